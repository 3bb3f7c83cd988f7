"""What follows instructions and moves by formulas of its speed, heading and climb: velocity and pose as Taylor series.

Subclasses give the formulas; the position is the integral of the velocity, all else is exact differentiation.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PPoly

from eskf_ros.simulate.jets import Taylor, moving_body, sin
from eskf_ros.simulate.motion import Motion, checked_times
from eskf_ros.simulate.profile import FlightInstruction, Profile, stacked
from eskf_ros.simulate.quadrature import PositionIntegral

Array = NDArray[np.float64]

_QUANTITIES = ("speed", "yaw", "climb", "lift")


class PathState(NamedTuple):
    """Where something is on its path: time (s), distance (m), speed (m/s), yaw, climb angle (rad), share of lift."""

    time: Taylor
    distance: Taylor
    speed: Taylor
    yaw: Taylor
    climb: Taylor
    lift: Taylor


class Pose(NamedTuple):
    """Position in ``map`` (m) and the turns from its axes to those of the body, see `moving_body`."""

    position: Sequence[Taylor]
    turns: Sequence[tuple[str, Taylor]]


class PathTrajectory(ABC):
    """Something that follows instructions, starting at the origin of ``map``."""

    def __init__(self, instructions: Sequence[FlightInstruction], heading_deg: float = 0.0) -> None:
        """Start at rest with ``heading_deg``, counter-clockwise from east (REP-103).

        Raises ValueError for an instruction that cannot be followed.
        """
        profile = Profile(instructions)
        self._breakpoints = profile.breakpoints
        rates = profile.rates(*_QUANTITIES)
        states = rates.antiderivative()
        states.c[-1] += (0.0, math.radians(heading_deg), 0.0, 0.0)
        distance = PPoly(states.c[..., :1], self._breakpoints).antiderivative()
        self._values = stacked(distance, states)
        self._derivatives = stacked(distance, states, rates, rates.derivative(), rates.derivative(2))
        self._integral = PositionIntegral(self._velocity_values, self._breakpoints)

    @property
    def duration(self) -> float:
        """Its length in seconds."""
        return float(self._breakpoints[-1])

    @property
    def breakpoints(self) -> Array:
        """Times (s) from 0 to the end between which all quantities are smooth."""
        return self._breakpoints

    def motion(self, times: ArrayLike) -> Motion:
        """Return the truth at ``times`` (n,) in seconds from the start; ValueError outside of the trajectory."""
        t = checked_times(times, self.duration)
        state = _state(t, self._derivatives(t).T)
        velocity = self.velocity(state)
        way = [rate.integral(value) for rate, value in zip(velocity, self._integral(t).T, strict=True)]
        return moving_body(*self.pose(state, way))

    @abstractmethod
    def velocity(self, state: PathState) -> Sequence[Taylor]:
        """Return the velocity in ``map`` (m/s) whose integral is the way."""

    @abstractmethod
    def pose(self, state: PathState, way: Sequence[Taylor]) -> Pose:
        """Return the pose of base_link; ``way`` is the integral of `velocity` (m)."""

    def _velocity_values(self, times: Array) -> list[Array]:
        t = times.ravel()
        return [rate.c[0].reshape(times.shape) for rate in self.velocity(_state(t, self._values(t).T))]


def _state(t: Array, values: Array) -> PathState:
    """Return the state at times ``t`` (n,); ``values``: distance, then the quantities, their first derivatives, ..."""
    distance, derivatives = values[0], values[1:].reshape(-1, len(_QUANTITIES), len(t))
    quantities = [Taylor.of_derivatives(derivatives[:, number]) for number in range(len(_QUANTITIES))]
    time = np.zeros((len(derivatives) + 1, len(t)))
    time[:2] = t, np.ones_like(t)
    return PathState(Taylor(time), quantities[0].integral(distance), *quantities)


def waves(time: Taylor, components: Sequence[tuple[float, float, float]]) -> Taylor:
    """Return a sum of sines of ``time``: (amplitude, frequency in Hz, phase in rad) of each."""
    total = 0.0 * time
    for amplitude, frequency, phase in components:
        total = total + amplitude * sin(2.0 * math.pi * frequency * time + phase)
    return total
