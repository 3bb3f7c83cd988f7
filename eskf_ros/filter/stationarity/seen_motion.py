"""Seen motion: how fast a robot moves whose IMU is quiet, as its other sensors see it over seconds to minutes.

One message seldom has the resolution to tell a creep from rest: a velocity with an error of 0.1 m/s is as likely at
0.1 m/s as at zero, and two fixes of a metre say less. But while the IMU is quiet the velocity hardly changes, so that
all messages measure the same one. A small Kalman filter for each sensor (two states per axis, place and velocity, as in
Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, section 6.2.2) collects them.
It knows nothing of the estimate and of zero velocities that were fused, which would confirm themselves.

A part of the error of fixes lasts: the place of the filter is that of the antenna plus this error, which walks.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.state.error_state import SOURCES
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.earth import east_north_up_to_ecef
from eskf_ros.geodesy.rotation import rotate_back, wrapped

EYES = SOURCES + 1
"""Sensors that see motion: the receivers by source, and behind them the velocity in body axes."""

BODY_EYE = SOURCES
"""Index of the velocity in body axes. The body may point anywhere, but rest is rest in any axes."""

SEEN_MOTION = np.dtype(
    [
        ("stamp", "i8", (EYES,)),
        ("interval", "i8", (EYES,)),
        ("origin_stamp", "i8", (EYES,)),
        ("origin_ecef", "f8", (EYES, 3)),
        ("place", "f8", (EYES, 3)),
        ("velocity", "f8", (EYES, 3)),
        ("place_variance", "f8", (EYES, 3)),
        ("mixed_variance", "f8", (EYES, 3)),
        ("velocity_variance", "f8", (EYES, 3)),
        ("walk", "f8", (EYES,)),
        ("turn_stamp", "i8"),
        ("yaw", "f8"),
        ("turn_rate", "f8"),
        ("yaw_variance", "f8"),
        ("mixed_turn_variance", "f8"),
        ("turn_rate_variance", "f8"),
    ],
    align=True,
)
"""What each sensor sees; axes east, north, up, or those of the sensor.

