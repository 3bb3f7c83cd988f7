"""Fix tracker: what the fixes of a receiver say by themselves, and whether they can be believed.

A small Kalman filter for each receiver tracks the offset of its fixes from the reckoned position: the position of the
navigator by dead reckoning, without any of its corrections, led by the velocities of the same receiver where it sends
them. Each axis of map has two states, offset (m) and rate (m/s), driven by white acceleration noise (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, section 6.2.2). The correlated error of fixes is
part of the offset. The track has a gate of its own: a fix outside is a miss, and after `MISSES` misses in a row the
track restarts from the newest fix.
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
"""The tracks of the receivers, by source; variances are per axis of map.

- ``corrections_map``: sum of all corrections of the position (m): the state minus dead reckoning.
- ``stamp``: the newest fix of the track (ns).
- ``offset``, ``rate``: where the fixes are (m) and how they move (m/s) relative to the reckoned position.
- ``offset_variance``, ``mixed_variance``, ``rate_variance``: their covariance.
- ``misses``, ``hit_stamp``: fixes in a row outside the gate of the track, and the last fix inside (ns).
- ``jumps``, ``jump``: how often the fixes stepped aside, and the largest step (m).
- ``rejected``, ``rejected_since``: fixes of the track in a row that the filter rejected, and the first of them (ns).
- ``scatter``: mean square of the fixes about the track over the variance that they claim.
- ``scatter_paid``: the noise factor for which the position was widened last.
- ``velocity_lead``, ``velocity_lead_variance``: displacement by the receiver's velocities minus that of the reckoned
  position (m).
"""

SHORTEST_PATIENCE = 1_000_000_000
"""ns; no stream is called silent earlier than this after its last message."""

LONGEST_PATIENCE = 30_000_000_000
"""ns; every stream is called silent later than this after its last message."""

MISSED_INTERVALS = 2.5
"""A stream is silent after this many of its usual intervals without a message, within the two limits above."""

LONGEST_LEAD = 2_000_000_000
"""ns; a velocity of the receiver leads the track only if it is at most this far away in time."""

MISSES = 3
"""Fixes in a row outside the gate of the track after which the track restarts."""

MISS_GATE = 16.27
"""Gate of the track (NIS of a fix): the chi-square quantile of probability 0.999 with 3 degrees of freedom."""

UNBROKEN = 5_000_000_000
"""ns; after a longer time without a fix inside the gate a step is not counted: dead reckoning may have drifted."""

LEAST_JUMP = 2.0
"""m; shorter steps of the fixes are not counted as jumps."""

UNKNOWN_RATE_STD = 10.0
"""m/s; standard deviation of the rate when a track starts."""

RATE_NOISE_DENSITY = 0.05
"""m/s2/rtHz; process noise of the rate while velocities lead the track: it forgets within some seconds."""

INERTIAL_NOISE_DENSITY = 0.2
"""m/s2/rtHz; process noise of the rate while the IMU alone reckons: the track forgets faster."""

SCATTER_GAIN = 0.08
"""Weight of the newest fix in the running mean of the scatter."""

SCATTER_CLIP = 4.0
"""One fix counts with at most this many times the present scatter."""

SCATTER_SHARE = 10.0
"""Ratio of the variance of the track to that of a fix above which the track is too uncertain to learn the scatter."""

SCATTER_GROWTH = 4.0
"""Growth of the noise factor that widens the position once more. A single step aside and back does not reach it."""

CONTRADICTION_SIGMAS = 5.0
"""Standard deviations by which the rate of a track must differ from zero to contradict the receiver's velocities."""

CONTRADICTION_RATE = 0.3
"""m/s; a smaller rate of a track does not contradict the receiver's velocities."""


@njit
def patience(state, stream, source):
    """Return the time (ns) after which a silent stream and source counts as lost."""
    usual = MISSED_INTERVALS * state.streams.interval[stream, source]
    return min(max(usual, SHORTEST_PATIENCE), LONGEST_PATIENCE)


@njit
def is_live(state, stream, source):
    """Say whether measurements of a stream and source arrive, accepted or not."""
    last = state.streams.last_stamp[stream, source]
    return last != NEVER and state.stamp - last <= patience(state, stream, source)


