"""Ranges and ephemerides as topics of a recording, and the fixes a receiver would have computed from the ranges."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import POINT_CLOUD, cloud_messages
from eskf_ros.gnss.cloud import write_epoch
from eskf_ros.gnss.ephemeris import Broadcast, Ephemerides
from eskf_ros.gnss.ephemeris_cloud import write_ephemerides
from eskf_ros.gnss.point_solution import PointSolution, SolutionStatus, solve
from eskf_ros.gnss.ranges import SATELLITE_KNOWN, locate, one_per_satellite
from eskf_ros.gnss.signals import Gnss
from eskf_ros.inputs.epochs import DEFAULT_KLOBUCHAR
from support.recordings.common import GNSS_FRAME, STATUS_FIX, Array, Fixes, Messages, ecef_to_geodetic_deg, nanoseconds


@dataclass(frozen=True)
class RangeEpochs:
    """What a receiver measured, epoch by epoch.

    ``time`` (n,) Unix s of the measurements; ``week``, ``seconds`` (n,): their GPS time by the receiver; ``ranges``:
    one array (RANGE) for each, all signals.
    """

    time: Array
    week: int
    seconds: Array
    ranges: Sequence[NDArray[np.void]]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> RangeEpochs:
        kept = [ranges for ranges, stays in zip(self.ranges, chosen, strict=True) if stays]
        return RangeEpochs(self.time[chosen], self.week, self.seconds[chosen], kept)


def masked(epochs: RangeEpochs, count: int, start: float, length: float) -> RangeEpochs:
    """The epochs, of which those from `start` on (Unix s), for `length` s, have only the `count` strongest satellites.

    By the sum of C/N0 over that time: those that were there throughout.
    """
    inside = (epochs.time >= start) & (epochs.time < start + length)
    strength: dict[tuple[int, int], float] = {}
    for ranges in (ranges for ranges, is_in in zip(epochs.ranges, inside, strict=True) if is_in):
        for satellite in np.unique(ranges[["gnss_id", "sv_id"]]).tolist():
            of_one = (ranges["gnss_id"] == satellite[0]) & (ranges["sv_id"] == satellite[1])
            strength[satellite] = strength.get(satellite, 0.0) + float(ranges["cn0"][of_one].max())
    kept = sorted(strength, key=lambda satellite: -strength[satellite])[:count]
    stays = [
        np.array([not is_in or (row["gnss_id"], row["sv_id"]) in kept for row in ranges], np.bool_)
        for ranges, is_in in zip(epochs.ranges, inside, strict=True)
    ]
    left = [ranges[chosen] for ranges, chosen in zip(epochs.ranges, stays, strict=True)]
    return RangeEpochs(epochs.time, epochs.week, epochs.seconds, left)


def gnss_ranges(epochs: RangeEpochs, arrival: Array) -> Messages:
    """`gnss/ranges`; with satellites where the ranges know them."""
    clouds = []
    for seconds, ranges in zip(epochs.seconds, epochs.ranges, strict=True):
        known = bool(np.any(ranges["flags"] & SATELLITE_KNOWN))
        clouds.append(write_epoch(ranges, epochs.week, float(seconds), satellites=known))
    return Messages("gnss/ranges", POINT_CLOUD, arrival, cloud_messages(nanoseconds(epochs.time), clouds, GNSS_FRAME))


def gnss_ephemerides(
    time: float, broadcasts: Sequence[Broadcast], klobuchar: Mapping[Gnss, Array] | None = None
) -> Messages:
    """`gnss/ephemerides`: all of them in one message at `time` (Unix s)."""
    stamp = np.array([time])
    cloud: NDArray[Any] = write_ephemerides(broadcasts, klobuchar)
    return Messages("gnss/ephemerides", POINT_CLOUD, stamp, cloud_messages(nanoseconds(stamp), [cloud], GNSS_FRAME))


def point_solutions(
    epochs: RangeEpochs, ephemerides: Ephemerides, klobuchar: Array = DEFAULT_KLOBUCHAR
) -> Iterator[PointSolution]:
    """Our own point solution of each epoch, one signal per satellite."""
    for seconds, ranges in zip(epochs.seconds.tolist(), epochs.ranges, strict=True):
        located = ranges.copy()
        locate(located, epochs.week, seconds, ephemerides)
        yield solve(one_per_satellite(located), epochs.week, seconds, klobuchar)


def solved_fixes(
    epochs: RangeEpochs, ephemerides: Ephemerides, klobuchar: Array = DEFAULT_KLOBUCHAR
) -> tuple[Fixes, Array, Array, Array]:
    """Fixes of the epochs that could be solved; time (m,), velocity (m, 3) and its deviations (m, 3) of the others."""
    times, positions, covariances, velocity_times, velocities, deviations = [], [], [], [], [], []
    for time, solution in zip(epochs.time, point_solutions(epochs, ephemerides, klobuchar), strict=True):
        if solution.status != SolutionStatus.SOLVED:
            continue
        times.append(time)
        positions.append(solution.position_ecef)
        covariances.append(solution.covariance_enu)
        if solution.velocity_status == SolutionStatus.SOLVED:
            velocity_times.append(time)
            velocities.append(solution.velocity_enu)
            deviations.append(np.sqrt(np.diagonal(solution.velocity_covariance_enu)))
    status = np.full(len(times), STATUS_FIX, np.int8)
    fixes = Fixes(np.array(times), ecef_to_geodetic_deg(np.array(positions)), np.array(covariances), status)
    return fixes, np.array(velocity_times), np.array(velocities), np.array(deviations)
