"""`--static`: noise densities and bias instability of an IMU from hours at rest, by the Allan deviation.

The overlapping Allan deviation and its noise of a slope follow IEEE Std 952 (annex C): white noise has the slope -1/2
and its density is the deviation at one second; the bias instability is the lowest point, over 0.664; a random walk of
the bias has the slope +1/2 and its density is the deviation at three seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FLICKER = 0.664
"""Least of the Allan deviation over the bias instability: sqrt(2 ln 2 / pi)."""

SLOPE = 0.15
"""By how much the slope of a part of the curve may differ from that of white noise or random walk."""

PER_DECADE = 12
"""Points of the curve in a decade of averaging times."""

SHORTEST = 60.0
"""s of rest that are needed."""

SHARE = 0.1
"""Longest averaging time as a share of the recording: beyond it there are too few independent averages."""

MOVED = 8.0
"""A second whose mean is so many of its usual deviations off is one in which somebody touched the IMU."""


@dataclass(frozen=True)
class StaticAxis:
    """One axis.

    ``density``: white noise; ``instability``: of the bias; ``walk``: density of its random walk, NaN where the
    recording is too short for it. ``tau``, ``deviation``: the curve. Units of the readings: m/s2 or rad/s.
    """

    name: str
    density: float
    instability: float
    walk: float
    tau: Array
    deviation: Array


@dataclass(frozen=True)
class StaticNoise:
    """Six axes, the seconds and Hz they were seen for, and what is odd."""

    axes: list[StaticAxis]
    seconds: float
    rate: float
    warnings: list[str]

    def worst(self, sensor: str, quantity: str) -> float:
        """Return the largest value over the axes of ``sensor`` (accel or gyro), NaN if no axis shows it."""
        values = [getattr(axis, quantity) for axis in self.axes if axis.name.startswith(sensor)]
        known = [value for value in values if math.isfinite(value)]
        return max(known) if known else math.nan


def static_noise(imu: Any) -> StaticNoise:
    """Return the noise of an IMU at rest; ``imu`` is a table as `eskf_ros.run` takes it, stamps in ns.

    Raises:
        ImportError: allantools is not installed (pip install 'eskf_ros[calibrate]').
        ValueError: the recording is too short.
    """
    import allantools

    order = np.argsort(imu["stamp"], kind="stable")
    time = (np.asarray(imu["stamp"], np.int64)[order] - int(np.min(imu["stamp"]))) * 1e-9
    readings = np.concatenate([imu["specific_force"], imu["angular_rate"]], axis=1)[order].astype(float)
    seconds = float(time[-1])
    if seconds < SHORTEST:
        raise ValueError(
            f"{seconds:.0f} s of rest are too short: the Allan deviation takes {SHORTEST:.0f} s, better hours"
        )
    rate = (len(time) - 1) / seconds
    # A missing sample shifts what follows by one: on an even grid it is bridged.
    grid = np.arange(round(seconds * rate)) / rate
    even = np.stack([np.interp(grid, time, column) for column in readings.T], 1)
    warnings = moved_warnings(even, rate)
    taus = np.logspace(
        math.log10(1.0 / rate), math.log10(SHARE * seconds), int(PER_DECADE * math.log10(SHARE * seconds * rate)) + 2
    )
    axes = []
    for k, name in enumerate(f"{sensor}_{axis}" for sensor in ("accel", "gyro") for axis in "xyz"):
        tau, deviation, _, _ = allantools.oadev(even[:, k], rate=rate, data_type="freq", taus=taus)
        axes.append(axis_of(name, tau, deviation))
    return StaticNoise(axes, seconds, rate, warnings)


def axis_of(name: str, tau: Array, deviation: Array) -> StaticAxis:
    """Read white noise, bias instability and random walk off a curve."""
    slope = np.gradient(np.log(deviation), np.log(tau))
    lowest = int(np.argmin(deviation))
    white = (np.abs(slope + 0.5) < SLOPE) & (np.arange(len(tau)) <= lowest)
    density = float(np.exp(np.mean(np.log(deviation[white] * np.sqrt(tau[white]))))) if white.any() else math.nan
    rising = (np.abs(slope - 0.5) < SLOPE) & (np.arange(len(tau)) > lowest)
    walk = (
        float(np.exp(np.mean(np.log(deviation[rising] * np.sqrt(3.0 / tau[rising]))))) if rising.sum() > 2 else math.nan
    )
    is_bottom = lowest < len(tau) - 1
    return StaticAxis(
        name, density, float(deviation[lowest] / FLICKER) if is_bottom else math.nan, walk, tau, deviation
    )


def moved_warnings(even: Array, rate: float) -> list[str]:
    """Return a sentence if the IMU was not at rest all the time."""
    length = round(rate)
    means = even[: len(even) // length * length].reshape(-1, length, 6).mean(axis=1)
    off = np.abs(means - np.median(means, axis=0))
    usual = 1.4826 * np.median(off, axis=0)
    moved = np.flatnonzero((off > MOVED * np.maximum(usual, 1e-9)).any(axis=1))
    if not len(moved):
        return []
    return [f"the IMU was moved: {len(moved)} seconds stand out, the first {int(moved[0])} s after the start"]


def parameters_of(noise: StaticNoise) -> dict[str, tuple[float, str]]:
    """Return parameters by name, each with its evidence; what the recording is too short for is left out."""
    found = {}
    for sensor, unit in (("gyro", "rad/s"), ("accel", "m/s2")):
        density, walk = noise.worst(sensor, "density"), noise.worst(sensor, "walk")
        instability = noise.worst(sensor, "instability")
        about = f"worst of three axes over {noise.seconds:.0f} s at {noise.rate:.0f} Hz"
        bias = (
            f"bias instability {instability:.2g} {unit}" if math.isfinite(instability) else "bias instability not shown"
        )
        if math.isfinite(density):
            found[f"imu.{sensor}_noise_density"] = density, f"Allan deviation at 1 s, {about}; {bias}"
        if math.isfinite(walk):
            found[f"imu.{sensor}_bias_random_walk"] = walk, f"Allan deviation, slope 1/2 at 3 s, {about}"
    return found


def draw(noise: StaticNoise, path: Path) -> None:
    """Draw the curves of the six axes. Raises ImportError without matplotlib."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(11, 4.5), constrained_layout=True)
    for panel, sensor, unit in zip(panels, ("gyro", "accel"), ("rad/s", "m/s2"), strict=True):
        for axis in noise.axes:
            if axis.name.startswith(sensor):
                label = f"{axis.name[-1]}: {axis.density:.2g} {unit}/rtHz, instability {axis.instability:.2g} {unit}"
                panel.loglog(axis.tau, axis.deviation, label=label)
        panel.set_xlabel("averaging time, s")
        panel.set_ylabel(f"Allan deviation of the {sensor}, {unit}")
        panel.grid(True, which="both", alpha=0.3)
        panel.legend(fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)
