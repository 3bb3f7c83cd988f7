"""Covariance of the error state over one IMU interval, in blocks.

Error dynamics of the local Earth-fixed frame with the attitude error theta on the map side, q_true = dq(theta) q
(Groves, section 14.2.3, written for the local frame; Sola, section 7.2):

    d/dt dp    = dv
    d/dt dv    = theta x (R f) - R dba - 2 Omega x dv + gradient(g) dp
    d/dt theta = -R dbg - Omega x theta
    d/dt dba, d/dt dbg = random walks

One interval is integrated to second order: the attitude error of mid-interval enters the velocity, the mean of old
and new velocity error the position. That is a transition of nine rows which never becomes a matrix: it is applied to
the rows of P, and again to the rows of the transpose of the result.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.earth import SEMI_MAJOR_AXIS
from eskf_ros.filter.layout import ATTITUDE, ERROR_SIZE
from eskf_ros.rotation import rotate


@njit
def apply_transition(rows, out, rotation, force, up, gravity_gradient, earth_rate, dt, coupling):
    """Write the transition of one interval times ``rows`` to ``out`` (both error size x error size).

    ``rotation`` body to map at mid-interval, ``force`` specific force (m/s2, map), ``up`` unit vector (map),
    ``gravity_gradient`` gravity over Earth radius (1/s2), ``earth_rate`` (rad/s, map), ``dt`` in s. ``coupling`` 0 cuts
    velocity off from attitude and accelerometer bias (unknown heading), 1 is the full model.
    """
    r00, r01, r02 = rotation[0][0] * dt, rotation[0][1] * dt, rotation[0][2] * dt
    r10, r11, r12 = rotation[1][0] * dt, rotation[1][1] * dt, rotation[1][2] * dt
    r20, r21, r22 = rotation[2][0] * dt, rotation[2][1] * dt, rotation[2][2] * dt
    a00, a01, a02 = coupling * r00, coupling * r01, coupling * r02
    a10, a11, a12 = coupling * r10, coupling * r11, coupling * r12
    a20, a21, a22 = coupling * r20, coupling * r21, coupling * r22
    # Half, because old and new attitude error are added below.
    half = 0.5 * dt * coupling
    fx, fy, fz = half * force[0], half * force[1], half * force[2]
    ex, ey, ez = earth_rate[0] * dt, earth_rate[1] * dt, earth_rate[2] * dt
    ux, uy, uz = up[0], up[1], up[2]
    gradient = gravity_gradient * dt
    h = 0.5 * dt
    for j in range(ERROR_SIZE):
        px, py, pz = rows[0, j], rows[1, j], rows[2, j]
        vx, vy, vz = rows[3, j], rows[4, j], rows[5, j]
        tx, ty, tz = rows[6, j], rows[7, j], rows[8, j]
        ax, ay, az = rows[9, j], rows[10, j], rows[11, j]
        gx, gy, gz = rows[12, j], rows[13, j], rows[14, j]
        new_tx = tx - (r00 * gx + r01 * gy + r02 * gz) - (ey * tz - ez * ty)
        new_ty = ty - (r10 * gx + r11 * gy + r12 * gz) - (ez * tx - ex * tz)
        new_tz = tz - (r20 * gx + r21 * gy + r22 * gz) - (ex * ty - ey * tx)
        sx, sy, sz = tx + new_tx, ty + new_ty, tz + new_tz
        vertical = 3.0 * (ux * px + uy * py + uz * pz)
        new_vx = (
            vx
            + (sy * fz - sz * fy)
            - (a00 * ax + a01 * ay + a02 * az)
            - 2.0 * (ey * vz - ez * vy)
            + gradient * (vertical * ux - px)
        )
        new_vy = (
            vy
            + (sz * fx - sx * fz)
            - (a10 * ax + a11 * ay + a12 * az)
            - 2.0 * (ez * vx - ex * vz)
            + gradient * (vertical * uy - py)
        )
        new_vz = (
            vz
            + (sx * fy - sy * fx)
            - (a20 * ax + a21 * ay + a22 * az)
            - 2.0 * (ex * vy - ey * vx)
            + gradient * (vertical * uz - pz)
        )
        out[0, j] = px + h * (vx + new_vx)
        out[1, j] = py + h * (vy + new_vy)
        out[2, j] = pz + h * (vz + new_vz)
        out[3, j], out[4, j], out[5, j] = new_vx, new_vy, new_vz
        out[6, j], out[7, j], out[8, j] = new_tx, new_ty, new_tz
        out[9, j], out[10, j], out[11, j] = ax, ay, az
        out[12, j], out[13, j], out[14, j] = gx, gy, gz


@njit
def transpose(matrix):
    """Transpose a square matrix in place."""
    for i in range(ERROR_SIZE):
        for j in range(i):
            matrix[i, j], matrix[j, i] = matrix[j, i], matrix[i, j]


@njit
def add_noise(covariance, velocity_noise, attitude_noise, dt, settings):
    """Add ``dt`` s of process noise; velocity (m2/s3) and attitude (rad2/s) noise are spectral densities."""
    for i in range(3):
        p, v, t, a, g = i, 3 + i, 6 + i, 9 + i, 12 + i
        covariance[p, p] += velocity_noise * dt * dt * dt / 3.0
        covariance[p, v] += velocity_noise * dt * dt / 2.0
        covariance[v, p] += velocity_noise * dt * dt / 2.0
        covariance[v, v] += velocity_noise * dt
        covariance[t, t] += attitude_noise * dt
        covariance[a, a] += settings.accel_bias_random_walk**2 * dt
        covariance[g, g] += settings.gyro_bias_random_walk**2 * dt


@njit
def propagate_covariance(covariance, rotation, force, gravity, earth_rate, dt, coupling, work):
    """Apply one interval's transition on both sides of the covariance; arguments as for ``apply_transition``.

    ``gravity`` is the vector (m/s2, map); the result is exactly symmetric.
    """
    strength = math.sqrt(gravity[0] * gravity[0] + gravity[1] * gravity[1] + gravity[2] * gravity[2])
    up = (-gravity[0] / strength, -gravity[1] / strength, -gravity[2] / strength)
    gradient = strength / SEMI_MAJOR_AXIS
    apply_transition(covariance, work.half, rotation, force, up, gradient, earth_rate, dt, coupling)
    transpose(work.half)
    apply_transition(work.half, covariance, rotation, force, up, gradient, earth_rate, dt, coupling)
    for i in range(ERROR_SIZE):
        for j in range(i):
            covariance[i, j] = covariance[j, i]


@njit
def transform_attitude_error(covariance, matrix):
    """Replace the attitude error theta by ``matrix`` theta (3x3 row tuples) in the covariance."""
    for j in range(ERROR_SIZE):
        theta = rotate(matrix, (covariance[ATTITUDE, j], covariance[ATTITUDE + 1, j], covariance[ATTITUDE + 2, j]))
        for i in range(3):
            covariance[ATTITUDE + i, j] = theta[i]
    for j in range(ERROR_SIZE):
        theta = rotate(matrix, (covariance[j, ATTITUDE], covariance[j, ATTITUDE + 1], covariance[j, ATTITUDE + 2]))
        for i in range(3):
            covariance[j, ATTITUDE + i] = theta[i]
