"""Errors in the node, counted by kind: logged the first time, reported as a problem while they are fresh."""

from __future__ import annotations

import time
from collections.abc import Callable

KINDS = 100
"""Kinds of errors that are distinguished, at most: nonsense from a sender must not fill the memory."""

FRESH = 10.0
"""s; time for which an error is reported as a present problem."""


class Trouble:
    """Counts errors by kind.

    Attributes:
        counts: how often each kind has occurred.
    """

    def __init__(self, log: Callable[[str], object], now: Callable[[], float] = time.monotonic) -> None:
        """Make a counter; `log` gets each kind once; `now` returns seconds on a monotonic clock."""
        self.counts: dict[str, int] = {}
        self._log = log
        self._now = now
        self._last: dict[str, float] = {}

    def note(self, kind: str) -> None:
        """Count an error."""
        if kind not in self.counts:
            if len(self.counts) >= KINDS:
                return
            self._log(kind)
        self.counts[kind] = self.counts.get(kind, 0) + 1
        self._last[kind] = self._now()

    def problems(self) -> list[str]:
        """Return one sentence for each kind of error that has occurred lately."""
        now = self._now()
        return [
            f"{kind} ({self.counts[kind]} {'time' if self.counts[kind] == 1 else 'times'})"
            for kind, last in self._last.items()
            if now - last <= FRESH
        ]
