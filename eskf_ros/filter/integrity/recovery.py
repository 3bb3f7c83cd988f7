"""Recovery: decide who is right when a receiver and the filter disagree, and reset the one that is wrong.

The fix tracker (`fix_tracker`) judges a receiver by its own fixes, without the filter's opinion:

- Fixes scatter more than their covariances claim: their noise is inflated (`gnss_position.noise_factor`).
- Fixes move otherwise than the receiver's velocities (spoofing, multipath): they are not fused while they do.
- Fixes that the filter rejects agree with each other: when they have done so for longer than the filter had been fusing
  before them, they win, and position and velocity are reset to them. The alignment restarts only if resets do not help.

A fix just outside the innovation gate is fused with inflated noise. Where the IMU is worse than its parameters say, the
error of the filter and its standard deviation grow at the same rate: a filter that rejects the first fix outside the
gate would reject all that follow.

A heading that was given (parameter, memory or pose) loses against a dual antenna that has never agreed with it
(`heading_sensors`).

A sudden change of the accuracy that a receiver claims means another kind of solution (single, float, fixed). What was
learnt of the correlated error of the old solution does not hold for the new one.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.first_fix import START_VELOCITY_STD
from eskf_ros.filter.alignment.heading_sensors import reset_given_heading, update_refutation
from eskf_ros.filter.history.records import XX, YY
from eskf_ros.filter.integrity.fix_tracker import is_contradicted, is_fusing, is_live, offset_of_track, patience
from eskf_ros.filter.integrity.restart import reset_alignment
from eskf_ros.filter.measurements.kalman_update import project, update
from eskf_ros.filter.state.augmented_states import reset_augmented
from eskf_ros.filter.state.enums import SENSOR_STREAMS, Phase, Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_CAPACITY, POSITION, SOURCES, VELOCITY
from eskf_ros.filter.state.time import NEVER

RECOVERY = np.dtype(
    [
        ("absolute_stamp", "i8"),
        ("absolute_interval", "i8"),
        ("rejected_fixes", "i8"),
        ("rejected_since", "i8"),
        ("resets", "i8"),
        ("reset_stamp", "i8"),
        ("recent_resets", "i8"),
    ],
    align=True,
)
"""Acceptance of absolute positions (fixes and epochs of pseudoranges), and resets of position and velocity.

