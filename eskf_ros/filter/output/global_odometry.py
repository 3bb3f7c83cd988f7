"""Output rows: the state of the IMU turned into pose and twist of base_link, with covariance, status and quality."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.levelling import UNKNOWN_SPEED
from eskf_ros.filter.inertial.gyro_noise import gyro_noise_variance
from eskf_ros.filter.inertial.navigation_frame import body_rate, heading_of
from eskf_ros.filter.integrity.fix_errors import held_variance
from eskf_ros.filter.integrity.motion_monitor import lag_of_receiver, offset_by_jumps
from eskf_ros.filter.measurements.antenna import lever_arm_of
from eskf_ros.filter.output.status import quality_of, status_of
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, GYRO_BIAS, POSITION, SOURCES, VELOCITY
from eskf_ros.geodesy.rotation import cross, from_matrix, from_rotation_vector, multiply, rotate, rotate_back, to_matrix

ODOMETRY = np.dtype(
    [
        ("stamp", "i8"),
        ("status", "i4"),
        ("quality", "i4"),
        ("position_known", "?"),
        ("heading_known", "?"),
        ("position_map", "f8", (3,)),
        ("attitude_body_to_map", "f8", (4,)),
        ("position_odom", "f8", (3,)),
        ("attitude_body_to_odom", "f8", (4,)),
        ("local_position_variance", "f8"),
        ("local_heading_variance", "f8"),
        ("velocity_map", "f8", (3,)),
        ("velocity_body", "f8", (3,)),
        ("angular_rate_body", "f8", (3,)),
        ("pose_covariance", "f8", (6, 6)),
        ("twist_covariance", "f8", (6, 6)),
        ("accel_bias", "f8", (3,)),
        ("gyro_bias", "f8", (3,)),
        ("accel_bias_std", "f8", (3,)),
        ("gyro_bias_std", "f8", (3,)),
    ],
    align=True,
)
"""What is published for one IMU sample: pose and twist of base_link (here "body" is base_link), biases in IMU axes.

