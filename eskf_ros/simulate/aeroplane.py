"""A small aeroplane: take-off, coordinated turns, climb, landing, in wind."""

from __future__ import annotations

from collections.abc import Sequence

from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.simulate.jets import Taylor, arctan2, sin_cos
from eskf_ros.simulate.path import PathState, PathTrajectory, Pose

WIND = (4.0, 3.0)
"""Velocity of the air, east and north, m/s."""

_ANGLE_OF_ATTACK = 0.06 * 45.0**2
"""Angle of attack times the square of the speed, rad m2/s2: 3.4 deg at 45 m/s."""


class AeroplaneTrajectory(PathTrajectory):
    """An aeroplane that banks as far as its turns need: nobody aboard is pushed sideways.

    Speed, heading and climb are those through the air. Between `LiftOff` and `TouchDown` the wind carries it along, so
    that its course is not its heading.
    """

    def velocity(self, state: PathState) -> Sequence[Taylor]:
        """Return the velocity over ground."""
        sin_yaw, cos_yaw = sin_cos(state.yaw)
        sin_climb, cos_climb = sin_cos(state.climb)
        level = state.speed * cos_climb
        return (
            level * cos_yaw + WIND[0] * state.lift,
            level * sin_yaw + WIND[1] * state.lift,
            state.speed * sin_climb,
        )

    def pose(self, state: PathState, way: Sequence[Taylor]) -> Pose:
        """Return the pose; way, bank about it, angle of attack."""
        east, north, up = (part.derivative().derivative() for part in way)
        up = up + STANDARD_GRAVITY
        sin_yaw, cos_yaw = sin_cos(state.yaw)
        sin_climb, cos_climb = sin_cos(state.climb)
        # Specific force to the left of the way and at right angles to both: all of it is to go through the floor.
        left = cos_yaw * north - sin_yaw * east
        normal = cos_climb * up - sin_climb * (cos_yaw * east + sin_yaw * north)
        bank = arctan2(-left, normal)
        # On the ground lift is zero whatever the speed; the 1 only keeps a standing aeroplane from dividing by zero.
        attack = _ANGLE_OF_ATTACK * state.lift / (state.speed * state.speed + 1.0)
        # REP-103: pitch is positive nose down.
        return Pose(way, (("z", state.yaw), ("y", -state.climb), ("x", bank), ("y", -attack)))
