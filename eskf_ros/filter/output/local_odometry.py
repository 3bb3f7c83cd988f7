"""Odometry without jumps: the pose of base_link in `odom`, moved by predicted steps only.

Corrections move the pose in map; here they are taken out again. From one IMU sample to the next the local pose gains
the predicted displacement and turn, without the jumps by measurements in between and by a rewind: the step is that of
the latest estimate, and it starts from the published pose. Roll and pitch are those of the filter. The local pose
depends on the order of arrival and is not part of the rewound state.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.levelling import UNKNOWN_SPEED
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.inertial.navigation_frame import heading_of
from eskf_ros.filter.state.error_state import GYRO_BIAS, VELOCITY
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.rotation import wrapped

STEP = np.dtype(
    [
        ("step_position", "f8", (3,)),
        ("step_heading", "f8"),
        ("sample_position", "f8", (3,)),
        ("sample_heading", "f8"),
        ("jump_position", "f8", (3,)),
        ("jump_heading", "f8"),
    ],
    align=True,
)
"""What the odometry without jumps needs of the state.

``step_position``, ``step_heading``: predicted step over the last IMU interval (m in map, rad). ``sample_position``,
``sample_heading``: position (m) and heading (rad) at its end. ``jump_position``, ``jump_heading``: corrections since
then (m, rad).
"""

LOCAL = np.dtype(
    [
        ("started", "i8"),
        ("position", "f8", (3,)),
        ("heading", "f8"),
        ("position_variance", "f8"),
        ("heading_variance", "f8"),
    ],
    align=True,
)
"""Pose of the IMU in `odom` (m, rad), and the variances per axis that it has gathered since the start (m2, rad2)."""

STILL_SPEED = 0.05
"""m/s; standard deviation of the velocity of a robot at rest before the first fix."""


@njit
def measure_step(state, settings):
    """Store the displacement (m, map) and turn (rad) since the last IMU sample, without corrections."""
    heading = heading_of(state, settings)
    for i in range(3):
        state.odom.step_position[i] = (
            state.position_map[i] - state.odom.sample_position[i] - state.odom.jump_position[i]
        )
        state.odom.sample_position[i] = state.position_map[i]
        state.odom.jump_position[i] = 0.0
    state.odom.step_heading = wrapped(heading - state.odom.sample_heading - state.odom.jump_heading)
    state.odom.sample_heading = heading
    state.odom.jump_heading = 0.0


@njit
def note_jump(state, position, heading, settings):
    """Add the correction that has moved the state from ``position`` (m, map) and ``heading`` (rad)."""
    for i in range(3):
        state.odom.jump_position[i] += state.position_map[i] - position[i]
    state.odom.jump_heading += wrapped(heading_of(state, settings) - heading)


@njit
def carry(local, state, settings):
    """Move the local pose by the step of the newest IMU sample, and let its uncertainty grow.

    Errors of velocity and gyro bias are correlated over time, so their standard deviations add up; the error of the
    heading moves the position, too.
    """
    if local.started == 0:
        local.started = 1
        return
    local.heading += state.odom.step_heading
    c = math.cos(local.heading - state.odom.sample_heading)
    s = math.sin(local.heading - state.odom.sample_heading)
    x, y, z = state.odom.step_position[0], state.odom.step_position[1], state.odom.step_position[2]
    local.position[0] += c * x - s * y
    local.position[1] += s * x + c * y
    local.position[2] += z

    dt = state.imu.interval
    covariance = state.covariance
    bias_variance = 0.0
    velocity_variance = 0.0
    for i in range(3):
        bias_variance = max(bias_variance, covariance[GYRO_BIAS + i, GYRO_BIAS + i])
        velocity_variance = max(velocity_variance, covariance[VELOCITY + i, VELOCITY + i])
    if state.position_known == 0:
        at_rest = (
            state.window.still_stamp != NEVER
            and state.stamp - state.window.still_stamp < 1.5e9 * settings.static_duration
        )
        velocity_variance = STILL_SPEED**2 if at_rest else UNKNOWN_SPEED**2
    heading_std = math.sqrt(local.heading_variance) + math.sqrt(bias_variance) * dt
    local.heading_variance = heading_std**2 + gyro_density(state, settings) ** 2 * dt
    drift = math.sqrt(velocity_variance) * dt + math.sqrt(x * x + y * y) * heading_std
    local.position_variance = (math.sqrt(local.position_variance) + drift) ** 2
