"""Start-up: level from gravity, position from the first fix, heading from what there is.

In this order: a parameter or the memory of the last run, a sensor that tells it (``heading_hints``), or acceleration
(``heading_search``), sharpened by the course.

While the heading is unknown its error has the variance of a half turn and is not estimated: GNSS moves position and
velocity only (``strapdown.step`` cuts the coupling), the gyros carry the attitude. Every still window until the
heading is known levels again; once GNSS is there, only one in which a fix agrees that it is still.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.earth import EARTH_RATE, STANDARD_GRAVITY, east_north_up_to_ecef, geodetic_to_ecef
from eskf_ros.filter.aiding.common import set_east_north_up_covariance
from eskf_ros.filter.aiding.gnss_position import position_of_fix
from eskf_ros.filter.aiding.gnss_velocity import body_rate, local_east_north_up_to_ecef
from eskf_ros.filter.covariance import transform_error
from eskf_ros.filter.heading_search import (
    COSINE,
    begin_search,
    forget_search,
    note_level,
    spread,
    turn_found,
    update_search,
)
from eskf_ros.filter.layout import (
    ACCEL_BIAS,
    ATTITUDE,
    ERROR_CAPACITY,
    ERROR_SIZE,
    GYRO_BIAS,
    NEVER,
    POSITION,
    SOURCES,
    VELOCITY,
    Stream,
)
from eskf_ros.filter.monitors import watch_input
from eskf_ros.filter.strapdown import gravity_map
from eskf_ros.filter.sway import MOVING_SPEED, can_be_bias, is_moving, note_sway
from eskf_ros.filter.track import forget_tracks
from eskf_ros.filter.warm_start import do_biases_hold
from eskf_ros.rotation import (
    cross,
    dot,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalized,
    rotate,
    rotate_back,
    to_matrix,
    to_rotation_vector,
    wrapped,
)

GNSS_POSITION = int(Stream.GNSS_POSITION)
GNSS_VELOCITY = int(Stream.GNSS_VELOCITY)

START_POSITION_STD = 1000.0
START_VELOCITY_STD = 100.0
POSITION_SIGMAS = 5.0
VELOCITY_SIGMAS = 3.0
"""What GNSS has to exceed (m/s) by so many sigma to prove motion.

