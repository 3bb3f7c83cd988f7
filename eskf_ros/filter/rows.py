"""The rows of all measurements, in the order of their streams."""

from __future__ import annotations

from eskf_ros.filter.fuse import MEASUREMENTS
from eskf_ros.filter.tight import pseudorange, range_rate

ROWS = tuple(sorted((*MEASUREMENTS, pseudorange.ROW, range_rate.ROW), key=lambda row: row.stream))
"""The facts of each measurement, from `GNSS_POSITION` on."""

SENSORS = tuple(row for row in ROWS if row.is_sent)
"""Measurements that a sensor sends as values with covariances. What a GNSS receiver sends has intakes of its own."""

CONSTRAINTS = tuple(row for row in ROWS if row.is_enabled)
"""Constraints, which no sensor sends."""
