"""Parts of innovation, Jacobian and noise that several measurements share."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_CAPACITY, ERROR_SIZE, GYRO_BIAS, VELOCITY
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix


@njit
def clear(work):
    """Zero Jacobian, noise, and the covariance of noise and errors (``work.shared``), and do not hold the heading."""
    work.holds_heading = 0
    work.lever_noise = 0.0
    for i in range(3):
        for j in range(ERROR_CAPACITY):
            work.jacobian[i, j] = 0.0
            work.shared[i, j] = 0.0
        for j in range(3):
            work.noise[i, j] = 0.0


@njit
def let_heading_be_held(work, settings):
    """Let the update hold the heading where nothing shows it: of GNSS, which sees it by accelerations alone."""
    work.holds_heading = 1
    work.heading_offset_at = settings.heading_offset_at


@njit
def set_identity(jacobian, column):
    """Write a 3x3 identity block from ``column`` on."""
    for i in range(3):
        jacobian[i, column + i] = 1.0


@njit
def set_minus_cross(jacobian, column, v):
    """Write -[v]x from ``column`` on: how a small rotation theta changes v, since theta x v = -[v]x theta."""
    jacobian[0, column + 1] = v[2]
    jacobian[0, column + 2] = -v[1]
    jacobian[1, column] = -v[2]
    jacobian[1, column + 2] = v[0]
    jacobian[2, column] = v[1]
    jacobian[2, column + 1] = -v[0]


@njit
def set_east_north_up_covariance(noise, state, local_to_ecef, payload, first):
    """Write a covariance given in local East-North-Up (six values from ``payload[first]``) in map axes."""
    ee, en, eu = payload[first], payload[first + 1], payload[first + 2]
    nn, nu, uu = payload[first + 3], payload[first + 4], payload[first + 5]
    ecef = state.frame.map_to_ecef
    for j in range(3):
        local = rotate_back(local_to_ecef, (ecef[0, j], ecef[1, j], ecef[2, j]))
        spread = (
            ee * local[0] + en * local[1] + eu * local[2],
            en * local[0] + nn * local[1] + nu * local[2],
            eu * local[0] + nu * local[1] + uu * local[2],
        )
        column = rotate_back(ecef, rotate(local_to_ecef, spread))
        for i in range(3):
            noise[i, j] = column[i]


@njit
def point_velocity(state, rotation, rate, arm):
    """Return the velocity (m/s, IMU axes) of the point ``arm`` (m) from the IMU; ``rate`` rad/s relative to the Earth.

    R' v + rate x arm (Groves, section 14.3.1).
    """
    velocity = rotate_back(rotation, state.velocity_map)
    lever_velocity = cross(rate, arm)
    return (velocity[0] + lever_velocity[0], velocity[1] + lever_velocity[1], velocity[2] + lever_velocity[2])


@njit
def set_point_velocity_row(jacobian, row, axis, scale, state, rotation, arm):
    """Write how ``scale`` times the velocity of a point along ``axis`` (unit vector, IMU axes) changes with the errors.

    ``arm`` (m, IMU axes) is the lever arm of the point. The row has the velocity, the attitude (which turns the
    velocity, and the Earth rate that is subtracted from the gyro reading), and the gyro bias through the lever arm.
    """
    axis_map = rotate(rotation, axis)
    lever = cross(axis, arm)
    turned = cross(axis_map, state.velocity_map)
    earth = cross(rotate(rotation, lever), state.frame.earth_rate_map)
    for j in range(3):
        jacobian[row, VELOCITY + j] = scale * axis_map[j]
        jacobian[row, ATTITUDE + j] = scale * (turned[j] + earth[j])
        jacobian[row, GYRO_BIAS + j] = scale * lever[j]


@njit
def mounting_of(state, settings):
    """Return yaw and pitch (rad) of the vehicle's axes in base_link; zero if they are not estimated."""
    place = settings.mounting_at
    if place >= state.error_size:
        return 0.0, 0.0
    return state.optional[place - ERROR_SIZE], state.optional[place - ERROR_SIZE + 1]


@njit
def vehicle_axes(state, settings):
    """Return the unit vectors forward, left and up of the vehicle in IMU axes."""
    yaw, pitch = mounting_of(state, settings)
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    m = settings.imu_to_base
    forward = rotate_back(m, (cy * cp, sy * cp, -sp))
    left = rotate_back(m, (-sy, cy, 0.0))
    up = rotate_back(m, (cy * sp, sy * sp, cp))
    return forward, left, up


@njit
def set_mounting(jacobian, row, yaw_part, pitch_part, state, settings):
    """Write the derivatives of a measurement by yaw and pitch of the vehicle's axes, if they are estimated."""
    place = settings.mounting_at
    if place < state.error_size:
        jacobian[row, place] = yaw_part
        jacobian[row, place + 1] = pitch_part


@njit
def horizontal_acceleration(state, rotation, force):
    """Return the size (m/s2) of the horizontal acceleration for a raw specific force (m/s2, IMU axes)."""
    b = state.accel_bias
    felt = rotate(rotation, (force[0] - b[0], force[1] - b[1], force[2] - b[2]))
    g = gravity_map(state, (state.position_map[0], state.position_map[1], state.position_map[2]))
    a = (felt[0] + g[0], felt[1] + g[1], felt[2] + g[2])
    along = dot(a, g) / dot(g, g)
    return math.sqrt((a[0] - along * g[0]) ** 2 + (a[1] - along * g[1]) ** 2 + (a[2] - along * g[2]) ** 2)


@njit
def to_local(state, local_to_ecef, direction_body):
    """Return a direction of the body in the local axes (East-North-Up) whose rotation to ECEF is given."""
    direction_map = rotate(to_matrix(state.attitude), direction_body)
    return rotate_back(local_to_ecef, rotate(state.frame.map_to_ecef, direction_map))


@njit
def set_attitude_row(jacobian, row, state, local_to_ecef, local):
    """Write the derivative of a scalar by the attitude, given as ``local`` by small rotations about the local axes."""
    in_map = rotate_back(state.frame.map_to_ecef, rotate(local_to_ecef, local))
    for i in range(3):
        jacobian[row, ATTITUDE + i] = in_map[i]


@njit
def azimuth_change(direction, level_square):
    """Return the derivative of the angle of ``direction`` from east by small rotations about the local axes.

    theta x d has the angle (d_e (theta x d)_n - d_n (theta x d)_e) / (d_e^2 + d_n^2); the denominator is
    ``level_square``.
    """
    slope = -direction[2] / level_square
    return (slope * direction[0], slope * direction[1], 1.0)
