"""What the IMU samples say about themselves: repeated, bridged, stuck, clipped and jumping readings.

A sensor that measures is noisy: no six axes stay on a straight line, and no axis keeps a value to the last bit for
long, unless its resolution is so coarse that this is usual for it, which is learnt. What is out of the ordinary tells
that motion is not measured; the rate or force is then in error by an unknown constant, and the variance of velocity or
attitude along that axis grows with the square of the time, over exactly that time (`sample_doubt`):

- All axes on a line for longer than ``imu.gap``: a hole that a driver has filled. It costs what a hole costs.
- One axis that keeps a value or comes back to the end of its range: stuck or clipped (`held_axes`).
- A jump from one sample to the next, away from the mean of late, that is far beyond all changes before: a shock that
  the sensor may not follow, or the body.

While the robot seems to stand nothing is widened but what shows that it does not: there a reading may well stay the
same.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.held_axes import (
    FEWEST_EQUAL,
    FIRST_SAMPLES,
    is_end_of_range,
    is_standing,
    is_usual,
    watch_axis,
)
from eskf_ros.filter.inertial.sample_doubt import clear_doubt, widen
from eskf_ros.filter.state.time import NEVER

SAMPLE_QUALITY = np.dtype(
    [
        ("count", "i8"),
        ("change", "f8", (6,)),
        ("bend", "f8", (6,)),
        ("lowest", "f8", (6,)),
        ("highest", "f8", (6,)),
        ("at_extreme", "i8", (6, 2)),
        ("least_jump", "f8", (6,)),
        ("equal_share", "f8", (6,)),
        ("any_equal", "i8"),
        ("equal_count", "i8", (6,)),
        ("equal_time", "f8", (6,)),
        ("equal_paid", "f8", (6,)),
        ("line_share", "f8"),
        ("line_count", "i8"),
        ("line_equal", "i8"),
        ("line_time", "f8"),
        ("line_paid", "f8"),
        ("shock_axis", "i8"),
        ("shock_size", "f8"),
        ("shock_time", "f8"),
        ("shock_level", "f8", (6,)),
        ("is_doubted", "i8"),
        ("doubt", "f8", (6,)),
        ("error", "f8", (6,)),
        ("excess", "f8", (2, 6)),
        ("hidden", "f8", (6,)),
        ("hidden_stamp", "i8", (6,)),
        ("repeated", "i8"),
        ("bridged", "i8"),
        ("hole_time", "f8"),
        ("clipped_time", "f8", (6,)),
        ("stuck_time", "f8", (6,)),
        ("held_value", "f8", (6,)),
        ("held_stamp", "i8", (6,)),
    ],
    align=True,
)
"""Readings of the six axes (specific force, angular rate; m/s2, rad/s), how they change, and what is wrong with them.

- ``count``: samples judged. ``change``, ``bend``: running mean squares of the first and second differences.
- ``least_jump``: square of the smallest change that is a jump, whatever is usual; a constant.
- ``lowest``, ``highest``: the smallest and largest readings; ``at_extreme``: how often they were read.
- ``equal_share``: share of the samples that repeat the one before, by axis; ``equal_count``, ``equal_time``: how often
  and for how long (s) the last reading was repeated; ``equal_paid``: up to which time that is in the covariance (s);
  ``any_equal``: whether an axis repeats its reading now.
- ``line_*``: the same of samples that continue a straight line in all axes; ``line_equal``: those that only repeat.
- ``shock_axis``, ``shock_size``, ``shock_time``: which axis jumped by how much (0: no shock), and since when (s);
  ``shock_level``: all readings before.
- ``doubt``: variance per second of velocity (m2/s3) and attitude (rad2/s) along the axes over the interval that the
  newest sample ends; ``is_doubted``: whether one is above zero. ``error``: standard deviations of the readings (m/s2,
  rad/s); ``excess``: what is taken off them at the begin and the end of the interval.
- ``hidden``, ``hidden_stamp``: what clipped readings have hidden of velocity (m/s) and attitude (rad) of late, and when
  the last of them was (ns).
- ``repeated``, ``bridged``: holes filled in either way; ``hole_time``: their length together (s). ``clipped_time``,
  ``stuck_time``: for how long an axis was so, together (s); ``held_value``, ``held_stamp``: the value that it kept
  then, and the last time (ns).
