"""The heading: setting it, and finding it by search, by the course over ground, or from memory."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading_from_turning import turn_from_spot
from eskf_ros.filter.alignment.heading_search import (
    COSINE,
    begin_search,
    nis_of_pair,
    spread,
    turn_found,
    update_search,
)
from eskf_ros.filter.history.records import XX, YY, ZZ
from eskf_ros.filter.inertial.covariance import update_error_axes
from eskf_ros.filter.inertial.navigation_frame import (
    body_rate,
    heading_of,
    local_east_north_up_to_ecef,
    local_up,
    reset_attitude,
)
from eskf_ros.filter.measurements.antenna import lever_arm_of
from eskf_ros.filter.measurements.gnss_position import position_of_fix
from eskf_ros.filter.measurements.jacobians import set_east_north_up_covariance
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, POSITION, VELOCITY
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.earth import east_north_up_to_ecef, geodetic_to_ecef
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix, wrapped

COURSE_MAX_STD = 0.17
"""rad; the course over ground gives the heading only if its standard deviation is below this."""

COURSE_MAX_TURN_RATE = 0.2
"""rad/s; the course over ground gives the heading only if the robot turns more slowly."""

CERTAIN = 3.0
"""Standard deviations by which forward must differ from reverse."""

AGREEMENT = 1.5
"""Standard deviations of the search within which it must agree with the course. A craft that is set off by a current
disagrees by as many of them as it crabs: the tighter they must agree, the more certainly it is told apart.
"""

COURSE_WAY = 6.0
"""m; over this way search and course must agree. Many a slow robot has found its heading by the search alone meanwhile,
and better.
"""

FAST = 20.0
"""m/s; wind and current set off a craft that is faster by a small angle only: the search need not exclude a large one.
"""

FAST_SEARCH_STD = 0.35
"""rad; `COURSE_SEARCH_STD` of such a craft."""

WIND = 5.0
"""m/s; standard deviation of what sets it off."""

LEAST_LENGTH = 0.5
"""Length of the found (cos, sin) along the course, at least; 1 if the model holds."""

SAME_VELOCITY = 13.82
"""NIS of the difference of the velocities of filter and search up to which they agree: 0.999 quantile of chi-square."""

COURSE_SEARCH_STD = 0.2
"""rad; standard deviation of the direction found by the search above which the course is not believed."""


@njit
def reset_heading(state, heading, std, settings):
    """Turn the attitude about the local vertical to ``heading`` (rad, map), with the standard deviation ``std`` (rad).

    The error of the heading is uncorrelated with all others afterwards.
    """
    up = local_up(state)
    lever = rotate(to_matrix(state.attitude), lever_arm_of(state, 0, settings))
    change = heading - heading_of(state, settings)
    reset_attitude(state, (change * up[0], change * up[1], change * up[2]))
    # The vehicle did not make this turn: the error of the magnetic field stays the same.
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
        # GNSS has measured the antenna, which therefore stays in place: the IMU moves about it.
        turned = rotate(to_matrix(state.attitude), lever_arm_of(state, 0, settings))
        for i in range(3):
            state.position_map[i] += lever[i] - turned[i]


@njit
def begin_with_heading(state, heading, std, settings):
    """Set the unknown heading (rad, map), with the standard deviation ``std`` (rad); it is known from now on."""
    reset_heading(state, heading, std, settings)
    if state.position_known == 1:
        inflate_position_by_antenna(state, settings)
    state.heading_known = 1


@njit
def reset_to_search(state, heading, std, settings):
    """Set the unknown heading (rad, map) that the search has found, and continue with the velocity of the search.

    Without a heading the filter knows no accelerations, so its velocity lags behind; the search has used them. A search
    that is further from it than both may err has gone astray.
    """
    x, y = state.search.estimate[2] - state.velocity_map[0], state.search.estimate[3] - state.velocity_map[1]
    p, found = state.covariance, state.search.covariance
    xx = p[VELOCITY, VELOCITY] + found[2, 2]
    xy = p[VELOCITY, VELOCITY + 1] + found[2, 3]
    yy = p[VELOCITY + 1, VELOCITY + 1] + found[3, 3]
    if nis_of_pair(x, y, xx, xy, yy) <= SAME_VELOCITY:
        for i in range(2):
            state.velocity_map[i] = state.search.estimate[2 + i]
            for j in range(state.error_size):
                p[VELOCITY + i, j] = p[j, VELOCITY + i] = 0.0
        for i in range(2):
            for j in range(2):
                p[VELOCITY + i, VELOCITY + j] = found[2 + i, 2 + j]
    begin_with_heading(state, heading, std, settings)


@njit
def inflate_position_by_antenna(state, settings):
    """Give the position its share of the errors of the attitude, and of lever arm and time offset, where estimated.

    With an unknown heading fixes did not enter through them: what is known as well as the fixes is the antenna. From
    now on it is p = antenna - R lever_arm - velocity time_offset, in the covariance, too.
    """
    rotation = to_matrix(state.attitude)
    lever = rotate(rotation, lever_arm_of(state, 0, settings))
    inflate_position(state, ATTITUDE, (0.0, -lever[2], lever[1]))
    inflate_position(state, ATTITUDE + 1, (lever[2], 0.0, -lever[0]))
    inflate_position(state, ATTITUDE + 2, (-lever[1], lever[0], 0.0))
    if settings.lever_arm_at < state.error_size:
        for k in range(3):
            m = settings.imu_to_base
            inflate_position(state, settings.lever_arm_at + k, rotate(rotation, (m[k, 0], m[k, 1], m[k, 2])))
    if settings.time_offset_at < state.error_size:
        v = state.velocity_map
        inflate_position(state, settings.time_offset_at, (v[0], v[1], v[2]))


@njit
def inflate_position(state, place, effect):
    """Subtract ``effect`` times the error at index ``place`` from that of the position, on both sides of P."""
    for i in range(3):
        for j in range(state.error_size):
            state.covariance[POSITION + i, j] -= effect[i] * state.covariance[place, j]
    for i in range(3):
        for j in range(state.error_size):
            state.covariance[j, POSITION + i] -= effect[i] * state.covariance[j, place]


@njit
def search_heading(state, aid, gate, settings, work):
    """Update the search with a GNSS measurement that was fused; set the heading if the search has found it."""
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
    if aid.stream == Stream.GNSS_POSITION:
        turn, std = turn_from_spot(state, measured, aid.source, settings, work)
        if std <= settings.found_heading_std:
            begin_with_heading(state, heading_of(state, settings) + turn, std, settings)
            return
    search_with(state, first, measured, lever, gate, settings, work)


@njit
def search_with(state, first, measured, lever, gate, settings, work):
    """Update the search with a position (``first`` 0, m) or velocity (2, m/s) of the antenna; set a found heading.

    ``measured`` is in map, its covariance in ``work.noise``; ``lever``, the lever arm or its velocity, is in the level
    axes of the unknown heading.
    """
    if state.search.started == 1:
        update_search(state, first, measured, lever, work.noise, gate, work)
    elif first == 0:
        reach = lever[0] ** 2 + lever[1] ** 2
        begin_search(state, measured[0], measured[1], max(work.noise[0, 0], work.noise[1, 1]) + reach)
    turn, std = turn_found(state)
    if std <= settings.found_heading_std:
        reset_to_search(state, heading_of(state, settings) + turn, std, settings)
    elif settings.use_course == 1:
        align_to_course(state, settings)


@njit
def align_to_course(state, settings):
    """Set the unknown heading to the course over ground, if the search has confirmed it over `COURSE_WAY`.

    Accelerations tell forward from reverse, and side slip from straight travel, before they tell the heading as
    accurately as the course does. But they tell the side slip no better than they tell the heading: what crabs may
    agree with its course by chance, and the standard deviation that is set is therefore not below that of the search.
    """
    heading, std = course_confirmed(state, settings)
    if std == math.inf:
        state.search.course_since = NEVER
        return
    if state.search.course_since == NEVER:
        state.search.course_since = state.stamp
    speed = math.hypot(state.search.estimate[2], state.search.estimate[3])
    if (state.stamp - state.search.course_since) * 1e-9 * speed >= COURSE_WAY:
        reset_to_search(state, heading, std, settings)


@njit
def course_confirmed(state, settings):
    """Return the heading of a robot that travels along its x axis and its standard deviation (rad), infinite if unsure.

    The course must be certain and steady, and agree with the search. The velocity is that of the search, which knows
    the accelerations.
    """
    v = (state.search.estimate[2], state.search.estimate[3])
    speed = math.sqrt(v[0] ** 2 + v[1] ** 2)
    if state.search.started == 0 or speed < settings.course_min_speed:
        return 0.0, math.inf
    along = (v[0] / speed, v[1] / speed)
    covariance = state.search.covariance
    pxx, pxy, pyy = covariance[2, 2], covariance[2, 3], covariance[3, 3]
    along_variance = along[0] ** 2 * pxx + 2.0 * along[0] * along[1] * pxy + along[1] ** 2 * pyy
    across_variance = along[1] ** 2 * pxx - 2.0 * along[0] * along[1] * pxy + along[0] ** 2 * pyy
    up = local_up(state)
    turn_rate = dot(up, rotate(to_matrix(state.attitude), body_rate(state, to_matrix(state.attitude))))
    if (
        across_variance > (COURSE_MAX_STD * speed) ** 2
        or speed**2 < 9.0 * along_variance
        or abs(turn_rate) > COURSE_MAX_TURN_RATE
    ):
        return 0.0, math.inf
    heading = math.atan2(v[1], v[0])
    turn = heading - heading_of(state, settings)
    cosine, sine = math.cos(turn), math.sin(turn)
    ahead = cosine * state.search.estimate[COSINE] + sine * state.search.estimate[COSINE + 1]
    aside = cosine * state.search.estimate[COSINE + 1] - sine * state.search.estimate[COSINE]
    ahead_std, aside_std = spread(state, cosine, sine)
    if abs(ahead) < max(CERTAIN * ahead_std, LEAST_LENGTH):
        return 0.0, math.inf
    off, off_std = abs(aside / ahead), aside_std / abs(ahead)
    course_variance = across_variance / speed**2 + settings.course_std**2
    if speed > FAST:
        course_variance += (WIND / speed) ** 2
        does_agree = off_std < FAST_SEARCH_STD and off < CERTAIN * math.sqrt(off_std**2 + course_variance)
    else:
        course_variance += off_std**2
        does_agree = off_std < COURSE_SEARCH_STD and off < AGREEMENT * off_std
    if not does_agree:
        return 0.0, math.inf
    if ahead < 0.0:
        heading += math.pi
    return heading, math.sqrt(course_variance)


@njit
def reset_heading_from_memory(state, payload, settings):
    """Set the heading to the remembered one if the first fix finds the robot at its remembered place.

    ``payload``: latitude, longitude (rad), altitude (m), covariance. Level and position are known already.
    """
    if settings.has_memory == 0 or state.restarts > 0 or state.heading_known == 1:
        return
    fix = geodetic_to_ecef(payload[0], payload[1], payload[2])
    place, lever, mount = settings.remembered_place_ecef, settings.lever_arms_body[0], settings.imu_position_base
    way = (fix[0] - place[0], fix[1] - place[1], fix[2] - place[2])
    fix_std = math.sqrt(max(payload[XX], payload[YY], payload[ZZ]))
    # The antenna is at most this far from base_link, on whatever side.
    reach = math.sqrt(dot(lever, lever)) + math.sqrt(dot(mount, mount))
    std = math.sqrt(fix_std**2 + settings.remembered_place_std**2)
    if math.sqrt(dot(way, way)) > reach + settings.remembered_place_tolerance + 3.0 * std:
        return
    f = settings.remembered_forward_ecef
    forward = rotate_back(state.frame.map_to_ecef, (f[0], f[1], f[2]))
    begin_with_heading(state, math.atan2(forward[1], forward[0]), settings.remembered_heading_std, settings)
    state.heading.given_stamp = state.stamp
