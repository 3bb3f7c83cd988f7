"""What samples that do not measure cost: noise along their axes, and the part of a reading that is not believed."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit

LASTS = 2.0
"""s; for so long the motion that an axis does not measure stays the same, about."""

SLOWEST = 5.0
"""Hz; slower swings of the specific force are those of the robot."""


@njit
def clear_doubt(quality):
    """Believe all axes in the next interval."""
    if quality.is_doubted == 0:
        return
    quality.is_doubted = 0
    for i in range(6):
        quality.doubt[i] = quality.error[i] = 0.0
        quality.excess[0, i] = quality.excess[1, i] = 0.0


@njit
def copy_doubt(state, lane):
    """Let another lane know which axes are doubted, how much readings change, and how noisy the gyros are."""
    lane.gyro_noise.density = state.gyro_noise.density
    for i in range(6):
        lane.quality.change[i] = state.quality.change[i]
        lane.quality.bend[i] = state.quality.bend[i]
    if state.quality.is_doubted == 0:
        clear_doubt(lane.quality)
        return
    lane.quality.is_doubted = 1
    for i in range(6):
        lane.quality.doubt[i] = state.quality.doubt[i]
        lane.quality.error[i] = state.quality.error[i]
        lane.quality.excess[0, i] = state.quality.excess[0, i]
        lane.quality.excess[1, i] = state.quality.excess[1, i]


@njit
def widen(quality, i, std, begin, end, interval):
    """Let axis ``i`` be in error by a constant of ``std`` from ``begin`` to ``end`` (s), paid over ``interval`` s.

    What is in error for longer than `LASTS` is in error by something else by then.
    """
    growth = (end - begin) * min(end + begin, 2.0 * LASTS)
    quality.doubt[i] += std * std * growth / interval
    quality.error[i] = max(quality.error[i], std)
    quality.is_doubted = 1


@njit
def hide(quality, i, std, duration, instant, interval):
    """Let axis ``i`` be in error by ``std`` for ``duration`` s up to ``instant`` (ns), paid over ``interval`` s.

    All that is hidden within `LASTS` has one direction, also with good readings between: it adds in amplitude.
    """
    before = quality.hidden[i] * math.exp((quality.hidden_stamp[i] - instant) * 1e-9 / LASTS)
    quality.hidden[i] = before + std * duration
    quality.hidden_stamp[i] = instant
    quality.doubt[i] += (quality.hidden[i] ** 2 - before**2) / interval
    quality.error[i] = max(quality.error[i], std)
    quality.is_doubted = 1


@njit
def credible_reading(quality, reading, first, fraction):
    """Return a reading of a sensor (3) at ``fraction`` of the interval without what is not believed of it.

    ``first``: 0 for the accelerometers (m/s2), 3 for the gyros (rad/s).
    """
    if quality.is_doubted == 0:
        return reading
    begin, end = quality.excess[0], quality.excess[1]
    return (
        reading[0] - (begin[first] + fraction * (end[first] - begin[first])),
        reading[1] - (begin[first + 1] + fraction * (end[first + 1] - begin[first + 1])),
        reading[2] - (begin[first + 2] + fraction * (end[first + 2] - begin[first + 2])),
    )


@njit
def shaken_density(quality, first, interval):
    """Return the density of white noise by which the readings of a sensor would change as much as they do.

    Vibration is no noise of the sensor, but says as little of the motion. ``first``: 0 for the accelerometers
    (m/s2/rtHz), 3 for the gyros (rad/s/rtHz); ``interval`` of the samples in s.
    """
    largest = max(quality.change[first], max(quality.change[first + 1], quality.change[first + 2]))
    return math.sqrt(0.5 * largest * interval)


@njit
def shaken_velocity(quality, interval):
    """Return by how much (m/s, standard deviation) vibration moves the integral of the specific force to and fro.

    A sine of amplitude a and angular frequency w changes by 2 a sin(w h / 2) in the ``interval`` h (s), and these
    changes change by the square of the sine: both mean squares give a and w, and the integral is a / w. 0 where that is
    slower than `SLOWEST`: then it is motion.
    """
    largest = 0.0
    for i in range(3):
        if quality.change[i] == 0.0:
            continue
        sine = 0.5 * math.sqrt(quality.bend[i] / quality.change[i])
        if sine < math.sin(min(math.pi * SLOWEST * interval, 0.5 * math.pi)):
            continue
        amplitude = 0.5 * math.sqrt(quality.change[i]) / sine
        largest = max(largest, 0.5 * amplitude * interval / math.asin(min(sine, 1.0)))
    return largest
