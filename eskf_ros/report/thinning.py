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


def strongest(size: NDArray[np.float64], intervals: int) -> NDArray[np.intp]:
    """Return increasing indices of points (n,): of each interval the largest `size`, and one that is like any other."""
    count = len(size)
    per_interval = -(-count // intervals) if count else 1
    if per_interval <= 2:
        return np.arange(count)
    starts = np.arange(0, count, per_interval)
    padded = np.full(len(starts) * per_interval, -np.inf)
    padded[:count] = np.where(np.isfinite(size), size, -np.inf)
    largest = starts + np.argmax(padded.reshape(-1, per_interval), axis=1)
    return np.unique(np.minimum(np.concatenate([starts, largest]), count - 1))
