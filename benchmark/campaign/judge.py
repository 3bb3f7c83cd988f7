"""The figures of runs, and what they are held against: the bars."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from campaign.causes import is_named, is_wrong
from campaign.fault import Fault, Filter, Kind
from campaign.running import MOVES, RAISED, TURNS, Trace

Array = NDArray[np.float64]

FAR, SIGMAS = 10.0, 5.0
"""m and standard deviations: beyond both it is lost, beyond the sigmas it is a lie."""

RECOVERS = 15.0
"""s after the end of a fault from which on nothing of it may be left."""

NEAR = math.radians(20.0)
"""rad; a heading is right within this, and within `SIGMAS`."""

LARGEST_ERROR = {True: 10.0, False: 30.0}
"""m; the largest error after a fault of the IMU, with and without velocities."""

LIES, WRONG, NAMED, HELD = 0.01, 0.02, 0.9, 0.9
"""Shares: of lies at most, of runs that blame a wrong cause at most, of runs that name the right one at least, and of
the time at rest at which rest is seen at least."""

KNOWN_WITHIN = 60.0
"""s from the first motion to a heading that is known, and right."""

CONSISTENT = (0.7, 1.5)
"""Bounds of the mean of (error/sigma)^2 of the heading where nothing tells it."""

NEVER_AT_REST = ("boat", "long_flight")
"""Scenarios in which hardly ever a moment is one of rest."""

GATE_SHARE = 0.001
"""Share of good measurements that a gate refuses (``gnss.gate_probability``)."""

ROUNDING = 0.005
"""m; errors are compared to the centimetre."""


@dataclass(frozen=True)
class Figures:
    """One run in numbers; shares of the time, m, s; nan where there is nothing to count."""

    worst: float
    lost: float
    position_lies: float
    heading_lies: float
    heading_square: float
    heading_beyond: bool
    restarts: int
    resets: int
    thrown_away: int
    known_after: float
    is_right: bool
    false_rest: int
    held: float
    named_after: float
    wrong: tuple[str, ...]
    said: tuple[str, ...]
    refused: int
    offered: int


def figures_of(fault: Fault, trace: Trace) -> Figures:
    """Reduce a run to what the table needs."""
    t = trace.seconds
    judged = t >= min(fault.begin + fault.settles, fault.end + RECOVERS)
    counted = t >= (fault.begin if math.isinf(fault.end) else fault.end + RECOVERS)
    for begin, end in fault.unusable:
        counted &= (t < begin) | (t >= end + RECOVERS)
    ratio = np.where(trace.is_known, np.abs(trace.heading_error) / trace.heading_sigma, 0.0)
    known_judged = judged & trace.is_known
    begun = t[(trace.speed > MOVES) | (trace.turn > 5.0 * TURNS)]
    begun_at = float(begun[0]) if len(begun) else math.nan
    known_at = float(t[np.argmax(trace.is_known)]) if trace.is_known.any() else math.inf
    since = trace.is_known & (t >= known_at)
    is_right = bool(np.all((ratio[since] < SIGMAS) & (np.abs(trace.heading_error[since]) < NEAR)))
    still = (t > 30.0) & (trace.speed < 1e-6) & (trace.turn < 1e-6)
    named = [when for sentence, when in trace.said.items() if is_named(sentence, fault.names)]
    wrong = tuple(text for text in trace.said if is_wrong(text, fault.names, fault.also))
    return Figures(
        worst=float(trace.error[t >= min(fault.begin, t[-1])].max()),
        lost=share(trace.error > np.maximum(FAR, SIGMAS * trace.sigma), counted),
        position_lies=share(trace.error > SIGMAS * trace.sigma, judged),
        heading_lies=share(ratio > SIGMAS, judged),
        heading_square=float(np.mean(ratio[known_judged] ** 2)) if known_judged.any() else math.nan,
        heading_beyond=bool((ratio[known_judged] > SIGMAS).any()),
        restarts=trace.restarts,
        resets=trace.resets,
        thrown_away=trace.thrown_away,
        known_after=known_at - begun_at,
        is_right=is_right,
        false_rest=int(np.count_nonzero(trace.rest_speed > MOVES) + np.count_nonzero(trace.rest_turn > TURNS)),
        held=share(np.isin(np.round(t[still]), np.round(trace.rest)), np.ones(np.count_nonzero(still), bool)),
        named_after=min(named) - fault.begin if named else math.inf,
        wrong=wrong,
        said=tuple(trace.said),
        refused=trace.refused,
        offered=trace.offered,
    )


def share(what: NDArray[np.bool_], counted: NDArray[np.bool_]) -> float:
    """Return the share of ``counted`` in which ``what`` is true; nan if nothing is counted."""
    return float(np.mean(what[counted])) if counted.any() else math.nan


@dataclass(frozen=True)
class Row:
    """The runs of one fault with one filter, and of the same filter without gates."""

    fault: Fault
    given: Filter
    runs: Sequence[Figures]
    ungated: Sequence[Figures]

    def missed(self) -> dict[int, list[str]]:
        """Return, by number of the bar, what misses it; a bar that the row is held against and meets is empty."""
        fault, found = self.fault, {1: self._lost(), 2: self._lies()}
        if fault.kind == Kind.MOTION or (fault.kind == Kind.CLEAN and fault.scenario in NEVER_AT_REST):
            found[5] = self._rest()
        if fault.is_slow:
            found[6] = self._known()
        if fault.kind == Kind.CLEAN:
            found[7] = self._clean()
        else:
            found[8] = self._names()
        if fault.is_judged_by_name_alone:
            found = {8: found[8]}
        return found

    def _lost(self) -> list[str]:
        found = []
        lost = mean([run.lost for run in self.runs])
        if lost > 0.0:
            found.append(f"lost {100.0 * lost:.1f} %")
        worst, bar = max(run.worst for run in self.runs), LARGEST_ERROR[self.given.has_velocity]
        if self.fault.kind == Kind.IMU and worst > bar:
            found.append(f"worst {metres(worst)} m")
        if self.ungated and self.median_worst(self.runs) > 1.1 * self.median_worst(self.ungated) + ROUNDING:
            found.append(f"without gates {metres(self.median_worst(self.ungated))} m")
        thrown = sum(run.thrown_away for run in self.runs)
        if thrown:
            found.append(f"{thrown} headings thrown away")
        return found

    def _lies(self) -> list[str]:
        found = []
        for what, shares in (
            ("position", [run.position_lies for run in self.runs]),
            ("heading", [run.heading_lies for run in self.runs]),
        ):
            if mean(shares) > LIES:
                found.append(f"{what} lies {100.0 * mean(shares):.1f} %")
        if self.fault.is_steady:
            square = self.heading_square()
            if not (math.isnan(square) or CONSISTENT[0] <= square <= CONSISTENT[1]):
                found.append(f"(e/s)^2 {square:.2g}")
            beyond = sum(run.heading_beyond for run in self.runs)
            if beyond:
                found.append(f"{beyond} runs beyond 5 s")
        return found

    def _rest(self) -> list[str]:
        false = sum(run.false_rest for run in self.runs)
        found = [f"{false} false rests"] if false else []
        held = mean([run.held for run in self.runs])
        if self.fault.is_at_rest and not held >= HELD:
            found.append(f"rest held {100.0 * held:.0f} %")
        return found

    def _known(self) -> list[str]:
        late = sum(run.known_after > KNOWN_WITHIN for run in self.runs)
        wrong = sum(not run.is_right for run in self.runs)
        return [f"{late} late"] * bool(late) + [f"{wrong} wrong"] * bool(wrong)

    def _clean(self) -> list[str]:
        offered, refused = sum(run.offered for run in self.runs), sum(run.refused for run in self.runs)
        expected = GATE_SHARE * offered
        found = []
        if refused > expected + 3.0 * math.sqrt(expected):
            found.append(f"refused {100.0 * refused / offered:.2g} %")
        complaining = sum(bool(run.said) for run in self.runs)
        return [*found, f"{complaining} complain"] if complaining else found

    def _names(self) -> list[str]:
        found = []
        if self.fault.names and self.named() < NAMED:
            found.append(f"named {100.0 * self.named():.0f} %")
        if self.blamed() > WRONG:
            found.append(f"wrong cause {100.0 * self.blamed():.0f} %")
        if any(text.startswith(RAISED) for run in self.runs for text in run.said):
            found.append("raises")
        return found

    def named(self) -> float:
        """Share of the runs that name the right cause after the fault has begun."""
        return mean([math.isfinite(run.named_after) for run in self.runs])

    def blamed(self) -> float:
        """Share of the runs that blame a wrong cause."""
        return mean([bool(run.wrong) for run in self.runs])

    def heading_square(self) -> float:
        """Mean of (error/sigma)^2 of the heading over the runs in which it is known."""
        return mean([run.heading_square for run in self.runs])

    @staticmethod
    def median_worst(runs: Sequence[Figures]) -> float:
        """Median of the largest errors (m)."""
        return float(np.median([run.worst for run in runs]))

    def verdict(self) -> str:
        """What misses which bar, or ok."""
        found = [f"{bar}: {', '.join(what)}" for bar, what in self.missed().items() if what]
        return "; ".join(found) or "ok"

    def cells(self) -> list[str]:
        """The row of the table."""
        runs = self.runs
        known = [run.known_after for run in runs]
        return [
            self.fault.name,
            str(self.given),
            f"{metres(self.median_worst(runs))} / {metres(max(run.worst for run in runs))}",
            f"{metres(self.median_worst(self.ungated))} / {metres(max(run.worst for run in self.ungated))}",
            percent([run.lost for run in runs]),
            f"{percent([run.position_lies for run in runs])} / {percent([run.heading_lies for run in runs])}",
            f"{self.heading_square():.2f}",
            f"{sum(r.restarts for r in runs)} / {sum(r.resets for r in runs)} / {sum(r.thrown_away for r in runs)}",
            f"{np.median(known):.0f} / {max(known):.0f}" if not math.isnan(known[0]) else "-",
            str(sum(run.false_rest for run in runs)),
            f"{100.0 * self.named():.0f} / {100.0 * self.blamed():.0f}"
            if self.fault.names
            else f"- / {100.0 * self.blamed():.0f}",
            self.verdict(),
            self.most_said(),
        ]

    def most_said(self) -> str:
        """What is said in most runs, a wrong cause first."""
        wrong = Counter(text for run in self.runs for text in set(run.wrong))
        said = wrong or Counter(text for run in self.runs for text in set(run.said))
        if not said:
            return ""
        sentence, count = said.most_common(1)[0]
        return f"{sentence[:60].replace('|', '/')} ({count})"


HEADINGS = (
    "fault",
    "filter",
    "worst m (median / all)",
    "without gates",
    "lost %",
    "lies % (pos. / head.)",
    "heading (e/s)^2",
    "restarts / resets / headings lost",
    "heading known s",
    "false rests",
    "named / wrong %",
    "bars missed",
    "said most",
)


def metres(error: float) -> str:
    """Return an error in as many digits as mean something."""
    return f"{error:.1f}" if error < 99.95 else f"{error:.0f}" if error < 1e5 else f"{error:.0e}"


def mean(values: Sequence[float]) -> float:
    """Return the mean of those that are numbers; nan if none is."""
    found = [value for value in values if not math.isnan(value)]
    return sum(found) / len(found) if found else math.nan


def percent(shares: Sequence[float]) -> str:
    """Return the mean of shares in percent."""
    found = mean(shares)
    return "-" if math.isnan(found) else f"{100.0 * found:.1f}"


def summary(rows: Sequence[Row]) -> list[tuple[str, str, str]]:
    """Return, by bar, how many of the rows held against it meet it."""
    titles = {1: "lost", 2: "lies", 5: "rest", 6: "slow robots", 7: "clean", 8: "names"}
    found = []
    for bar, title in titles.items():
        held = [row.missed()[bar] for row in rows if bar in row.missed()]
        if held:
            found.append((f"{bar} {title}", str(sum(not what for what in held)), str(len(held))))
    found.append(("all", str(sum(row.verdict() == "ok" for row in rows)), str(len(rows))))
    return found
