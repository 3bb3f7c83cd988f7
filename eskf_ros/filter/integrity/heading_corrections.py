"""Corrections of the heading by GNSS: where the model holds, those of one time say nothing of those of the next.

The updates of a consistent filter correct the heading by white increments, whose variance is the decrease of the
variance of the heading (Kailath, An innovations approach to least-squares estimation, 1968). A gyro whose bias wanders,
or whose scale is wrong, shows in corrections that go one way, long before the innovations themselves are large.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.state.error_state import ATTITUDE
from eskf_ros.filter.state.time import NEVER

HEADING = ATTITUDE + 2
"""Index of the error of the heading: the turn about the z axis of map."""

CORRECTIONS = np.dtype(
    [("since", "i8"), ("total", "f8"), ("variance", "f8"), ("left", "f8"), ("right", "f8")],
    align=True,
)
"""Corrections of the heading since ``since`` (ns): their sum (rad) and the variance of that (rad2); and the CUSUM of
such sums, in standard deviations, to the left and to the right."""

WINDOW = 5_000_000_000
"""ns; corrections are summed up over this time: errors of velocities last for a second or so."""

ALLOWANCE = 1.0
"""Standard deviations of each sum that count for nothing: receivers smooth their velocities."""

LIMIT = 8.0
"""Standard deviations, the allowance taken off, from which on corrections go one way."""


@njit
def forget_corrections(state):
    """Begin anew: the estimate was reset."""
    state.corrections.since = NEVER
    state.corrections.left = 0.0
    state.corrections.right = 0.0


@njit
def weigh_correction(state, before, correction):
    """Add a correction (rad) of the heading, whose variance was ``before`` (rad2); say whether they go one way."""
    c = state.corrections
    if c.since == NEVER or state.stamp - c.since > WINDOW:
        if c.since != NEVER and c.variance > 0.0:
            sigmas = c.total / math.sqrt(c.variance)
            c.left = max(0.0, c.left + sigmas - ALLOWANCE)
            c.right = max(0.0, c.right - sigmas - ALLOWANCE)
        c.since = state.stamp
        c.total = 0.0
        c.variance = 0.0
    c.total += correction
    c.variance += max(before - state.covariance[HEADING, HEADING], 0.0)
    return one_way(state) > LIMIT


@njit
def one_way(state):
    """Return how far the corrections go one way (standard deviations, the allowance taken off)."""
    return max(state.corrections.left, state.corrections.right)
