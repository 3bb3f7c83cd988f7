"""Optional states: scales, mounting, offsets and errors of sensors, estimated with the core when their sensor is there.

Each has a fixed place behind the core (``settings.NAME_at``) and costs nothing until it joins, with the first
measurement that needs it: from then on ``state.error_size`` reaches over it. Its error is a sum (true = estimate +
error); value and variance live in ``state.optional`` and ``state.covariance``. By itself it is a random walk, or a
first-order Gauss-Markov process if it has a correlation time (Gelb, Applied Optimal Estimation, section 3.8). The core
does not depend on any of them: their columns of the covariance turn with the core's transition and no more.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.state.error_state import ERROR_SIZE


@njit
def update_error_size(state, reach, settings):
    """Take the optional states into use, so that ``reach`` errors are."""
    if reach > state.error_size:
        reset_augmented(state, state.error_size, reach - state.error_size, settings)
        state.error_size = reach


@njit
def reset_augmented(state, place, count, settings):
    """Begin again with ``count`` optional states from ``place``: zero, as uncertain as at first, independent."""
    covariance = state.covariance
    for i in range(place, place + count):
        state.optional[i - ERROR_SIZE] = 0.0
        for j in range(len(covariance)):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0
        covariance[i, i] = settings.optional_std[i - ERROR_SIZE] ** 2


@njit
def propagate_augmented(state, dt, settings):
    """Let ``dt`` s pass for the optional states: they decay towards zero and become less certain."""
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
def propagate_clock(state, place, dt, settings):
    """Let ``dt`` s pass for the receiver's clock: the bias gains what the drift says, and what the drift gains.

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