"""

MEMORY = 4096
"""Samples that the shares of equal readings remember."""

LEARNING = 1.0 / 256.0
"""Weight of a new sample in the mean squares of the differences."""

OUTLIER = 64.0
"""Ratio of the square of a change to its mean up to which it is learnt, and above which it is a jump."""

ON_LINE = 1e-6
"""Ratio of the square of a second difference to its mean below which three samples are on a straight line."""

NOISY = 0.1
"""Ratio of the mean squares of second and first differences above which an axis is noisy: white noise has 3. A
simulation without noise has straight lines that say nothing."""

FEWEST_NOISY = 2
"""Axes, at least, that must be noisy for lines to mean anything."""

USUAL_LINES = 0.1
"""Share of samples on a line in all axes from which on nothing is concluded from that: so coarse a sensor stays there
the longer the slower it moves.
"""

LEAST_SHARE = 1e-3
"""Smallest share of equal readings that is assumed: fewer than that cannot be told from none."""

LEAST_FORCE_JUMP = 10.0
"""m/s2; a smaller change from one sample to the next is no shock."""

LEAST_RATE_JUMP = 1.0
"""rad/s; the same of rates."""

SHOCK_ENDS = 0.5
"""Share of the jump: a reading closer to that before the jump ends the shock."""

HALF = 0.5
"""Share of a hard blow that is taken for motion: whether the body moved as is read or not at all is one sigma away."""

HARD_FORCE, HARD_RATE = 40.0, 3.5
"""m/s2, rad/s; a blow that is harder is hardly the motion of the body. An aeroplane that touches down turns as fast."""

LONGEST_SHOCK = 0.5
"""s; after that the reading is believed again."""


@njit
def judge_sample(state, sample, instant, settings):
    """Compare the next IMU sample, of the time ``instant`` (ns), with those before; set the doubt about the interval.

    Of all arrays of six, index 0 to 2 is an axis of the accelerometer, 3 to 5 one of the gyro.
    """
    quality = state.quality
    if state.imu.stamp == NEVER:
        return
    interval = (instant - state.imu.stamp) * 1e-9
    ratio = interval / state.imu.interval
    quality.count += 1
    # How usual repetitions are is not learnt from those that are out of the ordinary.
    weight = 0.0 if quality.is_doubted == 1 else 1.0 / min(quality.count, MEMORY)
    equal, on_line, noisy, jumps, ends = 0, 0, 0, 0, 0
    is_new = not is_repeated(state, sample)
    for i in range(6):
        change, bend = differences(state, sample, i, ratio)
        is_equal = change == 0.0
        equal += is_equal
        on_line += bend <= ON_LINE * quality.bend[i]
        noisy += quality.bend[i] > NOISY * quality.change[i]
        jump = jump_of(state, sample, i)
        jumps += jump * jump > max(quality.least_jump[i], OUTLIER * quality.change[i])
        if is_new:
            learn_range(quality, i, read(sample, i))
        learn(quality, i, change, bend, is_equal, weight)
        ends += is_end_of_range(quality, i, read(sample, i))
    if equal > 0 or quality.any_equal == 1:
        count_equal(state, quality, sample, interval)
    clear_doubt(quality)
    is_line = on_line == 6
    if quality.shock_size > 0.0 or (jumps > 0 and quality.count > FIRST_SAMPLES):
        watch_shock(state, quality, sample, interval)
    if is_line and noisy >= FEWEST_NOISY:
        quality.line_count += 1
        quality.line_time += interval
        quality.line_equal += equal == 6
        watch_line(state, quality, interval, settings)
    elif quality.line_count > 0:
        quality.line_count = quality.line_equal = 0
        quality.line_time = quality.line_paid = 0.0
    quality.line_share = max(quality.line_share + weight * (is_line - quality.line_share), LEAST_SHARE)
    if (equal > 0 or ends > 0) and not is_line:
        for i in range(6):
            reading = read(sample, i)
            if quality.equal_count[i] >= FEWEST_EQUAL or is_end_of_range(quality, i, reading):
                watch_axis(state, quality, i, reading, instant, interval, settings)


@njit
def read(sample, i):
    """Return the reading of an axis in a sample."""
    return sample.specific_force[i] if i < 3 else sample.angular_rate[i - 3]


@njit
def is_repeated(state, sample):
    """Say whether a sample is the last one again, in all axes."""
    for i in range(6):
        if read(sample, i) != last_reading(state, i):
            return False
    return True


@njit
def last_reading(state, i):
    """Return the last reading of an axis."""
    return state.imu.force[i] if i < 3 else state.imu.rate[i - 3]


@njit
def jump_of(state, sample, i):
    """Return by how much an axis has left both its last reading and its mean of late.

    A vibration swings from one side of the mean to the other: that is twice as far as it leaves the mean.
    """
    mean = state.imu.smooth_force[i] if i < 3 else state.imu.smooth_rate[i - 3]
    new = read(sample, i)
    return min(abs(new - last_reading(state, i)), abs(new - mean))


@njit
def differences(state, sample, i, ratio):
    """Return the change of an axis since the last reading, and the square of its departure from a straight line.

    ``ratio`` of the new interval to the last.
    """
    if i < 3:
        last, earlier = state.imu.force[i], state.imu.earlier_force[i]
    else:
        last, earlier = state.imu.rate[i - 3], state.imu.earlier_rate[i - 3]
    change = read(sample, i) - last
    bend = change - ratio * (last - earlier)
    return change, bend * bend


@njit
def count_equal(state, quality, sample, interval):
    """Count for each axis how often and how long it has repeated its last reading."""
    quality.any_equal = 0
    for i in range(6):
        if read(sample, i) == last_reading(state, i):
            quality.any_equal = 1
            quality.equal_count[i] += 1
            quality.equal_time[i] += interval
        else:
            quality.equal_count[i] = 0
            quality.equal_time[i] = quality.equal_paid[i] = 0.0


@njit
def learn_range(quality, i, new):
    """Learn the range of an axis, and how often it reads the ends. A sample that is sent again says nothing of them."""
    if new <= quality.lowest[i]:
        quality.at_extreme[i, 0] = quality.at_extreme[i, 0] + 1 if new == quality.lowest[i] else 1
        quality.lowest[i] = new
    if new >= quality.highest[i]:
        quality.at_extreme[i, 1] = quality.at_extreme[i, 1] + 1 if new == quality.highest[i] else 1
        quality.highest[i] = new


@njit
def learn(quality, i, change, bend, is_equal, weight):
    """Learn how an axis changes, and how usual it is that it repeats a reading.

    ``bend`` is the square of the second difference, ``weight`` that of a new sample in the shares. Nothing is learnt of
    noise where the readings are on a line.
    """
    share = quality.equal_share[i]
    quality.equal_share[i] = max(share + weight * (is_equal - share), LEAST_SHARE)
    is_first = quality.count <= FIRST_SAMPLES
    # Of the first samples all is learnt.
    more = math.inf if is_first else 0.0
    learning = 1.0 / quality.count if is_first else LEARNING
    learning = learning if bend > ON_LINE * quality.bend[i] else 0.0
    square, usual, usual_bend = change * change, quality.change[i], quality.bend[i]
    quality.change[i] = usual + learning * (min(square, OUTLIER * usual + more) - usual)
    quality.bend[i] = usual_bend + learning * (min(bend, OUTLIER * usual_bend + more) - usual_bend)


@njit
def watch_shock(state, quality, sample, interval):
    """Widen all axes by how far they are from what they were before one of them jumped; end when that has come back."""
    if quality.shock_size == 0.0:
        quality.shock_time = 0.0
        largest = 0.0
        for i in range(6):
            quality.shock_level[i] = last_reading(state, i)
            share = jump_of(state, sample, i) ** 2 / quality.least_jump[i]
            if share > largest:
                largest = share
                quality.shock_axis = i
                quality.shock_size = abs(read(sample, i) - quality.shock_level[i])
    begin = quality.shock_time
    quality.shock_time = begin + interval
    for i in range(6):
        level = quality.shock_level[i]
        before, after = last_reading(state, i) - level, read(sample, i) - level
        std = max(abs(before), abs(after))
        if std > (HARD_FORCE if i < 3 else HARD_RATE):
            quality.excess[0, i] = HALF * before
            quality.excess[1, i] = HALF * after
            std *= HALF
        widen(quality, i, std, begin, quality.shock_time, interval)
    departure = abs(read(sample, quality.shock_axis) - quality.shock_level[quality.shock_axis])
    if departure < SHOCK_ENDS * quality.shock_size or quality.shock_time > LONGEST_SHOCK:
        quality.shock_size = 0.0


@njit
def watch_line(state, quality, interval, settings):
    """Widen all axes while they stay on a line for so long that samples are missing."""
    # A shorter hole would cost nothing, either.
    if quality.line_time <= settings.imu_gap or is_usual(quality, quality.line_share, USUAL_LINES, quality.line_count):
        return
    if is_standing(state):
        return
    if quality.line_paid == 0.0:
        # What was learnt of this line before it was known to be a hole is taken back.
        quality.line_share = max(LEAST_SHARE, quality.line_share - quality.line_count / MEMORY)
        if quality.line_equal == quality.line_count:
            quality.repeated += 1
        else:
            quality.bridged += 1
    quality.hole_time += quality.line_time - quality.line_paid
    for i in range(6):
        std = settings.gap_accel_std if i < 3 else settings.gap_gyro_std
        widen(quality, i, std, quality.line_paid, quality.line_time, interval)
    quality.line_paid = quality.line_time


@njit
def is_hidden(state, settings):
    """Say whether motion may be hidden in the interval that the newest sample has ended: by a hole, filled or not."""
    return state.imu.interval > settings.imu_gap or state.quality.line_paid > 0.0
