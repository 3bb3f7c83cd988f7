"""Fusion of the signals of one epoch, which say more together than one by one.

Each signal is a measurement of its own and goes through the one update. Before that the epoch is examined as a whole,
because a jump of the receiver clock, a wrong state and a wrong satellite look the same to a single signal. Everything
here is a function of the state and of the signals with one stamp, in their total order.

- A common innovation of whole milliseconds is a jump of the receiver clock; any other common innovation is a clock that
  was set anew. Neither costs a satellite.
- More than half of at least `FEWEST_TO_JUDGE` satellites outside their gates: the state is wrong, or all ranges are by
  an error that lasts. The variances of both are inflated by what they show.
- A single satellite outside its gate is rejected (fault exclusion); from `HUBER` standard deviations up to the gate its
  noise is inflated (Huber, Robust Statistics, section 7.8).

Least squares over the epoch alone give the first position, evidence for the static windows and the heading search, and
outliers where the state is too uncertain to tell them.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit, njit_in_caller
from eskf_ros.filter.alignment.heading import search_with
from eskf_ros.filter.alignment.heading_course import reset_contradicted_heading
from eskf_ros.filter.alignment.levelling import reset_level_to_moving
from eskf_ros.filter.history.timeline import open_record
from eskf_ros.filter.inertial.navigation_frame import body_rate, heading_of
from eskf_ros.filter.integrity.humble_lane import hear, reset_to_humble_lane, weigh_evidence
from eskf_ros.filter.integrity.humble_lane import linearize as linearize_solution
from eskf_ros.filter.integrity.humble_lane import start as start_humble_lane
from eskf_ros.filter.integrity.recovery import note, note_epoch
from eskf_ros.filter.measurements import mag
from eskf_ros.filter.measurements.kalman_update import judge, update
from eskf_ros.filter.output.local_odometry import note_jump
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import POSITION, VELOCITY
from eskf_ros.filter.state.lanes import FILTER, HUMBLE, is_judging
from eskf_ros.filter.stationarity.detector import note_seen
from eskf_ros.filter.stationarity.seen_motion import see_velocity
from eskf_ros.filter.stationarity.static_window import (
    MEASURED_SPEED,
    VELOCITY_SIGMAS,
    update_evidence_from_place,
    update_motion,
)
from eskf_ros.filter.tight.epoch_least_squares import (
    FEWEST_TO_SOLVE,
    HUBER,
    MEDIAN_OF_SQUARES,
    gather,
    linearize,
    median,
    outside,
    reject_outliers,
    solve_epoch,
    spread_of,
)
from eskf_ros.filter.tight.first_position import POOREST_STD, note_coarsely, start
from eskf_ros.filter.tight.receiver_clock import join_offsets, reset_clock, reset_or_jump_clock
from eskf_ros.filter.tight.signal import (
    FIELD,
)
from eskf_ros.geodesy.rotation import cross, dot, rotate, to_matrix

FEWEST_TO_JUDGE = 5
"""Satellites, at least, whose majority outvotes the state."""

STATE_SHARE = 0.05
"""Share of the variance that the position gains where the error that all ranges have in common is estimated, too: more
often than the state it is reflections that are wrong, and the next epochs have them as well."""

FEWEST_FOR_CLOCK = 3
"""Satellites, at least, that show a clock that was set anew."""


WIDE = (30.0, 3.0)
"""Standard deviation per axis of position (m) and velocity (m/s) beyond which the state cannot tell outliers."""


@njit
def is_range(stream):
    """Say whether a stream carries the signals of satellites."""
    return stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE)


@njit
def end_of_epoch(aids, first, count):
    """Return the index after the signals with stamp and stream of ``aids[first]``; ``count`` measurements are there."""
    end = first + 1
    while end < count and aids[end].stamp == aids[first].stamp and aids[end].stream == aids[first].stream:
        end += 1
    return end


@njit_in_caller
def fuse_ranges(states, aids, first, end, settings, work):
    """Fuse or refuse the signals ``aids[first:end]`` of one stream and epoch; write the verdict to each record."""
    state = states[FILTER]
    waiting = False
    for i in range(first, end):
        if open_record(aids, i):
            waiting = True
    if not waiting:
        return
    position = (state.position_map[0], state.position_map[1], state.position_map[2])
    heading = heading_of(state, settings)
    offer_epoch(states, aids, first, end, 0 if aids[first].stream == Stream.PSEUDORANGE else 1, settings, work)
    reset_contradicted_heading(state, settings)
    note_jump(state, position, heading, settings)


@njit_in_caller
def offer_epoch(states, aids, first, end, which, settings, work):
    """Fuse or refuse the pseudoranges (``which`` 0) or range rates (1) of an epoch, start and clock included."""
    state = states[FILTER]
    if state.level_known == 0:
        note_coarsely(state, aids, first, end, which, settings, work)
    elif state.position_known == 0 and which == 0:
        start(state, aids, first, end, settings, work)
    if state.level_known == 0 or state.position_known == 0:
        for i in range(first, end):
            if aids[i].verdict == Verdict.WAITING:
                aids[i].verdict = Verdict.BEFORE_ALIGNMENT
        return
    join_offsets(state, aids, first, end, settings)
    gather(state, aids, first, end, settings, work)
    reset_or_jump_clock(state, aids, first, end, which, settings, work)
    is_wrong = False
    solved = solve_epoch(work) and spread_of(work) < POOREST_STD
    if solved:
        note_solution(state, aids[first].stamp, which, settings, work)
        is_wrong = hear_solution(states, aids[first], which, settings, work)
    if solved and is_wide(state, which):
        reject_outliers(aids, work)
    else:
        inflate_or_reset_by_majority(state, aids, first, end, which, settings, work)
    fused = 0
    for i in range(first, end):
        if aids[i].verdict == Verdict.WAITING:
            fuse_signal(state, aids[i], settings, work)
            if aids[i].verdict in (Verdict.FUSED, Verdict.WEIGHED_DOWN):
                fused += 1
                mag.note_field(state, aids[i], FIELD)
    if is_wrong:
        reset_to_humble_lane(states, False, work)
        fused_as = Verdict.TAKEOVER.value
    else:
        fused_as = Verdict.FUSED.value
    if which == 1:
        note(state, Stream.RANGE_RATE.value, 0, fused_as if fused >= FEWEST_TO_SOLVE else Verdict.GATE.value)
    elif fused >= FEWEST_TO_SOLVE:
        note_epoch(state, fused_as)
    elif work.signal_count >= FEWEST_TO_JUDGE and 2 * fused < work.signal_count:
        note_epoch(state, Verdict.GATE.value)


@njit
def fuse_signal(state, aid, settings, work):
    """Fuse one signal in full or with inflated noise, or refuse it."""
    if linearize(state, aid, settings, work) == 0:
        aid.verdict = Verdict.LOW_ELEVATION
        return
    gate = settings.gate[aid.stream, 1]
    aid.dof = 1
    aid.innovation[0] = work.innovation[0]
    aid.verdict, aid.nis = update(state, 1, min(gate, HUBER * HUBER), work)
    if aid.verdict == Verdict.GATE and aid.nis <= gate:
        work.noise[0, 0] *= math.sqrt(aid.nis) / HUBER
        update(state, 1, math.inf, work)
        aid.verdict = Verdict.WEIGHED_DOWN


@njit
def inflate_or_reset_by_majority(state, aids, first, end, which, settings, work):
    """Reset the clock or inflate position or velocity, if most satellites contradict the state.

    A common innovation is a clock that was set anew. Otherwise the variance of position or velocity and of the clock
    gains the median of the squared innovations, scaled to a variance; so does the common error of the ranges, and then
    the position `STATE_SHARE` of it.
    """
    count, gate = work.signal_count, settings.gate[aids[first].stream, 1]
    if count < FEWEST_FOR_CLOCK or 2 * outside(work, 0.0, gate) <= count:
        return
    common = median(work.signal_innovation, count, work)
    apart = outside(work, common, gate)
    if apart == 0 or (count >= FEWEST_TO_JUDGE and 2 * apart <= count):
        reset_clock(state, which, common, settings)
        gather(state, aids, first, end, settings, work)
    elif count >= FEWEST_TO_JUDGE:
        state.tight.range_faults += 1
        for k in range(count):
            work.signal_square[k] = work.signal_innovation[k] ** 2
        fault = median(work.signal_square, count, work) / MEDIAN_OF_SQUARES
        block, place = POSITION if which == 0 else VELOCITY, settings.position_error_at
        can_last = which == 0 and place < state.error_size
        for i in range(3):
            state.covariance[block + i, block + i] += STATE_SHARE * fault if can_last else fault
            if can_last:
                state.covariance[place + i, place + i] += fault / settings.pseudorange.error_std[i] ** 2
        state.covariance[settings.clock_at + which, settings.clock_at + which] += fault


@njit
def is_wide(state, which):
    """Say whether position (``which`` 0) or velocity (1) is too uncertain to tell outliers."""
    block = POSITION if which == 0 else VELOCITY
    p = state.covariance
    variance = p[block, block] + p[block + 1, block + 1] + p[block + 2, block + 2]
    return variance > 3.0 * WIDE[which] ** 2


@njit
def note_solution(state, stamp, which, settings, work):
    """Use the solution of the epoch alone as evidence for the static windows and in the heading search."""
    step = (work.step[0], work.step[1], work.step[2])
    std = math.sqrt(max(work.normal[0, 0], work.normal[1, 1], work.normal[2, 2]))
    rotation = to_matrix(state.attitude)
    arm = settings.lever_arms_body[0]
    lever = rotate(rotation, arm)
    if which == 0:
        base = state.position_map
    else:
        lever = rotate(rotation, cross(body_rate(state, rotation), arm))
        base = state.velocity_map
    measured = (base[0] + lever[0] + step[0], base[1] + lever[1] + step[1], base[2] + lever[2] + step[2])
    for i in range(3):
        work.solution[i] = measured[i]
        for j in range(3):
            work.solution_covariance[i, j] = work.normal[i, j]
    if which == 0:
        offset = rotate(state.frame.map_to_ecef, measured)
        origin = state.frame.origin_ecef
        ecef = (origin[0] + offset[0], origin[1] + offset[1], origin[2] + offset[2])
        if update_evidence_from_place(state, ecef, std, stamp, 0):
            reset_level_to_moving(state, settings)
    else:
        speed = math.sqrt(dot(measured, measured))
        if update_motion(state, speed - VELOCITY_SIGMAS * std, stamp, stamp, MEASURED_SPEED):
            reset_level_to_moving(state, settings)
        variances = (work.normal[0, 0], work.normal[1, 1], work.normal[2, 2])
        note_seen(state, stamp, see_velocity(state, 0, stamp, measured, variances))
    if state.heading_known == 0:
        for i in range(3):
            for j in range(3):
                work.noise[i, j] = work.normal[i, j]
        stream = Stream.PSEUDORANGE.value if which == 0 else Stream.RANGE_RATE.value
        search_with(state, 2 * which, measured, lever, settings.gate[stream, 3], settings, work)


@njit
def hear_solution(states, aid, which, settings, work):
    """Let the humble lane hear the solution of an epoch; return whether it shows that the filter is wrong.

    The filter is judged by the same solution before it fuses the signals. A solution that jumps is left to the tests of
    the signals.
    """
    start_humble_lane(states, settings)
    if not is_judging(states):
        return False
    state = states[FILTER]
    size = linearize_solution(state, aid, settings, work)
    nis, determinant = judge(state, size, work)
    gate = settings.gate[aid.stream, 3]
    jumps, believed, humble_nis, humble_log = hear(states, aid, gate, settings, work)
    if believed:
        return True
    if jumps or states[HUMBLE].heading_known == 0 or determinant == 0.0:
        return False
    return weigh_evidence(states, aid, nis, math.log(determinant), humble_nis, humble_log, settings)
