"""A message of a GNSS receiver: whether it is believed, how much, and what follows for the filter.

The humble lane (`humble_lane`) says whether a message jumps. One that does not is fused; where the filter did not
expect it, with noise that brings it onto the innovation gate. One that jumps is refused until it has persisted. Where
the heading is unknown there is no humble lane: the filter, whose noise is wide then, judges for itself.

Fixes that scatter about the humble lane by more than their covariances claim are fused with inflated noise.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, YY
from eskf_ros.filter.integrity.humble_lane import (
    compare,
    hear,
    kind_of,
    linearize,
    note_jump,
    reset_to_humble_lane,
    reset_to_message,
    start,
)
from eskf_ros.filter.integrity.recovery import note, note_reset
from eskf_ros.filter.measurements.gnss_position import noise_factor
from eskf_ros.filter.measurements.kalman_update import apply, judge, project, update
from eskf_ros.filter.state.augmented_states import reset_augmented
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import POSITION, SOURCES
from eskf_ros.filter.state.lanes import FILTER, HUMBLE, is_running
from eskf_ros.filter.state.streams import is_live

SCATTER = np.dtype([("ratio", "f8", (SOURCES,)), ("paid", "f8", (SOURCES,))], align=True)
"""Scatter of the fixes about the humble lane, by source.

``ratio``: mean square over what the covariances allow. ``paid``: the noise factor for which the position was widened
last.
"""

SCATTER_GAIN = 0.08
"""Weight of the newest fix in the running mean of the scatter."""

SCATTER_CLIP = 4.0
"""One fix counts with at most this many times the present scatter."""

LARGEST_SCATTER = 100.0
"""Largest noise factor: fixes that scatter ten times as much as they claim are used for what they are."""

SCATTER_GROWTH = 4.0
"""Growth of the noise factor that widens the position once more. A single step aside and back does not reach it."""

SAME_SOLUTION = 4.0
"""Largest ratio of the variances of two consecutive fixes of the same kind of solution."""


@njit
def reset_for_new_solution(state, aid, settings):
    """Reset the learnt scatter and the correlated error of fixes when the receiver changes its kind of solution.

    A sudden change of the accuracy that it claims means another kind (single, float, fixed): what was learnt of the
    errors of the old solution does not hold for the new one.
    """
    if aid.stream != Stream.GNSS_POSITION:
        return
    variance = aid.payload[XX] + aid.payload[YY]
    last = state.window.last_fix_variance[aid.source]
    if max(variance, last) > SAME_SOLUTION * min(variance, last):
        state.scatter.ratio[aid.source] = 1.0
        if settings.position_error_at < state.error_size and settings.correlated_share > 0.0:
            reset_augmented(state, settings.position_error_at, 3, settings)
    state.window.last_fix_variance[aid.source] = variance


@njit
def fuse_receiver(states, aid, gate, settings, work):
    """Fuse or refuse a position or velocity of GNSS; ``gate`` is the innovation gate of the filter (NIS)."""
    state, humble = states[FILTER], states[HUMBLE]
    start(states)
    heard = is_running(states)
    jumps, believed, humble_nis, humble_log = False, False, 0.0, 0.0
    if heard:
        humble.scatter.ratio[aid.source] = state.scatter.ratio[aid.source]
        jumps, believed, humble_nis, humble_log = hear(states, aid, settings, work)
        if believed:
            reset_to_humble_lane(states, settings)
    size = linearize(state, aid, settings, work)
    for k in range(size):
        aid.innovation[k] = work.innovation[k]
    aid.dof = size
    aid.nis, determinant = judge(state, size, work)
    if determinant == 0.0:
        aid.verdict = Verdict.BAD_COVARIANCE
    elif aid.nis <= gate:
        apply(state, size, work)
        aid.verdict = Verdict.FUSED
    elif jumps:
        aid.verdict = Verdict.CONTRADICTED if is_contradicted(state, aid) else Verdict.GATE
    elif heard:
        update_weighed_down(state, size, aid.nis / gate, work)
        aid.verdict = Verdict.WEIGHED_DOWN
    elif note_jump(state, state, aid, kind_of(aid.stream), work):
        reset_to_message(state, state, kind_of(aid.stream), aid.source, work)
        linearize(state, aid, settings, work)
        update(state, size, math.inf, work)
        believed = True
    else:
        aid.verdict = Verdict.GATE
    if heard and not jumps and not believed:
        if aid.stream == Stream.GNSS_POSITION:
            inflate_position_for_scatter(state, aid.source, humble_nis, work)
        if compare(states, aid, aid.nis, math.log(determinant), humble_nis, humble_log, settings):
            aid.verdict = Verdict.TAKEOVER
    if believed:
        aid.verdict = Verdict.RESET
        note_reset(state)
    note(state, aid.stream, aid.source, aid.verdict)


@njit
def is_contradicted(state, aid):
    """Say whether a refused position jumps while the velocities of the same receiver do not."""
    has_velocity = is_live(state, Stream.GNSS_VELOCITY.value, aid.source) and state.trust.refused[1, aid.source] == 0
    return aid.stream == Stream.GNSS_POSITION and has_velocity


@njit
def update_weighed_down(state, size, excess, work):
    """Fuse the measurement in ``work``, its NIS ``excess`` times the gate, with noise that brings it onto the gate."""
    project(state, size, work)
    for a in range(size):
        for b in range(size):
            work.noise[a, b] += (excess - 1.0) * work.innovation_covariance[a, b]
    update(state, size, math.inf, work)


@njit
def inflate_position_for_scatter(state, source, nis, work):
    """Learn the scatter of the fixes about the humble lane; widen the position if they were trusted too much before.

    ``nis`` is that of the newest fix in the humble lane. The running mean of the scatter is the factor on the variances
    that the fixes claim (`gnss_position.noise_factor`). Whenever this factor has grown by `SCATTER_GROWTH`, the
    variance of the position gains up to that of one fix, because earlier fixes were fused with too small a variance.
    """
    scatter = state.scatter
    factor = noise_factor(state, source)
    found = min(factor * nis / 3.0, SCATTER_CLIP * max(scatter.ratio[source], 1.0))
    scatter.ratio[source] = min(scatter.ratio[source] + SCATTER_GAIN * (found - scatter.ratio[source]), LARGEST_SCATTER)
    paid = scatter.paid[source]
    if factor == 1.0:
        scatter.paid[source] = 1.0
    elif factor > SCATTER_GROWTH * paid:
        for i in range(3):
            state.covariance[POSITION + i, POSITION + i] += (1.0 - paid / factor) * work.noise[i, i]
        scatter.paid[source] = factor
