"""One row of a table on its way into the filter: the same for `eskf_ros.run`, the campaigns and the tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.rows import ROWS

Array = NDArray[np.float64]

WIDTH = 14
"""Numbers in a row: three values, nine of their covariance, and for a fix its covariance type and status."""

STREAMS = {row.name: row.stream for row in ROWS if row.columns}
"""Streams by the names of the tables."""


def rows_from(values: Array, covariance: Array, covariance_type: Array | int = 2, status: Array | int = 0) -> Array:
    """Return rows (n, 14) of values (n, 3) with covariances (n, 9), (n, 3, 3), or (9,) for all of them."""
    rows = np.empty((len(values), WIDTH))
    rows[:, :3] = values
    rows[:, 3:12] = np.reshape(covariance, (-1, 9))
    rows[:, 12], rows[:, 13] = covariance_type, status
    return rows


def push_row(navigator: Navigator, name: str, stamp: int, row: Array, arrival: int) -> None:
    """Give one row (14,) of the table ``name`` to the filter; ``stamp`` and ``arrival`` in ns."""
    if name == "gnss_position":
        position = float(row[0]), float(row[1]), float(row[2])
        navigator.push_gnss_position(stamp, *position, row[3:12], int(row[12]), int(row[13]), arrival)
    elif name == "gnss_velocity":
        navigator.push_gnss_velocity(stamp, row[:3].tolist(), row[3:12], arrival)
    else:
        navigator.push(STREAMS[name], stamp, row[:3].tolist(), row[3:12], arrival)
