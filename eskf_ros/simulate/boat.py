"""A small boat in waves and in a current."""

from __future__ import annotations

import math
from collections.abc import Sequence

from eskf_ros.simulate.jets import Taylor, sin_cos
from eskf_ros.simulate.path import PathState, PathTrajectory, Pose, waves
from eskf_ros.simulate.profile import Instruction

CURRENT = (0.35, -0.25)
"""Velocity of the water, east and north, m/s, unless it is told."""

_HEAVE = ((0.25, 0.16, 0.0), (0.12, 0.27, 1.3))
_SURGE = ((0.15, 0.16, 1.6), (0.06, 0.27, 2.9))
_SWAY = ((0.12, 0.14, 0.4), (0.05, 0.24, 2.0))
_ROLL = ((math.radians(6.0), 0.19, 0.2), (math.radians(2.5), 0.31, 1.0))
_PITCH = ((math.radians(2.5), 0.16, 0.9), (math.radians(1.0), 0.29, 0.1))
_YAW = ((math.radians(2.0), 0.11, 0.0),)
"""Motion in the waves, m and rad; see `waves`."""


class BoatTrajectory(PathTrajectory):
    """A boat that heads through the water as it is told and drifts with the current; it never is at rest."""

    def __init__(
        self,
        instructions: Sequence[Instruction],
        heading_deg: float = 0.0,
        current: tuple[float, float] = CURRENT,
    ) -> None:
        """Start with ``heading_deg``, counter-clockwise from east; ``current``: of the water, east and north, m/s."""
        self._current = current
        super().__init__(instructions, heading_deg)

    def velocity(self, state: PathState) -> Sequence[Taylor]:
        """Return the velocity over ground without the waves."""
        sine, cosine = sin_cos(state.yaw)
        return state.speed * cosine + self._current[0], state.speed * sine + self._current[1], 0.0 * state.speed

    def pose(self, state: PathState, way: Sequence[Taylor]) -> Pose:
        """Return the pose in the waves."""
        sine, cosine = sin_cos(state.yaw)
        surge, sway = waves(state.time, _SURGE), waves(state.time, _SWAY)
        position = (
            way[0] + cosine * surge - sine * sway,
            way[1] + sine * surge + cosine * sway,
            way[2] + waves(state.time, _HEAVE),
        )
        turns = (
            ("z", state.yaw + waves(state.time, _YAW)),
            ("y", waves(state.time, _PITCH)),
            ("x", waves(state.time, _ROLL)),
        )
        return Pose(position, turns)
