"""A message of a GNSS receiver: whether it is believed, how much, and what follows for the filter.

The humble lane (`humble_lane`) says whether a message jumps. One that does not is fused; where the filter did not
expect it, with noise that brings it onto the innovation gate. One that jumps is refused until it has persisted. Where
the heading is unknown there is no humble lane: the filter, whose noise is wide then, judges for itself.

How much messages scatter about the humble lane decides with how much noise they are fused (`scatter`, `fix_errors`).
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading_sensors import confirm_given_heading, reset_to_unknown_heading
from eskf_ros.filter.history.records import XX, YY
from eskf_ros.filter.integrity.fault_effects import write_effect
from eskf_ros.filter.integrity.fix_errors import (
    follow_calm_error,
    forget_spread,
    note_claims,
    propagate_walk,
    reset_scatter,
    update_shares,
)
from eskf_ros.filter.integrity.heading_corrections import HEADING, forget_corrections, weigh_correction
from eskf_ros.filter.integrity.heading_trial import refute_heading, reset_to_found_heading, update_trial
from eskf_ros.filter.integrity.humble_lane import (
    hear,
    linearize,
    reset_to_humble_lane,
    reset_to_message,
    start,
    weigh_evidence,
)
from eskf_ros.filter.integrity.recovery import note, note_reset
from eskf_ros.filter.integrity.refusal import (
    IMU_ASTRAY,
    JUMP_GATE,
    RECEIVER_STEPPED,
    is_other_refused,
    kind_of,
    note_jump,
)
from eskf_ros.filter.integrity.refused_motion import update_with_refused_fix
from eskf_ros.filter.integrity.scatter import (
    copy_scatter,
    learn_from_change,
    learn_from_fix,
    learn_from_velocity,
    learn_walk,
)
from eskf_ros.filter.measurements.kalman_update import apply, judge, project, update
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.lanes import FILTER, HUMBLE, is_judging
from eskf_ros.filter.state.streams import is_live
from eskf_ros.filter.state.time import NEVER

LOST_HEADING_STD = 0.95
"""rad; a heading that is known no better is unknown."""

SAME_SOLUTION = 4.0
"""Largest ratio of the variances of two consecutive fixes of the same kind of solution."""


@njit
def reset_for_new_solution(states, aid, settings, work):
    """Reset the learnt scatter and the correlated error of fixes when the receiver changes its kind of solution.

    A sudden change of the accuracy that it claims means another kind (single, float, fixed): what was learnt of the
    errors of the old solution does not hold for the new one.
    """
    if aid.stream != Stream.GNSS_POSITION:
        return
    state, variance = states[FILTER], aid.payload[XX] + aid.payload[YY]
    last = state.window.last_fix_variance[aid.source]
    if max(variance, last) > SAME_SOLUTION * min(variance, last):
        linearize(state, aid, settings, work)
        reset_scatter(state, states[HUMBLE], aid.source, variance < last, settings, work)
    state.window.last_fix_variance[aid.source] = variance


@njit
def fuse_receiver(states, aid, gate, settings, work):
    """Fuse or refuse a position or velocity of GNSS; ``gate`` is the innovation gate of the filter (NIS)."""
    state, humble = states[FILTER], states[HUMBLE]
    reset_lost_heading(state)
    update_trial(states, settings)
    start(states, settings)
    is_position = aid.stream == Stream.GNSS_POSITION
    if is_position:
        propagate_walk(state, state, aid.source)
    is_wrong_heading = refute_heading(states, aid, gate, settings, work)
    heard, jumps, believed, humble_nis, humble_log = judge_with_humble_lane(states, aid, gate, settings, work)
    size = linearize(state, aid, settings, work)
    write_effect(state, aid, work, settings)
    if is_position:
        note_claims(state, aid.source, settings, work)
    for k in range(size):
        aid.innovation[k] = work.innovation[k]
    aid.dof = size
    aid.nis, determinant = judge(state, size, work)
    heading_variance = state.covariance[HEADING, HEADING]
    if determinant == 0.0:
        aid.verdict = Verdict.BAD_COVARIANCE
    elif aid.nis <= gate:
        apply(state, size, work)
        aid.verdict = Verdict.FUSED
        confirm_given_heading(state)
    elif jumps:
        aid.verdict = Verdict.CONTRADICTED if is_contradicted(state, aid) else Verdict.GATE
    elif heard or aid.nis <= JUMP_GATE:
        update_weighed_down(state, size, aid.nis / gate, work)
        aid.verdict = Verdict.WEIGHED_DOWN
    else:
        aid.verdict = Verdict.GATE
        believed = note_jump(state, aid, kind_of(aid.stream), work)
        if believed:
            reset_to_message(state, state.trust, aid, True, work)
            linearize(state, aid, settings, work)
            update(state, size, math.inf, work)
    if is_position and aid.verdict != Verdict.BAD_COVARIANCE:
        is_fused = believed != 0 or aid.verdict in (Verdict.FUSED, Verdict.WEIGHED_DOWN)
        learn_in_filter(state, aid, is_fused, believed, settings, work)
    if heard and not jumps and not believed and determinant > 0.0:
        drifts = weigh_correction(state, heading_variance, work.correction[HEADING])
        worse = weigh_evidence(states, aid, aid.nis, math.log(determinant), humble_nis, humble_log, settings)
        if worse or drifts:
            reset_to_humble_lane(states, drifts, work)
            aid.verdict = Verdict.TAKEOVER
    if believed:
        aid.verdict = Verdict.RESET
        note_reset(state)
    if is_wrong_heading:
        reset_to_found_heading(states)
        aid.verdict = Verdict.TAKEOVER
    if aid.verdict in (Verdict.RESET, Verdict.TAKEOVER):
        forget_corrections(state)
        forget_spread(state, humble, settings)
    note(state, aid.stream, aid.source, aid.verdict)
    if not heard:
        # A lane that starts now has its own noise over an outage that may follow.
        start(states, settings)


@njit
def reset_lost_heading(state):
    """Search for the heading where a gyro that did not measure has left none that a linear filter could correct."""
    is_lost = state.heading_known == 1 and state.covariance[HEADING, HEADING] > LOST_HEADING_STD**2
    if is_lost and state.heading.given_stamp == NEVER:
        reset_to_unknown_heading(state)


@njit
def judge_with_humble_lane(states, aid, gate, settings, work):
    """Let the humble lane hear a message, and learn from it; reset the filter where messages are believed at last.

    Returns whether the lane has heard it, and what `hear` returns.
    """
    state, humble = states[FILTER], states[HUMBLE]
    if not is_judging(states):
        return False, False, 0, 0.0, 0.0
    is_position = aid.stream == Stream.GNSS_POSITION
    if is_position:
        propagate_walk(state, humble, aid.source)
    copy_scatter(state, humble, aid.source)
    jumps, believed, nis, log_determinant = hear(states, aid, gate, settings, work)
    if believed == IMU_ASTRAY and state.heading.given_stamp != NEVER:
        reset_to_unknown_heading(state)
        humble.heading_known = 0
        linearize(state, aid, settings, work)
        reset_to_message(state, state.trust, aid, True, work)
    elif believed == IMU_ASTRAY:
        reset_to_humble_lane(states, is_other_refused(state, aid.stream, aid.source), work)
    elif believed == RECEIVER_STEPPED:
        linearize(state, aid, settings, work)
        reset_to_message(state, state.trust, aid, False, work)
    if humble.heading_known == 0:
        return False, jumps, believed, nis, log_determinant
    if jumps and is_position:
        update_with_refused_fix(state, aid, settings, work)
        linearize(humble, aid, settings, work)
        learn_from_change(state, humble, aid.source, False, settings, work)
        update_shares(state, humble, aid.source, settings, work)
    elif not jumps and not believed:
        learn(state, humble, aid, nis, settings, work)
    return True, jumps, believed, nis, log_determinant


@njit
def learn_in_filter(state, aid, is_fused, believed, settings, work):
    """Learn from a fix in the filter, after its update, how far the position follows the fixes and how they walk.

    While the heading is unknown the filter also takes the part of the humble lane, but for messages that are
    ``believed`` after many were refused.
    """
    if is_fused:
        follow_calm_error(state, aid.source, work)
        learn_walk(state, aid.source, settings, work)
    if state.heading_known == 0 and not believed:
        learn_from_change(state, state, aid.source, is_fused, settings, work)
        update_shares(state, state, aid.source, settings, work)


@njit
def learn(state, humble, aid, nis, settings, work):
    """Learn from a message that the humble lane has heard how the receiver scatters; its NIS there is ``nis``."""
    if aid.stream == Stream.GNSS_VELOCITY:
        learn_from_velocity(state, aid.source, nis)
        return
    learn_from_fix(state, humble, aid.source, settings, work)
    update_shares(state, humble, aid.source, settings, work)


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
