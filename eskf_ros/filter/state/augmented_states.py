"""Augmented states: scales, mounting, offsets and errors of sensors, estimated if their sensor is there.

Each has a fixed index behind the core (``settings.NAME_at``) and costs nothing until the first measurement that needs
it activates it: from then on ``state.error_size`` includes it. Its error is additive (true = estimate + error); its
value is in ``state.optional``, its variance in ``state.covariance``. It is a random walk or, with a correlation time, a
first-order Gauss-Markov process (Gelb, Applied Optimal Estimation, section 3.8). The core does not depend on any of
them: the transition matrix of the core acts on their columns of the covariance and does no more.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, SOURCES, VELOCITY
from eskf_ros.geodesy.rotation import cross, dot, to_matrix


@njit
def update_error_size(state, reach, settings):
    """Activate augmented states until ``reach`` errors are in use."""
    if reach > state.error_size:
        first = state.error_size
        reset_augmented(state, first, reach - first, settings)
        state.error_size = reach
        if first <= settings.imu_scale_at < reach:
            # They join with the first fix, which is at the datum: z of map is up.
            inflate_tilt_by_scale(state, (0.0, 0.0, 1.0), settings)


@njit
def reset_augmented(state, place, count, settings):
    """Reset ``count`` augmented states from index ``place``: value zero, initial variance, no correlations."""
    covariance = state.covariance
    for i in range(place, place + count):
        state.optional[i - ERROR_SIZE] = 0.0
        state.forward.renewed |= 1 << (i - ERROR_SIZE)
        for j in range(len(covariance)):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0
        covariance[i, i] = settings.optional_std[i - ERROR_SIZE] ** 2
        for source in range(SOURCES):
            state.installation.absorbed[source, i].fill(0.0)


@njit
def propagate_augmented(state, dt, settings):
    """Propagate the augmented states over ``dt`` s: they decay towards zero and gain process noise."""
    covariance = state.covariance
    if settings.clock_at < state.error_size:
        propagate_clock(state, settings.clock_at, dt, settings)
    for k in range(state.error_size - ERROR_SIZE):
        i = ERROR_SIZE + k
        if settings.optional_decay[k] > 0.0:
            remaining = 1.0 - settings.optional_decay[k] * dt
            state.optional[k] *= remaining
            for j in range(state.error_size):
                covariance[i, j] *= remaining
                covariance[j, i] *= remaining
        covariance[i, i] += settings.optional_noise_density[k] ** 2 * dt


@njit
def unscaled(state, reading, bias, first, settings):
    """Return a reading (3,) in IMU axes as it would be without the estimated scale errors from index ``first`` on.

    reading = (1 + scale) true + bias, and the bias is taken off elsewhere.
    """
    place = settings.imu_scale_at
    if place >= state.error_size:
        return (reading[0], reading[1], reading[2])
    scale = state.optional[place - ERROR_SIZE + first : place - ERROR_SIZE + first + 3]
    return (
        (reading[0] - bias[0]) / (1.0 + scale[0]) + bias[0],
        (reading[1] - bias[1]) / (1.0 + scale[1]) + bias[1],
        (reading[2] - bias[2]) / (1.0 + scale[2]) + bias[2],
    )


@njit
def inflate_tilt_by_scale(state, up, settings):
    """Give the tilt its share of the scale errors of the accelerometers, where they are estimated.

    Levelling takes what they read at rest for gravity: a scale error s tilts the level as the bias s f does (see
    `alignment.levelling.reset_tilt`), theta = up x (R s f) / g with f = g R' up. ``up``: unit vector (map).
    """
    place, covariance = settings.imu_scale_at, state.covariance
    if place >= state.error_size:
        return
    rotation = to_matrix(state.attitude)
    for k in range(3):
        axis = (rotation[0][k], rotation[1][k], rotation[2][k])
        along, tilt = dot(up, axis), cross(up, axis)
        for i in range(3):
            for j in range(state.error_size):
                covariance[ATTITUDE + i, j] += along * tilt[i] * covariance[place + k, j]
        for i in range(3):
            for j in range(state.error_size):
                covariance[j, ATTITUDE + i] += along * tilt[i] * covariance[j, place + k]


@njit
def propagate_scale(state, rotation, force, rate, dt, coupling, settings):
    """Let the scale errors of the IMU act on the covariance of velocity and attitude for ``dt`` s.

    ``rotation``: body to map; ``force``, ``rate``: readings (m/s2, rad/s; IMU axes). A scale error s acts as a bias of
    s times what its axis measures; ``coupling`` 0 cuts the velocity off (unknown heading).
    """
    place, covariance = settings.imu_scale_at, state.covariance
    if place >= state.error_size:
        return
    for k in range(6):
        axis, block, effect = k % 3, VELOCITY, -coupling * dt
        if k < 3:
            effect *= force[axis] - state.accel_bias[axis]
        else:
            block, effect = ATTITUDE, -dt * (rate[axis] - state.gyro_bias[axis])
        effect /= 1.0 + state.optional[place - ERROR_SIZE + k]
        for i in range(3):
            for j in range(state.error_size):
                covariance[block + i, j] += effect * rotation[i][axis] * covariance[place + k, j]
        for i in range(3):
            for j in range(state.error_size):
                covariance[j, block + i] += effect * rotation[i][axis] * covariance[j, place + k]
    for i in range(state.error_size):
        for j in range(i):
            covariance[j, i] = covariance[i, j]


@njit
def propagate_clock(state, place, dt, settings):
    """Propagate the receiver clock over ``dt`` s: the drift, with its process noise, enters the bias.

    Two-state clock (Brown and Hwang, Introduction to Random Signals and Applied Kalman Filtering, section 9.3); the
    white noise of each of its two states is left to `propagate_augmented`.
    """
    covariance = state.covariance
    state.optional[place - ERROR_SIZE] += dt * state.optional[place + 1 - ERROR_SIZE]
    for j in range(state.error_size):
        covariance[place, j] += dt * covariance[place + 1, j]
    for j in range(state.error_size):
        covariance[j, place] += dt * covariance[j, place + 1]
    density = settings.optional_noise_density[place + 1 - ERROR_SIZE] ** 2
    covariance[place, place] += density * dt * dt * dt / 3.0
    covariance[place, place + 1] += density * dt * dt / 2.0
    covariance[place + 1, place] += density * dt * dt / 2.0
