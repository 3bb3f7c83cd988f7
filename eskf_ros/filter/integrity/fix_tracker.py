"""The track of a receiver: what its fixes say by themselves, and whether they can be believed.

A small filter for each receiver, of where its fixes are and how they move beside the reckoned position: that of the
navigator without any of its corrections, led by the velocities of the same receiver where there are any. Per axis it
has two states, offset (m) and rate (m/s), white acceleration noise (Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, section 6.2.2), and a gate of its own; what lasts in the errors of fixes is in
the offset. Fixes that do not follow the others are misses, and after a few of them in a row the track starts anew.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.gnss_position import noise_factor
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import POSITION, SOURCES
from eskf_ros.filter.state.time import NEVER

FIX_TRACKER = np.dtype(
    [
        ("corrections_map", "f8", (3,)),
        ("stamp", "i8", (SOURCES,)),
        ("offset", "f8", (SOURCES, 3)),
        ("rate", "f8", (SOURCES, 3)),
        ("offset_variance", "f8", (SOURCES, 3)),
        ("mixed_variance", "f8", (SOURCES, 3)),
        ("rate_variance", "f8", (SOURCES, 3)),
        ("misses", "i8", (SOURCES,)),
        ("hit_stamp", "i8", (SOURCES,)),
        ("jumps", "i8", (SOURCES,)),
        ("jump", "f8", (SOURCES,)),
        ("rejected", "i8", (SOURCES,)),
        ("rejected_since", "i8", (SOURCES,)),
        ("scatter", "f8", (SOURCES,)),
        ("scatter_paid", "f8", (SOURCES,)),
        ("velocity_lead", "f8", (SOURCES, 3)),
        ("velocity_lead_variance", "f8", (SOURCES, 3)),
    ],
    align=True,
)
"""The track of the fixes by receiver: where they are (m) and move (m/s) beside the reckoned position.

The reckoned position is the position without any correction (``corrections_map``). Variances per axis; misses and
rejected fixes, jumps (m). ``scatter``: of the fixes against what they claim. ``velocity_lead``: how far the velocities
of the receiver lead away from the reckoned position (m), and how well that is known.
"""

SHORTEST_PATIENCE = 1_000_000_000
LONGEST_PATIENCE = 30_000_000_000
MISSED_INTERVALS = 2.5
"""An aid is silent when so many of its usual intervals pass, within these limits (ns)."""

LONGEST_LEAD = 2_000_000_000
"""A velocity says nothing of what was or will be so long (ns) before or after it."""

MISSES = 3
MISS_GATE = 16.27
"""A fix further (squared, in its standard deviations; 3 axes, 0.999) from the track is a miss; the track starts anew
after so many in a row."""

UNBROKEN = 5_000_000_000
"""Without a fix that belongs to the track for longer (ns) the reckoned position may have drifted away."""

LEAST_JUMP = 2.0
"""A step (m) that deserves the name."""

UNKNOWN_RATE_STD = 10.0
RATE_NOISE_DENSITY = 0.05
INERTIAL_NOISE_DENSITY = 0.2
"""Rate of a new track (m/s), and how fast it may change (m/s2/rtHz), led by velocities or by the IMU alone: the track
forgets within some seconds."""

SCATTER_GAIN = 0.08
SCATTER_CLIP = 4.0
SCATTER_SHARE = 10.0
"""Share of the newest fix in the measure of scatter, and the most that it may add, in measures; variance of the track,
in that of a fix, from which on it says nothing."""

SCATTER_GROWTH = 4.0
"""A step aside and back does not make the scatter seem so large."""

CONTRADICTION_SIGMAS = 5.0
CONTRADICTION_RATE = 0.3
"""Fixes move otherwise than the receiver's velocities beyond so many sigma and so many m/s."""


@njit
def patience(state, stream, source):
    """Return how long (ns) an aid may be silent."""
    usual = MISSED_INTERVALS * state.streams.interval[stream, source]
    return min(max(usual, SHORTEST_PATIENCE), LONGEST_PATIENCE)


