"""The lanes: the filter, which is published, and the humble lane, which judges it (`integrity.humble_lane`).

Each is a record of its own in one array, so that all kernels serve both; the humble lane uses the core alone, and what
the measurements of GNSS need.
"""

from __future__ import annotations

from eskf_ros.compiled import njit

FILTER = 0
"""Index of the filter among the lanes."""

HUMBLE = 1
"""Index of the humble lane."""

LANES = 2
"""Number of the lanes."""


@njit
def is_running(states):
    """Say whether the humble lane runs: it has started from the filter since the heading of that was set last."""
    state, humble = states[FILTER], states[HUMBLE]
    return (
        state.heading_known == 1
        and humble.heading_known == 1
        and humble.restarts == state.restarts
        and humble.heading.given_stamp == state.heading.given_stamp
    )
