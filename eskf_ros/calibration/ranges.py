"""Recordings with ranges of satellites (mode tight): each epoch is solved alone and calibrates as a fix would.

Lever arm and time offset are those of antenna and receiver, whatever the filter is given of it. Position and velocity
of an epoch have the same stamp, so that one time offset serves both, ``ranges.time_offset``.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import open_bag
from eskf_ros.calibration.constants import Constant, constants_of
from eskf_ros.filter.navigator import Navigator
from eskf_ros.gnss.rinex import RinexError
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.inputs.table import RANGES, uses_ranges
from eskf_ros.parameters.mapping import from_mapping, to_mapping
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.feed import Feed
from eskf_ros.replay.topics import InputError, find_topic, find_topics
from eskf_ros.tables.bag import Table, read_bag

OF_FIXES = (
    "mode",
    "ranges.use_point_solution",
    "gnss.time_offset",
    "gnss.velocity_time_offset",
    "gnss.correlation_time",
)
"""Parameters that are others while solutions of ranges stand for fixes."""

NO_OFFSET_STD = 1e-4
"""s; of the time offset of velocities besides that of positions, which those of one epoch do not have."""


def with_fixes(parameters: Parameters) -> Parameters:
    """Return the parameters with which a filter uses solutions of ranges as fixes, which have no time offset yet."""
    values = (("loose", False, 0.0, 0.0, parameters.ranges.correlation_time),)
    return from_mapping(dict(to_mapping(parameters)) | dict(zip(OF_FIXES, *values, strict=True)))


def with_ranges(found: Parameters, given: Parameters) -> Parameters:
    """Return what was found with `with_fixes` of ``given`` as parameters for ranges."""
    before = to_mapping(given)
    offset = given.ranges.time_offset + found.gnss.time_offset
    back = {name: before[name] for name in OF_FIXES}
    return from_mapping(dict(to_mapping(found)) | back | {"ranges.time_offset": offset})


def constants_of_ranges(inputs: Collection[str], is_vehicle: bool) -> tuple[Constant, ...]:
    """Return what `constants_of` returns, but that velocities have no time offset of their own."""
    return tuple(
        dataclasses.replace(constant, prior_std=NO_OFFSET_STD) if constant.name == "velocity_time_offset" else constant
        for constant in constants_of(inputs, is_vehicle)
    )


def read_tables(path: Path, parameters: Parameters) -> dict[str, Table]:
    """Return the tables of a recording; with ranges their solutions as fixes.

    Raises BagError or InputError as `read_bag` does, and InputError if there are no ranges where they are used.
    """
    if not uses_ranges(parameters):
        return read_bag(path, parameters)
    values = dict(to_mapping(parameters)) | {"mode": "loose", "ranges.use_point_solution": True}
    solving = from_mapping(values)
    with open_bag([path]) as reader:
        if not find_topic(reader, parameters.topics.ranges):
            raise InputError(
                f"{path}: mode {parameters.mode} is calibrated with ranges, and there is no topic "
                f"{parameters.topics.ranges}: eskf_ranges writes those of RINEX files into a copy of the recording; "
                "with mode: loose the fixes of the receiver show the lever arm as well"
            )
        topics, _ = find_topics(reader, path, solving, "")
        inputs = {kind: topic for kind, topic in topics.inputs.items() if kind.name in RANGES}
        solutions = _Solutions()
        try:
            intake = RangeIntake(cast(Navigator, solutions), solving)
        except RinexError as error:
            raise InputError(str(error)) from error
        feed = Feed(cast(Navigator, solutions), dataclasses.replace(topics, inputs=inputs), intake=intake)
        for batch in reader.batches({topic: kind.type for kind, topic in inputs.items()}):
            feed.push(batch)
    if not solutions.velocities:
        said = "; ".join(intake.complaints)
        raise InputError(f"{path}: none of {intake.epochs} epochs of ranges has a solution" + (said and f": {said}"))
    return read_bag(path, solving) | solutions.tables(round(parameters.ranges.time_offset * 1e9))


class _Solutions:
    """Takes what a `RangeIntake` that solves epochs gives to a navigator."""

    def __init__(self) -> None:
        self.range_statuses: Counter[Any] = Counter()
        self.positions: list[tuple[Any, ...]] = []
        self.velocities: list[tuple[Any, ...]] = []

    def push_gnss_position(self, *arguments: Any, from_ranges: bool) -> None:
        """Take stamp, latitude, longitude (deg), altitude (m), covariance (m2), kind of covariance, status, arrival."""
        self.positions.append(arguments)

    def push_gnss_velocity(self, *arguments: Any, from_ranges: bool) -> None:
        """Take stamp, velocity (m/s), its covariance, arrival."""
        self.velocities.append(arguments)

    def tables(self, offset: int) -> dict[str, Table]:
        """Return the tables of fixes and velocities; ``offset`` (ns) is added to the stamps."""

        def columns(rows: list[tuple[Any, ...]], names: Sequence[str]) -> Table:
            table: dict[str, NDArray[Any]] = {
                name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=False)
            }
            table["stamp"] = table["stamp"] + offset
            return table

        fixes = ("stamp", "latitude_deg", "longitude_deg", "altitude", "covariance")
        return {
            "gnss_position": columns(self.positions, fixes),
            "gnss_velocity": columns(self.velocities, ("stamp", "velocity", "covariance")),
        }
