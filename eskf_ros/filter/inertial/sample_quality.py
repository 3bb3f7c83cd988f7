"""What the IMU samples say about themselves: repeated, bridged, stuck, clipped and jumping readings.

A sensor that measures is noisy: no six axes stay on a straight line, and no axis keeps a value to the last bit for
long, unless its resolution is so coarse that this is usual for it, which is learnt. What is out of the ordinary tells
that motion is not measured; the rate or force is then in error by an unknown constant, and the variance of velocity or
attitude along that axis grows with the square of the time, over exactly that time:

- All axes on a line for longer than ``imu.gap``: a hole that a driver has filled. It costs what a hole costs.
- One axis that keeps a value: clipped if the value is the largest or smallest ever read, else stuck.
- A jump from one sample to the next, away from the mean of late, that is far beyond all changes before: a shock that
  the sensor may not follow.

While the robot seems to stand nothing is widened: there a reading may well stay the same.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
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
        ("repeated", "i8"),
        ("bridged", "i8"),
        ("hole_time", "f8"),
        ("clipped_time", "f8", (6,)),
        ("clipped_value", "f8", (6,)),
        ("stuck_time", "f8", (6,)),
        ("stuck_value", "f8", (6,)),
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
  newest sample ends; ``is_doubted``: whether one is above zero.
- ``repeated``, ``bridged``: holes filled in either way; ``hole_time``: their length together (s). ``clipped_*``,
  ``stuck_*``: for how long an axis was so, together (s), and its value then.
"""

MEMORY = 4096
"""Samples that the shares of equal readings remember."""

LEARNING = 1.0 / 256.0
"""Weight of a new sample in the mean squares of the differences."""

OUTLIER = 64.0
"""Ratio of the square of a change to its mean up to which it is learnt, and above which it is a jump."""

FIRST_SAMPLES = 256
"""Samples that are learnt from before one is judged."""

ON_LINE = 1e-6
"""Ratio of the square of a second difference to its mean below which three samples are on a straight line."""

NOISY = 0.1
"""Ratio of the mean squares of second and first differences above which an axis is noisy: white noise has 3. A
simulation without noise has straight lines that say nothing."""

FEWEST_NOISY = 2
"""Axes, at least, that must be noisy for lines to mean anything."""

USUAL_EQUAL = 0.5
"""Share of readings that an axis repeats from which on nothing is concluded from that."""

USUAL_LINES = 0.1
"""Share of samples on a line in all axes from which on nothing is concluded from that: so coarse a sensor stays there
the longer the slower it moves.
"""

LEAST_SHARE = 1e-3
"""Smallest share of equal readings that is assumed: fewer than that cannot be told from none."""

CHANCE = -20.0
"""Logarithm of the probability below which a run of equal readings is no chance: one in 5e8 samples."""

FEWEST_EQUAL = 3
"""Repetitions of a reading from which on an axis is looked at."""

STUCK_AFTER = 0.5
"""s; an axis within its range is stuck when it keeps a value for longer."""

LASTS = 2.0
"""s; for so long the motion that an axis does not measure stays the same, about."""

STANDING = 0.3
"""m/s; at a smaller estimated speed the robot may stand, and a reading may stay the same."""

SEEN_LATELY = 3_000_000_000
"""ns; for so long a robot that another sensor has seen moving is thought to move."""

LEAST_FORCE_JUMP = 10.0
"""m/s2; a smaller change from one sample to the next is no shock."""

LEAST_RATE_JUMP = 1.0
"""rad/s; the same of rates."""

SHOCK_ENDS = 0.5
"""Share of the jump: a reading closer to that before the jump ends the shock."""

LONGEST_SHOCK = 0.5
"""s; after that the reading is believed again."""


@njit
def copy_doubt(state, lane):
    """Let another lane know which axes of the interval are doubted, and how much readings change."""
    lane.quality.is_doubted = state.quality.is_doubted
    for i in range(6):
        lane.quality.doubt[i] = state.quality.doubt[i]
        lane.quality.change[i] = state.quality.change[i]


