"""The parameters of eskf_ros: names, units, defaults, ranges and what they mean.

The dataclasses below are the only place where a parameter is defined. `config/eskf.yaml` and `docs/parameters.md`
are written from them by `python -m eskf_ros.parameters`, and `load` reads the ROS 2 parameter files users write.

Values are Python floats, integers, bools, strings and tuples of floats. Angles whose name ends in `_deg` are degrees,
all others are in the SI unit stated with them. This module imports neither numpy nor ROS, so that reading a
configuration costs no start-up time.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

Value = float | int | bool | str | tuple[float, ...]


class ParameterError(ValueError):
    """A parameter file or mapping that cannot be used; `problems` holds one complete sentence per mistake."""

    def __init__(self, source: str, problems: list[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(f"{source}: {problem}" for problem in problems))


@dataclass(frozen=True)
class Rule:
    """What is allowed for one parameter and how it is explained; kept as the metadata of its dataclass field.

    `minimum` and `maximum` are inclusive, `above` and `below` are exclusive bounds. For lists a tuple gives one
    bound per element. `lengths` are the allowed numbers of elements. `pattern` is a regular expression for strings,
    explained by `pattern_text`. `live` parameters may change while the node runs, all others are read-only.
    """

    default: Value
    unit: str
    description: str
    minimum: float | tuple[float, ...] | None = None
    maximum: float | tuple[float, ...] | None = None
    above: float | None = None
    below: float | None = None
    lengths: tuple[int, ...] = ()
    pattern: str = ""
    pattern_text: str = ""
    nan_allowed: bool = False
    live: bool = False


def _parameter(default: Value, unit: str, description: str, **limits: Any) -> Any:
    if isinstance(default, tuple) and "lengths" not in limits:
        limits["lengths"] = (len(default),)
    return dataclasses.field(default=default, metadata={"rule": Rule(default, unit, description, **limits)})


def _group(group: type, description: str) -> Any:
    return dataclasses.field(default_factory=group, metadata={"group": group, "description": description})


def _choice(default: str, description: str, *others: str) -> Any:
    words = (default, *others)
    return _parameter(default, "", description, pattern="|".join(words), pattern_text=" or ".join(words))


_FRAME = {"pattern": r"[^/\s]\S*", "pattern_text": "a frame name without blanks and without a leading slash"}
_TOPIC = {
    "pattern": r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*",
    "pattern_text": "a ROS topic name like imu/data or /robot/imu",
}
_TYPE = "Message type of this topic, where the driver publishes another one. The replay takes what was recorded."


@dataclass(frozen=True)
class Frames:
    map: str = _parameter(
        "map", "", "Frame of the global estimate: East-North-Up at the datum, fixed to the Earth.", **_FRAME
    )
    odom: str = _parameter("odom", "", "Frame of the local estimate, which never jumps (REP-105).", **_FRAME)
    base_link: str = _parameter(
        "base_link", "", "Frame of the vehicle whose pose is estimated: x forward, y left, z up (REP-103).", **_FRAME
    )
    extrinsics: str = _choice(
        "auto",
        "Where the node takes the places of the sensors in base_link from. auto: a sensor whose parameters "
        "(imu.mount_position and imu.mount_rpy_deg, gnss.lever_arm, and so on) are all zero is looked up on /tf_static "
        "by the header.frame_id of its messages. parameters: /tf_static is not looked at; so it is in the replay.",
        "parameters",
    )


@dataclass(frozen=True)
class Topics:
    imu: str = _parameter("imu/data", "", "sensor_msgs/Imu: angular rate and specific force (+g up at rest).", **_TOPIC)
    gnss_fix: str = _parameter("gps/fix", "", "sensor_msgs/NavSatFix: position of the GNSS antenna.", **_TOPIC)
    gnss_velocity: str = _parameter(
        "gps/vel",
        "",
        "geometry_msgs/TwistWithCovarianceStamped: velocity of the GNSS antenna, East-North-Up.",
        **_TOPIC,
    )
    gnss_velocity_type: str = _choice(
        "geometry_msgs/msg/TwistWithCovarianceStamped", _TYPE, "geometry_msgs/msg/TwistStamped"
    )
    heading: str = _parameter(
        "gnss/heading",
        "",
        "sensor_msgs/Imu of a dual-antenna receiver: yaw (0 = east, counter-clockwise) and pitch of the baseline; one "
        "whose variance is above 1 rad2 is not used.",
        **_TOPIC,
    )
    mag: str = _parameter("imu/mag", "", "sensor_msgs/MagneticField: field in the axes of the magnetometer.", **_TOPIC)
    wheel: str = _parameter(
        "wheel/odom", "", "nav_msgs/Odometry: wheel odometry, of which speed and yaw rate are used.", **_TOPIC
    )
    wheel_type: str = _choice(
        "nav_msgs/msg/Odometry",
        _TYPE,
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        "geometry_msgs/msg/TwistStamped",
    )
    body_velocity: str = _parameter(
        "body_velocity",
        "",
        "geometry_msgs/TwistWithCovarianceStamped: velocity in the axes of the vehicle, of a DVL, optical flow, radar "
        "or odometry of any kind; an axis with a negative variance is absent.",
        **_TOPIC,
    )
    body_velocity_type: str = _choice(
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        _TYPE,
        "geometry_msgs/msg/TwistStamped",
        "nav_msgs/msg/Odometry",
    )
    baro: str = _parameter("baro", "", "sensor_msgs/FluidPressure: air pressure.", **_TOPIC)
    ranges: str = _parameter(
        "gnss/ranges",
        "",
        "sensor_msgs/PointCloud2: what the receiver measures of each satellite, one point per signal (mode tight).",
        **_TOPIC,
    )
    ephemerides: str = _parameter(
        "gnss/ephemerides",
        "",
        "sensor_msgs/PointCloud2: orbits and clocks of the satellites, one point per broadcast ephemeris.",
        **_TOPIC,
    )
    initial_pose: str = _parameter(
        "initialpose",
        "",
        "geometry_msgs/PoseWithCovarianceStamped in frames.map: puts the estimate there, as RViz's tool does. Position "
        "and yaw are taken over; a height without variance is not. The replay does not read it.",
        **_TOPIC,
    )


@dataclass(frozen=True)
class Imu:
    mount_position: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the IMU in base_link, x forward, y left, z up.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    mount_rpy_deg: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "deg",
        "Orientation of the IMU in base_link: roll, pitch, yaw about fixed axes as in a URDF.",
        minimum=-360.0,
        maximum=360.0,
    )
    gyro_noise_density: float = _parameter(
        1.5e-3,
        "rad/s/rtHz",
        "White noise of the gyro as mounted. The default, 0.0859 deg/s/rtHz (5.16 deg/rt h), is for a consumer MEMS "
        "IMU shaken by engine and road; a data sheet says 2e-4 (consumer), 0.5e-4 (industrial), 0.1e-4 and less "
        "(tactical): use that on a smooth vehicle.",
        above=0.0,
        maximum=1.0,
        live=True,
    )
    accel_noise_density: float = _parameter(
        3.0e-2,
        "m/s2/rtHz",
        "White noise of the accelerometer as mounted. The default, 3060 ug/rtHz, is for a consumer MEMS IMU shaken "
        "by engine and road; a data sheet says 2e-3 (consumer), 0.6e-3 (industrial): use that on a smooth vehicle.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    gyro_bias_random_walk: float = _parameter(
        1.0e-5,
        "rad/s2/rtHz",
        "How fast the gyro bias wanders: by this value times the square root of the seconds passed. "
        "The default is 0.0044 deg/s in one minute, a consumer MEMS IMU; industrial MEMS about 0.2e-5.",
        minimum=0.0,
        maximum=0.1,
        live=True,
    )
    accel_bias_random_walk: float = _parameter(
        2.0e-4,
        "m/s3/rtHz",
        "How fast the accelerometer bias wanders: by this value times the square root of the seconds passed. "
        "The default is 0.16 mg in one minute, a consumer MEMS IMU; industrial MEMS about 0.5e-4.",
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    gyro_bias_std: float = _parameter(
        0.01,
        "rad/s",
        "Standard deviation of the unknown gyro bias at start (0.57 deg/s). "
        "Zero together with a zero random walk switches the estimation of this bias off.",
        minimum=0.0,
        maximum=1.0,
    )
    accel_bias_std: float = _parameter(
        0.2,
        "m/s2",
        "Standard deviation of the unknown accelerometer bias at start (20 mg). "
        "Zero together with a zero random walk switches the estimation of this bias off.",
        minimum=0.0,
        maximum=10.0,
    )
    gap: float = _parameter(
        0.1,
        "s",
        "An interval between two IMU samples longer than this is a gap: it is bridged with the samples on its two "
        "sides and costs the extra uncertainty given by gap_accel_std and gap_gyro_std.",
        above=0.0,
        maximum=10.0,
    )
    gap_accel_std: float = _parameter(
        2.0,
        "m/s2",
        "How far the mean acceleration during a gap may be from what the samples on its two sides say.",
        minimum=0.0,
        maximum=100.0,
        live=True,
    )
    gap_gyro_std: float = _parameter(
        0.3,
        "rad/s",
        "How far the mean angular rate during a gap may be from what the samples on its two sides say.",
        minimum=0.0,
        maximum=100.0,
        live=True,
    )


@dataclass(frozen=True)
class Gnss:
    use_position: bool = _parameter(True, "", "Fuse the positions of topics.gnss_fix.", live=True)
    use_velocity: bool = _parameter(True, "", "Fuse the velocities of topics.gnss_velocity.", live=True)
    lever_arm: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the GNSS antenna in base_link, x forward, y left, z up. "
        "Measure it to a few centimetres: an error here becomes a position error that turns with the vehicle.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    time_offset: float = _parameter(
        0.0,
        "s",
        "Added to the stamps of the GNSS messages: true time = stamp + offset. "
        "Negative when the driver stamps a message on arrival.",
        minimum=-10.0,
        maximum=10.0,
    )
    position_std_floor: float = _parameter(
        0.02,
        "m",
        "The standard deviation of a GNSS position is never taken smaller than this, per axis.",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    velocity_std_floor: float = _parameter(
        0.03,
        "m/s",
        "The standard deviation of a GNSS velocity is never taken smaller than this, per axis.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    covariance_scale: float = _parameter(
        1.0,
        "",
        "Factor on the covariances (variances, not standard deviations) that the GNSS messages carry. "
        "Raise it for a receiver that is too sure of itself; the floors apply after it.",
        above=0.0,
        maximum=1.0e6,
        live=True,
    )
    gate_probability: float = _parameter(
        0.999,
        "",
        "Chi-square gate: the share of good measurements that passes. With 0.999 one good measurement in a thousand "
        "is rejected (3 axes: normalised innovation squared above 16.27); closer to 1 lets more outliers in.",
        above=0.0,
        below=1.0,
        live=True,
    )
    correlation_time: float = _parameter(
        0.0,
        "s",
        "How long the error of a position lasts (e-folding time). 0: fixes err independently of each other. Those of a "
        "receiver at several Hz do not, and the estimate then trusts their mean too much; without corrections 30 to "
        "300 s is usual.",
        minimum=0.0,
        maximum=1.0e5,
    )
    correlated_share: float = _parameter(
        0.8,
        "",
        "With a correlation_time: the share of the variance of each fix that lasts; the rest is new every time.",
        above=0.0,
        below=1.0,
        live=True,
    )
    status_std_horizontal: tuple[float, ...] = _parameter(
        (3.0, 2.0, 0.5),
        "m",
        "Standard deviation of east and of north when a fix comes with a covariance of unknown type or all zero, "
        "by NavSatFix status: [fix, sbas, gbas].",
        above=0.0,
        maximum=1.0e4,
        live=True,
    )
    status_std_vertical: tuple[float, ...] = _parameter(
        (6.0, 4.0, 1.0),
        "m",
        "The same for the altitude: [fix, sbas, gbas].",
        above=0.0,
        maximum=1.0e4,
        live=True,
    )
    unknown_velocity_std: float = _parameter(
        0.3,
        "m/s",
        "Standard deviation per axis of a GNSS velocity whose covariance is unknown or all zero.",
        above=0.0,
        maximum=100.0,
        live=True,
    )


@dataclass(frozen=True)
class SecondGnss:
    frame_id: str = _parameter(
        "",
        "",
        "Messages of topics.gnss_fix and topics.gnss_velocity with this frame are those of the second receiver. "
        "Empty: there is one receiver.",
        pattern=r"([^/\s]\S*)?",
        pattern_text="empty, or a frame name without blanks and without a leading slash",
    )
    lever_arm: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the second antenna in base_link, x forward, y left, z up.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    time_offset: float = _parameter(
        0.0,
        "s",
        "Added to the stamps of the second receiver's messages: true time = stamp + offset.",
        minimum=-10.0,
        maximum=10.0,
    )


@dataclass(frozen=True)
class Aid:
    """What every aid has: the fields of its group begin with these."""

    use: bool = _parameter(True, "", "Fuse the messages of this topic.", live=True)
    time_offset: float = _parameter(
        0.0, "s", "Added to the stamps: true time = stamp + offset.", minimum=-10.0, maximum=10.0
    )
    covariance_scale: float = _parameter(
        1.0,
        "",
        "Factor on the covariances (variances) that the messages carry; the floors apply after it.",
        above=0.0,
        maximum=1.0e6,
        live=True,
    )
    gate_probability: float = _parameter(
        0.999, "", "Chi-square gate: the share of good measurements that passes.", above=0.0, below=1.0, live=True
    )


@dataclass(frozen=True)
class Heading(Aid):
    mount_rpy_deg: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "deg",
        "Orientation of the baseline in base_link, whose yaw and pitch the messages tell: roll, pitch, yaw about fixed "
        "axes as in a URDF, of a frame whose x axis leads from the first antenna (of u-blox: the moving base) to the "
        "second. [0.0, 0.0, 0.0]: the second is in front; [0.0, 0.0, 90.0]: it is on the left; [0.0, 0.0, 180.0]: it "
        "is behind.",
        minimum=-360.0,
        maximum=360.0,
    )
    offset_std_deg: float = _parameter(
        0.5,
        "deg",
        "Standard deviation at first of what all messages are wrong by alike: how well the baseline is known in "
        "base_link, and multipath at the antennas. It is estimated as the vehicle accelerates; 0: there is none.",
        minimum=0.0,
        maximum=90.0,
    )
    offset_random_walk: float = _parameter(
        2.0e-4,
        "rad/rtHz",
        "How fast that wanders: by this value times the square root of the seconds passed. The default is 0.36 deg in "
        "1000 s.",
        minimum=0.0,
        maximum=1.0,
    )
    std_floor_deg: float = _parameter(
        0.2, "deg", "The standard deviation is never taken smaller than this.", above=0.0, maximum=90.0, live=True
    )
    unknown_std_deg: float = _parameter(
        1.0, "deg", "Standard deviation where the message gives none.", above=0.0, maximum=90.0, live=True
    )


@dataclass(frozen=True)
class Mag(Aid):
    use: bool = _parameter(
        False,
        "",
        "Fuse the heading that the magnetometer shows. Off unless asked for: in vehicles, indoors and near iron it "
        "misleads.",
        live=True,
    )
    mount_rpy_deg: tuple[float, ...] = _parameter(
        (),
        "deg",
        "Orientation of the magnetometer in base_link: roll, pitch, yaw about fixed axes as in a URDF. "
        "Empty: its axes are those of the IMU.",
        lengths=(0, 3),
        minimum=-360.0,
        maximum=360.0,
    )
    declination_deg: float = _parameter(
        math.nan,
        "deg",
        "Angle from true north to magnetic north, east positive. .nan: from the World Magnetic Model for the place of "
        "the fixes and the date of their stamps, for which the Python package pygeomag must be installed.",
        minimum=-180.0,
        maximum=180.0,
        nan_allowed=True,
    )
    error_std_deg: float = _parameter(
        4.0,
        "deg",
        "Standard deviation of the heading error that remains after calibration, by iron in the vehicle and nearby. It "
        "does not average out while the vehicle stands.",
        above=0.0,
        maximum=180.0,
    )
    error_distance: float = _parameter(
        50.0,
        "m",
        "Having travelled so far, or turned by one radian, the vehicle meets another such error.",
        above=0.0,
        maximum=1.0e6,
    )
    strength_tolerance: float = _parameter(
        0.15,
        "",
        "A field is taken for disturbed where its strength differs by more than this part from that of the World "
        "Magnetic Model. Without the model nothing is checked.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    inclination_tolerance_deg: float = _parameter(
        8.0,
        "deg",
        "The same for its inclination (dip).",
        above=0.0,
        maximum=180.0,
        live=True,
    )
    std_floor: float = _parameter(
        1.0e-6,
        "T",
        "The standard deviation per axis is never taken smaller than this.",
        above=0.0,
        maximum=1.0,
        live=True,
    )
    unknown_std: float = _parameter(
        1.0e-6, "T", "Standard deviation per axis where the message gives none.", above=0.0, maximum=1.0, live=True
    )


@dataclass(frozen=True)
class Wheel(Aid):
    position: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "m",
        "The point of base_link whose forward speed the wheels show: the middle of the axle they are on, or the place "
        "of a single wheel.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    slip: float = _parameter(
        0.005,
        "s2/m",
        "Tyres slip by this share of the speed for every m/s2 of acceleration. The default is that of a car on dry "
        "asphalt; loose ground takes several times as much.",
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    speed_std_floor: float = _parameter(
        0.05,
        "m/s",
        "The standard deviation of the speed is never taken smaller than this.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    yaw_rate_std_floor: float = _parameter(
        0.02,
        "rad/s",
        "The standard deviation of the yaw rate is never taken smaller than this.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    unknown_speed_std: float = _parameter(
        0.1, "m/s", "Standard deviation of the speed where the message gives none.", above=0.0, maximum=100.0, live=True
    )
    unknown_yaw_rate_std: float = _parameter(
        0.1,
        "rad/s",
        "Standard deviation of the yaw rate where the message gives none.",
        above=0.0,
        maximum=10.0,
        live=True,
    )


@dataclass(frozen=True)
class BodyVelocity(Aid):
    std_floor: float = _parameter(
        0.02,
        "m/s",
        "The standard deviation per axis is never taken smaller than this.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    unknown_std: float = _parameter(
        0.2, "m/s", "Standard deviation per axis where the message gives none.", above=0.0, maximum=100.0, live=True
    )
    mount_position: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0), "m", "Position of the sensor in base_link.", minimum=-1000.0, maximum=1000.0
    )
    mount_rpy_deg: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "deg",
        "Orientation of the axes of its velocity in base_link: roll, pitch, yaw about fixed axes as in a URDF.",
        minimum=-360.0,
        maximum=360.0,
    )


@dataclass(frozen=True)
class Baro(Aid):
    position: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the barometer in base_link, x forward, y left, z up.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    offset_std: float = _parameter(
        300.0,
        "m",
        "Standard deviation at first of the difference between pressure altitude and height: weather and geoid. "
        "It is estimated.",
        above=0.0,
        maximum=1.0e4,
    )
    offset_random_walk: float = _parameter(
        0.1,
        "m/s/rtHz",
        "How fast that difference wanders, by weather, wind and warming up: by this value times the square root of the "
        "seconds passed. The default is 6 m in one hour; more where air is blown about, as in a vehicle.",
        minimum=0.0,
        maximum=100.0,
    )
    scale_std: float = _parameter(
        0.03,
        "",
        "Standard deviation of the factor by which pressure altitude grows faster or slower than height: 0.03 where "
        "the air is 9 K warmer or colder than in the standard atmosphere. It is estimated.",
        minimum=0.0,
        maximum=1.0,
    )
    std_floor: float = _parameter(
        3.0, "Pa", "The standard deviation is never taken smaller than this.", above=0.0, maximum=1.0e4, live=True
    )
    unknown_std: float = _parameter(
        10.0, "Pa", "Standard deviation where the message gives none.", above=0.0, maximum=1.0e4, live=True
    )


@dataclass(frozen=True)
class Ranges(Aid):
    use: bool = _parameter(
        True,
        "",
        "Fuse the pseudoranges of topics.ranges in mode tight.",
        live=True,
    )
    use_doppler: bool = _parameter(True, "", "Fuse the Doppler of topics.ranges in mode tight.", live=True)
    time_offset: float = _parameter(
        0.0,
        "s",
        "Added to the stamps: true time = stamp + offset. RINEX files are stamped with UTC: -18 or 18 s may be missing "
        "where a recording is stamped with GPS time.",
        minimum=-100.0,
        maximum=100.0,
    )
    gate_probability: float = _parameter(
        0.99994,
        "",
        "Gate of each signal: the share of good measurements that passes; 0.99994 is four standard deviations. From "
        "2.5 on they are weighed down.",
        above=0.0,
        below=1.0,
        live=True,
    )
    code_std_floor: float = _parameter(
        0.3,
        "m",
        "The standard deviation of a pseudorange is never taken smaller than this.",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    range_rate_std_floor: float = _parameter(
        0.03,
        "m/s",
        "The standard deviation of a range rate (Doppler) is never taken smaller than this.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    elevation_mask_deg: float = _parameter(
        10.0, "deg", "Satellites below this elevation are not used.", minimum=-90.0, maximum=90.0, live=True
    )
    cn0_mask: float = _parameter(
        28.0,
        "dB-Hz",
        "Signals whose carrier-to-noise density is below this are not used; an unknown one passes.",
        minimum=0.0,
        maximum=60.0,
        live=True,
    )
    clock_drift_noise: float = _parameter(
        0.3,
        "m/s/rts",
        "How fast the drift of the receiver's clock wanders: by this value times the square root of the seconds "
        "passed. 0.1 geodetic receiver, 0.3 usual, 0.6 hand-held or shaken. Too small makes one or two satellites "
        "worse than none.",
        minimum=0.0,
        maximum=1.0e3,
        live=True,
    )
    clock_bias_noise: float = _parameter(
        0.1,
        "m/rts",
        "How fast the bias of the receiver's clock wanders besides its drift.",
        minimum=0.0,
        maximum=1.0e3,
        live=True,
    )
    correlation_time: float = _parameter(
        120.0,
        "s",
        "How long the common error of the pseudoranges lasts (e-folding time): reflections, orbits, what the models "
        "leave of the atmosphere. 0: not modelled, and the estimate then trusts the mean of many epochs too much.",
        minimum=0.0,
        maximum=1.0e5,
    )
    correlated_std: float = _parameter(
        1.5,
        "m",
        "With a correlation_time: the standard deviation of a position by errors that last, per horizontal axis ...",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    correlated_std_vertical: float = _parameter(
        3.0,
        "m",
        "... and vertically, where the atmosphere is not averaged out. More without parameters of the ionosphere for "
        "the day (5 m): the stand-in may be wrong by its own size.",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    inter_system_std: float = _parameter(
        10.0,
        "m",
        "Standard deviation of the offset between a constellation and GPS in the receiver at first.",
        above=0.0,
        maximum=1.0e4,
    )
    inter_system_std_glonass: float = _parameter(30.0, "m", "The same for GLONASS.", above=0.0, maximum=1.0e4)
    inter_system_noise: float = _parameter(
        0.02, "m/rts", "How fast these offsets wander.", minimum=0.0, maximum=100.0, live=True
    )
    use_point_solution: bool = _parameter(
        False,
        "",
        "In mode loose: solve each epoch of topics.ranges for position and velocity, and fuse these instead of the "
        "receiver's own fixes.",
    )
    rinex_nav_files: str = _parameter(
        "",
        "",
        "RINEX navigation files with the orbits and clocks of the satellites, separated by colons. Empty: they come "
        "by topics.ephemerides, or topics.ranges brings the satellites itself.",
        pattern=r"[^\0]*",
        pattern_text="paths separated by colons, or nothing",
    )


@dataclass(frozen=True)
class Zupt:
    enabled: bool = _parameter(
        True,
        "",
        "While the vehicle stands still, hold velocity and turn rate at zero. Wheels, GNSS and the spread of the IMU's "
        "readings tell when it does.",
        live=True,
    )
    velocity_std: float = _parameter(
        0.02,
        "m/s",
        "Standard deviation of the velocity of a vehicle that stands: it sways on its springs.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    rate_std: float = _parameter(
        1.0e-4,
        "rad/s",
        "Standard deviation of its turn rate, as a mean over one second.",
        above=0.0,
        maximum=1.0,
        live=True,
    )


@dataclass(frozen=True)
class Nhc:
    enabled: bool = _parameter(
        False,
        "",
        "For vehicles on wheels: they move neither sideways nor up and down at the rear axle (non-holonomic "
        "constraint).",
        live=True,
    )
    position: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "m",
        "The point of base_link that does not move sideways: the middle of the axle that does not steer, usually the "
        "rear one.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    lateral_std: float = _parameter(
        0.05,
        "m/s",
        "Standard deviation of the lateral velocity, however slow the vehicle is.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    vertical_std: float = _parameter(
        0.1,
        "m/s",
        "The same of the vertical velocity: bumps and springs.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    angle_std_deg: float = _parameter(
        0.3,
        "deg",
        "How far the direction of travel differs from the axes of the vehicle on a straight road (camber, side wind), "
        "as a standard deviation.",
        minimum=0.0,
        maximum=90.0,
        live=True,
    )
    slip: float = _parameter(
        0.01,
        "rad s2/m",
        "What acceleration adds to this angle, by side slip of the tyres in turns, and by springs, for every m/s2. The "
        "default is about twice what a car shows, because these errors last for seconds.",
        minimum=0.0,
        maximum=1.0,
        live=True,
    )


@dataclass(frozen=True)
class Estimate:
    wheel_scale: bool = _parameter(
        True,
        "",
        "Estimate what the wheels multiply the speed with: nobody knows the radius of a tyre to a per mille.",
    )
    wheel_scale_std: float = _parameter(
        0.03, "", "Standard deviation of the scale of the wheels at start.", above=0.0, maximum=1.0
    )
    wheel_scale_random_walk: float = _parameter(
        5.0e-5,
        "1/rtHz",
        "How fast the scale of the wheels wanders with load and tyre pressure: by this value times the square root of "
        "the seconds passed.",
        minimum=0.0,
        maximum=1.0,
    )
    mounting: bool = _parameter(
        True,
        "",
        "Estimate yaw and pitch of the direction in which the vehicle rolls against the x axis of base_link, where "
        "wheels or nhc need it.",
    )
    mounting_std_deg: float = _parameter(
        2.0, "deg", "Standard deviation of these angles at start.", above=0.0, maximum=45.0
    )
    magnetic_bias: bool = _parameter(
        False,
        "",
        "Estimate the hard iron that turns with the magnetometer. It shows as the vehicle turns.",
    )
    magnetic_bias_std: float = _parameter(
        3.0e-6, "T", "Standard deviation per axis of this field at start.", above=0.0, maximum=1.0e-3
    )
    mounting_random_walk: float = _parameter(
        3.0e-5,
        "rad/rtHz",
        "How fast these angles wander with the load: by this value times the square root of the seconds passed.",
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class History:
    window: float = _parameter(
        2.0,
        "s",
        "How far behind the newest IMU stamp a message may lie and still be put where it belongs in time. "
        "Later ones are counted and never applied. Memory grows with it.",
        above=0.0,
        maximum=60.0,
    )


@dataclass(frozen=True)
class Alignment:
    initial_heading_deg: float = _parameter(
        math.nan,
        "deg",
        "Heading at start when it is known: yaw of base_link, 0 = east, counter-clockwise. "
        ".nan = unknown: then a dual antenna, the magnetometer or imu_orientation tell it, in this order, or it is "
        "found from the accelerations and the course over ground.",
        minimum=-360.0,
        maximum=360.0,
        nan_allowed=True,
    )
    initial_heading_std_deg: float = _parameter(
        5.0, "deg", "Standard deviation of initial_heading_deg.", above=0.0, maximum=180.0
    )
    static_duration: float = _parameter(
        2.0, "s", "How long the IMU must be still to level from it.", minimum=0.1, maximum=600.0
    )
    moving_start_after: float = _parameter(
        3.0,
        "s",
        "When no stillness was found for so long, the vehicle is taken to be moving and is levelled on the way.",
        minimum=0.1,
        maximum=600.0,
    )
    still_gyro_std: float = _parameter(
        0.06,
        "rad/s",
        "Standard deviation of the angular rate within static_duration, per axis, below which the IMU counts as still. "
        "The default lets a car with its engine running pass.",
        above=0.0,
        maximum=10.0,
    )
    still_accel_std: float = _parameter(
        0.4,
        "m/s2",
        "Standard deviation of the specific force within static_duration, per axis, below which the IMU counts as "
        "still. The default lets a car with its engine running pass.",
        above=0.0,
        maximum=100.0,
    )
    moving_tilt_std_deg: float = _parameter(
        5.0, "deg", "Standard deviation of roll and of pitch after levelling on the way.", above=0.0, maximum=90.0
    )
    found_heading_std_deg: float = _parameter(
        5.0,
        "deg",
        "An unknown heading is looked for by comparing the accelerations that the IMU and GNSS measure, in whatever "
        "direction the vehicle moves. It counts as known when its standard deviation falls below this.",
        above=0.0,
        maximum=30.0,
    )
    imu_orientation: str = _choice(
        "unused",
        "What Imu.orientation is good for at start, where nothing better tells the heading: true_north, its yaw is 0 "
        "in the east (REP-103); magnetic_north, its yaw counts from magnetic east (REP-145), and the declination is "
        "added as for mag.",
        "true_north",
        "magnetic_north",
    )
    imu_orientation_std_deg: float = _parameter(
        10.0,
        "deg",
        "Standard deviation of this heading at least.",
        above=0.0,
        maximum=90.0,
    )
    use_course: bool = _parameter(
        True,
        "",
        "For vehicles that travel along their x axis, forward or in reverse: take the course over ground as the "
        "heading, once the accelerations have told it from reversing and side slip. false for what moves in any "
        "direction (a multirotor, a vessel in the current, a walker with a hand-held IMU).",
    )
    course_min_speed: float = _parameter(
        1.5,
        "m/s",
        "Horizontal speed above which the course over ground tells the heading.",
        above=0.0,
        maximum=1000.0,
    )
    course_std_deg: float = _parameter(
        4.0,
        "deg",
        "How far the course over ground may differ from the heading (side slip, a trailer, wind), as a standard "
        "deviation.",
        above=0.0,
        maximum=180.0,
    )
    good_heading_std_deg: float = _parameter(
        3.0,
        "deg",
        "The state changes from ALIGNING to GOOD when the standard deviation of the heading falls below this.",
        above=0.0,
        maximum=180.0,
    )


@dataclass(frozen=True)
class WarmStart:
    file: str = _parameter(
        "",
        "",
        "File in which the node keeps biases, position and heading from one run to the next: written at shutdown, read "
        "at start. Empty: none.",
        pattern=r"[^\0]*",
        pattern_text="a path, or nothing",
    )
    max_age: float = _parameter(
        86400.0,
        "s",
        "A file older than this is not used. Age is counted in stamps of the IMU.",
        above=0.0,
        maximum=1.0e9,
    )
    heading_std_deg: float = _parameter(
        2.0,
        "deg",
        "Standard deviation of the heading that a vehicle parked in between is given at least.",
        above=0.0,
        maximum=180.0,
    )
    position_tolerance: float = _parameter(
        3.0,
        "m",
        "The first fix may be this far, plus three of its own standard deviations, from where the vehicle was left; "
        "otherwise it was moved, and its old heading is not used.",
        above=0.0,
        maximum=1.0e4,
    )


@dataclass(frozen=True)
class Output:
    tf: str = _choice(
        "full",
        "Transforms the node publishes on /tf. full: map -> odom -> base_link. map_to_odom: only map -> odom; another "
        "node owns odom -> base_link, which is read from /tf. none: none.",
        "map_to_odom",
        "none",
    )
    rate_divisor: int = _parameter(
        1, "", "Odometry and transforms are published for every so many IMU samples.", minimum=1, maximum=1000
    )
    two_d: bool = _parameter(
        False,
        "",
        "For planar robots: publish z, roll and pitch as zero, and no vertical velocity and no roll and pitch rate. "
        "The estimator works in three dimensions all the same.",
    )


@dataclass(frozen=True)
class Parameters:
    """Every parameter; `Parameters()` holds the defaults, `dataclasses.replace` changes a copy."""

    frames: Frames = _group(Frames, "Names of the coordinate frames.")
    topics: Topics = _group(Topics, "Names of the input topics: relative to the namespace, or absolute with a slash.")
    datum: tuple[float, ...] = _parameter(
        (),
        "deg, deg, m",
        "Origin of the map frame: [latitude, longitude, ellipsoidal altitude]. "
        "Empty: the first accepted fix becomes the origin and stays it.",
        lengths=(0, 3),
        minimum=(-90.0, -180.0, -1.0e4),
        maximum=(90.0, 180.0, 1.0e6),
    )
    mode: str = _choice(
        "loose",
        "How GNSS is used. loose: the receiver's position and velocity (topics.gnss_fix, topics.gnss_velocity). tight: "
        "each satellite's pseudorange and Doppler (topics.ranges) in place of the first receiver's fixes; below four "
        "satellites the estimate then degrades gradually.",
        "tight",
    )
    imu: Imu = _group(Imu, "Where the IMU sits and how good it is; biases and noise are in the axes of the IMU.")
    gnss: Gnss = _group(Gnss, "The GNSS receiver: where its antenna sits and how far its messages are trusted.")
    second_gnss: SecondGnss = _group(
        SecondGnss, "A second GNSS receiver with an antenna of its own; all else is as for the first."
    )
    heading: Heading = _group(Heading, "Heading of a dual-antenna receiver.")
    mag: Mag = _group(Mag, "Magnetometer.")
    wheel: Wheel = _group(Wheel, "Wheel odometry.")
    body_velocity: BodyVelocity = _group(BodyVelocity, "Velocity in the axes of the vehicle.")
    baro: Baro = _group(Baro, "Barometer.")
    ranges: Ranges = _group(Ranges, "What a GNSS receiver measures of each satellite: pseudorange and Doppler.")
    zupt: Zupt = _group(Zupt, "Standing still.")
    nhc: Nhc = _group(Nhc, "Non-holonomic constraint.")
    estimate: Estimate = _group(Estimate, "What is estimated besides the motion and the biases of the IMU.")
    history: History = _group(History, "Late and out-of-order messages.")
    alignment: Alignment = _group(Alignment, "Start-up: levelling, heading, and when the estimate is called good.")
    warm_start: WarmStart = _group(WarmStart, "What the node remembers of its last run.")
    output: Output = _group(Output, "What the node publishes, and how.")


@dataclass(frozen=True)
class Leaf:
    """One parameter: its dotted name and its rule."""

    name: str
    rule: Rule

    @property
    def default(self) -> Value:
        return self.rule.default

    @property
    def kind(self) -> str:
        """float, integer, bool, string or float list."""
        kinds = {bool: "bool", int: "integer", str: "string", tuple: "float list"}
        return kinds.get(type(self.default), "float")

    def allowed(self) -> str:
        """What may be written for this parameter, as it appears in errors and in the documentation."""
        rule = self.rule
        if self.kind == "bool":
            return "true or false"
        if self.kind == "string":
            return rule.pattern_text
        if isinstance(rule.minimum, tuple) and isinstance(rule.maximum, tuple):
            bounds = ", ".join(f"{low:g} to {high:g}" for low, high in zip(rule.minimum, rule.maximum))
        elif rule.above is not None and rule.below is not None:
            bounds = f"above {rule.above:g} and below {rule.below:g}"
        elif rule.above is not None:
            bounds = f"above {rule.above:g}, at most {rule.maximum:g}"
        else:
            bounds = f"{rule.minimum:g} to {rule.maximum:g}"
        if self.kind == "float list":
            counts = " or ".join("no" if count == 0 else str(count) for count in rule.lengths)
            return f"{counts} numbers, {'in turn' if isinstance(rule.minimum, tuple) else 'each'} {bounds}"
        noun = "a whole number" if self.kind == "integer" else "a number"
        return f"{noun} {bounds}{' or .nan' if rule.nan_allowed else ''}"

    def convert(self, value: object) -> Value:
        """The checked value in the type of this parameter; integers become floats where a float is wanted.

        Raises ValueError naming the key, the value and what is allowed.
        """
        converted = self._converted(value)
        if converted is None:
            unit = f" [{self.rule.unit}]" if self.rule.unit else ""
            shown = "an empty value" if value is None else repr(list(value) if isinstance(value, tuple) else value)
            raise ValueError(f"{self.name}: {shown} is not allowed here, it takes {self.allowed()}{unit}")
        return converted

    def _converted(self, value: object) -> Value | None:
        if self.kind == "bool":
            return value if isinstance(value, bool) else None
        if self.kind == "string":
            return value if isinstance(value, str) and re.fullmatch(self.rule.pattern, value) else None
        if self.kind == "integer":
            return value if isinstance(value, int) and self._number(value, 0) is not None else None
        if self.kind == "float":
            return self._number(value, 0)
        # numpy arrays and array.array (what rclpy hands out) are lists here too.
        elements = value.tolist() if hasattr(value, "tolist") else value
        if not isinstance(elements, (list, tuple)) or len(elements) not in self.rule.lengths:
            return None
        numbers = [self._number(element, index) for index, element in enumerate(elements)]
        return None if None in numbers else tuple(number for number in numbers if number is not None)

    def _number(self, value: object, index: int) -> float | None:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        if value != value:  # NaN; math.isnan fails for integers beyond the range of floats
            # One object for all: equal `to_mapping` then means equal parameters.
            return math.nan if self.rule.nan_allowed else None
        rule = self.rule
        minimum = rule.minimum[index] if isinstance(rule.minimum, tuple) else rule.minimum
        maximum = rule.maximum[index] if isinstance(rule.maximum, tuple) else rule.maximum
        inside = (
            (minimum is None or value >= minimum)
            and (maximum is None or value <= maximum)
            and (rule.above is None or value > rule.above)
            and (rule.below is None or value < rule.below)
        )
        return float(value) if inside else None


def leaves() -> tuple[Leaf, ...]:
    """All parameters in the order of the file."""
    return tuple(_leaves(Parameters, ""))


def _leaves(group: type, prefix: str) -> Iterator[Leaf]:
    for item in dataclasses.fields(group):
        if "rule" in item.metadata:
            yield Leaf(prefix + item.name, item.metadata["rule"])
        else:
            yield from _leaves(item.metadata["group"], prefix + item.name + ".")


def to_mapping(parameters: Parameters) -> dict[str, Value]:
    """Dotted name -> value of every parameter."""
    return {leaf.name: _value(parameters, leaf.name) for leaf in leaves()}


def _value(parameters: Parameters, name: str) -> Any:
    value: Any = parameters
    for part in name.split("."):
        value = getattr(value, part)
    return value


def from_mapping(mapping: Mapping[str, object], source: str = "parameters") -> Parameters:
    """Parameters from nested mappings or dotted keys (or both mixed); what is not given keeps its default.

    `source` is named in errors, usually the file. Raises ParameterError listing every unknown key, wrong type and
    value outside its range.
    """
    known = {leaf.name: leaf for leaf in leaves()}
    problems: list[str] = []
    values: dict[str, Value] = {}
    for name, raw in _flat(mapping, source).items():
        if name in known:
            try:
                values[name] = known[name].convert(raw)
            except ValueError as error:
                problems.append(str(error))
        elif not _belongs_to_every_node(name):
            problems.append(_unknown(name, raw, list(known)))
    if problems:
        raise ParameterError(source, problems)
    parameters: Parameters = _build(Parameters, "", values)
    return parameters


def _flat(mapping: Mapping[str, object], source: str) -> dict[str, object]:
    values: dict[str, object] = {}
    problems: list[str] = []
    for name, value in _flatten(mapping, ""):
        if name in values:
            problems.append(f"{name}: given twice, as {values[name]!r} and as {value!r}; keep one of them")
        values[name] = value
    if problems:
        raise ParameterError(source, problems)
    return values


def _flatten(mapping: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    for key, value in mapping.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _belongs_to_every_node(name: str) -> bool:
    return name in ("use_sim_time", "start_type_description_service") or name.startswith("qos_overrides.")


def _unknown(name: str, value: object, known: list[str]) -> str:
    members = [other for other in known if other.startswith(name + ".")]
    if members:
        return f"{name}: {value!r} given, but {name} is a group; its parameters are {', '.join(members)}"
    # A key in the wrong group is as frequent as a typing error.
    same_tail = [other for other in known if other.rpartition(".")[2] == name.rpartition(".")[2]]
    closest = difflib.get_close_matches(name, known, n=1) or same_tail
    hint = f"did you mean {closest[0]}?" if closest else "docs/parameters.md lists all parameters"
    return f"{name}: unknown parameter (value {value!r}); {hint}"


def _build(group: type, prefix: str, values: Mapping[str, Value]) -> Any:
    arguments: dict[str, Any] = {}
    for item in dataclasses.fields(group):
        name = prefix + item.name
        if "rule" not in item.metadata:
            arguments[item.name] = _build(item.metadata["group"], name + ".", values)
        elif name in values:
            arguments[item.name] = values[name]
    return group(**arguments)


class _RosLoader(yaml.SafeLoader):
    """Reads `1e-3` as a number, as ROS and people do (in YAML 1.1 it is a string), and refuses repeated keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key_node.value} is given twice", key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


_RosLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


def load(path: Path, node_name: str = "eskf_node") -> Parameters:
    """Parameters from a ROS 2 parameter file.

    Sections apply as in ROS: `/**`, `/*`, `eskf_node`, `/robot/eskf_node`, or nested namespaces; sections of other
    nodes are ignored; where several apply, the later one in the file wins. A `node_name` without a leading slash
    stands for the node in whatever single namespace the file uses.

    Raises ParameterError (naming the file and everything wrong in it) for a file that cannot be read, is no YAML,
    has no section for this node, or fails `from_mapping`.
    """
    source = str(path)
    try:
        document = yaml.load(path.read_text(encoding="utf-8"), Loader=_RosLoader)
    except OSError as error:
        raise ParameterError(source, [f"cannot read the parameter file: {error.strerror}"]) from error
    except UnicodeDecodeError as error:
        raise ParameterError(source, ["not a text file, so not a parameter file"]) from error
    except yaml.YAMLError as error:
        raise ParameterError(source, [f"not valid YAML: {' '.join(str(error).split())}"]) from error
    wanted = "a ROS parameter file has '/**:', below it 'ros__parameters:', and below that the parameters"
    if not isinstance(document, Mapping):
        raise ParameterError(source, [f"no parameters found; {wanted}"])
    sections = list(_sections(document, ""))
    if not sections:
        raise ParameterError(source, [f"no 'ros__parameters:' found; {wanted}"])
    applying = [(name, content) for name, content in sections if _applies(name, node_name)]
    if not applying:
        names = ", ".join(name for name, _ in sections)
        raise ParameterError(source, [f"no section applies to node {node_name}; the sections are {names}"])
    concrete = sorted({name for name, _ in applying if "*" not in name})
    if len(concrete) > 1:
        raise ParameterError(
            source, [f"sections for several nodes called {node_name}: {', '.join(concrete)}; keep one"]
        )
    merged: dict[str, object] = {}
    for name, content in applying:
        if not isinstance(content, Mapping):
            raise ParameterError(source, [f"{name}: nothing below 'ros__parameters:'"])
        merged.update(_flat(content, source))
    return from_mapping(merged, source)


