"""Stamps of the IMU freed of jitter: a line through the last ones, as a sensor with a steady clock takes its samples.

USB, serial ports and host clocks stamp a sample when it arrives: late by a time that changes from sample to sample, or
several samples at once. A reading that is integrated over a wrong interval errs by the reading times the jitter, and
vibration no longer averages out. A line with growing memory (least squares, weights of an expanding-memory polynomial
filter; Brookner, Tracking and Kalman Filtering Made Easy, section 7.7) foretells each stamp; the estimator then takes
the sample to be of the time of the line. Stamps that are even stay as they are.

All of it is a function of the stamps in their order, and of no later one.
"""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.state.time import NEVER, SECOND

IMU_STAMPS = np.dtype(
    [
        ("raw", "i8"),
        ("points", "i8"),
        ("period", "f8"),
        ("ahead", "f8"),
        ("off", "i8"),
        ("variance", "f8"),
        ("even", "f8"),
        ("waiting", "i8"),
        ("block_count", "i8"),
        ("block_short", "i8"),
        ("block_time", "f8"),
        ("block_longest", "f8"),
        ("mean_interval", "f8"),
        ("bunched", "f8"),
        ("blocks", "i8"),
        ("jittered_blocks", "i8"),
        ("bunched_blocks", "i8"),
    ],
    align=True,
)
"""The line through the stamps of the IMU, and how they scatter around it.

- ``raw``: the last stamp as it came (ns).
- ``points``, ``period``: stamps on the line, at most `MEMORY` (0: the next burst begins it); its slope (s per sample).
- ``ahead``: the time of the last sample by the line minus its stamp (s). ``off``: stamps in a row far from the line.
- ``variance``: of the jitter (s2). ``even``: share of the stamps that are where the line foretells them.
- ``waiting``: samples since the line was last corrected by the end of a burst.
- ``block_*``: intervals since the last block of `BLOCK` ended: number, those that are short, their sum and the longest.
- ``mean_interval``, ``bunched``: mean interval (s) and share of short ones in the last block.
- ``blocks``, ``jittered_blocks``, ``bunched_blocks``: all blocks, and those that ended with uneven stamps.
"""

MEMORY = 256
"""Samples, or bursts of them, that the line remembers: the clock of an IMU is steady for longer."""

LONGEST_BURST = 20.0
"""Samples that are believed to come in one burst, at most."""

BLOCK = 64
"""Intervals after which the mean interval is taken anew."""

SHORT = 0.25
"""Share of the mean interval below which a sample was stamped together with the one before."""

BUNCHED = 0.35
"""Share of short intervals above which the stamps come in bursts: it is a half for pairs."""

SLACK = 3.0
"""Lengths of a burst by which a stamp may be late before the line gives it up."""

SIGMAS = 4.0
"""Standard deviations of the jitter by which a stamp may be off the line before the line begins anew."""

LEAST_TOLERANCE = 0.3
"""Share of the period by which it may be in any case."""

PATIENCE = 4
"""Stamps in a row that may be off the line where they are known to jitter, before it is led on from them."""

LATEST = 8.0
"""Periods; a stamp that is later comes after a hole, however much the stamps jitter."""

FEWER_POINTS = 16
"""Stamps, at most, that a line counts as which was led on from a stamp far off, with the same slope."""

LEARNING = 1.0 / 64.0
"""Weight of a new stamp in the running variance of the jitter."""

EVEN = 0.05
"""Share of the period: stamps that are off by less are even. If most are, all are taken as they are."""

LEAST_JITTER = 0.07
"""Share of the period: stamps that scatter less are taken as they are, too. It costs little, and may be real: those of
one real car, with 0.05, navigate 8 % better unsmoothed.
"""


@njit
def take_stamp(state, raw):
    """Take the stamp of the next IMU sample (ns); return the time at which it was measured (ns), later than the last.

    A first stamp, and one after a hole or a change of the rate, is returned as it is.
    """
    stamps = state.stamps
    if stamps.raw == NEVER:
        stamps.raw = raw
        stamps.points = 1
        return raw
    interval = (raw - stamps.raw) * 1e-9
    stamps.raw = raw
    learn_interval(stamps, interval)
    follow(stamps, interval)
    correction = stamps.ahead if is_uneven(stamps) or stamps.bunched > BUNCHED else 0.0
    # An interval is never shorter than a quarter of what it should be, unless the stamps themselves are that close.
    least = max(1.0, min(interval, 0.25 * stamps.period) * SECOND)
    return max(raw + round(correction * SECOND), state.imu.stamp + round(least))


