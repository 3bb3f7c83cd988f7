"""The main loop of the filter: predict, detect rest, align, fuse, publish."""

from __future__ import annotations

from eskf_ros.compiled import njit, njit_in_caller
from eskf_ros.filter.alignment.levelling import update_level
from eskf_ros.filter.fuse import fuse
from eskf_ros.filter.history.timeline import rewind, save_checkpoint
from eskf_ros.filter.inertial.navigation_frame import heading_of
from eskf_ros.filter.inertial.sample_doubt import copy_doubt
from eskf_ros.filter.inertial.sample_quality import judge_sample
from eskf_ros.filter.inertial.stamps import take_stamp
from eskf_ros.filter.inertial.strapdown import SMOOTHING_TIME
from eskf_ros.filter.integrity.departure import begin_departure, extend_departure
from eskf_ros.filter.integrity.imu_monitor import watch_input, watch_interval
from eskf_ros.filter.integrity.motion_monitor import add_sample
from eskf_ros.filter.integrity.restart import reset_alignment
from eskf_ros.filter.output.forward_log import close_node, log_sample, open_node
from eskf_ros.filter.output.global_odometry import write_odometry
from eskf_ros.filter.output.local_odometry import carry, measure_step, note_jump
from eskf_ros.filter.predict import propagate
from eskf_ros.filter.state.lanes import FILTER, HUMBLE, is_running
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.filter.stationarity.detector import add_to_block
from eskf_ros.filter.stationarity.residual_motion import add_to_part
from eskf_ros.filter.stationarity.rest_noise import measure_gyro_noise
from eskf_ros.filter.stationarity.static_window import Window, close_static_window, update_static_window
from eskf_ros.filter.tight.epoch import end_of_epoch, fuse_ranges, is_range

LONGEST_GAP = 5 * SECOND
"""ns; after a longer silence of the IMU the alignment restarts: attitude and velocity are lost."""


@njit
def advance(states, imu, aids, checkpoints, timeline, blank, settings_, work_, locals_, rows, log):
    """Run the filter over all waiting messages in the total order; return the number of rows written.

    One row is written for every IMU sample that is new and is the first on the output grid.
    """
    t, settings, work, local = timeline[0], settings_[0], work_[0], locals_[0]
    rewind(states, checkpoints, t, blank)
    state = states[FILTER]
    row_count = 0
    while state.imu_next < t.imu_count:
        sample = imu[state.imu_next]
        previous_stamp = state.stamps.raw
        instant = take_stamp(state, sample.stamp)
        judge_sample(state, sample, instant, settings)

        while state.aid_next < t.aid_count and aids[state.aid_next].stamp < instant:
            predict(states, aids[state.aid_next].stamp, sample, instant, settings, work, log)
            state.aid_next = fuse_next(states, aids, t.aid_count, settings, work, log)

        predict(states, instant, sample, instant, settings, work, log)
        take_sample(state, sample, instant)
        if is_running(states):
            take_sample(states[HUMBLE], sample, instant)
        watch_interval(state, settings)
        add_sample(state)
        extend_departure(state)
        measure_step(state, settings)
        update_rest(state, settings)
        add_to_block(state, settings)
        is_due = is_on_grid(previous_stamp, sample.stamp, settings.output_interval)
        if settings.keeps_log == 1:
            log_sample(state, log, is_due, settings)
        save_checkpoint(states, checkpoints, t)

        is_new = sample.stamp > t.published and state.level_known == 1
        if is_new:
            carry(local, state, settings)

        while state.aid_next < t.aid_count and aids[state.aid_next].stamp == instant:
            state.aid_next = fuse_next(states, aids, t.aid_count, settings, work, log)

        if is_new and is_due:
            write_odometry(state, local, settings, rows[row_count])
            row_count += 1
        t.published = max(t.published, sample.stamp)
    return row_count


@njit
def predict(states, stamp, sample, instant, settings, work, log):
    """Propagate the lanes to ``stamp`` (ns), at or before the next IMU sample, which is of the time ``instant`` (ns).

    After a long silence of the IMU the alignment starts again.
    """
    state = states[FILTER]
    if state.level_known == 0:
        return
    if instant - state.imu.stamp > LONGEST_GAP:
        position = (state.position_map[0], state.position_map[1], state.position_map[2])
        if settings.keeps_log == 1:
            open_node(state, log)
        reset_alignment(state)
        if settings.keeps_log == 1:
            close_node(state, log, True, settings)
        note_jump(state, position, heading_of(state, settings), settings)
        return
    propagate(state, stamp, sample, instant, settings, work)
    if is_running(states):
        copy_doubt(state, states[HUMBLE])
        propagate(states[HUMBLE], stamp, sample, instant, settings, work)


@njit
def update_rest(state, settings):
    """Add the newest IMU sample to the static window; judge the IMU and level when the window is full."""
    add_to_part(state)
    window = update_static_window(state, settings)
    if window != Window.OPEN:
        if window != Window.MOTION:
            measure_gyro_noise(state)
        watch_input(state, window != Window.MOTION, settings)
        update_level(state, window, settings)
        if window == Window.REST:
            begin_departure(state, settings)
        close_static_window(state)


@njit
def take_sample(state, sample, instant):
    """Make an IMU sample of the time ``instant`` (ns) the newest reading of the state."""
    if state.imu.stamp != NEVER:
        state.imu.interval = (instant - state.imu.stamp) * 1e-9
    state.imu.stamp = instant
    state.stamp = instant
    state.imu_next += 1
    # No weight above one: the first reading, and the one after a gap, stand for themselves.
    weight = min(1.0, state.imu.interval / SMOOTHING_TIME)
    for i in range(3):
        state.imu.smooth_force[i] += weight * (sample.specific_force[i] - state.imu.smooth_force[i])
        state.imu.smooth_rate[i] += weight * (sample.angular_rate[i] - state.imu.smooth_rate[i])
        state.imu.earlier_force[i] = state.imu.force[i]
        state.imu.earlier_rate[i] = state.imu.rate[i]
        state.imu.force[i] = sample.specific_force[i]
        state.imu.rate[i] = sample.angular_rate[i]
        state.specific_force[i] = sample.specific_force[i]
        state.angular_rate[i] = sample.angular_rate[i]


@njit_in_caller
def fuse_next(states, aids, count, settings, work, log):
    """Fuse the next of ``count`` measurements, or all signals of its epoch; return the index of the next one."""
    state = states[FILTER]
    i = state.aid_next
    end = i + 1
    if settings.keeps_log == 1 and state.forward.is_open == 0:
        open_node(state, log)
    if is_range(aids[i].stream):
        end = end_of_epoch(aids, i, count)
        fuse_ranges(states, aids, i, end, settings, work)
    else:
        fuse(states, aids, i, settings, work)
    if settings.keeps_log == 1 and (end == count or aids[end].stamp != aids[i].stamp):
        close_node(state, log, False, settings)
    return end


@njit
def is_on_grid(previous_stamp, stamp, interval):
    """Say whether a multiple of ``interval`` (ns) lies in (previous_stamp, stamp]; always for the interval 0."""
    return interval == 0 or previous_stamp == NEVER or stamp // interval != previous_stamp // interval
