"""GNSS velocity of the antenna relative to the Earth.

Payload: velocity east, north, up (m/s), covariance (m2/s2: ee, en, eu, nn, nu, uu). The antenna moves with
velocity + R (omega x lever_arm), omega the body rate relative to the Earth, free of the gyro bias (Groves, section
14.3.1; here the Jacobian also has the attitude, through R and through the Earth rate in body axes, and the gyro bias).
"""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.gyro_noise import gyro_noise_variance
from eskf_ros.filter.inertial.navigation_frame import body_rate, local_east_north_up_to_ecef
from eskf_ros.filter.inertial.sample_doubt import shaken_velocity
from eskf_ros.filter.measurements.antenna import antenna_velocity, carry_velocity, lever_arm_of, set_lever_arm
from eskf_ros.filter.measurements.jacobians import (
    clear,
    let_heading_be_held,
    set_east_north_up_covariance,
    set_identity,
    set_minus_cross,
)
from eskf_ros.filter.measurements.row import (
    BARE_TWIST,
    HIGHEST_SPEED,
    NEEDS_POSITION,
    TWIST,
    Readings,
    Row,
    linear_covariances,
    threefold,
)
from eskf_ros.filter.measurements.stamp_noise import add_gain_of_cut_stamp
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, GYRO_BIAS, VELOCITY
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix

SIZE = 3

LEAST_SHAKEN = 0.02
"""m/s; vibration that moves the velocity to and fro by less is within what receivers claim."""

SWING = 2.0
"""Noise of a velocity over its swing by vibration (standard deviations): it turns with the heading, and must not be
thought to show it.
"""


NOTABLE_SCATTER = 2.0
"""Ratio of the scatter of velocities to the variance they claim above which their noise is inflated."""


@njit
def noise_factor(state, source):
    """Return the factor on the covariances of velocities that their scatter demands (see `integrity.scatter`)."""
    ratio = state.scatter.velocity[source]
    return ratio if ratio > NOTABLE_SCATTER else 1.0


@njit
def predict(state, source, settings):
    """Return the velocity (m/s, map) of the antenna of receiver ``source``."""
    return antenna_velocity(state, to_matrix(state.attitude), source, settings)


@njit
def linearize(state, payload, source, settings, work):
    """Write innovation, Jacobian and noise of one velocity to ``work``; return the number of scalars."""
    clear(work)
    local_to_ecef = local_east_north_up_to_ecef(state)
    measured = rotate_back(state.frame.map_to_ecef, rotate(local_to_ecef, (payload[0], payload[1], payload[2])))
    set_east_north_up_covariance(work.noise, state, local_to_ecef, payload, 3)
    factor = noise_factor(state, source)
    for i in range(SIZE):
        for j in range(SIZE):
            work.noise[i, j] *= factor
    add_gain_of_cut_stamp(state, source, work)
    linearize_antenna(state, measured, source, settings, work)
    return SIZE


@njit
def linearize_antenna(state, measured, source, settings, work):
    """Add innovation and Jacobian of a velocity (m/s, map) of the antenna of ``source`` to ``work``.

    Its noise is there; the noise of the gyro, which is part of the prediction, is added to it.
    """
    let_heading_be_held(work, settings)
    predicted = predict(state, source, settings)
    for i in range(3):
        work.innovation[i] = measured[i] - predicted[i]
    set_identity(work.jacobian, VELOCITY)
    rotation = to_matrix(state.attitude)
    arm = lever_arm_of(state, source, settings)
    lever = rotate(rotation, arm)
    lever_velocity = rotate(rotation, cross(body_rate(state, rotation), arm))
    # The gyro reading of this instant carries the white noise of one sample.
    rate_variance = gyro_noise_variance(state, settings)
    for i in range(3):
        for j in range(3):
            work.noise[i, j] -= rate_variance * lever[i] * lever[j]
        work.noise[i, i] += rate_variance * dot(lever, lever)
    add_unmeasured_motion(state, rotation, arm, work)
    if state.heading_known == 0:
        for i in range(3):
            work.noise[i, i] += dot(lever_velocity, lever_velocity)
        return
    set_minus_cross(work.jacobian, ATTITUDE, lever_velocity)
    # An attitude error also turns the Earth rate into the body: [lever]x [Earth rate]x theta.
    earth = state.frame.earth_rate_map
    along = dot(lever, earth)
    for i in range(3):
        for j in range(3):
            work.jacobian[i, ATTITUDE + j] += earth[i] * lever[j]
        work.jacobian[i, ATTITUDE + i] -= along
    # R [lever_arm]x for the gyro bias.
    for i in range(3):
        row = cross((rotation[i][0], rotation[i][1], rotation[i][2]), arm)
        for j in range(3):
            work.jacobian[i, GYRO_BIAS + j] = row[j]
    set_lever_arm(work.jacobian, state, rotation, source, True, settings)
    carry_velocity(state, rotation, source, settings, work)


@njit
def add_unmeasured_motion(state, rotation, arm, work):
    """Add to the noise what vibration makes of the predicted velocity, and the rates that the gyro does not measure.

    The latter move the antenna at ``arm`` (m, IMU axes); ``rotation``: body to map.
    """
    shaken = shaken_velocity(state.quality, state.imu.interval)
    if shaken > LEAST_SHAKEN:
        for i in range(3):
            work.noise[i, i] += (SWING * shaken) ** 2
    if state.quality.is_doubted == 0:
        return
    for k in range(3):
        axis = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0)
        moved = rotate(rotation, cross(axis, arm))
        variance = state.quality.error[3 + k] ** 2
        for i in range(3):
            for j in range(3):
                work.noise[i, j] += variance * moved[i] * moved[j]


def read(messages: npt.NDArray[Any]) -> Readings:
    """Return velocities (m/s) of the antenna, East-North-Up, with their covariances."""
    return messages["linear_velocity"], linear_covariances(messages)


def limits(gnss: Any) -> dict[str, Any]:
    """Return the fields of the `Intake` that the parameters of this measurement determine."""
    return {
        "is_used": gnss.use_velocity,
        "std_floor": threefold(gnss.velocity_std_floor),
        "unknown_std": threefold(gnss.unknown_velocity_std),
        "largest": HIGHEST_SPEED,
    }


ROW = Row(
    Stream.GNSS_VELOCITY,
    "GNSS velocity",
    group_name="gnss",
    types=(TWIST, BARE_TWIST),
    read=read,
    limits=limits,
    depth=50,
    is_gnss=True,
    needs=NEEDS_POSITION,
    columns=("velocity",),
    is_vector=True,
)
"""The facts of this measurement."""
