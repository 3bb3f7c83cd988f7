"""Fusion of one measurement, from the timeline to its verdict; `linearize` lists the measurement models."""

from __future__ import annotations

from eskf_ros.compiled import njit, njit_in_caller
from eskf_ros.filter.alignment.first_fix import reset_position_to_fix
from eskf_ros.filter.alignment.heading import reset_heading_from_memory, search_heading
from eskf_ros.filter.alignment.heading_course import reset_contradicted_heading
from eskf_ros.filter.alignment.heading_from_wheels import search_with_wheels
from eskf_ros.filter.alignment.heading_sensors import update_unknown_heading
from eskf_ros.filter.alignment.levelling import reset_level_to_moving
from eskf_ros.filter.history.timeline import open_record
from eskf_ros.filter.inertial.navigation_frame import heading_of
from eskf_ros.filter.integrity.fix_errors import forget_spread
from eskf_ros.filter.integrity.heading_monitor import (
    watch_course,
    watch_field,
    watch_given_heading,
    watch_heading,
    watch_slip,
)
from eskf_ros.filter.integrity.heading_trial import restart_trial
from eskf_ros.filter.integrity.installation_monitor import find_faults, learn_faults
from eskf_ros.filter.integrity.motion_monitor import watch_motion
from eskf_ros.filter.integrity.receiver import fuse_receiver, reset_for_new_solution
from eskf_ros.filter.integrity.receiver_monitor import watch_receiver
from eskf_ros.filter.integrity.recovery import note, recover
from eskf_ros.filter.integrity.repeated_fixes import is_repeated, note_copy, note_fused_fix
from eskf_ros.filter.integrity.restart import reset_to_level
from eskf_ros.filter.measurements import (
    baro,
    body_velocity,
    gnss_position,
    gnss_velocity,
    heading,
    mag,
    nhc,
    wheel,
    zaru,
    zupt,
)
from eskf_ros.filter.measurements.kalman_update import update
from eskf_ros.filter.measurements.row import NEEDS_FIELD, NEEDS_HEADING, NEEDS_POSITION
from eskf_ros.filter.measurements.stamp_noise import note_cut_stamp
from eskf_ros.filter.output.local_odometry import note_jump
from eskf_ros.filter.state.augmented_states import update_error_size
from eskf_ros.filter.state.enums import SENSOR_STREAMS, Stream, Verdict
from eskf_ros.filter.state.lanes import FILTER, HUMBLE
from eskf_ros.filter.stationarity.detector import update_rest_evidence, watch_rest, watch_wheels
from eskf_ros.filter.stationarity.static_window import update_evidence_from_fix, update_evidence_from_velocity
from eskf_ros.geodesy.rotation import wrapped

MEASUREMENTS = (
    gnss_position.ROW,
    gnss_velocity.ROW,
    heading.ROW,
    mag.ROW,
    wheel.ROW,
    body_velocity.ROW,
    baro.ROW,
    zupt.ROW,
    zaru.ROW,
    nhc.ROW,
)
"""The rows of the measurements that `linearize` knows; the signals of satellites are in `tight`."""

UNKNOWN_STREAM = -1
"""Size for a stream without a branch in `linearize`: its messages are refused with a record, never fused."""


@njit_in_caller
def fuse(states, aids, i, settings, work):
    """Fuse or refuse one measurement; write the verdict to its record."""
    state = states[FILTER]
    if not open_record(aids, i):
        note_cut_stamp(state, aids, i)
        return
    aid = aids[i]
    if is_repeated(state, aid):
        aid.verdict = Verdict.REPEATED
        note_copy(state, aid, settings)
        return
    if aid.stream == Stream.GNSS_POSITION:
        gnss_position.fill_altitude(state, aid.payload, aid.source, settings)
    # What came before the first sample that counts must leave no trace, and no window may begin with it.
    if state.level_known == 1 and watch_motion(state, aid, settings):
        # The filter has followed velocities in other axes.
        reset_to_level(state)
        forget_spread(state, states[HUMBLE], settings)
    if aid.stream == Stream.GNSS_VELOCITY and aid.source == 0 and state.motion.has_other_axes == 1:
        aid.verdict = Verdict.CONTRADICTED
        return
    update_motion_evidence(state, aid, settings)
    if aid.stream == Stream.GNSS_POSITION and state.level_known == 1 and state.position_known == 0:
        begin(state, aid, settings)
    position_before = (state.position_map[0], state.position_map[1], state.position_map[2])
    heading_before, given_before = heading_of(state, settings), state.heading.given_stamp
    offer(states, aid, heading_before, settings, work)
    watch_given_heading(state, given_before, wrapped(heading_of(state, settings) - heading_before))
    note_jump(state, position_before, heading_before, settings)


