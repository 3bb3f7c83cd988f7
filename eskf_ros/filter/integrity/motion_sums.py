"""Sums that compare the motion by a receiver with that by the IMU: see `motion_monitor`."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.geodesy.rotation import wrapped

LAGS = 6
"""Windows by which the receiver may be stamped later or earlier than the IMU for it to be seen by turns."""

TURNS = np.dtype(
    [
        ("count", "f8"),
        ("weight", "f8"),
        ("course", "f8"),
        ("course_square", "f8"),
        ("gyro", "f8", (3,)),
        ("gyro_square", "f8", (3,)),
        ("product", "f8", (3,)),
        ("shifted", "f8", (2 * LAGS + 1, 5)),
        ("recent", "f8", (LAGS, 3)),
        ("recent_count", "i8"),
        ("last_stamp", "i8"),
        ("lag", "f8"),
    ],
    align=True,
)
"""Sums over windows of the change of course and the integrated rates (rad, axes of base_link), weighted (1/rad2).

``shifted``: at `LAGS` + k, of the windows whose course is compared with the rate about z of k windows earlier: the sum
of the weights, of the weighed differences and of their squares, and the last two for the rate of the same window.
``recent``, ``recent_count``, ``last_stamp``: rate about z, course and weight of the windows before this one, the newest
first; how many of them follow each other without a hole; the end of the newest (ns). ``lag``: by how much the receiver
is stamped later than the IMU (s); 0 where it is less than notable, or not known.
"""

PUSHES = np.dtype(
    [
        ("count", "f8"),
        ("mean_acceleration", "f8", (2,)),
        ("mean_force", "f8", (2,)),
        ("acceleration_square", "f8", (2, 2)),
        ("force_square", "f8"),
        ("product", "f8", (2, 2)),
        ("last", "f8", (2, 2)),
        ("force_next", "f8"),
        ("acceleration_next", "f8", (2, 2)),
        ("product_next", "f8", (2, 2)),
    ],
    align=True,
)
"""Sums over windows of acceleration along the course and to its left, and specific force (m/s2, x and y of base_link).

