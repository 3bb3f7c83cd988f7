"""What becomes of the filter when fixes are bad: spikes, multipath, outages, lying covariances, spoofing.

    python benchmark/recovery.py [--runs 100]

Simulates `runs` drives of each scenario, with position and velocity and with position alone, and compares with the
truth. Needs nothing but the simulator; some fifteen minutes on one core.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from monte_carlo import NO_SIDE_SLIP, Run, nees, run

from eskf_ros.filter.layout import POSITION
from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters import from_mapping
from eskf_ros.simulate.episodes import Episode, Outage
from eskf_ros.simulate.gnss_episodes import BadFixes, ClaimedStd, Multipath, Spoofing, ZeroCovariance
from eskf_ros.simulate.scenario import simulate

FIRST_SEED = 20_000
"""Apart from the seeds of the tests and of development."""

BEGIN = 100.0
"""The drive is in full swing: aligned for a minute, at 14 m/s (s)."""

STOP = 210.0
RECOVERED = 3.0
"""A horizontal error (m) that a filter with fixes of 1 m per axis does not have unless something is wrong."""


@dataclass(frozen=True)
class Case:
    """Something that goes wrong from `BEGIN` for ``length`` s."""

    label: str
    length: float
    episodes: tuple[Episode, ...]
    options: dict[str, Any] = field(default_factory=dict)


def bad_after_outage() -> tuple[Episode, ...]:
    return (Outage(BEGIN, 60.0), BadFixes(BEGIN + 60.0, 1.0))


CASES = (
    Case("clean", 0.0, ()),
    Case("one fix off by 30 m", 0.2, (Multipath(BEGIN, 0.2, (24.0, -18.0, 0.0)),)),
    Case("multipath of 25 m for 5 s", 5.0, (Multipath(BEGIN, 5.0, (20.0, -15.0, 0.0)),)),
    Case("60 s without GNSS", 60.0, (Outage(BEGIN, 60.0),)),
    Case("60 s without GNSS, then 5 bad fixes", 61.0, bad_after_outage()),
    Case("3 mm claimed for errors of 1 m", 60.0, (ClaimedStd(BEGIN, 60.0),)),
    Case("covariance all zero", 60.0, (ZeroCovariance(BEGIN, 60.0),)),
    Case("position drawn away by 1.5 m/s", 60.0, (Spoofing(BEGIN, 60.0, (1.5, 0.0, 0.0), 0.1, consistent=False),)),
    Case("position and velocity, 5 m/s at 1 m/s2", 60.0, (Spoofing(BEGIN, 60.0, (5.0, 0.0, 0.0), 1.0),)),
)


@dataclass(frozen=True)
class Outcome:
    """What one run of a case came to: errors in m, seconds, NEES of the position (ideal mean 3), resets, restarts."""

    during: float
    after: float
    recovery: float
    nees: float
    resets: int
    restarts: int


def outcome_of(case: Case, done: Run, navigator: Navigator) -> Outcome:
    """Judge a run: the worst errors during the case and in the 10 s after it, and the way back."""
    end = BEGIN + case.length
    error = np.hypot(done.error[:, 0], done.error[:, 1])
    during = error[(done.seconds >= BEGIN) & (done.seconds < max(end, BEGIN + 0.5))]
    after = error[(done.seconds >= end) & (done.seconds < end + 10.0)]
    bad = done.seconds[(done.seconds >= end) & (error > RECOVERED)]
    settled = (done.seconds >= end + 10.0) & (done.seconds < end + 40.0)
    position = nees(done.error[settled], done.covariance[settled], slice(POSITION, POSITION + 3))
    return Outcome(
        float(during.max()),
        float(after.max()),
        float(bad[-1] - end) if len(bad) else 0.0,
        float(position.mean()),
        navigator.position_resets,
        navigator.restarts,
    )


def run_case(
    case: Case, seed: int, changes: dict[str, Any] | None = None, interval: float = 0.2
) -> tuple[Outcome, Run, Navigator]:
    """Simulate and run one seed of a case."""
    recording = simulate("drive", seed, **{"imu_rate": 100.0, "stop": STOP, "episodes": case.episodes, **case.options})
    navigator = Navigator(from_mapping({**recording.parameters(), **NO_SIDE_SLIP, **(changes or {})}))
    done = run(recording, navigator, interval)
    return outcome_of(case, done, navigator), done, navigator