``map`` pose: the best estimate. ``odom`` pose: without jumps (see `local_odometry`). Units: ns, m, m/s, rad/s, m/s2;
attitudes are quaternions (w x y z). Covariances: position and rotation in map axes, velocity and rate in base_link
axes.
"""


@njit
def attitude_base_to_map(state, settings):
    """Return the rotation from base_link to map as row tuples."""
    imu = to_matrix(state.attitude)
    m = settings.imu_to_base
    row = (m[0, 0], m[0, 1], m[0, 2])
    first = rotate(imu, row)
    row = (m[1, 0], m[1, 1], m[1, 2])
    second = rotate(imu, row)
    row = (m[2, 0], m[2, 1], m[2, 2])
    third = rotate(imu, row)
    return (
        (first[0], second[0], third[0]),
        (first[1], second[1], third[1]),
        (first[2], second[2], third[2]),
    )


@njit
def write_odometry(state, local, settings, row):
    """Fill one ODOMETRY row from the state and the local pose.

    The pose error of base_link is that of the IMU plus [R m]x theta, m the position of the IMU in base_link; the twist
    error in base_link axes is R' (dv + v x theta), v the velocity of the IMU (first order; Sola, section 4.4).
    """
    covariance = state.covariance
    base_to_map = attitude_base_to_map(state, settings)
    imu_offset = rotate(base_to_map, settings.imu_position_base)
    rate_imu = body_rate(state, to_matrix(state.attitude))
    rate_base = rotate(settings.imu_to_base, rate_imu)
    lever_velocity = rotate(base_to_map, cross(rate_base, settings.imu_position_base))
    velocity = (
        state.velocity_map[0] - lever_velocity[0],
        state.velocity_map[1] - lever_velocity[1],
        state.velocity_map[2] - lever_velocity[2],
    )
    velocity_base = rotate_back(base_to_map, velocity)
    attitude = from_matrix(base_to_map)

    row.stamp = state.stamp
    row.status = status_of(state, settings)
    row.quality = quality_of(state, row.status, settings)
    row.position_known = state.position_known == 1
    row.heading_known = state.heading_known == 1
    for i in range(4):
        row.attitude_body_to_map[i] = attitude[i]
    for i in range(3):
        row.position_map[i] = state.position_map[i] - imu_offset[i]
        row.velocity_map[i] = velocity[i]
        row.velocity_body[i] = velocity_base[i]
        row.angular_rate_body[i] = rate_base[i]
        row.accel_bias[i] = state.accel_bias[i]
        row.gyro_bias[i] = state.gyro_bias[i]
        row.accel_bias_std[i] = math.sqrt(max(covariance[ACCEL_BIAS + i, ACCEL_BIAS + i], 0.0))
        row.gyro_bias_std[i] = math.sqrt(max(covariance[GYRO_BIAS + i, GYRO_BIAS + i], 0.0))
    write_local_pose(state, local, attitude, settings, row)
    if state.heading_known == 1:
        write_pose_covariance(state, imu_offset, row)
    else:
        write_pose_covariance(state, (0.0, 0.0, 0.0), row)
        add_unknown_heading(state, imu_offset, settings, row)
    write_twist_covariance(state, base_to_map, settings, row)
    for source in range(SOURCES):
        if state.installation.is_considered[source] == 1:
            add_considered_faults(state, source, imu_offset, base_to_map, row)
    offset = offset_by_jumps(state)
    for i in range(2):
        for j in range(2):
            row.pose_covariance[i, j] += offset[i] * offset[j]
    lag = lag_of_receiver(state)
    if lag != 0.0:
        for i in range(3):
            for j in range(3):
                row.pose_covariance[i, j] += lag * lag * velocity[i] * velocity[j]


@njit
def write_local_pose(state, local, attitude, settings, row):
    """Write the pose of base_link in odom; ``attitude`` is the quaternion from base_link to map."""
    turn = from_rotation_vector((0.0, 0.0, local.heading - heading_of(state, settings)))
    attitude_odom = multiply(turn, attitude)
    imu_offset = rotate(to_matrix(attitude_odom), settings.imu_position_base)
    for i in range(4):
        row.attitude_body_to_odom[i] = attitude_odom[i]
    for i in range(3):
        row.position_odom[i] = local.position[i] - imu_offset[i]
    row.local_position_variance = local.position_variance
    row.local_heading_variance = local.heading_variance


@njit
def cross_row(v, i):
    """Return row ``i`` of the matrix [v]x."""
    if i == 0:
        return (0.0, -v[2], v[1])
    if i == 1:
        return (v[2], 0.0, -v[0])
    return (-v[1], v[0], 0.0)


@njit
def write_pose_covariance(state, imu_offset, row):
    """Write the 6x6 covariance of position and attitude of base_link (map axes)."""
    covariance = state.covariance
    for i in range(3):
        a = cross_row(imu_offset, i)
        for j in range(3):
            b = cross_row(imu_offset, j)
            position = covariance[POSITION + i, POSITION + j]
            mixed = covariance[POSITION + i, ATTITUDE + j]
            for k in range(3):
                position += a[k] * covariance[ATTITUDE + k, POSITION + j]
                position += covariance[POSITION + i, ATTITUDE + k] * b[k]
                mixed += a[k] * covariance[ATTITUDE + k, ATTITUDE + j]
                for n in range(3):
                    position += a[k] * covariance[ATTITUDE + k, ATTITUDE + n] * b[n]
            row.pose_covariance[i, j] = position
            row.pose_covariance[i, 3 + j] = mixed
            row.pose_covariance[3 + j, i] = mixed
            row.pose_covariance[3 + i, 3 + j] = covariance[ATTITUDE + i, ATTITUDE + j]
    for i in range(3):
        row.pose_covariance[i, i] += held_variance(state, i)
        for j in range(i):
            row.pose_covariance[i, j] = row.pose_covariance[j, i]


@njit
def write_twist_covariance(state, base_to_map, settings, row):
    """Write the 6x6 covariance of the twist in base_link axes."""
    covariance = state.covariance
    # The velocity by the lever arm is known in body axes: an attitude error turns only the velocity of the IMU.
    velocity = (state.velocity_map[0], state.velocity_map[1], state.velocity_map[2])
    # The rate error times the lever arm is neglected: it adds millimetres per second.
    rate_variance = gyro_noise_variance(state, settings)
    for i in range(3):
        forward_i = (base_to_map[0][i], base_to_map[1][i], base_to_map[2][i])
        lever_i = cross(forward_i, velocity)
        for j in range(i + 1):
            forward_j = (base_to_map[0][j], base_to_map[1][j], base_to_map[2][j])
            lever_j = cross(forward_j, velocity)
            linear = 0.0
            angular = 0.0
            for k in range(3):
                for n in range(3):
                    linear += forward_i[k] * covariance[VELOCITY + k, VELOCITY + n] * forward_j[n]
                    linear += lever_i[k] * covariance[ATTITUDE + k, ATTITUDE + n] * lever_j[n]
                    linear += forward_i[k] * covariance[VELOCITY + k, ATTITUDE + n] * lever_j[n]
                    linear += lever_i[k] * covariance[ATTITUDE + k, VELOCITY + n] * forward_j[n]
                    angular += (
                        settings.imu_to_base[i, k]
                        * covariance[GYRO_BIAS + k, GYRO_BIAS + n]
                        * settings.imu_to_base[j, n]
                    )
            if i == j:
                angular += rate_variance
                if state.position_known == 0:
                    linear += UNKNOWN_SPEED**2
            row.twist_covariance[i, j] = linear
            row.twist_covariance[j, i] = linear
            row.twist_covariance[3 + i, 3 + j] = angular
            row.twist_covariance[3 + j, 3 + i] = angular


@njit
def add_considered_faults(state, source, imu_offset, base_to_map, row):
    """Add what faults of the installation do to pose and velocity of base_link, as large as they were found."""
    effect = state.installation.considered[source]
    turn = (effect[ATTITUDE], effect[ATTITUDE + 1], effect[ATTITUDE + 2])
    velocity = (state.velocity_map[0], state.velocity_map[1], state.velocity_map[2])
    moved, sped = cross(imu_offset, turn), cross(velocity, turn)
    forward = rotate_back(
        base_to_map,
        (effect[VELOCITY] + sped[0], effect[VELOCITY + 1] + sped[1], effect[VELOCITY + 2] + sped[2]),
    )
    pose = (
        effect[POSITION] + moved[0],
        effect[POSITION + 1] + moved[1],
        effect[POSITION + 2] + moved[2],
        turn[0],
        turn[1],
        turn[2],
    )
    for i in range(6):
        for j in range(6):
            row.pose_covariance[i, j] += pose[i] * pose[j]
    for i in range(3):
        for j in range(3):
            row.twist_covariance[i, j] += forward[i] * forward[j]


@njit
def add_unknown_heading(state, imu_offset, settings, row):
    """Add what an unknown heading does to the position of base_link, since GNSS measures that of the antenna.

    The horizontal arm l from base_link to the antenna, not that to the IMU, points anywhere:
    E |R(a) l - R(b) l|^2 = 2 |l|^2 for a uniform angle a, |l|^2 for each axis.
    """
    antenna = rotate(to_matrix(state.attitude), lever_arm_of(state, 0, settings))
    arm_squared = (antenna[0] + imu_offset[0]) ** 2 + (antenna[1] + imu_offset[1]) ** 2
    for i in range(2):
        row.pose_covariance[i, i] += arm_squared
