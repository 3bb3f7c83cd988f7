"""Recovery: acceptance of the streams, and what follows from a rejection for sensors other than GNSS receivers.

A heading that was given (parameter, memory or pose) loses against a dual antenna that has never agreed with it
(`heading_sensors`). A pressure that stays rejected has a new offset. GNSS receivers have their own judge
(`receiver`, `humble_lane`).
"""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading_sensors import reset_given_heading, update_refutation
from eskf_ros.filter.integrity.restart import reset_alignment
from eskf_ros.filter.state.augmented_states import reset_augmented
from eskf_ros.filter.state.enums import SENSOR_STREAMS, Phase, Stream, Verdict
from eskf_ros.filter.state.error_state import SOURCES
from eskf_ros.filter.state.streams import is_fusing, is_live
from eskf_ros.filter.state.time import NEVER

RECOVERY = np.dtype(
    [
        ("absolute_stamp", "i8"),
        ("absolute_interval", "i8"),
        ("rejected_fixes", "i8"),
        ("rejected_since", "i8"),
        ("resets", "i8"),
        ("reset_stamp", "i8"),
    ],
    align=True,
)
"""Acceptance of absolute positions (fixes and epochs of pseudoranges), and resets of position and velocity.

``absolute_stamp``, ``absolute_interval``: the last accepted one (ns), and the time from the one before it (ns).
``rejected_fixes``, ``rejected_since``: how many were rejected since then, and the stamp of the first of them (ns).
``resets``, ``reset_stamp``: how often the filter was reset to a receiver that had been refused, and when last (ns).
"""

MEMBERS = 5
"""Rejected fixes, at least, that must agree with each other to win over the filter."""

FULL_SUPPORT = 10_000_000_000
"""ns; a stream that has been accepted for longer is in the phase FUSING."""

LAST_RESORT = 60_000_000_000
"""ns; the alignment restarts if neither a fix nor a GNSS velocity was accepted for this long while fixes came."""

REJECTED_PRESSURE = 5_000_000_000
"""ns; when no pressure has been accepted for longer, the offset of the pressure altitude is reset."""


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
def recover(state, aid, settings, work):
    """Decide what follows from the verdict of an update, and count it.

    A heading of the dual antenna that is rejected may refute one that was given. When pressures have been rejected for
    `REJECTED_PRESSURE`, a door or a fan has changed the pressure for good: the offset is reset, so that the barometer
    says nothing of the height, but soon again of its changes.
    """
    stream, source = aid.stream, aid.source
    if stream >= SENSOR_STREAMS:
        return
    if stream == Stream.HEADING and aid.verdict == Verdict.GATE and update_refutation(state, aid, settings, work):
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


@njit
def note_epoch(state, verdict):
    """Count the verdict of most pseudoranges of an epoch; restart the alignment if the filter is lost."""
    note(state, Stream.PSEUDORANGE.value, 0, verdict)
    if is_lost(state):
        reset_alignment(state)


@njit
def note(state, stream, source, verdict):
    """Update the stamps and counters of a stream and source with the verdict of its newest measurement."""
    last = state.streams.last_stamp[stream, source]
    if last != NEVER:
        interval = state.streams.interval[stream, source]
        passed = state.stamp - last
        state.streams.interval[stream, source] = passed if interval == 0 else min(passed, 2 * interval)
    if verdict in (Verdict.FUSED, Verdict.WEIGHED_DOWN, Verdict.TAKEOVER, Verdict.RESET):
        if verdict == Verdict.RESET or not is_fusing(state, stream, source):
            state.streams.fused_since[stream, source] = state.stamp
        state.streams.fused_stamp[stream, source] = state.stamp
        state.streams.rejected[stream, source] = 0
        if stream in (Stream.GNSS_POSITION, Stream.PSEUDORANGE):
            if state.recovery.absolute_stamp != NEVER:
                state.recovery.absolute_interval = state.stamp - state.recovery.absolute_stamp
            state.recovery.absolute_stamp = state.stamp
            state.recovery.rejected_fixes = 0
    else:
        state.streams.rejected[stream, source] += 1
        if stream in (Stream.GNSS_POSITION, Stream.PSEUDORANGE):
            if state.recovery.rejected_fixes == 0:
                state.recovery.rejected_since = state.stamp
            state.recovery.rejected_fixes += 1
    state.streams.last_stamp[stream, source] = state.stamp


@njit
def note_reset(state):
    """Count a reset of the filter to a receiver that had been refused."""
    state.recovery.reset_stamp = state.stamp
    state.recovery.resets += 1


@njit
def is_lost(state):
    """Say whether only a new alignment can help: neither ranges nor velocities have been accepted for long."""
    since = state.recovery.rejected_since
    for source in range(SOURCES):
        since = max(since, state.streams.fused_stamp[Stream.GNSS_VELOCITY.value, source])
    return state.recovery.rejected_fixes >= MEMBERS and state.stamp - since >= LAST_RESORT
