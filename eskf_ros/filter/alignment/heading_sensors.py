"""Heading at start from a sensor that tells it: a dual antenna, a magnetometer, an IMU with a filter of its own.

One message may be wrong. So the heading counts as known when a few in a row agree on how far the attitude, which the
gyros carry meanwhile, is turned. The sensors have ranks: while a better one speaks, what the others say is not heard,
and they have to wait long enough for it to speak.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.first_fix import START_VELOCITY_STD
from eskf_ros.filter.alignment.heading import reset_heading
from eskf_ros.filter.alignment.heading_search import turn_found
from eskf_ros.filter.inertial.navigation_frame import heading_of
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, GYRO_BIAS, VELOCITY
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.rotation import wrapped

CANDIDATE = np.dtype(
    [
        ("candidate_rank", "i8"),
        ("candidate_count", "i8"),
        ("candidate_since", "i8"),
        ("candidate_stamp", "i8"),
        ("candidate_turn", "f8"),
        ("candidate_std", "f8"),
        ("given_stamp", "i8"),
        ("disputed", "i8"),
    ],
    align=True,
)
"""What a sensor says of the unknown heading, and when a heading was given.

``candidate_*``: rank of the sensor, how often it agreed with itself since when, its last message, by how much (rad) it
would turn the attitude, and the standard deviation. ``given_stamp``: by parameter, from memory, or by a pose.
``disputed``: the dual antenna contradicts it.
"""

DUAL_ANTENNA = 0
MAGNETOMETER = 1
IMU_ORIENTATION = 2

MESSAGES = 3
SHORTEST_TIME = (0.3, 3.0, 3.0)
"""So many messages, over at least so long (s, by rank), must agree."""

SILENCE = 5.0
"""A better sensor that was silent for so long (s) is no longer waited for."""

SIGMAS = 3.0

LARGEST_STD = 0.5
"""What is less certain (rad) does not tell a heading."""

REFUTING_TIME = 5.0
TRIAL_TIME = 20.0
"""Rejected headings that agree for so long (s) refute a given one, if they began so soon (s) after it was given."""

OPEN_STD = 1.0
"""The heading is first set with this standard deviation (rad); the update by the message makes it what it is."""


@njit
def update_unknown_heading(state, aid, settings, work):
    """Consider a measurement of the unknown heading, described by ``work``; set the heading if it is beyond doubt.

    When it returns True the measurement is still to be fused.
    """
    if aid.payload[3] < 0.0:
        return False
    rank = MAGNETOMETER
    if aid.stream == Stream.HEADING:
        rank = DUAL_ANTENNA if aid.source == 0 else IMU_ORIENTATION
    if rank == DUAL_ANTENNA and state.heading.disputed == 1:
        return False
    turn, std = work.innovation[0], math.sqrt(work.noise[0, 0])
    if rank == DUAL_ANTENNA and settings.heading_offset_at < state.error_size:
        std = math.hypot(std, settings.optional_std[settings.heading_offset_at - ERROR_SIZE])
    if rank == MAGNETOMETER:
        std = math.hypot(std, settings.optional_std[settings.mag_error_at - ERROR_SIZE])
    if std > LARGEST_STD or not update_heading_candidate(state, aid.stamp, rank, turn, std, SHORTEST_TIME[rank]):
        return False
    found, found_std = turn_found(state)
    if abs(wrapped(turn - found)) > SIGMAS * math.sqrt(std**2 + found_std**2):
        return False
    reset_heading(state, heading_of(state, settings) + turn, OPEN_STD, settings)
    state.heading_known = 1
    state.mag.heading = heading_of(state, settings)
    return True


@njit
def update_heading_candidate(state, stamp, rank, turn, std, shortest_time):
    """Say whether enough messages in a row, this one the last, would turn the attitude alike (rad)."""
    age = (stamp - state.heading.candidate_stamp) * 1e-9
    if state.heading.candidate_count > 0 and rank > state.heading.candidate_rank and age < SILENCE:
        return False
    bias_variance = 0.0
    for i in range(3):
        bias_variance = max(bias_variance, state.covariance[GYRO_BIAS + i, GYRO_BIAS + i])
    drift = math.sqrt(bias_variance) * age
    tolerance = SIGMAS * math.sqrt(std**2 + state.heading.candidate_std**2 + drift**2)
    is_other = abs(wrapped(turn - state.heading.candidate_turn)) > tolerance
    if state.heading.candidate_count == 0 or rank != state.heading.candidate_rank or age > SILENCE or is_other:
        state.heading.candidate_count = 0
        state.heading.candidate_since = stamp
    state.heading.candidate_rank = rank
    state.heading.candidate_count += 1
    state.heading.candidate_stamp = stamp
    state.heading.candidate_turn = turn
    state.heading.candidate_std = std
    return state.heading.candidate_count >= MESSAGES and (stamp - state.heading.candidate_since) * 1e-9 >= shortest_time


@njit
def update_refutation(state, aid, settings, work):
    """Consider a heading of the dual antenna that was rejected; say whether it refutes a heading that was given.

    A parameter, a memory or a pose may be wrong, and a filter that trusts them rejects for ever the sensor that knows
    better. So what was given holds only if the antennas are heard to agree with it, and not if those that were rejected
    from the beginning agree with each other.
    """
    is_doubtful = (
        state.heading.given_stamp != NEVER
        and state.streams.fused_stamp[Stream.HEADING.value, 0] < state.heading.given_stamp
    )
    if not is_doubtful or aid.source != 0 or not aid.payload[3] > 0.0:
        return False
    std = math.sqrt(aid.payload[3])
    if not update_heading_candidate(state, aid.stamp, DUAL_ANTENNA, work.innovation[0], std, REFUTING_TIME):
        return False
    return (state.heading.candidate_since - state.heading.given_stamp) * 1e-9 < TRIAL_TIME


@njit
def reset_given_heading(state, aid, settings, work):
    """Take the heading of the antennas, if they were believed before, else none: antennas may be swapped, too.

    Then only motion decides, and the caller has to restart the alignment. The velocity, led astray meanwhile, is open.
    Returns whether the antennas have won.
    """
    state.heading.given_stamp = NEVER
    state.heading.candidate_count = 0
    if state.streams.fused_stamp[Stream.HEADING.value, 0] == NEVER:
        state.heading.disputed = 1
        return False
    std = math.sqrt(aid.payload[3])
    if settings.heading_offset_at < state.error_size:
        std = math.hypot(std, settings.optional_std[settings.heading_offset_at - ERROR_SIZE])
    reset_heading(state, heading_of(state, settings) + work.innovation[0], std, settings)
    for i in range(VELOCITY, VELOCITY + 3):
        for j in range(len(state.covariance)):
            state.covariance[i, j] = 0.0
            state.covariance[j, i] = 0.0
        state.covariance[i, i] = START_VELOCITY_STD**2
    return True
