"""Velocity of a point of the vehicle in the axes of its sensor: DVL, optical flow, radar, odometry of any kind.

Payload: velocity (m/s, axes of the sensor), covariance (xx, xy, xz, yy, yz, zz); an axis with variance -1 was not
measured. Along each axis a of the sensor, a . (R' v + omega x arm), omega the body rate relative to the Earth, free of
the gyro bias (Groves, section 14.3.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.gyro_noise import gyro_noise_variance
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.measurements.jacobians import clear, point_velocity, set_point_velocity_row
from eskf_ros.filter.measurements.row import (
    BARE_TWIST,
    HIGHEST_SPEED,
    ODOMETRY,
    TWIST,
    Place,
    Readings,
    Row,
    arm_body,
    linear_covariances,
    threefold,
    to_base,
)
from eskf_ros.filter.state.enums import Stream
from eskf_ros.geodesy.rotation import cross, dot, to_matrix
from eskf_ros.parameters.schema import Aid, parameter

COVARIANCES = ((3, 4, 5), (4, 6, 7), (5, 7, 8))
"""Index in the payload of the covariance of two axes."""


@njit
def axis_of(settings, i):
    """Return axis ``i`` of the sensor as a unit vector in IMU axes."""
    axes = settings.body_velocity.axes_body
    return (axes[i, 0], axes[i, 1], axes[i, 2])


@njit
def predict(state, settings):
    """Return the velocity (m/s) that the sensor should measure along its three axes."""
    rotation = to_matrix(state.attitude)
    velocity = point_velocity(state, rotation, body_rate(state, rotation), settings.body_velocity.arm_body)
    return (
        dot(axis_of(settings, 0), velocity),
        dot(axis_of(settings, 1), velocity),
        dot(axis_of(settings, 2), velocity),
    )


@njit
def linearize(state, payload, settings, work):
    """Write innovation, Jacobian and noise of the measured axes to ``work``; return how many there are."""
    clear(work)
    rotation = to_matrix(state.attitude)
    arm = settings.body_velocity.arm_body
    predicted = predict(state, settings)
    rate_variance = gyro_noise_variance(state, settings)
    row = 0
    for i in range(3):
        if payload[COVARIANCES[i][i]] < 0.0:
            continue
        axis = axis_of(settings, i)
        work.innovation[row] = payload[i] - predicted[i]
        set_point_velocity_row(work.jacobian, row, axis, 1.0, state, rotation, arm)
        lever = cross(axis, arm)
        column = 0
        for j in range(i + 1):
            if payload[COVARIANCES[j][j]] < 0.0:
                continue
            # The noise of the gyro is in the predictions of all axes.
            shared = rate_variance * dot(lever, cross(axis_of(settings, j), arm))
            work.noise[row, column] = payload[COVARIANCES[i][j]] + shared
            work.noise[column, row] = work.noise[row, column]
            column += 1
        row += 1
    return row


@dataclass(frozen=True)
class BodyVelocity(Aid):
    std_floor: float = parameter(
        0.02,
        "m/s",
        "The standard deviation per axis is never taken smaller than this.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    unknown_std: float = parameter(
        0.2, "m/s", "Standard deviation per axis where the message gives none.", above=0.0, maximum=100.0, live=True
    )
    mount_position: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), "m", "Position of the sensor in base_link.", minimum=-1000.0, maximum=1000.0
    )
    mount_rpy_deg: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "deg",
        "Orientation of the axes of its velocity in base_link: roll, pitch, yaw about fixed axes as in a URDF.",
        minimum=-360.0,
        maximum=360.0,
    )


SETTINGS = np.dtype([("arm_body", "f8", (3,)), ("axes_body", "f8", (3, 3))], align=True)
"""Lever arm of the sensor (m, IMU axes), and the axes of its velocity as rows (IMU axes)."""


def read(messages: npt.NDArray[Any]) -> Readings:
    """Return velocities (m/s, axes of the sensor) with their covariances."""
    return messages["linear_velocity"], linear_covariances(messages)


def limits(body: BodyVelocity) -> dict[str, Any]:
    """Return the fields of the `Intake` that the parameters of this measurement determine."""
    return {
        "std_floor": threefold(body.std_floor),
        "unknown_std": threefold(body.unknown_std),
        "largest": HIGHEST_SPEED,
        "may_lack_axes": True,
    }


def describe(settings: np.void, parameters: Any) -> None:
    """Fill `SETTINGS` from the parameters."""
    body: BodyVelocity = parameters.body_velocity
    settings["arm_body"] = arm_body(body.mount_position, parameters)
    settings["axes_body"] = to_base(body.mount_rpy_deg).T @ to_base(parameters.imu.mount_rpy_deg)


ROW = Row(
    Stream.BODY_VELOCITY,
    "velocity sensor",
    BodyVelocity,
    "Velocity in the axes of the vehicle.",
    types=(TWIST, BARE_TWIST, ODOMETRY),
    topic="body_velocity",
    topic_about="geometry_msgs/TwistWithCovarianceStamped: velocity in the axes of the vehicle, of a DVL, optical "
    "flow, radar or odometry of any kind; an axis with a negative variance is absent.",
    read=read,
    limits=limits,
    place=Place("body_velocity.mount_position", "body_velocity.mount_rpy_deg", ("body_velocity",)),
    settings=SETTINGS,
    describe=describe,
    columns=("velocity",),
    is_vector=True,
)
"""The facts of this measurement."""
