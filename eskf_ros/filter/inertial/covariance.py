"""Covariance of the error state over one IMU interval, in blocks.

Error dynamics of the local Earth-fixed frame with the attitude error theta on the map side, q_true = dq(theta) q
(Groves, section 14.2.3, written for the local frame; Sola, section 7.2):

    d/dt dp    = dv
    d/dt dv    = theta x (R f) - R dba - 2 Omega x dv + gradient(g) dp
    d/dt theta = -R dbg - Omega x theta
    d/dt dba, d/dt dbg = random walks

One interval is integrated to second order: the attitude error of mid-interval enters the velocity, the mean of old and
new velocity error the position. This transition matrix has nine rows other than those of the identity. It is never
formed: it is applied to the columns of P, and again to the columns of the transpose of the result. The bias rows do not
change, so the second round has nine columns only. The core does not depend on the augmented states: the transition acts
on their columns in the first round alone. Columns are taken four at a time, as the processor does; what the last four
hold besides is not used.

The force in F is not the measured one: of its horizontal part only as much enters as stands out from its own error
(`credible_force`).
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit, njit_in_caller
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE
from eskf_ros.geodesy.earth import SEMI_MAJOR_AXIS
from eskf_ros.geodesy.rotation import dot, rotate

ACCELERATION_TIME = 1.0
"""s; time constant of the mean acceleration that `credible_force` judges. Vehicles accelerate for about so long."""

CREDIBLE = 5.0
"""Standard deviations (per axis) that the mean acceleration must exceed to be believed; noise alone never does."""

EXCITED_TIME = 60.0
"""s; after an acceleration that was believed, those that follow are part of the same motion."""

EXCITATION = np.dtype([("acceleration", "f8", (3,)), ("left", "f8")], align=True)
"""``acceleration``: horizontal (m/s2, map), low-passed with `ACCELERATION_TIME`; ``left``: seconds for which
accelerations are believed."""


@njit
def credible_force(excitation, covariance, rotation, force, gravity, dt, noise_density):
    """Return the specific force (m/s2, map) of the error dynamics, and advance `EXCITATION` by ``dt`` s.

    A horizontal acceleration turns an error of the heading into one of the velocity: it shows the heading. So do, in
    F, the noise of the accelerometer and an error of tilt or bias, though the robot stands still or travels straight
    on; the heading would grow certain of nothing. Therefore ``force`` has a horizontal part only for `EXCITED_TIME`
    after the low-passed horizontal acceleration has exceeded `CREDIBLE` standard deviations from white noise
    (``noise_density``, m/s2/rtHz; Gelb, section 3.8) and from the covariance. Far from the datum these are about the
    horizontal of map, a few degrees off.

    The motion had begun before it stood out: in the first step the change of velocity since then, about
    `ACCELERATION_TIME` times the low-passed acceleration, is caught up with.
    """
    along = dot(force, gravity) / dot(gravity, gravity)
    vertical = (along * gravity[0], along * gravity[1], along * gravity[2])
    mean = excitation.acceleration
    for i in range(3):
        mean[i] += dt / ACCELERATION_TIME * (force[i] - vertical[i] - mean[i])
    square = mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]
    noise = noise_density**2 / (2.0 * ACCELERATION_TIME)
    excitation.left = max(0.0, excitation.left - dt)
    if square > CREDIBLE**2 * noise and square > CREDIBLE**2 * (
        noise + acceleration_variance(covariance, rotation, vertical)
    ):
        missed = ACCELERATION_TIME / dt if excitation.left == 0.0 else 0.0
        excitation.left = EXCITED_TIME
        return (force[0] + missed * mean[0], force[1] + missed * mean[1], force[2] + missed * mean[2])
    return force if excitation.left > 0.0 else vertical


@njit
def acceleration_variance(covariance, rotation, force):
    """Return the variance (m2/s4, mean of the axes x and y of map) of theta x ``force`` - R dba.

    Of second order, an uncertain heading turns the uncertain bias: R dba moves by theta_z times its length.
    """
    total = 0.0
    for axis in range(2):
        r = rotation[axis]
        turned = (0.0, force[2], -force[1]) if axis == 0 else (-force[2], 0.0, force[0])
        row = (turned[0], turned[1], turned[2], -r[0], -r[1], -r[2])
        for i in range(6):
            # Sums of their own: each addition waits for the one before in the same sum.
            part = 0.0
            for j in range(6):
                part += row[j] * covariance[ATTITUDE + i, ATTITUDE + j]
            total += row[i] * part
    bias_variance = (covariance[9, 9] + covariance[10, 10] + covariance[11, 11]) / 3.0
    return 0.5 * total + covariance[8, 8] * bias_variance


ABREAST = 4
"""Columns of the covariance that the processor takes at a time: single ones cost as much as four."""

TURNED_COLUMNS = -(-ACCEL_BIAS // ABREAST) * ABREAST
"""Columns of the second round: the first nine, and three that are not used."""

UNKNOWN_ATTITUDE = 1.0
"""rad; standard deviation of an attitude that is as good as unknown."""


@njit_in_caller
def apply_transition(columns, out, count, rotation, force, up, gravity_gradient, earth_rate, dt, coupling):
    """Write the nine changing rows of one interval's transition matrix times the first ``count`` columns to ``out``.

    ``columns`` has error size rows. ``rotation``: body to map at mid-interval; ``force``: specific force (m/s2, map);
    ``up``: unit vector (map); ``gravity_gradient``: gravity over Earth radius (1/s2); ``earth_rate`` (rad/s, map);
    ``dt`` in s. ``coupling`` 0 cuts the velocity off from attitude and accelerometer bias (unknown heading), 1 is the
    full model.

    Over 60 lines: one loop, a part of its caller, where the compiler knows how far apart rows are in memory and that
    they do not overlap; only then does it take several columns at a time.
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
    cx, cy, cz = 2.0 * ex, 2.0 * ey, 2.0 * ez
    ux, uy, uz = up[0], up[1], up[2]
    gradient = gravity_gradient * dt
    wx, wy, wz = 3.0 * gradient * ux, 3.0 * gradient * uy, 3.0 * gradient * uz
    h = 0.5 * dt
    for j in range(count):
        px, py, pz = columns[0, j], columns[1, j], columns[2, j]
        vx, vy, vz = columns[3, j], columns[4, j], columns[5, j]
        tx, ty, tz = columns[6, j], columns[7, j], columns[8, j]
        ax, ay, az = columns[9, j], columns[10, j], columns[11, j]
        gx, gy, gz = columns[12, j], columns[13, j], columns[14, j]
        new_tx = tx - (r00 * gx + r01 * gy + r02 * gz) - (ey * tz - ez * ty)
        new_ty = ty - (r10 * gx + r11 * gy + r12 * gz) - (ez * tx - ex * tz)
        new_tz = tz - (r20 * gx + r21 * gy + r22 * gz) - (ex * ty - ey * tx)
        sx, sy, sz = tx + new_tx, ty + new_ty, tz + new_tz
        vertical = ux * px + uy * py + uz * pz
        new_vx = (
            vx
            + (sy * fz - sz * fy)
            - (a00 * ax + a01 * ay + a02 * az)
            - (cy * vz - cz * vy)
            + (wx * vertical - gradient * px)
        )
        new_vy = (
            vy
            + (sz * fx - sx * fz)
            - (a10 * ax + a11 * ay + a12 * az)
            - (cz * vx - cx * vz)
            + (wy * vertical - gradient * py)
        )
        new_vz = (
            vz
            + (sx * fy - sy * fx)
            - (a20 * ax + a21 * ay + a22 * az)
            - (cx * vy - cy * vx)
            + (wz * vertical - gradient * pz)
        )
        out[0, j] = px + h * (vx + new_vx)
        out[1, j] = py + h * (vy + new_vy)
        out[2, j] = pz + h * (vz + new_vz)
        out[3, j], out[4, j], out[5, j] = new_vx, new_vy, new_vz
        out[6, j], out[7, j], out[8, j] = new_tx, new_ty, new_tz


