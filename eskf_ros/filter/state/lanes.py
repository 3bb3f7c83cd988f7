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
    """Say whether the humble lane runs: to judge the filter, or without the heading of that, which is on trial."""
    return is_judging(states) or (states[FILTER].heading_known == 1 and states[FILTER].trial.is_on == 1)


@njit
def is_judging(states):
    """Say whether the humble lane judges the filter: it has started since the heading of that was set last."""
    state, humble = states[FILTER], states[HUMBLE]
    return (
        state.heading_known == 1
        and state.trial.is_on == 0
        and humble.heading_known == 1
        and humble.restarts == state.restarts
        and humble.heading.given_stamp == state.heading.given_stamp
    )
