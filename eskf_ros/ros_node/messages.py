"""Messages that the node sends rarely: biases, the filtered fix, the verdicts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TwistWithCovarianceStamped
from sensor_msgs.msg import NavSatFix, NavSatStatus

from eskf_ros.filter.state.time import SECOND
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.gnss.point_solution import PointSolution, SolutionStatus
from eskf_ros.replay import words

IMU_SILENCE = 1.0
"""s; after this time without an IMU message nothing is published that a robot could navigate by."""


def set_header(header: Any, stamp: int, frame: str) -> None:
    """Fill in a message header; ``stamp`` in ns, negative before the first message."""
    header.stamp.sec, header.stamp.nanosec = divmod(max(0, stamp), SECOND)
    header.frame_id = frame


def key_values(values: dict[str, object]) -> list[KeyValue]:
    """Return a mapping in the form of diagnostics."""
    return [KeyValue(key=key, value=str(value)) for key, value in values.items()]


def bias_message(row: np.void, frame: str) -> TwistWithCovarianceStamped:
    """Return the biases in the axes and frame of the IMU: linear accelerometer (m/s2), angular gyro (rad/s)."""
    message = TwistWithCovarianceStamped()
    set_header(message.header, int(row["stamp"]), frame)
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z = row["accel_bias"].tolist()
    angular.x, angular.y, angular.z = row["gyro_bias"].tolist()
    variances = np.concatenate([row["accel_bias_std"], row["gyro_bias_std"]]) ** 2
    message.twist.covariance = np.diag(variances).ravel()
    return message


def fix_message(row: np.void, datum: tuple[float, float, float], frame: str) -> NavSatFix:
    """Return the position of base_link as NavSatFix, covariance in east, north, up of the map."""
    message = NavSatFix()
    set_header(message.header, int(row["stamp"]), frame)
    message.status.status = NavSatStatus.STATUS_FIX
    message.latitude, message.longitude, message.altitude = MapFrame(datum).to_geodetic_deg(row["position_map"])
    message.position_covariance = np.ascontiguousarray(row["pose_covariance"][:3, :3]).ravel()
    message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
    return message


def solution_message(solution: PointSolution, stamp: int, frame: str) -> NavSatFix:
    """Return the position of the antenna by the ranges of one epoch alone, in the frame of their message."""
    message = NavSatFix()
    set_header(message.header, stamp, frame)
    if solution.status != SolutionStatus.SOLVED:
        message.status.status = NavSatStatus.STATUS_NO_FIX
        message.latitude = message.longitude = message.altitude = math.nan
        return message
    latitude, longitude, message.altitude = map(float, solution.geodetic)
    message.status.status = NavSatStatus.STATUS_FIX
    message.latitude, message.longitude = math.degrees(latitude), math.degrees(longitude)
    message.position_covariance = np.ascontiguousarray(solution.covariance_enu, np.float64).ravel()
    message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
    return message


def quality_message(row: np.void, node: str, silence: float) -> DiagnosticStatus:
    """Return whether an ODOMETRY row may be used for navigation: OK, WARN (usable, dead reckoning) or ERROR (not).

    ``silence``: time since the last IMU message (s), NaN before the first one.
    """
    words_of_row = words.quality(row, node)
    status = status_message(words_of_row)
    if not silence <= IMU_SILENCE:
        status.level = DiagnosticStatus.ERROR
        status.message = "no IMU message has come" + (f" for {silence:.1f} s" if silence > 0.0 else "")
        status.values[0].value = "no"
    return status


def status_message(status: words.Status) -> DiagnosticStatus:
    """Return a status as a message."""
    return DiagnosticStatus(
        level=bytes([status.level]),
        name=status.name,
        hardware_id="eskf_ros",
        message=status.message,
        values=key_values(dict(status.values)),
    )


def record_statuses(records: np.ndarray, stamp: Time) -> DiagnosticArray:
    """Return one status per measurement: its verdict, and its receiver (0: the first) or signal."""
    message = DiagnosticArray()
    message.header.stamp = stamp
    message.status = [status_message(words.verdict(record)) for record in records]
    return message
