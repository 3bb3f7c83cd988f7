"""Unit quaternions and rotation matrices (Sola, Quaternion kinematics for the error-state Kalman filter).

A quaternion is (w, x, y, z), Hamilton, and turns body coordinates into ``map`` coordinates. Compiled functions take
and return tuples, so that nothing is allocated; a 3x3 matrix is a tuple of three row tuples or an array.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit


@njit
def cross(a, b):
    """Return the cross product of two 3-vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit
def dot(a, b):
    """Return the scalar product of two 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit
def multiply(a, b):
    """Return the Hamilton product of two quaternions (Sola, eq. 12)."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@njit
def normalized(q):
    """Return the quaternion scaled to unit length."""
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale)


@njit
def from_rotation_vector(v):
    """Return the quaternion that turns by the rotation vector ``v`` (rad; Sola, eq. 101), exact near zero too."""
    angle2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if angle2 < 1e-8:
        half_sinc = 0.5 - angle2 / 48.0
        return (1.0 - angle2 / 8.0 + angle2 * angle2 / 384.0, v[0] * half_sinc, v[1] * half_sinc, v[2] * half_sinc)
    angle = math.sqrt(angle2)
    half_sinc = math.sin(0.5 * angle) / angle
    return (math.cos(0.5 * angle), v[0] * half_sinc, v[1] * half_sinc, v[2] * half_sinc)


@njit
def to_rotation_vector(q):
    """Return the rotation vector (rad) of a unit quaternion, its length at most pi (Sola, eq. 103)."""
    sign = 1.0 if q[0] >= 0.0 else -1.0
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    scale = 2.0 * sign
    if sine > 1e-12:
        scale = 2.0 * math.atan2(sign * sine, sign * q[0]) / sine
    return (q[1] * scale, q[2] * scale, q[3] * scale)


@njit
def left_jacobian(v):
    """Return the left Jacobian of a rotation vector (rad), as row tuples.

    It turns what is constant in axes that turn by ``v`` meanwhile, on the average (Sola, Deray and Atchuthan, A micro
    Lie theory for state estimation in robotics, 2018, eq. 145).
    """
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    angle = math.sqrt(square)
    first, second = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    if angle > 1e-3:
        first, second = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
    x, y, z = v[0], v[1], v[2]
    return (
        (1.0 - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y),
        (second * x * y + first * z, 1.0 - second * (x * x + z * z), second * y * z - first * x),
        (second * x * z - first * y, second * y * z + first * x, 1.0 - second * (x * x + y * y)),
    )


@njit
def to_matrix(q):
    """Return the rotation matrix of a unit quaternion as three row tuples (Sola, eq. 115)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@njit
def from_matrix(m):
    """Return the unit quaternion (w >= 0) of a rotation matrix, by its largest component (Shepperd's method)."""
    trace = m[0][0] + m[1][1] + m[2][2]
    if trace >= max(m[0][0], m[1][1], m[2][2]):
        q = (1.0 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1])
    elif m[0][0] >= m[1][1] and m[0][0] >= m[2][2]:
        q = (m[2][1] - m[1][2], 1.0 + 2.0 * m[0][0] - trace, m[0][1] + m[1][0], m[0][2] + m[2][0])
    elif m[1][1] >= m[2][2]:
        q = (m[0][2] - m[2][0], m[0][1] + m[1][0], 1.0 + 2.0 * m[1][1] - trace, m[1][2] + m[2][1])
    else:
        q = (m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1.0 + 2.0 * m[2][2] - trace)
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    return normalized(q)


@njit
def rotate(rotation, v):
    """Return rotation matrix times vector."""
    return (
        rotation[0][0] * v[0] + rotation[0][1] * v[1] + rotation[0][2] * v[2],
        rotation[1][0] * v[0] + rotation[1][1] * v[1] + rotation[1][2] * v[2],
        rotation[2][0] * v[0] + rotation[2][1] * v[1] + rotation[2][2] * v[2],
    )


@njit
def rotate_back(rotation, v):
    """Return transposed rotation matrix times vector."""
    return (
        rotation[0][0] * v[0] + rotation[1][0] * v[1] + rotation[2][0] * v[2],
        rotation[0][1] * v[0] + rotation[1][1] * v[1] + rotation[2][1] * v[2],
        rotation[0][2] * v[0] + rotation[1][2] * v[1] + rotation[2][2] * v[2],
    )


@njit
def from_roll_pitch_yaw(roll, pitch, yaw):
    """Return the quaternion of fixed-axis roll, pitch, yaw (rad): Rz(yaw) Ry(pitch) Rx(roll), as in REP-103."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@njit
def wrapped(angle):
    """Return ``angle`` (rad) wrapped to [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
