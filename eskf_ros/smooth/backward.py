"""The backward pass: a fixed-interval smoother (Rauch, Tung and Striebel, 1965) over the log of the forward pass.

With the nominal states x and covariances P of the filter before (-) and after (+) the measurements of each node, the
transition F of the errors between nodes, and smoothed x_s, P_s (Sarkka, Bayesian Filtering and Smoothing, section 8.2):

    C     = P+(k) F' P-(k+1)^-1
    x_s(k) = x+(k) + C (x_s(k+1) - x-(k+1))
    P_s(k) = P+(k) + C (P_s(k+1) - P-(k+1)) C'

The differences count from the predicted state: what the filter injected at the node is part of them. Its reset turns
the axes of the errors of position, velocity and attitude; the log has the matrix G of it, and the smoothed errors go
back by its inverse. So the pass is linear in errors about the trajectory of the filter, whatever force the filter
believed and however it resets. Where the filter did something else than to predict and to update
(`output.forward_log`), the smoothed state is the filter's own and the recursion begins anew. An augmented state that
was reset tells nothing of its past: it is left out of P- there.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.covariance import update_error_axes
from eskf_ros.filter.output.forward_log import (
    AFTER,
    BEFORE,
    COVARIANCE_BEFORE,
    FADE,
    RESET,
    TRANSITION,
)
from eskf_ros.filter.state.error_state import (
    ACCEL_BIAS,
    ATTITUDE,
    ERROR_CAPACITY,
    ERROR_SIZE,
    OPTIONAL_CAPACITY,
    POSITION,
    VELOCITY,
)
from eskf_ros.geodesy.rotation import (
    cross,
    dot,
    left_jacobian,
    multiply,
    rotate,
    to_rotation_vector,
)

CORE_TRIANGLE = ERROR_SIZE * (ERROR_SIZE + 1) // 2

CORRECTION_AFTER, CORRECTION_BEFORE = 0, ERROR_SIZE
"""Places of the corrections of the 15 errors in the numbers of a smoothed node: they replace what the filter knew."""

SMOOTHED_AFTER = 2 * ERROR_SIZE
"""Place of the smoothed covariance of the 15 errors after the measurements: its lower triangle by rows."""

SMOOTHED_BEFORE = SMOOTHED_AFTER + CORE_TRIANGLE
"""The same before the measurements: it differs where the recursion began anew."""

LEAST_PIVOT = 1e-13
"""Pivot of the Cholesky factor of a correlation matrix up to which an error follows from those before it."""

PASS = np.dtype(
    [
        ("is_linked", "i8"),
        ("size", "i8"),
        ("transition", "f8", (ACCEL_BIAS, ERROR_SIZE)),
        ("fade", "f8", (OPTIONAL_CAPACITY + 1,)),
        # Of the following node, before its measurements: the filter's covariance, and what smoothing adds.
        ("predicted", "f8", (ERROR_CAPACITY, ERROR_CAPACITY)),
        ("added", "f8", (ERROR_CAPACITY, ERROR_CAPACITY)),
        ("correction", "f8", (ERROR_CAPACITY,)),
        # Of the node itself.
        ("covariance", "f8", (ERROR_CAPACITY, ERROR_CAPACITY)),
        ("change", "f8", (ERROR_CAPACITY,)),
        # Intermediate results.
        ("scale", "f8", (ERROR_CAPACITY,)),
        ("factor", "f8", (ERROR_CAPACITY, ERROR_CAPACITY)),
        ("gain", "f8", (ERROR_CAPACITY, ERROR_CAPACITY)),
        ("product", "f8", (ERROR_CAPACITY, ERROR_CAPACITY)),
    ],
    align=True,
)
"""What the backward pass carries from a node to the one before it, and scratch memory."""


@njit
def smooth_nodes(nodes, numbers, pass_, clock_at):
    """Smooth nodes (NODE, and their numbers), the last first; the numbers become corrections and covariances.

    ``pass_`` (PASS) carries on from the nodes that follow; ``clock_at``: index of the receiver clock.
    """
    p = pass_[0]
    after = (COVARIANCE_BEFORE + numbers.shape[1]) // 2
    for k in range(len(nodes) - 1, -1, -1):
        node, row = nodes[k], numbers[k]
        size = node.size_after
        unpack(row, after, size, p.covariance)
        for i in range(ERROR_CAPACITY):
            p.change[i] = 0.0
        if p.is_linked == 1:
            compute_gain(p, size, clock_at)
            apply_gain(p, size)
        go_before(p, node, row)
        for i in range(ERROR_SIZE):
            row[CORRECTION_AFTER + i] = p.change[i]
            row[CORRECTION_BEFORE + i] = p.correction[i]
        at = 0
        for i in range(ERROR_SIZE):
            for j in range(i + 1):
                row[SMOOTHED_AFTER + at] = p.covariance[i, j]
                row[SMOOTHED_BEFORE + at] = p.predicted[i, j] + p.added[i, j]
                at += 1


@njit
def unpack(row, place, size, matrix):
    """Write a lower triangle, by rows, to both triangles of a matrix."""
    at = place
    for i in range(size):
        for j in range(i + 1):
            matrix[i, j] = row[at]
            matrix[j, i] = row[at]
            at += 1


@njit
def compute_gain(p, size, clock_at):
    """Write C' = P-(k+1)^-1 F P+(k) to ``p.gain``, by the Cholesky factor of the correlation matrix of P-(k+1)."""
    gain, covariance, factor, scale = p.gain, p.covariance, p.factor, p.scale
    for i in range(ACCEL_BIAS):
        for j in range(size):
            gain[i, j] = 0.0
        for m in range(ERROR_SIZE):
            f = p.transition[i, m]
            if f != 0.0:
                for j in range(size):
                    gain[i, j] += f * covariance[m, j]
    for i in range(ACCEL_BIAS, size):
        f = 1.0 if i < ERROR_SIZE else p.fade[i - ERROR_SIZE]
        for j in range(size):
            gain[i, j] = f * covariance[i, j]
    if clock_at + 1 < size:
        for j in range(size):
            gain[clock_at, j] += p.fade[OPTIONAL_CAPACITY] * covariance[clock_at + 1, j]
    for i in range(size):
        variance = p.predicted[i, i]
        scale[i] = 1.0 / math.sqrt(variance) if variance > 0.0 else 0.0
        for j in range(i):
            total = p.predicted[i, j] * scale[i] * scale[j]
            for m in range(j):
                total -= factor[i, m] * factor[j, m]
            factor[i, j] = total * factor[j, j]
        pivot = 1.0
        for m in range(i):
            pivot -= factor[i, m] * factor[i, m]
        # The diagonal holds the inverse: 0 leaves out an error that has no variance, or none of its own.
        factor[i, i] = 1.0 / math.sqrt(pivot) if scale[i] > 0.0 and pivot > LEAST_PIVOT else 0.0
    for i in range(size):
        for j in range(size):
            gain[i, j] *= scale[i]
        for m in range(i):
            f = factor[i, m]
            for j in range(size):
                gain[i, j] -= f * gain[m, j]
        for j in range(size):
            gain[i, j] *= factor[i, i]
    for i in range(size - 1, -1, -1):
        for m in range(i + 1, size):
            f = factor[m, i]
            for j in range(size):
                gain[i, j] -= f * gain[m, j]
        for j in range(size):
            gain[i, j] *= factor[i, i]
    for i in range(size):
        for j in range(size):
            gain[i, j] *= scale[i]


