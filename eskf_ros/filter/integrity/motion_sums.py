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
        ("shifted", "f8", (2 * LAGS, 4, 4)),
        ("recent", "f8", (LAGS, 3)),
        ("recent_count", "i8"),
        ("last_stamp", "i8"),
        ("lag", "f8"),
    ],
    align=True,
)
"""Sums over windows of the change of course and the integrated rates (rad, axes of base_link), weighted (1/rad2).

``shifted``: at `LAGS` + k, of the windows whose course is compared with the rates about z of k and of k + 1 windows
earlier and of the same window: the weighed products of these three differences and of 1 with each other.
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

MANY_TURNS = 30
"""Such windows of positions alone, whose courses scatter, from which on they say whether clocks are apart."""

TURNED = 0.4
"""rad2; sum of the squares of the changes of course from which on they are."""

SAME = 0.7
"""Correlation of changes of course with a gyro from which on it shows them."""

HELD = 0.7
"""Share of the limits of a lag beyond which it stays once it is known."""

LAG_SIGMAS = 3.0
"""Standard deviations of a lag from which on it is certain."""

COMMON_ERROR = 0.025
"""rad; by which course and gyro differ in many windows together, where the bias of the gyro changes or fixes wander."""

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
    for k in range(2 * LAGS):
        for i in range(4):
            for j in range(4):
                turns.shifted[k, i, j] *= remains
    for k in range(min(turns.recent_count, LAGS)):
        near = turn[2] if k == 0 else turns.recent[k - 1, 0]
        add_shifted(turns.shifted[LAGS + k], weight, course, (near, turns.recent[k, 0], turn[2]))
        earlier = turns.recent[k]
        add_shifted(turns.shifted[LAGS - 1 - k], earlier[2], earlier[1], (turn[2], turns.recent[0, 0], earlier[0]))
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
def has_turned(turns, fewest):
    """Say whether there were turns, in at least ``fewest`` windows, for course and gyro to be compared."""
    return turns.count >= fewest and turns.course_square * turns.count > TURNED * turns.weight


@njit
def add_shifted(sums, weight, course, turns_about_z):
    """Add the differences of a course (rad) from three integrated rates to ``sums`` (4, 4): see `TURNS`."""
    differences = (course - turns_about_z[0], course - turns_about_z[1], course - turns_about_z[2], 1.0)
    for i in range(4):
        for j in range(4):
            sums[i, j] += weight * differences[i] * differences[j]


@njit
def lag_of(turns, length):
    """Return by how much (s) the course is stamped later than the gyro: the lag that leaves least unexplained.

    Between lags of whole windows (of a ``length`` in s) the rate is taken to be even within each window: the rate of
    the shifted one is a weighed mean of two. The bias of the gyro is the mean of the differences.
    """
    if turns.count < FEWEST_TURNS:
        return 0.0
    square = turns.course_square - turns.course**2 / turns.weight
    lag, most, least = 0.0, 0.0, 0.0
    for k in range(2 * LAGS):
        none, left, share = left_between(turns.shifted[k])
        if turns.weight * (none - left) > most:
            lag, most, least = (k - LAGS + share) * length, turns.weight * (none - left), turns.weight * left
    # What has been told is held unless the turns speak against it.
    held = HELD if turns.lag * lag > 0.0 else 1.0
    chance = max(1.0, least / turns.count) + COMMON_ERROR**2 * turns.weight / turns.count
    is_shown = held * least < (1.0 - SAME**2) * square and most > held * LAG_SIGMAS**2 * chance
    return lag if abs(lag) > held * NOTABLE_LAG and is_shown else 0.0


@njit
def left_between(sums):
    """Return the mean square (rad2) left without a lag, that with the best lag between two, and its place (0 to 1)."""
    weight = max(sums[3, 3], 1e-12)
    a = sums[0, 0] - sums[3, 0] ** 2 / weight
    b = sums[1, 1] - sums[3, 1] ** 2 / weight
    both = sums[0, 1] - sums[3, 0] * sums[3, 1] / weight
    none = sums[2, 2] - sums[3, 2] ** 2 / weight
    spread = a + b - 2.0 * both
    share = min(max((a - both) / spread, 0.0), 1.0) if spread > 0.0 else 0.0
    return none / weight, (a - 2.0 * share * (a - both) + share * share * spread) / weight, share


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
