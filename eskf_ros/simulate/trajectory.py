"""The motion of a simulated car: driving instructions turned into a smooth trajectory.

Acceleration along the road and yaw rate are piecewise polynomials of time (ramps of `SMOOTH_STEP`, so three times
continuously differentiable); speed, distance and heading are their exact integrals. base_link is the middle of the rear
axle: its velocity points along the heading, up and down with the slope of the road. The body squats with acceleration
and rolls with lateral acceleration. Velocity, acceleration, attitude and angular rate are closed expressions of these;
only position is a quadrature, exact to rounding. So all of them are derivatives of each other to machine precision.

All of it is in ``map``: a frame rigidly fixed to the Earth, x east, y north, z up at the datum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PPoly

from eskf_ros.simulate.motion import Motion, checked_times

Array = NDArray[np.float64]

SMOOTH_STEP = (-20.0, 70.0, -84.0, 35.0, 0.0, 0.0, 0.0, 0.0)
"""Coefficients, highest power first, of the step from 0 to 1 on [0, 1] whose first three derivatives vanish at both."""

RAMP_DURATION = 1.2
"""Seconds in which acceleration or yaw rate build up and fade."""

PITCH_PER_ACCELERATION = math.radians(2.0) / 9.80665
ROLL_PER_ACCELERATION = math.radians(4.0) / 9.80665
"""Tilt of a car's body on its springs, rad per m/s2 (usual figures: 2 deg/g in pitch, 4 deg/g in roll)."""

HILLS = ((0.030, 700.0), (0.015, 190.0))
"""Slope of the road over the distance driven: a sum of sines, each (amplitude in rad, wave length in m)."""

_KNOT_INTERVAL = 0.1
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(5)


@dataclass(frozen=True)
class Hold:
    """Keep speed and heading for ``duration`` seconds: stand still at speed zero, else cruise straight on."""

    duration: float


@dataclass(frozen=True)
class SpeedTo:
    """Change to ``speed`` (m/s), straight on, with at most ``acceleration`` (m/s2)."""

    speed: float
    acceleration: float = 2.0


@dataclass(frozen=True)
class Turn:
    """Turn by ``angle_deg`` (left positive) at the present speed with at most ``lateral_acceleration`` (m/s2)."""

    angle_deg: float
    lateral_acceleration: float = 2.0


Instruction = Hold | SpeedTo | Turn


