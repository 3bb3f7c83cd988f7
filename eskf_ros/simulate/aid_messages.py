"""The measurements of the aids as ROS messages: one function per sensor, each for a slice of its measurements."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import cloud_messages, message_dtype
from eskf_ros.gnss.cloud import write_epoch
from eskf_ros.gnss.ephemeris_cloud import write_ephemerides
from eskf_ros.simulate.barometer import BarometerMeasurements
from eskf_ros.simulate.body_velocity import BodyVelocityMeasurements
from eskf_ros.simulate.dual_antenna import DualAntennaMeasurements
from eskf_ros.simulate.frames import Frame
from eskf_ros.simulate.magnetometer import MagnetometerMeasurements
from eskf_ros.simulate.range_receiver import RangeMeasurements
from eskf_ros.simulate.wheel import WheelMeasurements

ABSENT = -1.0
"""Variance of what is not measured."""

EPHEMERIDES_AGE = 60_000_000_000
"""So long (ns) before the recording the receiver has read what the satellites broadcast."""


def wheel(measured: WheelMeasurements, part: slice) -> NDArray[Any]:
    """Return nav_msgs/Odometry with forward speed and yaw rate; no pose and no other axis of the twist."""
    messages = _stamped("nav_msgs/msg/Odometry", measured.stamp[part], Frame.ODOM)
    messages["child_frame_id"] = Frame.WHEEL
    messages["orientation"][:, 3] = 1.0
    messages["pose_covariance"] = np.diag([ABSENT] * 6).ravel()
    messages["linear_velocity"][:, 0] = measured.speed[part]
    messages["angular_velocity"][:, 2] = measured.yaw_rate[part]
    variances = [measured.speed_variance, ABSENT, ABSENT, ABSENT, ABSENT, measured.yaw_rate_variance]
    messages["twist_covariance"] = np.diag(variances).ravel()
    return messages


def magnetometer(measured: MagnetometerMeasurements, part: slice) -> NDArray[Any]:
    """Return sensor_msgs/MagneticField."""
    messages = _stamped("sensor_msgs/msg/MagneticField", measured.stamp[part], Frame.MAGNETOMETER)
    messages["magnetic_field"] = measured.field[part]
    messages["magnetic_field_covariance"] = np.diag([measured.sensor.noise_std**2] * 3).ravel()
    return messages


def barometer(measured: BarometerMeasurements, part: slice) -> NDArray[Any]:
    """Return sensor_msgs/FluidPressure."""
    messages = _stamped("sensor_msgs/msg/FluidPressure", measured.stamp[part], Frame.BAROMETER)
    messages["fluid_pressure"] = measured.pressure[part]
    messages["variance"] = measured.sensor.noise_std**2
    return messages


def dual_antenna(measured: DualAntennaMeasurements, part: slice) -> NDArray[Any]:
    """Return sensor_msgs/Imu with yaw and pitch of the baseline; what is not measured is zero and may be anything."""
    messages = _stamped("sensor_msgs/msg/Imu", measured.stamp[part], Frame.GNSS)
    yaw, pitch = 0.5 * measured.yaw[part], 0.5 * measured.pitch[part]
    messages["orientation"][:, 0] = -np.sin(yaw) * np.sin(pitch)
    messages["orientation"][:, 1] = np.cos(yaw) * np.sin(pitch)
    messages["orientation"][:, 2] = np.sin(yaw) * np.cos(pitch)
    messages["orientation"][:, 3] = np.cos(yaw) * np.cos(pitch)
    # A first element of -1 would say that there is no orientation at all (REP-145).
    stds = (math.inf, measured.sensor.pitch_std_deg, measured.sensor.yaw_std_deg)
    variances = [min(math.radians(std), math.pi) ** 2 for std in stds]
    messages["orientation_covariance"] = np.diag(variances).ravel()
    messages["angular_velocity_covariance"][:, 0] = ABSENT
    messages["linear_acceleration_covariance"][:, 0] = ABSENT
    return messages


def body_velocity(measured: BodyVelocityMeasurements, part: slice) -> NDArray[Any]:
    """Return geometry_msgs/TwistWithCovarianceStamped; an axis that is not measured has a negative variance."""
    messages = _stamped("geometry_msgs/msg/TwistWithCovarianceStamped", measured.stamp[part], Frame.BODY_VELOCITY)
    messages["linear_velocity"] = measured.velocity[part]
    messages["twist_covariance"] = np.diag([*measured.variance, ABSENT, ABSENT, ABSENT]).ravel()
    return messages


def ranges(measured: RangeMeasurements, part: slice) -> NDArray[Any]:
    """Return `gnss/ranges` (sensor_msgs/PointCloud2), with satellite states if the receiver gives them."""
    clouds = [
        write_epoch(measured.epoch(k), int(measured.week[k]), float(measured.seconds[k]), measured.sensor.satellites)
        for k in range(len(measured.stamp))[part]
    ]
    return cloud_messages(measured.stamp[part], clouds, Frame.GNSS)


def ephemerides(measured: RangeMeasurements, part: slice) -> NDArray[Any]:
    """Return `gnss/ephemerides` (sensor_msgs/PointCloud2): all there are, once, from before the recording."""
    stamps = measured.ephemerides_stamp[part] - EPHEMERIDES_AGE
    cloud = write_ephemerides(measured.broadcasts, measured.klobuchar)
    return cloud_messages(stamps, [cloud] * len(stamps), Frame.GNSS)


def _stamped(type_name: str, stamp: NDArray[np.int64], frame: Frame) -> NDArray[Any]:
    messages = np.zeros(len(stamp), message_dtype(type_name))
    messages["stamp"] = stamp
    messages["frame_id"] = frame
    return messages
