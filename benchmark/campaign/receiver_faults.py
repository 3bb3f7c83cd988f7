"""Faults of the receiver and of its messages."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from campaign.fault import BEGIN, END, MOVING, STOP, VEHICLES, WITH_VELOCITY, Fault, Kind
from eskf_ros.simulate.episodes import Episode, Outage
from eskf_ros.simulate.gnss_episodes import ClaimedStd, CorrelatedErrors, Multipath, RtkSolution, Spoofing
from eskf_ros.simulate.gnss_message_episodes import (
    FrozenFixes,
    MissingAltitude,
    RepeatedFixes,
    UnfilledFixes,
    WholeSeconds,
)

FOR_GOOD = math.inf
LENGTH = END - BEGIN
WHILE = ((BEGIN, END),)
FALSE_SIGNALS = ("multipath", "spoofing")


def _fault(name: str, *episodes: Episode, **more: object) -> Fault:
    return Fault(name, Kind.RECEIVER, episodes, **{"vehicles": VEHICLES, **more})  # type: ignore[arg-type]


def receiver_faults(amplitude: float = 1.0) -> list[Fault]:
    """Return the faults, their sizes times ``amplitude``."""
    return [*_errors(amplitude), *_spoofing(amplitude), *_messages(amplitude), *_outages()]


def _errors(a: float) -> list[Fault]:
    lasting = {"begin": MOVING, "settles": 120.0, "names": ("lasting errors",), "also": ("multipath", "fix covariance")}
    steps = [Multipath(begin, 20.0, (15.0 * a, 0.0, 0.0)) for begin in np.arange(BEGIN, STOP, 60.0).tolist()]
    return [
        *(
            _fault(
                f"lasting errors {1.5 * a:.3g} m, {time:g} s",
                CorrelatedErrors(0.0, FOR_GOOD, (1.5 * a, 2.25 * a), time),
                **lasting,
            )
            for time in (30.0, 60.0, 300.0)
        ),
        _fault(
            f"RTK claims 1 cm and wanders {0.3 * a:.3g} m",
            RtkSolution(0.0, FOR_GOOD),
            CorrelatedErrors(0.0, FOR_GOOD, (0.3 * a, 0.45 * a), 60.0),
            ClaimedStd(0.0, FOR_GOOD, (0.01, 0.02)),
            **lasting,
        ),
        _fault(
            f"steps of {15 * a:.3g} m, 20 s every minute",
            *steps,
            unusable=tuple((step.start, step.start + step.length) for step in steps),
            names=("multipath",),
            also=FALSE_SIGNALS,
        ),
        _fault(
            f"one wild fix of {2000 * a:.4g} m",
            Multipath(BEGIN, 0.2, (2000.0 * a, 0.0, 0.0)),
            end=BEGIN + 0.2,
            also=FALSE_SIGNALS,
        ),
    ]


def _spoofing(a: float) -> list[Fault]:
    return [
        _fault(
            f"drawn away by {speed * a:.3g} m/s, {what}",
            Spoofing(BEGIN, LENGTH, (speed * a, 0.0, 0.0), consistent=is_consistent),
            end=END,
            # A velocity that is true tells where the robot is.
            unusable=WHILE if is_consistent else (),
            names=FALSE_SIGNALS,
            filters=Fault.filters if is_consistent else WITH_VELOCITY,
        )
        for speed in (0.2, 0.5, 1.0)
        for is_consistent, what in ((True, "velocity too"), (False, "velocity true"))
    ]


def _messages(a: float) -> list[Fault]:
    stale = {"names": ("stale fixes",), "also": ("lasting errors",)}
    return [
        _fault("frozen coordinates for 40 s", FrozenFixes(BEGIN, LENGTH), end=END, unusable=WHILE, **stale),
        _fault("fixes sent five times", RepeatedFixes(0.0, FOR_GOOD), begin=MOVING, **stale),
        _fault(
            f"unfilled fixes (0, 0, 0) for the first {15 * a:.3g} s",
            UnfilledFixes(0.0, 15.0 * a),
            begin=0.0,
            end=15.0 * a,
            unusable=((0.0, 15.0 * a),),
            names=("unfilled fixes",),
        ),
        _fault(
            "unfilled fixes (0, 0, 0) for 40 s",
            UnfilledFixes(BEGIN, LENGTH),
            end=END,
            unusable=WHILE,
            names=("unfilled fixes",),
        ),
        _fault("no altitude", MissingAltitude(0.0, FOR_GOOD), begin=MOVING, names=("altitude missing",)),
        _fault(
            "no altitude in one of four fixes",
            MissingAltitude(0.0, FOR_GOOD, 0.25),
            begin=MOVING,
            names=("altitude missing",),
        ),
        _fault(
            "stamps cut to whole seconds",
            WholeSeconds(0.0, FOR_GOOD),
            begin=MOVING,
            settles=120.0,
            names=("same stamps",),
            also=("position offset", "clocks apart"),
        ),
    ]


def _outages() -> list[Fault]:
    hour = {"scenario": "hour_drive", "vehicles": (), "also": ("outage",)}
    sparse = {"gnss_rate": 0.1}
    return [
        *(
            _fault(
                f"outage of {minutes:g} min",
                Outage(BEGIN, 60.0 * minutes),
                end=BEGIN + 60.0 * minutes,
                unusable=((BEGIN, BEGIN + 60.0 * minutes),),
                stop=BEGIN + 60.0 * minutes + 120.0,
                **hour,
            )
            for minutes in (3.0, 10.0)
        ),
        replace(_fault("fixes 10 s apart", options=sparse, begin=MOVING), also=("outage",)),
    ]
