"""Heading from a turn in place: the antenna goes round the point about which the robot turns.

A robot that turns where it stands accelerates too little for the search, but the circle of an antenna that is not on
the axis tells the heading as well as its fixes tell the circle. Antenna = centre + lever arm from base_link, turned by
the unknown heading: linear in the centre, the cosine and the sine. The centre may creep (`CENTRE_WALK`) but does not
drive; a robot that drives does not fit, and the estimate begins anew. That the length of (cos, sin) comes out as one,
the radius of the circle as the lever arm, tells that the model holds; so does the search, which assumes no standing: it
must see neither a drive nor another turn.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading_search import LENGTH_TOLERANCE, agrees_with_search, is_faster_than, nis_of_pair
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.state.error_state import GYRO_BIAS
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.rotation import dot, rotate, rotate_back, to_matrix

STATES = 4
"""Centre (m, east and north), cosine and sine of the turn from the level axes to the map."""

SPOT = np.dtype(
    [
        ("stamp", "i8"),
        ("begin_stamp", "i8"),
        ("misses", "i8"),
        ("estimate", "f8", (STATES,)),
        ("covariance", "f8", (STATES, STATES)),
    ],
    align=True,
)
"""The turn in place: stamps of the newest and of the first fix (ns), fixes in a row that do not fit, and the states."""

CENTRE_WALK = 0.003
"""m/rtHz; how fast the centre creeps: tracks and tyres slip."""

FASTEST_CREEP = 0.3
"""m/s; a robot that is certainly faster, where the turn alone does not move its IMU, drives."""

SPOT_GATE = 13.8
"""Gate of a fix (NIS): the chi-square quantile of probability 0.999 with 2 degrees of freedom."""

MISSES = 2
"""Fixes in a row outside the gate after which the robot has driven on."""

LONGEST_SILENCE = 10_000_000_000
"""ns; after a longer time without a fix the turn begins anew."""

LEAST_LEVER = 0.05
"""m; a shorter horizontal lever arm tells nothing."""

LENGTH_STD = 0.15
"""The turn is undecided while the standard deviation of the length of (cos, sin) exceeds this."""


@njit
def turn_from_spot(state, measured, source, settings, work):
    """Update the turn in place with a fix (m, map; noise in ``work``); return turn and standard deviation (rad).

    The turn leads from the level axes to the map, as in `heading_search.turn_found`; undecided: infinite.
    """
    base = settings.imu_position_base
    arm = rotate_back(settings.imu_to_base, (base[0], base[1], base[2]))
    antenna = settings.lever_arms_body[source]
    lever = rotate(to_matrix(state.attitude), (antenna[0] + arm[0], antenna[1] + arm[1], antenna[2] + arm[2]))
    if lever[0] ** 2 + lever[1] ** 2 < LEAST_LEVER**2:
        return 0.0, math.inf
    spot = state.spot
    dt = (state.stamp - spot.stamp) * 1e-9
    is_stale = spot.stamp == NEVER or state.stamp - spot.stamp > LONGEST_SILENCE
    if is_stale or spot.misses >= MISSES or is_driving(state, base):
        begin_spot(spot, state.stamp, measured, work.noise, lever)
        return 0.0, math.inf
    spot.stamp = state.stamp
    p = spot.covariance
    gyro_variance = 0.0
    for i in range(3):
        gyro_variance = max(gyro_variance, state.covariance[GYRO_BIAS + i, GYRO_BIAS + i])
    age = (state.stamp - spot.begin_stamp) * 1e-9
    drift = gyro_density(state, settings) ** 2 + 2.0 * gyro_variance * age
    for i in range(2):
        p[i, i] += CENTRE_WALK**2 * dt
        p[2 + i, 2 + i] += drift * dt
    # measured = centre + lever turned by (cos, sin), one axis after the other: fixes of receivers are round.
    x = spot.estimate
    variance = max(work.noise[0, 0], work.noise[1, 1])
    excess = (
        measured[0] - x[0] - lever[0] * x[2] + lever[1] * x[3],
        measured[1] - x[1] - lever[1] * x[2] - lever[0] * x[3],
    )
    if nis_of(p, lever, excess, variance) > SPOT_GATE:
        spot.misses += 1
        return 0.0, math.inf
    spot.misses = 0
    for axis in range(2):
        h2, h3 = (lever[0], -lever[1]) if axis == 0 else (lever[1], lever[0])
        column = (
            p[0, axis] + p[0, 2] * h2 + p[0, 3] * h3,
            p[1, axis] + p[1, 2] * h2 + p[1, 3] * h3,
            p[2, axis] + p[2, 2] * h2 + p[2, 3] * h3,
            p[3, axis] + p[3, 2] * h2 + p[3, 3] * h3,
        )
        total = column[axis] + h2 * column[2] + h3 * column[3] + variance
        innovation = measured[axis] - x[axis] - h2 * x[2] - h3 * x[3]
        for i in range(STATES):
            x[i] += column[i] / total * innovation
            for j in range(STATES):
                p[i, j] -= column[i] * column[j] / total
    if not agrees_with_search(state, x[2], x[3], (p[2, 2], p[2, 3], p[3, 3])):
        return 0.0, math.inf
    return decided(x, p)


@njit
def is_driving(state, base):
    """Say whether the search sees the IMU, ``base`` (m) from the point that stands, move faster than by the turn."""
    rate = body_rate(state, to_matrix(state.attitude))
    return is_faster_than(state, FASTEST_CREEP + math.sqrt(dot(rate, rate) * dot(base, base)))


@njit
def begin_spot(spot, stamp, measured, noise, lever):
    """Begin with a fix: the centre is somewhere within the lever arm of it, the heading unknown."""
    spot.stamp = stamp
    spot.begin_stamp = stamp
    spot.misses = 0
    # A uniform heading has mean (0, 0) and variance 1/2 in each of (cos, sin); the centre is bound to it by this fix.
    reach = 0.5 * (lever[0] ** 2 + lever[1] ** 2)
    p = spot.covariance
    for i in range(STATES):
        spot.estimate[i] = measured[i] if i < 2 else 0.0
        for j in range(STATES):
            p[i, j] = 0.0
    for i in range(2):
        p[i, i] = max(noise[0, 0], noise[1, 1]) + reach
        p[2 + i, 2 + i] = 0.5
    # centre = fix - lever turned: its covariance with cosine and sine.
    p[0, 2], p[0, 3] = -0.5 * lever[0], 0.5 * lever[1]
    p[1, 2], p[1, 3] = -0.5 * lever[1], -0.5 * lever[0]
    for i in range(2):
        for j in range(2, STATES):
            p[j, i] = p[i, j]


@njit
def nis_of(p, lever, excess, variance):
    """Return the normalised innovation squared of a fix that is ``excess`` (m, east and north) off."""
    see = p[0, 0] + 2.0 * (lever[0] * p[0, 2] - lever[1] * p[0, 3]) + variance
    see += lever[0] ** 2 * p[2, 2] - 2.0 * lever[0] * lever[1] * p[2, 3] + lever[1] ** 2 * p[3, 3]
    snn = p[1, 1] + 2.0 * (lever[1] * p[1, 2] + lever[0] * p[1, 3]) + variance
    snn += lever[1] ** 2 * p[2, 2] + 2.0 * lever[0] * lever[1] * p[2, 3] + lever[0] ** 2 * p[3, 3]
    sen = p[0, 1] + lever[1] * p[0, 2] + lever[0] * p[0, 3] + lever[0] * p[1, 2] - lever[1] * p[1, 3]
    sen += lever[0] * lever[1] * (p[2, 2] - p[3, 3]) + (lever[0] ** 2 - lever[1] ** 2) * p[2, 3]
    return nis_of_pair(excess[0], excess[1], see, sen, snn)


@njit
def decided(x, p):
    """Return turn and standard deviation (rad), infinite unless the length of (cos, sin) is known to be one."""
    length = math.hypot(x[2], x[3])
    if length < 0.5:
        return 0.0, math.inf
    c, s = x[2] / length, x[3] / length
    along = math.sqrt(max(c * c * p[2, 2] + 2.0 * c * s * p[2, 3] + s * s * p[3, 3], 0.0))
    across = math.sqrt(max(s * s * p[2, 2] - 2.0 * c * s * p[2, 3] + c * c * p[3, 3], 0.0))
    if along > LENGTH_STD or abs(length - 1.0) > LENGTH_TOLERANCE + 3.0 * along:
        return 0.0, math.inf
    return math.atan2(x[3], x[2]), across / length
