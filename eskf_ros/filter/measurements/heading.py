"""Heading of a line that is fixed to the body: the baseline of a dual-antenna receiver.

Payload: yaw of the line (rad, counter-clockwise from east) and its pitch (rad, positive down, REP-103), both at the
place where it is, and their covariance (rad2) in the first two axes; either may be absent. With d the line in local
East-North-Up, yaw = atan2(d_n, d_e) and pitch = atan2(-d_u, |d_e, d_n|); a small rotation theta about local axes adds
theta x d to d.

What all yaws are wrong by alike, mounting and slow multipath, is an optional state: measured = yaw + offset.

The line of source 1 is the x axis of base_link: what an IMU with a filter of its own says of it, perhaps from magnetic
north. It serves at start only (``heading_hints``).
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.navigation_frame import local_east_north_up_to_ecef
from eskf_ros.filter.measurements.jacobians import azimuth_change, clear, set_attitude_row, to_local
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.geodesy.rotation import wrapped

IMU_ORIENTATION = 1

STEEPEST = 0.17
"""Cosine of the steepest pitch (80 degrees) at which a line still has a heading."""


@njit
def predict(state, source, settings):
    """Return yaw and pitch (rad) of the line of ``source``."""
    line = settings.heading_lines_body[source]
    d = to_local(state, local_east_north_up_to_ecef(state), (line[0], line[1], line[2]))
    return math.atan2(d[1], d[0]), math.atan2(-d[2], math.sqrt(d[0] ** 2 + d[1] ** 2))


@njit
def linearize(state, payload, source, settings, work):
    """Write innovation, Jacobian and noise of what was measured of yaw and pitch to ``work``; return the size."""
    clear(work)
    yaw = payload[0]
    if source == IMU_ORIENTATION and settings.is_orientation_magnetic == 1:
        if state.mag.field_known == 0:
            return 0
        yaw -= state.mag.declination
    line = settings.heading_lines_body[source]
    local_to_ecef = local_east_north_up_to_ecef(state)
    d = to_local(state, local_to_ecef, (line[0], line[1], line[2]))
    level_square = d[0] ** 2 + d[1] ** 2
    if level_square < STEEPEST**2:
        return 0
    level = math.sqrt(level_square)
    predicted_yaw, predicted_pitch = predict(state, source, settings)
    size = 0
    if payload[3] > 0.0:
        place = settings.heading_offset_at
        if source == 0 and place < state.error_size:
            yaw -= state.optional[place - ERROR_SIZE]
            work.jacobian[0, place] = 1.0
        work.innovation[0] = wrapped(yaw - predicted_yaw)
        set_attitude_row(work.jacobian, 0, state, local_to_ecef, azimuth_change(d, level_square))
        work.noise[0, 0] = payload[3]
        size = 1
    if payload[6] > 0.0:
        work.innovation[size] = payload[1] - predicted_pitch
        set_attitude_row(work.jacobian, size, state, local_to_ecef, (-d[1] / level, d[0] / level, 0.0))
        if size == 1:
            work.noise[0, 1] = payload[4]
            work.noise[1, 0] = payload[4]
        work.noise[size, size] = payload[6]
        size += 1
    return size
