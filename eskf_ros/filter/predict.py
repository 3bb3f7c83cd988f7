"""Prediction: propagates state, covariance and heading search to the next measurement or IMU sample."""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading_search import forget_search, hide_motion, predict_search
from eskf_ros.filter.inertial.covariance import (
    credible_force,
    propagate_axis_noise,
    propagate_covariance,
    propagate_noise,
)
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.inertial.sample_doubt import credible_reading, shaken_density
from eskf_ros.filter.inertial.strapdown import propagate_nominal_state
from eskf_ros.filter.output.forward_log import carry_transition
from eskf_ros.filter.state import augmented_states
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.filter.state.time import SECOND
from eskf_ros.geodesy.rotation import dot

LONGEST_STEP = 20_000_000
"""ns; a longer IMU interval is integrated in equal steps of at most this length."""

LONGEST_RATIO = 2.5
"""The slope between the last two samples is believed over an interval of at most this many times their distance: its
noise grows with the ratio.
"""

WANDER_ACCELERATION = 0.5
"""m/s2; acceleration of the robot beyond the measured one that is assumed with an unknown heading (process noise)."""

LARGEST_SHAKEN_DENSITY = 0.1
"""m/s2/rtHz; vibration counts as noise of an acceleration up to here, lest the strongest hide all accelerations."""

WANDER_TIME = 1.0
"""s; correlation time of the unknown acceleration with an unknown heading."""


@njit
def step(state, force_0, rate_0, force_1, rate_1, dt, gap, settings, work):
    """Propagate one lane by ``dt`` s between two raw IMU readings (m/s2, rad/s; IMU axes).

    ``gap`` (s) is the length of the hole in the IMU data that is being bridged, 0 for none.
    """
    # With an unknown heading the direction of the measured acceleration on the map is unknown: it is not integrated.
    coupling = 0.0 if state.heading_known == 0 else 1.0
    force_0 = augmented_states.unscaled(state, force_0, state.accel_bias, 0, settings)
    force_1 = augmented_states.unscaled(state, force_1, state.accel_bias, 0, settings)
    rate_0 = augmented_states.unscaled(state, rate_0, state.gyro_bias, 3, settings)
    rate_1 = augmented_states.unscaled(state, rate_1, state.gyro_bias, 3, settings)
    middle, force, gravity = propagate_nominal_state(state, force_0, rate_0, force_1, rate_1, dt, coupling)
    # Motion hidden by a gap is assumed to be constant; this density gives the same variance at its end.
    accel_noise, gyro_noise, accel_walk, gyro_walk = imu_noise(state, settings)
    velocity_noise = accel_noise + settings.gap_accel_std**2 * gap
    attitude_noise = gyro_noise + settings.gap_gyro_std**2 * gap
    if state.heading_known == 0:
        acceleration = (force[0] + gravity[0], force[1] + gravity[1], force[2] + gravity[2])
        predict_search(state, acceleration, middle, dt, settings)
        if gap > 0.0:
            hide_motion(state, settings.gap_accel_std**2 * gap * dt, settings.gap_gyro_std**2 * gap * dt)
        velocity_noise += WANDER_TIME * (WANDER_ACCELERATION**2 + dot(acceleration, acceleration))
    size, covariance = state.error_size, state.covariance
    shaken = min(shaken_density(state.quality, 0, state.imu.interval), LARGEST_SHAKEN_DENSITY)
    density = max(settings.accel_noise_density, shaken)
    force = credible_force(state.excitation, covariance, middle, force, gravity, dt, density)
    augmented_states.propagate_scale(state, middle, force_1, rate_1, dt, coupling, settings)
    propagate_covariance(covariance, size, middle, force, gravity, state.frame.earth_rate_map, dt, coupling, work)
    if settings.keeps_log == 1:
        carry_transition(state, middle, force, gravity, dt, coupling, settings)
    propagate_noise(covariance, velocity_noise, attitude_noise, accel_walk, gyro_walk, dt)
    if state.quality.is_doubted == 1:
        doubt = state.quality.doubt
        propagate_axis_noise(covariance, middle, doubt, dt)
        if state.heading_known == 0 and max(doubt[3], max(doubt[4], doubt[5])) > 0.0:
            # The search compares headings by turns that were not measured.
            forget_search(state)
    if size > ERROR_SIZE:
        augmented_states.propagate_augmented(state, dt, settings)


