"""The antenna of a GNSS receiver: its lever arm and the time of its messages, as far as they are estimated.

Augmented states of the first receiver, all constant: ``lever_arm`` (m, base_link axes) is added to the lever arm of the
parameters, ``time_offset`` (s) to that of positions and velocities, ``velocity_time_offset`` (s) to that of velocities.
A message is then of the time stamp + offset, and shows the antenna where its velocity and acceleration carry it in the
offset: the measurement itself stays where it is in the timeline.
"""

from __future__ import annotations

from typing import Any

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.measurements.row import OptionalBlock
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, VELOCITY
from eskf_ros.geodesy.rotation import cross, rotate, rotate_back

FIRST = 0
"""Source of the receiver whose antenna is estimated."""


@njit
def lever_arm_of(state, source, settings):
    """Return the lever arm (m, IMU axes) of receiver ``source``."""
    arm = settings.lever_arms_body[source]
    place = settings.lever_arm_at - ERROR_SIZE
    if source != FIRST or settings.lever_arm_at >= state.error_size:
        return (arm[0], arm[1], arm[2])
    found = state.optional
    more = rotate_back(settings.imu_to_base, (found[place], found[place + 1], found[place + 2]))
    return (arm[0] + more[0], arm[1] + more[1], arm[2] + more[2])


@njit
def time_offset_of(state, source, of_velocity, settings):
    """Return what is estimated of the time offset (s) of positions or (``of_velocity``) velocities."""
    total = 0.0
    if source == FIRST and settings.time_offset_at < state.error_size:
        total += state.optional[settings.time_offset_at - ERROR_SIZE]
    if source == FIRST and of_velocity and settings.velocity_time_offset_at < state.error_size:
        total += state.optional[settings.velocity_time_offset_at - ERROR_SIZE]
    return total


@njit
def antenna_velocity(state, rotation, source, settings):
    """Return the velocity (m/s, map) of the antenna of receiver ``source``; ``rotation``: body to map."""
    lever_velocity = rotate(rotation, cross(body_rate(state, rotation), lever_arm_of(state, source, settings)))
    return (
        state.velocity_map[0] + lever_velocity[0],
        state.velocity_map[1] + lever_velocity[1],
        state.velocity_map[2] + lever_velocity[2],
    )


@njit
def smooth_force_map(state, rotation):
    """Return the specific force (m/s2, map) without vibration and bias; ``rotation``: body to map."""
    force, bias = state.imu.smooth_force, state.accel_bias
    return rotate(rotation, (force[0] - bias[0], force[1] - bias[1], force[2] - bias[2]))


@njit
def set_lever_arm(jacobian, state, rotation, source, of_velocity, settings):
    """Write the derivative of a position or velocity (map) by the lever arm in base_link axes, if it is estimated."""
    place = settings.lever_arm_at
    if source != FIRST or place >= state.error_size:
        return
    rate = body_rate(state, rotation)
    for k in range(3):
        m = settings.imu_to_base
        axis = (m[k, 0], m[k, 1], m[k, 2])
        column = rotate(rotation, cross(rate, axis) if of_velocity else axis)
        for i in range(3):
            jacobian[i, place + k] = column[i]


@njit
def carry_position(state, rotation, source, settings, work):
    """Carry the predicted position in ``work`` over the time offset, if it is estimated, and write its derivatives."""
    place = settings.time_offset_at
    if source != FIRST or place >= state.error_size:
        return
    velocity, offset = antenna_velocity(state, rotation, source, settings), state.optional[place - ERROR_SIZE]
    for i in range(3):
        work.innovation[i] -= offset * velocity[i]
        work.jacobian[i, place] = velocity[i]
        work.jacobian[i, VELOCITY + i] += offset


@njit
def carry_velocity(state, rotation, source, settings, work):
    """Do the same with a predicted velocity; that the lever arm turns faster or slower is left out."""
    if source != FIRST or settings.time_offset_at >= state.error_size:
        return
    offset = time_offset_of(state, source, True, settings)
    force = smooth_force_map(state, rotation)
    gravity = gravity_map(state, (state.position_map[0], state.position_map[1], state.position_map[2]))
    for i in range(3):
        acceleration = force[i] + gravity[i]
        work.innovation[i] -= offset * acceleration
        work.jacobian[i, settings.time_offset_at] = acceleration
        if settings.velocity_time_offset_at < state.error_size:
            work.jacobian[i, settings.velocity_time_offset_at] = acceleration
        # theta x force, and minus R for the bias.
        work.jacobian[i, ATTITUDE + (i + 1) % 3] += offset * force[(i + 2) % 3]
        work.jacobian[i, ATTITUDE + (i + 2) % 3] -= offset * force[(i + 1) % 3]
        for j in range(3):
            work.jacobian[i, ACCEL_BIAS + j] -= offset * rotation[i][j]


def lever_arm_block(estimate: Any) -> OptionalBlock:
    """Return the augmented states of the lever arm."""
    streams = (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY)
    return OptionalBlock("lever_arm", is_on=estimate.lever_arm, std=estimate.lever_arm_std, streams=streams)


def time_offset_blocks(estimate: Any) -> tuple[OptionalBlock, ...]:
    """Return the augmented states of the time offsets, of all messages and of velocities besides."""
    on, std = estimate.time_offset, estimate.time_offset_std
    streams = (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY)
    return (
        OptionalBlock("time_offset", is_on=on, std=std, streams=streams),
        OptionalBlock("velocity_time_offset", is_on=on, std=std, streams=streams[1:]),
    )
