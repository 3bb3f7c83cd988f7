"""The scenarios by name: what moves, how, and where it has no GNSS."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from eskf_ros.simulate.aeroplane import AeroplaneTrajectory
from eskf_ros.simulate.boat import BoatTrajectory
from eskf_ros.simulate.motion import Trajectory
from eskf_ros.simulate.multirotor import Land, Leg, MultirotorTrajectory, TakeOff
from eskf_ros.simulate.profile import (
    ClimbTo,
    FlightInstruction,
    Hold,
    Instruction,
    LiftOff,
    SpeedTo,
    TouchDown,
    Turn,
    TurnInPlace,
)
from eskf_ros.simulate.scenario_families import FAMILIES, driven
from eskf_ros.simulate.trajectory import SIDE_SLIP_PER_ACCELERATION
from eskf_ros.simulate.walk import WalkTrajectory


@dataclass(frozen=True)
class Scenario:
    """A motion and where it has no GNSS.

    ``move`` makes the motion from ``heading_deg``, the heading at the start, counter-clockwise from east (REP-103).
    ``outages`` are intervals (first, last) in seconds from time zero; no GNSS message has a stamp within one.
    """

    description: str
    move: Callable[[float], Trajectory]
    heading_deg: float
    outages: tuple[tuple[float, float], ...] = ()


_CITY_LAP: tuple[Instruction, ...] = (
    SpeedTo(13.5),
    Hold(12.0),
    SpeedTo(6.0),
    Turn(90.0, 2.5),
    SpeedTo(10.0, 1.5),
    Turn(25.0),
    Turn(-25.0),
    Hold(6.0),
    SpeedTo(0.0, 2.5),
    Hold(8.0),
    SpeedTo(6.0),
    Turn(90.0, 2.5),
    SpeedTo(14.0, 2.5),
    Hold(10.0),
    Turn(-15.0),
    Turn(15.0),
    SpeedTo(5.0),
    Turn(90.0, 2.0),
    SpeedTo(11.0),
    Hold(8.0),
    SpeedTo(5.5),
    Turn(90.0, 2.5),
    SpeedTo(0.0, 1.5),
    Hold(5.0),
)

TUNNEL_START = 162.0
PARKED = 147.0
"""Seconds from time zero."""

_TUNNEL: tuple[Instruction, ...] = (
    SpeedTo(15.0),
    Hold(15.0),
    Turn(40.0, 1.5),
    Hold(10.0),
    SpeedTo(9.0, 1.5),
    Turn(-70.0, 1.5),
    SpeedTo(0.0, 2.0),
    Hold(8.0),
    SpeedTo(4.0, 1.5),
    Hold(6.0),
    SpeedTo(16.0, 1.5),
    Hold(20.0),
    Turn(55.0, 1.5),
    Hold(25.0),
    SpeedTo(11.0, 1.0),
    Turn(-90.0, 1.5),
    Hold(20.0),
    SpeedTo(0.0, 1.5),
    Hold(20.0),
    SpeedTo(13.0, 1.5),
    Hold(30.0),
    Turn(-45.0, 1.5),
    Hold(20.0),
    SpeedTo(18.0, 1.0),
    Hold(30.0),
)

_ROWS: tuple[Instruction, ...] = (
    SpeedTo(0.8, 0.4),
    Hold(15.0),
    SpeedTo(0.0, 0.4),
    TurnInPlace(90.0),
    SpeedTo(0.5, 0.4),
    Hold(1.0),
    SpeedTo(0.0, 0.4),
    TurnInPlace(90.0),
    SpeedTo(1.0, 0.4),
    Hold(12.0),
    SpeedTo(0.0, 0.4),
    Hold(3.0),
    TurnInPlace(-90.0),
    SpeedTo(0.5, 0.4),
    Hold(1.0),
    SpeedTo(0.0, 0.4),
    TurnInPlace(-90.0, 25.0),
)

_WALK: tuple[Instruction, ...] = (
    Hold(15.0),
    SpeedTo(1.4, 0.8),
    Hold(25.0),
    Turn(90.0, 0.8),
    Hold(15.0),
    SpeedTo(0.0, 0.8),
    Hold(8.0),
    TurnInPlace(-60.0, 60.0),
    SpeedTo(1.1, 0.6),
    Hold(20.0),
    Turn(-100.0, 0.6),
    SpeedTo(1.8, 0.5),
    Hold(20.0),
    Turn(40.0, 0.8),
    SpeedTo(1.3, 0.5),
    Hold(20.0),
    SpeedTo(0.0, 0.8),
    Hold(10.0),
)

_FLIGHT = (
    Leg(20.0),
    TakeOff(8.0, (0.0, 0.0, 12.0)),
    Leg(15.0),
    Leg(12.0, (-20.0, 35.0, 0.0)),
    Leg(4.0),
    Leg(12.0, (45.0, 20.0, 8.0), turn_deg=60.0),
    Leg(6.0, turn_deg=-150.0),
    Leg(14.0, (10.0, -60.0, -5.0)),
    Leg(20.0),
    Leg(12.0, (-35.0, 5.0, 0.0), turn_deg=45.0),
    Land(14.0, (0.0, 0.0, -15.0)),
    Leg(10.0),
)

_LONG_FLIGHT = (*_FLIGHT[:2], *(_FLIGHT[2:10] * 3), *_FLIGHT[10:])

_CIRCUIT: tuple[FlightInstruction, ...] = (
    Hold(20.0),
    SpeedTo(30.0, 3.0),
    LiftOff(),
    ClimbTo(6.0),
    Hold(20.0),
    SpeedTo(45.0, 1.5),
    ClimbTo(0.0),
    Turn(-90.0, 3.0),
    Hold(15.0),
    Turn(-180.0, 3.5),
    Hold(25.0),
    Turn(270.0, 4.5),
    Turn(-90.0, 3.0),
    Hold(15.0),
    # The way up in reverse: the runway is as high as it was.
    ClimbTo(-6.0),
    SpeedTo(30.0, 1.5),
    Hold(20.0),
    ClimbTo(0.0),
    TouchDown(),
    SpeedTo(0.0, 3.0),
    Hold(10.0),
)

_CRUISE: tuple[Instruction, ...] = (
    Hold(40.0),
    SpeedTo(2.5, 0.3),
    Hold(60.0),
    Turn(-70.0, 0.15),
    Hold(50.0),
    SpeedTo(1.2, 0.2),
    Turn(160.0, 0.08),
    Hold(60.0),
    SpeedTo(0.0, 0.2),
    Hold(60.0),
)

SCENARIOS: dict[str, Scenario] = {
    "drive": Scenario(
        "five minutes in a city: two laps around blocks, with turns and stops",
        driven((Hold(20.0), *_CITY_LAP, *_CITY_LAP, Hold(5.0))),
        heading_deg=35.0,
    ),
    "tunnel_drive": Scenario(
        "stand still 20 s, drive with turns and stops, a tunnel of 45 s at speed, and on",
        driven(
            (
                Hold(20.0),
                SpeedTo(8.0),
                Turn(80.0, 2.5),
                SpeedTo(13.0),
                Hold(6.0),
                Turn(-60.0, 2.5),
                SpeedTo(0.0, 2.5),
                Hold(6.0),
                SpeedTo(7.0, 2.5),
                Turn(-95.0, 2.5),
                SpeedTo(12.0),
                Turn(30.0),
                Turn(-30.0),
                SpeedTo(0.0),
                Hold(4.0),
                SpeedTo(7.0),
                Turn(90.0, 2.5),
                SpeedTo(17.0),
                Hold(8.0),
                # The tunnel begins about here and bends to the left.
                Hold(15.0),
                Turn(35.0, 1.0),
                SpeedTo(15.0, 0.8),
                Hold(13.0),
                Turn(-20.0, 1.0),
                Hold(12.0),
                SpeedTo(7.0),
                Turn(90.0, 2.5),
                SpeedTo(11.0),
                Hold(8.0),
                Turn(-40.0),
                SpeedTo(0.0),
                Hold(8.0),
            )
        ),
        heading_deg=-20.0,
        outages=((125.0, 170.0),),
    ),
    "hour_drive": Scenario(
        "one hour of city laps, for measuring speed",
        driven((Hold(20.0), *(_CITY_LAP * 27), Hold(47.5))),
        heading_deg=35.0,
    ),
    "long_tunnel": Scenario(
        "a city lap, then five minutes in a tunnel with bends, slow traffic and stops, on tyres that slip sideways",
        driven((Hold(20.0), *_CITY_LAP, *_TUNNEL), side_slip=SIDE_SLIP_PER_ACCELERATION),
        heading_deg=-130.0,
        outages=((TUNNEL_START, TUNNEL_START + 300.0),),
    ),
    "garage": Scenario(
        "a city lap, then ten minutes parked in a garage",
        driven((Hold(20.0), *_CITY_LAP, Hold(600.0))),
        heading_deg=50.0,
        outages=((PARKED, PARKED + 600.0),),
    ),
    "reverse_start": Scenario(
        "a car backs out of its place before it drives",
        driven(
            (
                Hold(20.0),
                SpeedTo(-2.0, 1.0),
                Hold(3.0),
                Turn(70.0, 1.0),
                SpeedTo(0.0, 1.0),
                Hold(3.0),
                SpeedTo(6.0),
                Turn(-70.0, 2.5),
                *_CITY_LAP,
            )
        ),
        heading_deg=110.0,
    ),
    "parked": Scenario("a car stands for ten minutes", driven((Hold(600.0),)), heading_deg=-75.0),
    "motorway": Scenario(
        "five minutes straight on at 33 m/s: nothing to tell heading and biases apart",
        driven((Hold(300.0),), speed=33.0, hills=()),
        heading_deg=62.0,
    ),
    "field_robot": Scenario(
        "a slow robot on uneven ground: rows, with turns in place between them",
        driven((Hold(15.0), *(_ROWS * 4), Hold(10.0)), hills=((0.05, 9.0), (0.025, 2.6))),
        heading_deg=0.0,
    ),
    "walk": Scenario(
        "a person with the sensors in the hand: steps, turns, stops, never quite at rest",
        lambda heading_deg: WalkTrajectory(_WALK, heading_deg),
        heading_deg=80.0,
    ),
    "multirotor": Scenario(
        "take-off, hover, legs in all directions but forward, drifting in the wind, landing",
        lambda heading_deg: MultirotorTrajectory(_FLIGHT, heading_deg),
        heading_deg=25.0,
    ),
    "long_flight": Scenario(
        "the multirotor, five minutes of it",
        lambda heading_deg: MultirotorTrajectory(_LONG_FLIGHT, heading_deg),
        heading_deg=25.0,
    ),
    "aeroplane": Scenario(
        "take-off, climb, coordinated turns in wind, descent, landing",
        lambda heading_deg: AeroplaneTrajectory(_CIRCUIT, heading_deg),
        heading_deg=-100.0,
    ),
    "boat": Scenario(
        "a slow boat that rolls, pitches and heaves in waves and drifts with the current, never at rest",
        lambda heading_deg: BoatTrajectory(_CRUISE, heading_deg),
        heading_deg=150.0,
    ),
}


def scenario(name: str) -> Scenario:
    """Return the scenario ``name``, FAMILY:NUMBER for one of a family; ValueError names those there are."""
    if name in SCENARIOS:
        return SCENARIOS[name]
    kind, _, number = name.partition(":")
    if kind not in FAMILIES:
        families = (f"{family}:NUMBER" for family in FAMILIES)
        raise ValueError(f"unknown scenario '{name}'; there are {', '.join((*SCENARIOS, *families))}")
    family = FAMILIES[kind]
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ValueError(f"scenario '{name}' wants a positive number of {family.unit}, as in {kind}:2")
    return Scenario(f"{family.description}; {value:g} {family.unit}", family.move(value), family.heading_deg)


@lru_cache(maxsize=4)
def trajectory(name: str) -> Trajectory:
    """Return the motion of scenario ``name``; ValueError names those there are."""
    found = scenario(name)
    return found.move(found.heading_deg)
