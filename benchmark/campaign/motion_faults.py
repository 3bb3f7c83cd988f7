"""Motions in which little tells where a robot points, or whether it rests: nothing is broken."""

from __future__ import annotations

import math
from dataclasses import replace

from campaign.fault import DEFAULT_VELOCITY, MOVING, TOLD_VELOCITY, Fault, Kind
from campaign.imu_faults import ROUGH
from eskf_ros.simulate.dual_antenna import DualAntenna
from eskf_ros.simulate.gnss_episodes import RtkSolution

WITH_VELOCITY = (TOLD_VELOCITY, DEFAULT_VELOCITY)
RTK = RtkSolution(0.0, math.inf)

MANY_SEEDS = 50
"""Runs over which the heading is judged where nothing tells it."""


def _motion(name: str, move: str, stop: float, **more: object) -> Fault:
    usual: dict[str, object] = {"begin": MOVING, "scenario": move, "stop": stop, "filters": WITH_VELOCITY}
    return Fault(name, Kind.MOTION, **{**usual, **more})  # type: ignore[arg-type]


def _honestly_given(fault: Fault, std_deg: float) -> Fault:
    """The same motion with a heading at the start that is as good as it is said to be."""
    return replace(fault, given_heading_std_deg=std_deg, is_steady=True, seeds=MANY_SEEDS)


def motion_faults() -> list[Fault]:
    """Return the motions."""
    slow = {"begin": 0.0, "is_slow": True}
    return [
        _honestly_given(_motion("parked 30 min", "stand:1800", 1800.0, begin=0.0, is_at_rest=True), 10.0),
        _honestly_given(_motion("motorway 10 min, straight", "straight:33", 600.0, begin=0.0), 5.0),
        _motion(
            "motorway, heading given 25 deg off as 5",
            "straight:33",
            300.0,
            begin=0.0,
            given_heading_std_deg=5.0,
            given_heading_off_deg=25.0,
            also=("given heading",),
        ),
        *(
            _honestly_given(
                _motion(
                    f"creep of {speed:g} m/s, fixes at {rate:g} Hz",
                    f"creep:{speed:g}",
                    260.0,
                    options={"gnss_rate": rate},
                ),
                5.0,
            )
            for speed, rate in ((0.1, 5.0), (0.4, 5.0), (1.0, 5.0), (1.0, 1.0))
        ),
        *(
            _motion(
                f"turn of {rate:g} deg/s, dual antenna",
                f"slow_turn:{rate:g}",
                230.0,
                options={"dual_antenna": DualAntenna()},
            )
            for rate in (0.2, 0.5, 1.0, 2.0)
        ),
        _motion(
            "turn in place, RTK antenna 0.3 m off",
            "turn_in_place:20",
            90.0,
            options={"lever_arm": (0.3, 0.0, 1.0)},
            episodes=(RTK,),
            **slow,
        ),
        _motion("boat in waves", "boat", 350.0, is_steady=True, seeds=MANY_SEEDS),
        _motion("boat that crabs 40 deg", "crab:40", 260.0, also=("IMU mounting",)),
        _motion(
            "boat that crabs 40 deg, told to use its course",
            "crab:40",
            260.0,
            parameters={"alignment.use_course": True},
            also=("course", "IMU mounting"),
        ),
        _motion("skid-steer", "skid_steer:0.8", 240.0, is_slow=True),
        _motion("mower rows, RTK", "field_robot", 286.0, episodes=(RTK,), is_slow=True),
        _motion(
            "tractor 0.5 m/s, RTK at 1 Hz", "tractor:0.5", 175.0, options={"gnss_rate": 1.0}, episodes=(RTK,), **slow
        ),
        _motion("multirotor", "long_flight", 330.0),
        *(_motion(f"start at {speed:g} m/s", f"fast_start:{speed:g}", 170.0, **slow) for speed in (60.0, 120.0, 250.0)),
        _motion("train, 30 m/s", "train:30", 370.0),
        _motion("train, rough line", "train:30", 370.0, options=ROUGH),
    ]
