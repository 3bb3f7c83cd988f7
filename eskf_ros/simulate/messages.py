"""A simulated recording as ROS messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros import rotation
from eskf_ros.bags import message_dtype
from eskf_ros.simulate.scenario import Recording

Array = NDArray[np.float64]

STRINGS = ("imu_link", "gps", "earth", "base_link")
"""The frames; messages hold indices into them."""
_IMU_FRAME, _GNSS_FRAME, _EARTH_FRAME, _BASE_FRAME = range(4)

_STATUS_FIX = 0
_SERVICE_GPS = 1
_COVARIANCE_DIAGONAL_KNOWN = 2


@dataclass(frozen=True)
class Topic:
    """One topic of a recording: when its messages arrive (int64 ns, sorted) and how a slice of them is made."""

    name: str
    type_name: str
    arrival: NDArray[np.int64]
    messages: Callable[[slice], NDArray[Any]]


def topics_of(recording: Recording) -> list[Topic]:
    """Return the topics ``imu/data``, ``gps/fix``, ``gps/vel`` and ``truth`` of a recording."""
    return [
        Topic("imu/data", "sensor_msgs/msg/Imu", recording.imu_arrival, lambda part: _imu(recording, part)),
        Topic("gps/fix", "sensor_msgs/msg/NavSatFix", recording.fix_arrival, lambda part: _fixes(recording, part)),
        Topic(
            "gps/vel",
            "geometry_msgs/msg/TwistWithCovarianceStamped",
            recording.velocity_arrival,
            lambda part: _velocities(recording, part),
        ),
        Topic("truth", "nav_msgs/msg/Odometry", recording.truth_stamp, lambda part: _truth(recording, part)),
    ]


def _imu(recording: Recording, part: slice) -> NDArray[Any]:
    messages = np.zeros(len(recording.imu_stamp[part]), message_dtype("sensor_msgs/msg/Imu"))
    messages["stamp"] = recording.imu_stamp[part]
    messages["frame_id"] = _IMU_FRAME
    # REP-145: an orientation that is not measured is announced by a first covariance element of -1.
    messages["orientation"][:, 3] = 1.0
    messages["orientation_covariance"][:, 0] = -1.0
    messages["angular_velocity"] = recording.angular_rate[part]
    messages["linear_acceleration"] = recording.specific_force[part]
    noise = recording.parameters()
    for field, density in (("angular_velocity", "gyro"), ("linear_acceleration", "accel")):
        variance = noise[f"imu.{density}_noise_density"] ** 2 * recording.options.imu_rate
        messages[f"{field}_covariance"] = np.diag([variance] * 3).ravel()
    return messages


def _fixes(recording: Recording, part: slice) -> NDArray[Any]:
    messages = np.zeros(len(recording.fix_stamp[part]), message_dtype("sensor_msgs/msg/NavSatFix"))
    messages["stamp"] = recording.fix_stamp[part]
    messages["frame_id"] = _GNSS_FRAME
    messages["status"] = _STATUS_FIX
    messages["service"] = _SERVICE_GPS
    messages["latitude"] = recording.fix_latitude_deg[part]
    messages["longitude"] = recording.fix_longitude_deg[part]
    messages["altitude"] = recording.fix_altitude[part]
    messages["position_covariance"] = recording.fix_covariance[part]
    messages["position_covariance_type"] = _COVARIANCE_DIAGONAL_KNOWN
    return messages


def _velocities(recording: Recording, part: slice) -> NDArray[Any]:
    count = len(recording.velocity_stamp[part])
    messages = np.zeros(count, message_dtype("geometry_msgs/msg/TwistWithCovarianceStamped"))
    messages["stamp"] = recording.velocity_stamp[part]
    messages["frame_id"] = _GNSS_FRAME
    messages["linear_velocity"] = recording.velocity_enu[part]
    covariance = np.zeros((count, 6, 6))
    covariance[:, :3, :3] = recording.velocity_covariance[part].reshape(-1, 3, 3)
    # The receiver does not measure rotation.
    covariance[:, 3, 3] = -1.0
    messages["twist_covariance"] = covariance.reshape(-1, 36)
    return messages


def _truth(recording: Recording, part: slice) -> NDArray[Any]:
    messages = np.zeros(len(recording.truth_stamp[part]), message_dtype("nav_msgs/msg/Odometry"))
    messages["stamp"] = recording.truth_stamp[part]
    messages["frame_id"] = _EARTH_FRAME
    messages["child_frame_id"] = _BASE_FRAME
    messages["position"] = recording.frame.to_ecef(recording.truth_position_map[part])
    # East-North-Up is reached from ECEF axes by a turn about z and one about the new x.
    latitude, longitude = (math.radians(angle) for angle in recording.datum[:2])
    w, x, y, z = rotation.from_roll_pitch_yaw(0.5 * math.pi - latitude, 0.0, 0.5 * math.pi + longitude)
    map_to_ecef = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    attitude = recording.truth_attitude_body_to_map[part]
    messages["orientation"] = (attitude @ map_to_ecef.T)[:, [1, 2, 3, 0]]
    messages["linear_velocity"] = _rotate_back(attitude, recording.truth_velocity_map[part])
    messages["angular_velocity"] = recording.truth_angular_rate_body[part]
    return messages


def _rotate_back(attitude: Array, vectors: Array) -> Array:
    """Return vectors (n, 3) in map turned into the body whose ``attitude`` (n, 4) is body to map."""
    axis = -attitude[:, 1:]
    twice = 2.0 * np.cross(axis, vectors)
    return vectors + attitude[:, :1] * twice + np.cross(axis, twice)
