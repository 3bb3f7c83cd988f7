"""Streams of measurements: when their messages come, and when they are accepted."""

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
"""Arrival and acceptance by stream and source.

``last_stamp``, ``interval``: the last measurement (ns), and the usual time between two (ns). ``fused_stamp``,
``fused_since``: the last accepted one (ns), and since when they have been accepted (ns). ``rejected``: rejections in a
row.
"""
