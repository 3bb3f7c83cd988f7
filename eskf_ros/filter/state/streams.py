"""Streams of measurements: when they come, and when they were accepted."""

from __future__ import annotations

import numpy as np

from eskf_ros.filter.state.enums import SENSOR_STREAMS
from eskf_ros.filter.state.error_state import SOURCES

STREAMS = np.dtype(
    [
        ("last_stamp", "i8", (SENSOR_STREAMS, SOURCES)),
        ("interval", "i8", (SENSOR_STREAMS, SOURCES)),
        ("fused_stamp", "i8", (SENSOR_STREAMS, SOURCES)),
        ("fused_since", "i8", (SENSOR_STREAMS, SOURCES)),
        ("rejected", "i8", (SENSOR_STREAMS, SOURCES)),
    ],
    align=True,
)
"""By stream and source: the last measurement and the usual interval (ns), the last accepted one and since when they
are,
and how many were rejected in a row.
"""