``absolute_stamp``, ``absolute_interval``: the last accepted one (ns), and the time from the one before it (ns).
``rejected_fixes``, ``rejected_since``: how many were rejected since then, and the stamp of the first of them (ns).
``resets``: all resets; ``reset_stamp``: the last one (ns); ``recent_resets``: resets in a row, each within
`RESET_HELPS` of the one before.
"""

MEMBERS = 5
"""Rejected fixes, at least, that must agree with each other to win over the filter."""

LEAST_SUPPORT = 1_000_000_000
"""ns; rejected fixes must agree for at least this long to win over the filter, even right after an outage."""

FULL_SUPPORT = 10_000_000_000
"""ns; rejected fixes must agree for as long as the filter had been fusing before them, but no longer than this: a
multipath step is shorter.
"""

AGAINST_INERTIAL = 30_000_000_000
"""ns; rejected fixes must agree for this long if the filter had full support and they contradict its velocity, too."""

INERTIAL_SIGMAS = 5.0
"""Standard deviations by which the track of the fixes must move to contradict the velocity of the filter."""

LAST_RESORT = 60_000_000_000
"""ns; the alignment restarts if neither a fix nor a GNSS velocity was accepted for this long while fixes came."""

RESETS = 3
"""Resets in a row without lasting success after which the alignment restarts."""

RESET_HELPS = 20_000_000_000
"""ns; a reset has helped if the next one comes later than this."""

RESTART_HELPS = 300_000_000_000
"""ns; if resets still do not help within this time after a restart, the alignment is not the cause: it stays."""

NEAR_GATE = 4.0
"""Multiple of the gate (in NIS; 4 is twice the innovation) up to which a fix is weighed down: the filter may be
overconfident. Further outside, the fix is taken for wrong and rejected.
"""

REJECTED_PRESSURE = 5_000_000_000
"""ns; when no pressure has been accepted for longer, the offset of the pressure altitude is reset."""

NOTHING_PASSES = -1.0
"""Innovation gate (NIS) that no measurement passes, because a NIS is never negative: for contradicted fixes."""

SAME_SOLUTION = 4.0
"""Largest ratio of the variances of two consecutive fixes of the same kind of solution."""


@njit
def reset_for_new_solution(state, aid, settings):
    """Reset the learnt scatter and the correlated error of fixes when the receiver changes its kind of solution."""
    if aid.stream != Stream.GNSS_POSITION:
        return
    variance = aid.payload[XX] + aid.payload[YY]
    last = state.window.last_fix_variance[aid.source]
    if max(variance, last) > SAME_SOLUTION * min(variance, last):
        state.tracker.scatter[aid.source] = 1.0
        if settings.position_error_at < state.error_size and settings.correlated_share > 0.0:
            reset_augmented(state, settings.position_error_at, 3, settings)
    state.window.last_fix_variance[aid.source] = variance


@njit
def phase_of(state, stream, source):
    """Return the `Phase` of a stream and source at the stamp of the state."""
    if state.streams.last_stamp[stream, source] == NEVER:
        return Phase.WAITING
    if not is_live(state, stream, source):
        return Phase.OUTAGE
    if not is_fusing(state, stream, source):
        return Phase.REACQUIRING
    if state.streams.rejected[stream, source] > 0:
        return Phase.SUSPICIOUS
    if state.streams.fused_stamp[stream, source] - state.streams.fused_since[stream, source] < FULL_SUPPORT:
        is_after_reset = (
            stream == Stream.GNSS_POSITION and state.recovery.reset_stamp == state.streams.fused_since[stream, source]
        )
        return Phase.RESET if is_after_reset else Phase.REACQUIRING
    return Phase.FUSING


@njit
def gate_of(state, aid, size, settings):
    """Return the innovation gate of a measurement: the largest NIS that is accepted."""
    if aid.stream == Stream.GNSS_POSITION and is_contradicted(state, aid.source):
        return NOTHING_PASSES
    return settings.gate[aid.stream, size]


@njit
def recover(state, aid, size, gate, settings, work):
    """Decide what follows from the verdict of an update, and count it; rejected fixes that agree may win.

    ``gate`` is the one of this update, ``size`` the number of scalars in ``work``. When pressures have been rejected
    for `REJECTED_PRESSURE`, a door or a fan has changed the pressure for good: the offset is reset, so that the
    barometer says nothing of the height, but soon again of its changes.
    """
    stream, source = aid.stream, aid.source
    if stream >= SENSOR_STREAMS:
        return
    if stream == Stream.GNSS_POSITION and gate == NOTHING_PASSES:
        aid.verdict = Verdict.CONTRADICTED
    elif stream == Stream.GNSS_POSITION and aid.verdict == Verdict.GATE:
        if has_won(state, source):
            reset_to_fixes(state, source, settings, work)
            aid.verdict = Verdict.RESET
        elif aid.nis <= NEAR_GATE * gate:
            update_weighed_down(state, size, aid.nis / gate, work)
            aid.verdict = Verdict.WEIGHED_DOWN
    elif stream == Stream.HEADING and aid.verdict == Verdict.GATE and update_refutation(state, aid, settings, work):
        if reset_given_heading(state, aid, settings, work):
            aid.verdict = Verdict.RESET
        else:
            reset_alignment(state)
    elif stream == Stream.HEADING and aid.verdict == Verdict.FUSED:
        state.heading.disputed = 0
    is_lasting = state.stamp - state.streams.fused_stamp[stream, source] > REJECTED_PRESSURE
    if stream == Stream.BARO and aid.verdict == Verdict.GATE and is_lasting:
        reset_augmented(state, settings.baro_offset_at, 1, settings)
    note(state, stream, source, aid.verdict)
    if stream == Stream.GNSS_POSITION and is_lost(state):
        reset_alignment(state)


@njit
def note_epoch(state, verdict):
    """Count the verdict of most pseudoranges of an epoch; restart the alignment if the filter is lost."""
    note(state, Stream.PSEUDORANGE.value, 0, verdict)
    if is_lost(state):
        reset_alignment(state)


@njit
def update_weighed_down(state, size, excess, work):
    """Fuse the measurement in ``work``, its NIS ``excess`` times the gate, with noise that brings it onto the gate."""
    project(state, size, work)
    for a in range(size):
        for b in range(size):
            work.noise[a, b] += (excess - 1.0) * work.innovation_covariance[a, b]
    update(state, size, math.inf, work)


@njit
def note(state, stream, source, verdict):
    """Update the stamps and counters of a stream and source with the verdict of its newest measurement."""
    last = state.streams.last_stamp[stream, source]
    if last != NEVER:
        interval = state.streams.interval[stream, source]
        passed = state.stamp - last
        state.streams.interval[stream, source] = passed if interval == 0 else min(passed, 2 * interval)
    if verdict in (Verdict.FUSED, Verdict.RESET):
        if verdict == Verdict.RESET or not is_fusing(state, stream, source):
            state.streams.fused_since[stream, source] = state.stamp
        state.streams.fused_stamp[stream, source] = state.stamp
        state.streams.rejected[stream, source] = 0
        if stream in (Stream.GNSS_POSITION, Stream.PSEUDORANGE):
            if state.recovery.absolute_stamp != NEVER:
                state.recovery.absolute_interval = state.stamp - state.recovery.absolute_stamp
            state.recovery.absolute_stamp = state.stamp
            state.recovery.rejected_fixes = 0
            for k in range(SOURCES):
                state.tracker.rejected[k] = 0
    else:
        state.streams.rejected[stream, source] += 1
        if stream in (Stream.GNSS_POSITION, Stream.PSEUDORANGE):
            if state.recovery.rejected_fixes == 0:
                state.recovery.rejected_since = state.stamp
            state.recovery.rejected_fixes += 1
        if stream == Stream.GNSS_POSITION:
            if verdict == Verdict.CONTRADICTED:
                state.tracker.rejected[source] = 0
            elif state.tracker.misses[source] == 0:
                if state.tracker.rejected[source] == 0:
                    state.tracker.rejected_since[source] = state.stamp
                state.tracker.rejected[source] += 1
    state.streams.last_stamp[stream, source] = state.stamp


@njit
def has_won(state, source):
    """Say whether the rejected fixes of a receiver have agreed with each other for long enough to reset the filter."""
    if (
        state.tracker.misses[source] > 0
        or state.tracker.rejected[source] + 1 < MEMBERS
        or is_contradicted(state, source)
    ):
        return False
    since, last = state.tracker.rejected_since[source], state.recovery.absolute_stamp
    needed = LEAST_SUPPORT
    if last != NEVER and since - last <= patience(state, Stream.GNSS_POSITION.value, source):
        support = last - state.streams.fused_since[Stream.GNSS_POSITION.value, source]
        needed = min(max(support, LEAST_SUPPORT), FULL_SUPPORT)
        if needed == FULL_SUPPORT and is_against_inertial(state, source):
            needed = AGAINST_INERTIAL
    return state.stamp - since >= needed


@njit
def is_against_inertial(state, source):
    """Say whether the fixes of a receiver contradict the velocity of the filter, too, which the IMU supports."""
    if is_live(state, Stream.GNSS_VELOCITY.value, source):
        return not is_fusing(state, Stream.GNSS_VELOCITY.value, source)
    for i in range(3):
        known = state.tracker.rate_variance[source, i] + state.covariance[VELOCITY + i, VELOCITY + i]
        if state.tracker.rate[source, i] ** 2 > INERTIAL_SIGMAS**2 * known:
            return True
    return False


@njit
def reset_to_fixes(state, source, settings, work):
    """Reset position and velocity to the track of a receiver; attitude and biases stay as they are.

    The variance of the position is at least that of one fix, because errors of fixes are correlated. The velocity stays
    while the receiver's velocities are accepted. Otherwise it is that of the track or, if the receiver sends
    velocities, its variance is opened to `START_VELOCITY_STD` for the next one.
    """
    covariance = state.covariance
    reset_error(covariance, POSITION)
    # The noise lacks the correlated share of the variance of a fix; the error of the reset position contains it.
    whole = 1.0 / (1.0 - settings.correlated_share) if settings.position_error_at < state.error_size else 1.0
    for i in range(3):
        state.position_map[i] += offset_of_track(state, source, i)
        covariance[POSITION + i, POSITION + i] = max(state.tracker.offset_variance[source, i], whole * work.noise[i, i])
    if not is_fusing(state, Stream.GNSS_VELOCITY.value, source):
        reset_error(covariance, VELOCITY)
        is_led = is_live(state, Stream.GNSS_VELOCITY.value, source)
        for i in range(3):
            p, v = POSITION + i, VELOCITY + i
            covariance[v, v] = START_VELOCITY_STD**2
            if not is_led:
                state.velocity_map[i] += state.tracker.rate[source, i]
                covariance[v, v] = state.tracker.rate_variance[source, i]
                covariance[p, v] = state.tracker.mixed_variance[source, i]
                covariance[v, p] = state.tracker.mixed_variance[source, i]
    if settings.position_error_at < state.error_size:
        reset_augmented(state, settings.position_error_at, 3, settings)
    is_recent = state.recovery.reset_stamp != NEVER and state.stamp - state.recovery.reset_stamp < RESET_HELPS
    state.recovery.recent_resets = state.recovery.recent_resets + 1 if is_recent else 1
    state.recovery.reset_stamp = state.stamp
    state.recovery.resets += 1


@njit
def reset_error(covariance, place):
    """Zero the variances and correlations of the three errors from index ``place``."""
    for i in range(place, place + 3):
        for j in range(ERROR_CAPACITY):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0


@njit
def is_lost(state):
    """Say whether only a new alignment can help: resets did not, or neither fixes nor velocities are accepted."""
    is_new = state.restarts > 0 and state.stamp - state.first_stamp < RESTART_HELPS
    if state.recovery.recent_resets >= RESETS:
        return not is_new
    since = state.recovery.rejected_since
    for source in range(SOURCES):
        since = max(since, state.streams.fused_stamp[Stream.GNSS_VELOCITY.value, source])
    return state.recovery.rejected_fixes >= MEMBERS and state.stamp - since >= LAST_RESORT
