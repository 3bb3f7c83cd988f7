"""What becomes of the filter when fixes are bad: spikes, multipath, outages, lying covariances, spoofing.

    python benchmark/recovery.py [--runs 100]

Simulates `runs` drives of each scenario, with position and velocity and with position alone, and compares with the
truth. Then receivers that lie consistently: which acceleration of the lie is noticed, for each grade of IMU. Needs
nothing but the simulator; about half an hour on one core.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.error_state import POSITION
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.episodes import Episode, Outage
from eskf_ros.simulate.gnss_episodes import BadFixes, ClaimedStd, Multipath, Spoofing, ZeroCovariance
from eskf_ros.simulate.scenario import simulate
from markdown_table import table
from monte_carlo import NO_SIDE_SLIP, Array, Run, feed, nees, run, state_error

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results.md"
MARKERS = ("<!-- recovery: written by benchmark/recovery.py -->\n", "<!-- end of recovery -->\n")

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


GRADES = ("consumer", "industrial", "tactical")
LIE_SPEED = 5.0
ACCELERATIONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
NOTICED = "the IMU went different ways"
LATEST = 285.0


@dataclass(frozen=True)
class Notice:
    """When a consistent lie was noticed (s after its onset, infinity: never), and how far off (m) the filter was then.

    Infinitely late is also what is noticed only when the lie has its full speed for ten seconds.
    """

    seconds: float
    error: float


def notice_of(seed: int, grade: str, acceleration: float) -> Notice:
    """Run one drive with a lie that sets in with ``acceleration`` (m/s2)."""
    length = min(LIE_SPEED / acceleration + 10.0, LATEST - BEGIN)
    lie = Spoofing(BEGIN, length + 1.0, (LIE_SPEED, 0.0, 0.0), acceleration)
    options: dict[str, Any] = {"imu_rate": 100.0, "stop": BEGIN + length, "grade": grade, "episodes": (lie,)}
    recording = simulate("drive", seed, **options)
    navigator = Navigator(from_mapping({**recording.parameters(), **NO_SIDE_SLIP}))
    every = round(0.5 * recording.options.imu_rate)
    stops = np.arange(every - 1, len(recording.imu_stamp), every)
    truth = np.searchsorted(recording.truth_stamp, recording.imu_stamp[stops])
    for k, (i, state) in enumerate(feed(recording, navigator, stops)):
        if any(NOTICED in sentence for sentence in navigator.complaints):
            error = state_error(recording, i, int(truth[k]), state)
            return Notice((i + 1) / recording.options.imu_rate - BEGIN, float(np.hypot(error[0], error[1])))
    return Notice(np.inf, np.nan)


def main() -> int:
    """Run everything and write the tables; the exit code is 1 if a clean run had a reset or a complaint."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="drives of each case (default 100)")
    parser.add_argument("--only", default="", metavar="TEXT", help="cases whose name contains TEXT; writes nothing")
    options = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + options.runs)
    content, faults = "", 0
    for title, changes in (("position and velocity", {}), ("position only", {"gnss.use_velocity": False})):
        rows = []
        for case in CASES:
            if options.only not in case.label:
                continue
            done = [run_case(case, seed, changes) for seed in seeds]
            rows.append(row_of(case, [outcome for outcome, _, _ in done]))
            print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
            if not case.episodes:
                faults += sum(bool(navigator.complaints) or navigator.position_resets > 0 for _, _, navigator in done)
        content += f"\n### {title[0].upper() + title[1:]}\n\n" + table(HEADINGS, rows)
    if options.only:
        return 1 if faults else 0
    rows = []
    for grade in GRADES:
        row = [grade]
        for acceleration in ACCELERATIONS:
            notices = [notice_of(seed, grade, acceleration) for seed in seeds]
            row.append(cell_of(notices))
        rows.append(row)
        print(" | ".join(row), file=sys.stderr, flush=True)
    content += "\n### A receiver that lies consistently\n\n"
    content += table(["IMU", *(f"{acceleration:g} m/s2" for acceleration in ACCELERATIONS)], rows) + "\n"
    print(content)
    RESULTS.write_text(between_markers(RESULTS.read_text(encoding="utf-8"), content), encoding="utf-8")
    return 1 if faults else 0


def between_markers(text: str, content: str) -> str:
    """`text` with `content` between the markers; raises ValueError when they are not there."""
    before, begin, rest = text.partition(MARKERS[0])
    _, end, after = rest.partition(MARKERS[1])
    if not (begin and end):
        raise ValueError(f"{RESULTS}: the lines {MARKERS[0].strip()!r} and {MARKERS[1].strip()!r} are missing")
    return before + begin + content + end + after


def three(values: Array) -> str:
    """Median, 95 % and largest."""
    return " / ".join(f"{value:.2f}" for value in (np.median(values), np.percentile(values, 95.0), values.max()))


def row_of(case: Case, outcomes: Sequence[Outcome]) -> list[str]:
    """One row of the table of cases."""
    columns = {name: np.array([getattr(outcome, name) for outcome in outcomes]) for name in Outcome.__annotations__}
    return [
        case.label,
        three(columns["during"]),
        three(columns["after"]),
        three(columns["recovery"]),
        f"{columns['nees'].mean():.1f}",
        str(int(columns["resets"].sum())),
        str(int(columns["restarts"].sum())),
    ]


def cell_of(notices: Sequence[Notice]) -> str:
    """Share noticed; how late and how far off in the median."""
    found = [notice for notice in notices if np.isfinite(notice.seconds)]
    if not found:
        return "0 %"
    seconds, error = (float(np.median([getattr(notice, name) for notice in found])) for name in ("seconds", "error"))
    return f"{100 * len(found) / len(notices):.0f} %, {seconds:.0f} s, {error:.1f} m"


HEADINGS = ["what happens", "during, m", "10 s after, m", "recovered after, s", "NEES", "resets", "restarts"]

if __name__ == "__main__":
    sys.exit(main())
