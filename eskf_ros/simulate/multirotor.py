"""A multirotor: legs between points, flown in any direction whatever the heading, in wind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PPoly

from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.simulate.jets import Taylor, arctan2, moving_body, sin_cos, sqrt
from eskf_ros.simulate.motion import Motion, Vector, checked_times
from eskf_ros.simulate.path import waves

Array = NDArray[np.float64]

WIND = (4.0, -2.5)
"""Mean velocity of the air, east and north, m/s."""

DRAG = 0.25
"""Deceleration by the air per velocity through it, 1/s."""

_GUSTS = ((0.8, 1.0 / 9.0, 0.0), (0.4, 1.0 / 3.7, 1.0))
_DRIFT_EAST = ((0.7, 1.0 / 17.0, 0.0), (0.15, 1.0 / 5.3, 0.5))
_DRIFT_NORTH = ((0.5, 1.0 / 13.0, 1.2), (0.12, 1.0 / 4.1, 0.0))
_DRIFT_UP = ((0.25, 1.0 / 15.0, 0.4),)
"""What the wind does: change of its velocity (m/s), and how far it carries the craft off (m); see `waves`."""

_STEP_ORDER = 4


def _step() -> Array:
    """Return the coefficients, highest power first, of the step from 0 to 1 on [0, 1] that is as smooth at both ends.

    Its first `_STEP_ORDER` derivatives vanish there: a hovering craft tilts and turns without a jerk.
    """
    n = _STEP_ORDER
    powers = np.zeros(2 * n + 2)
    for k in range(n + 1):
        powers[n + 1 + k] = math.comb(n + k, k) * math.comb(2 * n + 1, n - k) * (-1) ** k
    return powers[::-1]


@dataclass(frozen=True)
class Leg:
    """Move by ``way`` (m; east, north, up) and turn by ``turn_deg`` (left positive) in ``duration`` seconds."""

    duration: float
    way: Vector = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0


@dataclass(frozen=True)
class TakeOff(Leg):
    """A leg that begins on the ground and ends in the air."""


@dataclass(frozen=True)
class Land(Leg):
    """A leg that begins in the air and ends on the ground."""


class MultirotorTrajectory:
    """A multirotor that starts at the origin of ``map``.

    Its thrust points along the body's z axis. So it leans against the wind when it hovers, and into its accelerations;
    its heading is free. On the ground it stands level.
    """

    def __init__(self, legs: Sequence[Leg], heading_deg: float = 0.0) -> None:
        """Start with ``heading_deg``, counter-clockwise from east (REP-103). ValueError for a leg without duration."""
        times = [0.0]
        # East, north, up, yaw, share of flight.
        before = np.array([0.0, 0.0, 0.0, math.radians(heading_deg), 0.0])
        pieces = []
        for leg in legs:
            if leg.duration <= 0.0:
                raise ValueError(f"{leg}: the duration must be positive")
            flight = float(isinstance(leg, TakeOff)) - float(isinstance(leg, Land))
            change = np.array([*leg.way, math.radians(leg.turn_deg), flight])
            shape = _step() / leg.duration ** np.arange(2 * _STEP_ORDER + 1, -1, -1)
            piece = shape[:, None] * change
            piece[-1] += before
            pieces.append(piece)
            before = before + change
            times.append(times[-1] + leg.duration)
        self._breakpoints = np.array(times)
        self._profile = PPoly(np.stack(pieces, axis=1), self._breakpoints)

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
        # Attitude takes two derivatives of position, its acceleration another two.
        derivatives = np.stack([self._profile(t, order).T for order in range(5)])
        east, north, up, yaw, flight = (Taylor.of_derivatives(derivatives[:, number]) for number in range(5))
        time = Taylor.of_derivatives([t, np.ones_like(t), *np.zeros((3, len(t)))])
        position = (
            east + flight * waves(time, _DRIFT_EAST),
            north + flight * waves(time, _DRIFT_NORTH),
            up + flight * waves(time, _DRIFT_UP),
        )
        velocity = [coordinate.derivative() for coordinate in position]
        gust = waves(time, _GUSTS)
        # What the rotors push with: all acceleration, the weight, and the drag of the air that passes.
        thrust_east = velocity[0].derivative() + flight * DRAG * (velocity[0] - gust - WIND[0])
        thrust_north = velocity[1].derivative() + flight * DRAG * (velocity[1] - gust - WIND[1])
        thrust_up = velocity[2].derivative() + STANDARD_GRAVITY
        sine, cosine = sin_cos(yaw)
        forward = cosine * thrust_east + sine * thrust_north
        left = cosine * thrust_north - sine * thrust_east
        pitch = arctan2(forward, thrust_up)
        roll = arctan2(-left, sqrt(forward * forward + thrust_up * thrust_up))
        return moving_body(position, (("z", yaw), ("y", pitch), ("x", roll)))
