"""What several aids need to fill in a measurement."""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.layout import ATTITUDE, ERROR_CAPACITY
from eskf_ros.rotation import rotate, rotate_back, to_matrix


@njit
def clear(work):
    """Zero Jacobian and noise."""
    for i in range(3):
        for j in range(ERROR_CAPACITY):
            work.jacobian[i, j] = 0.0
        for j in range(3):
            work.noise[i, j] = 0.0


@njit
def set_identity(jacobian, column):
    """Write a 3x3 identity block."""
    for i in range(3):
        jacobian[i, column + i] = 1.0


@njit
def set_minus_cross(jacobian, column, v):
    """Write -[v]x: how a small rotation theta changes v, since theta x v = -[v]x theta."""
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
    ecef = state.map_to_ecef
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
def to_local(state, local_to_ecef, direction_body):
    """Return a direction of the body in the axes whose rotation to ECEF is given (East-North-Up at its place)."""
    direction_map = rotate(to_matrix(state.attitude), direction_body)
    return rotate_back(local_to_ecef, rotate(state.map_to_ecef, direction_map))


@njit
def set_attitude_row(jacobian, row, state, local_to_ecef, local):
    """Write how a small rotation about the local axes (``local``) changes a scalar, in map axes."""
    in_map = rotate_back(state.map_to_ecef, rotate(local_to_ecef, local))
    for i in range(3):
        jacobian[row, ATTITUDE + i] = in_map[i]


@njit
def azimuth_change(direction, level_square):
    """Return how a small rotation about local axes changes the angle of ``direction`` from east in the level plane.

    theta x d has the angle (d_e (theta x d)_n - d_n (theta x d)_e) / (d_e^2 + d_n^2), the latter is ``level_square``.
    """
    slope = -direction[2] / level_square
    return (slope * direction[0], slope * direction[1], 1.0)
