"""Steps of the clock that stamps the IMU: seen in the order of arrival, and taken out of the timeline.

A clock that is set makes all stamps jump, but time goes on. The timeline counts in a time of its own that never jumps:
stamp + shift. When the clock is set, the shift changes, and the estimate is carried on; what is given out carries the
stamps of the clock as it was then. Without a step the shift is zero, and nothing here has an effect.

- **Set back**: samples in a row, each a little after the one before, begin behind the newest one, and run over a time
  from which there are samples already. Samples that come late fill a hole, or come between newer ones.
- **Set forward**: samples in a row jump ahead of the newest one and of their own arrival. Where arrivals are unknown,
  or do not pass as the stamps do (a recording that is played fast), this cannot be told from an IMU that was silent.

Until enough samples say so, they are held, and the measurements that come meanwhile with them; so their order of
arrival matters around a step, and only there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.state.time import NEVER, SECOND

LEAST_STEP = 300_000_000
"""ns; smaller steps are not looked for: late samples and slewing clocks come to as much."""

CONFIRMATIONS = 10
"""Samples in a row that must follow each other at the new time."""

LONG_RUN = SECOND
"""ns; how long they must do so where no samples are kept to compare with: behind the history window."""

LONGEST_FOLLOWING = SECOND
"""ns; longest interval between two samples that follow each other."""

LONGEST_PAUSE = 5 * SECOND
"""ns; more time than this is not taken to have passed while a clock was set."""

SAME_RATE = 0.2
"""Share by which arrivals may pass slower or faster than stamps to be believed."""

WATCHED = 2000
"""Samples of which the least delay is kept: clocks drift apart by less than `LEAST_STEP` meanwhile."""

AHEAD = 50_000_000
"""ns; a measurement is not further ahead of the newest IMU sample than this when it arrives."""

TRANSITION = 3 * SECOND
"""ns; after this time with the new clock each stream keeps the clock that its last message had."""


class Sample(NamedTuple):
    """One IMU sample as it came; ``arrival`` (ns) is 0 where it is unknown."""

    stamp: int
    force: NDArray[np.float64]
    rate: NDArray[np.float64]
    arrival: int


class Step(NamedTuple):
    """One step: first time in the timeline with the new clock, first stamp, and size (all ns; negative is back)."""

    time: int
    stamp: int
    size: int


class ClockSteps:
    """Watches the stamps of the IMU; turns stamps into times of the timeline and back."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.held: list[Sample] = []
        self.held_aids: list[Callable[[], None]] = []
        self.newest = NEVER
        """The newest stamp of the present clock (ns)."""
        self._shifts = [0]
        self._choice: dict[Any, int] = {}
        self._is_ahead = False
        self._let_through = NEVER
        self._arrival = 0
        self._interval = 0.0
        self._reference = (0, 0)
        self._delays: list[int] = []
        self._seen = 0

    @property
    def shift(self) -> int:
        """What is added to a stamp of the present clock (ns)."""
        return self._shifts[-1]

    def time_of(self, source: Any, stamp: int) -> int:
        """Return the time in the timeline of a measurement; ``source`` tells streams apart, which may lag behind."""
        if not self.steps:
            return stamp
        frontier = self.newest + self.shift
        if source not in self._choice or frontier - self.steps[-1].time < TRANSITION:
            fitting = [shift for shift in self._shifts[-2:] if stamp + shift <= frontier + AHEAD]
            self._choice[source] = max(fitting, default=min(self._shifts[-2:]))
        return stamp + self._choice[source]

    def stamps_of(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the stamps that times (n,) of the timeline had on the clock of then."""
        if not self.steps:
            return times
        era = np.searchsorted([step.time for step in self.steps], times, side="right")
        return np.where(times == NEVER, NEVER, times - np.array(self._shifts)[era])

    def is_plain(self, stamps: NDArray[np.int64], arrivals: NDArray[np.int64] | None) -> bool:
        """Say whether nothing in these samples (n,) suggests a step."""
        if self.held:
            return False
        if self.newest == NEVER or not len(stamps):
            return True
        if len(stamps) == 1:
            # One by one they come to the node, where numpy would cost more than the filter.
            ahead = int(stamps[0]) - self.newest
            return ahead >= -LEAST_STEP and (arrivals is None or ahead <= LEAST_STEP)
        before = np.maximum.accumulate(np.concatenate([[self.newest], stamps[:-1]]))
        if (stamps < before - LEAST_STEP).any():
            return False
        return arrivals is None or not (stamps > before + LEAST_STEP).any()

    def note(self, frontier: int, count: int, delay: int, arrival: int) -> None:
        """Take note of samples that the timeline has taken, up to the time ``frontier``.

        ``count``: how many; ``delay``: least arrival minus stamp, ``arrival``: the last one (ns), 0 where unknown.
        """
        newest = frontier - self.shift
        if NEVER < self.newest < newest:
            interval = min((newest - self.newest) / count, LONGEST_FOLLOWING)
            self._interval += (0.05 if self._interval else 1.0) * (interval - self._interval)
        self.newest = newest
        if not arrival:
            return
        self._arrival = arrival
        self._seen += count
        if self._seen > WATCHED or not self._delays:
            self._seen = 0
            self._reference = newest, arrival
            self._delays = [*self._delays[-1:], delay]
        else:
            self._delays[-1] = min(self._delays[-1], delay)

    def take(self, sample: Sample, kept: Callable[[], NDArray[Any]]) -> tuple[list[Sample], list[Sample]]:
        """Take one sample; return samples with stamps that were wrong, and samples for the timeline.

        ``kept`` returns the IMU samples of the history.
        """
        if self.newest == NEVER:
            return [], [sample]
        if self.held and not 0 < sample.stamp - self.held[-1].stamp <= LONGEST_FOLLOWING:
            held, self.held = self.held, []
            false, late = (held, []) if self._is_ahead else ([], held)
            return false, [*late, sample]
        if not self.held:
            if 0 < sample.stamp - self._let_through <= LONGEST_FOLLOWING:
                self._let_through = sample.stamp
                return [], [sample]
            self._is_ahead = sample.stamp > self.newest
            if not (self._has_jumped_ahead(sample) if self._is_ahead else sample.stamp < self.newest - LEAST_STEP):
                return [], [sample]
        self.held.append(sample)
        if len(self.held) < CONFIRMATIONS:
            return [], []
        verdict = True if self._is_ahead else self._runs_over(kept())
        if verdict is None:
            return [], []
        held, self.held = self.held, []
        if verdict:
            self._set(held[0])
        else:
            self._let_through = held[-1].stamp
        return [], held

    def release(self) -> list[Sample]:
        """Return what is held: no more samples decide."""
        held, self.held = self.held, []
        return held

    def _has_jumped_ahead(self, sample: Sample) -> bool:
        """Say whether a sample is ahead of the newest one, and of its own arrival, by more than time has passed."""
        if sample.stamp - self.newest <= LEAST_STEP or not sample.arrival or not self._delays:
            return False
        stamp, arrival = self._reference
        passed = self.newest - stamp
        if passed < SECOND or abs(self._arrival - arrival - passed) > SAME_RATE * passed:
            return False
        return sample.arrival - sample.stamp < min(self._delays) - LEAST_STEP

    def _runs_over(self, kept: NDArray[Any]) -> bool | None:
        """Say whether the samples held run over a time from which samples are kept; None while that is not certain."""
        first, last = self.held[0].stamp, self.held[-1].stamp
        times = kept["stamp"] - self.shift
        if not len(times) or first < times[0]:
            return True if last - first >= LONG_RUN else None
        begin, end = np.searchsorted(times, first), np.searchsorted(times, last, side="right")
        readings = {
            int(time): (force.tobytes(), rate.tobytes())
            for time, force, rate in zip(
                times[begin:end], kept["specific_force"][begin:end], kept["angular_rate"][begin:end]
            )
        }
        # A recording whose blocks came twice has the same samples once more: no clock does that.
        doubled = sum(
            readings.get(sample.stamp) == (sample.force.tobytes(), sample.rate.tobytes()) for sample in self.held
        )
        return 2 * (len(readings) - doubled) >= len(self.held)

    def _set(self, first: Sample) -> None:
        """Begin a new clock with this sample, one interval, or what arrivals say, after the newest one."""
        passed = round(self._interval)
        if first.arrival and self._arrival:
            passed = min(max(first.arrival - self._arrival, passed), LONGEST_PAUSE)
        expected = self.newest + max(passed, 1)
        self.steps.append(Step(expected + self.shift, first.stamp, first.stamp - expected))
        self._shifts.append(self.shift + expected - first.stamp)
        self.newest = expected - self.shift
        self._delays, self._seen, self._arrival = [], 0, 0

    def complaints(self) -> list[str]:
        """Return a sentence for the steps, with what to do."""
        if not self.steps:
            return []
        last = self.steps[-1]
        size = abs(last.size) / SECOND
        way = "forward" if last.size > 0 else "back"
        count = f"; {len(self.steps)} steps so far" if len(self.steps) > 1 else ""
        return [
            f"the clock of the IMU's stamps was set {way} by {size:.1f} s, to {last.stamp / SECOND:.1f} s{count}: the "
            "estimate was carried on; let the clock be slewed, or set it before the drive"
        ]


def steps_back(stamps: NDArray[np.int64], begins_earlier: bool) -> list[int]:
    """Return where in stamps (n,), in order of arrival, the clock was set back: the first sample of each new clock.

    The same rule as that of `ClockSteps`, for whole recordings. ``begins_earlier``: whether samples older than all
    others count; they do not where the rows may come in any order.
    """
    found: list[int] = []
    start = 0
    before = np.maximum.accumulate(stamps)
    suspects = np.flatnonzero(stamps[1:] < before[:-1] - LEAST_STEP) + 1
    for i in suspects.tolist():
        if i <= start or not len(stamps) > i + CONFIRMATIONS:
            continue
        earlier = stamps[start:i]
        if stamps[i] >= earlier.max() - LEAST_STEP or 0 < stamps[i] - stamps[i - 1] <= LONGEST_FOLLOWING:
            continue
        run = stamps[i : i + CONFIRMATIONS]
        is_older = stamps[i] < earlier.min()
        if is_older:
            run = stamps[i : i + int(np.searchsorted(stamps[i:] - stamps[i], LONG_RUN, side="right")) + 1]
        steps = np.diff(run)
        if not ((steps > 0) & (steps <= LONGEST_FOLLOWING)).all():
            continue
        if not (begins_earlier and run[-1] - run[0] >= LONG_RUN if is_older else _are_many(earlier, run)):
            continue
        found.append(i)
        start = i
    return found


def _are_many(earlier: NDArray[np.int64], run: NDArray[np.int64]) -> bool:
    return 2 * int(np.count_nonzero((earlier >= run[0]) & (earlier <= run[-1]))) >= len(run)
