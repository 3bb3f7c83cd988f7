"""Non-holonomic constraint: a wheeled vehicle moves neither sideways nor up and down where it does not steer.

Lateral and vertical velocity of the point ``nhc.position`` (the rear axle) in the axes of the vehicle are zero: left .
(R' v + omega x arm) = 0, and the same with up (Dissanayake et al., The aiding of a low-cost strapdown inertial
measurement unit using vehicle model constraints, 2001). No payload; the timeline puts it on its grid.

The constraint holds only approximately: tyres slip sideways by an angle that grows with the acceleration, springs let
the body pitch and roll with it, and even straight ahead the direction of travel differs a little from the vehicle's
axes (side wind, camber). The noise therefore has a constant part, and an angle times the speed that grows with the
acceleration. These errors last for seconds, longer than the spacing of the grid. The default angles are therefore about
twice what cars show: an error that lasts for 2 s and is in every constraint does as much harm as an independent error
of twice the size every second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.gyro_noise import gyro_noise_variance
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.measurements.jacobians import (
    clear,
    horizontal_acceleration,
    mounting_of,
    point_velocity,
    set_mounting,
    set_point_velocity_row,
    vehicle_axes,
)
from eskf_ros.filter.measurements.row import OptionalBlock, Row, arm_body
from eskf_ros.filter.measurements.zupt import CONSTRAINT_GATE_PROBABILITY
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.detector import has_block, mean_force
from eskf_ros.geodesy.rotation import cross, dot, to_matrix
from eskf_ros.parameters.schema import parameter

SIZE = 2

CERTAIN_HEADING = 0.17
"""rad; standard deviation of the heading above which the constraint is not applied: the direction of travel is unknown.
"""

SLIP_MEMORY = 1_500_000_000
"""ns; time after a wheel message outside the gate during which the wheels are assumed to slip."""

SLIPPING = 5.0
"""Factor on the standard deviations of the constraint while the wheels are assumed to slip."""


@njit
def arm_of(state, forward, settings):
    """Return the lever arm (m, IMU axes) of the constrained point; what is estimated of it lies along ``forward``."""
    arm, place = settings.nhc.arm_body, settings.nhc_position_at
    ahead = state.optional[place - ERROR_SIZE] if place < state.error_size else 0.0
    return (arm[0] + ahead * forward[0], arm[1] + ahead * forward[1], arm[2] + ahead * forward[2])


@njit
def predict(state, settings):
    """Return the lateral and the vertical velocity (m/s) of the constrained point."""
    rotation = to_matrix(state.attitude)
    forward, left, up = vehicle_axes(state, settings)
    arm = arm_of(state, forward, settings)
    velocity = point_velocity(state, rotation, body_rate(state, rotation), arm)
    return dot(left, velocity), dot(up, velocity)


@njit
def heading_variance(state):
    """Return the variance (rad2) of the heading."""
    return state.covariance[ATTITUDE + 2, ATTITUDE + 2]


@njit
def linearize(state, settings, work):
    """Write innovation, Jacobian and noise to ``work``; return the number of scalars, 0 if it is not applied."""
    if not has_block(state) or heading_variance(state) > CERTAIN_HEADING**2:
        return 0
    clear(work)
    rotation = to_matrix(state.attitude)
    forward, left, up = vehicle_axes(state, settings)
    arm, rate = arm_of(state, forward, settings), body_rate(state, rotation)
    speed = dot(forward, point_velocity(state, rotation, rate, arm))
    sideways, upwards = predict(state, settings)
    _yaw, pitch = mounting_of(state, settings)
    cosine, sine = math.cos(pitch), math.sin(pitch)

    work.innovation[0] = -sideways
    work.innovation[1] = -upwards
    set_point_velocity_row(work.jacobian, 0, left, 1.0, state, rotation, arm)
    set_point_velocity_row(work.jacobian, 1, up, 1.0, state, rotation, arm)
    set_mounting(work.jacobian, 0, -cosine * speed - sine * upwards, 0.0, state, settings)
    set_mounting(work.jacobian, 1, sine * sideways, speed, state, settings)

    if settings.nhc_position_at < state.error_size:
        # left . (omega x forward), and the same with up.
        work.jacobian[0, settings.nhc_position_at] = dot(up, rate)
        work.jacobian[1, settings.nhc_position_at] = -dot(left, rate)

    slip = settings.nhc.slip * horizontal_acceleration(state, rotation, mean_force(state))
    angle_variance = settings.nhc.angle_std**2 + slip**2
    loosening = 1.0
    if state.rest.slip_stamp != NEVER and state.stamp - state.rest.slip_stamp <= SLIP_MEMORY:
        loosening = SLIPPING**2
    rate_variance = gyro_noise_variance(state, settings)
    left_lever, up_lever = cross(left, arm), cross(up, arm)
    work.noise[0, 0] = loosening * (settings.nhc.lateral_std**2 + angle_variance * speed**2)
    work.noise[1, 1] = loosening * (settings.nhc.vertical_std**2 + angle_variance * speed**2)
    work.noise[0, 0] += rate_variance * dot(left_lever, left_lever)
    work.noise[1, 1] += rate_variance * dot(up_lever, up_lever)
    work.noise[0, 1] = rate_variance * dot(left_lever, up_lever)
    work.noise[1, 0] = work.noise[0, 1]
    return SIZE


@dataclass(frozen=True)
class Nhc:
    enabled: bool = parameter(
        False,
        "",
        "For vehicles on wheels: they move neither sideways nor up and down at the rear axle (non-holonomic "
        "constraint).",
        live=True,
    )
    position: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "m",
        "The point of base_link that does not move sideways: the middle of the axle that does not steer, usually the "
        "rear one.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    lateral_std: float = parameter(
        0.05,
        "m/s",
        "Standard deviation of the lateral velocity, however slow the vehicle is.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    vertical_std: float = parameter(
        0.1,
        "m/s",
        "The same of the vertical velocity: bumps and springs.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    angle_std_deg: float = parameter(
        0.3,
        "deg",
        "How far the direction of travel differs from the axes of the vehicle on a straight road (camber, side wind), "
        "as a standard deviation.",
        minimum=0.0,
        maximum=90.0,
        live=True,
    )
    slip: float = parameter(
        0.01,
        "rad s2/m",
        "What acceleration adds to this angle, by side slip of the tyres in turns, and by springs, for every m/s2. The "
        "default is about twice what a car shows, because these errors last for seconds.",
        minimum=0.0,
        maximum=1.0,
        live=True,
    )


SETTINGS = np.dtype(
    [
        ("arm_body", "f8", (3,)),
        ("lateral_std", "f8"),
        ("vertical_std", "f8"),
        ("angle_std", "f8"),
        ("slip", "f8"),
    ],
    align=True,
)
"""Lever arm of the constrained point (m, IMU axes), and the noise of the constraint: see `Nhc`."""


def describe(settings: np.void, parameters: Any) -> None:
    """Fill `SETTINGS` from the parameters."""
    nhc: Nhc = parameters.nhc
    settings["arm_body"] = arm_body(nhc.position, parameters)
    settings["lateral_std"] = nhc.lateral_std
    settings["vertical_std"] = nhc.vertical_std
    settings["angle_std"] = math.radians(nhc.angle_std_deg)
    settings["slip"] = nhc.slip


def is_enabled(parameters: Any) -> bool:
    """Say whether the constraint is switched on."""
    return bool(parameters.nhc.enabled)


def augmented(parameters: Any) -> tuple[OptionalBlock, ...]:
    """Return how far ahead of ``nhc.position`` the constrained point is."""
    estimate = parameters.estimate
    return (
        OptionalBlock(
            "nhc_position", is_on=estimate.nhc_position, std=estimate.nhc_position_std, streams=(Stream.NHC,)
        ),
    )


ROW = Row(
    Stream.NHC,
    "non-holonomic constraint",
    Nhc,
    "Non-holonomic constraint.",
    gate_probability=CONSTRAINT_GATE_PROBABILITY,
    settings=SETTINGS,
    augmented=augmented,
    describe=describe,
    is_enabled=is_enabled,
)
"""The facts of this measurement."""