class DriveTrajectory:
    """A car following driving instructions, starting at the origin of ``map``."""

    def __init__(
        self,
        instructions: Sequence[Instruction],
        heading_deg: float = 0.0,
        speed: float = 0.0,
        hills: Sequence[tuple[float, float]] = HILLS,
    ) -> None:
        """Prepare the drive.

        ``heading_deg`` is the heading at the start, counter-clockwise from east (REP-103), ``speed`` the speed there
        in m/s. Raises ValueError for an instruction that cannot be followed (a turn while standing, a negative speed).
        """
        pieces = _Pieces(speed)
        for instruction in instructions:
            pieces.add(instruction)
        self.breakpoints: Array = np.array(pieces.breakpoints)
        """Times (s) at which the fourth derivative of speed and heading may jump; the last is the end."""
        rates = PPoly(np.stack([pieces.acceleration, pieces.yaw_rate], axis=-1).transpose(1, 0, 2), self.breakpoints)
        states = rates.antiderivative()
        states.c[-1] += (speed, math.radians(heading_deg))
        distance = PPoly(states.c[..., :1], self.breakpoints).antiderivative()
        self._way = _stacked(distance, states)
        self._profile = _stacked(distance, states, rates, rates.derivative(), rates.derivative(2))
        self._hills = tuple(hills)
        counts = np.ceil(np.diff(self.breakpoints) / _KNOT_INTERVAL).astype(int)
        starts = [
            np.linspace(begin, end, count, endpoint=False)
            for begin, end, count in zip(self.breakpoints[:-1], self.breakpoints[1:], counts, strict=True)
        ]
        self._knots = np.concatenate([*starts, self.breakpoints[-1:]])
        increments = self._displacement(self._knots[:-1], self._knots[1:])
        self._knot_positions = np.vstack([np.zeros(3), np.cumsum(increments, axis=0)])

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
        roll = ROLL_PER_ACCELERATION * speed * yaw_rate
        roll_rate = ROLL_PER_ACCELERATION * (acceleration * yaw_rate + speed * yaw_acceleration)
        roll_acceleration = ROLL_PER_ACCELERATION * (
            jerk * yaw_rate + 2.0 * acceleration * yaw_acceleration + speed * yaw_jerk
        )
        pitch = -slope - PITCH_PER_ACCELERATION * acceleration
        pitch_rate = -slope_rate - PITCH_PER_ACCELERATION * jerk
        pitch_acceleration = (
            -slope_curvature * speed * speed - slope_gradient * acceleration - PITCH_PER_ACCELERATION * snap
        )
        rate, rate_derivative = _body_rates(
            (roll, pitch),
            (roll_rate, pitch_rate, yaw_rate),
            (roll_acceleration, pitch_acceleration, yaw_acceleration),
        )
        before = np.clip(np.searchsorted(self._knots, t, side="right") - 1, 0, len(self._knots) - 2)
        position = self._knot_positions[before] + self._displacement(self._knots[before], t)
        return Motion(
            position_map=position,
            velocity_map=speed[:, None] * along,
            acceleration_map=acceleration_map,
            attitude_body_to_map=_quaternions(roll, pitch, yaw),
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

    def _displacement(self, begin: Array, end: Array) -> Array:
        """Return the way (n, 3) from ``begin`` to ``end`` (n,) by Gauss quadrature; none may cross a knot."""
        half = 0.5 * (end - begin)
        distance, speed, yaw = np.moveaxis(self._way(begin[:, None] + half[:, None] * (1.0 + _GAUSS_NODES)), -1, 0)
        slope = self._slope(distance)[0]
        level = speed * np.cos(slope)
        ways = (level * np.cos(yaw), level * np.sin(yaw), speed * np.sin(slope))
        return np.stack([half * (way @ _GAUSS_WEIGHTS) for way in ways], axis=-1)


class _Pieces:
    """Collects the polynomial pieces (degree 7) of acceleration and yaw rate."""

    def __init__(self, speed: float) -> None:
        self.breakpoints = [0.0]
        self.acceleration: list[Array] = []
        self.yaw_rate: list[Array] = []
        self._speed = speed

    def add(self, instruction: Instruction) -> None:
        if isinstance(instruction, Hold):
            if instruction.duration <= 0.0:
                raise ValueError(f"{instruction}: the duration must be positive")
            self._append(instruction.duration, np.zeros(8), np.zeros(8))
        elif isinstance(instruction, SpeedTo):
            if instruction.speed < 0.0 or instruction.speed == self._speed:
                raise ValueError(f"{instruction}: the speed must differ from the present one and not be negative")
            self._window(instruction.speed - self._speed, instruction.acceleration, self.acceleration)
            self._speed = instruction.speed
        else:
            if self._speed <= 0.0 or instruction.angle_deg == 0.0:
                raise ValueError(f"{instruction}: a car turns only while it moves, and by an angle other than zero")
            yaw_rate = instruction.lateral_acceleration / self._speed
            self._window(math.radians(instruction.angle_deg), yaw_rate, self.yaw_rate)

    def _window(self, change: float, limit: float, pieces: list[Array]) -> None:
        """Append a ramp up, a plateau and a ramp down whose integral is ``change``."""
        plateau = abs(change) / limit - RAMP_DURATION
        if plateau <= 0.0:
            plateau = 0.0
            limit = abs(change) / RAMP_DURATION
        peak = math.copysign(limit, change)
        up = peak * np.array(SMOOTH_STEP) / RAMP_DURATION ** np.arange(7, -1, -1)
        level = np.zeros(8)
        level[-1] = peak
        for duration, shape in ((RAMP_DURATION, up), (plateau, level), (RAMP_DURATION, level - up)):
            if duration > 0.0:
                if pieces is self.acceleration:
                    self._append(duration, shape, np.zeros(8))
                else:
                    self._append(duration, np.zeros(8), shape)

    def _append(self, duration: float, acceleration: Array, yaw_rate: Array) -> None:
        self.breakpoints.append(self.breakpoints[-1] + duration)
        self.acceleration.append(acceleration)
        self.yaw_rate.append(yaw_rate)


def _stacked(*polynomials: PPoly) -> PPoly:
    """Return one polynomial that has all values of several; one evaluation is quicker than several."""
    order = max(len(polynomial.c) for polynomial in polynomials)
    padded = [np.pad(p.c, ((order - len(p.c), 0), (0, 0), (0, 0))) for p in polynomials]
    return PPoly(np.concatenate(padded, axis=-1), polynomials[0].x)


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
