"""Ephemerides that come one by one while the robot drives, and which of them an epoch of ranges may use."""

from __future__ import annotations

from bisect import bisect_right, insort
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.ephemeris import EPHEMERIS, Ephemerides
from eskf_ros.gnss.time import Instant, elapsed, normalized

LARGEST_LEAD = 10_000_000_000
"""A message stamped this far (ns) ahead of the ranges has another clock: its stamp is not believed."""

PRUNE_INTERVAL = 900.0
"""s from one look for ephemerides whose time has ended to the next."""


class _Message(NamedTuple):
    """What one message brought. Compared as a whole, so that the order of arrival leaves no trace."""

    stamp: int
    klobuchar: bytes
    records: bytes


class DatedEphemerides:
    """The ephemerides known at the stamp of an epoch: the same in whatever order messages and epochs arrive.

    A message serves the epochs that are later than its own stamp by the ``window`` (ns) of the history: those that are
    in time find all the messages that are in time. Nothing is lost by the wait, since an issue is sent long before
    the one it replaces grows old. What has no stamp, or one that cannot be true, serves at once.

    Messages that bring what is known already cost nothing, and what no epoch can use any more is forgotten, so that a
    node may run for ever. Files are kept as they are.
    """

    def __init__(self, records: NDArray[np.void], klobuchar: NDArray[np.float64], window: int) -> None:
        """Start with the records (EPHEMERIS) of files and eight parameters of the ionosphere, good for any stamp."""
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
        """Take what a message stamped so (ns) brought: records (EPHEMERIS), parameters of the ionosphere if any."""
        # What is settled serves every epoch still to come, whether it is sent again or not.
        fresh = self._settled.unknown(records)
        if len(fresh) or klobuchar is not None:
            insort(self._messages, _Message(stamp, b"" if klobuchar is None else klobuchar.tobytes(), fresh.tobytes()))

    def at(self, stamp: int, instant: Instant | None = None) -> tuple[Ephemerides, NDArray[np.float64]]:
        """Return the ephemerides and the parameters of the ionosphere that serve an epoch with this stamp (ns).

        ``instant``: GPS time of the epoch; without it nothing is forgotten.
        """
        # The earlier of two epochs in a row: a single one with a wrong stamp settles nothing.
        self._newest = max(self._newest, min(self._previous or stamp, stamp))
        self._previous = stamp
        # All that serves every epoch still to come becomes one.
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
        """Forget what ended before the epochs still to come, now and then.

        By the earlier of two epochs in a row: a single one with a wrong time tag forgets nothing.
        """
        week, seconds = min(self._instant, instant)
        self._instant = instant
        oldest = normalized(week, seconds - 2e-9 * self._window)
        if abs(elapsed(*oldest, *self._pruned)) >= PRUNE_INTERVAL:
            self._pruned = oldest
            self._settled.drop_ended(*oldest)
            self._settled.add(self._files)

    def _older_than(self, stamp: int) -> int:
        """How many messages have this stamp or an earlier one."""
        return bisect_right(self._messages, stamp, key=lambda message: message.stamp)

    def _with(self, messages: list[_Message]) -> tuple[Ephemerides, NDArray[np.float64]]:
        """Add messages to what is settled; of several parameters of the ionosphere the last are in force."""
        records = self._settled.unknown(np.frombuffer(b"".join(message.records for message in messages), EPHEMERIS))
        klobuchar = self._settled_klobuchar
        for message in messages:
            if message.klobuchar:
                # A copy, because memory that cannot be written to is another type, for which numba compiles anew.
                klobuchar = np.frombuffer(message.klobuchar).copy()
        if not len(records):
            return self._settled, klobuchar
        return Ephemerides(np.concatenate([self._settled.records, records])), klobuchar
