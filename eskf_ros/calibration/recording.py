"""A recording, what it shows at first sight, and one pass of the filter over it with the constants as states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.api import Filter
from eskf_ros.calibration.coarse_mounting import CoarseMounting, coarse_mounting
from eskf_ros.calibration.constants import Constant, places_of
from eskf_ros.calibration.noise import Density, rest_and_road
from eskf_ros.calibration.ranges import read_tables
from eskf_ros.calibration.roll import ROW_RATE, Roll, roll_of
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.parameters.tree import Parameters

Array = NDArray[np.float64]
Tables = Mapping[str, Any]


@dataclass(frozen=True)
class Recording:
    """One recording: tables in memory (``held``), or the ``path`` they are read from, with topics of ``parameters``.

    What is read is not part of it: it can be sent to another process, and a hundred of them need the memory of one.
    """

    name: str
    held: Tables | None = None
    path: Path | None = None
    parameters: Parameters = field(default_factory=Parameters)

    @property
    def tables(self) -> Tables:
        """The tables as `eskf_ros.run` takes them, stamps as int64 ns; raises BagError or InputError."""
        if self.held is not None:
            return self.held
        assert self.path is not None
        return _read(self.path, self.parameters)


@lru_cache(maxsize=1)
def _read(path: Path, parameters: Parameters) -> Tables:
    return read_tables(path, parameters)


@dataclass(frozen=True)
class Look:
    """What a recording shows without the filter: its inputs, noise at rest and on the road, mounting of the IMU."""

    inputs: tuple[str, ...]
    rest: Density | None
    road: Density | None
    coarse: CoarseMounting | None

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Look:
        """Return what `as_dict` has told."""
        rest, road = (Density(**content[key]) if content[key] else None for key in ("rest", "road"))
        coarse = content["coarse"]
        if coarse:
            coarse = CoarseMounting(**coarse | {"quaternion": tuple(coarse["quaternion"])})
        return cls(tuple(content["inputs"]), rest, road, coarse)

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as JSON has it, exactly."""
        return asdict(self)


def look_at(recording: Recording, may_be_vehicle: bool) -> Look:
    """Return what a recording shows without the filter; the mounting only where it ``may_be_vehicle``."""
    tables = recording.tables
    coarse = coarse_mounting(tables) if may_be_vehicle else None
    inputs = sorted(name for name, table in tables.items() if len(table["stamp"]))
    return Look(tuple(inputs), *rest_and_road(tables), coarse)


@dataclass(frozen=True)
class Pass:
    """What one pass has found: corrections (n,) of the constants, their covariance (n, n), what they began with.

    ``nis``: mean NIS over degrees of freedom of the measurements that were tested, by stream. ``roll``: by how much
    base_link is rolled against the vehicle. ``restarts``: of the alignment.
    """

    correction: Array
    covariance: Array
    prior_std: Array
    nis: dict[str, float]
    roll: Roll
    restarts: int

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Pass:
        """Return what `as_dict` has told."""
        arrays = {key: np.array(content[key], float) for key in ("correction", "covariance", "prior_std")}
        roll = Roll(*(tuple(content["roll"][key]) for key in ("by_turns", "by_road")))
        return cls(**arrays, nis=content["nis"], roll=roll, restarts=content["restarts"])

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as JSON has it, exactly."""
        arrays = {key: getattr(self, key).tolist() for key in ("correction", "covariance", "prior_std")}
        return asdict(self) | arrays


def as_recording(source: Any, parameters: Parameters) -> Recording:
    """Return a recording from a path, from tables as `eskf_ros.run` takes them, or as it is."""
    if isinstance(source, Recording):
        return source
    if isinstance(source, str | PathLike):
        return Recording(Path(source).name, path=Path(source), parameters=parameters)
    return Recording("tables", dict(source))


def filtered(tables: Tables, parameters: Parameters, rate: float = ROW_RATE) -> Filter:
    """Return a filter that has seen all of the tables; ``rate`` of its rows in Hz."""
    filter_ = Filter(parameters, rate)
    filter_.push_imu(tables["imu"])
    for name, table in tables.items():
        if name != "imu":
            filter_.push(name, table)
    return filter_


def run_pass(recording: Recording, parameters: Parameters, constants: Sequence[Constant], first_std: Array) -> Pass:
    """Run the filter over a recording; ``parameters`` have the constants as states (`constants.as_states`)."""
    filter_ = filtered(recording.tables, parameters)
    result = filter_.result()
    state = filter_.state
    places = places_of(parameters, constants)
    used = [k for k, place in enumerate(places) if place < state["error_size"]]
    correction, covariance = np.zeros(len(constants)), np.diag(first_std**2)
    at = [places[k] for k in used]
    correction[used] = state["optional"][np.array(at, int) - ERROR_SIZE]
    covariance[np.ix_(used, used)] = state["covariance"][np.ix_(at, at)]
    return Pass(
        correction,
        covariance,
        first_std,
        mean_nis(result.summary["aids"], result.innovations),
        roll_of(result.odometry),
        int(result.summary["restarts"]),
    )


def mean_nis(aids: Mapping[str, Any], innovations: Any) -> dict[str, float]:
    """Return the mean NIS over degrees of freedom (1: as the covariances say) by stream."""
    found = {}
    for name in aids:
        rows = np.asarray(innovations["aid"]) == name
        nis, dof = np.asarray(innovations["nis"])[rows], np.asarray(innovations["dof"])[rows]
        tested = np.isfinite(nis) & (dof > 0)
        if tested.any():
            found[name] = float(np.sum(nis[tested]) / np.sum(dof[tested]))
    return found
