"""The one update of all measurements: innovation gate, gain, Joseph form, injection, reset."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.covariance import turn_rows, update_error_axes
from eskf_ros.filter.inertial.navigation_frame import local_up
from eskf_ros.filter.state.enums import Verdict
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, GYRO_BIAS, POSITION, VELOCITY
from eskf_ros.geodesy.rotation import (
    dot,
    from_rotation_vector,
    left_jacobian,
    multiply,
    normalized,
    rotate,
    rotate_back,
    to_matrix,
)

ITERATIONS = 4
"""Estimates of the errors by one measurement, at most. What is missed becomes less by half of the turn (rad) each."""

NEGLIGIBLE = 1e-12
"""Share of a correction up to which it does not matter that it is missed."""

TURNING_RATE = 0.1
"""rad/s; beyond it the robot turns, whatever the bias of its gyro."""


@njit
def update(state, size, gate, work):
    """Fuse ``size`` scalars described by ``work.jacobian``, ``work.innovation``, ``work.noise``, ``work.shared``.

    Returns the verdict and the normalised innovation squared (NIS); the state changes only if the verdict is FUSED.
    ``gate`` is the largest NIS that is accepted.
    """
    nis, determinant = judge(state, size, work)
    if determinant == 0.0:
        return Verdict.BAD_COVARIANCE, np.nan
    if not nis <= gate:
        return Verdict.GATE, nis
    apply(state, size, work)
    return Verdict.FUSED, nis


@njit
def judge(state, size, work):
    """Return the NIS of the measurement in ``work``, and the determinant of its innovation covariance.

    The determinant is 0 if the covariance is not positive definite, and the NIS is NaN then. ``work.projected`` and, in
    ``work.innovation_covariance``, the inverse of the innovation covariance are left for `apply`.
    """
    project(state, size, work)
    determinant = invert_positive(work.innovation_covariance, size)
    if determinant == 0.0:
        return np.nan, 0.0
    inverse = work.innovation_covariance
    nis = 0.0
    for a in range(size):
        for b in range(size):
            nis += work.innovation[a] * inverse[a, b] * work.innovation[b]
    return nis, determinant


@njit
def apply(state, size, work):
    """Fuse the measurement that `judge` has seen: gain, covariance, injection and reset.

    Joseph form with the full product (I - K H) P (I - K H)' + K R K' (Groves, eq. 3.58), evaluated through its
    rank-``size`` parts, and extended by the covariance C of noise and errors (Brown and Hwang, Introduction to Random
    Signals, section 5.5). It holds for any gain, also for one that holds the heading.
    """
    inverse = work.innovation_covariance
    for i in range(state.error_size):
        for a in range(size):
            gain = 0.0
            for b in range(size):
                gain += work.projected[b, i] * inverse[b, a]
            work.gain[i, a] = gain
    if work.holds_heading == 1 and not is_heading_shown(state):
        hold_heading(state, size, work)
    compute_correction(state, size, work)
    update_covariance(state, size, work)
    update_nominal_state(state, work.correction)
    reset_errors(state, work.correction)


@njit
def compute_correction(state, size, work):
    """Write the estimate of the errors to ``work.correction``.

    Position and velocity are corrected in axes that turn with the attitude meanwhile (`reset_errors`), so that the
    measurement is not met by as much (``work.missed``). It counts again, until that is negligible: the iterated update
    of Bell and Cathey (The iterated Kalman filter update as a Gauss-Newton method, 1993), whose gain is kept.
    """
    c, missed, share = work.correction, work.missed, 1.0
    missed.fill(0.0)
    for _ in range(ITERATIONS):
        for i in range(state.error_size):
            c[i] = 0.0
            for a in range(size):
                c[i] += work.gain[i, a] * (work.innovation[a] + missed[a])
        missed.fill(0.0)
        turn = (c[ATTITUDE], c[ATTITUDE + 1], c[ATTITUDE + 2])
        turning = left_jacobian(turn)
        for block in (POSITION, VELOCITY):
            turned = rotate(turning, (c[block], c[block + 1], c[block + 2]))
            for i in range(3):
                for a in range(size):
                    missed[a] += work.jacobian[a, block + i] * (c[block + i] - turned[i])
                c[block + i] = turned[i]
        share *= 0.5 * math.sqrt(dot(turn, turn))
        if share < NEGLIGIBLE:
            return


@njit
def is_heading_shown(state):
    """Say whether the robot moves so that GNSS shows its heading: it accelerates, or the antenna goes round it."""
    rate, bias = state.imu.smooth_rate, state.gyro_bias
    turn = (rate[0] - bias[0], rate[1] - bias[1], rate[2] - bias[2])
    return state.excitation.left > 0.0 or dot(turn, turn) > TURNING_RATE**2


@njit
def hold_heading(state, size, work):
    """Take the heading and what is known through it out of the gain in ``work``.

    That is the gyro bias about the vertical, whose integral the heading is, and the offset of a heading sensor.
    GNSS does not see them while no acceleration stands out (`credible_force`) and nothing turns. What the linearised
    filter would learn all the same, it learns from its own corrections: lever arm, Earth rate and biases turn with the
    estimate, and with them what is unobservable. These errors still count in the covariance of the innovation (Schmidt,
    Application of state-space methods to navigation problems, 1966).
    """
    up = local_up(state)
    up_body = rotate_back(to_matrix(state.attitude), up)
    for a in range(size):
        turn, drift = 0.0, 0.0
        for i in range(3):
            turn += up[i] * work.gain[ATTITUDE + i, a]
            drift += up_body[i] * work.gain[GYRO_BIAS + i, a]
        for i in range(3):
            work.gain[ATTITUDE + i, a] -= turn * up[i]
            work.gain[GYRO_BIAS + i, a] -= drift * up_body[i]
        if work.heading_offset_at < state.error_size:
            work.gain[work.heading_offset_at, a] = 0.0


@njit
def reset_errors(state, correction):
    """Turn the errors of position, velocity and attitude about the vertical, by the correction of the heading.

    R_true = exp(heading error) exp(tilt error) R. GNSS and gravity do not see a turn of all about the vertical: what
    stays unknown is a factor on the far left, whatever the tilt is corrected by, and its axis must stay the vertical.
    The Jacobian of the one rotation vector (Sola, section 6.3.1) tips it by half of each correction of the tilt; these
    corrections follow the noise of the gyro for ever, and the filter would learn the heading from it. The tilt error
    turns with a corrected heading, as the accelerometer bias does that it is correlated with.

    So do the errors of position and velocity: an unknown heading enters them across the acceleration, whose direction
    on the map is turned with the heading. About the vertical the error is that of the left-invariant filter (Barrau and
    Bonnabel, The invariant extended Kalman filter as a stable observer, 2017).
    """
    up = local_up(state)
    angle = dot(up, (correction[ATTITUDE], correction[ATTITUDE + 1], correction[ATTITUDE + 2]))
    turn = to_matrix(from_rotation_vector((angle * up[0], angle * up[1], angle * up[2])))
    used = state.covariance[: state.error_size, : state.error_size]
    for block in (POSITION, VELOCITY, ATTITUDE):
        update_error_axes(used, block, turn)
    turn_rows(state.forward.reset, 0, turn)


@njit
def project(state, size, work):
    """Write H P + C' to ``work.projected`` and H P H' + H C + C' H' + R to ``work.innovation_covariance``."""
    covariance, n = state.covariance, state.error_size
    for a in range(size):
        for j in range(n):
            work.projected[a, j] = work.shared[a, j]
        for i in range(n):
            h = work.jacobian[a, i]
            if h != 0.0:
                for j in range(n):
                    work.projected[a, j] += h * covariance[i, j]
    for a in range(size):
        for b in range(a + 1):
            total = work.noise[a, b]
            for j in range(n):
                total += work.projected[a, j] * work.jacobian[b, j] + work.shared[b, j] * work.jacobian[a, j]
            work.innovation_covariance[a, b] = total
            work.innovation_covariance[b, a] = total


@njit
def invert_positive(matrix, size):
    """Invert a symmetric positive definite matrix in place (Gauss-Jordan); return its determinant, 0 if it is none."""
    determinant = 1.0
    for k in range(size):
        pivot = matrix[k, k]
        if not (pivot > 0.0 and pivot < math.inf):
            return 0.0
        determinant *= pivot
        matrix[k, k] = 1.0
        for j in range(size):
            matrix[k, j] /= pivot
        for i in range(size):
            if i != k:
                factor = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(size):
                    matrix[i, j] -= factor * matrix[k, j]
    for i in range(size):
        for j in range(i):
            mean = 0.5 * (matrix[i, j] + matrix[j, i])
            matrix[i, j] = mean
            matrix[j, i] = mean
    return determinant


@njit
def update_covariance(state, size, work):
    """Replace P by (I - K H) P (I - K H)' + K R K' - (I - K H) C K' - K C' (I - K H)', exactly symmetric."""
    covariance, n, gain = state.covariance, state.error_size, work.gain
    for i in range(n):
        for a in range(size):
            k = gain[i, a]
            for j in range(n):
                covariance[i, j] -= k * work.projected[a, j]
    # ``covariance`` is (I - K H) P - K C' now. All that is missing is (this H' - K R + C - K H C) K'.
    for a in range(size):
        for b in range(size):
            work.noise_seen[a, b] = work.noise[a, b]
            for j in range(n):
                work.noise_seen[a, b] += work.jacobian[a, j] * work.shared[b, j]
    for i in range(n):
        for a in range(size):
            total = work.shared[a, i]
            for j in range(n):
                total += covariance[i, j] * work.jacobian[a, j]
            for b in range(size):
                total -= gain[i, b] * work.noise_seen[b, a]
            work.residual_gain[i, a] = total
    for i in range(n):
        for j in range(i + 1):
            total = covariance[i, j]
            for a in range(size):
                total -= work.residual_gain[i, a] * gain[j, a]
            covariance[i, j] = total
            covariance[j, i] = total


@njit
def update_nominal_state(state, correction):
    """Inject the error estimate into the nominal state (closed loop); the error state is zero afterwards."""
    for i in range(3):
        state.position_map[i] += correction[POSITION + i]
        state.velocity_map[i] += correction[VELOCITY + i]
        state.accel_bias[i] += correction[ACCEL_BIAS + i]
        state.gyro_bias[i] += correction[GYRO_BIAS + i]
    turn = from_rotation_vector((correction[ATTITUDE], correction[ATTITUDE + 1], correction[ATTITUDE + 2]))
    attitude = normalized(multiply(turn, (state.attitude[0], state.attitude[1], state.attitude[2], state.attitude[3])))
    for i in range(4):
        state.attitude[i] = attitude[i]
    for i in range(state.error_size - ERROR_SIZE):
        state.optional[i] += correction[ERROR_SIZE + i]
