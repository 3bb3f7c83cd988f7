"""A person who walks and holds the sensors in the hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

from eskf_ros.simulate.jets import Taylor, sin, sin_cos
from eskf_ros.simulate.path import PathState, PathTrajectory, Pose, waves

STRIDE = 1.4
"""Metres of a stride, which is two steps."""

_BOB, _SWAY, _SURGE = 0.022, 0.02, 0.012
_ROLL, _PITCH, _YAW = (math.radians(angle) for angle in (3.0, 2.0, 4.0))
"""Amplitudes of the gait, m and rad."""

_HELD_PITCH = math.radians(20.0)
"""How far the hand holds the nose down."""

_WANDER = ((math.radians(9.0), 1.0 / 37.0, 0.0), (math.radians(5.0), 1.0 / 13.0, 0.0))
_TREMBLE = ((0.004, 0.31, 0.3), (0.002, 0.83, 1.1))
_TILT = ((math.radians(0.8), 0.23, 0.7), (math.radians(0.3), 0.71, 0.0))
"""What the hand does all the time, standing too: turn from the way walked, move and tilt; see `waves`."""


class WalkTrajectory(PathTrajectory):
    """A walk on level ground. The hand bobs twice a stride, sways and rolls once; it never is quite at rest."""

    def velocity(self, state: PathState) -> Sequence[Taylor]:
        """Return the velocity of the person."""
        sine, cosine = sin_cos(state.yaw)
        return state.speed * cosine, state.speed * sine, 0.0 * state.speed

    def pose(self, state: PathState, way: Sequence[Taylor]) -> Pose:
        """Return the pose of the hand."""
        # The phase is that of the distance: steps are as long when slow, and end where the person stops.
        stride = 2.0 * math.pi / STRIDE * state.distance
        once = sin(stride)
        twice, bob = sin_cos(2.0 * stride)
        tremble = waves(state.time, _TREMBLE)
        forward = _SURGE * twice + tremble
        left = _SWAY * once - tremble
        up = _BOB * bob + tremble
        sine, cosine = sin_cos(state.yaw)
        position = (
            way[0] + cosine * forward - sine * left,
            way[1] + sine * forward + cosine * left,
            way[2] + up,
        )
        tilt = waves(state.time, _TILT)
        return Pose(
            position,
            (
                ("z", state.yaw + waves(state.time, _WANDER) + _YAW * once),
                ("y", _PITCH * twice + tilt + _HELD_PITCH),
                ("x", _ROLL * once - tilt),
            ),
        )
