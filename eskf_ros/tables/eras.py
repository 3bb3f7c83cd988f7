"""Tables whose clock was set back in mid-recording: cut there, so that old and new rows are not mixed by sorting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.history.clock_steps import steps_back
from eskf_ros.tables.columns import Array, Stamps

Part = tuple[Stamps, Array]
"""Stamps (n,) and rows (n, k) of a table, in the order in which they were given."""

Era = tuple[list[Part], dict[str, list[Part]]]
"""What one clock has stamped: parts of the IMU, and of the measurements by name."""


def eras_of(imu: list[Part], aids: dict[str, list[Part]]) -> list[Era]:
    """Return the parts of the tables by the clock that stamped them, one era unless a table of the IMU was set back.

    Rows in the order of stamps, or in any other, are one era: a clock that was set back runs a second time over stamps
    that were there before.
    """
    cuts = [steps_back(stamps, begins_earlier=False) for stamps, _ in imu]
    count = max((len(cut) for cut in cuts), default=0)
    eras: list[Era] = [([], {name: [] for name in aids}) for _ in range(count + 1)]
    for (stamps, rows), cut in zip(imu, cuts):
        for era, part in enumerate(np.split(np.arange(len(stamps)), cut)):
            eras[era][0].append((stamps[part], rows[part]))
    if not count:
        return [(imu, aids)]
    stamps, cut = next((stamps, cut) for (stamps, _), cut in zip(imu, cuts) if len(cut) == count)
    newest = [int(part.max()) for part in np.split(stamps, cut)[:-1]]
    least = min(old - int(stamps[i]) for old, i in zip(newest, cut))
    for name, parts in aids.items():
        for own, rows in parts:
            for era, index in enumerate(_split(own, newest, least)):
                eras[era][1][name].append((own[index], rows[index]))
    return eras


def _split(stamps: Stamps, newest: list[int], least: int) -> list[NDArray[np.intp]]:
    """Return the rows of a table of measurements by era.

    ``newest``: the newest stamp of the IMU in each era but the last, ``least``: the smallest step back (ns). A table so
    slow that its stamps never go back is cut where they leave the old clock's.
    """
    order = np.arange(len(stamps))
    before = np.maximum.accumulate(stamps) if len(stamps) else stamps
    cuts: list[int] = []
    start = 0
    for i in (np.flatnonzero(stamps[1:] < before[:-1] - least // 2) + 1).tolist():
        if i > start and stamps[i] < stamps[start:i].max() - least // 2 and stamps[i] < stamps[i - 1]:
            cuts.append(i)
            start = i
    if len(cuts) == len(newest):
        return np.split(order, cuts)
    return np.split(order, [int(np.searchsorted(before, limit, side="right")) for limit in newest])
