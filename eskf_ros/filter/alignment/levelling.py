"""Levelling: roll and pitch from gravity, and the gyro bias of a robot at rest."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading import reset_heading
from eskf_ros.filter.alignment.heading_search import note_level
from eskf_ros.filter.alignment.warm_start import do_biases_hold
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.inertial.navigation_frame import heading_of, local_up, reset_attitude, shortest_turn
from eskf_ros.filter.state.augmented_states import inflate_tilt_by_scale
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_CAPACITY, ERROR_SIZE, GYRO_BIAS
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.quiet_run import has_changed_lately
from eskf_ros.filter.stationarity.residual_motion import can_be_bias, is_moving, note_sway, variance_of_half
from eskf_ros.filter.stationarity.seen_motion import unseen_speed_variance, unseen_turn_variance
from eskf_ros.filter.stationarity.static_window import Window, force_of_last_half
from eskf_ros.geodesy.earth import EARTH_RATE, STANDARD_GRAVITY
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix, wrapped

LEVELLING = np.dtype(
    [
        ("kept_gyro_bias", "f8", (3,)),
        ("kept_gyro_variance", "f8"),
        ("unseen_braking", "f8"),
    ],
    align=True,
)
"""What levelling knows.

- ``kept_gyro_bias``, ``kept_gyro_variance``: the gyro bias (rad/s) before the run of still windows, and its variance.
- ``unseen_braking``: acceleration (m/s2; root mean square) that the last level at rest may have taken for a tilt.
"""

DRIFTED = 2.0
"""Ratio of the present tilt variance to that of a new level above which a robot in motion is levelled again."""

TURN_SIGMAS = 4.0
"""Standard deviations by which gravity must turn in the readings of a run of still windows for a robot that tilts."""

LEAST_TURN = 5e-4
"""m/s2 per second (0.003 deg/s); readings of gravity that change more slowly may be those of a drifting bias."""

LARGEST_CHANGE_STD = 1e-2
"""m/s2 per second (0.06 deg/s); where the change is known no better, a body that sways says nothing of a slow turn."""

UNKNOWN_SPEED = 10.0
"""m/s; speed assumed where it is unknown: in a turn, levelling takes its centripetal acceleration for tilt."""


@njit
def level(state, sums, count, interval, is_rest, settings):
    """Set roll and pitch from mean readings and, at rest, the gyro bias; the heading stays as it was.

    ``sums`` of force (m/s2) and rate (rad/s) over ``count`` samples, ``interval`` s apart.
    """
    duration = count * interval
    force = (sums[0] / count, sums[1] / count, sums[2] / count)
    rate = (sums[3] / count, sums[4] / count, sums[5] / count)
    is_first = count == state.window.samples
    if is_first:
        keep_gyro_bias(state)
    accel_bias, accel_variance, gyro_bias, gyro_variance = known_biases(state, force, rate, duration, is_rest, settings)
    if is_rest and not can_be_rest(state, rate, gyro_bias, gyro_variance, duration, settings):
        # Readings that may not be at rest are treated as motion: they have to wait.
        state.window.still_stamp = NEVER
        state.window.still_samples = 0
        if state.level_known == 1 or (state.stamp - state.first_stamp) * 1e-9 < settings.moving_start_after:
            return
        is_rest = False
    force = (force[0] - accel_bias[0], force[1] - accel_bias[1], force[2] - accel_bias[2])
    strength, turn_variance = math.sqrt(dot(force, force)), 0.0
    if strength < 0.5 * STANDARD_GRAVITY:
        return
    if is_rest:
        note_sway(state, is_first, settings)
        braking = state.window.still_speed / duration
        change, variance = change_of_gravity(state, settings)
        if dot(change, change) > 0.0:
            end = force_of_last_half(state)
            force = (end[0] - accel_bias[0], end[1] - accel_bias[1], end[2] - accel_bias[2])
            strength = math.sqrt(dot(force, force))
            rate = without_turn(force, rate, change)
        # Readings that are those remembered from where the robot was left are not those of a robot that tilts.
        is_remembered = accel_variance < settings.accel_bias_std**2
        turn_variance = 0.0 if is_remembered else variance / strength**2
        tilt_noise = tilt_noise_at_rest(state, duration, strength, braking, settings)
        if is_level_better_known(state, accel_variance / strength**2 + tilt_noise, braking):
            return
        state.levelling.unseen_braking = braking
    else:
        tilt_noise = settings.moving_tilt_std**2 + dot(rate, rate) * (assumed_speed(state) / strength) ** 2
    heading = heading_of(state, settings)
    up = local_up(state)
    measured = rotate(to_matrix(state.attitude), (force[0] / strength, force[1] / strength, force[2] / strength))
    reset_attitude(state, shortest_turn(measured, up))
    reset_tilt(state, up, strength, accel_bias, accel_variance, tilt_noise, settings)
    update_gyro_bias_at_rest(state, gyro_bias, gyro_variance, rate, turn_variance, up, duration, is_rest, settings)
    if is_rest:
        state.search.turning_age = 0.0
    # The parameter holds at the first start only: after a restart the robot may have turned.
    if state.level_known == 0 and state.restarts == 0 and not math.isnan(settings.initial_heading):
        state.heading_known = 1
        reset_heading(state, settings.initial_heading, settings.initial_heading_std, settings)
        state.heading.given_stamp = state.stamp
    state.odom.jump_heading += wrapped(heading_of(state, settings) - heading)
    state.level_known = 1


@njit
def known_biases(state, force, rate, duration, is_rest, settings):
    """Return accelerometer bias (m/s2), its variance, gyro bias (rad/s), its variance as known before this level.

    They come from the last run if the readings allow it, from the windows before this run of still windows, else from
    the parameters.
    """
    accel_bias, accel_variance = (0.0, 0.0, 0.0), settings.accel_bias_std**2
    gyro_bias, gyro_variance = (0.0, 0.0, 0.0), settings.gyro_bias_std**2
    if do_biases_hold(state, force, rate, duration, is_rest, settings):
        b, r = settings.remembered_accel_bias, settings.remembered_gyro_bias
        accel_bias, accel_variance = (b[0], b[1], b[2]), settings.remembered_accel_bias_std**2
        gyro_bias, gyro_variance = (r[0], r[1], r[2]), settings.remembered_gyro_bias_std**2
    if state.levelling.kept_gyro_variance < gyro_variance:
        b = state.levelling.kept_gyro_bias
        gyro_bias, gyro_variance = (b[0], b[1], b[2]), state.levelling.kept_gyro_variance
    return accel_bias, accel_variance, gyro_bias, gyro_variance


@njit
def can_be_rest(state, rate, gyro_bias, gyro_variance, duration, settings):
    """Say whether quiet readings can be those of rest: no even braking, no slow turn, no unexpected bias."""
    if state.residual.moved_first == 1 or is_moving(state):
        return False
    return can_be_bias(rate, gyro_bias, math.sqrt(gyro_variance), mean_rate_std(state, duration, settings))


@njit
def sway_left(sway, duration, settings):
    """Return the variance that residual motion leaves in a mean over ``duration`` (s); ``sway``: in one window."""
    return sway * min(1.0, settings.static_duration / duration)


@njit
def tilt_noise_at_rest(state, duration, strength, braking, settings):
    """Return the variance (rad2) of the direction of the mean force, without that of the accelerometer bias.

    The bias is a random walk: its value at the end differs from its mean by a third of the variance that it gains
    meanwhile. ``braking`` (m/s2): the acceleration that would have used up, in the run, the speed that the robot may
    have had when it began; to brake evenly is as quiet as rest.
    """
    walked = settings.accel_bias_random_walk**2 * duration / 3.0
    swayed = sway_left(state.residual.force_variance, duration, settings)
    return (settings.accel_noise_density**2 / duration + walked + swayed + braking**2) / strength**2


@njit
def change_of_gravity(state, settings):
    """Return the change of the mean force in a run of still windows (m/s2 per second, IMU axes), and its variance.

    It is that from the first half of its first window to the second half of its last one, and zero where it is no more
    than noise, or noise hides it. A robot that tilts while it stands, as one that is loaded does, would pass for one
    with another gyro bias.

    Nor is it a turn where it may be the acceleration of a robot that sets out, growing by j in each of T seconds up to
    a speed of j T^2 / 2 that its sensors do not exclude. What is no proven turn may be one all the same.
    """
    window, variance = state.window, variance_of_half(state)
    if variance == 0.0:
        return (0.0, 0.0, 0.0), 0.0
    duration = (state.stamp - window.still_start) * 1e-9
    passed = duration - 0.5 * settings.static_duration
    variance *= 2.0 / passed**2
    if variance > LARGEST_CHANGE_STD**2:
        return (0.0, 0.0, 0.0), 0.0
    end, start = force_of_last_half(state), window.still_force
    change = ((end[0] - start[0]) / passed, (end[1] - start[1]) / passed, (end[2] - start[2]) / passed)
    start_variance = 4.0 * unseen_speed_variance(state) / duration**4
    square = dot(change, change)
    if square > TURN_SIGMAS**2 * (variance + start_variance + LEAST_TURN**2):
        return change, variance + start_variance
    return (0.0, 0.0, 0.0), variance + square


@njit
def without_turn(force, rate, change):
    """Return the mean rate (rad/s) in a run of still windows without the turn that gravity shows.

    ``change``: of the force (m/s2 per second). Gravity that turns in the body by w x f comes from the rate
    w = change x f / f^2.
    """
    turn, square = cross(change, force), dot(force, force)
    return (rate[0] - turn[0] / square, rate[1] - turn[1] / square, rate[2] - turn[2] / square)


@njit
def is_level_better_known(state, variance, braking):
    """Say whether a robot that sways, or may have braked, already has a level with a smaller variance (rad2)."""
    known = max(state.covariance[ATTITUDE, ATTITUDE], state.covariance[ATTITUDE + 1, ATTITUDE + 1])
    is_doubtful = state.residual.force_variance > 0.0 or braking > 0.0
    return is_doubtful and state.level_known == 1 and known < variance


@njit
def reset_tilt(state, up, strength, accel_bias, accel_variance, tilt_noise, settings):
    """Set the accelerometer bias, and the covariance of tilt, heading and accelerometer bias after a levelling.

    The accelerometer bias tilts the level: theta = up x (R dba) / g. Hence their cross covariance (Groves, section
    5.6.2).
    """
    rotation = to_matrix(state.attitude)
    covariance = state.covariance
    for i in range(ATTITUDE, ERROR_SIZE):
        for j in range(ERROR_CAPACITY):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0
    note_level(state, tilt_noise, accel_variance, rotation, settings)
    heading_variance = settings.initial_heading_std**2 if state.heading_known == 1 else math.pi**2
    for i in range(3):
        state.accel_bias[i] = accel_bias[i]
        covariance[ACCEL_BIAS + i, ACCEL_BIAS + i] = accel_variance
        # Column i of [up]x R / g.
        tilt = cross(up, (rotation[0][i], rotation[1][i], rotation[2][i]))
        for j in range(3):
            covariance[ATTITUDE + j, ACCEL_BIAS + i] = tilt[j] / strength * accel_variance
            covariance[ACCEL_BIAS + i, ATTITUDE + j] = tilt[j] / strength * accel_variance
        for j in range(3):
            horizontal = -up[i] * up[j]
            if i == j:
                horizontal += 1.0
            covariance[ATTITUDE + i, ATTITUDE + j] = (
                horizontal * (accel_variance / strength**2 + tilt_noise) + up[i] * up[j] * heading_variance
            )
    inflate_tilt_by_scale(state, up, settings)


@njit
def assumed_speed(state):
    """Return the speed (m/s) that a robot is assumed to have in a turn: that which GNSS tells, if it is faster."""
    if state.position_known == 0:
        return UNKNOWN_SPEED
    return max(UNKNOWN_SPEED, math.hypot(state.velocity_map[0], state.velocity_map[1]))


@njit
def keep_gyro_bias(state):
    """Keep the known gyro bias when a run of still windows begins, as the prior of the whole run."""
    state.levelling.kept_gyro_variance = math.inf
    if state.level_known == 0:
        return
    state.levelling.kept_gyro_variance = 0.0
    for i in range(3):
        state.levelling.kept_gyro_bias[i] = state.gyro_bias[i]
        variance = state.covariance[GYRO_BIAS + i, GYRO_BIAS + i]
        state.levelling.kept_gyro_variance = max(state.levelling.kept_gyro_variance, variance)


@njit
def update_level(state, window, settings):
    """Level at the end of a static window (`Window`): at rest or, if rest does not come, in motion."""
    if state.heading_known == 0 or state.position_known == 0:
        interval = (state.stamp - state.window.start) * 1e-9 / state.window.samples
        if window == Window.REST:
            state.window.still_stamp = state.stamp
            level(state, state.window.still_total, state.window.still_samples, interval, True, settings)
        elif state.level_known == 0 and (state.stamp - state.first_stamp) * 1e-9 >= settings.moving_start_after:
            level(state, state.window.total, state.window.samples, interval, False, settings)
    update_level_in_motion(state, settings)


@njit
def update_level_in_motion(state, settings):
    """Level in motion at the end of a window, if the gyros have drifted further than such a level is wrong.

    A robot that is never at rest has no known gyro bias, and without a heading GNSS does not observe its tilt.
    """
    if state.level_known == 0 or state.heading_known == 1 or state.window.still_stamp == state.stamp:
        return
    n = state.window.samples
    rate_square = (state.window.total[3] ** 2 + state.window.total[4] ** 2 + state.window.total[5] ** 2) / n**2
    fresh = settings.moving_tilt_std**2 + rate_square * (assumed_speed(state) / STANDARD_GRAVITY) ** 2
    drifted = max(state.covariance[ATTITUDE, ATTITUDE], state.covariance[ATTITUDE + 1, ATTITUDE + 1])
    if drifted > DRIFTED * fresh:
        level(state, state.window.total, n, settings.static_duration / n, False, settings)


@njit
def mean_rate_std(state, duration, settings):
    """Return the standard deviation (rad/s) of the mean rate at rest over ``duration`` (s) about the present bias."""
    white = gyro_density(state, settings) ** 2 / duration
    return math.sqrt(white + settings.gyro_bias_random_walk**2 * duration / 3.0)


@njit
def update_gyro_bias_at_rest(state, prior_bias, prior, mean_rate, turn_variance, up, duration, is_rest, settings):
    """Set the gyro bias to the weighted mean of its prior and of the mean rate at rest minus the Earth rate.

    A turn that gravity has shown is taken out of ``mean_rate`` (rad/s) already, with the variance ``turn_variance``.

    The prior (``prior_bias``, rad/s, IMU axes, with variance ``prior``) and the mean rate are weighed along the
    vertical and across it, because without a heading only the vertical part of the Earth rate is known. The unknown
    part enters the variance.
    """
    rotation = to_matrix(state.attitude)
    noise = mean_rate_std(state, duration, settings) ** 2
    if is_rest:
        noise += sway_left(state.residual.rate_variance, duration, settings)
    earth = state.frame.earth_rate_map
    vertical_rate = dot(up, earth)
    horizontal_square = dot(earth, earth) - vertical_rate**2
    known = (vertical_rate * up[0], vertical_rate * up[1], vertical_rate * up[2])
    vertical_variance = noise
    # Its direction is unknown: half of its square falls on each horizontal axis.
    horizontal_variance = noise + 0.5 * horizontal_square
    if state.frame.datum_known == 0:
        vertical_variance = noise + EARTH_RATE**2
        horizontal_variance = noise + EARTH_RATE**2
    elif state.heading_known == 1:
        known = (earth[0], earth[1], earth[2])
        horizontal_variance = noise + horizontal_square * settings.initial_heading_std**2
    horizontal_variance += turn_variance
    # A turn that nothing excludes may be what the gyro reads.
    vertical_variance += unseen_turn_variance(state, has_changed_lately(state))
    vertical_gain = prior / (prior + vertical_variance) if is_rest and prior > 0.0 else 0.0
    horizontal_gain = prior / (prior + horizontal_variance) if is_rest and prior > 0.0 else 0.0
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
            state.covariance[GYRO_BIAS + i, GYRO_BIAS + j] = (along - across) * (up_body[i] * up_body[j])
        state.covariance[GYRO_BIAS + i, GYRO_BIAS + i] += across


@njit
def reset_level_to_moving(state, settings):
    """Reset tilt and gyro bias to the uncertainty of a level taken in motion: the last level was not taken at rest."""
    state.window.still_stamp = NEVER
    state.window.still_samples = 0
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
