"""The motion of a simulated car: driving instructions turned into a smooth trajectory.

Speed, distance and course are those of `eskf_ros.simulate.profile`. base_link is the middle of the rear axle: its
velocity points along the course, up and down with the slope of the road. The heading is the course, or, on tyres that
slip sideways, turned into the curve by an angle in proportion to the lateral acceleration. The body squats with
acceleration and rolls with lateral acceleration. Velocity, acceleration, attitude and angular rate are closed
expressions of these; only position is a quadrature, exact to rounding. So all of them are derivatives of each other to
machine precision.

All of it is in ``map``: a frame rigidly fixed to the Earth, x east, y north, z up at the datum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PPoly

from eskf_ros.simulate.motion import Motion, checked_times
from eskf_ros.simulate.profile import Instruction, Profile, stacked
from eskf_ros.simulate.quadrature import PositionIntegral

Array = NDArray[np.float64]

PITCH_PER_ACCELERATION = math.radians(2.0) / 9.80665
ROLL_PER_ACCELERATION = math.radians(4.0) / 9.80665
"""Tilt of a car's body on its springs, rad per m/s2 (usual figures: 2 deg/g in pitch, 4 deg/g in roll)."""

SIDE_SLIP_PER_ACCELERATION = math.radians(2.5) / 9.80665
"""Side slip of rear tyres, rad per m/s2 (usual figure: 2.5 deg/g)."""

HILLS = ((0.030, 700.0), (0.015, 190.0))
"""Slope of the road over the distance driven: a sum of sines, each (amplitude in rad, wave length in m)."""


class DriveTrajectory:
    """A car following driving instructions, starting at the origin of ``map``."""

    def __init__(
        self,
        instructions: Sequence[Instruction],
        heading_deg: float = 0.0,
        speed: float = 0.0,
        hills: Sequence[tuple[float, float]] = HILLS,
        side_slip: float = 0.0,
    ) -> None:
        """Prepare the drive.

        ``heading_deg`` is the heading at the start, counter-clockwise from east (REP-103), ``speed`` the speed there
        in m/s, backwards below zero. ``side_slip`` is the angle from the course to the heading in rad per m/s2 of
        lateral acceleration. Raises ValueError for an instruction that cannot be followed (a turn while
        standing).
        """
        profile = Profile(instructions, speed)
        self.breakpoints: Array = profile.breakpoints
        """Times (s) at which the fourth derivative of speed and heading may jump; the last is the end."""
        rates = profile.rates("speed", "yaw")
        states = rates.antiderivative()
        states.c[-1] += (speed, math.radians(heading_deg))
        distance = PPoly(states.c[..., :1], self.breakpoints).antiderivative()
        self._way = stacked(distance, states)
        self._profile = stacked(distance, states, rates, rates.derivative(), rates.derivative(2))
        self._hills = tuple(hills)
        self._side_slip = side_slip
        self._position = PositionIntegral(self._velocity, self.breakpoints)

    @property
    def duration(self) -> float:
        """Length of the drive in seconds."""
        return float(self.breakpoints[-1])

    def motion(self, times: ArrayLike) -> Motion:
        """Return the truth at ``times`` (n,) in seconds from the start; ValueError outside of the drive."""
        t = checked_times(times, self.duration)
        distance, speed, yaw, acceleration, yaw_rate, jerk, yaw_acceleration, snap, yaw_jerk = self._profile(t).T
        slope, slope_gradient, slope_curvature = self._slope(distance)
        slope_rate = slope_gradient * speed

        cos_slope, sin_slope, cos_yaw, sin_yaw = np.cos(slope), np.sin(slope), np.cos(yaw), np.sin(yaw)
        along = np.stack([cos_slope * cos_yaw, cos_slope * sin_yaw, sin_slope], axis=-1)
        upward = np.stack([-sin_slope * cos_yaw, -sin_slope * sin_yaw, cos_slope], axis=-1)
        leftward = np.stack([-sin_yaw, cos_yaw, np.zeros_like(yaw)], axis=-1)
        acceleration_map = (
            acceleration[:, None] * along
            + (speed * slope_rate)[:, None] * upward
            + (speed * yaw_rate * cos_slope)[:, None] * leftward
        )

        # REP-103: pitch is positive nose down, roll positive right side down.
        lateral = (
            speed * yaw_rate,
            acceleration * yaw_rate + speed * yaw_acceleration,
            jerk * yaw_rate + 2.0 * acceleration * yaw_acceleration + speed * yaw_jerk,
        )
        roll, roll_rate, roll_acceleration = (ROLL_PER_ACCELERATION * part for part in lateral)
        slip, slip_rate, slip_acceleration = (self._side_slip * part for part in lateral)
        pitch = -slope - PITCH_PER_ACCELERATION * acceleration
        pitch_rate = -slope_rate - PITCH_PER_ACCELERATION * jerk
        pitch_acceleration = (
            -slope_curvature * speed * speed - slope_gradient * acceleration - PITCH_PER_ACCELERATION * snap
        )
        rate, rate_derivative = _body_rates(
            (roll, pitch),
            (roll_rate, pitch_rate, yaw_rate + slip_rate),
            (roll_acceleration, pitch_acceleration, yaw_acceleration + slip_acceleration),
        )
        return Motion(
            position_map=self._position(t),
            velocity_map=speed[:, None] * along,
            acceleration_map=acceleration_map,
            attitude_body_to_map=_quaternions(roll, pitch, yaw + slip),
            angular_rate_body=rate,
            angular_acceleration_body=rate_derivative,
        )

    def _slope(self, distance: Array) -> tuple[Array, Array, Array]:
        """Return slope (rad) and its first and second derivative by distance."""
        slope, gradient, curvature = (np.zeros_like(distance) for _ in range(3))
        for amplitude, wave_length in self._hills:
            wave_number = 2.0 * math.pi / wave_length
            sine = amplitude * np.sin(wave_number * distance)
            slope += sine
            gradient += amplitude * wave_number * np.cos(wave_number * distance)
            curvature -= wave_number * wave_number * sine
        return slope, gradient, curvature

    def _velocity(self, times: Array) -> tuple[Array, Array, Array]:
        distance, speed, yaw = np.moveaxis(self._way(times), -1, 0)
        slope = self._slope(distance)[0]
        level = speed * np.cos(slope)
        return level * np.cos(yaw), level * np.sin(yaw), speed * np.sin(slope)


