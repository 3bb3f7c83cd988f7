"""Ephemerides that arrive one by one while the robot drives, and which of them serve an epoch of ranges."""

from __future__ import annotations

from bisect import bisect_right, insort
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.ephemeris import EPHEMERIS, Ephemerides
from eskf_ros.gnss.time import Instant, elapsed, normalized

LARGEST_LEAD = 10_000_000_000
"""ns; a message stamped this far ahead of the ranges has another clock: its stamp is not believed."""

PRUNE_INTERVAL = 900.0
"""s; time from one search for outdated ephemerides to the next."""


class _Message(NamedTuple):
    """Content of one message. Compared as a whole, so that the order of arrival has no influence."""

    stamp: int
    klobuchar: bytes
    records: bytes


class DatedEphemerides:
    """The ephemerides that serve an epoch: independent of the order in which messages and epochs arrive.

    A message serves the epochs that are later than its stamp by the ``window`` (ns) of the history or more: an epoch in
    time thus finds all messages that arrive in time. The delay costs nothing, because an issue is sent long before the
    one it replaces is outdated. A message without a stamp, or with an impossible one, serves at once.

    Messages that bring nothing new take no memory, and ephemerides that no epoch can use any more are forgotten, so
    that a node may run for ever. Those of files are kept.
    """

    def __init__(self, records: NDArray[np.void], klobuchar: NDArray[np.float64], window: int) -> None:
        """Start with the records (EPHEMERIS) of files and eight parameters of the ionosphere, which serve any stamp."""
        self._window = window
        self._files = records
        self._settled = Ephemerides(records)
        self._settled_klobuchar = klobuchar
        self._messages: list[_Message] = []
        self._newest = self._previous = 0
        self._serving: list[_Message] = []
        self._joined = self._settled, klobuchar
        self._instant: Instant = 0, 0.0
        self._pruned: Instant = 0, 0.0

    def add(self, stamp: int, records: NDArray[np.void], klobuchar: NDArray[np.float64] | None) -> None:
        """Add the content of a message with this stamp (ns): records (EPHEMERIS), ionosphere parameters if any."""
        # Settled records serve every epoch still to come: a repetition adds nothing.
        fresh = self._settled.unknown(records)
        if len(fresh) or klobuchar is not None:
            insort(self._messages, _Message(stamp, b"" if klobuchar is None else klobuchar.tobytes(), fresh.tobytes()))

    def at(self, stamp: int, instant: Instant | None = None) -> tuple[Ephemerides, NDArray[np.float64]]:
        """Return the ephemerides and the parameters of the ionosphere that serve an epoch with this stamp (ns).

        ``instant``: GPS time of the epoch; without it nothing is forgotten.
        """
        # The earlier of two epochs in a row decides, so that a single wrong stamp settles nothing.
        self._newest = max(self._newest, min(self._previous or stamp, stamp))
        self._previous = stamp
        # Messages that serve every epoch still to come are merged.
        settled = self._older_than(self._newest - 2 * self._window)
        if settled:
            self._settled, self._settled_klobuchar = self._with(self._messages[:settled])
            del self._messages[:settled]
            self._serving, self._joined = [], (self._settled, self._settled_klobuchar)
        if instant is not None:
            self._prune(instant)
        unbelieved = self._older_than(max(self._newest, stamp) + LARGEST_LEAD)
        serving = self._messages[: self._older_than(stamp - self._window)] + self._messages[unbelieved:]
        if serving != self._serving:
            self._serving, self._joined = serving, self._with(serving)
        return self._joined

    def _prune(self, instant: Instant) -> None:
        """Forget from time to time what is outdated for all epochs still to come.

        The earlier of two epochs in a row decides, so that a single wrong time tag has no effect.
        """
        week, seconds = min(self._instant, instant)
        self._instant = instant
        oldest = normalized(week, seconds - 2e-9 * self._window)
        if abs(elapsed(*oldest, *self._pruned)) >= PRUNE_INTERVAL:
            self._pruned = oldest
            self._settled.drop_ended(*oldest)
            self._settled.add(self._files)

    def _older_than(self, stamp: int) -> int:
        """Return the number of messages with this stamp (ns) or an earlier one."""
        return bisect_right(self._messages, stamp, key=lambda message: message.stamp)

    def _with(self, messages: list[_Message]) -> tuple[Ephemerides, NDArray[np.float64]]:
        """Return the settled ephemerides with those of messages, and the last ionosphere parameters among them."""
        records = self._settled.unknown(np.frombuffer(b"".join(message.records for message in messages), EPHEMERIS))
        klobuchar = self._settled_klobuchar
        for message in messages:
            if message.klobuchar:
                # A copy, because memory that cannot be written to is another type, for which numba compiles anew.
                klobuchar = np.frombuffer(message.klobuchar).copy()
        if not len(records):
            return self._settled, klobuchar
        return Ephemerides(np.concatenate([self._settled.records, records])), klobuchar
