"""A heading that was given, and that the course over ground of a fast vehicle contradicts.

A parameter, the memory or a pose may be wrong, and on a straight way at constant speed no acceleration tells. A vehicle
that travels along its x axis (`alignment.use_course`) and is fast points where it goes, but for wind.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading import FAST, WIND, reset_heading
from eskf_ros.filter.inertial.navigation_frame import heading_of
from eskf_ros.filter.state.error_state import ATTITUDE, VELOCITY
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.geodesy.rotation import wrapped

CONTRADICTION = 2.0
"""Standard deviations, those of course and heading together, beyond which they contradict each other. Wind is most of
them: a heading that is as good as it claims is hardly ever contradicted where there is none.
"""

CONTRADICTED_TIME = 10 * SECOND
"""ns; time for which the course must contradict the heading. The fixes of a passing fault are over by then."""


@njit
def reset_contradicted_heading(state, settings):
    """Take the course over ground for the heading if it contradicts one that was given for long enough.

    Once an acceleration stands out, it tells the heading better, and the course is not asked.
    """
    since = state.heading.contradicted_since
    state.heading.contradicted_since = NEVER
    if (
        settings.use_course == 0
        or state.heading_known == 0
        or state.heading.given_stamp == NEVER
        or state.excitation.left > 0.0
    ):
        return
    v = (state.velocity_map[0], state.velocity_map[1])
    speed = math.hypot(v[0], v[1])
    if speed < FAST:
        return
    p, e, n = state.covariance, VELOCITY, VELOCITY + 1
    across = (v[1] ** 2 * p[e, e] - 2.0 * v[0] * v[1] * p[e, n] + v[0] ** 2 * p[n, n]) / speed**4
    course, variance = math.atan2(v[1], v[0]), across + settings.course_std**2 + (WIND / speed) ** 2
    apart = wrapped(course - heading_of(state, settings))
    if apart**2 < CONTRADICTION**2 * (variance + p[ATTITUDE + 2, ATTITUDE + 2]):
        return
    state.heading.contradicted_since = state.stamp if since == NEVER else since
    if state.stamp - state.heading.contradicted_since < CONTRADICTED_TIME:
        return
    reset_heading(state, course, math.sqrt(variance), settings)
    # It was given anew, for the humble lane, too.
    state.heading.given_stamp = state.stamp
    state.heading.contradicted_since = NEVER
