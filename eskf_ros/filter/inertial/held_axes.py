"""Axes that keep a value while others move: clipped or stuck.

A sensor is clipped at the end of what it has ever read if that end comes back to the last bit more often than chance
allows, or at a size that it has kept before. The truth is beyond: after n such samples anywhere up to n usual changes,
or as far again as the reading. The middle is taken, with `WIDTH` times as much for a standard deviation.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.sample_doubt import hide, widen
from eskf_ros.filter.state.time import NEVER

USUAL_EQUAL = 0.5
"""Share of readings that an axis repeats from which on nothing is concluded from that."""

CHANCE = -20.0
"""Logarithm of the probability below which a run of equal readings is no chance: one in 5e8 samples."""

FIRST_SAMPLES = 256
"""Samples that are learnt from before one is judged."""

FEWEST_EQUAL = 3
"""Repetitions of a reading from which on an axis is looked at."""

TAIL = 16.0
"""The chance that noise comes to its extreme again but not beyond, over the share of equal readings. With a resolution
q the latter is q / 3.5 (standard deviations), the former 4.5 q where the extreme is 4.5 away."""

STUCK_AFTER = 0.5
"""s; an axis within its range is stuck when it keeps a value for longer."""

STANDING = 0.3
"""m/s; at a smaller estimated speed the robot may stand, and a reading may stay the same."""

TURNING = 0.05
"""rad/s; a gyro that keeps a larger rate does not say that the robot stands."""

WIDTH = 2.0
"""Standard deviation of what a clipped reading hides, over the middle of what it may be: there is no end to it."""

SEEN_LATELY = 3_000_000_000
"""ns; for so long a robot that another sensor has seen moving is thought to move."""


@njit
def is_end_of_range(quality, i, reading):
    """Say whether an axis reads the end of its range: an extreme that has come back too often to be noise."""
    if reading == quality.highest[i]:
        count = quality.at_extreme[i, 1]
    elif reading == quality.lowest[i]:
        count = quality.at_extreme[i, 0]
    else:
        return False
    chance = TAIL * quality.equal_share[i]
    return quality.count > FIRST_SAMPLES and chance < 1.0 and (count - 1) * math.log(chance) < CHANCE


@njit
def watch_axis(state, quality, i, reading, instant, interval, settings):
    """Widen one axis that reads the end of its range, or keeps its value beyond all chance while others move.

    ``instant`` (ns) of the ``reading``, which ends an interval of ``interval`` s.
    """
    is_clipped = is_end_of_range(quality, i, reading)
    if not is_clipped and is_usual(quality, quality.equal_share[i], USUAL_EQUAL, quality.equal_count[i]):
        return
    bias = state.accel_bias[i] if i < 3 else state.gyro_bias[i - 3]
    is_turning = i >= 3 and abs(reading - bias) > TURNING
    if not is_clipped and is_standing(state):
        return
    begin, end = quality.equal_paid[i], quality.equal_time[i]
    is_clipped = is_clipped or reading <= quality.lowest[i] or reading >= quality.highest[i]
    if not is_clipped and abs(reading) == abs(quality.held_value[i]):
        # What keeps a size a second time is clipped, although more has been read before.
        is_clipped = quality.clipped_time[i] > 0.0 or instant - round(end * 1e9) > quality.held_stamp[i]
    if is_clipped:
        watch_clipped(quality, i, reading, bias, instant, interval)
        return
    if end >= STUCK_AFTER or is_turning:
        quality.held_value[i] = reading
        quality.held_stamp[i] = instant
    if end < STUCK_AFTER:
        return
    quality.stuck_time[i] += end - begin
    widen(quality, i, settings.gap_accel_std if i < 3 else settings.gap_gyro_std, begin, end, interval)
    quality.equal_paid[i] = end


@njit
def watch_clipped(quality, i, reading, bias, instant, interval):
    """Pay for what an axis hides that reads the end of its range; take the middle of what it may be."""
    quality.held_value[i] = reading
    quality.held_stamp[i] = instant
    duration = interval
    if quality.equal_count[i] > 0:
        duration = quality.equal_time[i] - quality.equal_paid[i]
        quality.equal_paid[i] = quality.equal_time[i]
    quality.clipped_time[i] += duration + quality.stuck_time[i]
    quality.stuck_time[i] = 0.0
    gone = 0.5 * math.sqrt(quality.change[i]) * (quality.equal_count[i] + 1)
    hidden = min(gone, abs(reading - bias))
    hide(quality, i, WIDTH * hidden, duration, instant, interval)
    for k in range(2):
        quality.excess[k, i] -= math.copysign(hidden, reading - bias)


@njit
def is_usual(quality, share, usual, count):
    """Say whether a run of ``count`` equal readings may be chance, or is the way of a sensor that repeats often."""
    if quality.count < FIRST_SAMPLES or share > usual:
        return True
    return count * math.log(share) > CHANCE


@njit
def is_standing(state):
    """Say whether the robot is estimated to stand, or has not been seen to move while its heading is unknown.

    One that turns in place does not stand.
    """
    for i in range(3):
        if abs(state.imu.rate[i] - state.gyro_bias[i]) > TURNING:
            return False
    if state.heading_known == 0:
        return state.window.motion_stamp == NEVER or state.stamp - state.window.motion_stamp > SEEN_LATELY
    v = state.velocity_map
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2] < STANDING * STANDING