def _sections(document: Mapping[str, object], namespace: str) -> Iterator[tuple[str, object]]:
    for key, value in document.items():
        if key == "ros__parameters":
            yield namespace or "/", value
        elif isinstance(value, Mapping):
            yield from _sections(value, f"{namespace}/{str(key).strip('/')}")


def _applies(section: str, node_name: str) -> bool:
    pattern = re.escape(section).replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
    if node_name.startswith("/"):
        return re.fullmatch(pattern, node_name) is not None
    if "*" not in section:
        return section.rpartition("/")[2] == node_name
    # The namespace is not known here: a pattern applies when there is a namespace in which it would.
    last = section.rpartition("/")[2]
    return last in (node_name, "*", "**")


def to_yaml(parameters: Parameters | None = None) -> str:
    """A commented ROS parameter file with the given values (default: the defaults; that text is config/eskf.yaml)."""
    lines = [
        "# Parameters of eskf_ros with their defaults. Copy the file, keep the lines you change.",
        "# Written from eskf_ros/parameters.py by `python -m eskf_ros.parameters`.",
        "# Write all numbers of a list with a decimal point: ROS refuses [1, 2.5].",
        "/**:",
        "  ros__parameters:",
    ]
    _yaml_group(Parameters, "", parameters or Parameters(), lines)
    return "\n".join(lines) + "\n"


