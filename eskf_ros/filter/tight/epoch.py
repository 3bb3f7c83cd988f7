"""Ranges: the signals of one epoch, which say more together than one by one.

Each signal is a measurement of its own and goes through the one update. Before that the epoch is looked at as a whole,
because a receiver clock that has jumped, a state that is wrong and a satellite that is wrong all look the same to a
single signal. Everything here is a function of the state and of the signals with one stamp, in their total order.

- A whole number of milliseconds in common is a jump of the receiver's clock, any other common part a clock that was
  set anew: neither costs a satellite.
- More than half of at least five satellites outside their gates: the state is wrong, not they, and is given the
  uncertainty that they show.
- A single satellite outside its gate is refused; from 2.5 standard deviations up to the gate it weighs less (Huber,
  Robust Statistics, section 7.8).

Least squares over the epoch alone give the position at the start, what the search for the heading and the stillness
windows want to know, and outliers where the state is too uncertain to tell them.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.first_fix import reset_position_to_fix
from eskf_ros.filter.alignment.heading import reset_heading_from_memory, search_with
from eskf_ros.filter.alignment.levelling import reset_level_to_moving
from eskf_ros.filter.history.timeline import offer_aid, open_record
from eskf_ros.filter.inertial.navigation_frame import body_rate, heading_of
from eskf_ros.filter.integrity.recovery import note_epoch
from eskf_ros.filter.measurements import mag
from eskf_ros.filter.measurements.kalman_update import invert_positive, project, update
from eskf_ros.filter.output.local_odometry import note_jump
from eskf_ros.filter.state.augmented_states import join, reset_augmented
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE, POSITION, VELOCITY
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.detector import weigh_speed
from eskf_ros.filter.stationarity.static_window import (
    VELOCITY_SIGMAS,
    update_evidence_from_place,
    update_motion,
)
from eskf_ros.filter.tight import pseudorange, range_rate
from eskf_ros.filter.tight.pseudorange import offset_place
from eskf_ros.filter.tight.signal import (
    CARRIER,
    CN0,
    FIELD,
    FLAGS,
    GPS_TIME,
    KLOBUCHAR,
    MEASURED,
    NOISE_FACTOR,
    SATELLITE,
    SATELLITE_VELOCITY,
    STD,
    antenna_ecef,
    see,
    source_of,
    system_of,
)
from eskf_ros.geodesy.earth import SEMI_MAJOR_AXIS, ecef_to_geodetic
from eskf_ros.geodesy.rotation import cross, dot, rotate, to_matrix
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, Status
from eskf_ros.gnss.signals import SPEED_OF_LIGHT

TIGHT = np.dtype(
    [
        ("clock_known", "i8", (2,)),
        ("clock_jumps", "i8"),
        ("range_faults", "i8"),
    ],
    align=True,
)
"""Tight coupling: whether clock bias and drift have values yet, milliseconds the clock has jumped by, and how often
most
of the satellites contradicted the state.
"""

LARGEST_EPOCH = 256
"""So many signals of an epoch are looked at together."""

LARGEST_NUMBER = 1e11
"""Beyond every range, satellite and GPS time (m, m/s, s)."""

MILLISECOND = 1e-3 * SPEED_OF_LIGHT
JUMP_TOLERANCE = 100.0
"""A clock that jumps does so by whole milliseconds, within this many m."""

LOST_CLOCK = (0.1 * MILLISECOND, 1000.0)
"""Beyond this uncertainty (m, m/s) the clock is taken from the satellites anew."""

HUBER = 2.5
"""From so many standard deviations on a signal weighs less."""

FEWEST_TO_SOLVE = 4
FEWEST_TO_JUDGE = 5
FEWEST_FOR_CLOCK = 3
FEWEST_TO_EXCLUDE = 6
"""Satellites that fix a position; of which the majority may outvote the state, tell a clock that was set anew, and show
which one of them is wrong."""

WIDE = (30.0, 3.0)
"""Standard deviation of position and velocity per axis (m, m/s) beyond which the state cannot tell outliers."""

OUTLIER = 4.0
MEDIAN_OF_SQUARES = 0.455
"""Median of the square of a standard normal variable."""

COARSE_STD = (30.0, 0.3)
"""Of a signal without atmosphere and weights (m, m/s)."""

POOREST_STD = 500.0
LOWEST_ALTITUDE = -10e3
HIGHEST_ALTITUDE = 100e3
"""A position that is one: formal standard deviation, altitudes (m)."""

UNWEIGHTED = 1e9
NEAR = 1e4
ITERATIONS = 15
REWEIGHTINGS = 20


@njit
def offer_signals(
    aids, timeline, offered, signals, stamp, arrival, gps_time, klobuchar, field, code_door, rate_door, refused
):
    """Sort the usable signals (MEASURED_SIGNAL) of one epoch into the timeline, which has room for two of each.

    ``gps_time``: s since 6 January 1980, ``klobuchar``: parameters of the ionosphere (8,), ``field``: the Earth's
    magnetic field there as `mag.note_field` wants it, zeros if unknown. Returns how many never enter; ``refused``
    (RECORD) says which and why.
    """
    payload = offered[0].payload
    count = 0
    for k in range(len(signals)):
        signal = signals[k]
        if signal["status"] != Status.USABLE:
            continue
        for stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE):
            is_code = stream == Stream.PSEUDORANGE
            if not signal["flags"] & (CODE_VALID if is_code else DOPPLER_VALID):
                continue
            source = source_of(signal["gnss_id"], signal["sv_id"], signal["signal"])
            door = code_door if is_code else rate_door
            payload[:] = 0.0
            payload[MEASURED] = signal["pseudorange"] if is_code else signal["range_rate"]
            payload[STD] = signal["code_std"] if is_code else signal["range_rate_std"]
            for i in range(3):
                payload[SATELLITE + i] = signal["satellite"][i]
                payload[SATELLITE_VELOCITY + i] = signal["satellite_velocity"][i]
            payload[FLAGS] = signal["flags"]
            payload[CARRIER] = signal["carrier_hz"]
            payload[CN0] = signal["cn0"]
            payload[NOISE_FACTOR] = signal["noise_factor"]
            payload[GPS_TIME] = gps_time
            if door == Verdict.WAITING:
                door = judge_signal(payload)
            payload[KLOBUCHAR : KLOBUCHAR + 8] = klobuchar
            payload[FIELD : FIELD + 4] = field
            verdict = offer_aid(aids, timeline, offered, stamp, arrival, stream, source, door)
            if verdict != Verdict.WAITING:
                record = refused[count]
                record["stamp"], record["arrival"], record["stream"] = stamp, arrival, stream
                record["source"], record["verdict"], record["dof"] = source, verdict, 0
                record["nis"] = math.nan
                for i in range(3):
                    record["innovation"][i] = math.nan
                count += 1
    return count


@njit
def judge_signal(payload):
    """Return whether the door is open to a signal: its numbers must be some, and no larger than they can be."""
    largest = max(abs(payload[MEASURED]), abs(payload[GPS_TIME]))
    for i in range(SATELLITE, SATELLITE_VELOCITY + 3):
        if math.isnan(payload[i]):
            return Verdict.NON_FINITE
        largest = max(largest, abs(payload[i]))
    if not math.isfinite(payload[MEASURED] + payload[GPS_TIME] + largest):
        return Verdict.NON_FINITE
    return Verdict.WAITING if largest < LARGEST_NUMBER else Verdict.BAD_VALUE


@njit
def is_range(stream):
    """Say whether a stream carries signals."""
    return stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE)


@njit
def end_of_epoch(aids, first, count):
    """Return the index behind the signals with stamp and stream of ``aids[first]``; ``count`` aids are there."""
    end = first + 1
    while end < count and aids[end].stamp == aids[first].stamp and aids[end].stream == aids[first].stream:
        end += 1
    return end


@njit
def fuse_ranges(state, aids, first, end, settings, work):
    """Offer the signals of one stream and epoch, ``aids[first:end]``; leave the verdict in the record of each."""
    waiting = False
    for i in range(first, end):
        if open_record(aids, i):
            waiting = True
    if not waiting:
        return
    position = (state.position_map[0], state.position_map[1], state.position_map[2])
    heading = heading_of(state, settings)
    offer_epoch(state, aids, first, end, 0 if aids[first].stream == Stream.PSEUDORANGE else 1, settings, work)
    note_jump(state, position, heading, settings)


@njit
def offer_epoch(state, aids, first, end, which, settings, work):
    """Fuse the signals of an epoch, pseudoranges (``which`` 0) or range rates (1), or refuse them."""
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
    solved = solve_epoch(work) and spread_of(work) < POOREST_STD
    if solved:
        note_solution(state, aids[first].stamp, which, settings, work)
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
    if which == 0 and fused >= FEWEST_TO_SOLVE:
        note_epoch(state, Verdict.FUSED.value)
    elif which == 0 and work.signal_count >= FEWEST_TO_JUDGE and 2 * fused < work.signal_count:
        note_epoch(state, Verdict.GATE.value)


@njit
def join_offsets(state, aids, first, end, settings):
    """Take the clock into use, and the offsets of the constellations that are there."""
    join(state, settings.clock_at + 2, settings)
    for i in range(first, end):
        place = offset_place(system_of(aids[i].source), settings)
        if aids[i].verdict == Verdict.WAITING and place < len(state.covariance):
            join(state, place + 1, settings)


@njit
def linearize(state, aid, settings, work):
    """Write innovation, Jacobian and noise of one signal to ``work``; return 1, or 0 below the elevation mask."""
    if aid.stream == Stream.PSEUDORANGE:
        return pseudorange.linearize(state, aid.payload, aid.source, settings, work)
    return range_rate.linearize(state, aid.payload, settings, work)


@njit
def fuse_signal(state, aid, settings, work):
    """Offer one signal to the state: in full, weighed down, or not at all."""
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
def gather(state, aids, first, end, settings, work):
    """Write what the signals that still wait say to ``work.signal_*``: innovation, its variance, noise, direction.

    The noise contains what is not known of the offset of the constellation, so that signals of all constellations can
    be compared.
    """
    count = 0
    for i in range(first, end):
        if aids[i].verdict != Verdict.WAITING or count == LARGEST_EPOCH:
            continue
        if linearize(state, aids[i], settings, work) == 0:
            aids[i].verdict = Verdict.LOW_ELEVATION
            continue
        project(state, 1, work)
        work.signal_index[count] = i
        work.signal_innovation[count] = work.innovation[0]
        work.signal_spread[count] = work.innovation_covariance[0, 0]
        noise = work.noise[0, 0]
        block = VELOCITY
        if aids[i].stream == Stream.PSEUDORANGE:
            block = POSITION
            place = offset_place(system_of(aids[i].source), settings)
            if place < state.error_size:
                noise += state.covariance[place, place]
        work.signal_noise[count] = noise
        for k in range(3):
            work.signal_direction[count, k] = work.jacobian[0, block + k]
        count += 1
    work.signal_count = count


@njit
def median(values, count, work):
    """Return the median of the first ``count`` values, 0 for none."""
    if count == 0:
        return 0.0
    for k in range(count):
        place = k
        while place > 0 and work.sorted[place - 1] > values[k]:
            work.sorted[place] = work.sorted[place - 1]
            place -= 1
        work.sorted[place] = values[k]
    return 0.5 * (work.sorted[(count - 1) // 2] + work.sorted[count // 2])


@njit
def reset_clock(state, which, shift, settings):
    """Begin again with the bias (``which`` 0, m) or the drift (1, m/s) of the clock, ``shift`` from where it was."""
    place = settings.clock_at + which
    value = state.optional[place - ERROR_SIZE] + shift
    reset_augmented(state, place, 1, settings)
    state.optional[place - ERROR_SIZE] = value
    state.tight.clock_known[which] = 1


@njit
def reset_or_jump_clock(state, aids, first, end, which, settings, work):
    """Give bias or drift a first value, and follow a jump by whole milliseconds."""
    if work.signal_count == 0:
        return
    common = median(work.signal_innovation, work.signal_count, work)
    place = settings.clock_at + which
    if state.tight.clock_known[which] == 0 or state.covariance[place, place] > LOST_CLOCK[which] ** 2:
        reset_clock(state, which, common, settings)
        gather(state, aids, first, end, settings, work)
        return
    jump = round(common / MILLISECOND)
    if which == 1 or jump == 0:
        return
    agreeing = 0
    for k in range(work.signal_count):
        off = abs(work.signal_innovation[k] - jump * MILLISECOND)
        if off < JUMP_TOLERANCE + OUTLIER * math.sqrt(work.signal_spread[k]):
            agreeing += 1
    if 2 * agreeing > work.signal_count:
        state.optional[place - ERROR_SIZE] += jump * MILLISECOND
        state.tight.clock_jumps += abs(jump)
        gather(state, aids, first, end, settings, work)


@njit
def outside(work, shift, gate):
    """Return how many of the gathered signals are outside the gate when ``shift`` is taken out of all of them."""
    count = 0
    for k in range(work.signal_count):
        if (work.signal_innovation[k] - shift) ** 2 > gate * work.signal_spread[k]:
            count += 1
    return count


@njit
def inflate_or_reset_by_majority(state, aids, first, end, which, settings, work):
    """Where most satellites contradict the state, it is the state that is wrong: the clock, or position or velocity."""
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
        block = POSITION if which == 0 else VELOCITY
        for i in range(3):
            state.covariance[block + i, block + i] += fault
        state.covariance[settings.clock_at + which, settings.clock_at + which] += fault


@njit
def is_wide(state, which):
    """Say whether position (``which`` 0) or velocity (1) are too uncertain to tell outliers."""
    block = POSITION if which == 0 else VELOCITY
    p = state.covariance
    variance = p[block, block] + p[block + 1, block + 1] + p[block + 2, block + 2]
    return variance > 3.0 * WIDE[which] ** 2


@njit
def reject_outliers(aids, work):
    """Refuse the signals that contradict the others: by their residuals, in units of what most of them show."""
    count = work.signal_count
    if count < FEWEST_TO_EXCLUDE:
        return
    scale = variance_factor(work)
    for k in range(count):
        square = work.signal_residual[k] ** 2
        if square > OUTLIER**2 * scale:
            aid = aids[work.signal_index[k]]
            aid.verdict = Verdict.GATE
            aid.dof = 1
            aid.nis = square
            aid.innovation[0] = work.signal_innovation[k]


@njit
def solve_epoch(work):
    """Solve the gathered signals for a step of position or velocity and of the clock; say whether they suffice.

    Least squares with Huber's weights, iterated; the sum it minimises is convex: where it begins does not matter. Step
    to ``work.step``, covariance to ``work.normal`` (grown where residuals are larger than the noise says), residuals in
    units of the noise to ``work.signal_residual``.
    """
    count, normal, step = work.signal_count, work.normal, work.step
    if count < FEWEST_TO_SOLVE:
        return False
    common = median(work.signal_innovation, count, work)
    for k in range(count):
        off = abs(work.signal_innovation[k] - common) / math.sqrt(work.signal_noise[k])
        work.signal_weight[k] = min(1.0, HUBER / max(off, 1e-12))
    for _ in range(REWEIGHTINGS):
        for i in range(4):
            step[i] = 0.0
            work.right[i] = 0.0
            for j in range(4):
                normal[i, j] = 0.0
        for k in range(count):
            weight = work.signal_weight[k] / work.signal_noise[k]
            for i in range(4):
                a = work.signal_direction[k, i] if i < 3 else 1.0
                work.right[i] += weight * a * work.signal_innovation[k]
                for j in range(4):
                    normal[i, j] += weight * a * (work.signal_direction[k, j] if j < 3 else 1.0)
        if not invert_positive(normal, 4):
            return False
        for i in range(4):
            for j in range(4):
                step[i] += normal[i, j] * work.right[j]
        change = 0.0
        for k in range(count):
            d = work.signal_direction[k]
            left = work.signal_innovation[k] - d[0] * step[0] - d[1] * step[1] - d[2] * step[2] - step[3]
            residual = left / math.sqrt(work.signal_noise[k])
            weight = min(1.0, HUBER / max(abs(residual), 1e-12))
            change = max(change, abs(weight - work.signal_weight[k]))
            work.signal_weight[k] = weight
            work.signal_residual[k] = residual
        if change < 1e-3:
            break
    factor = variance_factor(work)
    for i in range(4):
        for j in range(4):
            normal[i, j] *= factor
    return True


@njit
def variance_factor(work):
    """Return by how much the squares of the residuals are larger than the noise says, at least 1.

    From their median, which the outliers among them do not change much; with so few that no outlier can be told, from
    their mean.
    """
    count, total = work.signal_count, 0.0
    if count == FEWEST_TO_SOLVE:
        return 1.0
    for k in range(count):
        work.signal_square[k] = work.signal_residual[k] ** 2
        total += work.signal_square[k]
    usual = total / count
    if count >= FEWEST_TO_EXCLUDE:
        usual = median(work.signal_square, count, work) / MEDIAN_OF_SQUARES
    return max(1.0, usual * count / (count - FEWEST_TO_SOLVE))


@njit
def spread_of(work):
    """Return the standard deviation of the solved position (m) or velocity (m/s), all axes together."""
    return math.sqrt(work.normal[0, 0] + work.normal[1, 1] + work.normal[2, 2])


@njit
def note_solution(state, stamp, which, settings, work):
    """Let what the epoch alone says take part in the stillness windows and in the search for the heading."""
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
    if which == 0:
        offset = rotate(state.frame.map_to_ecef, measured)
        origin = state.frame.origin_ecef
        ecef = (origin[0] + offset[0], origin[1] + offset[1], origin[2] + offset[2])
        if update_evidence_from_place(state, ecef, std, stamp, 0):
            reset_level_to_moving(state, settings)
    else:
        speed = math.sqrt(dot(measured, measured))
        if update_motion(state, speed - VELOCITY_SIGMAS * std, stamp, stamp):
            reset_level_to_moving(state, settings)
        weigh_speed(state, stamp, speed, std, True)
    if state.heading_known == 0:
        for i in range(3):
            for j in range(3):
                work.noise[i, j] = work.normal[i, j]
        stream = Stream.PSEUDORANGE.value if which == 0 else Stream.RANGE_RATE.value
        search_with(state, 2 * which, measured, lever, settings.gate[stream, 3], settings, work)


@njit
def gather_coarsely(aids, first, end, position, which, std, work):
    """As `gather`, in ECEF axes, for an antenna at rest at ``position`` (m): no state, no atmosphere, equal noise."""
    count = 0
    for i in range(first, end):
        if aids[i].verdict != Verdict.WAITING or count == LARGEST_EPOCH:
            continue
        payload = aids[i].payload
        unit, length, rate = see(payload, position, (0.0, 0.0, 0.0))
        work.signal_index[count] = i
        work.signal_innovation[count] = payload[MEASURED] - (length if which == 0 else rate)
        work.signal_noise[count] = std * std
        for k in range(3):
            work.signal_direction[count, k] = -unit[k]
        count += 1
    work.signal_count = count


@njit
def locate_coarsely(aids, first, end, work):
    """Return whether the pseudoranges of an epoch give a position, and that (ECEF, to some ten m)."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(first, end):
        if aids[i].verdict == Verdict.WAITING:
            x += aids[i].payload[SATELLITE]
            y += aids[i].payload[SATELLITE + 1]
            z += aids[i].payload[SATELLITE + 2]
    length = math.sqrt(x * x + y * y + z * z)
    if not length > 0.0:
        return False, (0.0, 0.0, 0.0)
    # The place on the Earth below the middle of the satellites.
    scale = SEMI_MAJOR_AXIS / length
    position = (x * scale, y * scale, z * scale)
    # Far off, the residuals of the curved problem say nothing about the ranges: no weights.
    std = UNWEIGHTED
    for _ in range(ITERATIONS):
        gather_coarsely(aids, first, end, position, 0, std, work)
        if not solve_epoch(work):
            return False, position
        step = (work.step[0], work.step[1], work.step[2])
        position = (position[0] + step[0], position[1] + step[1], position[2] + step[2])
        length = math.sqrt(dot(step, step))
        if std == COARSE_STD[0] and length < 1.0:
            altitude = ecef_to_geodetic(position[0], position[1], position[2])[2]
            is_place = LOWEST_ALTITUDE < altitude < HIGHEST_ALTITUDE and spread_of(work) < POOREST_STD
            return is_place, position
        if length < NEAR:
            std = COARSE_STD[0]
    return False, position


