"""Refused messages of GNSS receivers: which ones jump, and when those that were refused are believed after all.

A message jumps where it surprises the humble lane (`humble_lane`). Offsets that stay the same are those of a receiver
that has stepped aside; offsets that grow come from an IMU that goes astray. Both are believed in the end.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import VELOCITY
from eskf_ros.filter.state.streams import is_live
from eskf_ros.filter.state.time import NEVER

JUMP_GATE = 30.7
"""NIS of 3 scalars in the humble lane beyond which a message jumps: the chi-square quantile of 1 - 1e-6."""

LEAST_JUMP = (2.0, 0.5)
"""m, m/s; smaller innovations of positions and velocities are no jumps, whatever the receiver claims."""

AGREEMENT_GATE = 16.27
"""NIS of the difference of two refused messages up to which they agree: the chi-square quantile of 0.999."""

FEWEST = 5
"""Refused messages in a row that must agree with each other before they are believed."""

RECEIVER_STEPPED = 1
"""Why refused messages are believed: the receiver has stepped aside, for good."""

IMU_ASTRAY = 2
"""Why refused messages are believed: the IMU, or the velocity, is wrong."""

SHORT_PATIENCE = 1_000_000_000
"""ns; position and velocity that both contradict the humble lane are believed after this time: the IMU is wrong."""

LONG_PATIENCE = 30_000_000_000
"""ns; a stream that stepped aside is believed after this time at the latest."""

RIVAL_TIME = 10_000_000_000
"""ns; fixes that agree with each other for so long while they are refused may be the right ones."""

OPENED_VELOCITY_STD = 10.0
"""m/s per axis; of a velocity that nothing confirms."""

BACKED_VELOCITY_STD = 0.05
"""m/s per axis; of the mean velocity of the humble lane while the velocities of the receiver agree with it."""

OPENED_ACCELERATION_STD = 3.0
"""m/s2 per axis; of refused velocities about each other."""


@njit
def kind_of(stream):
    """Return 0 for positions, 1 for velocities of GNSS, -1 for all else: the humble lane does not hear it."""
    if stream in (Stream.GNSS_POSITION, Stream.PSEUDORANGE):
        return 0
    if stream in (Stream.GNSS_VELOCITY, Stream.RANGE_RATE):
        return 1
    return -1


@njit
def receiver_of(aid):
    """Return the index of the receiver of a message; the source of a range is its satellite, of the first receiver."""
    return 0 if aid.stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE) else aid.source


@njit
def other_stream(stream):
    """Return the stream of the other kind of the same receiver: velocities for positions, positions for velocities."""
    if stream == Stream.GNSS_POSITION:
        return Stream.GNSS_VELOCITY.value
    if stream == Stream.GNSS_VELOCITY:
        return Stream.GNSS_POSITION.value
    return Stream.RANGE_RATE.value if stream == Stream.PSEUDORANGE else Stream.PSEUDORANGE.value


@njit
def is_jump(nis, kind, work):
    """Say whether the innovation in ``work`` is impossible, and larger than the errors that receivers do not claim."""
    return not nis <= JUMP_GATE and not is_small(kind, work)


@njit
def is_small(kind, work):
    """Say whether the innovation in ``work`` is within the errors that receivers do not claim."""
    x, y, z = work.innovation[0], work.innovation[1], work.innovation[2]
    return x * x + y * y + z * z <= LEAST_JUMP[kind] ** 2


@njit
def note_jump(state, aid, kind, work):
    """Count a message that jumps; return whether those refused have agreed for long enough to be believed, and why.

    0: they have not; `RECEIVER_STEPPED`: the offset stayed the same; `IMU_ASTRAY`: it grew, or both kinds of messages
    of the receiver contradict the IMU.

    ``work`` holds its innovation in the filter, and its noise. Offsets that stay the same are those of a
    receiver that has stepped aside; offsets that grow come from an IMU that goes astray, unless the velocities of the
    same receiver agree with the IMU.
    """
    trust, source = state.trust, receiver_of(aid)
    # Without a heading the velocity comes from the same receiver: nothing backs the IMU.
    is_backed = state.heading_known == 1 and is_other_agreeing(state, aid.stream, source)
    dt = (aid.stamp - trust.refused_stamp[kind, source]) * 1e-9
    passed = (aid.stamp - trust.refused_since[kind, source]) * 1e-9
    rate = OPENED_VELOCITY_STD if kind == 0 else OPENED_ACCELERATION_STD
    follows, stays, grows = 0.0, 0.0, 0.0
    for i in range(3):
        variance = state.covariance[VELOCITY + i, VELOCITY + i] if kind == 0 else OPENED_ACCELERATION_STD**2
        variance = BACKED_VELOCITY_STD**2 if is_backed and kind == 0 else variance
        noise = 2.0 * work.noise[i, i]
        follows += (work.innovation[i] - trust.refused_innovation[kind, source, i]) ** 2 / (noise + (rate * dt) ** 2)
        grows += (work.innovation[i] - trust.first_innovation[kind, source, i]) ** 2 / noise
        stays += (work.innovation[i] - trust.first_innovation[kind, source, i]) ** 2 / (noise + variance * passed**2)
    agrees = stays <= AGREEMENT_GATE or (follows <= AGREEMENT_GATE and not is_backed)
    if trust.refused[kind, source] == 0 or not agrees:
        if trust.refused[kind, source] == 0:
            trust.jumps[kind, source] += 1
        trust.refused[kind, source] = 0
        trust.refused_since[kind, source] = aid.stamp
        for i in range(3):
            trust.first_innovation[kind, source, i] = work.innovation[i]
            trust.change[kind, source, i] = 0.0
            trust.refused_innovation[kind, source, i] = work.innovation[i]
    trust.refused[kind, source] += 1
    trust.refused_stamp[kind, source] = aid.stamp
    square = 0.0
    for i in range(3):
        change = abs(work.innovation[i] - trust.refused_innovation[kind, source, i])
        trust.change[kind, source, i] = max(trust.change[kind, source, i], change)
        trust.refused_innovation[kind, source, i] = work.innovation[i]
        square += work.innovation[i] ** 2
    trust.jump[kind, source] = max(trust.jump[kind, source], math.sqrt(square))
    lasted = aid.stamp - trust.refused_since[kind, source]
    is_alone = not is_live(state, other_stream(aid.stream), source)
    # A heading that was given and that no motion has confirmed is more likely wrong than velocities.
    is_turned = kind == 1 and grows > AGREEMENT_GATE and state.heading.given_stamp != NEVER
    is_apart = (is_alone and stays > AGREEMENT_GATE) or is_turned
    is_apart = is_apart or is_other_refused(state, aid.stream, source) or state.heading_known == 0
    patience = SHORT_PATIENCE if is_apart else patience_for(state, aid.stream, source)
    if trust.refused[kind, source] < FEWEST or lasted < patience:
        return 0
    return IMU_ASTRAY if is_apart or kind == 1 else RECEIVER_STEPPED


@njit
def is_other_refused(state, stream, source):
    """Say whether the other kind of message of a receiver contradicts the lanes for as long: then the IMU is wrong."""
    return is_live(state, other_stream(stream), source) and state.trust.refused[1 - kind_of(stream), source] >= FEWEST


@njit
def is_other_agreeing(state, stream, source):
    """Say whether the other kind of message of a receiver comes and agrees with the humble lane."""
    return is_live(state, other_stream(stream), source) and state.trust.refused[1 - kind_of(stream), source] == 0


@njit
def has_velocity(state, stream, source):
    """Say whether velocities come beside the positions of a receiver: its own, of wheels, or in body axes."""
    is_carried = is_live(state, Stream.WHEEL.value, 0) or is_live(state, Stream.BODY_VELOCITY.value, 0)
    return is_carried or is_live(state, other_stream(stream), source)


@njit
def rival_offset(state):
    """Return how far (m; x and y of map) fixes that are refused, but agree with each other, are from the estimate.

    They are those of the first receiver. Zero before `RIVAL_TIME`, and where other positions are accepted meanwhile:
    otherwise it is not known which of the two is right.
    """
    trust = state.trust
    lasted = trust.refused_stamp[0, 0] - trust.refused_since[0, 0]
    is_alone = state.recovery.absolute_stamp < trust.refused_since[0, 0]
    if trust.refused[0, 0] < FEWEST or lasted < RIVAL_TIME or not is_alone:
        return 0.0, 0.0
    return trust.refused_innovation[0, 0, 0], trust.refused_innovation[0, 0, 1]


@njit
def patience_for(state, stream, source):
    """Return the time (ns) for which offsets that stay the same must last: as long as the stream was believed before.

    Right after an outage or a start there is little that speaks against them. Nor is there against positions where the
    IMU is doubted and no velocity backs it: they may have drawn the filter away, and be back.
    """
    if kind_of(stream) == 0 and state.doubt > 0.0 and not has_velocity(state, stream, source):
        return SHORT_PATIENCE
    support = state.streams.fused_stamp[stream, source] - state.streams.fused_since[stream, source]
    return min(max(support, SHORT_PATIENCE), LONG_PATIENCE)
