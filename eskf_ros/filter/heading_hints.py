"""Heading at start from a sensor that tells it: a dual antenna, a magnetometer, an IMU with a filter of its own.

One message may be wrong. So the heading counts as known when a few in a row agree on how far the attitude, which the
gyros carry meanwhile, is turned. The sensors have ranks: while a better one speaks, what the others say is not heard,
and they have to wait long enough for it to speak.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment import heading_of, set_heading
from eskf_ros.filter.heading_search import turn_found
from eskf_ros.filter.layout import ERROR_SIZE, GYRO_BIAS, Stream
from eskf_ros.rotation import wrapped

HEADING = int(Stream.HEADING)

DUAL_ANTENNA = 0
MAGNETOMETER = 1
IMU_ORIENTATION = 2

MESSAGES = 3
SHORTEST_TIME = (0.3, 3.0, 3.0)
"""So many messages, over at least so long (s, by rank), must agree."""

SILENCE = 5.0
"""A better sensor that was silent for so long (s) is no longer waited for."""

SIGMAS = 3.0

OPEN_STD = 1.0
"""The heading is first set with this standard deviation (rad); the update by the message makes it what it is."""


@njit
def is_heading_told(state, aid, settings, work):
    """Consider a measurement of the unknown heading, described by ``work``; set the heading if it is beyond doubt.

    When it returns True the measurement is still to be fused.
    """
    if aid.payload[3] < 0.0:
        return False
    rank = MAGNETOMETER
    if aid.stream == HEADING:
        rank = DUAL_ANTENNA if aid.source == 0 else IMU_ORIENTATION
    turn, std = work.innovation[0], math.sqrt(work.noise[0, 0])
    if rank == DUAL_ANTENNA and settings.heading_offset_at < state.error_size:
        std = math.hypot(std, settings.optional_std[settings.heading_offset_at - ERROR_SIZE])
    if rank == MAGNETOMETER:
        std = math.hypot(std, settings.optional_std[settings.mag_error_at - ERROR_SIZE])
    age = (aid.stamp - state.hint_stamp) * 1e-9
    if state.hint_count > 0 and rank > state.hint_rank and age < SILENCE:
        return False
    bias_variance = 0.0
    for i in range(3):
        bias_variance = max(bias_variance, state.covariance[GYRO_BIAS + i, GYRO_BIAS + i])
    drift = math.sqrt(bias_variance) * age
    tolerance = SIGMAS * math.sqrt(std**2 + state.hint_std**2 + drift**2)
    if (
        state.hint_count == 0
        or rank != state.hint_rank
        or age > SILENCE
        or abs(wrapped(turn - state.hint_turn)) > tolerance
    ):
        state.hint_count = 0
        state.hint_since = aid.stamp
    state.hint_rank = rank
    state.hint_count += 1
    state.hint_stamp = aid.stamp
    state.hint_turn = turn
    state.hint_std = std
    if state.hint_count < MESSAGES or (aid.stamp - state.hint_since) * 1e-9 < SHORTEST_TIME[rank]:
        return False
    found, found_std = turn_found(state)
    if abs(wrapped(turn - found)) > SIGMAS * math.sqrt(std**2 + found_std**2):
        return False
    set_heading(state, heading_of(state, settings) + turn, OPEN_STD, settings)
    state.heading_known = 1
    # This turn is none that the vehicle made.
    state.mag_heading = heading_of(state, settings)
    return True
