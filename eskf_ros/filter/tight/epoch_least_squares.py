"""Least squares over the signals of one epoch with robust weights (Huber, Robust Statistics, section 7.8).

The point solution of the inputs (`gnss.point_solution`) solves the same problem for a receiver without a filter, in
ECEF and with its own atmosphere. Here the linearization is that of the filter, in map axes, and nothing is allocated.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.kalman_update import invert_positive, project
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import POSITION, VELOCITY
from eskf_ros.filter.tight import pseudorange, range_rate
from eskf_ros.filter.tight.pseudorange import offset_place
from eskf_ros.filter.tight.signal import system_of

LARGEST_EPOCH = 256
"""Signals of one epoch that are solved together, at most; the others are fused one by one."""

HUBER = 2.5
"""Standard deviations from which on the weight of a signal decreases (Huber's constant)."""

FEWEST_TO_SOLVE = 4
"""Satellites, at least, that determine a position and the clock."""

FEWEST_TO_EXCLUDE = 6
"""Satellites, at least, that show which one of them is wrong."""

OUTLIER = 4.0
"""Residual beyond which a signal is an outlier, in units of the spread that most signals show."""

MEDIAN_OF_SQUARES = 0.455
"""Median of the square of a standard normal variable."""

REWEIGHTINGS = 20
"""Iterations of the weighted least squares, at most; the weights follow from the residuals of the iteration before."""


@njit
def median(values, count, work):
    """Return the median of the first ``count`` values, 0 for none."""
    if count == 0:
        return 0.0
    for k in range(count):
        place = k
        while place > 0 and work.sorted[place - 1] > values[k]:
            work.sorted[place] = work.sorted[place - 1]
            place -= 1
        work.sorted[place] = values[k]
    return 0.5 * (work.sorted[(count - 1) // 2] + work.sorted[count // 2])


@njit
def outside(work, shift, gate):
    """Return how many of the gathered signals are outside the gate once the common ``shift`` is subtracted."""
    count = 0
    for k in range(work.signal_count):
        if (work.signal_innovation[k] - shift) ** 2 > gate * work.signal_spread[k]:
            count += 1
    return count


@njit
def reject_outliers(aids, work):
    """Reject the signals whose residuals are large compared with those of most signals."""
    count = work.signal_count
    if count < FEWEST_TO_EXCLUDE:
        return
    scale = variance_factor(work)
    for k in range(count):
        square = work.signal_residual[k] ** 2
        if square > OUTLIER**2 * scale:
            aid = aids[work.signal_index[k]]
            aid.verdict = Verdict.GATE
            aid.dof = 1
            aid.nis = square
            aid.innovation[0] = work.signal_innovation[k]


@njit
def solve_epoch(work):
    """Solve the gathered signals for a step of position or velocity and of the clock; say whether they suffice.

    Least squares with Huber's weights, iterated; the sum that it minimises is convex, so the result does not depend on
    the initial weights. The step (m or m/s) goes to ``work.step``, its covariance to ``work.normal`` (inflated by
    `variance_factor`), the residuals in units of the noise to ``work.signal_residual``.
    """
    count, normal, step = work.signal_count, work.normal, work.step
    if count < FEWEST_TO_SOLVE:
        return False
    common = median(work.signal_innovation, count, work)
    for k in range(count):
        off = abs(work.signal_innovation[k] - common) / math.sqrt(work.signal_noise[k])
        work.signal_weight[k] = min(1.0, HUBER / max(off, 1e-12))
    for _ in range(REWEIGHTINGS):
        for i in range(4):
            step[i] = 0.0
            work.right[i] = 0.0
            for j in range(4):
                normal[i, j] = 0.0
        for k in range(count):
            weight = work.signal_weight[k] / work.signal_noise[k]
            for i in range(4):
                a = work.signal_direction[k, i] if i < 3 else 1.0
                work.right[i] += weight * a * work.signal_innovation[k]
                for j in range(4):
                    normal[i, j] += weight * a * (work.signal_direction[k, j] if j < 3 else 1.0)
        if invert_positive(normal, 4) == 0.0:
            return False
        for i in range(4):
            for j in range(4):
                step[i] += normal[i, j] * work.right[j]
        change = 0.0
        for k in range(count):
            d = work.signal_direction[k]
            left = work.signal_innovation[k] - d[0] * step[0] - d[1] * step[1] - d[2] * step[2] - step[3]
            residual = left / math.sqrt(work.signal_noise[k])
            weight = min(1.0, HUBER / max(abs(residual), 1e-12))
            change = max(change, abs(weight - work.signal_weight[k]))
            work.signal_weight[k] = weight
            work.signal_residual[k] = residual
        if change < 1e-3:
            break
    factor = variance_factor(work)
    for i in range(4):
        for j in range(4):
            normal[i, j] *= factor
    return True


@njit
def variance_factor(work):
    """Return the factor (at least 1) by which the squared residuals exceed the noise.

    It follows from the median of the squares, on which outliers have little influence. With too few signals to tell an
    outlier it follows from their mean.
    """
    count, total = work.signal_count, 0.0
    if count == FEWEST_TO_SOLVE:
        return 1.0
    for k in range(count):
        work.signal_square[k] = work.signal_residual[k] ** 2
        total += work.signal_square[k]
    usual = total / count
    if count >= FEWEST_TO_EXCLUDE:
        usual = median(work.signal_square, count, work) / MEDIAN_OF_SQUARES
    return max(1.0, usual * count / (count - FEWEST_TO_SOLVE))


@njit
def spread_of(work):
    """Return the standard deviation of the solved position (m) or velocity (m/s) over all axes together."""
    return math.sqrt(work.normal[0, 0] + work.normal[1, 1] + work.normal[2, 2])


@njit
def linearize(state, aid, settings, work):
    """Write innovation, Jacobian and noise of one signal to ``work``; return 1, or 0 below the elevation mask."""
    if aid.stream == Stream.PSEUDORANGE:
        return pseudorange.linearize(state, aid.payload, aid.source, settings, work)
    return range_rate.linearize(state, aid.payload, settings, work)


@njit
def gather(state, aids, first, end, settings, work):
    """Write innovation, its variance, noise and direction of the signals that still wait to ``work.signal_*``.

    The noise includes the uncertainty of the offset of the constellation, so that signals of all constellations can be
    compared.
    """
    count = 0
    for i in range(first, end):
        if aids[i].verdict != Verdict.WAITING or count == LARGEST_EPOCH:
            continue
        if linearize(state, aids[i], settings, work) == 0:
            aids[i].verdict = Verdict.LOW_ELEVATION
            continue
        project(state, 1, work)
        work.signal_index[count] = i
        work.signal_innovation[count] = work.innovation[0]
        work.signal_spread[count] = work.innovation_covariance[0, 0]
        noise = work.noise[0, 0]
        block = VELOCITY
        if aids[i].stream == Stream.PSEUDORANGE:
            block = POSITION
            place = offset_place(system_of(aids[i].source), settings)
            if place < state.error_size:
                noise += state.covariance[place, place]
        work.signal_noise[count] = noise
        for k in range(3):
            work.signal_direction[count, k] = work.jacobian[0, block + k]
        count += 1
    work.signal_count = count
