"""Scenarios with a number in their name, ``creep:0.4``: slow, fast, steady and sideways motions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from eskf_ros.simulate.boat import BoatTrajectory
from eskf_ros.simulate.motion import Trajectory
from eskf_ros.simulate.profile import Hold, Instruction, SpeedTo, Turn, TurnInPlace
from eskf_ros.simulate.trajectory import DriveTrajectory

STANDS = 20.0
"""s for which what begins at rest stands."""

UNEVEN = ((0.05, 9.0), (0.025, 2.6))
"""Slope of a field over the distance driven: a sum of sines, each (amplitude in rad, wave length in m)."""

Move = Callable[[float], Trajectory]
"""A motion from a heading at the start, degrees counter-clockwise from east (REP-103)."""


@dataclass(frozen=True)
class Family:
    """Scenarios that differ by one number; ``unit`` says which, ``move`` makes the motion of one."""

    description: str
    unit: str
    move: Callable[[float], Move]
    heading_deg: float


def driven(instructions: Sequence[Instruction], **options: Any) -> Move:
    """Return the motion of a vehicle that follows instructions; options of `DriveTrajectory`."""
    return lambda heading_deg: DriveTrajectory(instructions, heading_deg, **options)


def _creep(speed: float) -> Move:
    return driven((Hold(STANDS), SpeedTo(speed, 0.1), Hold(240.0)), hills=())


def _slow_turn(rate_deg: float) -> Move:
    return driven((Hold(STANDS), TurnInPlace(200.0 * rate_deg, rate_deg), Hold(10.0)), hills=())


def _turn_in_place(rate_deg: float) -> Move:
    return driven((Hold(STANDS), TurnInPlace(60.0 * rate_deg, rate_deg), Hold(10.0)), hills=())


def _fast_start(speed: float) -> Move:
    # Bends of 2 m/s2, and as much along the path: what an airliner does.
    legs = (Hold(20.0), Turn(20.0), Hold(15.0), SpeedTo(0.9 * speed, 1.5), Turn(-40.0), Hold(20.0), SpeedTo(speed, 1.5))
    return driven((*legs, *legs[1:]), speed=speed, hills=())


def _tractor(speed: float) -> Move:
    row = (Hold(60.0), Turn(180.0, 0.1), Hold(60.0), Turn(-180.0, 0.1))
    return driven((Hold(STANDS), SpeedTo(speed, 0.2), *row), hills=UNEVEN)


def _skid_steer(speed: float) -> Move:
    lap = (
        SpeedTo(speed, 0.4),
        Hold(12.0),
        Turn(90.0, 0.4),
        Hold(6.0),
        SpeedTo(0.0, 0.4),
        TurnInPlace(120.0, 30.0),
        SpeedTo(speed, 0.4),
        Turn(-60.0, 0.4),
        Hold(8.0),
        SpeedTo(0.0, 0.4),
        TurnInPlace(-90.0, 30.0),
    )
    # Wheels that do not steer are dragged sideways: 8 deg at 0.4 m/s2.
    return driven((Hold(STANDS), *(lap * 4)), hills=UNEVEN, side_slip=math.radians(20.0))


def _train(speed: float) -> Move:
    line = (Turn(35.0, 0.4), Hold(40.0), Turn(-20.0, 0.3), Hold(40.0))
    return driven((Hold(STANDS), SpeedTo(speed, 0.4), Hold(30.0), *line, SpeedTo(0.0, 0.5), Hold(20.0)), hills=())


def _crab(angle_deg: float) -> Move:
    speed = 2.0
    across = speed * math.tan(math.radians(angle_deg))
    instructions = (Hold(20.0), SpeedTo(speed, 0.2), Hold(110.0), Turn(-25.0, 0.1), Hold(110.0))

    def move(heading_deg: float) -> Trajectory:
        left = math.radians(heading_deg + 90.0)
        return BoatTrajectory(instructions, heading_deg, (across * math.cos(left), across * math.sin(left)))

    return move


FAMILIES: dict[str, Family] = {
    "stand": Family("a car stands", "s", lambda seconds: driven((Hold(seconds),)), -75.0),
    "straight": Family(
        "a car that goes straight on for ten minutes",
        "m/s",
        lambda speed: driven((Hold(600.0),), speed=speed, hills=()),
        62.0,
    ),
    "creep": Family("starts gently and goes on straight and smoothly for four minutes", "m/s", _creep, 20.0),
    "slow_turn": Family("turns in place for 200 s", "deg/s", _slow_turn, 10.0),
    "turn_in_place": Family("turns in place for a minute", "deg/s", _turn_in_place, 10.0),
    "fast_start": Family("begins in full motion, with bends and changes of speed", "m/s", _fast_start, -40.0),
    "tractor": Family("rows on a field, with turns while it moves", "m/s", _tractor, 75.0),
    "skid_steer": Family(
        "a robot whose wheels do not steer: turns in place, slips in bends", "m/s", _skid_steer, -20.0
    ),
    "train": Family("a train: long bends, little acceleration, no shocks", "m/s", _train, 130.0),
    "crab": Family("a boat in a current from the side: the angle from heading to course", "deg", _crab, 15.0),
}
