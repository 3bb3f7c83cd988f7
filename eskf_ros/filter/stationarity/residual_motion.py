"""Residual motion within a quiet window: a boat in waves, sensors held in the hand, a car that brakes evenly.

If such motion passed for rest, the mean rate would be taken for the gyro bias and the mean force for gravity. The
window is therefore divided into parts. White noise and the vibration of an engine average out within a part. What the
means of the parts still differ by is residual motion, and the mean of the window may be wrong by as much.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.state.error_state import VELOCITY
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.earth import EARTH_RATE
from eskf_ros.geodesy.rotation import dot

RESIDUAL_MOTION = np.dtype(
    [
        ("moved_first", "i8"),
        ("first_speed", "f8"),
        ("part_start", "i8"),
        ("part_count", "i8"),
        ("part_sum", "f8", (6,)),
        ("parts", "i8"),
        ("part_mean_sum", "f8", (6,)),
        ("part_square_sum", "f8", (6,)),
        ("part_moment_sum", "f8", (3,)),
        ("force_variance", "f8"),
        ("rate_variance", "f8"),
    ],
    align=True,
)
"""The parts of the static window, and the residual motion that they show.

- ``moved_first``, ``first_speed``: whether the robot moved when the window began, and how fast it may have (m/s).
- ``part_start``, ``part_count``, ``part_sum``: start (ns), samples and sums (m/s2, rad/s) of the part being filled.
- ``parts``, ``part_mean_sum``, ``part_square_sum``: number of full parts, sums of their means and of the squares.
  ``part_moment_sum``: of the force, the sum of each mean times the number of parts before it (m/s2).
- ``force_variance``, ``rate_variance``: largest variance of the means in the present run of still windows ((m/s2)2,
  (rad/s)2).
"""

PART = 250_000_000
"""ns; length of a part."""

FEWEST_PARTS = 4
"""Parts, at least, whose means show residual motion."""

MOVING_SPEED = 0.5
"""m/s; a robot moves if its speed exceeds this by more than its uncertainty."""

REST_SIGMAS = 2.0
"""A window is not at rest while the estimated speed exceeds `MOVING_SPEED` by this many standard deviations: rather a
missed window than one of even braking.
"""

MORE_THAN_NOISE = 5.0
"""Ratio of the variance of the means to that of white noise above which there is residual motion: noise alone exceeds
it in one of thousands of windows.
"""

BIAS_SIGMAS = 4.0
"""Standard deviations by which a gyro bias may differ from its expected value."""


@njit
def add_to_part(state):
    """Add the newest IMU sample to the present part of the static window; a new window begins with new parts."""
    if state.window.start == NEVER:
        state.residual.moved_first = 1 if is_moving(state) else 0
        state.residual.first_speed = possible_speed(state)
        state.residual.part_start = state.stamp
        state.residual.part_count = 0
        state.residual.parts = 0
        for i in range(3):
            state.residual.part_moment_sum[i] = 0.0
        for i in range(6):
            state.residual.part_sum[i] = 0.0
            state.residual.part_mean_sum[i] = 0.0
            state.residual.part_square_sum[i] = 0.0
    for i in range(3):
        state.residual.part_sum[i] += state.specific_force[i]
        state.residual.part_sum[3 + i] += state.angular_rate[i]
    state.residual.part_count += 1
    if state.stamp - state.residual.part_start < PART:
        return
    for i in range(6):
        mean = state.residual.part_sum[i] / state.residual.part_count
        state.residual.part_mean_sum[i] += mean
        state.residual.part_square_sum[i] += mean * mean
        if i < 3:
            state.residual.part_moment_sum[i] += state.residual.parts * mean
        state.residual.part_sum[i] = 0.0
    state.residual.parts += 1
    state.residual.part_count = 0
    state.residual.part_start = state.stamp


@njit
def is_moving(state):
    """Say whether the velocity that the filter has from GNSS is too large for a robot at rest."""
    if state.position_known == 0:
        return False
    v = state.velocity_map
    return math.sqrt(dot(v, v)) - REST_SIGMAS * math.sqrt(velocity_variance(state)) > MOVING_SPEED


@njit
def possible_speed(state):
    """Return how fast the robot may be (m/s; root mean square); 0 before the first position: it starts at rest."""
    if state.position_known == 0:
        return 0.0
    v = state.velocity_map
    return math.sqrt(dot(v, v) + velocity_variance(state))


@njit
def velocity_variance(state):
    """Return the variance of the velocity (m2/s2) of the axis that is known worst."""
    variance = 0.0
    for i in range(3):
        variance = max(variance, state.covariance[VELOCITY + i, VELOCITY + i])
    return variance


@njit
def sway_variance(state, first, noise_density):
    """Return the variance of the means of the parts, for three axes from ``first``; 0 if white noise explains it.

    ``first`` 0: specific force ((m/s2)2); 3: angular rate ((rad/s)2). The axis with the largest variance counts.
    """
    n = state.residual.parts
    if n < FEWEST_PARTS:
        return 0.0
    largest = 0.0
    for i in range(first, first + 3):
        largest = max(largest, scatter_of_parts(state, i))
    return beyond_noise(largest, noise_density)


@njit
def beyond_noise(variance, noise_density):
    """Return a variance of the means of parts; 0 if white noise explains it."""
    return variance if variance > MORE_THAN_NOISE * noise_density**2 / (PART * 1e-9) else 0.0


@njit
def scatter_of_parts(state, i):
    """Return the variance of the means of the parts; axis ``i``: 0 to 2 force ((m/s2)2), 3 to 5 rate ((rad/s)2)."""
    n = state.residual.parts
    mean = state.residual.part_mean_sum[i] / n
    return (state.residual.part_square_sum[i] / n - mean * mean) * n / (n - 1)


@njit
def variance_of_half(state):
    """Return the variance ((m/s2)2) of the mean force of half a window, by how its parts scatter: noise and sway.

    They scatter about a line, which is that of gravity if the body turns evenly. A few parts show the scatter to a
    factor of two, which is in it; 0 for less than `FEWEST_PARTS`, which do not show it.
    """
    n = state.residual.parts
    if n < FEWEST_PARTS:
        return 0.0
    largest = 0.0
    for i in range(3):
        mean = state.residual.part_mean_sum[i] / n
        moment = state.residual.part_moment_sum[i] - 0.5 * (n - 1) * n * mean
        scatter = state.residual.part_square_sum[i] - n * mean * mean - 12.0 * moment * moment / (n * (n * n - 1.0))
        largest = max(largest, scatter / (n - 2))
    return 2.0 * largest / (0.5 * n)


@njit
def note_sway(state, is_first, settings):
    """Keep the largest residual motion in a run of still windows; ``is_first``: this window is the first of the run.

    What has passed for motion in windows before may be noise of the gyros, which has been measured since.
    """
    density = gyro_density(state, settings)
    force = sway_variance(state, 0, settings.accel_noise_density)
    rate = sway_variance(state, 3, density)
    before = beyond_noise(state.residual.rate_variance, density)
    state.residual.force_variance = force if is_first else max(state.residual.force_variance, force)
    state.residual.rate_variance = rate if is_first else max(before, rate)


@njit
def can_be_bias(rate, expected, std, noise):
    """Say whether a mean rate (rad/s) can be Earth rate plus gyro bias.

    The bias is ``expected`` (rad/s) with the standard deviation ``std``; ``noise`` is the standard deviation of the
    mean rate.
    """
    limit = BIAS_SIGMAS * math.sqrt(std * std + noise * noise) + EARTH_RATE
    for i in range(3):
        if abs(rate[i] - expected[i]) > limit:
            return False
    return True
