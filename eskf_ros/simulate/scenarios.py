"""The scenarios by name: what moves, how, and where it has no GNSS."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from eskf_ros.simulate.trajectory import DriveTrajectory, Hold, Instruction, SpeedTo, Turn


@dataclass(frozen=True)
class Scenario:
    """A drive and where it has no GNSS.

    ``outages`` are intervals (first, last) in seconds from time zero; no GNSS message has a stamp within one.
    """

    description: str
    instructions: tuple[Instruction, ...]
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

SCENARIOS: dict[str, Scenario] = {
    "drive": Scenario(
        "five minutes in a city: two laps around blocks, with turns and stops",
        (Hold(20.0), *_CITY_LAP, *_CITY_LAP, Hold(5.0)),
        heading_deg=35.0,
    ),
    "tunnel_drive": Scenario(
        "stand still 20 s, drive with turns and stops, a tunnel of 45 s at speed, and on",
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
        ),
        heading_deg=-20.0,
        outages=((125.0, 170.0),),
    ),
    "hour_drive": Scenario(
        "one hour of city laps, for measuring speed",
        (Hold(20.0), *(_CITY_LAP * 27), Hold(47.5)),
        heading_deg=35.0,
    ),
}


def scenario(name: str) -> Scenario:
    """Return the scenario ``name``; ValueError names those there are."""
    if name not in SCENARIOS:
        raise ValueError(f"unknown scenario '{name}'; there are {', '.join(SCENARIOS)}")
    return SCENARIOS[name]


@lru_cache(maxsize=4)
def trajectory(name: str) -> DriveTrajectory:
    """Return the motion of scenario ``name``; ValueError names those there are."""
    found = scenario(name)
    return DriveTrajectory(found.instructions, found.heading_deg)
