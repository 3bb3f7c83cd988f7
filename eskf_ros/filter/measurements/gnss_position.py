"""GNSS position of the antenna.

Payload: latitude, longitude (rad), ellipsoidal altitude (m), covariance in East-North-Up at the fix (m2: ee, en, eu,
nn, nu, uu); a mark if the altitude is missing, which is then the filter's own with a wide variance. Groves, section
14.3.1, for the local frame and a map-side attitude error.

A share of the variance may belong to a correlated error: per axis it is the standard deviation of the fix, times the
root of the share, times an augmented state of unit variance (first-order Gauss-Markov).
"""

from __future__ import annotations

import math
from typing import Any

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.antenna import (
    carry_position,
    lever_arm_block,
    lever_arm_of,
    set_lever_arm,
    time_offset_blocks,
)
from eskf_ros.filter.measurements.jacobians import (
    clear,
    let_heading_be_held,
    set_east_north_up_covariance,
    set_identity,
    set_minus_cross,
)
from eskf_ros.filter.measurements.row import NEEDS_LEVEL, OptionalBlock, Row, threefold
from eskf_ros.filter.measurements.stamp_noise import add_way_of_cut_stamp
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, POSITION
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic, geodetic_to_ecef
from eskf_ros.geodesy.rotation import rotate, rotate_back, to_matrix

SIZE = 3

NO_ALTITUDE = 9
"""Place in the payload of the mark (1) of a fix without altitude."""

UNKNOWN_ALTITUDE_VARIANCE = 1e8
"""m2; of the altitude that stands in for one that is missing: 10 km, which tells the filter nothing."""

LEAST_WHITE = 0.1
"""Least share of the claimed variance that is taken for new with every fix."""


@njit
def position_of_fix(state, payload):
    """Return the map position (m) of a fix."""
    fix = geodetic_to_ecef(payload[0], payload[1], payload[2])
    offset = (
        fix[0] - state.frame.origin_ecef[0],
        fix[1] - state.frame.origin_ecef[1],
        fix[2] - state.frame.origin_ecef[2],
    )
    return rotate_back(state.frame.map_to_ecef, offset)


@njit
def predict(state, source, settings):
    """Return the map position (m) of the antenna of receiver ``source``: position + R lever_arm."""
    lever = rotate(to_matrix(state.attitude), lever_arm_of(state, source, settings))
    return (state.position_map[0] + lever[0], state.position_map[1] + lever[1], state.position_map[2] + lever[2])


@njit
def fill_altitude(state, payload, source, settings):
    """Let the filter's own altitude (m) of the antenna stand in where a fix has none; its variance is wide anyway."""
    if payload[NO_ALTITUDE] == 0.0:
        return
    if state.frame.datum_known == 0:
        # Not what an earlier pass has left there: the result must not depend on the order of arrival.
        payload[2] = 0.0
        return
    position = (0.0, 0.0, 0.0)
    if state.position_known == 1:
        position = predict(state, source, settings)
    offset, origin = rotate(state.frame.map_to_ecef, position), state.frame.origin_ecef
    geodetic = ecef_to_geodetic(origin[0] + offset[0], origin[1] + offset[1], origin[2] + offset[2])
    payload[2] = geodetic[2]


@njit
def noise_shares(state, source, settings):
    """Return the variance of fixes that is new with each fix, and the one that lasts, over what they claim."""
    if settings.correlated_share > 0.0:
        return 1.0 - settings.correlated_share, settings.correlated_share
    return max(state.scatter.white[source], LEAST_WHITE), state.scatter.lasting[source]


@njit
def split_noise(state, source, settings, work):
    """Scale the noise of a fix in ``work`` to the share that is new; give the lasting one to its augmented states."""
    white, lasting = noise_shares(state, source, settings)
    place = settings.position_error_at
    if lasting > 0.0 and place < state.error_size:
        for i in range(SIZE):
            std = math.sqrt(lasting * work.noise[i, i])
            work.jacobian[i, place + i] = std
            work.innovation[i] -= std * state.optional[place - ERROR_SIZE + i]
    for i in range(SIZE):
        for j in range(SIZE):
            work.noise[i, j] *= white


@njit
def linearize(state, payload, source, settings, work):
    """Write innovation, Jacobian and noise of one fix to ``work``; return the number of scalars."""
    clear(work)
    set_east_north_up_covariance(work.noise, state, east_north_up_to_ecef(payload[0], payload[1]), payload, 3)
    linearize_antenna(state, position_of_fix(state, payload), source, settings, work)
    split_noise(state, source, settings, work)
    add_way_of_cut_stamp(state, source, work)
    if state.heading_known == 0:
        add_unknown_lever(state, source, settings, work)
    return SIZE


@njit
def linearize_antenna(state, measured, source, settings, work):
    """Write innovation and Jacobian of a position (m, map) of the antenna of ``source`` to ``work``, which is clear."""
    let_heading_be_held(work, settings)
    predicted = predict(state, source, settings)
    for i in range(3):
        work.innovation[i] = measured[i] - predicted[i]
    set_identity(work.jacobian, POSITION)
    if state.heading_known == 1:
        rotation = to_matrix(state.attitude)
        set_minus_cross(work.jacobian, ATTITUDE, rotate(rotation, lever_arm_of(state, source, settings)))
        set_lever_arm(work.jacobian, state, rotation, source, False, settings)
        carry_position(state, rotation, source, settings, work)


@njit
def add_unknown_lever(state, source, settings, work):
    """Add to the noise that the lever arm points anywhere around the vertical while the heading is unknown.

    It turns with the body, and is another one for a second antenna, but it is not new with each fix.
    """
    lever = rotate(to_matrix(state.attitude), lever_arm_of(state, source, settings))
    work.lever_noise = lever[0] ** 2 + lever[1] ** 2
    for i in range(2):
        work.noise[i, i] += work.lever_noise


@njit
def claimed_noise(work, i):
    """Return the part of the variance (m2, axis ``i`` of map) of the fix in ``work`` that is new with each fix."""
    return work.noise[i, i] - work.lever_noise if i < 2 else work.noise[i, i]


def limits(gnss: Any) -> dict[str, Any]:
    """Return the fields of the `Intake`; the stand-in for an unknown covariance depends on the status of the fix."""
    return {
        "is_used": gnss.use_position,
        "std_floor": threefold(gnss.position_std_floor),
        "unknown_std": threefold(math.nan),
        "largest": math.inf,
    }


def augmented(parameters: Any) -> tuple[OptionalBlock, ...]:
    """Return the correlated error of the fixes or, in mode tight, of the ranges; lever arm and time offsets."""
    time = parameters.ranges.correlation_time if parameters.mode == "tight" else parameters.gnss.correlation_time
    return (
        OptionalBlock(
            "position_error",
            is_on=time > 0.0,
            std=1.0,
            noise_density=math.sqrt(2.0 / time) if time else 0.0,
            correlation_time=time,
            streams=(Stream.GNSS_POSITION,) if parameters.gnss.correlated_share > 0.0 else (),
        ),
        lever_arm_block(parameters.estimate),
        *time_offset_blocks(parameters.estimate),
    )


ROW = Row(
    Stream.GNSS_POSITION,
    "GNSS position",
    group_name="gnss",
    types=("sensor_msgs/msg/NavSatFix",),
    limits=limits,
    depth=50,
    is_gnss=True,
    needs=NEEDS_LEVEL,
    augmented=augmented,
    columns=("latitude_deg", "longitude_deg", "altitude"),
)
"""The facts of this measurement."""
