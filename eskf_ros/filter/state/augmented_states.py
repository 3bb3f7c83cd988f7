"""Augmented states: scales, mounting, offsets and errors of sensors, estimated if their sensor is there.

Each has a fixed index behind the core (``settings.NAME_at``) and costs nothing until the first measurement that needs
it activates it: from then on ``state.error_size`` includes it. Its error is additive (true = estimate + error); its
value is in ``state.optional``, its variance in ``state.covariance``. It is a random walk or, with a correlation time, a
first-order Gauss-Markov process (Gelb, Applied Optimal Estimation, section 3.8). The core does not depend on any of
them: the transition matrix of the core acts on their columns of the covariance and does no more.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.state.error_state import ERROR_SIZE


@njit
def update_error_size(state, reach, settings):
    """Activate augmented states until ``reach`` errors are in use."""
    if reach > state.error_size:
        reset_augmented(state, state.error_size, reach - state.error_size, settings)
        state.error_size = reach


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
