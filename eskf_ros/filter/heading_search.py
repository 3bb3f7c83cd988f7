"""Heading from acceleration: which way round the level frame of the gyros lies on the map.

Levelled but without heading, the IMU knows every acceleration up to one unknown turn about the vertical. GNSS sees the
same acceleration on the map. Written with the cosine and the sine of that turn as two states, the whole problem is
linear: a Kalman filter of position and velocity in east and north, (cos, sin), and an acceleration error in east and
north that tilt and bias leave. Nothing has to be guessed: there are no hypotheses that could lock to the wrong one, no
direction of travel is taken for granted (reversing, side slip, a multirotor), and a robot that has not accelerated has
a (cos, sin) near zero, which says that nothing is known. Where the length comes out as one, the model holds.

A uniform heading has mean (0, 0) and variance 1/2 in each of (cos, sin).
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.earth import STANDARD_GRAVITY
from eskf_ros.filter.layout import ACCEL_BIAS, GYRO_BIAS, SEARCH_SIZE

COSINE = 4
ACCELERATION = 6

START_VELOCITY_STD = 30.0
"""Of a robot at the first fix (m/s, per axis)."""

LEAST_ACCELERATION_STD = 0.01
"""What Coriolis, scale factors and settling springs leave at least (m/s2)."""

LONGEST_TURN = 2.0
"""A bias that turns with the body changes by at most twice itself."""

LENGTH_TOLERANCE = 0.1
LENGTH_STD = 0.25
"""(cos, sin) has length one within this and three sigma, and that sigma is small: else the model does not hold."""


@njit
def forget_search(state):
    """Begin anew with the next fix."""
    state.search_started = 0


@njit
def begin_search(state, east, north, variance):
    """Begin at a fix (m, map) of that variance per axis; nothing is known of velocity and heading."""
    for i in range(SEARCH_SIZE):
        state.search[i] = 0.0
        for j in range(SEARCH_SIZE):
            state.search_covariance[i, j] = 0.0
    state.search[0] = east
    state.search[1] = north
    for i in range(2):
        state.search_covariance[i, i] = variance
        state.search_covariance[2 + i, 2 + i] = START_VELOCITY_STD**2
        state.search_covariance[COSINE + i, COSINE + i] = 0.5
        state.search_covariance[ACCELERATION + i, ACCELERATION + i] = state.search_tilt_variance * STANDARD_GRAVITY**2
    state.search_started = 1


@njit
def note_level(state, tilt_variance):
    """A new level has this tilt variance (rad2) apart from the accelerometer bias, which it hides in the tilt."""
    state.search_tilt_variance = tilt_variance + (LEAST_ACCELERATION_STD / STANDARD_GRAVITY) ** 2
    state.search_age = 0.0
    state.search_turn = 0.0
    covariance = state.search_covariance
    for i in range(ACCELERATION, ACCELERATION + 2):
        state.search[i] = 0.0
        for j in range(SEARCH_SIZE):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0
        covariance[i, i] = state.search_tilt_variance * STANDARD_GRAVITY**2


@njit
def predict_search(state, acceleration, turn_rate, dt, settings):
    """Advance by ``dt`` s: ``acceleration`` (m/s2) in axes that are level and turned by the unknown angle."""
    if state.search_started == 0:
        return
    x = state.search
    a, b = acceleration[0] * dt, acceleration[1] * dt
    for i in range(2):
        x[i] += dt * x[2 + i]
    x[2] += a * x[4] - b * x[5] + dt * x[6]
    x[3] += b * x[4] + a * x[5] + dt * x[7]
    covariance = state.search_covariance
    for j in range(SEARCH_SIZE):
        covariance[0, j] += dt * covariance[2, j]
        covariance[1, j] += dt * covariance[3, j]
        covariance[2, j] += a * covariance[4, j] - b * covariance[5, j] + dt * covariance[6, j]
        covariance[3, j] += b * covariance[4, j] + a * covariance[5, j] + dt * covariance[7, j]
    for i in range(SEARCH_SIZE):
        covariance[i, 0] += dt * covariance[i, 2]
        covariance[i, 1] += dt * covariance[i, 3]
        covariance[i, 2] += a * covariance[i, 4] - b * covariance[i, 5] + dt * covariance[i, 6]
        covariance[i, 3] += b * covariance[i, 4] + a * covariance[i, 5] + dt * covariance[i, 7]

    gyro_variance, accel_variance = 0.0, 0.0
    for i in range(3):
        gyro_variance = max(gyro_variance, state.covariance[GYRO_BIAS + i, GYRO_BIAS + i])
        accel_variance = max(accel_variance, state.covariance[ACCEL_BIAS + i, ACCEL_BIAS + i])
    # A constant rate error turns by its std times the age: variance std^2 age^2, of which this is the growth.
    drift = settings.gyro_noise_density**2 + 2.0 * gyro_variance * state.search_age
    # The level has hidden the accelerometer bias in the tilt; where the body turns it comes out.
    emerging = 2.0 * accel_variance * state.search_turn * abs(turn_rate) if state.search_turn < LONGEST_TURN else 0.0
    for i in range(2):
        covariance[2 + i, 2 + i] += settings.accel_noise_density**2 * dt
        covariance[COSINE + i, COSINE + i] += drift * dt
        covariance[ACCELERATION + i, ACCELERATION + i] += (STANDARD_GRAVITY**2 * drift + emerging) * dt
    state.search_age += dt
    state.search_turn += abs(turn_rate) * dt


@njit
def update_search(state, first, measured, lever, noise, gate, work):
    """Fuse east and north of a position (``first`` 0, m) or of a velocity (2, m/s) of the antenna.

    ``lever`` is the antenna from the IMU (or its velocity), in the axes of the acceleration; ``noise`` (3, 3) in map
    axes; beyond ``gate`` in NIS nothing is fused.
    """
    x, p = state.search, state.search_covariance
    # One row of H has the one, the cosine and the sine: measured = x[first] + lever turned by (cos, sin).
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
    if not determinant > 0.0:
        return
    nis = (snn * innovation_e**2 - 2.0 * sen * innovation_e * innovation_n + see * innovation_n**2) / determinant
    if nis > gate:
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
    """Return the turn (rad) from the level axes to the map, and its standard deviation; infinite while undecided."""
    if state.search_started == 0:
        return 0.0, math.inf
    c, s = state.search[COSINE], state.search[COSINE + 1]
    length = math.sqrt(c * c + s * s)
    if length < 0.5:
        return 0.0, math.inf
    along, across = spread(state, c / length, s / length)
    if along > LENGTH_STD or abs(length - 1.0) > LENGTH_TOLERANCE + 3.0 * along:
        return 0.0, math.inf
    return math.atan2(s, c), across / length


@njit
def spread(state, cosine, sine):
    """Return the standard deviations of (cos, sin) along and across a direction."""
    p = state.search_covariance
    cc, cs, ss = p[COSINE, COSINE], p[COSINE, COSINE + 1], p[COSINE + 1, COSINE + 1]
    along = cosine**2 * cc + 2.0 * cosine * sine * cs + sine**2 * ss
    across = sine**2 * cc - 2.0 * cosine * sine * cs + cosine**2 * ss
    return math.sqrt(max(along, 0.0)), math.sqrt(max(across, 0.0))