Fixes are differenced, and over fractions of a second: at three sigma the noise of a parked robot's often passes.
"""

REST_TOLERANCE = 0.2
"""Change of the mean specific force across the vertical (m/s2) that a robot at rest may show: settling springs."""

REST_RATE_SIGMAS = 4.0
"""The mean rate at rest is the bias within this many sigma."""

DRIFTED = 2.0
"""Levelling on the way is worth it when it makes the variance of the tilt smaller by this factor."""

STRONGEST_START = 5.0
"""No robot gathers speed faster (m/s2)."""

UNKNOWN_SPEED = 10.0
"""Levelling in a turn: the speed (m/s) that makes the centripetal acceleration taken for tilt."""

COURSE_MAX_STD = 0.17
COURSE_MAX_TURN_RATE = 0.2
"""Course over ground gives heading only when it is this certain (rad) and the robot turns no faster (rad/s)."""

CERTAIN = 3.0
LEAST_LENGTH = 0.5
COURSE_SEARCH_STD = 0.35
"""The course is believed when the search agrees within three sigma, and knows the direction so well by itself (rad)."""

MINIMUM_WINDOW_SAMPLES = 10


@njit
def set_datum(state, latitude, longitude, altitude):
    """Latch the local frame: East-North-Up at a geodetic position (rad, rad, m)."""
    state.datum[0] = latitude
    state.datum[1] = longitude
    state.datum[2] = altitude
    origin = geodetic_to_ecef(latitude, longitude, altitude)
    rotation = east_north_up_to_ecef(latitude, longitude)
    earth_rate = rotate_back(rotation, (0.0, 0.0, EARTH_RATE))
    for i in range(3):
        state.origin_ecef[i] = origin[i]
        state.earth_rate_map[i] = earth_rate[i]
        for j in range(3):
            state.map_to_ecef[i, j] = rotation[i][j]
    state.datum_known = 1


@njit
def local_up(state):
    """Return the unit vector against gravity (map axes) at the current position."""
    gravity = gravity_map(state, (state.position_map[0], state.position_map[1], state.position_map[2]))
    scale = -1.0 / math.sqrt(dot(gravity, gravity))
    return (gravity[0] * scale, gravity[1] * scale, gravity[2] * scale)


@njit
def turn_attitude(state, rotation_vector):
    """Turn the attitude by a rotation vector in map axes, and its error with it (the error is in map axes too)."""
    turn = from_rotation_vector(rotation_vector)
    attitude = (state.attitude[0], state.attitude[1], state.attitude[2], state.attitude[3])
    attitude = normalized(multiply(turn, attitude))
    for i in range(4):
        state.attitude[i] = attitude[i]
    transform_error(state.covariance, ATTITUDE, to_matrix(turn))


@njit
def move_datum(state, latitude, longitude, altitude, settings):
    """Describe the same state in the local frame of another datum (rad, rad, m): an exact rotation and shift."""
    old = east_north_up_to_ecef(state.datum[0], state.datum[1])
    offset = rotate(old, state.position_map)
    ecef = (state.origin_ecef[0] + offset[0], state.origin_ecef[1] + offset[1], state.origin_ecef[2] + offset[2])
    set_datum(state, latitude, longitude, altitude)
    origin = state.origin_ecef
    # Columns of the rotation from old to new map, as rows: the images of the old axes.
    east = rotate_back(state.map_to_ecef, (old[0][0], old[1][0], old[2][0]))
    north = rotate_back(state.map_to_ecef, (old[0][1], old[1][1], old[2][1]))
    up = rotate_back(state.map_to_ecef, (old[0][2], old[1][2], old[2][2]))
    turn = ((east[0], north[0], up[0]), (east[1], north[1], up[1]), (east[2], north[2], up[2]))
    position = rotate_back(state.map_to_ecef, (ecef[0] - origin[0], ecef[1] - origin[1], ecef[2] - origin[2]))
    velocity = rotate(turn, state.velocity_map)
    for i in range(3):
        state.position_map[i] = position[i]
        state.velocity_map[i] = velocity[i]
    transform_error(state.covariance, POSITION, turn)
    transform_error(state.covariance, VELOCITY, turn)
    place = settings.position_error_at
    if place < state.error_size:
        transform_error(state.covariance, place, turn)
        lasting = state.optional[place - ERROR_SIZE : place - ERROR_SIZE + 3]
        lasting[0], lasting[1], lasting[2] = rotate(turn, (lasting[0], lasting[1], lasting[2]))
    turn_attitude(state, to_rotation_vector(from_matrix(turn)))
    forget_search(state)
    forget_tracks(state)


@njit
def shortest_turn(a, b):
    """Return the shortest rotation vector that turns unit vector ``a`` into ``b``."""
    axis = cross(a, b)
    sine = math.sqrt(dot(axis, axis))
    cosine = dot(a, b)
    if sine < 1e-9:
        if cosine > 0.0:
            return (0.0, 0.0, 0.0)
        # Opposite: half a turn about any perpendicular axis.
        if abs(a[0]) < 0.9:
            axis = cross(a, (1.0, 0.0, 0.0))
        else:
            axis = cross(a, (0.0, 1.0, 0.0))
        scale = math.pi / math.sqrt(dot(axis, axis))
        return (axis[0] * scale, axis[1] * scale, axis[2] * scale)
    scale = math.atan2(sine, cosine) / sine
    return (axis[0] * scale, axis[1] * scale, axis[2] * scale)


@njit
def restart(state):
    """Start the alignment again; only the datum stays."""
    state.restarts += 1
    forget_search(state)
    forget_tracks(state)
    state.hint_count = 0
    state.given_stamp = NEVER
    state.rejected_fixes = 0
    state.recent_resets = 0
    state.level_known = 0
    state.position_known = 0
    state.heading_known = 0
    state.first_stamp = NEVER
    state.window_start = NEVER
    state.still_stamp = NEVER
    state.still_count = 0
    for i in range(2):
        state.clock_known[i] = 0
    for i in range(3):
        state.position_map[i] = 0.0
        state.velocity_map[i] = 0.0


@njit
def watch_stillness(state, settings):
    """Add the newest IMU sample to the stillness window; at the end of a window level if that is still wanted."""
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
        return
    still = is_still(state, settings) and state.motion_stamp < state.window_start and is_same_rest(state, settings)
    watch_input(state, still, settings)
    if state.position_known == 1 and max(state.last_fix_stamp.max(), state.resting_stamp) < state.window_start:
        # Without a fix or wheels since it began nobody knows whether a slow acceleration passes for a tilt.
        still = False
    if not still:
        state.still_count = 0
    else:
        if state.still_count == 0:
            for i in range(6):
                state.still_sum[i] = 0.0
        state.still_count += state.window_count
        for i in range(6):
            state.still_sum[i] += state.window_sum[i]
    if state.heading_known == 0 or state.position_known == 0:
        if still:
            state.still_stamp = state.stamp
            level(state, state.still_sum, state.still_count, duration / state.window_count, True, settings)
        elif state.level_known == 0 and (state.stamp - state.first_stamp) * 1e-9 >= settings.moving_start_after:
            level(state, state.window_sum, state.window_count, duration / state.window_count, False, settings)
    state.window_start = NEVER


@njit
def note_position(state, aid, settings):
    """Remember a fix, and what it says about motion."""
    fix = geodetic_to_ecef(aid.payload[0], aid.payload[1], aid.payload[2])
    std = math.sqrt(max(aid.payload[3], aid.payload[6], aid.payload[8]))
    note_place(state, fix, std, aid.stamp, aid.source, settings)


@njit
def note_place(state, ecef, std, stamp, source, settings):
    """Remember the place (m) of an antenna, and look how far it is from that before the current stillness window."""
    if NEVER < state.anchor_stamp[source] < stamp:
        a = state.anchor_ecef[source]
        step = (ecef[0] - a[0], ecef[1] - a[1], ecef[2] - a[2])
        seconds = (stamp - state.anchor_stamp[source]) * 1e-9
        speed = (math.sqrt(dot(step, step)) - POSITION_SIGMAS * math.sqrt(2.0) * std) / seconds
        note_speed(state, speed, state.anchor_stamp[source], stamp, settings)
    state.last_fix_stamp[source] = stamp
    for i in range(3):
        state.last_fix_ecef[source, i] = ecef[i]


@njit
def note_velocity(state, aid, settings):
    """Look at a GNSS velocity."""
    speed = math.sqrt(aid.payload[0] ** 2 + aid.payload[1] ** 2 + aid.payload[2] ** 2)
    std = math.sqrt(max(aid.payload[3], aid.payload[6], aid.payload[8]))
    note_speed(state, speed - VELOCITY_SIGMAS * std, aid.stamp, aid.stamp, settings)


@njit
def note_speed(state, speed, since, stamp, settings):
    """Take a speed (m/s) that its noise leaves, the mean from ``since`` to ``stamp``, as proof of motion.

    If no robot can have gathered that speed since the last window that passed as still, that window was none.
    """
    if speed <= MOVING_SPEED:
        return
    state.motion_stamp = stamp
    state.moving_stamp = stamp
    waiting = state.heading_known == 0 and state.level_known == 1 and state.still_stamp != NEVER
    if waiting and speed > MOVING_SPEED + STRONGEST_START * (stamp - min(since, state.still_stamp)) * 1e-9:
        distrust_level(state, settings)


@njit
def distrust_level(state, settings):
    """Give tilt and gyro bias the uncertainty of a level taken while moving."""
    state.still_stamp = NEVER
    state.still_count = 0
    note_level(state, settings.moving_tilt_std**2, settings.accel_bias_std**2, to_matrix(state.attitude), settings)
    up = local_up(state)
    covariance = state.covariance
    for i in range(3):
        state.gyro_bias[i] = 0.0
        for j in range(ERROR_CAPACITY):
            covariance[GYRO_BIAS + i, j] = 0.0
            covariance[j, GYRO_BIAS + i] = 0.0
        for j in range(3):
            covariance[ATTITUDE + i, ATTITUDE + j] -= up[i] * up[j] * settings.moving_tilt_std**2
        covariance[ATTITUDE + i, ATTITUDE + i] += settings.moving_tilt_std**2
    for i in range(3):
        covariance[GYRO_BIAS + i, GYRO_BIAS + i] = settings.gyro_bias_std**2


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


@njit
def level(state, sums, count, interval, still, settings):
    """Set roll, pitch and, at rest, the gyro bias from mean readings; heading stays as it was.

    ``sums`` of force (m/s2) and rate (rad/s) over ``count`` samples ``interval`` s apart. The accelerometer bias
    tilts the result, theta = up x (R dba) / g: the cross covariance says so (Groves, section 5.6.2). A bias that walks
    differs at the end from its mean by a third of the variance that it walks meanwhile.
    """
    force = (sums[0] / count, sums[1] / count, sums[2] / count)
    rate = (sums[3] / count, sums[4] / count, sums[5] / count)
    duration = count * interval
    bias = (0.0, 0.0, 0.0)
    accel_bias_variance = settings.accel_bias_std**2
    start_rate = (0.0, 0.0, 0.0)
    gyro_bias_variance = settings.gyro_bias_std**2
    if do_biases_hold(state, force, rate, duration, still, settings):
        b, r = settings.remembered_accel_bias, settings.remembered_gyro_bias
        bias, start_rate = (b[0], b[1], b[2]), (r[0], r[1], r[2])
        accel_bias_variance = settings.remembered_accel_bias_std**2
        gyro_bias_variance = settings.remembered_gyro_bias_std**2
    is_first = count == state.window_count
    if is_first:
        keep_gyro_bias(state)
    if state.kept_gyro_variance < gyro_bias_variance:
        b = state.kept_gyro_bias
        start_rate, gyro_bias_variance = (b[0], b[1], b[2]), state.kept_gyro_variance
    can_be_rest = can_be_bias(rate, start_rate, math.sqrt(gyro_bias_variance), mean_rate_std(duration, settings))
    if still and (state.moved_first == 1 or is_moving(state) or not can_be_rest):
        # Even braking, a slow turn, or a bias that nobody expected: what is not known to be rest has to wait as if it
        # were motion.
        state.still_stamp = NEVER
        state.still_count = 0
        if state.level_known == 1 or (state.stamp - state.first_stamp) * 1e-9 < settings.moving_start_after:
            return
        still = False
    force = (force[0] - bias[0], force[1] - bias[1], force[2] - bias[2])
    strength = math.sqrt(dot(force, force))
    if strength < 0.5 * STANDARD_GRAVITY:
        return
    if still:
        note_sway(state, is_first, settings)
        walked = settings.accel_bias_random_walk**2 * duration / 3.0
        swayed = state.sway_force * min(1.0, settings.static_duration / duration)
        tilt_noise = (settings.accel_noise_density**2 / duration + walked + swayed) / strength**2
        known = max(state.covariance[ATTITUDE, ATTITUDE], state.covariance[ATTITUDE + 1, ATTITUDE + 1])
        if swayed > 0.0 and state.level_known == 1 and known < accel_bias_variance / strength**2 + tilt_noise:
            # Not quite at rest, and the level is better known.
            return
    else:
        turn_rate_square = (sums[3] ** 2 + sums[4] ** 2 + sums[5] ** 2) / count**2
        tilt_noise = settings.moving_tilt_std**2 + turn_rate_square * (UNKNOWN_SPEED / strength) ** 2
    heading = heading_of(state, settings)
    up = local_up(state)
    measured = rotate(to_matrix(state.attitude), (force[0] / strength, force[1] / strength, force[2] / strength))
    turn_attitude(state, shortest_turn(measured, up))
    rotation = to_matrix(state.attitude)

    covariance = state.covariance
    for i in range(ATTITUDE, ERROR_SIZE):
        for j in range(ERROR_CAPACITY):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0
    note_level(state, tilt_noise, accel_bias_variance, rotation, settings)
    heading_variance = math.pi**2
    if state.heading_known == 1:
        heading_variance = settings.initial_heading_std**2
    for i in range(3):
        state.accel_bias[i] = bias[i]
        covariance[ACCEL_BIAS + i, ACCEL_BIAS + i] = accel_bias_variance
        # Column i of [up]x R / g.
        tilt = cross(up, (rotation[0][i], rotation[1][i], rotation[2][i]))
        for j in range(3):
            covariance[ATTITUDE + j, ACCEL_BIAS + i] = tilt[j] / strength * accel_bias_variance
            covariance[ACCEL_BIAS + i, ATTITUDE + j] = tilt[j] / strength * accel_bias_variance
        for j in range(3):
            horizontal = -up[i] * up[j]
            if i == j:
                horizontal += 1.0
            covariance[ATTITUDE + i, ATTITUDE + j] = (
                horizontal * (accel_bias_variance / strength**2 + tilt_noise) + up[i] * up[j] * heading_variance
            )
    set_gyro_bias(state, start_rate, gyro_bias_variance, rate, rotation, up, duration, still, settings)
    # The parameter is true of the start only, not of where a restart finds the robot.
    if state.level_known == 0 and state.restarts == 0 and not math.isnan(settings.initial_heading):
        state.heading_known = 1
        set_heading(state, settings.initial_heading, settings.initial_heading_std, settings)
        state.given_stamp = state.stamp
    state.jump_heading += wrapped(heading_of(state, settings) - heading)
    state.level_known = 1


@njit
def keep_gyro_bias(state):
    """Keep what is known of the gyro bias when a run of windows begins: the prior of what its windows say together."""
    state.kept_gyro_variance = math.inf
    if state.level_known == 0:
        return
    state.kept_gyro_variance = 0.0
    for i in range(3):
        state.kept_gyro_bias[i] = state.gyro_bias[i]
        variance = state.covariance[GYRO_BIAS + i, GYRO_BIAS + i]
        state.kept_gyro_variance = max(state.kept_gyro_variance, variance)


@njit
def level_again(state, settings):
    """Level on the way, at the end of a window, when the gyros have drifted further than such a level is wrong.

    Of a robot that is never at rest the gyro bias is not known, and without a heading GNSS tells nothing of the tilt.
    """
    is_end = state.window_start == NEVER and state.window_count > 0
    if not is_end or state.level_known == 0 or state.heading_known == 1 or state.still_stamp == state.stamp:
        return
    n = state.window_count
    rate_square = (state.window_sum[3] ** 2 + state.window_sum[4] ** 2 + state.window_sum[5] ** 2) / n**2
    fresh = settings.moving_tilt_std**2 + rate_square * (UNKNOWN_SPEED / STANDARD_GRAVITY) ** 2
    drifted = max(state.covariance[ATTITUDE, ATTITUDE], state.covariance[ATTITUDE + 1, ATTITUDE + 1])
    if drifted > DRIFTED * fresh:
        level(state, state.window_sum, n, settings.static_duration / n, False, settings)


@njit
def mean_rate_std(duration, settings):
    """Return by how much (rad/s) the mean rate over ``duration`` (s) at rest differs from the gyro bias at the end."""
    white = settings.gyro_noise_density**2 / duration
    return math.sqrt(white + settings.gyro_bias_random_walk**2 * duration / 3.0)


@njit
def set_gyro_bias(state, prior_bias, prior, mean_rate, rotation, up, duration, still, settings):
    """Estimate the gyro bias from the mean rate at rest; what is not known of the Earth rate enters its sigma.

    The prior (``prior_bias``, rad/s, IMU axes, with variance ``prior``) and the mean are weighed along the vertical
    and across it, because without heading only the vertical part of the Earth rate is known.
    """
    noise = mean_rate_std(duration, settings) ** 2
    if still:
        noise += state.sway_rate * min(1.0, settings.static_duration / duration)
    earth = state.earth_rate_map
    vertical_rate = dot(up, earth)
    horizontal_square = dot(earth, earth) - vertical_rate**2
    known = (vertical_rate * up[0], vertical_rate * up[1], vertical_rate * up[2])
    vertical_variance = noise
    # Of unknown direction: half of its square falls on each horizontal axis.
    horizontal_variance = noise + 0.5 * horizontal_square
    if state.datum_known == 0:
        vertical_variance = noise + EARTH_RATE**2
        horizontal_variance = noise + EARTH_RATE**2
    elif state.heading_known == 1:
        known = (earth[0], earth[1], earth[2])
        horizontal_variance = noise + horizontal_square * settings.initial_heading_std**2
    vertical_gain = prior / (prior + vertical_variance) if still and prior > 0.0 else 0.0
    horizontal_gain = prior / (prior + horizontal_variance) if still and prior > 0.0 else 0.0
    mean_map = rotate(
        rotation, (mean_rate[0] - prior_bias[0], mean_rate[1] - prior_bias[1], mean_rate[2] - prior_bias[2])
    )
    excess = (mean_map[0] - known[0], mean_map[1] - known[1], mean_map[2] - known[2])
    vertical = dot(up, excess)
    bias = rotate_back(
        rotation,
        (
            horizontal_gain * (excess[0] - vertical * up[0]) + vertical_gain * vertical * up[0],
            horizontal_gain * (excess[1] - vertical * up[1]) + vertical_gain * vertical * up[1],
            horizontal_gain * (excess[2] - vertical * up[2]) + vertical_gain * vertical * up[2],
        ),
    )
    up_body = rotate_back(rotation, up)
    across = prior * (1.0 - horizontal_gain)
    along = prior * (1.0 - vertical_gain)
    for i in range(3):
        state.gyro_bias[i] = prior_bias[i] + bias[i]
        for j in range(3):
            state.covariance[GYRO_BIAS + i, GYRO_BIAS + j] = (along - across) * up_body[i] * up_body[j]
        state.covariance[GYRO_BIAS + i, GYRO_BIAS + i] += across


@njit
def heading_of(state, settings):
    """Return the heading (rad, map: 0 = x, counter-clockwise) of the x axis of base_link."""
    # The x axis of base_link in IMU axes is the first row of imu_to_base.
    m = settings.imu_to_base
    forward = rotate(to_matrix(state.attitude), (m[0, 0], m[0, 1], m[0, 2]))
    return math.atan2(forward[1], forward[0])


@njit
def set_heading(state, heading, std, settings):
    """Turn the attitude about the local vertical to ``heading`` (rad), independent of everything else by ``std``."""
    up = local_up(state)
    lever = rotate(to_matrix(state.attitude), settings.lever_arms_body[0])
    change = heading - heading_of(state, settings)
    turn_attitude(state, (change * up[0], change * up[1], change * up[2]))
    # The vehicle did not make this turn.
    state.mag_heading = wrapped(state.mag_heading + change)
    covariance = state.covariance
    across = (
        (1.0 - up[0] * up[0], -up[0] * up[1], -up[0] * up[2]),
        (-up[1] * up[0], 1.0 - up[1] * up[1], -up[1] * up[2]),
        (-up[2] * up[0], -up[2] * up[1], 1.0 - up[2] * up[2]),
    )
    transform_error(covariance, ATTITUDE, across)
    for i in range(3):
        for j in range(3):
            covariance[ATTITUDE + i, ATTITUDE + j] += up[i] * up[j] * std**2
    if state.position_known == 1:
        # GNSS held the antenna in place: the body is on the other end of the lever arm.
        turned = rotate(to_matrix(state.attitude), settings.lever_arms_body[0])
        for i in range(3):
            state.position_map[i] += lever[i] - turned[i]


@njit
def start_position(state, payload):
    """Take position from the first fix, with a wide prior that the update of this same fix makes narrow."""
    old_up = local_up(state)
    if state.datum_known == 0:
        set_datum(state, payload[0], payload[1], payload[2])
    position = position_of_fix(state, payload)
    covariance = state.covariance
    for i in range(3):
        state.position_map[i] = position[i]
        state.velocity_map[i] = 0.0
        for j in range(ERROR_CAPACITY):
            covariance[POSITION + i, j] = 0.0
            covariance[j, POSITION + i] = 0.0
            covariance[VELOCITY + i, j] = 0.0
            covariance[j, VELOCITY + i] = 0.0
    for i in range(3):
        covariance[POSITION + i, POSITION + i] = START_POSITION_STD**2
        covariance[VELOCITY + i, VELOCITY + i] = START_VELOCITY_STD**2
    turn_attitude(state, shortest_turn(old_up, local_up(state)))
    state.position_known = 1


@njit
def place(state, position, position_covariance, heading, heading_std, settings):
    """Put base_link to a position (m, map) with a covariance (3, 3) and a heading (rad), whatever was known before."""
    covariance = state.covariance
    for i in range(3):
        for j in range(ERROR_CAPACITY):
            covariance[POSITION + i, j] = 0.0
            covariance[j, POSITION + i] = 0.0
    if state.position_known == 0:
        for i in range(3):
            for j in range(ERROR_CAPACITY):
                covariance[VELOCITY + i, j] = 0.0
                covariance[j, VELOCITY + i] = 0.0
            covariance[VELOCITY + i, VELOCITY + i] = START_VELOCITY_STD**2
    state.position_known = 0
    forget_search(state)
    forget_tracks(state)
    set_heading(state, heading, heading_std, settings)
    m = settings.imu_position_base
    offset = rotate(to_matrix(state.attitude), rotate_back(settings.imu_to_base, (m[0], m[1], m[2])))
    for i in range(3):
        state.position_map[i] = position[i] + offset[i]
        for j in range(3):
            covariance[POSITION + i, POSITION + j] = position_covariance[i, j]
    state.position_known = 1
    state.heading_known = 1
    state.given_stamp = state.stamp


@njit
def search_heading(state, aid, gate, settings, work):
    """Let a GNSS measurement that was fused take part in the search for the heading, and look whether it is over."""
    rotation = to_matrix(state.attitude)
    arm = settings.lever_arms_body[aid.source]
    if aid.stream == GNSS_POSITION:
        first = 0
        measured = position_of_fix(state, aid.payload)
        lever = rotate(rotation, arm)
        local_to_ecef = east_north_up_to_ecef(aid.payload[0], aid.payload[1])
    elif aid.stream == GNSS_VELOCITY:
        first = 2
        local_to_ecef = local_east_north_up_to_ecef(state)
        velocity = rotate(local_to_ecef, (aid.payload[0], aid.payload[1], aid.payload[2]))
        measured = rotate_back(state.map_to_ecef, velocity)
        lever = rotate(rotation, cross(body_rate(state, rotation), arm))
    else:
        return
    set_east_north_up_covariance(work.noise, state, local_to_ecef, aid.payload, 3)
    search_with(state, first, measured, lever, gate, settings, work)


@njit
def search_with(state, first, measured, lever, gate, settings, work):
    """Search with a position (``first`` 0, m) or velocity (2, m/s) of the antenna, covariance in ``work.noise``.

    ``measured`` in map, ``lever`` (or its velocity) in the axes of the unknown heading.
    """
    if state.search_started == 1:
        update_search(state, first, measured, lever, work.noise, gate, work)
    elif first == 0:
        reach = lever[0] ** 2 + lever[1] ** 2
        begin_search(state, measured[0], measured[1], max(work.noise[0, 0], work.noise[1, 1]) + reach)
    turn, std = turn_found(state)
    if std <= settings.found_heading_std:
        set_heading(state, heading_of(state, settings) + turn, std, settings)
        state.heading_known = 1
    elif settings.use_course == 1:
        align_to_course(state, settings)


@njit
def align_to_course(state, settings):
    """Take the unknown heading from the course, if that is certain and steady and the search knows which end is ahead.

    Accelerations tell forward from reverse, and side slip from driving straight, long before they tell the heading as
    well as the course does.
    """
    v = state.velocity_map
    speed = math.sqrt(v[0] ** 2 + v[1] ** 2)
    if speed < settings.course_min_speed or state.search_started == 0:
        return
    along = (v[0] / speed, v[1] / speed)
    covariance = state.covariance
    pxx = covariance[VELOCITY, VELOCITY]
    pxy = covariance[VELOCITY, VELOCITY + 1]
    pyy = covariance[VELOCITY + 1, VELOCITY + 1]
    along_variance = along[0] ** 2 * pxx + 2.0 * along[0] * along[1] * pxy + along[1] ** 2 * pyy
    across_variance = along[1] ** 2 * pxx - 2.0 * along[0] * along[1] * pxy + along[0] ** 2 * pyy
    course_std = math.sqrt(max(across_variance, 0.0) / speed**2 + settings.course_std**2)
    up = local_up(state)
    turn_rate = dot(up, rotate(to_matrix(state.attitude), body_rate(state, to_matrix(state.attitude))))
    if (
        across_variance > (COURSE_MAX_STD * speed) ** 2
        or speed**2 < 9.0 * along_variance
        or abs(turn_rate) > COURSE_MAX_TURN_RATE
    ):
        return
    heading = math.atan2(v[1], v[0])
    turn = heading - heading_of(state, settings)
    cosine, sine = math.cos(turn), math.sin(turn)
    ahead = cosine * state.search[COSINE] + sine * state.search[COSINE + 1]
    aside = cosine * state.search[COSINE + 1] - sine * state.search[COSINE]
    ahead_std, aside_std = spread(state, cosine, sine)
    if (
        abs(ahead) < max(CERTAIN * ahead_std, LEAST_LENGTH)
        or aside_std > COURSE_SEARCH_STD * abs(ahead)
        or abs(aside) > CERTAIN * math.hypot(aside_std, course_std * abs(ahead))
    ):
        return
    if ahead < 0.0:
        heading += math.pi
    set_heading(state, heading, course_std, settings)
    state.heading_known = 1


@njit
def recall_heading(state, payload, settings):
    """Take the remembered heading if the first fix (``payload``: rad, rad, m, covariance) finds the robot in its place.

    The state has level and position already.
    """
    if settings.has_memory == 0 or state.restarts > 0 or state.heading_known == 1:
        return
    fix = geodetic_to_ecef(payload[0], payload[1], payload[2])
    place, lever, mount = settings.remembered_place_ecef, settings.lever_arms_body[0], settings.imu_position_base
    way = (fix[0] - place[0], fix[1] - place[1], fix[2] - place[2])
    fix_std = math.sqrt(max(payload[3], payload[6], payload[8]))
    # The antenna is at most this far from base_link, on whatever side.
    reach = math.sqrt(dot(lever, lever)) + math.sqrt(dot(mount, mount))
    std = math.sqrt(fix_std**2 + settings.remembered_place_std**2)
    if math.sqrt(dot(way, way)) > reach + settings.remembered_place_tolerance + 3.0 * std:
        return
    f = settings.remembered_forward_ecef
    forward = rotate_back(state.map_to_ecef, (f[0], f[1], f[2]))
    set_heading(state, math.atan2(forward[1], forward[0]), settings.remembered_heading_std, settings)
    state.heading_known = 1
    state.given_stamp = state.stamp
