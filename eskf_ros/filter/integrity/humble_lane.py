"""Two lanes: beside the filter runs a humble one, which judges the filter and the receivers.

The humble lane is the same filter, but it does not believe the IMU: its noise is wide (`settings.humble_noise`), so
that biases that step, wander, clip or scale are followed within seconds. It hears positions and velocities of GNSS
alone, and refuses only what jumps. It is less accurate than the filter, and hardly ever wrong.

- The filter is wrong where the humble lane predicts the receiver much better: the sum of the differences of their log
  likelihoods reaches a threshold (CUSUM; Page, Continuous inspection schemes, 1954), or the headings of the two are
  further apart than their covariances allow (Hausman, Specification tests in econometrics, 1978: the difference of an
  efficient and a robust estimate has the variance of the difference). The filter then continues from the humble lane,
  and its own IMU noise, wide at first, narrows again over ``doubt_time``.
- A receiver is wrong where even the humble lane is surprised. What it sends is refused until it has agreed with itself
  for long enough (`patience_for`): the shorter, the more streams contradict the humble lane.

The humble lane runs while the heading is known, and starts from the filter.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.navigation_frame import heading_of
from eskf_ros.filter.integrity.heading_corrections import one_way
from eskf_ros.filter.integrity.refusal import (
    IMU_ASTRAY,
    JUMP_GATE,
    OPENED_VELOCITY_STD,
    is_jump,
    is_small,
    kind_of,
    note_jump,
    other_stream,
    receiver_of,
)
from eskf_ros.filter.integrity.restart import inflate_level
from eskf_ros.filter.measurements import gnss_position, gnss_velocity
from eskf_ros.filter.measurements.jacobians import clear
from eskf_ros.filter.measurements.kalman_update import apply, judge, update
from eskf_ros.filter.state.augmented_states import reset_augmented
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, GYRO_BIAS, POSITION, SOURCES, VELOCITY
from eskf_ros.filter.state.lanes import FILTER, HUMBLE, LANES, is_running
from eskf_ros.filter.state.streams import is_live
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.rotation import wrapped

TRUST = np.dtype(
    [
        ("evidence", "f8"),
        ("doubt_stamp", "i8"),
        ("doubt_time", "f8"),
        ("takeovers", "i8"),
        ("refused", "i8", (2, SOURCES)),
        ("refused_since", "i8", (2, SOURCES)),
        ("refused_stamp", "i8", (2, SOURCES)),
        ("refused_innovation", "f8", (2, SOURCES, 3)),
        ("first_innovation", "f8", (2, SOURCES, 3)),
        ("mean_innovation", "f8", (SOURCES, 3)),
        ("mean_stamp", "i8", (SOURCES,)),
        ("change", "f8", (2, SOURCES, 3)),
        ("jumps", "i8", (2, SOURCES)),
        ("jump", "f8", (2, SOURCES)),
    ],
    align=True,
)
"""What the lanes think of each other and of the receivers; the latter by kind (0 position, 1 velocity) and source.

- ``evidence``: sum of log likelihood ratios against the filter (CUSUM).
- ``doubt_stamp``, ``doubt_time``: when the humble lane took over last (ns), and how long the noise narrows (s).
- ``takeovers``: how often the humble lane took over.
- ``refused``, ``refused_since``, ``refused_stamp``: messages refused in a row, the first and the last of them (ns).
- ``refused_innovation``, ``first_innovation``: innovation of the last and of the first refused one (m or m/s, map).
- ``mean_innovation``, ``mean_stamp``: mean of the innovations of refused fixes along the path as it is now (m, map),
  and of their stamps (ns).