def _yaml_group(group: type, prefix: str, parameters: Parameters, lines: list[str]) -> None:
    indent = " " * (4 + 2 * prefix.count("."))
    for item in dataclasses.fields(group):
        name = prefix + item.name
        if "rule" not in item.metadata:
            lines += ["", f"{indent}# {item.metadata['description']}", f"{indent}{item.name}:"]
            _yaml_group(item.metadata["group"], name + ".", parameters, lines)
            continue
        leaf = Leaf(name, item.metadata["rule"])
        if not prefix:
            lines.append("")
        unit = f" {leaf.rule.unit}" if leaf.rule.unit else ""
        change = "can change while running" if leaf.rule.live else "read at start"
        limits = f"Default {_yaml_value(leaf.default)}{unit}; {leaf.allowed()}; {change}."
        for text in (leaf.rule.description, limits):
            lines += textwrap.wrap(text, 116, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
        value = _value(parameters, name)
        if value == ():
            # ROS makes an empty list a parameter without a type, which no node can declare: show the form only.
            lines.append(f"{indent}# {item.name}: {_yaml_value((0.0,) * max(leaf.rule.lengths))}")
        else:
            lines.append(f"{indent}{item.name}: {_yaml_value(value)}")


def _yaml_value(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, tuple):
        return f"[{', '.join(_yaml_value(element) for element in value)}]"
    if isinstance(value, int):
        return str(value)
    if math.isnan(value):
        return ".nan"
    mantissa, exponent_sign, exponent = repr(value).partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{exponent_sign}{exponent}"


def to_markdown() -> str:
    """The reference of all parameters; that text is docs/parameters.md."""
    lines = [
        "# Parameters",
        "",
        "Written from `eskf_ros/parameters.py` by `python -m eskf_ros.parameters`; `config/eskf.yaml` holds the same",
        "as a file to copy. `eskf_replay --config FILE` reads ROS 2 parameter files; an unknown key, a wrong type or a",
        "value outside its range is an error that names it. Live parameters may change while the node runs, the others",
        "are read at start.",
        "",
    ]
    top = [leaf for leaf in leaves() if "." not in leaf.name]
    lines += ["## Top level", "", *_markdown_table(top)]
    for item in dataclasses.fields(Parameters):
        if "rule" not in item.metadata:
            members = [leaf for leaf in leaves() if leaf.name.startswith(item.name + ".")]
            lines += ["", f"## {item.name}", "", item.metadata["description"], "", *_markdown_table(members)]
    return "\n".join(lines) + "\n"


def _markdown_table(members: list[Leaf]) -> list[str]:
    rows = ["| name | default | unit | allowed | live | meaning |", "|---|---|---|---|---|---|"]
    for leaf in members:
        rule = leaf.rule
        live = "yes" if rule.live else "no"
        cells = (f"`{leaf.name}`", f"`{_yaml_value(leaf.default)}`", rule.unit, leaf.allowed(), live, rule.description)
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def main() -> int:
    """Write config/eskf.yaml and docs/parameters.md of the checkout this module lies in; returns the exit code."""
    root = Path(__file__).resolve().parent.parent
    if not (root / "setup.py").is_file():
        print(f"{root} is no checkout of eskf_ros: run this where the sources are", file=sys.stderr)
        return 2
    for path, text in ((root / "config" / "eskf.yaml", to_yaml()), (root / "docs" / "parameters.md", to_markdown())):
        path.write_text(text, encoding="utf-8")
        print(f"written: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
