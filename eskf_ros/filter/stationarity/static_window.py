"""Windows of IMU readings in which the robot stands still, from which it is levelled, and proof of motion."""

from __future__ import annotations

import math
from enum import IntEnum

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.navigation_frame import local_up
from eskf_ros.filter.state.error_state import GYRO_BIAS, SOURCES
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.residual_motion import MOVING_SPEED
from eskf_ros.geodesy.earth import STANDARD_GRAVITY, geodetic_to_ecef
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix

POSITION_SIGMAS = 5.0
VELOCITY_SIGMAS = 3.0
"""What GNSS has to exceed (m/s) by so many sigma to prove motion.

Fixes are differenced, and over fractions of a second: at three sigma the noise of a parked robot's often passes.
"""

REST_TOLERANCE = 0.2
"""Change of the mean specific force across the vertical (m/s2) that a robot at rest may show: settling springs."""

REST_RATE_SIGMAS = 4.0
"""The mean rate at rest is the bias within this many sigma."""

STRONGEST_START = 5.0
"""No robot gathers speed faster (m/s2)."""

MINIMUM_WINDOW_SAMPLES = 10


class Window(IntEnum):
    """What the static window holds after a sample.

    OPEN: it is not full yet. MOTION: the robot moved. REST: it stood still. UNPROVEN: as quiet as rest, but neither a
    fix nor wheels came since it began, and a slow acceleration passes for a tilt.
    """

    OPEN = 0
    MOTION = 1
    REST = 2
    UNPROVEN = 3


@njit
def update_static_window(state, settings):
    """Add the newest IMU sample to the static window; return its `Window`. The caller closes one that is full."""
    if state.first_stamp == NEVER:
        state.first_stamp = state.stamp
    if state.imu_interval > settings.imu_gap:
        # What a hole hides belongs to no window.
        state.window_start = NEVER
        state.still_count = 0
    if state.window_start == NEVER:
        state.window_start = state.stamp
        state.window_count = 0
        for source in range(SOURCES):
            state.anchor_stamp[source] = state.last_fix_stamp[source]
            for i in range(3):
                state.anchor_ecef[source, i] = state.last_fix_ecef[source, i]
        for i in range(6):
            state.window_sum[i] = 0.0
            state.window_square_sum[i] = 0.0
    for i in range(3):
        state.window_sum[i] += state.specific_force[i]
        state.window_square_sum[i] += state.specific_force[i] ** 2
        state.window_sum[3 + i] += state.angular_rate[i]
        state.window_square_sum[3 + i] += state.angular_rate[i] ** 2
    state.window_count += 1
    duration = (state.stamp - state.window_start) * 1e-9
    if duration < settings.static_duration or state.window_count < MINIMUM_WINDOW_SAMPLES:
        return Window.OPEN
    still = is_still(state, settings) and state.motion_stamp < state.window_start and is_same_rest(state, settings)
    window = Window.REST if still else Window.MOTION
    if (
        still
        and state.position_known == 1
        and max(state.last_fix_stamp.max(), state.resting_stamp) < state.window_start
    ):
        window = Window.UNPROVEN
    if window != Window.REST:
        state.still_count = 0
    else:
        if state.still_count == 0:
            for i in range(6):
                state.still_sum[i] = 0.0
        state.still_count += state.window_count
        for i in range(6):
            state.still_sum[i] += state.window_sum[i]
    return window


@njit
def close_static_window(state):
    """Let the next IMU sample begin a new window."""
    state.window_start = NEVER


@njit
def update_evidence_from_fix(state, aid):
    """Remember a fix, and what it says about motion; see `update_motion` for what is returned."""
    fix = geodetic_to_ecef(aid.payload[0], aid.payload[1], aid.payload[2])
    std = math.sqrt(max(aid.payload[3], aid.payload[6], aid.payload[8]))
    return update_evidence_from_place(state, fix, std, aid.stamp, aid.source)


