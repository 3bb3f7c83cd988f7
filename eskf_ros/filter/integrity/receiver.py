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
from eskf_ros.filter.measurements import gnss_position, gnss_velocity
from eskf_ros.filter.measurements.kalman_update import apply, judge, project, update
from eskf_ros.filter.state.augmented_states import reset_augmented
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import POSITION, SOURCES
from eskf_ros.filter.state.lanes import FILTER, HUMBLE, is_running
from eskf_ros.filter.state.streams import is_live

SCATTER = np.dtype(
    [
        ("ratio", "f8", (2, SOURCES)),
        ("paid", "f8", (SOURCES,)),
        ("last_stamp", "i8", (SOURCES,)),
        ("last_innovation", "f8", (SOURCES, 3)),
    ],
    align=True,
)
"""Scatter of the messages of the receivers, by source.

- ``ratio``: mean square of the innovations in the humble lane over what the covariances allow, for positions (0) and
  velocities (1). That of positions is taken from the differences of two fixes: errors that last cancel in them.
- ``paid``: the noise factor for which the position was widened last.
- ``last_stamp``, ``last_innovation``: of the last fix (ns; m, map).
"""

SCATTER_GAIN = 0.08
"""Weight of the newest fix in the running mean of the scatter."""

SCATTER_CLIP = 4.0
"""One fix counts with at most this many times the present scatter."""

LARGEST_SCATTER = 100.0
"""Largest noise factor: fixes that scatter ten times as much as they claim are used for what they are."""

SCATTER_GROWTH = 4.0
"""Growth of the noise factor that widens the position once more. A single step aside and back does not reach it."""

LONGEST_PAIR = 2_500_000_000
"""ns; two fixes further apart than this do not show the scatter: the humble lane drifts between them."""

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
        state.scatter.ratio[0, aid.source] = 1.0
        if settings.position_error_at < state.error_size and settings.correlated_share > 0.0:
            reset_augmented(state, settings.position_error_at, 3, settings)
    state.window.last_fix_variance[aid.source] = variance


@njit
def fuse_receiver(states, aid, gate, settings, work):
    """Fuse or refuse a position or velocity of GNSS; ``gate`` is the innovation gate of the filter (NIS)."""
    state, humble = states[FILTER], states[HUMBLE]
    start(states)
    heard = is_running(states)
    jumps, believed, humble_nis, humble_log, change = False, False, 0.0, 0.0, 0.0
    if heard:
        for kind in range(2):
            humble.scatter.ratio[kind, aid.source] = state.scatter.ratio[kind, aid.source]
        jumps, believed, humble_nis, humble_log = hear(states, aid, settings, work)
        change = innovation_change(state, aid.source, work) if aid.stream == Stream.GNSS_POSITION else humble_nis
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
            learn_scatter(state, 0, aid.source, gnss_position.noise_factor(state, aid.source), change)
            inflate_position_for_scatter(state, aid.source, work)
        else:
            learn_scatter(state, 1, aid.source, gnss_velocity.noise_factor(state, aid.source), change)
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
def innovation_change(state, source, work):
    """Return the NIS (3 axes) of the change of the innovation from the fix before to this one, and remember this one.

    It is negative if the last fix is too long ago. ``work.innovation_covariance`` has been inverted (`judge`): the
    innovations of both fixes have that covariance, and those of a humble lane are nearly independent.
    """
    scatter = state.scatter
    is_next = state.stamp - scatter.last_stamp[source] <= LONGEST_PAIR
    scatter.last_stamp[source] = state.stamp
    nis = 0.0
    for a in range(3):
        for b in range(3):
            change_a = work.innovation[a] - scatter.last_innovation[source, a]
            change_b = work.innovation[b] - scatter.last_innovation[source, b]
            nis += 0.5 * change_a * work.innovation_covariance[a, b] * change_b
    for a in range(3):
        scatter.last_innovation[source, a] = work.innovation[a]
    return nis if is_next else -1.0


@njit
def learn_scatter(state, kind, source, factor, nis):
    """Update the running mean of the scatter of positions (``kind`` 0) or velocities (1) with the newest NIS."""
    if nis < 0.0:
        return
    ratio = state.scatter.ratio[kind, source]
    found = min(factor * nis / 3.0, SCATTER_CLIP * max(ratio, 1.0))
    state.scatter.ratio[kind, source] = min(ratio + SCATTER_GAIN * (found - ratio), LARGEST_SCATTER)


@njit
def inflate_position_for_scatter(state, source, work):
    """Widen the position if fixes were trusted too much before.

    Whenever the noise factor of the fixes has grown by `SCATTER_GROWTH`, the variance of the position gains up to that
    of one fix, because earlier fixes were fused with too small a variance.
    """
    factor, paid = gnss_position.noise_factor(state, source), state.scatter.paid[source]
    if factor == 1.0:
        state.scatter.paid[source] = 1.0
    elif factor > SCATTER_GROWTH * paid:
        for i in range(3):
            state.covariance[POSITION + i, POSITION + i] += (1.0 - paid / factor) * work.noise[i, i]
        state.scatter.paid[source] = factor
