"""Heading search: the heading from accelerations, as a linear estimation problem.

A levelled IMU without heading knows every acceleration up to one unknown turn about the vertical. GNSS observes the
same acceleration on the map. With the cosine and the sine of that turn as two states the whole problem is linear: a
Kalman filter of position and velocity in east and north, (cos, sin), and the acceleration errors from tilt and
accelerometer bias. There are no hypotheses that could lock to a wrong heading, and no direction of travel is assumed
(reversing, side slip, a multirotor). A robot that has not accelerated has a (cos, sin) near zero: nothing is known.
Where the length of (cos, sin) comes out as one, the model holds.

The error of the acceleration in east and north is tilt + R bias, with R the turn of the body since the gyros began.
Levelling hides the bias in the tilt, tilt = -R bias; when the body turns, the bias shows. Turns about the vertical
commute, so both are constant in east and north, whatever the unknown turn is.

A uniform heading has mean (0, 0) and variance 1/2 in each of (cos, sin).
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.state.error_state import ACCEL_BIAS, GYRO_BIAS
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.geodesy.rotation import rotate

SEARCH_SIZE = 10
"""States of the search, two each: position (m), velocity (m/s), (cos, sin), tilt and accelerometer bias (m/s2)."""

SEARCH = np.dtype(
    [
        ("started", "i8"),
        ("estimate", "f8", (SEARCH_SIZE,)),
        ("covariance", "f8", (SEARCH_SIZE, SEARCH_SIZE)),
        ("age", "f8"),
        ("turning_age", "f8"),
        ("course_since", "i8"),
    ],
    align=True,
)
"""The search for the heading: whether it has started, its states and their covariance.