@njit
def update_evidence_from_place(state, ecef, std, stamp, source):
    """Remember the place (m) of an antenna, and look how far it is from that before the current static window."""
    is_disproved = False
    if NEVER < state.anchor_stamp[source] < stamp:
        a = state.anchor_ecef[source]
        step = (ecef[0] - a[0], ecef[1] - a[1], ecef[2] - a[2])
        seconds = (stamp - state.anchor_stamp[source]) * 1e-9
        speed = (math.sqrt(dot(step, step)) - POSITION_SIGMAS * math.sqrt(2.0) * std) / seconds
        is_disproved = update_motion(state, speed, state.anchor_stamp[source], stamp)
    state.last_fix_stamp[source] = stamp
    for i in range(3):
        state.last_fix_ecef[source, i] = ecef[i]
    return is_disproved


@njit
def update_evidence_from_velocity(state, aid):
    """Look at a GNSS velocity; see `update_motion` for what is returned."""
    speed = math.sqrt(aid.payload[0] ** 2 + aid.payload[1] ** 2 + aid.payload[2] ** 2)
    std = math.sqrt(max(aid.payload[3], aid.payload[6], aid.payload[8]))
    return update_motion(state, speed - VELOCITY_SIGMAS * std, aid.stamp, aid.stamp)


@njit
def update_motion(state, speed, since, stamp):
    """Take a speed (m/s) that its noise leaves, the mean from ``since`` to ``stamp``, as proof of motion.

    Returns whether the last level is disproved: no robot can have gathered that speed since the last window that passed
    as still, so that window was none.
    """
    if speed <= MOVING_SPEED:
        return False
    state.motion_stamp = stamp
    state.moving_stamp = stamp
    waiting = state.heading_known == 0 and state.level_known == 1 and state.still_stamp != NEVER
    return waiting and speed > MOVING_SPEED + STRONGEST_START * (stamp - min(since, state.still_stamp)) * 1e-9


@njit
def is_still(state, settings):
    """Say whether the spread of the readings in the full window is that of a robot at rest."""
    for i in range(6):
        mean = state.window_sum[i] / state.window_count
        variance = state.window_square_sum[i] / state.window_count - mean * mean
        limit = settings.still_accel_std if i < 3 else settings.still_gyro_std
        if variance > limit * limit:
            return False
    return True


@njit
def is_same_rest(state, settings):
    """Say whether rate and gravity are still where the last still window left them.

    A creeping turn is as quiet as rest, but its rate is none that the bias can have come to since. A steady
    acceleration looks like a tilt, but one that no gyro has seen.
    """
    if state.level_known == 0 or state.still_stamp == NEVER:
        return True
    n = state.window_count
    earth = rotate_back(to_matrix(state.attitude), state.earth_rate_map)
    noise = settings.gyro_noise_density**2 / ((state.stamp - state.window_start) * 1e-9)
    walked = settings.gyro_bias_random_walk**2 * (state.stamp - state.still_stamp) * 1e-9
    for i in range(3):
        excess = state.window_sum[3 + i] / n - state.gyro_bias[i] - earth[i]
        variance = state.covariance[GYRO_BIAS + i, GYRO_BIAS + i] + noise + walked
        if excess * excess > REST_RATE_SIGMAS**2 * variance:
            return False
    force = (state.window_sum[0] / n, state.window_sum[1] / n, state.window_sum[2] / n)
    force_map = rotate(to_matrix(state.attitude), force)
    sideways = cross(local_up(state), force_map)
    bias_variance = 0.0
    for i in range(3):
        bias_variance = max(bias_variance, state.covariance[GYRO_BIAS + i, GYRO_BIAS + i])
    drift = 3.0 * math.sqrt(bias_variance) * (state.stamp - state.still_stamp) * 1e-9
    return math.sqrt(dot(sideways, sideways)) < REST_TOLERANCE + STANDARD_GRAVITY * drift