- ``change``: largest change from one refused innovation to the next (m or m/s, map).
- ``jumps``, ``jump``: how often a stream jumped, and the furthest (m or m/s).
"""

EVIDENCE = 20.0
"""Log likelihood ratio from which on the filter is wrong: by chance once in exp(20) messages."""

EXPECTED_NIS = 7.81
"""NIS of 3 scalars in the humble lane beyond which a message surprises it: the chi-square quantile of 0.95."""

LARGEST_NIS = 30.0
"""A single innovation counts with at most this NIS in the likelihoods: wild messages are not evidence."""

HEADING_SIGMAS = 5.0
"""Standard deviations by which the headings of the lanes must differ for the filter to be wrong."""

FIRST_DOUBT = 60.0
"""s; time over which the noise of the filter narrows after the first takeover."""

LONGEST_DOUBT = 960.0
"""s; the time doubles with every takeover during the doubt, up to this, and halves after a time without."""

SOLUTION_SCALE = (25.0, 9.0)
"""Factor on the covariance of the solution of an epoch of ranges and of range rates: signals err for minutes and
together, which least squares over one epoch do not know.
"""

LOST_HEADING_STD = 0.5
"""rad; a humble lane that knows the heading no better starts anew from the filter."""

LASTING_BIAS_DOUBT = 0.7
"""Doubt about biases that does not fade: biases that have moved move again, most by temperature."""

LASTING_BIAS_TIME = 600.0
"""s; after this time without a takeover it ends."""

BIAS_GATE = 11.34
"""NIS of three biases of the filter in the humble lane beyond which they are wrong: the chi-square quantile of 0.99."""

BELIEVED = 16.0
"""Factor on the variances of the biases that the filter keeps: the IMU may be four times as noisy as was believed."""

DRIFT = 1.5
"""Standard deviations (`heading_corrections.one_way`) of the heading from which on the biases are doubted."""

OPENED_HEADING_STD = 0.5
"""rad; of the heading after a fault of the IMU."""


@njit
def start(states, settings):
    """Start the humble lane from the filter, where the heading is known; start it anew where it has lost its own."""
    state, humble = states[FILTER], states[HUMBLE]
    if state.heading_known == 0 or state.position_known == 0 or settings.has_humble_lane == 0:
        humble.heading_known = 0
        return
    if state.trial.is_on == 1:
        return
    if is_running(states) and humble.covariance[ATTITUDE + 2, ATTITUDE + 2] < LOST_HEADING_STD**2:
        return
    states[HUMBLE] = states[FILTER]
    humble.error_size = size_for_gnss(state, settings)
    humble.doubt = 1.0
    humble.bias_doubt = 1.0
    state.trust.evidence = 0.0


@njit
def size_for_gnss(state, settings):
    """Return how many of the errors in use the core has, and positions and velocities of GNSS."""
    size = ERROR_SIZE
    if settings.position_error_at < state.error_size:
        size = settings.position_error_at + 3
    if settings.lever_arm_at < state.error_size:
        size = settings.lever_arm_at + 3
    if settings.time_offset_at < state.error_size:
        size = settings.time_offset_at + 1
    if settings.velocity_time_offset_at < state.error_size:
        size = settings.velocity_time_offset_at + 1
    return size


@njit
def linearize(lane, aid, settings, work):
    """Write innovation, Jacobian and noise of a position or velocity of GNSS in a lane to ``work``.

    Of an epoch of ranges it is the solution by least squares in ``work.solution`` (`tight.epoch`).
    """
    if aid.stream == Stream.GNSS_POSITION:
        return gnss_position.linearize(lane, aid.payload, aid.source, settings, work)
    if aid.stream == Stream.GNSS_VELOCITY:
        return gnss_velocity.linearize(lane, aid.payload, aid.source, settings, work)
    clear(work)
    measured = (work.solution[0], work.solution[1], work.solution[2])
    for i in range(3):
        for j in range(3):
            work.noise[i, j] = SOLUTION_SCALE[kind_of(aid.stream)] * work.solution_covariance[i, j]
    if aid.stream == Stream.PSEUDORANGE:
        gnss_position.linearize_antenna(lane, measured, 0, settings, work)
    else:
        gnss_velocity.linearize_antenna(lane, measured, 0, settings, work)
    return 3


@njit
def hear(states, aid, gate, settings, work):
    """Let the humble lane hear a message.

    Returns whether it jumps, why it is believed now after many like it were refused (`note_jump`; 0: it is not one of
    these), and NIS and log determinant of its innovation.
    """
    state, humble = states[FILTER], states[HUMBLE]
    kind, source = kind_of(aid.stream), receiver_of(aid)
    size = linearize(humble, aid, settings, work)
    if aid.stream == Stream.GNSS_POSITION and reset_jumped_error(states, settings, work):
        linearize(humble, aid, settings, work)
    nis, determinant = judge(humble, size, work)
    if determinant == 0.0:
        return True, 0, nis, 0.0
    believed = 0
    if state.trust.refused[kind, source] > 0 or is_jump(nis, kind, work):
        if is_expected(state, aid, gate, settings, work):
            # While it refused, the humble lane has gone astray: it starts anew from the filter.
            state.trust.refused[kind, source] = 0
            humble.heading_known = 0
            return False, 0, nis, math.inf
        believed = note_jump(state, aid, kind, work)
        if believed == 0:
            return True, 0, nis, 0.0
        linearize(humble, aid, settings, work)
        reset_to_message(humble, state.trust, aid, believed == IMU_ASTRAY, work)
        size = linearize(humble, aid, settings, work)
        nis, determinant = judge(humble, size, work)
    state.trust.refused[kind, source] = 0
    apply(humble, size, work)
    return False, believed, nis, math.log(determinant)


@njit
def reset_jumped_error(states, settings, work):
    """Forget the lasting error of the fixes if the fix in ``work`` is much closer to the path without it.

    Errors by multipath end suddenly. Returns whether it was forgotten, in both lanes.
    """
    place = settings.position_error_at
    if place >= states[HUMBLE].error_size:
        return False
    with_error, without = 0.0, 0.0
    for i in range(3):
        lasting = work.jacobian[i, place + i] * states[HUMBLE].optional[place - ERROR_SIZE + i]
        with_error += work.innovation[i] ** 2 / work.noise[i, i]
        without += (work.innovation[i] + lasting) ** 2 / work.noise[i, i]
    if with_error - without < JUMP_GATE:
        return False
    for lane in range(LANES):
        if place < states[lane].error_size:
            reset_augmented(states[lane], place, 3, settings)
    return True


@njit
def is_expected(state, aid, gate, settings, work):
    """Say whether the filter itself expects a message: it is within its innovation gate, or close."""
    size = linearize(state, aid, settings, work)
    nis, determinant = judge(state, size, work)
    return determinant > 0.0 and (nis <= gate or is_small(kind_of(aid.stream), work))


@njit
def reset_to_message(lane, trust, aid, is_inertial, work):
    """Open what a message contradicts, which is believed now; ``work`` holds its innovation and noise.

    A position moves the position, and where the IMU is at fault (``is_inertial``) opens the velocity. A velocity moves
    the velocity, and opens the position by the way gone wrong since the first was refused. Both are as good as the
    refused messages agree (``trust``). A fault of the IMU also opens the attitude and the biases.
    """
    kind = kind_of(aid.stream)
    lasted = (aid.stamp - trust.refused_since[kind, receiver_of(aid)]) * 1e-9
    block = POSITION if kind == 0 else VELOCITY
    reset_block(lane, block)
    for i in range(3):
        if kind == 0:
            lane.position_map[i] += work.innovation[i]
        else:
            lane.velocity_map[i] += work.innovation[i]
            lane.covariance[POSITION + i, POSITION + i] += (lasted * work.innovation[i]) ** 2
        change = trust.change[kind, receiver_of(aid), i]
        lane.covariance[block + i, block + i] = 4.0 * work.noise[i, i] + change * change
    if not is_inertial:
        return
    if kind == 0:
        reset_block(lane, VELOCITY)
        for i in range(3):
            lane.covariance[VELOCITY + i, VELOCITY + i] = OPENED_VELOCITY_STD**2
    if lane.heading_known == 0:
        return
    inflate_level(lane)
    lane.covariance[ATTITUDE + 2, ATTITUDE + 2] += OPENED_HEADING_STD**2


@njit
def reset_block(lane, block):
    """Zero the variances and correlations of the three errors from index ``block``."""
    for i in range(block, block + 3):
        for j in range(len(lane.covariance)):
            lane.covariance[i, j] = 0.0
            lane.covariance[j, i] = 0.0


@njit
def weigh_evidence(states, aid, nis, log_determinant, humble_nis, humble_log_determinant, settings):
    """Compare how well the lanes predicted a message; say whether the filter has been worse for too long.

    Both innovations with their covariances: NIS and logarithm of the determinant. A message that surprises the humble
    lane, too, is noisier than it claims, and says less by that much.
    """
    state = states[FILTER]
    update_doubt(state)
    if kind_of(aid.stream) == 1 or not is_live(state, other_stream(aid.stream), receiver_of(aid)):
        surprise = max(1.0, humble_nis / EXPECTED_NIS)
        ratio = (min(nis, LARGEST_NIS) - min(humble_nis, LARGEST_NIS)) / surprise
        ratio += log_determinant - humble_log_determinant
        state.trust.evidence = max(0.0, state.trust.evidence + 0.5 * ratio)
    return state.trust.evidence >= EVIDENCE or is_heading_apart(states, settings)


@njit
def is_heading_apart(states, settings):
    """Say whether the heading of the filter is further from that of the humble lane than the covariances allow."""
    state, humble = states[FILTER], states[HUMBLE]
    variance = humble.covariance[ATTITUDE + 2, ATTITUDE + 2] - state.covariance[ATTITUDE + 2, ATTITUDE + 2]
    apart = wrapped(heading_of(state, settings) - heading_of(humble, settings))
    return variance > 0.0 and apart * apart > HEADING_SIGMAS**2 * variance


@njit
def update_doubt(state):
    """Let the doubts about the IMU fade from 1 to 0 over ``doubt_time`` after a takeover; those about biases last."""
    if state.doubt == 0.0 and state.bias_doubt == 0.0:
        return
    passed = (state.stamp - state.trust.doubt_stamp) * 1e-9
    state.doubt = max(0.0, 1.0 - passed / state.trust.doubt_time)
    lasting = LASTING_BIAS_DOUBT if passed < LASTING_BIAS_TIME else 0.0
    state.bias_doubt = min(state.bias_doubt, max(state.doubt, lasting))


@njit
def reset_to_humble_lane(states, is_bias_wrong, work):
    """Continue the filter from the humble lane, with wide IMU noise that narrows again.

    Unless ``is_bias_wrong``, or this is the second time in a row, the filter keeps the biases that the humble lane does
    not contradict: reflections near a receiver look like an IMU that goes astray, and the biases of the humble lane,
    which follow the last seconds, would be the worse ones to coast on.
    """
    state, humble = states[FILTER], states[HUMBLE]
    accel, gyro = state.accel_bias, state.gyro_bias
    accel_bias, gyro_bias = (accel[0], accel[1], accel[2]), (gyro[0], gyro[1], gyro[2])
    accel_variance = variances(state.covariance, ACCEL_BIAS)
    gyro_variance = variances(state.covariance, GYRO_BIAS)
    reset_to_lane(state, humble)
    trust = state.trust
    passed = (state.stamp - trust.doubt_stamp) * 1e-9 if trust.doubt_stamp != NEVER else math.inf
    is_first = passed >= FIRST_DOUBT
    if passed >= 3.0 * trust.doubt_time:
        trust.doubt_time = FIRST_DOUBT
    else:
        trust.doubt_time = min(2.0 * trust.doubt_time, LONGEST_DOUBT)
    trust.doubt_stamp = state.stamp
    trust.evidence = 0.0
    trust.takeovers += 1
    state.doubt = 1.0
    state.bias_doubt = 1.0
    if is_first and not is_bias_wrong and one_way(state) < DRIFT:
        keeps_accel = keep_bias(state, ACCEL_BIAS, accel_bias, accel_variance, work)
        keeps_gyro = keep_bias(state, GYRO_BIAS, gyro_bias, gyro_variance, work)
        state.bias_doubt = 0.0 if keeps_accel and keeps_gyro else 1.0


@njit
def reset_to_lane(state, lane):
    """Take the estimate of a lane and its covariance; errors that it does not have keep theirs, uncorrelated."""
    for i in range(3):
        state.position_map[i] = lane.position_map[i]
        state.velocity_map[i] = lane.velocity_map[i]
        state.accel_bias[i] = lane.accel_bias[i]
        state.gyro_bias[i] = lane.gyro_bias[i]
    for i in range(4):
        state.attitude[i] = lane.attitude[i]
    size = lane.error_size
    for i in range(size - ERROR_SIZE):
        state.optional[i] = lane.optional[i]
    for i in range(size):
        for j in range(size):
            state.covariance[i, j] = lane.covariance[i, j]
        for j in range(size, state.error_size):
            state.covariance[i, j] = 0.0
            state.covariance[j, i] = 0.0


@njit
def variances(covariance, first):
    """Return the three variances from index ``first`` on."""
    return covariance[first, first], covariance[first + 1, first + 1], covariance[first + 2, first + 2]


@njit
def keep_bias(state, first, bias, variance, work):
    """Fuse three biases from index ``first`` on that were known before; return False where they are contradicted."""
    clear(work)
    for i in range(3):
        now = state.accel_bias[i] if first == ACCEL_BIAS else state.gyro_bias[i]
        work.innovation[i] = bias[i] - now
        work.jacobian[i, first + i] = 1.0
        work.noise[i, i] = BELIEVED * variance[i]
    verdict, _ = update(state, 3, BIAS_GATE, work)
    return verdict == Verdict.FUSED
