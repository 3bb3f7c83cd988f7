"""A simulated recording as ROS messages."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import POINT_CLOUD, message_dtype
from eskf_ros.geodesy import rotation
from eskf_ros.simulate import aid_messages
from eskf_ros.simulate.frames import Frame
from eskf_ros.simulate.gnss import GnssMeasurements
from eskf_ros.simulate.range_receiver import RangeMeasurements
from eskf_ros.simulate.recording import Recording

Array = NDArray[np.float64]

_SERVICE_GPS = 1

_AIDS: dict[str, tuple[str, str, Callable[[Any, slice], NDArray[Any]]]] = {
    "dual_antenna": ("gnss/heading", "sensor_msgs/msg/Imu", aid_messages.dual_antenna),
    "wheel": ("wheel/odom", "nav_msgs/msg/Odometry", aid_messages.wheel),
    "magnetometer": ("imu/mag", "sensor_msgs/msg/MagneticField", aid_messages.magnetometer),
    "barometer": ("baro", "sensor_msgs/msg/FluidPressure", aid_messages.barometer),
    "body_velocity": (
        "body_velocity",
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        aid_messages.body_velocity,
    ),
}
"""Topic, type and conversion of the aids that have one topic each."""


@dataclass(frozen=True)
class Topic:
    """One topic of a recording: when its messages arrive (int64 ns, sorted) and how a slice of them is made."""

    name: str
    type_name: str
    arrival: NDArray[np.int64]
    messages: Callable[[slice], NDArray[Any]]


def topics_of(recording: Recording) -> list[Topic]:
    """Return the topics ``imu/data``, ``gps/fix``, ``gps/vel`` and ``truth`` of a recording, then those of its aids."""
    topics = [
        Topic("imu/data", "sensor_msgs/msg/Imu", recording.imu_arrival, partial(_imu, recording)),
        *_gnss(recording),
        Topic("truth", "nav_msgs/msg/Odometry", recording.truth_stamp, partial(_truth, recording)),
    ]
    for aid, (name, type_name, messages) in _AIDS.items():
        measured = getattr(recording, aid)
        if measured:
            topics.append(Topic(name, type_name, measured.arrival, partial(messages, measured)))
    if recording.ranges:
        topics += _ranges(recording.ranges)
    return topics


def _ranges(measured: RangeMeasurements) -> list[Topic]:
    topics = [Topic("gnss/ranges", POINT_CLOUD, measured.arrival, partial(aid_messages.ranges, measured))]
    if not measured.sensor.satellites:
        arrival = measured.ephemerides_stamp
        topics.append(Topic("gnss/ephemerides", POINT_CLOUD, arrival, partial(aid_messages.ephemerides, measured)))
    return topics


def _gnss(recording: Recording) -> list[Topic]:
    """The topics of the GNSS receivers: two of them share both, and differ by the frame."""
    fix_type, velocity_type = "sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/TwistWithCovarianceStamped"
    receivers: list[tuple[GnssMeasurements, Frame]] = [(recording, Frame.GNSS)]
    if recording.second_gnss:
        receivers.append((recording.second_gnss, Frame.SECOND_GNSS))
    fixes = [(gnss.fix_arrival, partial(_fixes, gnss, frame)) for gnss, frame in receivers]
    velocities = [(gnss.velocity_arrival, partial(_velocities, gnss, frame)) for gnss, frame in receivers]
    return [_shared("gps/fix", fix_type, fixes), _shared("gps/vel", velocity_type, velocities)]


def _shared(
    name: str, type_name: str, senders: Sequence[tuple[NDArray[np.int64], Callable[[slice], NDArray[Any]]]]
) -> Topic:
    """One topic of several senders, in the order of arrival."""
    if len(senders) == 1:
        return Topic(name, type_name, *senders[0])
    arrival = np.concatenate([times for times, _ in senders])
    order = np.argsort(arrival, kind="stable")
    messages = np.concatenate([made(slice(None)) for _, made in senders])[order]
    return Topic(name, type_name, arrival[order], lambda part: messages[part])


def _imu(recording: Recording, part: slice) -> NDArray[Any]:
    messages = np.zeros(len(recording.imu_stamp[part]), message_dtype("sensor_msgs/msg/Imu"))
    messages["stamp"] = recording.imu_stamp[part]
    messages["frame_id"] = Frame.IMU
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


def _fixes(gnss: GnssMeasurements, frame: Frame, part: slice) -> NDArray[Any]:
    messages = np.zeros(len(gnss.fix_stamp[part]), message_dtype("sensor_msgs/msg/NavSatFix"))
    messages["stamp"] = gnss.fix_stamp[part]
    messages["frame_id"] = frame
    messages["status"] = gnss.fix_status[part]
    messages["service"] = _SERVICE_GPS
    messages["latitude"] = gnss.fix_latitude_deg[part]
    messages["longitude"] = gnss.fix_longitude_deg[part]
    messages["altitude"] = gnss.fix_altitude[part]
    messages["position_covariance"] = gnss.fix_covariance[part]
    messages["position_covariance_type"] = gnss.fix_covariance_type[part]
    return messages


def _velocities(gnss: GnssMeasurements, frame: Frame, part: slice) -> NDArray[Any]:
    count = len(gnss.velocity_stamp[part])
    messages = np.zeros(count, message_dtype("geometry_msgs/msg/TwistWithCovarianceStamped"))
    messages["stamp"] = gnss.velocity_stamp[part]
    messages["frame_id"] = frame
    messages["linear_velocity"] = gnss.velocity_enu[part]
    covariance = np.zeros((count, 6, 6))
    covariance[:, :3, :3] = gnss.velocity_covariance[part].reshape(-1, 3, 3)
    # The receiver does not measure rotation; one that leaves its covariances zero does not say so either.
    covariance[:, 3, 3] = np.where(gnss.velocity_covariance[part].any(axis=1), -1.0, 0.0)
    messages["twist_covariance"] = covariance.reshape(-1, 36)
    return messages


def _truth(recording: Recording, part: slice) -> NDArray[Any]:
    messages = np.zeros(len(recording.truth_stamp[part]), message_dtype("nav_msgs/msg/Odometry"))
    messages["stamp"] = recording.truth_stamp[part]
    messages["frame_id"] = Frame.EARTH
    messages["child_frame_id"] = Frame.BASE
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
