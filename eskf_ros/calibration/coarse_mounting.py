"""Coarse mounting of the IMU in a vehicle, from any orientation: no prior is needed.

While a vehicle drives forward, the mean specific force of a short interval is, in IMU axes,

    f = up g cos(slope) + forward (a + g sin(slope)) + left (speed course rate)

with slope, acceleration a and course rate from the velocities of GNSS. This is linear in the three axes of the vehicle:
one robust least squares over the drive gives them, and the nearest rotation is the mounting. Roll and pitch rest on
the road having no lean and the accelerometers no bias in the mean; the passes of the filter refine yaw and pitch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.geodesy.earth import STANDARD_GRAVITY

Array = NDArray[np.float64]

FORWARD_SPEED = 3.0
"""m/s; a vehicle that is faster drives forward."""

INTERVAL = 0.9
"""s; least time between the two velocities of an interval: half a second of noise is more than what vehicles do."""

LONGEST_INTERVAL = 2.5
"""s; over a longer time speed and course do more than change at a constant rate."""

LAGS = np.arange(-0.6, 0.61, 0.05)
"""s; by how much the velocities may be later than the IMU says: the best fit decides."""

FEWEST = 20
"""Intervals that are needed."""

LEAST_ACCELERATION = 0.25
"""m/s2; rms of the acceleration along the path, below which the direction forward is not seen, only guessed."""


@dataclass(frozen=True)
class CoarseMounting:
    """``quaternion``: IMU to vehicle, x, y, z, w; ``std_deg``: about how good it is; ``lag`` (s): of velocities."""

    quaternion: tuple[float, ...]
    std_deg: float
    lag: float
    count: int

    @property
    def rotation(self) -> Rotation:
        """IMU to vehicle."""
        return Rotation.from_quat(self.quaternion)


def coarse_mounting(tables: Mapping[str, Any]) -> CoarseMounting | None:
    """Return the mounting that a recording shows; None if it shows none (too slow, or never speeds up or brakes).

    ``tables``: imu and gnss_velocity as `eskf_ros.run` takes them, stamps in ns.
    """
    if "gnss_velocity" not in tables:
        return None
    imu = tables["imu"]
    order = np.argsort(imu["stamp"], kind="stable")
    time = np.asarray(imu["stamp"], np.int64)[order]
    start = int(time[0])
    seconds = (time - start) * 1e-9
    integral = np.zeros((len(seconds), 3))
    force = np.asarray(imu["specific_force"], float)[order]
    integral[1:] = np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(seconds)[:, None], axis=0)
    first, last, design = intervals(tables["gnss_velocity"], start)
    if len(first) < FEWEST or np.sqrt(np.mean(design[:, 1] ** 2)) < LEAST_ACCELERATION:
        return None
    best: CoarseMounting | None = None
    least = np.inf
    for lag in LAGS:
        inside = (first - lag > seconds[0]) & (last - lag < seconds[-1])
        if np.count_nonzero(inside) < FEWEST:
            continue
        ends = [np.stack([np.interp(t[inside] - lag, seconds, c) for c in integral.T], 1) for t in (first, last)]
        mean = (ends[1] - ends[0]) / (last - first)[inside, None]
        axes, error, std = fit(design[inside], mean)
        if error < least:
            least = error
            quaternion = Rotation.from_matrix(nearest_rotation(axes, design[inside])).as_quat()
            count = int(np.count_nonzero(inside))
            best = CoarseMounting(tuple(quaternion.tolist()), float(np.degrees(std)), float(lag), count)
    return best


def intervals(table: Mapping[str, Any], start: int) -> tuple[Array, Array, Array]:
    """Return beginning and end (s after ``start`` ns) of intervals, and their parts along up, forward, left (n, 3)."""
    order = np.argsort(table["stamp"], kind="stable")
    time = (np.asarray(table["stamp"], np.int64)[order] - start) * 1e-9
    velocity = np.asarray(table["velocity"], float)[order]
    good = np.isfinite(velocity).all(axis=1)
    time, velocity = time[good], velocity[good]
    later = np.searchsorted(time, time + INTERVAL)
    here = np.flatnonzero(later < len(time))
    later = later[here]
    speed = np.linalg.norm(velocity[:, :2], axis=1)
    passed = time[later] - time[here]
    fast = (passed < LONGEST_INTERVAL) & (speed[here] > FORWARD_SPEED) & (speed[later] > FORWARD_SPEED)
    here, later, passed = here[fast], later[fast], passed[fast]
    course = np.arctan2(velocity[:, 1], velocity[:, 0])
    turn = np.angle(np.exp(1j * (course[later] - course[here])))
    mean = 0.5 * (speed[here] + speed[later])
    slope = np.arctan2(0.5 * (velocity[here, 2] + velocity[later, 2]), mean)
    design = np.stack(
        [
            STANDARD_GRAVITY * np.cos(slope),
            (speed[later] - speed[here]) / passed + STANDARD_GRAVITY * np.sin(slope),
            mean * turn / passed,
        ],
        axis=1,
    )
    return time[here], time[later], design


def fit(design: Array, force: Array) -> tuple[Array, float, float]:
    """Return up, forward, left as rows (3, 3) in IMU axes, the median residual (m/s2), the sigma of forward (rad)."""
    weight = np.ones(len(design))
    axes: Array = np.zeros((3, 3))
    residual: Array = np.zeros(len(design))
    for _ in range(5):
        axes = np.asarray(np.linalg.lstsq(design * weight[:, None], force * weight[:, None], rcond=None)[0], float)
        residual = np.linalg.norm(force - design @ axes, axis=1)
        # Huber's weights (Robust Statistics, 1981): potholes and multipath do not count squared.
        weight = np.sqrt(np.minimum(1.0, 1.5 * np.median(residual) / np.maximum(residual, 1e-9)))
    information = float(np.sum((weight[:, None] * design[:, 1:]) ** 2))
    # Neighbouring intervals overlap: half of them are new.
    return axes, float(np.median(residual)), float(np.sqrt(2.0) * np.median(residual) / np.sqrt(information))


def nearest_rotation(axes: Array, design: Array) -> Array:
    """Return the rotation (IMU to vehicle) closest to rows up, forward, left, each weighed by what shows it.

    Wahba's problem (Markley, Attitude determination using vector observations and the singular value decomposition,
    1988).
    """
    strength = np.sum(design**2, axis=0)
    target = np.zeros((3, 3))
    for row, place in enumerate((2, 0, 1)):
        target[place] = strength[row] * axes[row]
    u, _, v = np.linalg.svd(target)
    rotation: Array = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return rotation