@njit
def imu_noise(state, settings):
    """Return the spectral densities of accelerometer and gyro, and of the random walks of their biases.

    They are those of the parameters, or what the gyros have shown, for the doubt 0 (of white noise, of the biases),
    those of the humble lane for 1, and geometric means between.
    """
    doubt, bias_doubt, humble = state.doubt, state.bias_doubt, settings.humble_noise
    gyro = gyro_density(state, settings) ** 2
    return (
        between_noise(settings.accel_noise_density**2, humble[0], doubt),
        between_noise(gyro, max(humble[1], gyro), doubt),
        between_noise(settings.accel_bias_random_walk**2, humble[2], bias_doubt),
        between_noise(settings.gyro_bias_random_walk**2, humble[3], bias_doubt),
    )


@njit
def between_noise(told, humble, doubt):
    """Return the geometric mean of two densities with the weights 1 - ``doubt`` and ``doubt``."""
    if doubt == 0.0:
        return told
    if doubt == 1.0:
        return humble
    return told ** (1.0 - doubt) * humble**doubt


@njit
def propagate(state, stamp, sample, instant, settings, work):
    """Propagate one lane to ``stamp`` (ns), at or before ``instant`` (ns), the time of the next ``sample``.

    Between two samples the IMU is the straight line whose mean is that of the parabola through them and the sample
    before (Adams-Moulton): an interval gives the same result wherever it is cut. A long interval is integrated in
    steps; one longer than the gap of the settings may hide motion and adds process noise.
    """
    interval = (instant - state.imu.stamp) / SECOND
    force_0, force_1 = line(state.imu.earlier_force, state.imu.force, sample.specific_force, interval, state, settings)
    rate_0, rate_1 = line(state.imu.earlier_rate, state.imu.rate, sample.angular_rate, interval, state, settings)
    force_0 = credible_reading(state.quality, force_0, 0, 0.0)
    force_1 = credible_reading(state.quality, force_1, 0, 1.0)
    rate_0 = credible_reading(state.quality, rate_0, 3, 0.0)
    rate_1 = credible_reading(state.quality, rate_1, 3, 1.0)
    gap = interval if interval > settings.imu_gap else 0.0
    steps = (stamp - state.stamp + LONGEST_STEP - 1) // LONGEST_STEP
    begin = (state.stamp - state.imu.stamp) / SECOND / interval
    end = (stamp - state.imu.stamp) / SECOND / interval
    force_a = between(force_0, force_1, begin)
    rate_a = between(rate_0, rate_1, begin)
    for k in range(steps):
        fraction = begin + (end - begin) * (k + 1) / steps
        force_b = between(force_0, force_1, fraction)
        rate_b = between(rate_0, rate_1, fraction)
        step(state, force_a, rate_a, force_b, rate_b, (end - begin) * interval / steps, gap, settings, work)
        force_a = force_b
        rate_a = rate_b
    force = credible_reading(state.quality, between(state.imu.force, sample.specific_force, end), 0, end)
    rate = credible_reading(state.quality, between(state.imu.rate, sample.angular_rate, end), 3, end)
    for i in range(3):
        state.specific_force[i] = force[i]
        state.angular_rate[i] = rate[i]
    state.stamp = stamp


@njit
def line(earlier, last, following, interval, state, settings):
    """Return the ends of the straight line that stands for the IMU between two samples (see `propagate`)."""
    bend = 0.0
    longest = min(settings.imu_gap, LONGEST_RATIO * state.imu.interval)
    if interval <= longest and state.imu.interval <= settings.imu_gap:
        bend = interval * interval / (6.0 * (interval + state.imu.interval))
    shift = (
        bend * ((following[0] - last[0]) / interval - (last[0] - earlier[0]) / state.imu.interval),
        bend * ((following[1] - last[1]) / interval - (last[1] - earlier[1]) / state.imu.interval),
        bend * ((following[2] - last[2]) / interval - (last[2] - earlier[2]) / state.imu.interval),
    )
    return (
        (last[0] - shift[0], last[1] - shift[1], last[2] - shift[2]),
        (following[0] - shift[0], following[1] - shift[1], following[2] - shift[2]),
    )


@njit
def between(a, b, fraction):
    """Return the 3-vector at ``fraction`` of the way from ``a`` to ``b``."""
    return (
        a[0] + fraction * (b[0] - a[0]),
        a[1] + fraction * (b[1] - a[1]),
        a[2] + fraction * (b[2] - a[2]),
    )