Both without their running means: tilts and biases change slowly. ``product``: row force, column acceleration.
``last``: force and acceleration of the window before; ``*_next``: sums of the products of those of consecutive windows,
the product of force and acceleration both ways.
"""

MEMORY = 600.0
"""Windows that the sums remember, about."""

SLOW = 3.0
"""m/s; at less the course says little."""

MEAN_MEMORY = 20.0
"""Windows over which the running means are taken."""

COURSE_ERROR = 0.01
"""rad; by which the course differs from the heading beside all noise."""

LARGEST_TURN = 1.5
"""rad; within a window course and gyro only turn by more where the robot changes its direction of travel."""


FEWEST_TURNS = 15
"""Windows with a course from which on turns are compared."""

TURNED = 0.4
"""rad2; sum of the squares of the changes of course from which on they are."""

SAME = 0.7
"""Correlation of changes of course with a gyro from which on it shows them."""

HELD = 0.7
"""Share of the limits of a lag beyond which it stays once it is known."""

LAG_SIGMAS = 5.0
"""Standard deviations of a lag from which on it is certain."""

NOTABLE_LAG = 0.6
"""s; a time between course and gyro from which on it is told: less is found by the installation monitor."""


@njit
def add_turn(turns, before, after, turn, variance, start, passed):
    """Add the change of course from one velocity to the next, of a ``variance`` (rad2), and the integrated rates.

    ``start``, ``passed``: when the window began (ns), and its length (s).
    """
    course = wrapped(math.atan2(after[1], after[0]) - math.atan2(before[1], before[0]))
    if max(abs(course), max(abs(turn[0]), max(abs(turn[1]), abs(turn[2])))) > LARGEST_TURN:
        return
    weight, remains = 1.0 / (variance + COURSE_ERROR**2), 1.0 - 1.0 / MEMORY
    turns.count = remains * turns.count + 1.0
    turns.weight = remains * turns.weight + weight
    turns.course = remains * turns.course + weight * course
    turns.course_square = remains * turns.course_square + weight * course * course
    if start != turns.last_stamp:
        turns.recent_count = 0
    for k in range(2 * LAGS + 1):
        for i in range(5):
            turns.shifted[k, i] *= remains
    add_shifted(turns.shifted[LAGS], weight, course, turn[2], turn[2])
    for k in range(min(turns.recent_count, LAGS)):
        earlier = turns.recent[k]
        add_shifted(turns.shifted[LAGS + 1 + k], weight, course, earlier[0], turn[2])
        add_shifted(turns.shifted[LAGS - 1 - k], earlier[2], earlier[1], turn[2], earlier[0])
    for k in range(LAGS - 1, 0, -1):
        for i in range(3):
            turns.recent[k, i] = turns.recent[k - 1, i]
    turns.recent[0, 0], turns.recent[0, 1], turns.recent[0, 2] = turn[2], course, weight
    turns.recent_count += 1
    turns.last_stamp = start + round(passed * 1e9)
    for i in range(3):
        turns.gyro[i] = remains * turns.gyro[i] + weight * turn[i]
        turns.gyro_square[i] = remains * turns.gyro_square[i] + weight * turn[i] * turn[i]
        turns.product[i] = remains * turns.product[i] + weight * turn[i] * course
    turns.lag = lag_of(turns, passed)


@njit
def add_shifted(sums, weight, course, shifted, same):
    """Add what the course is from the rate of a shifted window, and of the same one (rad)."""
    sums[0] += weight
    sums[1] += weight * (course - shifted)
    sums[2] += weight * (course - shifted) ** 2
    sums[3] += weight * (course - same)
    sums[4] += weight * (course - same) ** 2


@njit
def left_with_lag(sums):
    """Return the sum of squares that a lag leaves unexplained; the bias of the gyro is the mean of the differences."""
    return sums[2] - sums[1] ** 2 / max(sums[0], 1e-12)


@njit
def gain_by_lag(sums):
    """Return by how much less a lag leaves unexplained than none does, of the same windows."""
    return sums[4] - sums[3] ** 2 / max(sums[0], 1e-12) - left_with_lag(sums)


@njit
def lag_of(turns, length):
    """Return by how much (s) the course is stamped later than the gyro: the lag that leaves least unexplained.

    Between the lags of whole windows (of a ``length`` in s) it is the top of a parabola.
    """
    square = turns.course_square - turns.course**2 / turns.weight
    if turns.count < FEWEST_TURNS:
        return 0.0
    best = 1
    for k in range(2, 2 * LAGS):
        if gain_by_lag(turns.shifted[k]) > gain_by_lag(turns.shifted[best]):
            best = k
    earlier, same, later = (
        gain_by_lag(turns.shifted[best - 1]),
        gain_by_lag(turns.shifted[best]),
        gain_by_lag(turns.shifted[best + 1]),
    )
    bend = earlier - 2.0 * same + later
    if bend >= 0.0:
        return 0.0
    shift = min(max(0.5 * (earlier - later) / bend, -0.5), 0.5)
    peak = same - 0.25 * (earlier - later) * shift
    sums = turns.shifted[best]
    # What one window leaves, with noise as it was expected 1, and the share of its course that it leaves.
    left = (sums[4] - sums[3] ** 2 / max(sums[0], 1e-12) - peak) / max(sums[0], 1e-12)
    chance = max(1.0, left * turns.weight / turns.count)
    # What has been told is held unless the turns speak against it.
    lag = (best - LAGS + shift) * length
    held = HELD if turns.lag * lag > 0.0 else 1.0
    is_shown = held * left * turns.weight < (1.0 - SAME**2) * square and peak > held * LAG_SIGMAS**2 * chance
    return lag if abs(lag) > held * NOTABLE_LAG and is_shown else 0.0


@njit
def add_push(pushes, before, after, push, time):
    """Add the mean acceleration over ``time`` (s) from one velocity to the next, and the integrated specific force."""
    east, north = before[0] + after[0], before[1] + after[1]
    length = math.hypot(east, north)
    if length < SLOW:
        return
    east, north = east / length, north / length
    change = ((after[0] - before[0]) / time, (after[1] - before[1]) / time)
    acceleration = (change[0] * east + change[1] * north, change[1] * east - change[0] * north)
    share = 1.0 / min(pushes.count + 1.0, MEAN_MEMORY)
    remains = 1.0 - 1.0 / MEMORY
    pushes.count = remains * pushes.count + 1.0
    pushes.force_square *= remains
    for i in range(2):
        pushes.mean_acceleration[i] += share * (acceleration[i] - pushes.mean_acceleration[i])
        pushes.mean_force[i] += share * (push[i] / time - pushes.mean_force[i])
    now = (
        (push[0] / time - pushes.mean_force[0], push[1] / time - pushes.mean_force[1]),
        (acceleration[0] - pushes.mean_acceleration[0], acceleration[1] - pushes.mean_acceleration[1]),
    )
    pushes.force_next *= remains
    for i in range(2):
        force, last = now[0][i], pushes.last[0, i]
        pushes.force_square += force * force
        pushes.force_next += force * last
        for j in range(2):
            pushes.product[i, j] = remains * pushes.product[i, j] + force * now[1][j]
            pushes.acceleration_square[i, j] = remains * pushes.acceleration_square[i, j] + now[1][i] * now[1][j]
            pushes.product_next[i, j] = (
                remains * pushes.product_next[i, j] + force * pushes.last[1, j] + last * now[1][j]
            )
            pushes.acceleration_next[i, j] = remains * pushes.acceleration_next[i, j] + now[1][i] * pushes.last[1, j]
    for i in range(2):
        for j in range(2):
            pushes.last[i, j] = now[i][j]
