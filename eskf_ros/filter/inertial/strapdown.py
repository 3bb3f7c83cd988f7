"""Strapdown navigation in the Earth-fixed local frame, one IMU interval at a time.

    d/dt position = velocity
    d/dt velocity = R f + g(position) - 2 Omega x velocity
    d/dt R        = R [omega]x - [Omega]x R

with Omega the Earth rate and g the normal gravity (both in map axes), f and omega the specific force and inertial
rate in body axes. IMU samples are instantaneous values; increments come from straight lines between them (two-sample
coning and sculling; Savage, Strapdown Analytics, ch. 7; Groves, sections 5.5 and 5.6).
"""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.geodesy.earth import STANDARD_GRAVITY, normal_gravity_ecef
from eskf_ros.geodesy.rotation import (
    cross,
    from_rotation_vector,
    multiply,
    normalized,
    rotate,
    rotate_back,
    to_matrix,
)

IMU_READINGS = np.dtype(
    [
        ("stamp", "i8"),
        ("interval", "f8"),
        ("force", "f8", (3,)),
        ("rate", "f8", (3,)),
        ("earlier_force", "f8", (3,)),
        ("earlier_rate", "f8", (3,)),
        ("smooth_force", "f8", (3,)),
        ("smooth_rate", "f8", (3,)),
    ],
    align=True,
)
"""The last raw IMU reading (m/s2, rad/s), its time, the interval (s) that it ended, and the reading before.

``stamp`` (ns) is free of jitter (`stamps`). ``smooth_force``, ``smooth_rate``: readings without vibration, averaged
over about `SMOOTHING_TIME`.
"""

SMOOTHING_TIME = 0.1
"""s; time constant of the smoothed readings: slower than vibration, faster than a vehicle turns."""


@njit
def gravity_map(state, position_map):
    """Return normal gravity (m/s2, map axes) at a map position (m); straight down while there is no datum."""
    if state.frame.datum_known == 0:
        return (0.0, 0.0, -STANDARD_GRAVITY)
    offset = rotate(state.frame.map_to_ecef, position_map)
    gravity = normal_gravity_ecef(
        state.frame.origin_ecef[0] + offset[0],
        state.frame.origin_ecef[1] + offset[1],
        state.frame.origin_ecef[2] + offset[2],
    )
    return rotate_back(state.frame.map_to_ecef, gravity)


@njit
def increments(force_0, rate_0, force_1, rate_1, dt):
    """Return the rotation vector (rad) and the velocity increment (m/s) of one interval of ``dt`` s.

    Rate and force are linear in time. The rotation vector carries the coning term. The velocity increment is in the
    axes half a rotation vector after the start, where the sculling terms of equal index vanish.
    """
    coning = cross(rate_0, rate_1)
    sculling_a = cross(rate_0, force_1)
    sculling_b = cross(force_0, rate_1)
    h = 0.5 * dt
    k = dt * dt / 12.0
    angle = (
        h * (rate_0[0] + rate_1[0]) + k * coning[0],
        h * (rate_0[1] + rate_1[1]) + k * coning[1],
        h * (rate_0[2] + rate_1[2]) + k * coning[2],
    )
    velocity = (
        h * (force_0[0] + force_1[0]) + k * (sculling_a[0] + sculling_b[0]),
        h * (force_0[1] + force_1[1]) + k * (sculling_a[1] + sculling_b[1]),
        h * (force_0[2] + force_1[2]) + k * (sculling_a[2] + sculling_b[2]),
    )
    # To second order in the rotation: the mean over the interval of (rotation from the middle)^2 / 2.
    bent = cross(angle, cross(angle, velocity))
    return angle, (velocity[0] + bent[0] / 24.0, velocity[1] + bent[1] / 24.0, velocity[2] + bent[2] / 24.0)


@njit
def half_turned(attitude, angle):
    """Return ``attitude`` followed by half the body rotation vector ``angle``."""
    return multiply(attitude, from_rotation_vector((0.5 * angle[0], 0.5 * angle[1], 0.5 * angle[2])))


@njit
def turned(attitude, angle, earth_rate, dt):
    """Return ``attitude`` after the body turned by ``angle`` and the map by ``earth_rate`` times ``dt``."""
    earth_turn = from_rotation_vector((-earth_rate[0] * dt, -earth_rate[1] * dt, -earth_rate[2] * dt))
    return normalized(multiply(multiply(earth_turn, attitude), from_rotation_vector(angle)))


@njit
def propagate_nominal_state(state, force_0, rate_0, force_1, rate_1, dt, coupling):
    """Advance the nominal state by ``dt`` s between two raw IMU readings (m/s2, rad/s; IMU axes).

    ``coupling``: 1, or 0 where the measured acceleration must not move the velocity. Returns the attitude in the middle
    of the interval (matrix, body to map), the mean specific force and the gravity (m/s2, map).
    """
    ba = state.accel_bias
    bg = state.gyro_bias
    angle, velocity_increment = increments(
        (force_0[0] - ba[0], force_0[1] - ba[1], force_0[2] - ba[2]),
        (rate_0[0] - bg[0], rate_0[1] - bg[1], rate_0[2] - bg[2]),
        (force_1[0] - ba[0], force_1[1] - ba[1], force_1[2] - ba[2]),
        (rate_1[0] - bg[0], rate_1[1] - bg[1], rate_1[2] - bg[2]),
        dt,
    )
    p = state.position_map
    v = state.velocity_map
    earth_rate = state.frame.earth_rate_map
    attitude = (state.attitude[0], state.attitude[1], state.attitude[2], state.attitude[3])
    middle = to_matrix(normalized(half_turned(attitude, angle)))
    dv = rotate(middle, velocity_increment)
    # The velocity increment belongs to mid-interval, when the map has turned by half of its own.
    turn = cross(earth_rate, dv)
    gravity = gravity_map(state, (p[0] + 0.5 * dt * v[0], p[1] + 0.5 * dt * v[1], p[2] + 0.5 * dt * v[2]))
    coriolis = cross(
        earth_rate,
        (
            v[0] + 0.5 * (dv[0] + gravity[0] * dt),
            v[1] + 0.5 * (dv[1] + gravity[1] * dt),
            v[2] + 0.5 * (dv[2] + gravity[2] * dt),
        ),
    )
    force = (dv[0] / dt, dv[1] / dt, dv[2] / dt)
    for i in range(3):
        new_velocity = v[i] + coupling * (dv[i] - 0.5 * dt * turn[i] + dt * (gravity[i] - 2.0 * coriolis[i]))
        if state.position_known == 0:
            new_velocity = 0.0
        p[i] += 0.5 * dt * (v[i] + new_velocity)
        v[i] = new_velocity
    attitude = turned(attitude, angle, earth_rate, dt)
    for i in range(4):
        state.attitude[i] = attitude[i]
    return middle, force, gravity
