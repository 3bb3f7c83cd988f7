"""Recovery: a fix not far outside the gate corrects a little; when fix after fix is outside, the filter starts again.

Where the IMU was worse than its parameters say, a filter that ignores the first fix outside the gate ignores all that
follow: its error and its sigma grow alike.

A receiver whose accuracy changes at once has another kind of solution (single, float, fixed), and what lasted in the
error of the old one says nothing about the new one.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment import restart
from eskf_ros.filter.layout import NEVER, Verdict
from eskf_ros.filter.optional import renew
from eskf_ros.filter.update import project, update

FUSED = int(Verdict.FUSED)
GATE = int(Verdict.GATE)
WEIGHED_DOWN = int(Verdict.WEIGHED_DOWN)

REJECTED_FIXES = 5
REJECTED_TIME = 5_000_000_000
"""So many fixes in a row, over at least this long (ns), outside the gate: more than an outlier or a multipath step."""

NEAR_GATE = 4.0
"""Up to so many times the gate (twice the innovation) a filter may be too sure of itself; beyond, the fix is wrong."""


SAME_SOLUTION = 4.0
"""A variance changes by no more than this factor from one fix to the next of the same kind of solution."""


@njit
def watch_solution(state, aid, settings):
    """Begin again with the lasting error of the fixes when the receiver changes its kind of solution."""
    variance = aid.payload[3] + aid.payload[6]
    last = state.last_fix_variance[aid.source]
    lasts = settings.position_error_at < state.error_size and settings.correlated_share > 0.0
    if lasts and max(variance, last) > SAME_SOLUTION * min(variance, last):
        renew(state, settings.position_error_at, 3, settings)
    state.last_fix_variance[aid.source] = variance


@njit
def judge_pressure(state, verdict, settings):
    """Begin again with the offset of the barometer when what it says was outside the gate for long.

    A door or a fan has changed the pressure for good: it says nothing of the height, but soon again of its changes.
    """
    if verdict == GATE and state.stamp - state.baro_stamp > REJECTED_TIME:
        renew(state, settings.baro_offset_at, 1, settings)
    if verdict == FUSED:
        state.baro_stamp = state.stamp


@njit
def is_near_gate(verdict, nis, gate):
    """Say whether a rejected fix is close enough to the gate to be weighed down instead."""
    return verdict == GATE and nis <= NEAR_GATE * gate


@njit
def update_weighed_down(state, size, excess, work):
    """Fuse what ``work`` describes with so much more noise that its NIS, ``excess`` gates, is on the gate."""
    project(state, size, work)
    for a in range(size):
        for b in range(size):
            work.noise[a, b] += (excess - 1.0) * work.innovation_covariance[a, b]
    update(state, size, math.inf, work)
    return WEIGHED_DOWN


@njit
def judge_filter(state, verdict):
    """Count what became of the latest fix; restart the alignment when too many in a row were rejected."""
    if verdict == FUSED:
        if state.absolute_stamp != NEVER:
            state.absolute_interval = state.stamp - state.absolute_stamp
        state.absolute_stamp = state.stamp
        state.rejected_fixes = 0
    elif verdict in (GATE, WEIGHED_DOWN):
        state.rejected_fixes += 1
        if state.rejected_fixes >= REJECTED_FIXES and state.stamp - state.absolute_stamp >= REJECTED_TIME:
            restart(state)