@njit
def apply_gain(p, size):
    """Write C times the correction to ``p.change``, and add C (P_s - P-) C' to the covariance."""
    for m in range(size):
        for i in range(size):
            p.change[i] += p.gain[m, i] * p.correction[m]
    for i in range(size):
        for j in range(size):
            p.product[i, j] = 0.0
        for m in range(size):
            f = p.added[i, m]
            if f != 0.0:
                for j in range(size):
                    p.product[i, j] += f * p.gain[m, j]
    for m in range(size):
        for i in range(size):
            f = p.gain[m, i]
            for j in range(i + 1):
                p.covariance[i, j] += f * p.product[m, j]
    for i in range(size):
        for j in range(i):
            p.covariance[j, i] = p.covariance[i, j]


@njit
def inverse_of(m):
    """Return the inverse of a 3x3 matrix (row tuples), by its cofactors."""
    a = cross(m[1], m[2])
    b = cross(m[2], m[0])
    c = cross(m[0], m[1])
    scale = 1.0 / dot(m[0], a)
    return (
        (a[0] * scale, b[0] * scale, c[0] * scale),
        (a[1] * scale, b[1] * scale, c[1] * scale),
        (a[2] * scale, b[2] * scale, c[2] * scale),
    )


@njit
def go_before(p, node, row):
    """Prepare the node before: what this one says of the estimate before its measurements, and the way from there.

    ``p.change`` and ``p.covariance`` are the smoothed errors of the estimate after them; what is said is the
    ``p.correction`` of the filter's prediction, and what is ``p.added`` to its covariance ``p.predicted``.
    """
    size = node.size_before
    p.is_linked = node.is_linked
    p.size = size
    for i in range(ACCEL_BIAS):
        for j in range(ERROR_SIZE):
            p.transition[i, j] = row[TRANSITION + ERROR_SIZE * i + j]
    for i in range(OPTIONAL_CAPACITY + 1):
        p.fade[i] = row[FADE + i]
    unpack(row, COVARIANCE_BEFORE, size, p.predicted)
    for i in range(size):
        p.correction[i] = 0.0
        for j in range(size):
            p.added[i, j] = 0.0
    if node.is_continued == 0:
        return
    r = row[RESET : RESET + 9]
    back = inverse_of(((r[0], r[1], r[2]), (r[3], r[4], r[5]), (r[6], r[7], r[8])))
    injected = (row[AFTER + 6], row[AFTER + 7], row[AFTER + 8], row[AFTER + 9])
    before = (row[BEFORE + 6], -row[BEFORE + 7], -row[BEFORE + 8], -row[BEFORE + 9])
    turn = to_rotation_vector(multiply(injected, before))
    turning = inverse_of(left_jacobian(turn))
    for block in (POSITION, VELOCITY, ATTITUDE):
        change = rotate(back, (p.change[block], p.change[block + 1], p.change[block + 2]))
        step = turn
        if block != ATTITUDE:
            a, b = AFTER + block, BEFORE + block
            step = rotate(turning, (row[a] - row[b], row[a + 1] - row[b + 1], row[a + 2] - row[b + 2]))
        for i in range(3):
            p.correction[block + i] = change[i] + step[i]
    for i in range(ACCEL_BIAS, size):
        # Biases and augmented states: a nominal attitude has four numbers.
        p.correction[i] = p.change[i] + row[AFTER + i + 1] - row[BEFORE + i + 1]
    for i in range(size):
        for j in range(size):
            p.added[i, j] = p.covariance[i, j]
    for block in (POSITION, VELOCITY, ATTITUDE):
        update_error_axes(p.added, block, back)
    for i in range(size):
        for j in range(size):
            p.added[i, j] -= p.predicted[i, j]
    for i in range(ERROR_SIZE, size):
        if node.renewed & (1 << (i - ERROR_SIZE)):
            p.correction[i] = 0.0
            for j in range(size):
                p.added[i, j], p.added[j, i] = 0.0, 0.0
                p.predicted[i, j], p.predicted[j, i] = 0.0, 0.0