@njit
def is_fusing(state, stream, source):
    """Say whether measurements of a stream and source are being accepted."""
    last = state.streams.fused_stamp[stream, source]
    return last != NEVER and state.stamp - last <= patience(state, stream, source)


@njit
def is_led(state, source):
    """Say whether velocities of a receiver come often enough to lead the track of its fixes."""
    last = state.streams.last_stamp[Stream.GNSS_VELOCITY.value, source]
    return last != NEVER and state.stamp - last <= LONGEST_LEAD


@njit
def update_track(state, aid, work):
    """Update the track of a receiver with its newest measurement, whose innovation and noise are in ``work``."""
    if aid.stream == Stream.GNSS_POSITION:
        take_fix(state, aid.source, work)
    elif aid.stream == Stream.GNSS_VELOCITY:
        take_velocity(state, aid.source, work)


@njit
def take_velocity(state, source, work):
    """Let a velocity lead the track over the time since the one before; after a break the rate starts anew."""
    if not is_led(state, source):
        forget_rate(state, source)
        return
    dt = (state.stamp - state.streams.last_stamp[Stream.GNSS_VELOCITY.value, source]) * 1e-9
    for i in range(3):
        state.tracker.velocity_lead[source, i] += work.innovation[i] * dt
        state.tracker.velocity_lead_variance[source, i] += work.noise[i, i] * dt * dt


@njit
def take_fix(state, source, work):
    """Update the track with a fix inside its gate; restart it after `MISSES` fixes in a row outside."""
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
    """Predict the track to the stamp of the newest fix; return the NIS of that fix (3 axes)."""
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
    """Return the offset (m, axis ``i`` of map) of the newest fix from the reckoned position led by velocities."""
    return work.innovation[i] + state.tracker.corrections_map[i] - state.tracker.velocity_lead[source, i]


@njit
def offset_of_track(state, source, i):
    """Return the offset (m, axis ``i`` of map) of the track from the position of the state."""
    return state.tracker.offset[source, i] + state.tracker.velocity_lead[source, i] - state.tracker.corrections_map[i]


@njit
def start_track(state, source, work):
    """Restart the track of a receiver from its newest fix."""
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
    """Reset the rate of the track to zero, with the variance of an unknown rate."""
    for i in range(3):
        state.tracker.rate[source, i] = 0.0
        state.tracker.mixed_variance[source, i] = 0.0
        state.tracker.rate_variance[source, i] = UNKNOWN_RATE_STD**2


@njit
def note_jump_of_fixes(state, source, work):
    """Count a jump: fixes without a break step aside, and the receiver's velocities do not show it."""
    if is_led(state, source) and state.stamp - state.tracker.hit_stamp[source] < UNBROKEN:
        square = 0.0
        for i in range(3):
            square += (offset_of_fix(state, source, i, work) - state.tracker.offset[source, i]) ** 2
        if square > LEAST_JUMP**2:
            state.tracker.jumps[source] += 1
            state.tracker.jump[source] = max(state.tracker.jump[source], math.sqrt(square))


@njit
def forget_tracks(state):
    """Drop the tracks of all receivers, because the map frame or the state has changed."""
    for source in range(SOURCES):
        state.tracker.stamp[source] = NEVER
        state.tracker.misses[source] = 0
        state.tracker.rejected[source] = 0


@njit
def inflate_position_for_scatter(state, source, nis, work):
    """Learn the scatter of the fixes about their track, and widen the position if fixes were trusted too much before.

    ``nis`` is that of the newest fix about the predicted track. The running mean of the scatter is the factor on the
    variances that the fixes claim (`gnss_position.noise_factor`). Whenever this factor has grown by `SCATTER_GROWTH`,
    the variance of the position gains up to that of one fix, because earlier fixes were fused with too small a
    variance.
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
    """Say whether the fixes of a receiver move in contradiction to its velocities."""
    if not is_led(state, source):
        return False
    square = 0.0
    nis = 0.0
    for i in range(3):
        rate = state.tracker.rate[source, i]
        square += rate * rate
        nis += rate * rate / state.tracker.rate_variance[source, i]
    return nis > CONTRADICTION_SIGMAS**2 and square > CONTRADICTION_RATE**2