@njit
def propagate_noise(covariance, velocity_noise, attitude_noise, accel_walk, gyro_walk, dt):
    """Add ``dt`` s of process noise, all spectral densities.

    Velocity (m2/s3), attitude (rad2/s), and the random walks of the biases (m2/s5, rad2/s3).
    """
    for i in range(3):
        p, v, t, a, g = i, 3 + i, 6 + i, 9 + i, 12 + i
        covariance[p, p] += velocity_noise * dt * dt * dt / 3.0
        covariance[p, v] += velocity_noise * dt * dt / 2.0
        covariance[v, p] += velocity_noise * dt * dt / 2.0
        covariance[v, v] += velocity_noise * dt
        covariance[t, t] += attitude_noise * dt
        covariance[a, a] += accel_walk * dt
        covariance[g, g] += gyro_walk * dt


@njit
def propagate_axis_noise(covariance, rotation, density, dt):
    """Add ``dt`` s of process noise along the axes of the IMU, which ``rotation`` (body to map) turns into the map.

    ``density``: spectral densities of velocity (m2/s3) along x, y, z, and of attitude (rad2/s) about them. An attitude
    that is as good as unknown stays as it is: errors of more than a radian are beyond what is linear.
    """
    is_lost = covariance[6, 6] + covariance[7, 7] + covariance[8, 8] > UNKNOWN_ATTITUDE**2
    for i in range(3):
        for j in range(3):
            velocity, attitude = 0.0, 0.0
            for k in range(3):
                product = rotation[i][k] * rotation[j][k]
                velocity += density[k] * product
                attitude += density[3 + k] * product
            covariance[i, j] += velocity * dt * dt * dt / 3.0
            covariance[i, 3 + j] += velocity * dt * dt / 2.0
            covariance[3 + j, i] += velocity * dt * dt / 2.0
            covariance[3 + i, 3 + j] += velocity * dt
            if not is_lost:
                covariance[6 + i, 6 + j] += attitude * dt


