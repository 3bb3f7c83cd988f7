"""Fewer points for a plot, without losing what matters: in every interval the extremes stay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def extremes(columns: list[NDArray[np.float64]], intervals: int) -> NDArray[np.intp]:
    """Return increasing indices into columns (n,) of which a plot looks like one of all points.

    The rows are divided into `intervals` of equal number; of each its first row stays, and the rows in which one of
    the columns is largest and smallest. All rows stay where that would not make them fewer. NaN is no extreme.
    """
    count = len(columns[0])
    per_interval = -(-count // intervals)
    if per_interval <= 2 * len(columns) + 1:
        return np.arange(count)
    starts = np.arange(0, count, per_interval)
    chosen = [starts, np.array([count - 1])]
    for column in columns:
        for fill, pick in ((-np.inf, np.argmax), (np.inf, np.argmin)):
            padded = np.full(len(starts) * per_interval, fill)
            padded[:count] = np.where(np.isfinite(column), column, fill)
            chosen.append(starts + pick(padded.reshape(-1, per_interval), axis=1))
    return np.unique(np.minimum(np.concatenate(chosen), count - 1))


def strongest(size: NDArray[np.float64], keep: NDArray[np.bool_], intervals: int) -> NDArray[np.intp]:
    """Return indices of points (n,): all in `keep` (thinned like the rest if they are many), and extremes of `size`."""
    kept, rest = np.flatnonzero(keep), np.flatnonzero(~keep)
    parts = [part[extremes([size[part]], intervals)] for part in (kept, rest) if len(part)]
    return np.unique(np.concatenate(parts)) if parts else kept
