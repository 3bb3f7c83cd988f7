"""Stamp monitor of a topic: delay, rate, stamps that are never filled in, and time that jumps."""

from __future__ import annotations

import enum
import math
import statistics
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from eskf_ros.filter.state.time import SECOND

MEMORY = 100
"""Messages over which delay and rate are computed."""

LONG_AGO = 10.0
"""s; stamps further behind their arrival are those of a recording, or of a clock that was never set."""

CONFIRMATIONS = 5
"""Messages in a row that must follow each other at the new time before a jump of the stamps is believed."""


class Stamp(enum.Enum):
    """What to do with a message, judged by its stamp and the ones before it."""

    IN_ORDER = enum.auto()
    ZERO = enum.auto()
    """The header was not filled in: the message has no place in time and must not be used."""
    ELSEWHERE = enum.auto()
    """Further from the others than the window: the admission of the estimator decides."""
    STARTED_AGAIN = enum.auto()
    """The stamps went back and continue from there (a bag that loops, a simulation reset): reset, then use it."""
    WENT_AHEAD = enum.auto()
    """The stamps jumped ahead, this computer's clock did not (a sensor clock was set): use the message, and log it."""


@dataclass(frozen=True)
class Timing:
    """Arrival minus stamp, and rate, over the last messages; NaN before the first message.

    `delay` is the median and `spread` the width of the interval that holds nine of ten messages (s). `rate` is in Hz of
    stamps and decreases while nothing arrives; `silence` is the time since the last arrival (s).
    """

    delay: float
    spread: float
    rate: float
    silence: float


class StampMonitor:
    """Watches the stamps of one topic. All times are integer nanoseconds; arrivals are on the node's clock."""

    def __init__(self, topic: str, window: float = 2.0, sender: str = "") -> None:
        """Make a monitor of `topic`; `sender` distinguishes several senders on it.

        `window` (s): how far out of order stamps may be; the history window of the filter.
        """
        self.topic = topic
        self.label = f"{topic} from {sender}" if sender else topic
        self.zero_count = 0
        self.zero_run = 0
        self.restart_count = 0
        self._window = round(window * SECOND)
        self._stamps: deque[int] = deque(maxlen=MEMORY)
        self._delays: deque[int] = deque(maxlen=MEMORY)
        self._last_arrival = 0
        self.restart()

    def restart(self) -> None:
        """Forget the stamps; counts stay. To be called for all topics after STARTED_AGAIN or a reset of the clock."""
        self._newest: int | None = None
        self._elsewhere = 0
        self._elsewhere_count = 0
        self._stamps.clear()
        self._delays.clear()

    def note(self, stamp: int, arrival: int) -> Stamp:
        """Record a message, with the configured time offset applied to its stamp; return what to do with it."""
        if stamp == 0:
            self.zero_count += 1
            self.zero_run += 1
            return Stamp.ZERO
        self.zero_run = 0
        self._last_arrival = arrival
        if self._newest is None:
            self._newest = stamp
        ahead = stamp - self._newest
        # In a pause of the sensor stamps and arrivals move on together; a wrong stamp moves alone.
        paused = ahead > 0 and bool(self._delays) and abs(arrival - stamp - self._delays[-1]) <= self._window
        if not paused and not -self._window <= ahead <= self._window:
            return self._note_elsewhere(stamp, arrival)
        if ahead > 0:
            self._newest = stamp
        self._elsewhere_count = 0
        self._stamps.append(stamp)
        self._delays.append(arrival - stamp)
        return Stamp.IN_ORDER

    def _note_elsewhere(self, stamp: int, arrival: int) -> Stamp:
        """Record a stamp outside the window: one changes nothing, several that follow each other are a jump."""
        follows = 0 < stamp - self._elsewhere <= self._window
        self._elsewhere_count = self._elsewhere_count + 1 if follows else 1
        self._elsewhere = stamp
        if self._elsewhere_count < CONFIRMATIONS:
            return Stamp.ELSEWHERE
        assert self._newest is not None
        back = stamp < self._newest
        self.restart()
        self.restart_count += back
        self._newest = stamp
        self._stamps.append(stamp)
        self._delays.append(arrival - stamp)
        return Stamp.STARTED_AGAIN if back else Stamp.WENT_AHEAD

    def timing(self, now: int) -> Timing:
        """Return delay, spread, rate and silence at `now` (ns, node's clock)."""
        count = len(self._delays)
        if count == 0:
            return Timing(math.nan, math.nan, 0.0, math.nan)
        delays = sorted(self._delays)
        spread = delays[round(0.95 * (count - 1))] - delays[round(0.05 * (count - 1))]
        silence = max(0, now - self._last_arrival)
        span = max(self._stamps) - min(self._stamps)
        rate = 0.0
        if span > 0:
            overdue = max(0, silence - span // (count - 1))
            rate = (count - 1) * SECOND / (span + overdue)
        return Timing(statistics.median(delays) / SECOND, spread / SECOND, rate, silence / SECOND)


def clock_complaints(monitors: Iterable[StampMonitor], now: int, tolerance: float = 1.0) -> list[str]:
    """Return one sentence for each fault of the clocks, with what to do; empty without faults.

    Clocks differ if the delays of two topics differ by more than `tolerance` (s).
    """
    found = []
    delays = []
    for monitor in monitors:
        if monitor.zero_run:
            found.append(
                f"{monitor.zero_count} {'message' if monitor.zero_count == 1 else 'messages'} on {monitor.label} "
                "with stamp zero: the driver must fill in header.stamp; without it a measurement has no place in time"
            )
        delay = monitor.timing(now).delay
        if not math.isnan(delay):
            delays.append((delay, monitor.label))
    if delays:
        (least, quickest), (most, slowest) = min(delays), max(delays)
        if most - least > tolerance:
            where = f"messages on {slowest} arrive {_delay_text(most)}, on {quickest} {_delay_text(least)}"
            if least > LONG_AGO:
                where = f"the stamps on {slowest} are that much further behind their arrival than those on {quickest}"
            found.append(
                f"sensor clocks differ by {_duration(most - least)}: {where}; synchronise the clocks, or set the "
                "time_offset of the topic"
            )
        elif least > LONG_AGO or most < -tolerance:
            found.append(
                f"all messages arrive {_delay_text(statistics.median(delay for delay, _ in delays))}: when they are "
                "played from a recording or come from a simulator, publish /clock and set use_sim_time; otherwise set "
                "this computer's clock"
            )
    return found


def _delay_text(delay: float) -> str:
    return f"{_duration(abs(delay))} {'after' if delay >= 0.0 else 'before'} their stamp"


def _duration(seconds: float) -> str:
    for unit, name in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 3.0 * unit:
            return f"{seconds / unit:.1f} {name}"
    return f"{seconds:.1f} s"
