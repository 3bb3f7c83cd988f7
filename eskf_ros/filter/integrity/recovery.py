"""Recovery: who is right when a receiver and the filter disagree, and what becomes of the one that is not.

The track of a receiver (see ``track``) answers that without the filter's own opinion:

- Fixes scatter more than they claim: their noise is taken as what it is (``gnss_position.noise_factor``).
- They move otherwise than the receiver's velocities: they are not fused while they do (spoofing, multipath).
- Those that the filter rejects agree with each other: when they have done so for longer than the filter had its own
  support, they win, and position and velocity are reset. The alignment starts again only when that does not help.

A fix not far outside the gate corrects a little: where the IMU was worse than its parameters say, a filter that ignores
the first fix outside the gate ignores all that follow, because its error and its sigma grow alike.

A heading that was given does not hold against a dual antenna that it was never reconciled with (``heading_hints``).

A receiver whose accuracy changes at once has another kind of solution (single, float, fixed), and what lasted in the
error of the old one says nothing about the new one.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.first_fix import START_VELOCITY_STD
from eskf_ros.filter.alignment.heading_sensors import reset_given_heading, update_refutation
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
"""When absolute measurements were last accepted, how many were rejected since and from when on; resets of position and
velocity, the last one, and how often lately.
"""

MEMBERS = 5
LEAST_SUPPORT = 1_000_000_000
FULL_SUPPORT = 10_000_000_000
"""So many rejected fixes must agree with each other to win over the filter, and do so for as long (ns) as it had been
fusing right before them, within these limits: a multipath step is shorter than the full time."""

AGAINST_INERTIAL = 30_000_000_000
INERTIAL_SIGMAS = 5.0
"""... and for this long when they contradict its velocity too, by so many sigma."""

LAST_RESORT = 60_000_000_000
RESETS = 3
RESET_HELPS = 20_000_000_000
"""The alignment starts again when fixes have come in vain for so long (ns), or after so many resets, none of which
helped for so long."""

RESTART_HELPS = 300_000_000_000
"""If after a new alignment, within this time (ns), resets do not help either, alignment is not what is wrong."""

NEAR_GATE = 4.0
"""Up to so many times the gate (twice the innovation) a filter may be too sure of itself; beyond, the fix is wrong."""

REJECTED_PRESSURE = 5_000_000_000
"""So long (ns) pressures are rejected before their offset is taken for another one."""

NOTHING_PASSES = -1.0
"""A gate."""

SAME_SOLUTION = 4.0
"""A variance changes by no more than this factor from one fix to the next of the same kind of solution."""


@njit
def reset_for_new_solution(state, aid, settings):
    """Begin again with what was learnt of the errors of the fixes when the receiver changes its kind of solution."""
    if aid.stream != Stream.GNSS_POSITION:
        return
    variance = aid.payload[3] + aid.payload[6]
    last = state.window.last_fix_variance[aid.source]
    if max(variance, last) > SAME_SOLUTION * min(variance, last):
        state.tracker.scatter[aid.source] = 1.0
        if settings.position_error_at < state.error_size and settings.correlated_share > 0.0:
            reset_augmented(state, settings.position_error_at, 3, settings)
    state.window.last_fix_variance[aid.source] = variance


@njit
def phase_of(state, stream, source):
    """Return the phase of an aid at the stamp of the state."""
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
    """Return the largest normalised innovation squared that is accepted."""
    if aid.stream == Stream.GNSS_POSITION and is_contradicted(state, aid.source):
        return NOTHING_PASSES
    return settings.gate[aid.stream, size]


@njit
def recover(state, aid, size, gate, settings, work):
    """Note what became of a measurement; let rejected ones that agree with each other win over the filter.

    ``gate`` as it was for the update of this measurement, ``size`` scalars described by ``work``. A pressure outside
    its gate for long means that a door or a fan has changed it for good: it says nothing of the height, but soon again
    of its changes.
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
    """Note what became of most pseudoranges of an epoch."""
    note(state, Stream.PSEUDORANGE.value, 0, verdict)
    if is_lost(state):
        reset_alignment(state)


@njit
def update_weighed_down(state, size, excess, work):
    """Fuse what ``work`` describes with so much more noise that its NIS, ``excess`` gates, is on the gate."""
    project(state, size, work)
    for a in range(size):
        for b in range(size):
            work.noise[a, b] += (excess - 1.0) * work.innovation_covariance[a, b]
    update(state, size, math.inf, work)


@njit
def note(state, stream, source, verdict):
    """Keep the times and counts of an aid."""
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
    """Say whether the rejected fixes of a receiver have agreed with each other for long enough."""
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
    """Say whether a receiver contradicts the filter in velocity too, in which the IMU has its say."""
    if is_live(state, Stream.GNSS_VELOCITY.value, source):
        return not is_fusing(state, Stream.GNSS_VELOCITY.value, source)
    for i in range(3):
        known = state.tracker.rate_variance[source, i] + state.covariance[VELOCITY + i, VELOCITY + i]
        if state.tracker.rate[source, i] ** 2 > INERTIAL_SIGMAS**2 * known:
            return True
    return False


@njit
def reset_to_fixes(state, source, settings, work):
    """Put position and velocity where the track of a receiver is; attitude and biases stay as they are.

    The position is no more certain than one fix: errors of fixes are alike. A velocity that agrees with the receiver's
    stays; if the receiver gives none it is that of the track, else it is open to the next one.
    """
    covariance = state.covariance
    reset_error(covariance, POSITION)
    # What lasts in the errors of fixes was taken out of the noise, and is in the position again.
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
    """Take the correlations of three errors, and their variances."""
    for i in range(place, place + 3):
        for j in range(ERROR_CAPACITY):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0


@njit
def is_lost(state):
    """Say whether only a new alignment is left: resets do not help, or neither fixes nor velocities are accepted."""
    is_new = state.restarts > 0 and state.stamp - state.first_stamp < RESTART_HELPS
    if state.recovery.recent_resets >= RESETS:
        return not is_new
    since = state.recovery.rejected_since
    for source in range(SOURCES):
        since = max(since, state.streams.fused_stamp[Stream.GNSS_VELOCITY.value, source])
    return state.recovery.rejected_fixes >= MEMBERS and state.stamp - since >= LAST_RESORT
