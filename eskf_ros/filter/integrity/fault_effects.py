"""Effects of constant faults of receivers and gyros on measurements, and on the estimate that has followed them.

Lever arms, time offsets, and a scale error or a steady drift of the bias of the gyros. The antenna is R dl + v dt away
from where the filter expects it. ``installation.absorbed`` is the derivative of the errors by the faults, carried
through every prediction and update (Friedland, Treatment of bias in recursive filtering, 1969).
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.sample_doubt import shaken_density
from eskf_ros.filter.inertial.strapdown import SMOOTHING_TIME, gravity_map
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, GYRO_BIAS, POSITION, SOURCES, VELOCITY
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix

FAULTS = 7
"""Faults that are estimated for each receiver: three axes of the lever arm (m, body), the time offsets (s) of positions
and of velocities, scale error of the gyros and drift of their bias (rad/s2): these are one, but each receiver sees
them."""

POSITION_TIME = 3
"""Index of the time offset of positions among the faults."""

VELOCITY_TIME = 4
"""Index of the time offset of velocities among the faults."""

GYRO_SCALE = 5
"""Index of the scale error of the gyros, the same for the three, among the faults."""

GYRO_DRIFT = 6
"""Index of the steady drift of the bias of the gyros about the vertical among the faults."""

CERTAIN_SHARE = 2.0
"""Ratio of the square of a rate or an acceleration to its variance below which it says nothing of the faults."""


@njit
def write_effect(state, aid, work, settings):
    """Write the derivative of a GNSS measurement by the faults of its receiver to ``work.direct_effect`` (3, 7).

    Zero for the faults of the gyros, which act in time. ``state`` is the predicted one: a velocity that the innovation
    has corrected would explain this innovation.
    """
    work.direct_effect.fill(0.0)
    if aid.stream == Stream.GNSS_POSITION:
        write_effect_on_position(state, aid.source, work.direct_effect, settings)
    else:
        write_effect_on_velocity(state, work.direct_effect)


@njit
def write_effect_on_position(state, source, effect, settings):
    """Write the derivative of a position by the faults of its receiver to the first rows of ``effect``."""
    rotation = to_matrix(state.attitude)
    turning = rotate(rotation, cross(smoothed_rate(state, rotation), settings.lever_arms_body[source]))
    for i in range(3):
        for k in range(3):
            effect[i, k] = rotation[i][k]
        effect[i, POSITION_TIME] = state.velocity_map[i] + turning[i]


@njit
def write_effect_on_velocity(state, effect):
    """Write the derivative of a velocity by the faults of its receiver to the first rows of ``effect``.

    A rate that is not larger than its own noise and vibration says nothing of the lever arm, nor does such an
    acceleration of the time: they would explain the innovation, which has the vibration, too.
    """
    rotation = to_matrix(state.attitude)
    rate = smoothed_rate(state, rotation)
    turning = shown_share(state, 3, dot(rate, rate))
    force, bias = state.imu.smooth_force, state.accel_bias
    felt = rotate(rotation, (force[0] - bias[0], force[1] - bias[1], force[2] - bias[2]))
    gravity = gravity_map(state, (state.position_map[0], state.position_map[1], state.position_map[2]))
    acceleration = (felt[0] + gravity[0], felt[1] + gravity[1], felt[2] + gravity[2])
    pushing = shown_share(state, 0, dot(acceleration, acceleration))
    x = rotate(rotation, cross(rate, (1.0, 0.0, 0.0)))
    y = rotate(rotation, cross(rate, (0.0, 1.0, 0.0)))
    z = rotate(rotation, cross(rate, (0.0, 0.0, 1.0)))
    for i in range(3):
        effect[i, 0], effect[i, 1], effect[i, 2] = turning * x[i], turning * y[i], turning * z[i]
        effect[i, VELOCITY_TIME] = pushing * acceleration[i]


@njit
def shown_share(state, first, square):
    """Return the share of a smoothed reading, given its ``square``, that is neither noise nor vibration of its sensor.

    ``first``: 0 for the accelerometers, 3 for the gyros (`sample_doubt.shaken_density`).
    """
    noise = 3.0 * shaken_density(state.quality, first, state.imu.interval) ** 2 / (2.0 * SMOOTHING_TIME)
    return square / (square + noise) if square > CERTAIN_SHARE * noise else 0.0


@njit
def smoothed_rate(state, rotation):
    """Return the rate of the body relative to the Earth (rad/s, IMU axes), without vibration and single noise.

    A rate that carries the noise of the very sample that predicts the measurement would explain its own innovation.
    """
    earth, rate, bias = rotate_back(rotation, state.frame.earth_rate_map), state.imu.smooth_rate, state.gyro_bias
    return (rate[0] - bias[0] - earth[0], rate[1] - bias[1] - earth[1], rate[2] - bias[2] - earth[2])


@njit
def absorb_completely(state, settings):
    """Begin to carry the effect of the faults: position and velocity have followed the receivers with all of it.

    So it is at the start, and when the filter goes on from the humble lane, which follows the receivers.
    """
    for source in range(SOURCES):
        absorbed = state.installation.absorbed[source]
        absorbed.fill(0.0)
        write_effect_on_position(state, source, absorbed[POSITION:VELOCITY], settings)
        write_effect_on_velocity(state, absorbed[VELOCITY:ATTITUDE])


@njit
def carry_absorbed(state, settings):
    """Carry the effect of the faults on the state to the present; return the time (s) since the last measurement.

    One step of the trapezoidal rule: exact enough for a second of a car's motion, and the fault estimates tolerate
    more.
    """
    rotation = to_matrix(state.attitude)
    f, b = state.specific_force, state.accel_bias
    force = rotate(rotation, (f[0] - b[0], f[1] - b[1], f[2] - b[2]))
    dt = 0.0 if state.installation.stamp == NEVER else (state.stamp - state.installation.stamp) * 1e-9
    last = state.installation.force
    mean = (0.5 * (force[0] + last[0]), 0.5 * (force[1] + last[1]), 0.5 * (force[2] + last[2]))
    rate = rotate(rotation, smoothed_rate(state, rotation))
    for source in range(SOURCES):
        a = state.installation.absorbed[source]
        # What the gyros read too much turns the attitude too far; a bias that drifts leaves its estimate behind.
        for i in range(3):
            a[ATTITUDE + i, GYRO_SCALE] += dt * rate[i]
            a[GYRO_BIAS + i, GYRO_DRIFT] -= dt * rotation[2][i]
        for k in range(FAULTS):
            turning = rotate(rotation, (a[GYRO_BIAS, k], a[GYRO_BIAS + 1, k], a[GYRO_BIAS + 2, k]))
            pulling = rotate(rotation, (a[ACCEL_BIAS, k], a[ACCEL_BIAS + 1, k], a[ACCEL_BIAS + 2, k]))
            tilt = (
                a[ATTITUDE, k] - 0.5 * dt * turning[0],
                a[ATTITUDE + 1, k] - 0.5 * dt * turning[1],
                a[ATTITUDE + 2, k] - 0.5 * dt * turning[2],
            )
            pushing = cross(tilt, mean)
            for i in range(3):
                gain = dt * (pushing[i] - pulling[i])
                a[POSITION + i, k] += dt * (a[VELOCITY + i, k] + 0.5 * gain)
                a[VELOCITY + i, k] += gain
                a[ATTITUDE + i, k] -= dt * turning[i]
        for i in range(ERROR_SIZE, state.error_size):
            remaining = math.exp(-settings.optional_decay[i - ERROR_SIZE] * dt)
            for k in range(FAULTS):
                a[i, k] *= remaining
    state.installation.stamp = state.stamp
    for i in range(3):
        state.installation.force[i] = force[i]
    return dt
