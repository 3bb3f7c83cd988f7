"""What goes wrong in the node, counted by kind: logged the first time, a problem as long as it is fresh."""

from __future__ import annotations

import time
from collections.abc import Callable

KINDS = 100
"""No more kinds than this are told apart: a sender of nonsense must not fill the memory."""

FRESH = 10.0
"""Seconds for which something that went wrong is a present problem."""


class Trouble:
    """Counts kinds of trouble.

    Attributes:
        counts: how often each was met.
    """

    def __init__(self, log: Callable[[str], object], now: Callable[[], float] = time.monotonic) -> None:
        """`log` gets each kind once; `now` gives seconds on a clock that nobody sets."""
        self.counts: dict[str, int] = {}
        self._log = log
        self._now = now
        self._last: dict[str, float] = {}

    def note(self, kind: str) -> None:
        """Count something that went wrong."""
        if kind not in self.counts:
            if len(self.counts) >= KINDS:
                return
            self._log(kind)
        self.counts[kind] = self.counts.get(kind, 0) + 1
        self._last[kind] = self._now()

    def problems(self) -> list[str]:
        """What went wrong lately, a sentence each."""
        now = self._now()
        return [
            f"{kind} ({self.counts[kind]} {'time' if self.counts[kind] == 1 else 'times'})"
            for kind, last in self._last.items()
            if now - last <= FRESH
        ]
