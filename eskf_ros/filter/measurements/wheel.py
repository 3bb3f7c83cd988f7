"""Wheel odometry: forward speed of a point of the vehicle, and its yaw rate.

Payload: speed (m/s), yaw rate (rad/s), 0, covariance (ss, sy, 0, yy, 0, absent); an unmeasured value has the variance
-1. The speed is that of the point ``wheel.position`` along the x axis of the vehicle, forward . (R' v + omega x arm),
times one plus the scale error; the yaw rate is that about the vehicle's z axis (Groves, section 16.1.1, with attitude,
gyro bias, scale and mounting in the Jacobian).

The covariance of the message is that of the independent noise of each message. Lasting errors are added here: tyres
slip by a share of the speed that grows with the force on them, and wheels of unequal size turn a straight line into a
curve. An error that lasts for T s and is in every message, dt s apart, does as much harm as an independent one with 2 T
/ dt times the variance (the spectral densities of the two at low frequencies are equal).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, XY, YY
from eskf_ros.filter.inertial.gyro_noise import gyro_noise_variance
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.measurements.jacobians import (
    clear,
    horizontal_acceleration,
    mounting_of,
    point_velocity,
    set_mounting,
    set_point_velocity_row,
    vehicle_axes,
)
from eskf_ros.filter.measurements.row import (
    BARE_TWIST,
    HIGHEST_SPEED,
    ODOMETRY,
    TWIST,
    UNMEASURED,
    OptionalBlock,
    Readings,
    Row,
    arm_body,
    twist_covariances,
)
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, GYRO_BIAS
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix
from eskf_ros.parameters.schema import Aid, parameter

LASTING_SPEED_ERROR = 0.001
"""Lasting error of the speed, as a share of it, even without a force on the tyres."""

SLIP_TIME = 1.0
"""s; errors of the speed last for this long."""

LASTING_TURN_ERROR = 0.03
"""Lasting error of the yaw rate, as a share of it: tyres that are squeezed and slip change the effective track."""

UNEQUAL_WHEELS = 7e-4
"""Yaw rate (rad/s) at 1 m/s by wheels of unequal size: 0.1 % of their radius, 1.5 m apart."""

TURN_ERROR_TIME = 60.0
"""s; errors of the yaw rate by load and tyre pressure last for this long."""

SHORTEST_INTERVAL = 0.001
"""s; least time between two messages that counts."""


@njit
def scale_of(state, settings):
    """Return the ratio of the speed that the wheels report to the true one."""
    place = settings.wheel_scale_at
    if place >= state.error_size:
        return settings.wheel.scale
    return settings.wheel.scale + state.optional[place - ERROR_SIZE]


@njit
def predict(state, settings):
    """Return the speed (m/s) and the yaw rate (rad/s) that the wheels should measure."""
    rotation = to_matrix(state.attitude)
    rate = body_rate(state, rotation)
    forward, _left, up = vehicle_axes(state, settings)
    velocity = point_velocity(state, rotation, rate, settings.wheel.arm_body)
    return scale_of(state, settings) * dot(forward, velocity), dot(up, rate)


@njit
def forward_acceleration(state, rotation, rate, forward):
    """Return the derivative (m/s2) of the speed along ``forward`` (unit vector, IMU axes), without vibration.

    forward . (f + R' g - omega x R' v): the time offset of the wheels, where it is estimated, acts through it.
    """
    force, bias = state.imu.smooth_force, state.accel_bias
    gravity = gravity_map(state, (state.position_map[0], state.position_map[1], state.position_map[2]))
    pull = rotate_back(rotation, gravity)
    turning = cross(rate, rotate_back(rotation, state.velocity_map))
    total = 0.0
    for i in range(3):
        total += forward[i] * (force[i] - bias[i] + pull[i] - turning[i])
    return total


@njit
def repeated(state, time):
    """Return the factor on the variance of an error that lasts for ``time`` s and is in every message."""
    if state.rest.wheel_stamp == NEVER:
        return 1.0
    interval = max((state.stamp - state.rest.wheel_stamp) * 1e-9, SHORTEST_INTERVAL)
    return max(1.0, 2.0 * time / interval)


@njit
def linearize(state, payload, settings, work):
    """Write innovation, Jacobian and noise of one message to ``work``; return the number of scalars."""
    clear(work)
    rotation = to_matrix(state.attitude)
    rate = body_rate(state, rotation)
    arm = settings.wheel.arm_body
    forward, left, up = vehicle_axes(state, settings)
    velocity = point_velocity(state, rotation, rate, arm)
    speed, scale = dot(forward, velocity), scale_of(state, settings)
    predicted_speed, turn_rate = predict(state, settings)
    _yaw, pitch = mounting_of(state, settings)
    cosine, sine = math.cos(pitch), math.sin(pitch)
    rate_variance = gyro_noise_variance(state, settings)
    lever = cross(forward, arm)

    size = 0
    if payload[XX] >= 0.0:
        work.innovation[0] = payload[0] - predicted_speed
        if settings.wheel_time_offset_at < state.error_size:
            change = scale * forward_acceleration(state, rotation, rate, forward)
            work.innovation[0] -= change * state.optional[settings.wheel_time_offset_at - ERROR_SIZE]
            work.jacobian[0, settings.wheel_time_offset_at] = change
        set_point_velocity_row(work.jacobian, 0, forward, scale, state, rotation, arm)
        sideways, upwards = dot(left, velocity), dot(up, velocity)
        set_mounting(work.jacobian, 0, scale * cosine * sideways, -scale * upwards, state, settings)
        if settings.wheel_scale_at < state.error_size:
            work.jacobian[0, settings.wheel_scale_at] = speed
        acceleration = horizontal_acceleration(state, rotation, state.specific_force)
        slip = speed * (LASTING_SPEED_ERROR + settings.wheel.slip * acceleration)
        work.noise[0, 0] = payload[XX] + repeated(state, SLIP_TIME) * slip**2
        work.noise[0, 0] += scale**2 * rate_variance * dot(lever, lever)
        size = 1
    if payload[YY] >= 0.0:
        work.innovation[size] = payload[1] - turn_rate
        earth = cross(rotate(rotation, up), state.frame.earth_rate_map)
        for j in range(3):
            work.jacobian[size, ATTITUDE + j] = -earth[j]
            work.jacobian[size, GYRO_BIAS + j] = -up[j]
        set_mounting(work.jacobian, size, sine * dot(left, rate), dot(forward, rate), state, settings)
        lasting = (LASTING_TURN_ERROR * turn_rate) ** 2 + (UNEQUAL_WHEELS * speed) ** 2
        work.noise[size, size] = payload[YY] + repeated(state, TURN_ERROR_TIME) * lasting + rate_variance
        if size == 1:
            # The noise of the gyro is in both predictions.
            shared = payload[XY] - scale * rate_variance * dot(lever, up)
            work.noise[0, 1] = shared
            work.noise[1, 0] = shared
        size += 1
    return size


@dataclass(frozen=True)
class Wheel(Aid):
    position: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "m",
        "The point of base_link whose forward speed the wheels show: the middle of the axle they are on, or the place "
        "of a single wheel.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    scale: float = parameter(
        1.0,
        "",
        "The ratio of the speed that the wheels report to the true one; estimate.wheel_scale finds what it lacks.",
        minimum=0.5,
        maximum=2.0,
    )
    slip: float = parameter(
        0.005,
        "s2/m",
        "Tyres slip by this share of the speed for every m/s2 of acceleration. The default is that of a car on dry "
        "asphalt; loose ground takes several times as much.",
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    speed_std_floor: float = parameter(
        0.05,
        "m/s",
        "The standard deviation of the speed is never taken smaller than this.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    yaw_rate_std_floor: float = parameter(
        0.02,
        "rad/s",
        "The standard deviation of the yaw rate is never taken smaller than this.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    unknown_speed_std: float = parameter(
        0.1, "m/s", "Standard deviation of the speed where the message gives none.", above=0.0, maximum=100.0, live=True
    )
    unknown_yaw_rate_std: float = parameter(
        0.1,
        "rad/s",
        "Standard deviation of the yaw rate where the message gives none.",
        above=0.0,
        maximum=10.0,
        live=True,
    )


SETTINGS = np.dtype([("arm_body", "f8", (3,)), ("scale", "f8"), ("slip", "f8")], align=True)
"""Lever arm of the wheel point (m, IMU axes); scale of the speed; slip as a share of the speed per m/s2."""


def read(messages: npt.NDArray[Any]) -> Readings:
    """Return speed along x (m/s) and yaw rate (rad/s) of twists with their covariances; the third axis is absent."""
    values, covariances = np.zeros((len(messages), 3)), np.zeros((len(messages), 9))
    values[:, 0] = messages["linear_velocity"][:, 0]
    values[:, 1] = messages["angular_velocity"][:, 2]
    of_both = twist_covariances(messages)[:, [0, 0, 5, 5], [0, 5, 0, 5]]
    covariances[:, [0, 1, 3, 4]] = of_both
    # All zero stays all zero: unknown.
    covariances[of_both.any(axis=1), 8] = UNMEASURED
    return values, covariances


def limits(wheel: Wheel) -> dict[str, Any]:
    """Return the fields of the `Intake` that the parameters of this measurement determine."""
    return {
        "std_floor": (wheel.speed_std_floor, wheel.yaw_rate_std_floor, 1.0),
        "unknown_std": (wheel.unknown_speed_std, wheel.unknown_yaw_rate_std, 1.0),
        "largest": HIGHEST_SPEED,
        "may_lack_axes": True,
    }


def describe(settings: np.void, parameters: Any) -> None:
    """Fill `SETTINGS` from the parameters."""
    settings["arm_body"] = arm_body(parameters.wheel.position, parameters)
    settings["scale"] = parameters.wheel.scale
    settings["slip"] = parameters.wheel.slip


def augmented(parameters: Any) -> tuple[OptionalBlock, ...]:
    """Return the mounting of the vehicle's axes, which the NHC needs, too, scale and time offset of the speed."""
    estimate = parameters.estimate
    return (
        OptionalBlock(
            "mounting",
            is_on=estimate.mounting,
            std=math.radians(estimate.mounting_std_deg),
            noise_density=estimate.mounting_random_walk,
            streams=(Stream.NHC, Stream.WHEEL),
        ),
        OptionalBlock(
            "wheel_scale",
            is_on=estimate.wheel_scale,
            std=estimate.wheel_scale_std,
            noise_density=estimate.wheel_scale_random_walk,
            streams=(Stream.WHEEL,),
        ),
        OptionalBlock(
            "wheel_time_offset",
            is_on=estimate.time_offset,
            std=estimate.time_offset_std,
            streams=(Stream.WHEEL,),
        ),
    )


ROW = Row(
    Stream.WHEEL,
    "wheel odometry",
    Wheel,
    "Wheel odometry.",
    types=(ODOMETRY, TWIST, BARE_TWIST),
    topic="wheel/odom",
    topic_about="nav_msgs/Odometry: wheel odometry, of which speed and yaw rate are used.",
    read=read,
    limits=limits,
    augmented=augmented,
    settings=SETTINGS,
    describe=describe,
    columns=("speed", "yaw_rate"),
    optional_column="yaw_rate",
    has_one_unit=False,
)
"""The facts of this measurement."""