@njit_in_caller
def offer(states, aid, heading_before, settings, work):
    """Fuse one measurement or refuse it; ``heading_before`` (rad) is the predicted heading."""
    state = states[FILTER]
    if not is_aligned_for(state, settings.needs[aid.stream]):
        wait_for_alignment(state, aid, settings, work)
        return
    if aid.stream == Stream.HEADING and aid.source == heading.IMU_ORIENTATION and state.heading_known == 1:
        # It comes from the same IMU: useful for the initial heading, no new information afterwards.
        aid.verdict = Verdict.INACTIVE
        return
    update_error_size(state, settings.reach[aid.stream], settings)
    gate = settings.gate[aid.stream, 3]
    is_gnss = aid.stream in (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY)
    if is_gnss:
        reset_for_new_solution(states, aid, settings, work)
        fuse_receiver(states, aid, gate, settings, work)
        size = aid.dof
    else:
        size = measure(state, aid, heading_before, settings, work)
        if size == 0:
            return
        gate = settings.gate[aid.stream, size]
        aid.verdict, aid.nis = update(state, size, gate, work)
        recover(state, aid, settings, work)
    if aid.verdict != Verdict.BAD_COVARIANCE:
        learn_faults(state, aid, size, gate, work, settings)
        find_faults(state, work)
        if is_gnss:
            watch_receiver(state, aid, work, settings)
            reset_contradicted_heading(state, settings)
    if aid.verdict == Verdict.FUSED and state.heading_known == 0:
        search_heading(state, aid, gate, settings, work)
    if aid.stream == Stream.GNSS_POSITION:
        note_fused_fix(state, aid)
        mag.note_field(state, aid, mag.FIELD)
    elif aid.stream == Stream.WHEEL:
        watch_wheels(state, aid)
    elif aid.stream == Stream.ZUPT:
        watch_rest(state, aid.verdict)
        if aid.verdict == Verdict.FUSED:
            restart_trial(states, settings)


@njit
def update_motion_evidence(state, aid, settings):
    """Look in a measurement for motion, rest, position and course: all count even if the measurement is refused."""
    if aid.stream == Stream.GNSS_POSITION:
        if update_evidence_from_fix(state, aid):
            reset_level_to_moving(state, settings)
        watch_slip(state, heading_of(state, settings))
    elif aid.stream == Stream.GNSS_VELOCITY:
        if update_evidence_from_velocity(state, aid):
            reset_level_to_moving(state, settings)
        watch_course(state, aid, heading_of(state, settings), settings)
    if update_rest_evidence(state, aid):
        reset_level_to_moving(state, settings)


@njit_in_caller
def wait_for_alignment(state, aid, settings, work):
    """Refuse a measurement that comes before its alignment; wheels take part in the search for the heading."""
    if aid.stream == Stream.WHEEL:
        search_with_wheels(state, aid.payload, settings.gate[Stream.WHEEL.value, 2], settings, work)
        watch_wheels(state, aid)
    aid.verdict = Verdict.BEFORE_ALIGNMENT if aid.stream < SENSOR_STREAMS else Verdict.INACTIVE


@njit_in_caller
def begin(state, aid, settings):
    """Set the position to the first fix, and the heading from memory if the robot is where it was left."""
    position = (state.position_map[0], state.position_map[1], state.position_map[2])
    heading_before = heading_of(state, settings)
    reset_position_to_fix(state, aid.payload)
    reset_heading_from_memory(state, aid.payload, settings)
    note_jump(state, position, heading_before, settings)


@njit_in_caller
def measure(state, aid, heading_before, settings, work):
    """Write innovation, Jacobian and noise to ``work``; return the size, or 0 with a verdict for what is not fused.

    A heading sensor may set the unknown heading here; its measurement is then linearized anew.
    """
    if aid.stream == Stream.MAG:
        mag.propagate_mag_error(state, heading_before, settings)
        is_disturbed = mag.update_disturbance(state, aid, settings)
        watch_field(state, is_disturbed)
        if is_disturbed:
            aid.verdict = Verdict.GATE
            note(state, Stream.MAG.value, aid.source, Verdict.GATE.value)
            return 0
    size = linearize(state, aid, settings, work)
    if size == UNKNOWN_STREAM:
        aid.verdict = Verdict.DISABLED
        return 0
    if size == 0:
        aid.verdict = Verdict.INACTIVE
        return 0
    if aid.stream in (Stream.HEADING, Stream.MAG):
        watch_heading(state, aid, work)
        if state.heading_known == 0:
            if not update_unknown_heading(state, aid, settings, work):
                aid.verdict = Verdict.BEFORE_ALIGNMENT
                return 0
            size = linearize(state, aid, settings, work)
    for k in range(size):
        aid.innovation[k] = work.innovation[k]
    aid.dof = size
    return size


@njit
def is_aligned_for(state, needs):
    """Say whether the alignment has what a measurement needs (sum of NEEDS_... of its row)."""
    if state.level_known == 0:
        return False
    if needs & NEEDS_POSITION and state.position_known == 0:
        return False
    if needs & NEEDS_HEADING and state.heading_known == 0:
        return False
    return not (needs & NEEDS_FIELD and state.mag.field_known == 0)


@njit
def linearize(state, aid, settings, work):
    """Write innovation, Jacobian and noise of one measurement to ``work``; return its size.

    Size 0: the measurement says nothing in this state. `UNKNOWN_STREAM`: there is no model for the stream.
    """
    if aid.stream == Stream.GNSS_POSITION:
        return gnss_position.linearize(state, aid.payload, aid.source, settings, work)
    if aid.stream == Stream.WHEEL:
        return wheel.linearize(state, aid.payload, settings, work)
    if aid.stream == Stream.BODY_VELOCITY:
        return body_velocity.linearize(state, aid.payload, settings, work)
    if aid.stream == Stream.ZUPT:
        return zupt.linearize(state, settings, work)
    if aid.stream == Stream.ZARU:
        return zaru.linearize(state, settings, work)
    if aid.stream == Stream.NHC:
        return nhc.linearize(state, settings, work)
    if aid.stream == Stream.HEADING:
        return heading.linearize(state, aid.payload, aid.source, settings, work)
    if aid.stream == Stream.MAG:
        return mag.linearize(state, aid.payload, settings, work)
    if aid.stream == Stream.BARO:
        return baro.linearize(state, aid.payload, aid.source, settings, work)
    if aid.stream == Stream.GNSS_VELOCITY:
        return gnss_velocity.linearize(state, aid.payload, aid.source, settings, work)
    return UNKNOWN_STREAM
