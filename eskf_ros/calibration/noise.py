"""The noise of the IMU as a recording shows it: at rest, and on the road.

At rest the density is the Allan deviation at one second (IEEE Std 952: N = sigma(tau) sqrt(tau) where the noise is
white): what is faster, the hum of an engine, averages out, as it does in the filter. On the road it is that of the
spectrum above what vehicles do: half the one-sided power spectral density.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

Array = NDArray[np.float64]

REST_SPEED = 0.5
"""m/s; below it velocities of GNSS are those of a vehicle at rest: their noise is 0.2 m/s, nobody creeps for long."""

DRIVING_SPEED = 3.0
"""m/s; above it the road shakes the IMU."""

BAND = (4.0, 12.0)
"""Hz; of the spectrum on the road: above the motion of vehicles, below what cheap IMUs filter out."""

SEGMENT = 4.0
"""s; length of the segments of the spectrum."""

FEWEST_SECONDS = 20
"""s of rest or driving that are needed."""


@dataclass(frozen=True)
class Density:
    """White noise of gyro (rad/s/rtHz) and accelerometer (m/s2/rtHz), mean over the axes; s it was seen for."""

    gyro: float
    accel: float
    seconds: float


def rest_and_road(tables: Mapping[str, Any]) -> tuple[Density | None, Density | None]:
    """Return the noise at rest and while driving; None where there is too little of it."""
    imu = tables["imu"]
    order = np.argsort(imu["stamp"], kind="stable")
    time: Array = ((np.asarray(imu["stamp"], np.int64)[order] - int(np.min(imu["stamp"]))) * 1e-9).astype(np.float64)
    readings: Array = np.concatenate([imu["specific_force"], imu["angular_rate"]], axis=1)[order]
    speed = speed_at(tables, time, int(np.min(imu["stamp"])))
    return at_rest(time, readings, speed < REST_SPEED), on_the_road(time, readings, speed > DRIVING_SPEED)


def speed_at(tables: Mapping[str, Any], time: Array, start: int) -> Array:
    """Return the speed (m/s) at times (s after ``start`` ns), NaN where no velocity is near."""
    table = tables.get("gnss_velocity")
    if table is None or not len(table["stamp"]):
        return np.full(len(time), np.nan)
    order = np.argsort(table["stamp"], kind="stable")
    given = (np.asarray(table["stamp"], np.int64)[order] - start) * 1e-9
    speed = np.linalg.norm(np.asarray(table["velocity"], float)[order], axis=1)
    near = np.abs(given[np.clip(np.searchsorted(given, time), 0, len(given) - 1)] - time) < 2.0
    return np.where(near, np.interp(time, given, speed), np.nan)


def runs(chosen: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        yield slice(int(first), int(last))


def at_rest(time: Array, readings: Array, chosen: NDArray[np.bool_]) -> Density | None:
    """Return the Allan deviation at one second over the periods of rest, without their first and last second."""
    squares, seconds = [], 0.0
    for run in runs(chosen):
        inside = (time[run] > time[run.start] + 1.0) & (time[run] < time[run.stop - 1] - 1.0)
        second = np.floor(time[run][inside]).astype(int)
        if len(second) < 2 or second[-1] - second[0] < 3:
            continue
        counts = np.bincount(second - second[0])
        sums = np.stack([np.bincount(second - second[0], c) for c in readings[run][inside].T], 1)
        means = sums[1:-1] / np.maximum(counts[1:-1], 1)[:, None]
        squares.append(0.5 * np.diff(means, axis=0) ** 2)
        seconds += len(means)
    if seconds < FEWEST_SECONDS:
        return None
    variance = np.mean(np.concatenate(squares), axis=0)
    return Density(float(np.sqrt(variance[3:].mean())), float(np.sqrt(variance[:3].mean())), seconds)


def on_the_road(time: Array, readings: Array, chosen: NDArray[np.bool_]) -> Density | None:
    """Return the density of the spectrum in `BAND`; half of the periods are louder."""
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    high = min(BAND[1], 0.4 / interval)
    length = round(SEGMENT / interval)
    found, seconds = [], 0.0
    for run in runs(chosen):
        if run.stop - run.start >= length and high > BAND[0]:
            frequency, power = welch(readings[run], 1.0 / interval, nperseg=length, axis=0)
            found.append(power[(frequency >= BAND[0]) & (frequency <= high)])
            seconds += time[run.stop - 1] - time[run.start]
    if seconds < FEWEST_SECONDS:
        return None
    power = np.mean([part.mean(axis=0) for part in found], axis=0)
    return Density(float(np.sqrt(power[3:].mean() / 2.0)), float(np.sqrt(power[:3].mean() / 2.0)), seconds)
