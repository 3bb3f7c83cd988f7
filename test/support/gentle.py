"""Motions that are as smooth as rest, or too slow to tell a heading: creep, slow turns, tractors, a boat that crabs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.simulate.aeroplane import AeroplaneTrajectory
from eskf_ros.simulate.boat import BoatTrajectory
from eskf_ros.simulate.jets import Taylor, sin_cos
from eskf_ros.simulate.motion import Trajectory
from eskf_ros.simulate.path import PathState
from eskf_ros.simulate.profile import Hold, Instruction, LiftOff, SpeedTo, Turn, TurnInPlace
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import SCENARIOS, Scenario, simulate
from eskf_ros.simulate.trajectory import DriveTrajectory

Array = NDArray[np.float64]
Move = Callable[[float], Trajectory]


def recorded(name: str, move: Move, seed: int, heading_deg: float = 35.0, **options: Any) -> Recording:
    """Simulate a motion that is no scenario of the package; ``name`` is what its truth is kept under."""
    SCENARIOS[name] = Scenario(name, move, heading_deg)
    try:
        return simulate(name, seed, **options)
    finally:
        del SCENARIOS[name]


def drive(instructions: Sequence[Instruction], **options: Any) -> Move:
    """A vehicle on a floor, unless ``hills`` are given."""
    given = {"hills": (), **options}
    return lambda heading_deg: DriveTrajectory(instructions, heading_deg, **given)


def creep(speed: float, rest: float = 30.0, seconds: float = 120.0) -> Move:
    """Stand, creep straight on, stand."""
    return drive((Hold(rest), SpeedTo(speed), Hold(seconds), SpeedTo(0.0), Hold(20.0)))


def slow_turn(rate_deg: float, rest: float = 30.0, seconds: float = 120.0) -> Move:
    """Stand, turn in place, stand; without ``rest`` it turns from the beginning."""
    turn = TurnInPlace(rate_deg * seconds, rate_deg)
    return drive((Hold(rest), turn, Hold(20.0)) if rest else (turn, Hold(20.0)))


TRAIN = drive(
    (
        Hold(30.0),
        SpeedTo(25.0, 0.4),
        Hold(60.0),
        Turn(40.0, 0.3),
        Hold(60.0),
        SpeedTo(0.5, 0.3),
        Hold(60.0),
        SpeedTo(0.0, 0.1),
        Hold(30.0),
    )
)
"""Stands, runs through a long curve, creeps into a station."""

TRACTOR = drive(
    (Hold(20.0), *((SpeedTo(0.5, 0.3), Hold(60.0), Turn(90.0, 0.15), Hold(10.0), Turn(90.0, 0.15), Hold(40.0))))
)
"""Half a metre per second along a furrow, and back."""

MOWER = drive(
    (
        Hold(20.0),
        SpeedTo(0.3, 0.3),
        Hold(25.0),
        SpeedTo(0.0, 0.3),
        TurnInPlace(90.0, 30.0),
        SpeedTo(0.3, 0.3),
        Hold(20.0),
        SpeedTo(0.0, 0.3),
        TurnInPlace(90.0, 30.0),
        SpeedTo(0.3, 0.3),
        Hold(25.0),
    ),
    hills=((0.03, 9.0), (0.015, 2.6)),
)
"""A lawn, slightly uneven."""

TURNING = drive((Hold(20.0), TurnInPlace(360.0, 6.0), Hold(20.0)))
"""A turn in place within a minute."""

STREAM = (-0.9, 1.9)
"""Velocity of the water, east and north, m/s: across a boat of 2.5 m/s that heads 25 degrees north of east."""


class CrabbingBoat(BoatTrajectory):
    """A boat in a current that sets it off by 40 degrees from where it heads."""

    def velocity(self, state: PathState) -> Sequence[Taylor]:
        """Return the velocity over ground without the waves."""
        sine, cosine = sin_cos(state.yaw)
        return state.speed * cosine + STREAM[0], state.speed * sine + STREAM[1], 0.0 * state.speed


def crabbing_boat(heading_deg: float) -> Trajectory:
    """Moored in the stream's way it never is at rest: it drifts, then crosses."""
    return CrabbingBoat(
        (
            Hold(20.0),
            SpeedTo(2.5, 0.3),
            Hold(60.0),
            Turn(-30.0, 0.15),
            Hold(60.0),
            Turn(30.0, 0.15),
            SpeedTo(1.5, 0.2),
            Hold(60.0),
        ),
        heading_deg,
    )


def flight(speed: float) -> Move:
    """An aeroplane that is in level flight at ``speed`` (m/s) before it turns."""
    instructions = (
        Hold(5.0),
        SpeedTo(speed, 8.0),
        LiftOff(),
        Hold(20.0),
        Turn(-90.0, 4.0),
        Hold(15.0),
        Turn(120.0, 5.0),
        Hold(60.0),
    )
    return lambda heading_deg: AeroplaneTrajectory(instructions, heading_deg)


def false_rest(recording: Recording, records: NDArray[Any], speed: float = 0.03, rate_deg: float = 0.05) -> int:
    """Count the zero velocities fused above ``speed`` (m/s), and zero rates fused above ``rate_deg`` (deg/s)."""
    moving = np.linalg.norm(recording.truth_velocity_map, axis=1)
    turning = np.degrees(np.linalg.norm(recording.truth_angular_rate_body, axis=1))
    count = 0
    for stream, value, limit in ((Stream.ZUPT, moving, speed), (Stream.ZARU, turning, rate_deg)):
        fused = records[(records["stream"] == stream) & (records["verdict"] == Verdict.FUSED)]
        count += int(np.count_nonzero(np.interp(fused["stamp"], recording.truth_stamp, value) > limit))
    return count


def true_rest(recording: Recording, records: NDArray[Any], since: float = 0.0, until: float = math.inf) -> float:
    """Share of the seconds at rest in which a zero velocity was fused, from ``since`` to ``until`` (s)."""
    seconds = (recording.truth_stamp - recording.imu_stamp[0]) * 1e-9
    still = np.linalg.norm(recording.truth_velocity_map, axis=1) < 1e-3
    still &= np.linalg.norm(recording.truth_angular_rate_body, axis=1) < 1e-4
    still &= (seconds >= since) & (seconds < until)
    length = np.count_nonzero(still) * float(np.median(np.diff(seconds)))
    fused = records[(records["stream"] == Stream.ZUPT) & (records["verdict"] == Verdict.FUSED)]
    at_rest = np.interp(fused["stamp"], recording.truth_stamp, still.astype(float)) > 0.5
    return float(np.count_nonzero(at_rest)) / max(length, 1.0)
