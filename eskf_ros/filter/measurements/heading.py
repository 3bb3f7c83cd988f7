"""Heading of a line that is fixed to the body: the baseline of a dual-antenna receiver.

Payload: yaw of the line (rad, counter-clockwise from east) and its pitch (rad, positive down, REP-103), both in local
axes at the present position, and their covariance (rad2) in the first two axes; either may be absent. With d the line
in local East-North-Up, yaw = atan2(d_n, d_e) and pitch = atan2(-d_u, |d_e, d_n|); a small rotation theta about local
axes adds theta x d to d.

The common error of all yaws, from mounting and slow multipath, is an augmented state: measured = yaw + offset.

The line of source 1 is the x axis of base_link: the orientation of an IMU with its own filter, perhaps from magnetic
north. It serves for the initial heading only (`heading_sensors`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, XY, YY
from eskf_ros.filter.inertial.navigation_frame import local_east_north_up_to_ecef
from eskf_ros.filter.measurements.jacobians import azimuth_change, clear, set_attitude_row, to_local
from eskf_ros.filter.measurements.row import (
    NEEDS_POSITION,
    UNMEASURED,
    OptionalBlock,
    Place,
    Readings,
    Row,
    threefold,
    to_base,
)
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, SOURCES
from eskf_ros.geodesy.rotation import wrapped
from eskf_ros.parameters.schema import Aid, parameter

IMU_ORIENTATION = 1
"""Source of the orientation of an IMU with its own filter; 0 is the dual antenna."""

STEEPEST = 0.17
"""Cosine of the steepest pitch (80 degrees) at which a line still has a heading."""


@njit
def predict(state, source, settings):
    """Return yaw and pitch (rad) of the line of ``source``."""
    line = settings.heading.lines_body[source]
    d = to_local(state, local_east_north_up_to_ecef(state), (line[0], line[1], line[2]))
    return math.atan2(d[1], d[0]), math.atan2(-d[2], math.sqrt(d[0] ** 2 + d[1] ** 2))


@njit
def linearize(state, payload, source, settings, work):
    """Write innovation, Jacobian and noise of the measured ones of yaw and pitch to ``work``; return the size."""
    clear(work)
    yaw = payload[0]
    if source == IMU_ORIENTATION and settings.heading.is_orientation_magnetic == 1:
        if state.mag.field_known == 0:
            return 0
        yaw -= state.mag.declination
    line = settings.heading.lines_body[source]
    local_to_ecef = local_east_north_up_to_ecef(state)
    d = to_local(state, local_to_ecef, (line[0], line[1], line[2]))
    level_square = d[0] ** 2 + d[1] ** 2
    if level_square < STEEPEST**2:
        return 0
    level = math.sqrt(level_square)
    predicted_yaw, predicted_pitch = predict(state, source, settings)
    size = 0
    if payload[XX] > 0.0:
        place = settings.heading_offset_at
        if source == 0 and place < state.error_size:
            yaw -= state.optional[place - ERROR_SIZE]
            work.jacobian[0, place] = 1.0
        work.innovation[0] = wrapped(yaw - predicted_yaw)
        set_attitude_row(work.jacobian, 0, state, local_to_ecef, azimuth_change(d, level_square))
        work.noise[0, 0] = payload[XX]
        size = 1
    if payload[YY] > 0.0:
        work.innovation[size] = payload[1] - predicted_pitch
        set_attitude_row(work.jacobian, size, state, local_to_ecef, (-d[1] / level, d[0] / level, 0.0))
        if size == 1:
            work.noise[0, 1] = payload[XY]
            work.noise[1, 0] = payload[XY]
        work.noise[size, size] = payload[YY]
        size += 1
    return size


@dataclass(frozen=True)
class Heading(Aid):
    mount_rpy_deg: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "deg",
        "Orientation of the baseline in base_link, whose yaw and pitch the messages tell: roll, pitch, yaw about fixed "
        "axes as in a URDF, of a frame whose x axis leads from the first antenna (of u-blox: the moving base) to the "
        "second. [0.0, 0.0, 0.0]: the second is in front; [0.0, 0.0, 90.0]: it is on the left; [0.0, 0.0, 180.0]: it "
        "is behind.",
        minimum=-360.0,
        maximum=360.0,
    )
    offset_std_deg: float = parameter(
        0.5,
        "deg",
        "Standard deviation at first of what all messages are wrong by alike: how well the baseline is known in "
        "base_link, and multipath at the antennas. It is estimated as the vehicle accelerates; 0: there is none.",
        minimum=0.0,
        maximum=90.0,
    )
    offset_random_walk: float = parameter(
        2.0e-4,
        "rad/rtHz",
        "How fast that wanders: by this value times the square root of the seconds passed. The default is 0.36 deg in "
        "1000 s.",
        minimum=0.0,
        maximum=1.0,
    )
    std_floor_deg: float = parameter(
        0.2, "deg", "The standard deviation is never taken smaller than this.", above=0.0, maximum=90.0, live=True
    )
    unknown_std_deg: float = parameter(
        1.0, "deg", "Standard deviation where the message gives none.", above=0.0, maximum=90.0, live=True
    )


SETTINGS = np.dtype([("lines_body", "f8", (SOURCES, 3)), ("is_orientation_magnetic", "i8")], align=True)
"""Baseline of the dual antenna and x axis of base_link (unit vectors, IMU axes); whether the IMU's own orientation
refers to magnetic north.
"""

LARGEST_ANGLE = 2.0 * math.pi
"""rad; no driver reports a larger yaw or pitch."""

UNKNOWN_ANGLE_VARIANCE = 1.0
"""rad2; a larger variance, such as 1000 or pi^2, means that the driver does not know the angle."""


def read(messages: npt.NDArray[Any]) -> Readings:
    """Return yaw (0 = east, counter-clockwise) and pitch (positive down) of orientations, in rad, with their variances.

    A missing orientation (REP-145) leaves all axes absent; one that is no unit quaternion becomes NaN.
    """
    x, y, z, w = messages["orientation"].T
    values, covariances = np.zeros((len(messages), 3)), np.zeros((len(messages), 9))
    values[:, 0] = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    values[:, 1] = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    given = messages["orientation_covariance"]
    covariances[:, 0], covariances[:, 4] = given[:, 8], given[:, 4]
    covariances[given.any(axis=1), 8] = UNMEASURED
    # Drivers that measure the yaw only leave the pitch and its variance zero.
    covariances[(given[:, 8] > 0.0) & (given[:, 4] == 0.0), 4] = UNMEASURED
    covariances[given[:, 0] == UNMEASURED] = UNMEASURED
    values[np.abs(x * x + y * y + z * z + w * w - 1.0) > 0.1] = math.nan
    return values, covariances


def limits(heading: Heading) -> dict[str, Any]:
    """Return the fields of the `Intake`, angles in rad."""
    return {
        "std_floor": threefold(math.radians(heading.std_floor_deg)),
        # The stand-in of the pitch is NaN: without a covariance the pitch is not used.
        "unknown_std": (math.radians(heading.unknown_std_deg), math.nan, math.nan),
        "largest": LARGEST_ANGLE,
        "may_lack_axes": True,
        "largest_variance": UNKNOWN_ANGLE_VARIANCE,
    }


def describe(settings: np.void, parameters: Any) -> None:
    """Fill `SETTINGS` from the parameters."""
    baseline = to_base(parameters.heading.mount_rpy_deg)[:, 0]
    settings["lines_body"] = np.array([baseline, (1.0, 0.0, 0.0)]) @ to_base(parameters.imu.mount_rpy_deg)
    settings["is_orientation_magnetic"] = parameters.alignment.imu_orientation == "magnetic_north"


def augmented(parameters: Any) -> tuple[OptionalBlock, ...]:
    """Return the constant difference between the true direction of the baseline and its mounting angle."""
    heading: Heading = parameters.heading
    return (
        OptionalBlock(
            "heading_offset",
            is_on=heading.offset_std_deg > 0.0,
            std=math.radians(heading.offset_std_deg),
            noise_density=heading.offset_random_walk,
            streams=(Stream.HEADING,),
        ),
    )


ROW = Row(
    Stream.HEADING,
    "dual antenna",
    Heading,
    "Heading of a dual-antenna receiver.",
    types=("sensor_msgs/msg/Imu",),
    topic="gnss/heading",
    topic_about="sensor_msgs/Imu of a dual-antenna receiver: yaw (0 = east, counter-clockwise) and pitch of the "
    "baseline; one whose variance is above 1 rad2 is not used.",
    read=read,
    limits=limits,
    depth=50,
    is_gnss=True,
    needs=NEEDS_POSITION,
    augmented=augmented,
    place=Place(rotation="heading.mount_rpy_deg", inputs=("heading",)),
    settings=SETTINGS,
    describe=describe,
    columns=("yaw", "pitch"),
    optional_column="pitch",
)
"""The facts of this measurement."""