@njit
def is_uneven(stamps):
    """Say whether the stamps scatter, most of them and so much that the line is closer to the truth than they are."""
    return stamps.even < 0.5 and stamps.variance > (LEAST_JITTER * stamps.period) ** 2


@njit
def follow(stamps, interval):
    """Lead the line on by a stamp ``interval`` s after the last, and correct it.

    Of a burst the last stamp is right: the samples before it waited for it. The line then goes through these.
    """
    if stamps.bunched <= BUNCHED:
        stamps.ahead += stamps.period - interval
        correct(stamps, 1)
        return
    if interval > SHORT * stamps.mean_interval:
        if stamps.points == 0:
            stamps.points = 1
            stamps.ahead = 0.0
        elif stamps.waiting > 0:
            correct(stamps, stamps.waiting)
        stamps.waiting = 0
    stamps.ahead += stamps.period - interval
    stamps.waiting += 1
    if -stamps.ahead > SLACK * stamps.mean_interval / (1.0 - stamps.bunched):
        stamps.ahead = 0.0
        stamps.points = min(stamps.points, FEWER_POINTS)


@njit
def correct(stamps, samples):
    """Correct the line, ``samples`` after the last time, by the stamp that it is ahead of.

    A stamp that is far off does not move the line. If more follow, or the stamps have been even, the line goes on from
    there with the same slope, and when that is wrong, too, begins anew.
    """
    n = max(stamps.points, 1)
    residual = -stamps.ahead
    if n > 1:
        # Dropped samples make a stamp late by whole periods.
        rest = residual - stamps.period * max(0.0, np.floor(residual / stamps.period + 0.5))
        is_even = abs(rest) < EVEN * stamps.period
        # Of n stamps the line foretells the next with the variance of its own jitter times this.
        square = residual * residual / (1.0 + (4.0 * n + 2.0) / (n * (n - 1.0)))
        tolerance = max((LEAST_TOLERANCE * stamps.period) ** 2, SIGMAS * SIGMAS * stamps.variance)
        jitters = is_uneven(stamps)
        stamps.even += LEARNING * (is_even - stamps.even)
        stamps.variance += LEARNING * (min(square, rest * rest) - stamps.variance)
        if square > tolerance:
            if is_even and not jitters:
                stamps.ahead = 0.0
                return
            stamps.off += 1
            patience = PATIENCE if jitters and abs(residual) < LATEST * stamps.period else 0
            if stamps.off > patience:
                stamps.ahead = -rest if patience > 0 else 0.0
                stamps.points = min(n, FEWER_POINTS) if stamps.off == patience + 1 else 1
            return
    stamps.off = 0
    n = min(n + 1, MEMORY)
    share = 1.0 / (n * (n + 1.0))
    stamps.points = n
    stamps.period += 6.0 * share * residual / samples
    stamps.ahead = -(1.0 - (4.0 * n - 2.0) * share) * residual


@njit
def learn_interval(stamps, interval):
    """Add an interval (s) to the block; at its end learn the mean interval, and whether the stamps come in bursts."""
    stamps.block_count += 1
    stamps.block_time += interval
    stamps.block_longest = max(stamps.block_longest, interval)
    if interval < SHORT * stamps.mean_interval:
        stamps.block_short += 1
    if stamps.block_count < BLOCK:
        return
    has_hole = stamps.block_longest > 0.5 * stamps.block_time
    if stamps.blocks > 0:
        stamps.bunched = min(stamps.block_short / BLOCK, 1.0 - 1.0 / LONGEST_BURST)
    stamps.mean_interval = stamps.block_time / BLOCK
    if has_hole:
        stamps.mean_interval = (stamps.block_time - stamps.block_longest) / (BLOCK - 1)
    if stamps.bunched > BUNCHED and abs(stamps.period - stamps.mean_interval) > 0.5 * stamps.mean_interval:
        # The line has followed the stamps within bursts: a new one begins with the next burst.
        stamps.period = stamps.mean_interval
        stamps.points = 0
    stamps.blocks += 1
    if stamps.bunched > BUNCHED:
        stamps.bunched_blocks += 1
    elif is_uneven(stamps):
        stamps.jittered_blocks += 1
    stamps.block_count = 0
    stamps.block_short = 0
    stamps.block_time = 0.0
    stamps.block_longest = 0.0
