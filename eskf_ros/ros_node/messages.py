"""Messages that the node sends rarely: biases, the filtered fix, the verdicts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TwistWithCovarianceStamped
from sensor_msgs.msg import NavSatFix, NavSatStatus

from eskf_ros.filter.state.enums import IS_USABLE, QUALITY_REASONS, STREAM_NAMES, Quality, Status, Stream, Verdict
from eskf_ros.filter.state.time import SECOND
from eskf_ros.filter.tight.signal import name_of
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.gnss.point_solution import PointSolution, SolutionStatus

GOOD_VERDICTS = (Verdict.FUSED, Verdict.WEIGHED_DOWN, Verdict.DUPLICATE, Verdict.DISABLED)
"""Verdicts that are no fault of the measurement."""

IMU_SILENCE = 1.0
"""s; after this time without an IMU message nothing is published that a robot could navigate by."""

SIGNALS = (Stream.PSEUDORANGE, Stream.RANGE_RATE)
"""Streams whose sources are signals of satellites."""


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
    quality = Quality(int(row["quality"]))
    reason = QUALITY_REASONS[quality]
    is_usable = quality in IS_USABLE
    if not silence <= IMU_SILENCE:
        is_usable, reason = False, "no IMU message has come" + (f" for {silence:.1f} s" if silence > 0.0 else "")
    level = DiagnosticStatus.OK if quality == Quality.GOOD else DiagnosticStatus.WARN
    covariance = row["pose_covariance"]
    return DiagnosticStatus(
        level=level if is_usable else DiagnosticStatus.ERROR,
        name=f"{node}: quality",
        hardware_id="eskf_ros",
        message=reason,
        values=key_values(
            {
                "usable": "yes" if is_usable else "no",
                "quality": quality.name,
                "state": Status(int(row["status"])).name,
                "stamp": f"{int(row['stamp']) // SECOND}.{int(row['stamp']) % SECOND:09d}",
                "horizontal std (m)": f"{math.sqrt(max(0.0, covariance[0, 0] + covariance[1, 1])):.3f}",
                "heading std (deg)": f"{math.degrees(math.sqrt(max(0.0, covariance[5, 5]))):.2f}",
            }
        ),
    )


def record_statuses(records: np.ndarray, stamp: Time) -> DiagnosticArray:
    """Return one status per measurement: its verdict, and its receiver (0: the first) or signal."""
    message = DiagnosticArray()
    message.header.stamp = stamp
    for record in records:
        verdict = Verdict(int(record["verdict"]))
        good = verdict in GOOD_VERDICTS
        stream, source = int(record["stream"]), int(record["source"])
        message.status.append(
            DiagnosticStatus(
                level=DiagnosticStatus.OK if good else DiagnosticStatus.WARN,
                name=STREAM_NAMES[stream],
                message=verdict.name.lower(),
                values=key_values(
                    {
                        **({"signal": name_of(source)} if stream in SIGNALS else {"receiver": source}),
                        "stamp": f"{int(record['stamp']) // SECOND}.{int(record['stamp']) % SECOND:09d}",
                        "nis": float(record["nis"]),
                        "dof": int(record["dof"]),
                        "innovation": " ".join(f"{value:.4f}" for value in record["innovation"]),
                    }
                ),
            )
        )
    return message
