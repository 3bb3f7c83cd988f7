"""Static windows: IMU readings from which a robot at rest is levelled, and proof of motion by other sensors."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, YY, ZZ
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.inertial.navigation_frame import local_up
from eskf_ros.filter.inertial.sample_quality import is_hidden
from eskf_ros.filter.state.error_state import GYRO_BIAS, SOURCES
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.residual_motion import MOVING_SPEED, variance_of_half
from eskf_ros.geodesy.earth import STANDARD_GRAVITY, geodetic_to_ecef
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix

STATIC_WINDOW = np.dtype(
    [
        ("start", "i8"),
        ("samples", "i8"),
        ("total", "f8", (6,)),
        ("square_total", "f8", (6,)),
        ("half_samples", "i8"),
        ("half_force", "f8", (3,)),
        ("still_stamp", "i8"),
        ("still_samples", "i8"),
        ("still_total", "f8", (6,)),
        ("still_start", "i8"),
        ("still_force", "f8", (3,)),
        ("still_speed", "f8"),
        ("motion_stamp", "i8"),
        ("disproofs", "i8", (SOURCES + 1,)),
        ("last_fix_stamp", "i8", (SOURCES,)),
        ("last_fix_ecef", "f8", (SOURCES, 3)),
        ("last_fix_variance", "f8", (SOURCES,)),
        ("anchor_stamp", "i8", (SOURCES,)),
        ("anchor_ecef", "f8", (SOURCES, 3)),
    ],
    align=True,
)
"""The static window being filled, the unbroken run of still windows before it, and evidence of motion from other
sensors.

- ``start``, ``samples``, ``total``, ``square_total``: the window: first stamp (ns), samples, sums (m/s2, rad/s).
  ``half_samples``, ``half_force``: samples in its first half, and their force (m/s2).
- ``still_stamp``, ``still_samples``, ``still_total``: the end of the last still window (ns), samples and sums of the
  run. ``still_start``, ``still_force``: the start of its first window (ns), and the mean force (m/s2) in the first half
  of that. ``still_speed``: how fast the robot may have been then (m/s).
