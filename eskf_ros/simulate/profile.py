"""Instructions to a vehicle, and the speed, heading and climb over time that they mean.

Their rates are piecewise polynomials of time, ramps of `SMOOTH_STEP`, so three times continuously differentiable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PPoly

Array = NDArray[np.float64]

SMOOTH_STEP = (-20.0, 70.0, -84.0, 35.0, 0.0, 0.0, 0.0, 0.0)
"""Coefficients, highest power first, of the step from 0 to 1 on [0, 1] whose first three derivatives vanish at both."""

RAMP_DURATION = 1.2
"""Seconds in which acceleration or yaw rate build up and fade."""

LIFT_DURATION = 5.0
"""Seconds in which the wings take over the weight, and give it back, but for a ramp."""


@dataclass(frozen=True)
class Hold:
    """Keep speed and heading for ``duration`` seconds: stand still at speed zero, else cruise straight on."""

    duration: float


@dataclass(frozen=True)
class SpeedTo:
    """Change to ``speed`` (m/s; backwards below zero), straight on, with at most ``acceleration`` (m/s2)."""

    speed: float
    acceleration: float = 2.0


@dataclass(frozen=True)
class Turn:
    """Turn by ``angle_deg`` (left positive) at the present speed with at most ``lateral_acceleration`` (m/s2)."""

    angle_deg: float
    lateral_acceleration: float = 2.0


@dataclass(frozen=True)
class TurnInPlace:
    """Turn by ``angle_deg`` (left positive) while standing, with at most ``yaw_rate_deg`` (deg/s)."""

    angle_deg: float
    yaw_rate_deg: float = 40.0


@dataclass(frozen=True)
class ClimbTo:
    """Bend the path to ``angle_deg`` above the horizon with at most ``normal_acceleration`` (m/s2)."""

    angle_deg: float
    normal_acceleration: float = 2.0


@dataclass(frozen=True)
class LiftOff:
    """Let the wings take over the weight."""


@dataclass(frozen=True)
class TouchDown:
    """Let the wheels take over the weight."""


Instruction = Hold | SpeedTo | Turn | TurnInPlace
FlightInstruction = Instruction | ClimbTo | LiftOff | TouchDown


class Profile:
    """What instructions mean: the rates of speed, heading, climb angle and the wings' share of the weight."""

    def __init__(self, instructions: Sequence[FlightInstruction], speed: float = 0.0) -> None:
        """Start at ``speed`` (m/s) on level ground. Raises ValueError for an instruction that cannot be followed."""
        self._times = [0.0]
        self._rates: dict[str, list[Array]] = {"speed": [], "yaw": [], "climb": [], "lift": []}
        self._speed = speed
        self._climb = 0.0
        for instruction in instructions:
            self._add(instruction)

    @property
    def breakpoints(self) -> Array:
        """Times (s) at which the fourth derivative of a quantity may jump; the last is the end."""
        return np.array(self._times)

    def rates(self, *quantities: str) -> PPoly:
        """Return the rates of ``quantities``: "speed" (m/s2), "yaw", "climb" (rad/s), "lift" (1/s)."""
        pieces = np.stack([self._rates[quantity] for quantity in quantities], axis=-1)
        return PPoly(pieces.transpose(1, 0, 2), self.breakpoints)

    def _add(self, instruction: FlightInstruction) -> None:
        if isinstance(instruction, Hold):
            if instruction.duration <= 0.0:
                raise ValueError(f"{instruction}: the duration must be positive")
            self._append(instruction.duration)
        elif isinstance(instruction, SpeedTo):
            if instruction.speed == self._speed:
                raise ValueError(f"{instruction}: the speed must differ from the present one")
            self._window("speed", instruction.speed - self._speed, instruction.acceleration)
            self._speed = instruction.speed
        elif isinstance(instruction, Turn):
            if self._speed == 0.0 or instruction.angle_deg == 0.0:
                raise ValueError(f"{instruction}: a car turns only while it moves, and by an angle other than zero")
            yaw_rate = instruction.lateral_acceleration / abs(self._speed)
            self._window("yaw", math.radians(instruction.angle_deg), yaw_rate)
        elif isinstance(instruction, TurnInPlace):
            if self._speed != 0.0 or instruction.angle_deg == 0.0:
                raise ValueError(f"{instruction}: only what stands turns in place, and by an angle other than zero")
            self._window("yaw", math.radians(instruction.angle_deg), math.radians(instruction.yaw_rate_deg))
        elif isinstance(instruction, ClimbTo):
            change = math.radians(instruction.angle_deg) - self._climb
            if self._speed <= 0.0 or change == 0.0:
                raise ValueError(f"{instruction}: only what moves climbs, and by an angle other than the present one")
            self._window("climb", change, instruction.normal_acceleration / self._speed)
            self._climb = math.radians(instruction.angle_deg)
        else:
            share = 1.0 if isinstance(instruction, LiftOff) else -1.0
            self._window("lift", share, 1.0 / LIFT_DURATION)

    def _window(self, quantity: str, change: float, limit: float) -> None:
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
                self._append(duration, **{quantity: shape})

    def _append(self, duration: float, **shapes: Array) -> None:
        self._times.append(self._times[-1] + duration)
        for quantity, pieces in self._rates.items():
            pieces.append(shapes.get(quantity, np.zeros(8)))


def stacked(*polynomials: PPoly) -> PPoly:
    """Return one polynomial that has all values of several; one evaluation is quicker than several."""
    order = max(len(polynomial.c) for polynomial in polynomials)
    padded = [np.pad(p.c, ((order - len(p.c), 0), (0, 0), (0, 0))) for p in polynomials]
    return PPoly(np.concatenate(padded, axis=-1), polynomials[0].x)
