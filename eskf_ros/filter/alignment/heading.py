"""The heading: what it is, setting it, and finding it by motion, by the course or from memory."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading_search import COSINE, begin_search, spread, turn_found, update_search
from eskf_ros.filter.inertial.covariance import update_error_axes
from eskf_ros.filter.inertial.navigation_frame import (
    body_rate,
    heading_of,
    local_east_north_up_to_ecef,
    local_up,
    reset_attitude,
)
from eskf_ros.filter.measurements.gnss_position import position_of_fix
from eskf_ros.filter.measurements.jacobians import set_east_north_up_covariance
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, VELOCITY
from eskf_ros.geodesy.earth import east_north_up_to_ecef, geodetic_to_ecef
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix, wrapped

COURSE_MAX_STD = 0.17
COURSE_MAX_TURN_RATE = 0.2
"""Course over ground gives heading only when it is this certain (rad) and the robot turns no faster (rad/s)."""

CERTAIN = 3.0
LEAST_LENGTH = 0.5
COURSE_SEARCH_STD = 0.35
"""The course is believed when the search agrees within three sigma, and knows the direction so well by itself (rad)."""


@njit
def reset_heading(state, heading, std, settings):
    """Turn the attitude about the local vertical to ``heading`` (rad), independent of everything else by ``std``."""
    up = local_up(state)
    lever = rotate(to_matrix(state.attitude), settings.lever_arms_body[0])
    change = heading - heading_of(state, settings)
    reset_attitude(state, (change * up[0], change * up[1], change * up[2]))
    # The vehicle did not make this turn.
    state.mag.heading = wrapped(state.mag.heading + change)
    covariance = state.covariance
    across = (
        (1.0 - up[0] * up[0], -up[0] * up[1], -up[0] * up[2]),
        (-up[1] * up[0], 1.0 - up[1] * up[1], -up[1] * up[2]),
        (-up[2] * up[0], -up[2] * up[1], 1.0 - up[2] * up[2]),
    )
    update_error_axes(covariance, ATTITUDE, across)
    for i in range(3):
        for j in range(3):
            covariance[ATTITUDE + i, ATTITUDE + j] += up[i] * up[j] * std**2
    if state.position_known == 1:
        # GNSS held the antenna in place: the body is on the other end of the lever arm.
        turned = rotate(to_matrix(state.attitude), settings.lever_arms_body[0])
        for i in range(3):
            state.position_map[i] += lever[i] - turned[i]


@njit
def search_heading(state, aid, gate, settings, work):
    """Let a GNSS measurement that was fused take part in the search for the heading, and look whether it is over."""
    rotation = to_matrix(state.attitude)
    arm = settings.lever_arms_body[aid.source]
    if aid.stream == Stream.GNSS_POSITION:
        first = 0
        measured = position_of_fix(state, aid.payload)
        lever = rotate(rotation, arm)
        local_to_ecef = east_north_up_to_ecef(aid.payload[0], aid.payload[1])
    elif aid.stream == Stream.GNSS_VELOCITY:
        first = 2
        local_to_ecef = local_east_north_up_to_ecef(state)
        velocity = rotate(local_to_ecef, (aid.payload[0], aid.payload[1], aid.payload[2]))
        measured = rotate_back(state.frame.map_to_ecef, velocity)
        lever = rotate(rotation, cross(body_rate(state, rotation), arm))
    else:
        return
    set_east_north_up_covariance(work.noise, state, local_to_ecef, aid.payload, 3)
    search_with(state, first, measured, lever, gate, settings, work)


@njit
def search_with(state, first, measured, lever, gate, settings, work):
    """Search with a position (``first`` 0, m) or velocity (2, m/s) of the antenna, covariance in ``work.noise``.

    ``measured`` in map, ``lever`` (or its velocity) in the axes of the unknown heading.
    """
    if state.search.started == 1:
        update_search(state, first, measured, lever, work.noise, gate, work)
    elif first == 0:
        reach = lever[0] ** 2 + lever[1] ** 2
        begin_search(state, measured[0], measured[1], max(work.noise[0, 0], work.noise[1, 1]) + reach)
    turn, std = turn_found(state)
    if std <= settings.found_heading_std:
        reset_heading(state, heading_of(state, settings) + turn, std, settings)
        state.heading_known = 1
    elif settings.use_course == 1:
        align_to_course(state, settings)


@njit
def align_to_course(state, settings):
    """Take the unknown heading from the course, if that is certain and steady and the search knows which end is ahead.

    Accelerations tell forward from reverse, and side slip from driving straight, long before they tell the heading as
    well as the course does.
    """
    v = state.velocity_map
    speed = math.sqrt(v[0] ** 2 + v[1] ** 2)
    if speed < settings.course_min_speed or state.search.started == 0:
        return
    along = (v[0] / speed, v[1] / speed)
    covariance = state.covariance
    pxx = covariance[VELOCITY, VELOCITY]
    pxy = covariance[VELOCITY, VELOCITY + 1]
    pyy = covariance[VELOCITY + 1, VELOCITY + 1]
    along_variance = along[0] ** 2 * pxx + 2.0 * along[0] * along[1] * pxy + along[1] ** 2 * pyy
    across_variance = along[1] ** 2 * pxx - 2.0 * along[0] * along[1] * pxy + along[0] ** 2 * pyy
    course_std = math.sqrt(max(across_variance, 0.0) / speed**2 + settings.course_std**2)
    up = local_up(state)
    turn_rate = dot(up, rotate(to_matrix(state.attitude), body_rate(state, to_matrix(state.attitude))))
    if (
        across_variance > (COURSE_MAX_STD * speed) ** 2
        or speed**2 < 9.0 * along_variance
        or abs(turn_rate) > COURSE_MAX_TURN_RATE
    ):
        return
    heading = math.atan2(v[1], v[0])
    turn = heading - heading_of(state, settings)
    cosine, sine = math.cos(turn), math.sin(turn)
    ahead = cosine * state.search.estimate[COSINE] + sine * state.search.estimate[COSINE + 1]
    aside = cosine * state.search.estimate[COSINE + 1] - sine * state.search.estimate[COSINE]
    ahead_std, aside_std = spread(state, cosine, sine)
    if (
        abs(ahead) < max(CERTAIN * ahead_std, LEAST_LENGTH)
        or aside_std > COURSE_SEARCH_STD * abs(ahead)
        or abs(aside) > CERTAIN * math.hypot(aside_std, course_std * abs(ahead))
    ):
        return
    if ahead < 0.0:
        heading += math.pi
    reset_heading(state, heading, course_std, settings)
    state.heading_known = 1


@njit
def reset_heading_from_memory(state, payload, settings):
    """Take the remembered heading if the first fix (``payload``: rad, rad, m, covariance) finds the robot in its place.

    The state has level and position already.
    """
    if settings.has_memory == 0 or state.restarts > 0 or state.heading_known == 1:
        return
    fix = geodetic_to_ecef(payload[0], payload[1], payload[2])
    place, lever, mount = settings.remembered_place_ecef, settings.lever_arms_body[0], settings.imu_position_base
    way = (fix[0] - place[0], fix[1] - place[1], fix[2] - place[2])
    fix_std = math.sqrt(max(payload[3], payload[6], payload[8]))
    # The antenna is at most this far from base_link, on whatever side.
    reach = math.sqrt(dot(lever, lever)) + math.sqrt(dot(mount, mount))
    std = math.sqrt(fix_std**2 + settings.remembered_place_std**2)
    if math.sqrt(dot(way, way)) > reach + settings.remembered_place_tolerance + 3.0 * std:
        return
    f = settings.remembered_forward_ecef
    forward = rotate_back(state.frame.map_to_ecef, (f[0], f[1], f[2]))
    reset_heading(state, math.atan2(forward[1], forward[0]), settings.remembered_heading_std, settings)
    state.heading_known = 1
    state.heading.given_stamp = state.stamp