@njit
def note_coarsely(state, aids, first, end, which, settings, work):
    """Before the attitude is level: take a motion that the epoch proves, so that it is not levelled in."""
    stamp = aids[first].stamp
    if which == 0:
        found, position = locate_coarsely(aids, first, end, work)
        if found:
            std = math.sqrt(max(work.normal[0, 0], work.normal[1, 1], work.normal[2, 2]))
            if update_evidence_from_place(state, position, std, stamp, 0):
                reset_level_to_moving(state, settings)
    elif state.window.last_fix_stamp[0] != NEVER:
        fix = state.window.last_fix_ecef[0]
        gather_coarsely(aids, first, end, (fix[0], fix[1], fix[2]), 1, COARSE_STD[1], work)
        if solve_epoch(work):
            step = (work.step[0], work.step[1], work.step[2])
            std = math.sqrt(max(work.normal[0, 0], work.normal[1, 1], work.normal[2, 2]))
            if update_motion(state, math.sqrt(dot(step, step)) - VELOCITY_SIGMAS * std, stamp, stamp):
                reset_level_to_moving(state, settings)


@njit
def start(state, aids, first, end, settings, work):
    """Take the first position from the pseudoranges of one epoch, which then make its wide prior narrow."""
    found, ecef = locate_coarsely(aids, first, end, work)
    if not found:
        return
    had_datum = state.frame.datum_known
    # Now with atmosphere, weights and the elevation mask.
    for _ in range(2):
        state.frame.datum_known = had_datum
        reset_position_to_fix(state, ecef_to_geodetic(ecef[0], ecef[1], ecef[2]))
        state.tight.clock_known[0] = 0
        join_offsets(state, aids, first, end, settings)
        gather(state, aids, first, end, settings, work)
        reset_or_jump_clock(state, aids, first, end, 0, settings, work)
        if not solve_epoch(work) or spread_of(work) > POOREST_STD:
            state.position_known = 0
            state.frame.datum_known = had_datum
            return
        antenna, _ = antenna_ecef(state, settings)
        step = rotate(state.frame.map_to_ecef, work.step)
        ecef = (antenna[0] + step[0], antenna[1] + step[1], antenna[2] + step[2])
    geodetic = ecef_to_geodetic(ecef[0], ecef[1], ecef[2])
    state.frame.datum_known = had_datum
    reset_position_to_fix(state, geodetic)
    state.tight.clock_known[0] = 0
    variance = max(work.normal[0, 0], work.normal[1, 1], work.normal[2, 2])
    fix = (geodetic[0], geodetic[1], geodetic[2], variance, 0.0, 0.0, variance, 0.0, variance)
    reset_heading_from_memory(state, fix, settings)