def _quaternions(roll: Array, pitch: Array, yaw: Array) -> Array:
    """Return Rz(yaw) Ry(pitch) Rx(roll) as quaternions w x y z (n, 4)."""
    cr, sr = np.cos(0.5 * roll), np.sin(0.5 * roll)
    cp, sp = np.cos(0.5 * pitch), np.sin(0.5 * pitch)
    cy, sy = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def _body_rates(
    angles: tuple[Array, Array], rates: tuple[Array, Array, Array], accelerations: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Return angular rate and angular acceleration in body axes (n, 3) of fixed-axis roll, pitch, yaw.

    ``angles`` are roll and pitch; ``rates`` and ``accelerations`` those of roll, pitch, yaw. Groves, eq. 2.58, and its
    derivative.
    """
    cr, sr = np.cos(angles[0]), np.sin(angles[0])
    cp, sp = np.cos(angles[1]), np.sin(angles[1])
    roll, pitch, yaw = rates
    roll_dot, pitch_dot, yaw_dot = accelerations
    rate = np.stack([roll - yaw * sp, pitch * cr + yaw * cp * sr, yaw * cp * cr - pitch * sr], axis=-1)
    derivative = np.stack(
        [
            roll_dot - yaw_dot * sp - yaw * pitch * cp,
            pitch_dot * cr - pitch * roll * sr + yaw_dot * cp * sr + yaw * (roll * cp * cr - pitch * sp * sr),
            yaw_dot * cp * cr - yaw * (pitch * sp * cr + roll * cp * sr) - pitch_dot * sr - pitch * roll * cr,
        ],
        axis=-1,
    )
    return rate, derivative
