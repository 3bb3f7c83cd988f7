"""Initial heading from a sensor that measures it: dual antenna, magnetometer, or an IMU with its own filter.

One message may be wrong. The heading therefore counts as known when several messages in a row agree on how far the
attitude, which the gyros carry meanwhile, must be turned. The sensors are ranked: while a better sensor reports, the
others are ignored, and each has to wait long enough for the better ones to report.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.first_fix import START_VELOCITY_STD
from eskf_ros.filter.alignment.heading import begin_with_heading, reset_heading
from eskf_ros.filter.alignment.heading_search import forget_search, turn_found
from eskf_ros.filter.history.records import XX
from eskf_ros.filter.inertial.navigation_frame import heading_of
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, GYRO_BIAS, VELOCITY
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
        ("tried_stamp", "i8"),
        ("confirmations", "i8"),
        ("contradicted_since", "i8"),
        ("disputed", "i8"),
    ],
    align=True,
)
"""The heading that a sensor proposes while it is unknown, and when a heading was given.

- ``candidate_rank``: the rank of the sensor.
- ``candidate_count``, ``candidate_since``, ``candidate_stamp``: messages in a row that agree, the first and the last
  (ns).
- ``candidate_turn``, ``candidate_std``: the proposed turn of the attitude (rad), and its standard deviation.
- ``given_stamp``: when a parameter, the memory or a pose gave the heading (ns).
- ``tried_stamp``, ``confirmations``: the same of the heading on trial, and the messages of GNSS that have agreed with
  it while accelerations showed the heading.
- ``contradicted_since``: since when the course over ground contradicts that heading (ns).
- ``disputed``: whether the dual antenna contradicts that heading.
"""

RANK_DUAL_ANTENNA = 0
RANK_MAGNETOMETER = 1
RANK_IMU_ORIENTATION = 2

MESSAGES = 3
"""Messages in a row, at least, that must agree before the heading is set."""

SHORTEST_TIME = (0.3, 3.0, 3.0)
"""s; time over which these messages must agree, at least, by rank of the sensor."""

SILENCE = 5.0
"""s; a better sensor that has been silent for longer is ignored, and a candidate that old starts anew."""

SIGMAS = 3.0
"""Standard deviations within which two headings agree."""

LARGEST_STD = 0.5
"""rad; a measurement with a larger standard deviation does not propose a heading."""

REFUTING_TIME = 5.0
"""s; time over which rejected headings of the dual antenna must agree to refute a given heading."""

TRIAL_TIME = 20.0
"""s; rejected headings refute a given heading only if they began within this time after it was given."""

CONFIRMATIONS = 50
"""Messages of GNSS that must agree with a given heading, while accelerations show it, before it counts as known."""

UNKNOWN_HEADING_STD = math.pi
"""rad; of a heading that was dropped."""

OPEN_STD = 1.0
"""rad; standard deviation with which the heading is first set; the update by the same message then narrows it."""


@njit
def update_unknown_heading(state, aid, settings, work):
    """Propose a heading from the measurement in ``work``; set the heading if enough messages agree.

    Returns whether the heading was set; then the measurement is still to be fused.
    """
    if aid.payload[XX] < 0.0:
        return False
    rank = RANK_MAGNETOMETER
    if aid.stream == Stream.HEADING:
        rank = RANK_DUAL_ANTENNA if aid.source == 0 else RANK_IMU_ORIENTATION
    if rank == RANK_DUAL_ANTENNA and state.heading.disputed == 1:
        return False
    turn, std = work.innovation[0], math.sqrt(work.noise[0, 0])
    if rank == RANK_DUAL_ANTENNA and settings.heading_offset_at < state.error_size:
        std = math.hypot(std, settings.optional_std[settings.heading_offset_at - ERROR_SIZE])
    if rank == RANK_MAGNETOMETER:
        std = math.hypot(std, settings.optional_std[settings.mag_error_at - ERROR_SIZE])
    if std > LARGEST_STD or not update_heading_candidate(state, aid.stamp, rank, turn, std, SHORTEST_TIME[rank]):
        return False
    found, found_std = turn_found(state)
    if abs(wrapped(turn - found)) > SIGMAS * math.sqrt(std**2 + found_std**2):
        return False
    begin_with_heading(state, heading_of(state, settings) + turn, OPEN_STD, settings)
    state.mag.heading = heading_of(state, settings)
    return True


@njit
def update_heading_candidate(state, stamp, rank, turn, std, shortest_time):
    """Say whether enough messages in a row, this one the last, propose the same turn (rad) of the attitude."""
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
    """Say whether a rejected heading of the dual antenna, with those before it, refutes a heading that was given.

    A parameter, the memory or a pose may be wrong, and a filter that trusts them would reject the better sensor for
    ever. A given heading therefore holds only once the dual antenna has agreed with it. Antennas that were rejected
    from the beginning and agree with each other refute it.
    """
    is_doubtful = (
        state.heading.given_stamp != NEVER
        and state.streams.fused_stamp[Stream.HEADING.value, 0] < state.heading.given_stamp
    )
    if not is_doubtful or aid.source != 0 or not aid.payload[XX] > 0.0:
        return False
    std = math.sqrt(aid.payload[XX])
    if not update_heading_candidate(state, aid.stamp, RANK_DUAL_ANTENNA, work.innovation[0], std, REFUTING_TIME):
        return False
    return (state.heading.candidate_since - state.heading.given_stamp) * 1e-9 < TRIAL_TIME


@njit
def reset_given_heading(state, aid, settings, work):
    """Drop a refuted heading: take that of the antennas if they were fused before; return whether they have won.

    Otherwise the antennas may be wrong, too (swapped), and only motion can decide: the caller has to restart the
    alignment. The velocity went wrong with the heading, so its variance is opened.
    """
    state.heading.given_stamp = NEVER
    state.heading.candidate_count = 0
    if state.streams.fused_stamp[Stream.HEADING.value, 0] == NEVER:
        state.heading.disputed = 1
        return False
    std = math.sqrt(aid.payload[XX])
    if settings.heading_offset_at < state.error_size:
        std = math.hypot(std, settings.optional_std[settings.heading_offset_at - ERROR_SIZE])
    reset_heading(state, heading_of(state, settings) + work.innovation[0], std, settings)
    for i in range(VELOCITY, VELOCITY + 3):
        for j in range(len(state.covariance)):
            state.covariance[i, j] = 0.0
            state.covariance[j, i] = 0.0
        state.covariance[i, i] = START_VELOCITY_STD**2
    return True


@njit
def confirm_given_heading(state):
    """Count a fused message of GNSS for the heading that was given, while accelerations show the heading."""
    is_asked = state.heading.given_stamp != NEVER and state.trial.is_on == 0
    if not is_asked or state.heading_known == 0 or state.excitation.left == 0.0:
        return
    if state.heading.tried_stamp != state.heading.given_stamp:
        state.heading.tried_stamp = state.heading.given_stamp
        state.heading.confirmations = 0
    state.heading.confirmations += 1
    if state.heading.confirmations >= CONFIRMATIONS:
        state.heading.given_stamp = NEVER


@njit
def reset_to_unknown_heading(state):
    """Drop a heading that was given and is refuted by the first motion: it is unknown now, and searched for."""
    state.heading_known = 0
    state.heading.given_stamp = NEVER
    up = ATTITUDE + 2
    for i in range(len(state.covariance)):
        state.covariance[up, i] = 0.0
        state.covariance[i, up] = 0.0
    state.covariance[up, up] = UNKNOWN_HEADING_STD**2
    forget_search(state)