- ``stamp``, ``interval``: the last message, and the time from the one before it (ns).
- ``origin_stamp``, ``origin_ecef``: the fix from which ``place`` counts (ns, m).
- ``place``, ``velocity``: m and m/s, with their covariance per axis.
- ``walk``: how fast the error of the fixes walks (m2/s).
- ``turn_*``, ``yaw``, ``yaw_variance``, ``mixed_turn_variance``: the same of the dual antenna: rad and rad/s.
"""

FIRST_VELOCITY_STD = 300.0
"""m/s; standard deviation of a velocity of which nothing is known."""

QUIET_WALK = 0.002
"""m/s/rtHz; how fast the velocity may wander while the IMU is quiet."""

LOUD_CHANGE = 5.0
"""m/s; standard deviation of the change of velocity in a second in which the IMU was not quiet."""

SURPRISE = 4.0
"""Standard deviations by which a message must differ from what was expected to show a smooth acceleration."""

LASTING_SHARE = 0.25
"""Share of the variance of a fix that lasts."""

LASTING_TIME = 60.0
"""s; for about this long."""

SLOWEST = 0.1
"""m/s; a horizontal motion this fast must be excluded before rest is seen; up and down twice as fast."""

EXCLUDED = 3.5
"""Standard deviations by which the seen velocity must differ from this motion to exclude it."""

REST_SIGMAS = 3.0
"""Standard deviations within which the seen velocity must be zero."""

STEADY_ERROR = 0.03
"""m/s; a seen velocity below this may be the error that all velocities of a receiver have in common."""

MOTION_SIGMAS = 4.0
"""Standard deviations that the seen velocity must exceed to prove motion."""

SHORTEST_SIGHT = 1_500_000_000
"""ns; what a sensor saw, rest or motion, counts for this long."""

MISSED_INTERVALS = 2.5
"""A sensor sees for as many of its intervals after its last message, if that is longer."""

QUIET_TURN_WALK = 3e-5
"""rad/s/rtHz; how fast the turn rate may wander while the IMU is quiet."""

YAW_WALK = 2e-4
"""rad/rtHz; how fast the error wanders that all yaws of a dual antenna have in common (multipath)."""

LOUD_TURN_CHANGE = 1.0
"""rad/s; standard deviation of the change of the turn rate in a second in which the IMU was not quiet."""

SLOWEST_TURN = 1.75e-3
"""rad/s (0.1 deg/s); a turn this fast must be excluded before a dual antenna sees rest."""

TURN_RADIUS = 20.0
"""m; of the bends of a robot that drives so slowly and evenly that its IMU is as quiet as at rest."""

NO_ALTITUDE_VARIANCE = 1e6
"""m2 or m2/s2; an axis with a larger variance was not measured."""


LONGEST_TURN = 5_000_000_000
"""ns; a dual antenna that has been silent for longer sees nothing."""


class Seen(IntEnum):
    """What a sensor sees: NOTHING has the resolution, REST excludes a slow motion, MOTION excludes rest."""

    NOTHING = 0
    REST = 1
    MOTION = 2


@njit
def open_motion(state):
    """Let all seen velocities and turn rates be uncertain, because the robot may have changed its own."""
    for eye in range(EYES):
        for i in range(3):
            state.seen.velocity_variance[eye, i] = min(
                state.seen.velocity_variance[eye, i] + LOUD_CHANGE**2, FIRST_VELOCITY_STD**2
            )
    state.seen.turn_rate_variance = min(state.seen.turn_rate_variance + LOUD_TURN_CHANGE**2, LOUD_TURN_CHANGE**2)


@njit
def see_velocity(state, eye, stamp, velocity, variances):
    """Take a velocity (m/s) with the variances of its axes; return what its sensor sees now (`Seen`)."""
    pass_time(state, eye, stamp)
    for i in range(3):
        expected = state.seen.velocity_variance[eye, i] + variances[i]
        excess = velocity[i] - state.seen.velocity[eye, i]
        if excess * excess > SURPRISE**2 * expected:
            state.seen.velocity_variance[eye, i] += excess * excess
        gain_with(state, eye, i, excess, variances[i], False)
    return judge(state, eye, variances[2])


@njit
def see_fix(state, source, stamp, ecef, latitude, longitude, variances):
    """Take a fix (ECEF, m; place on the ellipsoid in rad) with its variances in east, north, up; return `Seen`."""
    last = state.seen.origin_stamp[source]
    pass_time(state, source, stamp)
    state.seen.walk[source] = 2.0 * LASTING_SHARE / LASTING_TIME * max(variances[0], variances[1])
    if last == NEVER:
        state.seen.origin_stamp[source] = stamp
        for i in range(3):
            state.seen.origin_ecef[source, i] = ecef[i]
            state.seen.place[source, i] = 0.0
            state.seen.place_variance[source, i] = variances[i]
            state.seen.mixed_variance[source, i] = 0.0
        return Seen.NOTHING
    origin = state.seen.origin_ecef[source]
    way = rotate_back(
        east_north_up_to_ecef(latitude, longitude), (ecef[0] - origin[0], ecef[1] - origin[1], ecef[2] - origin[2])
    )
    for i in range(3):
        excess = way[i] - state.seen.place[source, i]
        expected = state.seen.place_variance[source, i] + variances[i]
        if excess * excess > SURPRISE**2 * expected:
            # It moves otherwise than it did: by how much is known, since when is not.
            state.seen.velocity_variance[source, i] += LOUD_CHANGE**2
            state.seen.place_variance[source, i] += excess * excess
        gain_with(state, source, i, excess, variances[i], True)
    return judge(state, source, variances[2])


@njit
def pass_time(state, eye, stamp):
    """Predict what a sensor sees to ``stamp`` (ns)."""
    last = state.seen.stamp[eye]
    if last == NEVER:
        for i in range(3):
            state.seen.velocity_variance[eye, i] = FIRST_VELOCITY_STD**2
        state.seen.stamp[eye] = stamp
        return
    dt = max(stamp - last, 0) * 1e-9
    if dt > 0.0:
        state.seen.interval[eye] = stamp - last
        state.seen.stamp[eye] = stamp
    for i in range(3):
        rate, mixed = state.seen.velocity_variance[eye, i], state.seen.mixed_variance[eye, i]
        state.seen.place[eye, i] += dt * state.seen.velocity[eye, i]
        state.seen.place_variance[eye, i] += dt * (2.0 * mixed + dt * rate + state.seen.walk[eye])
        state.seen.place_variance[eye, i] += QUIET_WALK**2 * dt**3 / 3.0
        state.seen.mixed_variance[eye, i] += dt * rate + 0.5 * QUIET_WALK**2 * dt * dt
        state.seen.velocity_variance[eye, i] += QUIET_WALK**2 * dt


@njit
def gain_with(state, eye, i, excess, variance, is_place):
    """Update axis ``i`` with a measurement of place or velocity that is ``excess`` more than expected."""
    place = state.seen.place_variance[eye, i]
    mixed = state.seen.mixed_variance[eye, i]
    rate = state.seen.velocity_variance[eye, i]
    first, second = (place, mixed) if is_place else (mixed, rate)
    total = (place if is_place else rate) + variance
    state.seen.place[eye, i] += first / total * excess
    state.seen.velocity[eye, i] += second / total * excess
    state.seen.place_variance[eye, i] -= first * first / total
    state.seen.mixed_variance[eye, i] -= first * second / total
    state.seen.velocity_variance[eye, i] -= second * second / total


@njit
def see_yaw(state, stamp, yaw, variance):
    """Take a yaw (rad) of the dual antenna with its variance; return what it sees (`Seen`)."""
    seen = state.seen
    if seen.turn_stamp == NEVER or stamp - seen.turn_stamp > LONGEST_TURN:
        seen.yaw, seen.yaw_variance = yaw, variance
        seen.turn_rate, seen.turn_rate_variance, seen.mixed_turn_variance = 0.0, LOUD_TURN_CHANGE**2, 0.0
        seen.turn_stamp = stamp
        return Seen.NOTHING
    dt = (stamp - seen.turn_stamp) * 1e-9
    seen.turn_stamp = stamp
    noise = QUIET_TURN_WALK**2 * dt
    seen.yaw_variance += dt * (2.0 * seen.mixed_turn_variance + dt * seen.turn_rate_variance + YAW_WALK**2)
    seen.yaw_variance += noise * dt * dt / 3.0
    seen.mixed_turn_variance += dt * seen.turn_rate_variance + 0.5 * noise * dt
    seen.turn_rate_variance += noise
    excess = wrapped(yaw - seen.yaw - dt * seen.turn_rate)
    if excess * excess > SURPRISE**2 * (seen.yaw_variance + variance):
        seen.yaw_variance += excess * excess
        seen.turn_rate_variance += LOUD_TURN_CHANGE**2
    total = seen.yaw_variance + variance
    gain, rate_gain = seen.yaw_variance / total, seen.mixed_turn_variance / total
    seen.yaw = wrapped(seen.yaw + dt * seen.turn_rate + gain * excess)
    seen.turn_rate += rate_gain * excess
    seen.turn_rate_variance -= rate_gain * seen.mixed_turn_variance
    seen.yaw_variance -= gain * seen.yaw_variance
    seen.mixed_turn_variance -= gain * seen.mixed_turn_variance
    rate, std = abs(seen.turn_rate), math.sqrt(seen.turn_rate_variance)
    if rate > MOTION_SIGMAS * std:
        return Seen.MOTION
    if rate > REST_SIGMAS * std or rate + EXCLUDED * std > SLOWEST_TURN:
        return Seen.NOTHING
    return Seen.REST


@njit
def unseen_turn_variance(state, has_changed):
    """Return the mean square ((rad/s)2) of a turn that the sensors do not exclude while the IMU is as quiet as at rest.

    It is that which a dual antenna leaves. Without one a robot turns only where its readings change (``has_changed``),
    with the speed that its sensors do not exclude. It is 0 where none of them has spoken: robots start at rest.
    """
    last = state.seen.turn_stamp
    if last != NEVER and state.stamp - last <= LONGEST_TURN:
        return state.seen.turn_rate**2 + state.seen.turn_rate_variance
    return unseen_speed_variance(state) / TURN_RADIUS**2 if has_changed else 0.0


@njit
def unseen_speed_variance(state):
    """Return the mean square ((m/s)2) of a horizontal speed that the sensors do not exclude.

    It is 0 where none of them has spoken: robots start at rest.
    """
    square = math.inf
    for eye in range(EYES):
        if state.seen.stamp[eye] != NEVER:
            v, p = state.seen.velocity[eye], state.seen.velocity_variance[eye]
            square = min(square, v[0] ** 2 + v[1] ** 2 + p[0] + p[1])
    return square if square < math.inf else 0.0


@njit
def judge(state, eye, up_variance):
    """Return what a sensor sees; ``up_variance`` is that of its last message along the third axis."""
    v, p = state.seen.velocity[eye], state.seen.velocity_variance[eye]
    level, level_std = math.hypot(v[0], v[1]), math.sqrt(max(p[0], p[1]))
    climb, climb_std = abs(v[2]), math.sqrt(p[2])
    has_up = up_variance < NO_ALTITUDE_VARIANCE
    if level > max(MOTION_SIGMAS * level_std, SLOWEST):
        return Seen.MOTION
    if has_up and climb > max(MOTION_SIGMAS * climb_std, SLOWEST):
        return Seen.MOTION
    if level > max(REST_SIGMAS * level_std, STEADY_ERROR) or level + EXCLUDED * level_std > SLOWEST:
        return Seen.NOTHING
    if has_up and (climb > max(REST_SIGMAS * climb_std, STEADY_ERROR) or climb + EXCLUDED * climb_std > 2.0 * SLOWEST):
        return Seen.NOTHING
    return Seen.REST


@njit
def has_sight(state):
    """Say whether a sensor that sees motion has reported lately."""
    for eye in range(EYES):
        last = state.seen.stamp[eye]
        lasts = max(float(SHORTEST_SIGHT), MISSED_INTERVALS * state.seen.interval[eye])
        if last != NEVER and state.stamp - last <= lasts:
            return True
    return False