@njit
def is_live(state, stream, source):
    """Say whether measurements of an aid come, accepted or not."""
    last = state.streams.last_stamp[stream, source]
    return last != NEVER and state.stamp - last <= patience(state, stream, source)


@njit
def is_fusing(state, stream, source):
    """Say whether measurements of an aid are accepted."""
    last = state.streams.fused_stamp[stream, source]
    return last != NEVER and state.stamp - last <= patience(state, stream, source)


@njit
def is_led(state, source):
    """Say whether velocities of a receiver come often enough to lead the track of its fixes."""
    last = state.streams.last_stamp[Stream.GNSS_VELOCITY.value, source]
    return last != NEVER and state.stamp - last <= LONGEST_LEAD


@njit
def update_track(state, aid, work):
    """Show the track of a receiver its newest measurement, whose innovation and noise are in ``work``."""
    if aid.stream == Stream.GNSS_POSITION:
        take_fix(state, aid.source, work)
    elif aid.stream == Stream.GNSS_VELOCITY:
        take_velocity(state, aid.source, work)


@njit
def take_velocity(state, source, work):
    """Let a velocity lead the track, for the time since the one before; the first is a new beginning of the rate."""
    if not is_led(state, source):
        forget_rate(state, source)
        return
    dt = (state.stamp - state.streams.last_stamp[Stream.GNSS_VELOCITY.value, source]) * 1e-9
    for i in range(3):
        state.tracker.velocity_lead[source, i] += work.innovation[i] * dt
        state.tracker.velocity_lead_variance[source, i] += work.noise[i, i] * dt * dt


@njit
def take_fix(state, source, work):
    """Let the track take a fix, if it belongs to it."""
    last = state.tracker.stamp[source]
    if last == NEVER or state.stamp - last > patience(state, Stream.GNSS_POSITION.value, source):
        start_track(state, source, work)
        return
    nis = predict_track(state, source, work)
    inflate_position_for_scatter(state, source, nis, work)
    if not nis <= MISS_GATE:
        state.tracker.misses[source] += 1
        if state.tracker.misses[source] >= MISSES:
            note_jump_of_fixes(state, source, work)
            start_track(state, source, work)
        return
    state.tracker.misses[source] = 0
    state.tracker.hit_stamp[source] = state.stamp
    for i in range(3):
        variance, mixed = state.tracker.offset_variance[source, i], state.tracker.mixed_variance[source, i]
        excess = offset_of_fix(state, source, i, work) - state.tracker.offset[source, i]
        gain = variance / (variance + work.noise[i, i])
        rate_gain = mixed / (variance + work.noise[i, i])
        state.tracker.offset[source, i] += gain * excess
        state.tracker.rate[source, i] += rate_gain * excess
        state.tracker.offset_variance[source, i] -= gain * variance
        state.tracker.mixed_variance[source, i] -= gain * mixed
        state.tracker.rate_variance[source, i] -= rate_gain * mixed


@njit
def predict_track(state, source, work):
    """Bring the track to the stamp of the newest fix; return the fix's normalised innovation squared."""
    dt = (state.stamp - state.tracker.stamp[source]) * 1e-9
    state.tracker.stamp[source] = state.stamp
    density = RATE_NOISE_DENSITY if is_led(state, source) else INERTIAL_NOISE_DENSITY
    noise = density**2 * dt
    nis = 0.0
    for i in range(3):
        mixed, rate = state.tracker.mixed_variance[source, i], state.tracker.rate_variance[source, i]
        state.tracker.offset[source, i] += dt * state.tracker.rate[source, i]
        state.tracker.offset_variance[source, i] += dt * (2.0 * mixed + dt * rate) + noise * dt * dt / 3.0
        state.tracker.offset_variance[source, i] += state.tracker.velocity_lead_variance[source, i]
        state.tracker.mixed_variance[source, i] += dt * rate + 0.5 * noise * dt
        state.tracker.rate_variance[source, i] += noise
        state.tracker.velocity_lead_variance[source, i] = 0.0
        excess = offset_of_fix(state, source, i, work) - state.tracker.offset[source, i]
        nis += excess * excess / (state.tracker.offset_variance[source, i] + work.noise[i, i])
    return nis


