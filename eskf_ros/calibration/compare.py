"""The same recording with two configurations: NIS, ends of outages and, with truth, NEES."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.calibration.ranges import with_ranges
from eskf_ros.calibration.recording import Recording, filtered, mean_nis
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.inputs.table import uses_ranges
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.run import Options, replay

Array = NDArray[np.float64]

GNSS = ("gnss_position", "gnss_velocity", "heading")
"""Inputs that an outage withholds."""

ROWS = 50.0
"""Hz; of the estimates that are compared."""

SETTLED = 60.0
"""s from the first IMU sample to the first outage."""

LARGEST_FIX_STD = 1.5
"""m; a fix that claims to be worse is no judge of the end of an outage."""


def outages_of(recording: Recording, length: float, every: float) -> list[tuple[int, int]]:
    """Return first and last stamp (ns) of outages of ``length`` s, one in ``every`` s."""
    stamps = np.asarray(recording.tables["imu"]["stamp"])
    first, last = int(stamps.min()), int(stamps.max())
    starts = np.arange(SETTLED, (last - first) * 1e-9 - length - 5.0, every)
    return [(first + round(s * 1e9), first + round((s + length) * 1e9)) for s in starts.tolist()]


def without(recording: Recording, outages: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """Return the tables without what GNSS gives in the outages."""
    tables = dict(recording.tables)
    for name in GNSS:
        if name in tables:
            stamp = np.asarray(tables[name]["stamp"])
            kept = np.ones(len(stamp), bool)
            for first, last in outages:
                kept &= (stamp < first) | (stamp >= last)
            tables[name] = {column: np.asarray(values)[kept] for column, values in tables[name].items()}
    return tables


def outage_ends(recording: Recording, parameters: Parameters, length: float, every: float) -> list[float]:
    """Return the horizontal distance (m) of the antenna from the last fix of each outage."""
    outages = outages_of(recording, length, every)
    if not outages:
        return []
    result = filtered(without(recording, outages), parameters, ROWS).result()
    rows, datum = result.odometry, result.summary["datum"]
    rows = rows[rows["heading_known"]]
    if datum is None or not len(rows):
        return []
    fixes = recording.tables["gnss_position"]
    stamp = np.asarray(fixes["stamp"]) + round(parameters.gnss.time_offset * 1e9)
    frame = MapFrame(tuple(datum))
    errors = []
    for first, last in outages:
        good = (stamp >= first) & (stamp < last) & (horizontal_std(fixes) < LARGEST_FIX_STD)
        if not good.any() or stamp[good].max() < last - 2e9 or rows["stamp"][0] > first:
            continue
        k = int(np.flatnonzero(good)[np.argmax(stamp[good])])
        place = frame.from_geodetic_deg(fixes["latitude_deg"][k], fixes["longitude_deg"][k], fixes["altitude"][k])
        errors.append(float(np.linalg.norm(antenna_at(rows, int(stamp[k]), parameters)[:2] - np.array(place)[:2])))
    return errors


def horizontal_std(fixes: Any) -> Array:
    """Return the larger horizontal standard deviation (m) that fixes claim."""
    covariance = np.asarray(fixes.get("covariance", np.zeros(len(fixes["stamp"]))))
    if covariance.ndim == 1:
        variance = covariance
    elif covariance.shape[1:] == (9,):
        variance = np.maximum(covariance[:, 0], covariance[:, 4])
    else:
        variance = np.maximum(covariance[:, 0], covariance[:, 1]) if covariance.ndim == 2 else covariance[:, 0, 0]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def antenna_at(rows: NDArray[Any], stamp: int, parameters: Parameters) -> Array:
    """Return the position (m, map) of the antenna at a stamp (ns)."""
    k = int(np.clip(np.searchsorted(rows["stamp"], stamp), 1, len(rows) - 1))
    near = rows[k - 1 : k + 1]
    share = (stamp - int(near["stamp"][0])) / max(int(near["stamp"][1] - near["stamp"][0]), 1)
    position = near["position_map"][0] + np.clip(share, 0.0, 1.0) * (near["position_map"][1] - near["position_map"][0])
    attitude = Rotation.from_quat(np.roll(near["attitude_body_to_map"][1], -1))
    arm: Array = position + attitude.apply(parameters.gnss.lever_arm)
    return arm


def compared(
    recording: Recording, before: Parameters, after: Parameters, outage: tuple[float, float], truth: str = ""
) -> dict[str, dict[str, Any]]:
    """Return "before" and "after", each as of `figures_of`."""
    return {
        label: figures_of(recording, parameters, outage, truth)
        for label, parameters in (("before", before), ("after", after))
    }


def figures_of(
    recording: Recording, parameters: Parameters, outage: tuple[float, float], truth: str = ""
) -> dict[str, Any]:
    """Return ``nis`` by stream, ``outage_ends`` (m) and, with a topic of truth, ``nees`` and ``error``.

    ``outage``: length of outages, and the time from one to the next (s).
    """
    result = filtered(recording.tables, parameters, 1.0).result()
    found: dict[str, Any] = {
        "nis": mean_nis(result.summary["aids"], result.innovations),
        "outage_ends": outage_ends(recording, parameters, *outage),
    }
    if truth and recording.path is not None:
        with tempfile.TemporaryDirectory(prefix="eskf_calibrate-") as folder:
            used = with_ranges(parameters, given) if uses_ranges(given := recording.parameters) else parameters
            summary = replay(recording.path, used, Options(Path(folder) / "results", truth=truth))
        found |= {"nees": summary["nees"], "error": summary["error"]}
    return found
