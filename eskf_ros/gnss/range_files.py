"""RINEX files beside a recording: epochs with stamps on the IMU's clock, and navigation messages for them.

Both are the structured arrays of the topics `gnss/ranges` and `gnss/ephemerides` (`eskf_ros.gnss.cloud`,
`eskf_ros.gnss.ephemeris_cloud`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss import time as gnss_time
from eskf_ros.gnss.cloud import MAX_SIGNALS, Epoch
from eskf_ros.gnss.ephemeris import EPHEMERIS, Broadcast
from eskf_ros.gnss.rinex import Complaints
from eskf_ros.gnss.rinex_nav import read_navigation
from eskf_ros.gnss.rinex_obs import Observations, read_observations
from eskf_ros.gnss.signals import Gnss
from eskf_ros.gnss.time import SECONDS_PER_WEEK


@dataclass
class RangeFile:
    """Epochs of an observation file; ``stamps`` (n,): int64 ns on the clock of the recording."""

    stamps: NDArray[np.int64]
    observations: Observations

    def epoch(self, k: int) -> Epoch:
        """Return epoch ``k`` as `cloud.read_epoch` would."""
        tag, ranges = self.observations.epochs[k], self.observations.ranges(k)
        left_out = max(0, len(ranges) - MAX_SIGNALS)
        return Epoch(int(tag["week"]), float(tag["seconds"]), ranges[:MAX_SIGNALS], left_out)


def read_range_file(path: str | os.PathLike[str], clock_offset: float = 0.0) -> RangeFile:
    """Read a RINEX observation file.

    Stamps are its GPS time converted to Unix time (UTC as computers keep it), plus ``clock_offset`` (s): how far the
    clock of the recording is ahead of UTC, 18 if it shows GPS time (2017 and later). Raises RinexError.
    """
    observations = read_observations(path)
    offset = round(clock_offset * 1e9)
    stamps = [gnss_time.to_unix(int(tag["week"]), float(tag["seconds"])) + offset for tag in observations.epochs]
    return RangeFile(np.array(stamps, np.int64), observations)


@dataclass
class NavigationFiles:
    """Content of several navigation files: messages, and Klobuchar parameters (8,) of the last file that has them."""

    broadcasts: list[Broadcast] = field(default_factory=list)
    klobuchar: dict[Gnss, NDArray[np.float64]] = field(default_factory=dict)
    complaints: list[Complaints] = field(default_factory=list)

    @property
    def records(self) -> NDArray[np.void]:
        """The ephemerides (EPHEMERIS), for `ephemeris.Ephemerides`."""
        return np.array([broadcast.record() for broadcast in self.broadcasts], EPHEMERIS)

    def serving(self, first: tuple[int, float], last: tuple[int, float]) -> list[Broadcast]:
        """Return the messages that are valid at some instant between two instants of GPS time."""
        records = self.records
        toe = records["toe_week"] * SECONDS_PER_WEEK + records["toe"]
        begin, end = (week * SECONDS_PER_WEEK + seconds for week, seconds in (first, last))
        kept = (toe - records["max_lead"] <= end) & (toe + records["max_age"] >= begin)
        return [broadcast for broadcast, serves in zip(self.broadcasts, kept) if serves]


def read_navigation_files(paths: Iterable[str | os.PathLike[str]]) -> NavigationFiles:
    """Read RINEX navigation files. Raises RinexError."""
    files = NavigationFiles()
    for path in paths:
        navigation = read_navigation(path)
        files.broadcasts += navigation.broadcasts
        files.klobuchar |= navigation.klobuchar
        files.complaints.append(navigation.complaints)
    return files
