"""A recording in memory, and one pass of the filter over it with the constants as states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.api import Filter
from eskf_ros.calibration.constants import Constant, places_of
from eskf_ros.calibration.roll import ROW_RATE, Roll, roll_of
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.parameters.tree import Parameters
from eskf_ros.tables.bag import read_bag

Array = NDArray[np.float64]
Tables = Mapping[str, Any]


@dataclass(frozen=True)
class Recording:
    """The tables of a recording as `eskf_ros.run` takes them, stamps as int64 ns, and where it comes from."""

    name: str
    tables: Tables
    path: Path | None = None

    @property
    def inputs(self) -> set[str]:
        """Names of the inputs that have messages."""
        return {name for name, table in self.tables.items() if len(table["stamp"])}


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


def as_recording(source: Any, parameters: Parameters) -> Recording:
    """Return a recording in memory from a path, from tables as `eskf_ros.run` takes them, or as it is.

    Raises BagError or InputError for a path that cannot be used.
    """
    if isinstance(source, Recording):
        return source
    if isinstance(source, str | PathLike):
        return Recording(Path(source).name, read_bag(source, parameters), Path(source))
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
