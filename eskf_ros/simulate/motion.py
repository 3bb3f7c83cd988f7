"""What the truth of a moving body is made of, whatever moves it.

All of it is in ``map``: a frame rigidly fixed to the Earth, x east, y north, z up at the datum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eskf_ros.geodesy import rotation

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


class Trajectory(Protocol):
    """A motion as a function of time."""

    @property
    def duration(self) -> float:
        """Its length in seconds."""
        ...

    @property
    def breakpoints(self) -> Array:
        """Times (s) from 0 to the end; between them all quantities of `Motion` are smooth."""
        ...

    def motion(self, times: ArrayLike) -> Motion:
        """Return the truth at ``times`` (n,) in seconds from the start; ValueError outside of the trajectory."""
        ...


def checked_times(times: ArrayLike, duration: float) -> Array:
    """Return ``times`` (s) as an array (n,); ValueError unless all lie within 0 to ``duration``."""
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    if t.size and (t.min() < 0.0 or t.max() > duration):
        raise ValueError(f"times must lie within the trajectory, 0 to {duration:.3f} s")
    return t


@dataclass(frozen=True)
class Motion:
    """Truth of base_link at n times. Lengths in m, angles in rad, time in s.

    ``position_map``, ``velocity_map``, ``acceleration_map`` (n, 3): relative to ``map``, in its axes.
    ``attitude_body_to_map`` (n, 4): quaternion w x y z.
    ``angular_rate_body``, ``angular_acceleration_body`` (n, 3): of the body relative to ``map``, in body axes.
    """

    position_map: Array
    velocity_map: Array
    acceleration_map: Array
    attitude_body_to_map: Array
    angular_rate_body: Array
    angular_acceleration_body: Array

    @cached_property
    def rotation_body_to_map(self) -> Array:
        """The attitudes as rotation matrices (n, 3, 3)."""
        w, x, y, z = self.attitude_body_to_map.T
        rows = (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        )
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    def velocity_of(self, lever_arm_body: ArrayLike) -> Array:
        """Return the velocity in map (n, 3) of a point fixed in the body at ``lever_arm_body`` (3,)."""
        arm = np.asarray(lever_arm_body, dtype=np.float64)
        return self.velocity_map + rotate(self.rotation_body_to_map, cross(self.angular_rate_body, arm))

    def position_of(self, lever_arm_body: ArrayLike) -> Array:
        """Return the position in map (n, 3) of a point fixed in the body at ``lever_arm_body`` (3,)."""
        return self.position_map + self.rotation_body_to_map @ np.asarray(lever_arm_body, dtype=np.float64)

    def acceleration_of(self, lever_arm_body: ArrayLike) -> Array:
        """Return the acceleration in map (n, 3) of a point fixed in the body at ``lever_arm_body`` (3,)."""
        arm = np.asarray(lever_arm_body, dtype=np.float64)
        rate = self.angular_rate_body
        in_body = cross(self.angular_acceleration_body, arm) + cross(rate, cross(rate, arm))
        return self.acceleration_map + rotate(self.rotation_body_to_map, in_body)


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of 3-vectors in the last axis; several times quicker than numpy's for few vectors."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def rotate(matrices: Array, vectors: Array) -> Array:
    """Return rotation matrices (n, 3, 3) times vectors (n, 3)."""
    return np.einsum("nij,nj->ni", matrices, vectors)


def mounting(rpy_deg: Vector) -> Array:
    """Return the rotation matrix (3, 3) from a sensor's to base_link axes; fixed-axis ``rpy_deg``, as in URDF."""
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    return np.array(rotation.to_matrix(rotation.from_roll_pitch_yaw(roll, pitch, yaw)))
