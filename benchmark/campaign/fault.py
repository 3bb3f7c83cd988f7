"""What a fault is: episodes of the simulation, wrong parameters, and what ought to be said about it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from eskf_ros.simulate.episodes import Episode

BEGIN, END, STOP = 100.0, 140.0, 286.0
"""s; where a fault begins, where one that ends does, and where a drive is cut."""

MOVING = 20.0
"""s; where the scenarios begin to move. What is wrong throughout is judged as if it began here."""

RATE = 100.0
"""Hz of the IMU."""

Interval = tuple[float, float]


class Kind(Enum):
    """What is at fault; it decides which bars a row is held against."""

    CLEAN = "nothing"
    IMU = "IMU"
    SETTINGS = "mounting and settings"
    RECEIVER = "receiver"
    MOTION = "motion"


@dataclass(frozen=True)
class Filter:
    """What the filter is given: the noise of the IMU (told) or the defaults, velocities beside the positions or not."""

    is_told: bool
    has_velocity: bool

    def __str__(self) -> str:
        """As it stands in the table."""
        return ("told" if self.is_told else "default") + (", velocity" if self.has_velocity else ", position only")


TOLD_VELOCITY, TOLD_POSITION = Filter(True, True), Filter(True, False)
DEFAULT_VELOCITY, DEFAULT_POSITION = Filter(False, True), Filter(False, False)
ALL_FILTERS = (TOLD_VELOCITY, TOLD_POSITION, DEFAULT_VELOCITY, DEFAULT_POSITION)
WITH_VELOCITY = (TOLD_VELOCITY, DEFAULT_VELOCITY)


@dataclass(frozen=True)
class Fault:
    """One kind of fault.

    ``episodes``: what the simulation does. ``parameters``: what the filter is told beside the truth about the sensors;
    three numbers are added to the true ones. ``options``: of the simulation.

    ``begin``, ``end`` (s): when it begins, and when it ends if it does. ``unusable``: intervals (s) in which the
    fixes are wrong and nothing else tells where the robot is. ``settles`` (s): from when on after the beginning a lie
    is counted.

    ``names``: the causes (`campaign.causes`) of which one must be named; none: nothing needs to be said. ``also``:
    causes that are true, too. ``is_judged_by_name_alone``: the estimate cannot be right.
    """

    name: str
    kind: Kind
    episodes: tuple[Episode, ...] = ()
    parameters: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    begin: float = BEGIN
    end: float = math.inf
    unusable: tuple[Interval, ...] = ()
    settles: float = 60.0
    names: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    is_judged_by_name_alone: bool = False
    scenario: str = "drive"
    stop: float = STOP
    filters: tuple[Filter, ...] = ALL_FILTERS
    vehicles: tuple[str, ...] = ()
    """Scenarios on which the fault is tried, too."""
    seeds: int = 0
    """Runs, at least; 0 takes as many as of the others."""
    given_heading_std_deg: float = 0.0
    """Standard deviation of the heading at the start that the filter is given; 0: it is given none."""
    given_heading_off_deg: float | None = None
    """How far that heading is off; None: by quantiles in turn, as far as the standard deviation says."""
    is_version: bool = False
    """It is a fault of the city drives, on another vehicle."""
    is_steady: bool = False
    """Nothing tells the heading: its error must stay within what is claimed, on the mean over the runs."""
    is_slow: bool = False
    """The heading must be known, and right, a minute after the robot has begun to move."""
    is_at_rest: bool = False
    """Rest must be seen."""

    def on(self, vehicle: str) -> Fault:
        """The same fault of another vehicle, with the usual filter alone."""
        return replace(
            self,
            name=f"{self.name}: {vehicle}",
            scenario=vehicle,
            filters=(DEFAULT_VELOCITY,),
            vehicles=(),
            is_version=True,
        )


VEHICLES = ("field_robot", "boat", "long_flight")
"""Scenarios beside the city drive."""


def with_vehicles(faults: Sequence[Fault]) -> list[Fault]:
    """Return faults, each followed by itself on the other vehicles that it names."""
    return [version for fault in faults for version in (fault, *(fault.on(vehicle) for vehicle in fault.vehicles))]
