"""All measurements, in the order of their streams: what a message or a constraint can be."""

from __future__ import annotations

from eskf_ros.filter.fuse import MEASUREMENTS
from eskf_ros.filter.tight import pseudorange, range_rate

ROWS = tuple(sorted((*MEASUREMENTS, pseudorange.ROW, range_rate.ROW), key=lambda row: row.stream))
"""The facts of each, from `GNSS_POSITION` on."""

SENSORS = tuple(row for row in ROWS if row.is_sent)
"""Those that a sensor sends as values and covariances. What a GNSS receiver sends has intakes of its own."""

CONSTRAINTS = tuple(row for row in ROWS if row.is_enabled)
"""Those that no sensor sends."""
