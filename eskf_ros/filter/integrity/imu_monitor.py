"""IMU monitor: gravity, mounting and rates, judged over static windows and never by a single sample."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.stationarity.residual_motion import can_be_bias, is_moving
from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.geodesy.rotation import dot, rotate

IMU_MONITOR = np.dtype(
    [
        ("windows", "i8"),
        ("rest_windows", "i8"),
        ("odd_gravity_windows", "i8"),
        ("odd_gravity", "f8"),
        ("tilted_windows", "i8"),
        ("tilted_force", "f8", (3,)),
        ("fast_windows", "i8"),
        ("biased_windows", "i8"),
        ("biased_rate", "f8", (3,)),
        ("intervals", "i8"),
        ("gaps", "i8"),
        ("gap_sum", "f8"),
        ("gap_square_sum", "f8"),
    ],
    align=True,
)
"""Counts of static windows by what is wrong with the IMU in them.

``windows``, ``rest_windows``: all windows, and those at rest. ``odd_gravity_windows``, ``odd_gravity``: the mean
specific force cannot be gravity, and its last strength (m/s2). ``tilted_windows``, ``tilted_force``: at rest gravity is
far from the z axis of base_link, and the last mean force (m/s2, base_link). ``fast_windows``: the mean rate is
impossible. ``biased_windows``, ``biased_rate``: still windows in a row with the same mean rate (rad/s, IMU axes) that
is too large for a bias. ``intervals``, ``gaps``, ``gap_sum``, ``gap_square_sum``: intervals between samples, those of
them that are longer than ``imu.gap`` (but no silence), and the sums of their lengths (s) and squares (s2).
"""

LONGEST_INTERVAL = 5.0
"""s; after a longer one the alignment restarts: it is a silence, and no interval of a slow IMU."""

MANY_GAPS = 0.1
"""Share of gaps among the intervals from which on the IMU is too slow for ``imu.gap``, rather than interrupted."""

NO_GRAVITY = 0.5
"""Share of standard gravity below which no strapdown accelerometer in m/s2 reads on average, at rest or in motion."""

GRAVITY_TOLERANCE = 0.2
"""Share of standard gravity by which the mean specific force at rest may differ from it."""

UPRIGHT_COSINE = 0.7
"""Cosine of the largest angle (45 degrees) between the mean specific force at rest and the z axis of base_link."""

FASTEST_TURN = 15.0
"""rad/s; no vehicle turns faster than this on average over a window."""

SAME_RATE = 0.1
"""Share of the mean rate by which it may change from one still window to the next and still be a constant bias."""

BIASED_WINDOWS = 3
"""Still windows in a row with the same mean rate that prove a bias: no robot turns that evenly."""


@njit
def watch_interval(state, settings):
    """Count the interval that the newest sample ended, if it is one, by whether it is a gap."""
    interval = state.imu.interval
    if interval > LONGEST_INTERVAL:
        return
    state.imu_monitor.intervals += 1
    if interval > settings.imu_gap:
        state.imu_monitor.gaps += 1
        state.imu_monitor.gap_sum += interval
        state.imu_monitor.gap_square_sum += interval * interval


@njit
def watch_input(state, still, settings):
    """Judge the full static window: strength of gravity, its direction in base_link, size of the rates.

    ``still``: the readings are as quiet as at rest.
    """
    n = state.window.samples
    force = (state.window.total[0] / n, state.window.total[1] / n, state.window.total[2] / n)
    rate = (state.window.total[3] / n, state.window.total[4] / n, state.window.total[5] / n)
    strength = math.sqrt(dot(force, force))
    state.imu_monitor.windows += 1
    odd = strength < NO_GRAVITY * STANDARD_GRAVITY
    if still and abs(strength / STANDARD_GRAVITY - 1.0) > GRAVITY_TOLERANCE:
        odd = True
    if odd:
        state.imu_monitor.odd_gravity_windows += 1
        state.imu_monitor.odd_gravity = strength
    elif still:
        watch_bias(state, rate, settings)
        state.imu_monitor.rest_windows += 1
        force_base = rotate(settings.imu_to_base, force)
        if force_base[2] < UPRIGHT_COSINE * strength:
            state.imu_monitor.tilted_windows += 1
            for i in range(3):
                state.imu_monitor.tilted_force[i] = force_base[i]
    if math.sqrt(dot(rate, rate)) > FASTEST_TURN:
        state.imu_monitor.fast_windows += 1


@njit
def watch_bias(state, rate, settings):
    """Count still windows in a row with the same mean rate (rad/s, IMU axes) that exceeds the expected gyro bias."""
    nothing = (0.0, 0.0, 0.0)
    if is_moving(state) or can_be_bias(rate, nothing, settings.gyro_bias_std, 0.0):
        state.imu_monitor.biased_windows = 0
        return
    last = state.imu_monitor.biased_rate
    change = (rate[0] - last[0], rate[1] - last[1], rate[2] - last[2])
    if dot(change, change) > SAME_RATE**2 * dot(rate, rate):
        state.imu_monitor.biased_windows = 0
    state.imu_monitor.biased_windows += 1
    for i in range(3):
        state.imu_monitor.biased_rate[i] = rate[i]