- ``age``: seconds since the last level.
- ``turning_age``: seconds since the gyros last stood or, if later, since the search began.
- ``course_since``: since when the course over ground agrees with it (ns).
"""

COSINE = 4
"""Index of (cos, sin) among the states."""

TILT = 6
"""Index of the acceleration errors from tilt, in east and north."""

BIAS = 8
"""Index of the horizontal accelerometer bias, along x and y of base_link turned into the level plane."""

START_VELOCITY_STD = 200.0
"""m/s per axis; prior of the velocity at the first fix, which may be in flight."""

LEAST_ACCELERATION_STD = 0.01
"""m/s2; least standard deviation of acceleration errors after levelling: Coriolis, scale factors, settling springs."""

LEANING_TIME = 10.0
"""s; a body that leans shows another part of its accelerometer bias for about this long."""

LEAST_LEVEL = 0.1
"""Horizontal length of the unit vector along the x axis of base_link below which the turn of the body is undefined: the
body turns about this axis instead of turning it.
"""

LENGTH_TOLERANCE = 0.1
"""The length of (cos, sin) must not differ from one by more than this plus three standard deviations."""

CHANCE_GATE = 9.21
"""NIS of two errors up to which they may be chance: the 0.99 quantile of chi-square with 2 degrees of freedom."""

LENGTH_STD = 0.25
"""The heading is undecided while the standard deviation of the length of (cos, sin) exceeds this."""


@njit
def forget_search(state):
    """Stop the search and the watch for a turn in place, so that the next fix begins new ones."""
    state.search.started = 0
    state.spot.stamp = NEVER


@njit
def begin_search(state, east, north, variance):
    """Begin a search at a fix (m, map) with ``variance`` (m2) per axis; velocity and heading are unknown."""
    for i in range(TILT):
        state.search.estimate[i] = 0.0
        for j in range(SEARCH_SIZE):
            state.search.covariance[i, j] = 0.0
            state.search.covariance[j, i] = 0.0
    state.search.estimate[0] = east
    state.search.estimate[1] = north
    for i in range(2):
        state.search.covariance[i, i] = variance
        state.search.covariance[2 + i, 2 + i] = START_VELOCITY_STD**2
        state.search.covariance[COSINE + i, COSINE + i] = 0.5
    state.search.turning_age = 0.0
    state.search.course_since = NEVER
    state.search.started = 1


@njit
def turn_of_body(rotation, settings):
    """Return cosine and sine of the turn of base_link in the level axes, and by how much (sine squared) it leans."""
    m = settings.imu_to_base
    forward = rotate(rotation, (m[0, 0], m[0, 1], m[0, 2]))
    upright = rotate(rotation, (m[2, 0], m[2, 1], m[2, 2]))
    level = math.sqrt(forward[0] ** 2 + forward[1] ** 2)
    leaning = upright[0] ** 2 + upright[1] ** 2
    if level < LEAST_LEVEL:
        return 1.0, 0.0, leaning
    return forward[0] / level, forward[1] / level, leaning


@njit
def note_level(state, tilt_variance, accel_bias_variance, rotation, settings):
    """Reset the tilt of the search after a levelling, which hides the accelerometer bias in the tilt.

    ``tilt_variance`` (rad2) is that of the other errors of the level; ``rotation``: from IMU to level axes. What a
    running search has learnt of the bias stays.
    """
    x, p = state.search.estimate, state.search.covariance
    if state.search.started == 0:
        for i in range(BIAS, SEARCH_SIZE):
            x[i] = 0.0
            for j in range(SEARCH_SIZE):
                p[i, j] = 0.0
                p[j, i] = 0.0
            p[i, i] = accel_bias_variance
    c, s, _ = turn_of_body(rotation, settings)
    x[TILT] = -c * x[BIAS] + s * x[BIAS + 1]
    x[TILT + 1] = -s * x[BIAS] - c * x[BIAS + 1]
    for j in range(SEARCH_SIZE):
        p[TILT, j] = -c * p[BIAS, j] + s * p[BIAS + 1, j]
        p[TILT + 1, j] = -s * p[BIAS, j] - c * p[BIAS + 1, j]
    for i in range(SEARCH_SIZE):
        p[i, TILT] = -c * p[i, BIAS] + s * p[i, BIAS + 1]
        p[i, TILT + 1] = -s * p[i, BIAS] - c * p[i, BIAS + 1]
    for i in range(TILT, BIAS):
        p[i, i] += STANDARD_GRAVITY**2 * tilt_variance + LEAST_ACCELERATION_STD**2
    state.search.age = 0.0


@njit
def predict_search(state, acceleration, rotation, dt, settings):
    """Predict the search over ``dt`` s: ``acceleration`` (m/s2) in level axes turned by the unknown heading.

    ``rotation``: from IMU to these axes.
    """
    if state.search.started == 0:
        return
    x = state.search.estimate
    c, s, leaning = turn_of_body(rotation, settings)
    c, s = c * dt, s * dt
    a, b = acceleration[0] * dt, acceleration[1] * dt
    for i in range(2):
        x[i] += dt * x[2 + i]
    x[2] += a * x[4] - b * x[5] + dt * x[6] + c * x[8] - s * x[9]
    x[3] += b * x[4] + a * x[5] + dt * x[7] + s * x[8] + c * x[9]
    p = state.search.covariance
    for j in range(SEARCH_SIZE):
        p[0, j] += dt * p[2, j]
        p[1, j] += dt * p[3, j]
        p[2, j] += a * p[4, j] - b * p[5, j] + dt * p[6, j] + c * p[8, j] - s * p[9, j]
        p[3, j] += b * p[4, j] + a * p[5, j] + dt * p[7, j] + s * p[8, j] + c * p[9, j]
    for i in range(SEARCH_SIZE):
        p[i, 0] += dt * p[i, 2]
        p[i, 1] += dt * p[i, 3]
        p[i, 2] += a * p[i, 4] - b * p[i, 5] + dt * p[i, 6] + c * p[i, 8] - s * p[i, 9]
        p[i, 3] += b * p[i, 4] + a * p[i, 5] + dt * p[i, 7] + s * p[i, 8] + c * p[i, 9]

    gyro_variance, accel_variance = 0.0, 0.0
    for i in range(3):
        gyro_variance = max(gyro_variance, state.covariance[GYRO_BIAS + i, GYRO_BIAS + i])
        accel_variance = max(accel_variance, state.covariance[ACCEL_BIAS + i, ACCEL_BIAS + i])
    # A constant rate error turns by its std times the age: variance std^2 age^2, of which this is the growth.
    white = gyro_density(state, settings) ** 2
    drift = white + 2.0 * gyro_variance * state.search.age
    turn_drift = white + 2.0 * gyro_variance * state.search.turning_age
    velocity_noise = settings.accel_noise_density**2 + LEANING_TIME * leaning * accel_variance
    for i in range(2):
        p[2 + i, 2 + i] += velocity_noise * dt
        p[COSINE + i, COSINE + i] += turn_drift * dt
        p[TILT + i, TILT + i] += STANDARD_GRAVITY**2 * drift * dt
        p[BIAS + i, BIAS + i] += settings.accel_bias_random_walk**2 * dt
    state.search.age += dt
    state.search.turning_age += dt


@njit
def hide_motion(state, velocity_variance, turn_variance):
    """Widen the search by motion that was not measured: a change of velocity (m2/s2 per axis) and a turn (rad2).

    The watch for a turn in place stops.

    A turn by an angle d, normal with variance q, leaves exp(-q/2) of the mean of x = (cos, sin), and exp(-2 q) of the
    part of E[x x'] that has a direction (moments of a wrapped normal; Mardia and Jupp, Directional Statistics, section
    3.5.7).
    """
    state.spot.stamp = NEVER
    if state.search.started == 0:
        return
    x, p, c = state.search.estimate, state.search.covariance, COSINE
    left, left_twice = math.exp(-0.5 * turn_variance), math.exp(-2.0 * turn_variance)
    mean = 0.5 * (p[c, c] + p[c + 1, c + 1] + x[c] ** 2 + x[c + 1] ** 2)
    cosine = mean + left_twice * (p[c, c] + x[c] ** 2 - mean)
    sine = mean + left_twice * (p[c + 1, c + 1] + x[c + 1] ** 2 - mean)
    mixed = left_twice * (p[c, c + 1] + x[c] * x[c + 1])
    for i in range(c, c + 2):
        x[i] *= left
        for j in range(SEARCH_SIZE):
            p[i, j] *= left
            p[j, i] *= left
    p[c, c] = cosine - x[c] ** 2
    p[c + 1, c + 1] = sine - x[c + 1] ** 2
    p[c, c + 1] = p[c + 1, c] = mixed - x[c] * x[c + 1]
    for i in range(2):
        p[2 + i, 2 + i] += velocity_variance
        p[TILT + i, TILT + i] += STANDARD_GRAVITY**2 * turn_variance


@njit
def update_search(state, first, measured, lever, noise, gate, work):
    """Update the search with east and north of a position (``first`` 0, m) or velocity (2, m/s) of the antenna.

    ``lever`` is the antenna from the IMU (or its velocity) in the axes of the acceleration; ``noise`` (3, 3) is in map
    axes. A measurement whose NIS is above ``gate`` is not fused.
    """
    x, p = state.search.estimate, state.search.covariance
    # measured = x[first] + lever turned by (cos, sin): the columns of H for cosine and sine.
    h = ((lever[0], -lever[1]), (lever[1], lever[0]))
    innovation_e = measured[0] - x[first] - h[0][0] * x[4] - h[0][1] * x[5]
    innovation_n = measured[1] - x[first + 1] - h[1][0] * x[4] - h[1][1] * x[5]
    east, north = work.projected[0], work.projected[1]
    for j in range(SEARCH_SIZE):
        east[j] = p[first, j] + h[0][0] * p[4, j] + h[0][1] * p[5, j]
        north[j] = p[first + 1, j] + h[1][0] * p[4, j] + h[1][1] * p[5, j]
    see = east[first] + h[0][0] * east[4] + h[0][1] * east[5] + noise[0, 0]
    sen = east[first + 1] + h[1][0] * east[4] + h[1][1] * east[5] + noise[0, 1]
    snn = north[first + 1] + h[1][0] * north[4] + h[1][1] * north[5] + noise[1, 1]
    determinant = see * snn - sen * sen
    if not determinant > 0.0 or nis_of_pair(innovation_e, innovation_n, see, sen, snn) > gate:
        return
    for i in range(SEARCH_SIZE):
        gain_e = (snn * east[i] - sen * north[i]) / determinant
        gain_n = (see * north[i] - sen * east[i]) / determinant
        x[i] += gain_e * innovation_e + gain_n * innovation_n
        for j in range(i + 1):
            p[i, j] -= gain_e * east[j] + gain_n * north[j]
            p[j, i] = p[i, j]


@njit
def turn_found(state):
    """Return the turn (rad) from the level axes to the map and its standard deviation (rad, infinite if undecided)."""
    if state.search.started == 0:
        return 0.0, math.inf
    c, s = state.search.estimate[COSINE], state.search.estimate[COSINE + 1]
    length = math.sqrt(c * c + s * s)
    if length < 0.5:
        return 0.0, math.inf
    along, across = spread(state, c / length, s / length)
    if along > LENGTH_STD or abs(length - 1.0) > LENGTH_TOLERANCE + 3.0 * along:
        return 0.0, math.inf
    return math.atan2(s, c), across / length


@njit
def is_faster_than(state, speed):
    """Say whether the search has a velocity above ``speed`` (m/s) that is not chance."""
    if state.search.started == 0:
        return False
    east, north = state.search.estimate[2], state.search.estimate[3]
    p = state.search.covariance
    is_fast = east * east + north * north > speed * speed
    return is_fast and nis_of_pair(east, north, p[2, 2], p[2, 3], p[3, 3]) > CHANCE_GATE


@njit
def agrees_with_search(state, cosine, sine, variances):
    """Say whether another estimate of (cos, sin) is that of the search, as far as both know it.

    ``variances`` (3,): of the cosine, of both, of the sine.
    """
    if state.search.started == 0:
        return True
    x, p, c = state.search.estimate, state.search.covariance, COSINE
    xx, xy, yy = variances[0] + p[c, c], variances[1] + p[c, c + 1], variances[2] + p[c + 1, c + 1]
    return nis_of_pair(cosine - x[c], sine - x[c + 1], xx, xy, yy) <= CHANCE_GATE


@njit
def nis_of_pair(x, y, xx, xy, yy):
    """Return the normalised square of a vector (``x``, ``y``) of covariance ((xx, xy), (xy, yy))."""
    determinant = xx * yy - xy * xy
    return (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant if determinant > 0.0 else math.inf


@njit
def spread(state, cosine, sine):
    """Return the standard deviations of (cos, sin) along and across the direction ``cosine``, ``sine``."""
    p = state.search.covariance
    cc, cs, ss = p[COSINE, COSINE], p[COSINE, COSINE + 1], p[COSINE + 1, COSINE + 1]
    along = cosine**2 * cc + 2.0 * cosine * sine * cs + sine**2 * ss
    across = sine**2 * cc - 2.0 * cosine * sine * cs + cosine**2 * ss
    return math.sqrt(max(along, 0.0)), math.sqrt(max(across, 0.0))
