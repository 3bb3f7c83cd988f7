"""RINEX files as messages of a recording: `gnss/ranges` and `gnss/ephemerides` as if they had been recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eskf_ros.bags import Batch, cloud_messages
from eskf_ros.gnss.cloud import UBLOX_NUMBER, write_epoch
from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.ephemeris_cloud import write_ephemerides
from eskf_ros.gnss.range_files import read_navigation_files, read_range_file
from eskf_ros.gnss.ranges import locate

MARGIN = 1_000_000_000
"""ns; epochs this far outside of the recording still belong to it."""
LEAD = 1_000_000
"""ns; log time from the ephemerides to the first epoch."""
AGE = 60_000_000_000
"""ns; time from the stamps of the ephemerides to the first epoch, as if the receiver had been on for a while."""
EPHEMERIDES_PER_MESSAGE = 500
"""Ephemerides in one message, at most."""


class RangesError(Exception):
    """The files do not fit the recording; the text is one line for the user."""


@dataclass
class Beside:
    """The messages of RINEX files. ``outside``: epochs outside of the time of the recording; ``notes`` for the user."""

    ranges: Batch
    ephemerides: Batch
    outside: int
    notes: list[str]


def read_beside(
    observations: Path,
    navigation: Sequence[Path],
    first: int,
    last: int,
    clock_offset: float = 0.0,
    frame: str = "gps",
    satellites: bool = False,
) -> Beside:
    """Return the messages for a recording from ``first`` to ``last`` (ns of its clock).

    ``clock_offset`` (s): see `range_files.read_range_file`. With ``satellites`` the ranges bring the states of their
    satellites; those without ephemeris have none. The log time of an epoch is its stamp; ephemerides come before the
    first one. Raises RinexError for files that cannot be read, RangesError if no epoch is in that time.
    """
    file = read_range_file(observations, clock_offset)
    files = read_navigation_files(navigation)
    kept = np.flatnonzero((file.stamps >= first - MARGIN) & (file.stamps <= last + MARGIN))
    if not len(kept):
        raise RangesError(f"{observations}: {_no_overlap(file.stamps, first, last)}")
    stamps = file.stamps[kept]
    tags = file.observations.epochs[kept]
    bounds = [(int(tag["week"]), float(tag["seconds"])) for tag in (tags[0], tags[-1])]
    serving = files.serving(bounds[0], bounds[1])
    ephemerides = Ephemerides(np.array([broadcast.record() for broadcast in serving], files.records.dtype))
    clouds, unwritten = [], 0
    for k in kept.tolist():
        epoch = file.epoch(k)
        if satellites:
            locate(epoch.ranges, epoch.week, epoch.seconds, ephemerides)
        unwritten += int(np.count_nonzero(UBLOX_NUMBER[epoch.ranges["signal"]] < 0))
        clouds.append(write_epoch(epoch.ranges, epoch.week, epoch.seconds, satellites))
    parts = [
        write_ephemerides(serving[begin : begin + EPHEMERIDES_PER_MESSAGE], files.klobuchar)
        for begin in range(0, 0 if satellites else len(serving), EPHEMERIDES_PER_MESSAGE)
    ]
    starts = np.full(len(parts), int(stamps[0]) - LEAD, np.int64)
    notes = [
        f"{complaints.path}: {reason} ({count})"
        for complaints in (file.observations.complaints, *files.complaints)
        for reason, count in complaints.counts.items()
    ]
    if unwritten:
        notes.append(f"{observations}: signals that the topic has no number for, left out ({unwritten})")
    if not serving:
        notes.append("no ephemeris serves the time of the recording: the ranges have no satellites")
    return Beside(
        Batch(stamps, cloud_messages(stamps, clouds), [frame]),
        Batch(starts, cloud_messages(starts - AGE, parts), [frame]),
        len(file.stamps) - len(kept),
        notes,
    )


def merged(batches: Iterable[dict[str, Batch]], beside: Mapping[str, Batch]) -> Iterator[dict[str, Batch]]:
    """Add the messages ``beside`` a recording (by topic, sorted by log time) to its batches, each in its time.

    A message comes with the first batch that ends after it, or after the last batch; so batches still follow each other
    without overlap.
    """
    done = dict.fromkeys(beside, 0)

    def taken(until: int | None) -> dict[str, Batch]:
        parts = {}
        for topic, batch in beside.items():
            begin, times = done[topic], batch.log_time
            end = len(times) if until is None else int(np.searchsorted(times, until, "right"))
            if end > begin:
                parts[topic] = Batch(times[begin:end], batch.messages[begin:end], batch.strings)
                done[topic] = end
        return parts

    for batch in batches:
        yield {**batch, **taken(max(int(part.log_time[-1]) for part in batch.values()))}
    rest = taken(None)
    if rest:
        yield rest


def _no_overlap(stamps: np.ndarray, first: int, last: int) -> str:
    if not len(stamps):
        return "no epoch in it"
    spans = [
        f"{_date(begin)} to {_date(end)}" for begin, end in ((int(stamps.min()), int(stamps.max())), (first, last))
    ]
    apart = (int(stamps.min()) - first) * 1e-9
    return (
        f"its epochs ({spans[0]} UTC) are not of the time of the recording ({spans[1]}); "
        f"if its clock is another, say by how much with --clock-offset (first to first: {-apart:.0f} s)"
    )


def _date(stamp: int) -> str:
    return str(np.datetime64(stamp, "ns").astype("datetime64[s]"))
