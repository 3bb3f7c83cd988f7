"""Navigation frame: the map frame and its datum, the local vertical, turns of the attitude with its error."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.covariance import update_error_axes
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, POSITION, VELOCITY
from eskf_ros.geodesy.earth import EARTH_RATE, east_north_up_to_ecef, ecef_to_geodetic, geodetic_to_ecef
from eskf_ros.geodesy.rotation import (
    cross,
    dot,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalized,
    rotate,
    rotate_back,
    to_matrix,
    to_rotation_vector,
)

FRAME = np.dtype(
    [
        ("datum", "f8", (3,)),
        ("origin_ecef", "f8", (3,)),
        ("map_to_ecef", "f8", (3, 3)),
        ("earth_rate_map", "f8", (3,)),
        ("datum_known", "i8"),
    ],
    align=True,
)
"""The map frame, valid once ``datum_known``.

``datum``: latitude, longitude (rad), altitude (m). ``origin_ecef``, ``map_to_ecef``: its origin (m) and axes in ECEF.
``earth_rate_map``: the Earth rate (rad/s, map).
"""


@njit
def set_datum(state, latitude, longitude, altitude):
    """Set the map frame: East-North-Up at a geodetic position (rad, rad, m)."""
    state.frame.datum[0] = latitude
    state.frame.datum[1] = longitude
    state.frame.datum[2] = altitude
    origin = geodetic_to_ecef(latitude, longitude, altitude)
    rotation = east_north_up_to_ecef(latitude, longitude)
    earth_rate = rotate_back(rotation, (0.0, 0.0, EARTH_RATE))
    for i in range(3):
        state.frame.origin_ecef[i] = origin[i]
        state.frame.earth_rate_map[i] = earth_rate[i]
        for j in range(3):
            state.frame.map_to_ecef[i, j] = rotation[i][j]
    state.frame.datum_known = 1


@njit
def local_up(state):
    """Return the unit vector against gravity (map axes) at the present position."""
    gravity = gravity_map(state, (state.position_map[0], state.position_map[1], state.position_map[2]))
    scale = -1.0 / math.sqrt(dot(gravity, gravity))
    return (gravity[0] * scale, gravity[1] * scale, gravity[2] * scale)


@njit
def reset_attitude(state, rotation_vector):
    """Turn the attitude by a rotation vector (rad, map axes), and its error with it, which is in map axes, too."""
    turn = from_rotation_vector(rotation_vector)
    attitude = (state.attitude[0], state.attitude[1], state.attitude[2], state.attitude[3])
    attitude = normalized(multiply(turn, attitude))
    for i in range(4):
        state.attitude[i] = attitude[i]
    update_error_axes(state.covariance, ATTITUDE, to_matrix(turn))


@njit
def reset_datum(state, latitude, longitude, altitude, settings):
    """Express the same state in the map frame of another datum (rad, rad, m): an exact rotation and translation."""
    old = east_north_up_to_ecef(state.frame.datum[0], state.frame.datum[1])
    offset = rotate(old, state.position_map)
    ecef = (
        state.frame.origin_ecef[0] + offset[0],
        state.frame.origin_ecef[1] + offset[1],
        state.frame.origin_ecef[2] + offset[2],
    )
    set_datum(state, latitude, longitude, altitude)
    origin = state.frame.origin_ecef
    # Columns of the rotation from old to new map, as rows: the images of the old axes.
    east = rotate_back(state.frame.map_to_ecef, (old[0][0], old[1][0], old[2][0]))
    north = rotate_back(state.frame.map_to_ecef, (old[0][1], old[1][1], old[2][1]))
    up = rotate_back(state.frame.map_to_ecef, (old[0][2], old[1][2], old[2][2]))
    turn = ((east[0], north[0], up[0]), (east[1], north[1], up[1]), (east[2], north[2], up[2]))
    position = rotate_back(state.frame.map_to_ecef, (ecef[0] - origin[0], ecef[1] - origin[1], ecef[2] - origin[2]))
    velocity = rotate(turn, state.velocity_map)
    for i in range(3):
        state.position_map[i] = position[i]
        state.velocity_map[i] = velocity[i]
    update_error_axes(state.covariance, POSITION, turn)
    update_error_axes(state.covariance, VELOCITY, turn)
    place = settings.position_error_at
    if place < state.error_size:
        update_error_axes(state.covariance, place, turn)
        lasting = state.optional[place - ERROR_SIZE : place - ERROR_SIZE + 3]
        lasting[0], lasting[1], lasting[2] = rotate(turn, (lasting[0], lasting[1], lasting[2]))
    reset_attitude(state, to_rotation_vector(from_matrix(turn)))


@njit
def shortest_turn(a, b):
    """Return the shortest rotation vector that turns unit vector ``a`` into ``b``."""
    axis = cross(a, b)
    sine = math.sqrt(dot(axis, axis))
    cosine = dot(a, b)
    if sine < 1e-9:
        if cosine > 0.0:
            return (0.0, 0.0, 0.0)
        # Opposite: half a turn about any perpendicular axis.
        if abs(a[0]) < 0.9:
            axis = cross(a, (1.0, 0.0, 0.0))
        else:
            axis = cross(a, (0.0, 1.0, 0.0))
        scale = math.pi / math.sqrt(dot(axis, axis))
        return (axis[0] * scale, axis[1] * scale, axis[2] * scale)
    scale = math.atan2(sine, cosine) / sine
    return (axis[0] * scale, axis[1] * scale, axis[2] * scale)


@njit
def local_east_north_up_to_ecef(state):
    """Return the rotation from East-North-Up at the present position to ECEF, as row tuples."""
    offset = rotate(state.frame.map_to_ecef, state.position_map)
    geodetic = ecef_to_geodetic(
        state.frame.origin_ecef[0] + offset[0],
        state.frame.origin_ecef[1] + offset[1],
        state.frame.origin_ecef[2] + offset[2],
    )
    return east_north_up_to_ecef(geodetic[0], geodetic[1])


@njit
def body_rate(state, rotation):
    """Return the body rate relative to the Earth (rad/s, IMU axes), free of the estimated gyro bias.

    ``rotation``: body to map.
    """
    earth = rotate_back(rotation, state.frame.earth_rate_map)
    return (
        state.angular_rate[0] - state.gyro_bias[0] - earth[0],
        state.angular_rate[1] - state.gyro_bias[1] - earth[1],
        state.angular_rate[2] - state.gyro_bias[2] - earth[2],
    )


@njit
def heading_of(state, settings):
    """Return the heading (rad, map: 0 = x, counter-clockwise) of the x axis of base_link."""
    # The x axis of base_link in IMU axes is the first row of imu_to_base.
    m = settings.imu_to_base
    forward = rotate(to_matrix(state.attitude), (m[0, 0], m[0, 1], m[0, 2]))
    return math.atan2(forward[1], forward[0])