- ``motion_stamp``: when another sensor last proved motion (ns).
- ``disproofs``: how many speeds in a row disprove the last level, from the fixes of each receiver and measured ones.
- ``last_fix_*``: the last fix by receiver, because their antennas are apart: stamp (ns), ECEF (m), variance (m2).
- ``anchor_*``: the fix by receiver from which the window started.
"""

POSITION_SIGMAS = 5.0
"""Standard deviations by which a displacement between fixes must exceed `MOVING_SPEED` to prove motion. Fixes are
differenced, and over fractions of a second: at three standard deviations a parked robot would often pass.
"""

VELOCITY_SIGMAS = 3.0
"""Standard deviations by which a GNSS velocity must exceed `MOVING_SPEED` to prove motion."""

LEAST_FORCE = 0.01
"""m/s2 (0.06 deg of tilt); the horizontal specific force that readings at rest scatter by, at least."""

BRAKING_SIGMAS = 3.0
"""Ratio of the change of the mean specific force to an acceleration that the last level may hold unseen, up to which
the robot has only ceased to brake."""

REST_SIGMAS = 4.0
"""Standard deviations by which the mean rate at rest may differ from gyro bias plus Earth rate, and gravity from up."""

STRONGEST_START = 5.0
"""m/s2; no robot gathers speed faster."""

MEASURED_SPEED = SOURCES
"""Index in ``disproofs`` of speeds that a sensor measures. Those before it come from the fixes of a receiver."""

LEAST_DISPROOFS = 2
"""Speeds in a row that disprove a level. One may be a wild fix."""

MINIMUM_WINDOW_SAMPLES = 10
"""Samples, at least, of a full window."""


class Window(IntEnum):
    """What the static window holds after a sample.

    OPEN: it is not full yet. MOTION: the robot moved. REST: it was stationary. UNPROVEN: its readings are as quiet as
    at rest, but neither a fix nor wheels have come since it began, so that a slow acceleration would pass for a tilt.
    """

    OPEN = 0
    MOTION = 1
    REST = 2
    UNPROVEN = 3


@njit
def update_static_window(state, settings):
    """Add the newest IMU sample to the static window; return its `Window`. The caller closes a full window."""
    if state.first_stamp == NEVER:
        state.first_stamp = state.stamp
    if is_hidden(state, settings):
        # A gap of the IMU may hide motion: no window spans it.
        state.window.start = NEVER
        state.window.still_samples = 0
    if state.window.start == NEVER:
        state.window.start = state.stamp
        state.window.samples = 0
        state.window.half_samples = 0
        for source in range(SOURCES):
            state.window.anchor_stamp[source] = state.window.last_fix_stamp[source]
            for i in range(3):
                state.window.anchor_ecef[source, i] = state.window.last_fix_ecef[source, i]
        for i in range(6):
            state.window.total[i] = 0.0
            state.window.square_total[i] = 0.0
    duration = (state.stamp - state.window.start) * 1e-9
    if state.window.half_samples == 0 and 2.0 * duration > settings.static_duration:
        state.window.half_samples = state.window.samples
        for i in range(3):
            state.window.half_force[i] = state.window.total[i]
    for i in range(3):
        state.window.total[i] += state.specific_force[i]
        state.window.square_total[i] += state.specific_force[i] ** 2
        state.window.total[3 + i] += state.angular_rate[i]
        state.window.square_total[3 + i] += state.angular_rate[i] ** 2
    state.window.samples += 1
    if duration < settings.static_duration or state.window.samples < MINIMUM_WINDOW_SAMPLES:
        return Window.OPEN
    # A creep may be slower than what proves motion at once, and quiet.
    moved = max(state.window.motion_stamp, state.rest.moving_stamp) >= state.window.start
    still = is_still(state, settings) and not moved and is_same_rest(state, settings)
    window = Window.REST if still else Window.MOTION
    if (
        still
        and state.position_known == 1
        and max(state.window.last_fix_stamp[0], state.window.last_fix_stamp[1], state.rest.resting_stamp)
        < state.window.start
    ):
        window = Window.UNPROVEN
    if window != Window.REST:
        state.window.still_samples = 0
    else:
        if state.window.still_samples == 0:
            for i in range(6):
                state.window.still_total[i] = 0.0
            state.window.still_start = state.window.start
            state.window.still_speed = state.residual.first_speed
            for i in range(3):
                state.window.still_force[i] = state.window.half_force[i] / state.window.half_samples
        state.window.still_samples += state.window.samples
        for i in range(6):
            state.window.still_total[i] += state.window.total[i]
    return window


@njit
def close_static_window(state):
    """Close the static window, so that the next IMU sample begins a new one."""
    state.window.start = NEVER


@njit
def update_evidence_from_fix(state, aid):
    """Keep a fix, and compare it with the anchor of the window; return whether the last level is disproved."""
    fix = geodetic_to_ecef(aid.payload[0], aid.payload[1], aid.payload[2])
    std = math.sqrt(max(aid.payload[XX], aid.payload[YY], aid.payload[ZZ]))
    return update_evidence_from_place(state, fix, std, aid.stamp, aid.source)


@njit
def update_evidence_from_place(state, ecef, std, stamp, source):
    """Keep the position (m, ECEF) of an antenna, and compare it with the anchor; return whether the level is disproved.

    ``std`` (m) is the largest standard deviation of the axes. See `update_motion` for what is returned. A place that
    may be wild is no anchor for the next ones.
    """
    is_disproved = False
    if NEVER < state.window.anchor_stamp[source] < stamp:
        a = state.window.anchor_ecef[source]
        step = (ecef[0] - a[0], ecef[1] - a[1], ecef[2] - a[2])
        seconds = (stamp - state.window.anchor_stamp[source]) * 1e-9
        speed = (math.sqrt(dot(step, step)) - POSITION_SIGMAS * math.sqrt(2.0) * std) / seconds
        is_disproved = update_motion(state, speed, state.window.anchor_stamp[source], stamp, source)
        if 0 < state.window.disproofs[source] < LEAST_DISPROOFS:
            return False
    state.window.last_fix_stamp[source] = stamp
    for i in range(3):
        state.window.last_fix_ecef[source, i] = ecef[i]
    return is_disproved


@njit
def update_evidence_from_velocity(state, aid):
    """Look for motion in a GNSS velocity; return whether the last level is disproved (`update_motion`)."""
    speed = math.sqrt(aid.payload[0] ** 2 + aid.payload[1] ** 2 + aid.payload[2] ** 2)
    std = math.sqrt(max(aid.payload[XX], aid.payload[YY], aid.payload[ZZ]))
    return update_motion(state, speed - VELOCITY_SIGMAS * std, aid.stamp, aid.stamp, MEASURED_SPEED)


@njit
def update_motion(state, speed, since, stamp, evidence):
    """Take a speed (m/s), its uncertainty subtracted, as proof of motion; return whether it disproves the last level.

    The speed is the mean from ``since`` to ``stamp`` (ns). The level is disproved if no robot can have gathered that
    speed since the last still window: then that window was not at rest. The speed before it of the same ``evidence``
    (index in ``disproofs``) must say so, too.
    """
    w = state.window
    gathered = STRONGEST_START * (stamp - min(since, w.still_stamp)) * 1e-9
    is_waiting = state.heading_known == 0 and state.level_known == 1
    w.disproofs[evidence] = w.disproofs[evidence] + 1 if is_waiting and speed > MOVING_SPEED + gathered else 0
    if speed > MOVING_SPEED:
        w.motion_stamp = stamp
        state.rest.moving_stamp = stamp
    return w.disproofs[evidence] >= LEAST_DISPROOFS


@njit
def is_still(state, settings):
    """Say whether the spread of the readings in the full window is that of a robot at rest."""
    for i in range(6):
        mean = state.window.total[i] / state.window.samples
        variance = state.window.square_total[i] / state.window.samples - mean * mean
        limit = settings.still_accel_std if i < 3 else settings.still_gyro_std
        if variance > limit * limit:
            return False
    return True


@njit
def force_of_last_half(state):
    """Return the mean force (m/s2, IMU axes) in the second half of the window: gravity at the end of a turn."""
    window = state.window
    n, total, half = window.samples - window.half_samples, window.total, window.half_force
    return ((total[0] - half[0]) / n, (total[1] - half[1]) / n, (total[2] - half[2]) / n)


@njit
def is_same_rest(state, settings):
    """Say whether mean rate and gravity agree with the last still window, so that both windows are the same rest.

    A slow turn is as quiet as rest, but the gyro bias cannot have walked to its rate since the last window. A steady
    acceleration looks like a tilt, but the gyros have not seen such a tilt.
    """
    if state.level_known == 0 or state.window.still_stamp == NEVER:
        return True
    n = state.window.samples
    earth = rotate_back(to_matrix(state.attitude), state.frame.earth_rate_map)
    passed = (state.stamp - state.window.still_stamp) * 1e-9
    white = gyro_density(state, settings) ** 2
    noise = white / ((state.stamp - state.window.start) * 1e-9)
    walked = settings.gyro_bias_random_walk**2 * passed
    for i in range(3):
        excess = state.window.total[3 + i] / n - state.gyro_bias[i] - earth[i]
        variance = state.covariance[GYRO_BIAS + i, GYRO_BIAS + i] + noise + walked
        if excess * excess > REST_SIGMAS**2 * variance:
            return False
    force_map = rotate(to_matrix(state.attitude), force_of_last_half(state))
    sideways = cross(local_up(state), force_map)
    bias_variance = 0.0
    for i in range(3):
        bias_variance = max(bias_variance, state.covariance[GYRO_BIAS + i, GYRO_BIAS + i])
    turned = passed * (passed * bias_variance + white)
    std = math.sqrt(STANDARD_GRAVITY**2 * turned + variance_of_half(state) + LEAST_FORCE**2)
    tolerance = REST_SIGMAS * std + BRAKING_SIGMAS * state.levelling.unseen_braking
    return math.sqrt(dot(sideways, sideways)) < tolerance