@njit
def offset_of_fix(state, source, i, work):
    """Return how far the newest fix is from the reckoned position that the velocities lead (m, axis ``i`` of map)."""
    return work.innovation[i] + state.tracker.corrections_map[i] - state.tracker.velocity_lead[source, i]


@njit
def offset_of_track(state, source, i):
    """Return how far the track is from the position of the state (m, axis ``i`` of map)."""
    return state.tracker.offset[source, i] + state.tracker.velocity_lead[source, i] - state.tracker.corrections_map[i]


@njit
def start_track(state, source, work):
    """Start the track of a receiver anew from its newest fix."""
    state.tracker.stamp[source] = state.stamp
    state.tracker.hit_stamp[source] = state.stamp
    state.tracker.misses[source] = 0
    state.tracker.rejected[source] = 0
    for i in range(3):
        state.tracker.offset[source, i] = offset_of_fix(state, source, i, work)
        state.tracker.offset_variance[source, i] = work.noise[i, i]
        state.tracker.velocity_lead_variance[source, i] = 0.0
    forget_rate(state, source)


@njit
def forget_rate(state, source):
    """Begin again with the rate of the track."""
    for i in range(3):
        state.tracker.rate[source, i] = 0.0
        state.tracker.mixed_variance[source, i] = 0.0
        state.tracker.rate_variance[source, i] = UNKNOWN_RATE_STD**2


@njit
def note_jump_of_fixes(state, source, work):
    """Count a step aside of fixes that came without a break, with velocities that know nothing of it."""
    if is_led(state, source) and state.stamp - state.tracker.hit_stamp[source] < UNBROKEN:
        square = 0.0
        for i in range(3):
            square += (offset_of_fix(state, source, i, work) - state.tracker.offset[source, i]) ** 2
        if square > LEAST_JUMP**2:
            state.tracker.jumps[source] += 1
            state.tracker.jump[source] = max(state.tracker.jump[source], math.sqrt(square))


@njit
def forget_tracks(state):
    """Forget what the fixes were like: the map or the state is another one."""
    for source in range(SOURCES):
        state.tracker.stamp[source] = NEVER
        state.tracker.misses[source] = 0
        state.tracker.rejected[source] = 0


@njit
def inflate_position_for_scatter(state, source, nis, work):
    """Take into account how far a fix is from its track, as a factor on the variance it claims.

    Unless the track knows too little to tell.
    Whenever the factor in use has grown to so much the position pays for what was believed before: it is less certain
    by as much as a fix is.
    """
    for i in range(3):
        if state.tracker.offset_variance[source, i] > SCATTER_SHARE * work.noise[i, i]:
            return
    scatter = state.tracker.scatter[source]
    factor = noise_factor(state, source)
    found = min(factor * nis / 3.0, SCATTER_CLIP * max(scatter, 1.0))
    state.tracker.scatter[source] += SCATTER_GAIN * (found - scatter)
    paid = state.tracker.scatter_paid[source]
    if factor == 1.0:
        state.tracker.scatter_paid[source] = 1.0
    elif factor > SCATTER_GROWTH * paid:
        for i in range(3):
            state.covariance[POSITION + i, POSITION + i] += (1.0 - paid / factor) * work.noise[i, i]
        state.tracker.scatter_paid[source] = factor


@njit
def is_contradicted(state, source):
    """Say whether the fixes of a receiver move otherwise than its velocities say."""
    if not is_led(state, source):
        return False
    square = 0.0
    nis = 0.0
    for i in range(3):
        rate = state.tracker.rate[source, i]
        square += rate * rate
        nis += rate * rate / state.tracker.rate_variance[source, i]
    return nis > CONTRADICTION_SIGMAS**2 and square > CONTRADICTION_RATE**2
