"""The timeline: messages of the last seconds in one total order, and checkpoints for out-of-sequence messages.

The order is (stamp, stream rank, source, admission, payload). IMU samples and measurements wait in two sorted buffers.
A checkpoint is a copy of the whole state right after an IMU sample and before the measurements of the same stamp. A
message that arrives behind the state only marks how far to go back: the next advance restores the newest checkpoint
before it and applies again all that follows. The result is therefore a function of the sorted contents alone.

Constraints (rest, no side slip), which no sensor sends, are sorted among the measurements on a grid of stamps, wherever
IMU samples are close together.

A message is in time if its stamp is not older than the newest IMU stamp (the frontier) minus the window.

Over 400 lines: total order, rewind and window are one invariant, and are read together.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.state.enums import CONSTRAINT_INTERVAL, SENSOR_STREAMS, Verdict
from eskf_ros.filter.state.lanes import FILTER, LANES
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER

EARLY_AIDS = 4096
"""Measurements that may wait for the first IMU sample, at most."""

CHECKPOINT_SPACING = 16
"""IMU samples between two checkpoints: a rewind repeats at most this many in vain. A copy of the state costs as much as
half a sample.
"""

LARGEST_FORCE = 1000.0
"""m/s2; no strapdown IMU on a robot reads more."""

LARGEST_RATE = 100.0
"""rad/s; no strapdown IMU on a robot reads more."""

LARGEST_JUMP = 10_000_000_000
"""ns; an IMU stamp further from the frontier is not believed until `JUMP_CONFIRMATIONS` samples confirm it."""

JUMP_CONFIRMATIONS = 10
"""IMU samples in a row that must follow each other at the new time to confirm a jump of the stamps."""

LONGEST_STEP = 1_000_000_000
"""ns; longest interval between two samples that confirm a jump."""


@njit
def oldest_in_time(timeline):
    """Return the oldest stamp (ns) that is still accepted: within the window, and after the last barrier."""
    return max(timeline.frontier - timeline.window, timeline.barrier)


@njit
def rewind(states, checkpoints, timeline, blank):
    """Restore the newest checkpoint that knows nothing later than what has come in, or ``blank``; drop the later ones.

    That is at ``timeline.rewind_to`` at the latest, and its last IMU sample is stamped ``timeline.rewind_sample`` at
    the latest.
    """
    state = states[FILTER]
    if timeline.rewind_to > state.stamp and timeline.rewind_sample > state.stamps.raw:
        timeline.rewind_to = timeline.rewind_sample = -NEVER
        return
    count = timeline.checkpoint_count
    while count > 0 and (
        checkpoints[count - 1, FILTER].stamp > timeline.rewind_to
        or checkpoints[count - 1, FILTER].stamps.raw > timeline.rewind_sample
    ):
        count -= 1
    timeline.checkpoint_count = count
    timeline.since_checkpoint = 0
    timeline.rewind_to = timeline.rewind_sample = -NEVER
    for lane in range(LANES):
        if count > 0:
            states[lane] = checkpoints[count - 1, lane]
        else:
            states[lane] = blank[lane]


@njit
def save_checkpoint(states, checkpoints, timeline):
    """Save a checkpoint after every `CHECKPOINT_SPACING` IMU samples."""
    if timeline.checkpoint_count > 0:
        timeline.since_checkpoint += 1
        if timeline.since_checkpoint < CHECKPOINT_SPACING:
            return
    for lane in range(LANES):
        checkpoints[timeline.checkpoint_count, lane] = states[lane]
    timeline.checkpoint_count += 1
    timeline.since_checkpoint = 0


@njit
def is_bad_value(force, rate):
    """Say whether an IMU sample is not finite or beyond anything a robot does."""
    for i in range(3):
        if not (abs(force[i]) < LARGEST_FORCE and abs(rate[i]) < LARGEST_RATE):
            return True
    return False


@njit
def is_far(timeline, stamp, started):
    """Say whether an IMU stamp is so far from the frontier that one of the two must be wrong.

    A stamp far behind counts only until the attitude is level (``started``) or a barrier stands: until then nothing was
    published, and the frontier may come from one wrong stamp. Later such a sample is late. No message in time is ever
    far.
    """
    if timeline.frontier == NEVER:
        return False
    behind = timeline.frontier - stamp
    if started == 1 or timeline.barrier != NEVER:
        return behind < -LARGEST_JUMP
    return behind < -LARGEST_JUMP or behind > max(LARGEST_JUMP, timeline.window)


@njit
def confirm_jump(timeline, stamp):
    """Count a sample far from the frontier; say whether `JUMP_CONFIRMATIONS` of them in a row follow each other."""
    follows = 0 < stamp - timeline.elsewhere_stamp <= LONGEST_STEP
    timeline.elsewhere_count = timeline.elsewhere_count + 1 if follows else 1
    timeline.elsewhere_stamp = stamp
    return timeline.elsewhere_count >= JUMP_CONFIRMATIONS


@njit
def begin_again(aids, timeline):
    """Drop all IMU samples: the next advance starts from the blank state, with the measurements that sensors sent."""
    kept = timeline.recorded
    for i in range(timeline.recorded, timeline.aid_count):
        if aids[i].stream < SENSOR_STREAMS:
            aids[kept] = aids[i]
            kept += 1
    timeline.aid_count = kept
    timeline.imu_count = 0
    timeline.frontier = NEVER
    timeline.published = NEVER
    timeline.furthest_late = 0
    timeline.rewind_to = timeline.rewind_sample = NEVER


@njit
def insert_imu(imu, aids, timeline, locals_, settings_, stamps, specific_force, angular_rate, first):
    """Sort the samples from ``first`` on into the buffer; return the index of the first one that no longer fits.

    Each is checked: finite, possible, stamp neither too old nor absurdly far from the others. Of two samples with one
    stamp the smaller one stays. The constraints on the grid are added with the samples around them.
    """
    t = timeline[0]
    gap = min(round(settings_[0].imu_gap * 1e9), CONSTRAINT_INTERVAL)
    k = first
    while k < len(stamps) and t.imu_count < len(imu):
        stamp = stamps[k]
        force = specific_force[k]
        rate = angular_rate[k]
        k += 1
        t.imu_offered += 1
        if is_bad_value(force, rate):
            t.imu_bad_value += 1
            continue
        if stamp <= 0:
            t.imu_bad_stamp += 1
            continue
        if is_far(t, stamp, locals_[0].started):
            if not confirm_jump(t, stamp):
                t.imu_bad_stamp += 1
                continue
            if stamp < t.frontier:
                begin_again(aids, t)
        elif stamp < oldest_in_time(t):
            t.imu_late += 1
            t.furthest_late = max(t.furthest_late, t.frontier - stamp)
            continue
        t.elsewhere_count = 0
        place = t.imu_count
        while place > 0 and imu[place - 1].stamp > stamp:
            place -= 1
        if place > 0 and imu[place - 1].stamp == stamp:
            t.imu_duplicate += 1
            if not is_smaller_sample(force, rate, imu[place - 1]):
                continue
            place -= 1
        else:
            before = imu[place - 1].stamp if place > 0 else NEVER
            after = imu[place].stamp if place < t.imu_count else NEVER
            if before == NEVER or after == NEVER or after - before > gap:
                add_constraints(aids, t, settings_[0], before, stamp, gap)
                add_constraints(aids, t, settings_[0], stamp, after, gap)
            for i in range(t.imu_count, place, -1):
                imu[i] = imu[i - 1]
            t.imu_count += 1
        imu[place].stamp = stamp
        for i in range(3):
            imu[place].specific_force[i] = force[i]
            imu[place].angular_rate[i] = rate[i]
        if stamp <= t.frontier:
            t.rewind_sample = min(t.rewind_sample, imu[place - 1].stamp if place > 0 else NEVER)
        t.frontier = max(t.frontier, stamp)
    return k


@njit
def add_constraints(aids, t, settings, after, until, gap):
    """Add the enabled constraints at the grid points in (``after``, ``until``], the stamps of two IMU samples.

    None is added if a stamp is `NEVER`, or if they are more than ``gap`` (ns) apart: the motion in a gap is unknown.
    """
    if after == NEVER or until == NEVER or until - after > gap:
        return
    point = (after // CONSTRAINT_INTERVAL + 1) * CONSTRAINT_INTERVAL
    while point <= until:
        for stream in range(SENSOR_STREAMS, len(settings.constrains)):
            if settings.constrains[stream] == 1:
                add_constraint(aids, t, stream, point)
        point += CONSTRAINT_INTERVAL


@njit
def add_constraint(aids, t, stream, stamp):
    """Sort one constraint into the buffer, which has room."""
    place = t.aid_count
    while place > 0 and (
        aids[place - 1].stamp > stamp or (aids[place - 1].stamp == stamp and aids[place - 1].stream > stream)
    ):
        place -= 1
    for i in range(t.aid_count, place, -1):
        aids[i] = aids[i - 1]
    aid = aids[place]
    aid.stamp = stamp
    aid.arrival = stamp
    aid.stream = stream
    aid.source = 0
    aid.door = Verdict.WAITING
    aid.verdict = Verdict.WAITING
    aid.dof = 0
    aid.told = 0
    for i in range(len(aid.payload)):
        aid.payload[i] = 0.0
    t.aid_count += 1
    # The state may be ahead of the stamps of the IMU.
    t.rewind_to = min(t.rewind_to, stamp)


@njit
def is_smaller_sample(force, rate, other):
    """Say whether a sample comes before another of the same stamp."""
    for i in range(3):
        if force[i] != other.specific_force[i]:
            return force[i] < other.specific_force[i]
    for i in range(3):
        if rate[i] != other.angular_rate[i]:
            return rate[i] < other.angular_rate[i]
    return False


@njit
def comes_before(a, b):
    """Say whether measurement ``a`` comes before ``b`` in the order of stamp, stream, source, admission, payload."""
    if a.stamp != b.stamp:
        return a.stamp < b.stamp
    if a.stream != b.stream:
        return a.stream < b.stream
    if a.source != b.source:
        return a.source < b.source
    if a.door != b.door:
        return a.door < b.door
    for i in range(len(a.payload)):
        if a.payload[i] != b.payload[i] and not (math.isnan(a.payload[i]) and math.isnan(b.payload[i])):
            return a.payload[i] < b.payload[i] or math.isnan(b.payload[i])
    return False


@njit
def offer_aid(aids, timeline, offered, stamp, arrival, stream, source, door):
    """Complete the record whose payload is on offer, and sort it into the buffer; return what `insert_aid` does."""
    aid = offered[0]
    aid.stamp, aid.arrival, aid.stream, aid.source = stamp, arrival, stream, source
    aid.door, aid.verdict, aid.told = door, door, 0
    # A measurement that waits in vain keeps these values in its record.
    aid.dof, aid.nis = 0, math.nan
    for k in range(3):
        aid.innovation[k] = math.nan
    return insert_aid(aids, timeline, offered)


@njit
def insert_aid(aids, timeline, offered):
    """Sort the measurement on offer into the buffer, which has room; return WAITING, or why it is refused.

    It is refused if it is too old for the window, or absurdly far ahead of the newest IMU sample.
    """
    t = timeline[0]
    aid = offered[0]
    if aid.stamp <= 0 or (t.frontier != NEVER and aid.stamp > t.frontier + LARGEST_JUMP):
        return Verdict.BAD_STAMP
    if t.frontier == NEVER and t.aid_count >= EARLY_AIDS:
        return Verdict.BEFORE_ALIGNMENT
    if t.frontier != NEVER and aid.stamp < oldest_in_time(t):
        t.furthest_late = max(t.furthest_late, t.frontier - aid.stamp)
        return Verdict.OUTSIDE_HISTORY
    place = t.aid_count
    while place > 0 and comes_before(aid, aids[place - 1]):
        place -= 1
    for i in range(t.aid_count, place, -1):
        aids[i] = aids[i - 1]
    aids[place] = aid
    t.aid_count += 1
    t.rewind_to = min(t.rewind_to, aid.stamp)
    return Verdict.WAITING


@njit
def is_duplicate(aids, i):
    """Say whether an earlier message of the same source and stream has the same stamp."""
    if i == 0:
        return False
    aid, other = aids[i], aids[i - 1]
    is_same = other.stamp == aid.stamp and other.stream == aid.stream and other.source == aid.source
    return is_same and other.door == 0


@njit
def open_record(aids, i):
    """Reset the record of a measurement; say whether it may be offered to the state."""
    aid = aids[i]
    aid.verdict = aid.door
    aid.nis = math.nan
    aid.dof = 0
    for k in range(3):
        aid.innovation[k] = math.nan
    if aid.door != Verdict.WAITING:
        return False
    if is_duplicate(aids, i):
        aid.verdict = Verdict.DUPLICATE
        return False
    return True


@njit
def latest_of(state):
    """Return the time of a checkpoint or the stamp of its last sample, whichever is later (ns)."""
    return max(state.stamp, state.stamps.raw)


@njit
def forget(states, imu, aids, checkpoints, timeline):
    """Drop what no accepted message can change: all before the newest checkpoint that is older than the window."""
    t = timeline[0]
    keep = 0
    oldest = t.frontier - t.window
    while keep + 1 < t.checkpoint_count and latest_of(checkpoints[keep + 1, FILTER]) < oldest:
        keep += 1
    if t.checkpoint_count == 0 or latest_of(checkpoints[keep, FILTER]) >= oldest:
        return
    # The sample of the checkpoint itself stays: it is the predecessor of what may still be inserted after it.
    imu_gone = checkpoints[keep, FILTER].imu_next - 1
    aid_gone = min(checkpoints[keep, FILTER].aid_next, t.recorded)
    for i in range(imu_gone, t.imu_count):
        imu[i - imu_gone] = imu[i]
    for i in range(aid_gone, t.aid_count):
        aids[i - aid_gone] = aids[i]
    for i in range(keep, t.checkpoint_count):
        for lane in range(LANES):
            checkpoints[i - keep, lane] = checkpoints[i, lane]
    t.imu_count -= imu_gone
    t.aid_count -= aid_gone
    t.recorded -= aid_gone
    t.checkpoint_count -= keep
    for i in range(t.checkpoint_count):
        checkpoints[i, FILTER].imu_next -= imu_gone
        checkpoints[i, FILTER].aid_next -= aid_gone
    states[FILTER].imu_next -= imu_gone
    states[FILTER].aid_next -= aid_gone


@njit
def raise_barrier(states, blank, timeline):
    """Make the present a barrier: nothing older is accepted, nothing rewinds past it, and the buffers are emptied.

    Before the first IMU sample there is no present: waiting measurements stay.
    """
    t = timeline[0]
    if t.frontier == NEVER:
        for lane in range(LANES):
            blank[lane] = states[lane]
        return
    states[FILTER].imu_next = 0
    states[FILTER].aid_next = 0
    # What follows is another trajectory: the pose or the datum was set.
    states[FILTER].forward.node_next = 0
    states[FILTER].forward.point_next = 0
    states[FILTER].forward.breaks = NEVER
    for lane in range(LANES):
        blank[lane] = states[lane]
    t.imu_count = 0
    t.aid_count = 0
    t.recorded = 0
    t.checkpoint_count = 0
    t.barrier = max(t.frontier, states[0].stamp) + 1


@njit
def take_final(states, aids, timeline, out, everything):
    """Copy the records that can no longer change to ``out`` (long enough); return their number.

    The state may be a little behind the frontier: what it has not judged is not final.
    """
    t = timeline[0]
    count = 0
    while t.recorded < t.aid_count:
        aid = aids[t.recorded]
        is_open = t.recorded >= states[0].aid_next or aid.stamp >= t.frontier - t.window
        if not everything and (t.frontier == NEVER or is_open):
            break
        if t.recorded >= states[0].aid_next:
            # What it was found to be before a rewind no longer counts.
            open_record(aids, t.recorded)
        is_unused = t.recorded >= states[0].aid_next and aid.stream >= SENSOR_STREAMS
        if aid.verdict == Verdict.INACTIVE or is_unused:
            t.recorded += 1
            continue
        out[count].stamp = aid.stamp
        out[count].arrival = aid.arrival
        out[count].stream = aid.stream
        out[count].source = aid.source
        out[count].verdict = aid.verdict
        out[count].dof = aid.dof
        out[count].nis = aid.nis
        for i in range(3):
            out[count].innovation[i] = aid.innovation[i]
        count += 1
        t.recorded += 1
    return count


def doubled(buffer: np.ndarray) -> np.ndarray:
    """Return a buffer of twice the size that starts with the contents of this one."""
    bigger = allocate(buffer.dtype, (2 * len(buffer), *buffer.shape[1:]))
    bigger[: len(buffer)] = buffer
    return bigger
