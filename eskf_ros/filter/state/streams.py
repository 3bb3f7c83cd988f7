"""Streams of measurements: when their messages come, and when they are accepted."""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.state.enums import SENSOR_STREAMS
from eskf_ros.filter.state.error_state import SOURCES
from eskf_ros.filter.state.time import NEVER

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

SHORTEST_PATIENCE = 1_000_000_000
"""ns; no stream is called silent earlier than this after its last message."""

LONGEST_PATIENCE = 30_000_000_000
"""ns; every stream is called silent later than this after its last message."""

MISSED_INTERVALS = 2.5
"""A stream is silent after this many of its usual intervals without a message, within the two limits above."""


@njit
def patience(state, stream, source):
    """Return the time (ns) after which a silent stream and source counts as lost."""
    usual = MISSED_INTERVALS * state.streams.interval[stream, source]
    return min(max(usual, SHORTEST_PATIENCE), LONGEST_PATIENCE)


@njit
def is_live(state, stream, source):
    """Say whether measurements of a stream and source arrive, accepted or not."""
    last = state.streams.last_stamp[stream, source]
    return last != NEVER and state.stamp - last <= patience(state, stream, source)


@njit
def is_fusing(state, stream, source):
    """Say whether measurements of a stream and source are being accepted."""
    last = state.streams.fused_stamp[stream, source]
    return last != NEVER and state.stamp - last <= patience(state, stream, source)