@njit
def shaken_density(quality, first, interval):
    """Return the density of white noise by which the readings of a sensor would change as much as they do.

    Vibration is no noise of the sensor, but says as little of the motion. ``first``: 0 for the accelerometers
    (m/s2/rtHz), 3 for the gyros (rad/s/rtHz); ``interval`` of the samples in s.
    """
    largest = max(quality.change[first], max(quality.change[first + 1], quality.change[first + 2]))
    return math.sqrt(0.5 * largest * interval)


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
    equal, on_line, noisy, jumps = 0, 0, 0, 0
    for i in range(6):
        change, bend = differences(state, sample, i, ratio)
        is_equal = change == 0.0
        equal += is_equal
        on_line += bend <= ON_LINE * quality.bend[i]
        noisy += quality.bend[i] > NOISY * quality.change[i]
        jump = jump_of(state, sample, i)
        jumps += jump * jump > max(quality.least_jump[i], OUTLIER * quality.change[i])
        learn(quality, i, read(sample, i), change, bend, is_equal, weight)
    if equal > 0 or quality.any_equal == 1:
        count_equal(state, quality, sample, interval)
    if quality.is_doubted == 1:
        for i in range(6):
            quality.doubt[i] = 0.0
        quality.is_doubted = 0
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
    if equal > 0 and not is_line:
        for i in range(6):
            if quality.equal_count[i] >= FEWEST_EQUAL:
                watch_axis(state, quality, i, interval, settings)


@njit
def read(sample, i):
    """Return the reading of an axis in a sample."""
    return sample.specific_force[i] if i < 3 else sample.angular_rate[i - 3]


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
def learn(quality, i, new, change, bend, is_equal, weight):
    """Learn how an axis changes, what its range is, and how usual it is that it repeats a reading.

    ``bend`` is the square of the second difference, ``weight`` that of a new sample in the shares. Nothing is learnt of
    noise where the readings are on a line.
    """
    if new <= quality.lowest[i]:
        quality.at_extreme[i, 0] = quality.at_extreme[i, 0] + 1 if new == quality.lowest[i] else 1
        quality.lowest[i] = new
    if new >= quality.highest[i]:
        quality.at_extreme[i, 1] = quality.at_extreme[i, 1] + 1 if new == quality.highest[i] else 1
        quality.highest[i] = new
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
        departure = max(abs(read(sample, i) - level), abs(last_reading(state, i) - level))
        widen(quality, i, departure, begin, quality.shock_time, interval)
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
def watch_axis(state, quality, i, interval, settings):
    """Widen one axis that keeps its value beyond all chance while others move."""
    value = last_reading(state, i)
    is_clipped = value <= quality.lowest[i] or value >= quality.highest[i]
    # What is stuck a second time at the same size is clipped, although more has been read before.
    again = quality.equal_paid[i] == 0.0 and quality.stuck_time[i] > 0.0
    if (again or quality.clipped_time[i] > 0.0) and abs(value) == abs(quality.stuck_value[i]):
        is_clipped = True
        quality.clipped_time[i] += quality.stuck_time[i]
        quality.stuck_time[i] = 0.0
    if not is_clipped and quality.equal_time[i] < STUCK_AFTER:
        return
    if is_usual(quality, quality.equal_share[i], USUAL_EQUAL, quality.equal_count[i]) or is_standing(state):
        return
    begin, end = quality.equal_paid[i], quality.equal_time[i]
    if is_clipped:
        # The truth may be anywhere beyond.
        bias = state.accel_bias[i] if i < 3 else state.gyro_bias[i - 3]
        std = abs(value - bias)
        quality.clipped_time[i] += end - begin
        quality.clipped_value[i] = value
    else:
        std = settings.gap_accel_std if i < 3 else settings.gap_gyro_std
        quality.stuck_time[i] += end - begin
        quality.stuck_value[i] = value
    widen(quality, i, std, begin, end, interval)
    quality.equal_paid[i] = end


@njit
def is_usual(quality, share, usual, count):
    """Say whether a run of ``count`` equal readings may be chance, or is the way of a sensor that repeats often."""
    if quality.count < FIRST_SAMPLES or share > usual:
        return True
    return count * math.log(share) > CHANCE


@njit
def is_standing(state):
    """Say whether the robot is estimated to stand, or has not been seen to move while its heading is unknown."""
    if state.heading_known == 0:
        return state.window.motion_stamp == NEVER or state.stamp - state.window.motion_stamp > SEEN_LATELY
    v = state.velocity_map
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2] < STANDING * STANDING


@njit
def widen(quality, i, std, begin, end, interval):
    """Let axis ``i`` be in error by a constant of ``std`` from ``begin`` to ``end`` (s), paid over ``interval`` s.

    What is in error for longer than `LASTS` is in error by something else by then.
    """
    growth = (end - begin) * min(end + begin, 2.0 * LASTS)
    quality.doubt[i] += std * std * growth / interval
    quality.is_doubted = 1


@njit
def is_hidden(state, settings):
    """Say whether motion may be hidden in the interval that the newest sample has ended: by a hole, filled or not."""
    return state.imu.interval > settings.imu_gap or state.quality.line_paid > 0.0