@njit
def vertical(gravity):
    """Return the unit vector against gravity (m/s2, map) and gravity over Earth radius (1/s2)."""
    strength = math.sqrt(gravity[0] * gravity[0] + gravity[1] * gravity[1] + gravity[2] * gravity[2])
    return (-gravity[0] / strength, -gravity[1] / strength, -gravity[2] / strength), strength / SEMI_MAJOR_AXIS


@njit_in_caller
def propagate_covariance(covariance, size, rotation, force, gravity, earth_rate, dt, coupling, work):
    """Apply one interval's transition matrix on both sides of the covariance; arguments as for `apply_transition`.

    ``size`` errors are in use; ``gravity`` is the vector (m/s2, map); the result is exactly symmetric.
    """
    up, gradient = vertical(gravity)
    half = work.half
    count = min(-(-size // ABREAST) * ABREAST, len(covariance))
    apply_transition(covariance, half, count, rotation, force, up, gradient, earth_rate, dt, coupling)
    for i in range(ACCEL_BIAS):
        for j in range(ERROR_SIZE):
            work.turned[j, i] = half[i, j]
    apply_transition(work.turned, covariance, TURNED_COLUMNS, rotation, force, up, gradient, earth_rate, dt, coupling)
    for i in range(ACCEL_BIAS):
        for j in range(i):
            covariance[i, j] = covariance[j, i]
        for j in range(ACCEL_BIAS, size):
            covariance[i, j] = half[i, j]
            covariance[j, i] = half[i, j]


@njit
def turn_rows(columns, block, matrix):
    """Replace the three rows from index ``block`` by ``matrix`` (3x3 row tuples) times them."""
    for j in range(columns.shape[1]):
        turned = rotate(matrix, (columns[block, j], columns[block + 1, j], columns[block + 2, j]))
        for i in range(3):
            columns[block + i, j] = turned[i]


@njit
def update_error_axes(covariance, block, matrix):
    """Transform the three errors from index ``block``, and their covariance, by ``matrix`` (3x3 row tuples)."""
    turn_rows(covariance, block, matrix)
    for j in range(len(covariance)):
        error = rotate(matrix, (covariance[j, block], covariance[j, block + 1], covariance[j, block + 2]))
        for i in range(3):
            covariance[j, block + i] = error[i]
    for i in range(3):
        for j in range(i):
            covariance[block + i, block + j] = covariance[block + j, block + i]
