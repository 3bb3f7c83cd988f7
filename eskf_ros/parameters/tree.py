"""The parameters of eskf_ros: names, units, defaults, ranges and what they mean.

The dataclasses below are the only place where a parameter is defined. `config/eskf.yaml` and `docs/parameters.md`
are written from them by `python -m eskf_ros.parameters`, and `load` reads the ROS 2 parameter files users write.

Values are Python floats, integers, bools, strings and tuples of floats. Angles whose name ends in `_deg` are degrees,
all others are in the SI unit stated with them. This module imports neither numpy nor ROS, so that reading a
configuration costs no start-up time.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from eskf_ros.parameters.ros_yaml import _RosLoader
from eskf_ros.parameters.schema import (
    FRAME_NAME,
    TOPIC_NAME,
    TYPE_OF_TOPIC,
    Aid,
    choice,
    group_of,
    parameter,
)


@dataclass(frozen=True)
class Frames:
    map: str = parameter(
        "map", "", "Frame of the global estimate: East-North-Up at the datum, fixed to the Earth.", **FRAME_NAME
    )
    odom: str = parameter("odom", "", "Frame of the local estimate, which never jumps (REP-105).", **FRAME_NAME)
    base_link: str = parameter(
        "base_link",
        "",
        "Frame of the vehicle whose pose is estimated: x forward, y left, z up (REP-103).",
        **FRAME_NAME,
    )
    extrinsics: str = choice(
        "auto",
        "Where the node takes the places of the sensors in base_link from. auto: a sensor whose parameters "
        "(imu.mount_position and imu.mount_rpy_deg, gnss.lever_arm, and so on) are all zero is looked up on /tf_static "
        "by the header.frame_id of its messages. parameters: /tf_static is not looked at; so it is in the replay.",
        "parameters",
    )


@dataclass(frozen=True)
class Topics:
    imu: str = parameter(
        "imu/data", "", "sensor_msgs/Imu: angular rate and specific force (+g up at rest).", **TOPIC_NAME
    )
    gnss_fix: str = parameter("gps/fix", "", "sensor_msgs/NavSatFix: position of the GNSS antenna.", **TOPIC_NAME)
    gnss_velocity: str = parameter(
        "gps/vel",
        "",
        "geometry_msgs/TwistWithCovarianceStamped: velocity of the GNSS antenna, East-North-Up.",
        **TOPIC_NAME,
    )
    gnss_velocity_type: str = choice(
        "geometry_msgs/msg/TwistWithCovarianceStamped", TYPE_OF_TOPIC, "geometry_msgs/msg/TwistStamped"
    )
    heading: str = parameter(
        "gnss/heading",
        "",
        "sensor_msgs/Imu of a dual-antenna receiver: yaw (0 = east, counter-clockwise) and pitch of the baseline; one "
        "whose variance is above 1 rad2 is not used.",
        **TOPIC_NAME,
    )
    mag: str = parameter(
        "imu/mag", "", "sensor_msgs/MagneticField: field in the axes of the magnetometer.", **TOPIC_NAME
    )
    wheel: str = parameter(
        "wheel/odom", "", "nav_msgs/Odometry: wheel odometry, of which speed and yaw rate are used.", **TOPIC_NAME
    )
    wheel_type: str = choice(
        "nav_msgs/msg/Odometry",
        TYPE_OF_TOPIC,
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        "geometry_msgs/msg/TwistStamped",
    )
    body_velocity: str = parameter(
        "body_velocity",
        "",
        "geometry_msgs/TwistWithCovarianceStamped: velocity in the axes of the vehicle, of a DVL, optical flow, radar "
        "or odometry of any kind; an axis with a negative variance is absent.",
        **TOPIC_NAME,
    )
    body_velocity_type: str = choice(
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        TYPE_OF_TOPIC,
        "geometry_msgs/msg/TwistStamped",
        "nav_msgs/msg/Odometry",
    )
    baro: str = parameter("baro", "", "sensor_msgs/FluidPressure: air pressure.", **TOPIC_NAME)
    ranges: str = parameter(
        "gnss/ranges",
        "",
        "sensor_msgs/PointCloud2: what the receiver measures of each satellite, one point per signal (mode tight).",
        **TOPIC_NAME,
    )
    ephemerides: str = parameter(
        "gnss/ephemerides",
        "",
        "sensor_msgs/PointCloud2: orbits and clocks of the satellites, one point per broadcast ephemeris.",
        **TOPIC_NAME,
    )
    initial_pose: str = parameter(
        "initialpose",
        "",
        "geometry_msgs/PoseWithCovarianceStamped in frames.map: puts the estimate there, as RViz's tool does. Position "
        "and yaw are taken over; a height without variance is not. The replay does not read it.",
        **TOPIC_NAME,
    )


@dataclass(frozen=True)
class Imu:
    mount_position: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the IMU in base_link, x forward, y left, z up.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    mount_rpy_deg: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "deg",
        "Orientation of the IMU in base_link: roll, pitch, yaw about fixed axes as in a URDF.",
        minimum=-360.0,
        maximum=360.0,
    )
    gyro_noise_density: float = parameter(
        1.5e-3,
        "rad/s/rtHz",
        "White noise of the gyro as mounted. The default, 0.0859 deg/s/rtHz (5.16 deg/rt h), is for a consumer MEMS "
        "IMU shaken by engine and road; a data sheet says 2e-4 (consumer), 0.5e-4 (industrial), 0.1e-4 and less "
        "(tactical): use that on a smooth vehicle.",
        above=0.0,
        maximum=1.0,
        live=True,
    )
    accel_noise_density: float = parameter(
        3.0e-2,
        "m/s2/rtHz",
        "White noise of the accelerometer as mounted. The default, 3060 ug/rtHz, is for a consumer MEMS IMU shaken "
        "by engine and road; a data sheet says 2e-3 (consumer), 0.6e-3 (industrial): use that on a smooth vehicle.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    gyro_bias_random_walk: float = parameter(
        1.0e-5,
        "rad/s2/rtHz",
        "How fast the gyro bias wanders: by this value times the square root of the seconds passed. "
        "The default is 0.0044 deg/s in one minute, a consumer MEMS IMU; industrial MEMS about 0.2e-5.",
        minimum=0.0,
        maximum=0.1,
        live=True,
    )
    accel_bias_random_walk: float = parameter(
        2.0e-4,
        "m/s3/rtHz",
        "How fast the accelerometer bias wanders: by this value times the square root of the seconds passed. "
        "The default is 0.16 mg in one minute, a consumer MEMS IMU; industrial MEMS about 0.5e-4.",
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    gyro_bias_std: float = parameter(
        0.01,
        "rad/s",
        "Standard deviation of the unknown gyro bias at start (0.57 deg/s). "
        "Zero together with a zero random walk switches the estimation of this bias off.",
        minimum=0.0,
        maximum=1.0,
    )
    accel_bias_std: float = parameter(
        0.2,
        "m/s2",
        "Standard deviation of the unknown accelerometer bias at start (20 mg). "
        "Zero together with a zero random walk switches the estimation of this bias off.",
        minimum=0.0,
        maximum=10.0,
    )
    gap: float = parameter(
        0.1,
        "s",
        "An interval between two IMU samples longer than this is a gap: it is bridged with the samples on its two "
        "sides and costs the extra uncertainty given by gap_accel_std and gap_gyro_std.",
        above=0.0,
        maximum=10.0,
    )
    gap_accel_std: float = parameter(
        2.0,
        "m/s2",
        "How far the mean acceleration during a gap may be from what the samples on its two sides say.",
        minimum=0.0,
        maximum=100.0,
        live=True,
    )
    gap_gyro_std: float = parameter(
        0.3,
        "rad/s",
        "How far the mean angular rate during a gap may be from what the samples on its two sides say.",
        minimum=0.0,
        maximum=100.0,
        live=True,
    )


@dataclass(frozen=True)
class Gnss:
    use_position: bool = parameter(True, "", "Fuse the positions of topics.gnss_fix.", live=True)
    use_velocity: bool = parameter(True, "", "Fuse the velocities of topics.gnss_velocity.", live=True)
    lever_arm: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the GNSS antenna in base_link, x forward, y left, z up. "
        "Measure it to a few centimetres: an error here becomes a position error that turns with the vehicle.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    time_offset: float = parameter(
        0.0,
        "s",
        "Added to the stamps of the GNSS messages: true time = stamp + offset. "
        "Negative when the driver stamps a message on arrival.",
        minimum=-10.0,
        maximum=10.0,
    )
    position_std_floor: float = parameter(
        0.02,
        "m",
        "The standard deviation of a GNSS position is never taken smaller than this, per axis.",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    velocity_std_floor: float = parameter(
        0.03,
        "m/s",
        "The standard deviation of a GNSS velocity is never taken smaller than this, per axis.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    covariance_scale: float = parameter(
        1.0,
        "",
        "Factor on the covariances (variances, not standard deviations) that the GNSS messages carry. "
        "Raise it for a receiver that is too sure of itself; the floors apply after it.",
        above=0.0,
        maximum=1.0e6,
        live=True,
    )
    gate_probability: float = parameter(
        0.999,
        "",
        "Chi-square gate: the share of good measurements that passes. With 0.999 one good measurement in a thousand "
        "is rejected (3 axes: normalised innovation squared above 16.27); closer to 1 lets more outliers in.",
        above=0.0,
        below=1.0,
        live=True,
    )
    correlation_time: float = parameter(
        0.0,
        "s",
        "How long the error of a position lasts (e-folding time). 0: fixes err independently of each other. Those of a "
        "receiver at several Hz do not, and the estimate then trusts their mean too much; without corrections 30 to "
        "300 s is usual.",
        minimum=0.0,
        maximum=1.0e5,
    )
    correlated_share: float = parameter(
        0.8,
        "",
        "With a correlation_time: the share of the variance of each fix that lasts; the rest is new every time.",
        above=0.0,
        below=1.0,
        live=True,
    )
    status_std_horizontal: tuple[float, ...] = parameter(
        (3.0, 2.0, 0.5),
        "m",
        "Standard deviation of east and of north when a fix comes with a covariance of unknown type or all zero, "
        "by NavSatFix status: [fix, sbas, gbas].",
        above=0.0,
        maximum=1.0e4,
        live=True,
    )
    status_std_vertical: tuple[float, ...] = parameter(
        (6.0, 4.0, 1.0),
        "m",
        "The same for the altitude: [fix, sbas, gbas].",
        above=0.0,
        maximum=1.0e4,
        live=True,
    )
    unknown_velocity_std: float = parameter(
        0.3,
        "m/s",
        "Standard deviation per axis of a GNSS velocity whose covariance is unknown or all zero.",
        above=0.0,
        maximum=100.0,
        live=True,
    )


@dataclass(frozen=True)
class SecondGnss:
    frame_id: str = parameter(
        "",
        "",
        "Messages of topics.gnss_fix and topics.gnss_velocity with this frame are those of the second receiver. "
        "Empty: there is one receiver.",
        pattern=r"([^/\s]\S*)?",
        pattern_text="empty, or a frame name without blanks and without a leading slash",
    )
    lever_arm: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the second antenna in base_link, x forward, y left, z up.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    time_offset: float = parameter(
        0.0,
        "s",
        "Added to the stamps of the second receiver's messages: true time = stamp + offset.",
        minimum=-10.0,
        maximum=10.0,
    )


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


@dataclass(frozen=True)
class Mag(Aid):
    use: bool = parameter(
        False,
        "",
        "Fuse the heading that the magnetometer shows. Off unless asked for: in vehicles, indoors and near iron it "
        "misleads.",
        live=True,
    )
    mount_rpy_deg: tuple[float, ...] = parameter(
        (),
        "deg",
        "Orientation of the magnetometer in base_link: roll, pitch, yaw about fixed axes as in a URDF. "
        "Empty: its axes are those of the IMU.",
        lengths=(0, 3),
        minimum=-360.0,
        maximum=360.0,
    )
    declination_deg: float = parameter(
        math.nan,
        "deg",
        "Angle from true north to magnetic north, east positive. .nan: from the World Magnetic Model for the place of "
        "the fixes and the date of their stamps, for which the Python package pygeomag must be installed.",
        minimum=-180.0,
        maximum=180.0,
        nan_allowed=True,
    )
    error_std_deg: float = parameter(
        4.0,
        "deg",
        "Standard deviation of the heading error that remains after calibration, by iron in the vehicle and nearby. It "
        "does not average out while the vehicle stands.",
        above=0.0,
        maximum=180.0,
    )
    error_distance: float = parameter(
        50.0,
        "m",
        "Having travelled so far, or turned by one radian, the vehicle meets another such error.",
        above=0.0,
        maximum=1.0e6,
    )
    strength_tolerance: float = parameter(
        0.15,
        "",
        "A field is taken for disturbed where its strength differs by more than this part from that of the World "
        "Magnetic Model. Without the model nothing is checked.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    inclination_tolerance_deg: float = parameter(
        8.0,
        "deg",
        "The same for its inclination (dip).",
        above=0.0,
        maximum=180.0,
        live=True,
    )
    std_floor: float = parameter(
        1.0e-6,
        "T",
        "The standard deviation per axis is never taken smaller than this.",
        above=0.0,
        maximum=1.0,
        live=True,
    )
    unknown_std: float = parameter(
        1.0e-6, "T", "Standard deviation per axis where the message gives none.", above=0.0, maximum=1.0, live=True
    )


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


@dataclass(frozen=True)
class Baro(Aid):
    position: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the barometer in base_link, x forward, y left, z up.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    offset_std: float = parameter(
        300.0,
        "m",
        "Standard deviation at first of the difference between pressure altitude and height: weather and geoid. "
        "It is estimated.",
        above=0.0,
        maximum=1.0e4,
    )
    offset_random_walk: float = parameter(
        0.1,
        "m/s/rtHz",
        "How fast that difference wanders, by weather, wind and warming up: by this value times the square root of the "
        "seconds passed. The default is 6 m in one hour; more where air is blown about, as in a vehicle.",
        minimum=0.0,
        maximum=100.0,
    )
    scale_std: float = parameter(
        0.03,
        "",
        "Standard deviation of the factor by which pressure altitude grows faster or slower than height: 0.03 where "
        "the air is 9 K warmer or colder than in the standard atmosphere. It is estimated.",
        minimum=0.0,
        maximum=1.0,
    )
    std_floor: float = parameter(
        3.0, "Pa", "The standard deviation is never taken smaller than this.", above=0.0, maximum=1.0e4, live=True
    )
    unknown_std: float = parameter(
        10.0, "Pa", "Standard deviation where the message gives none.", above=0.0, maximum=1.0e4, live=True
    )


@dataclass(frozen=True)
class Ranges(Aid):
    use: bool = parameter(
        True,
        "",
        "Fuse the pseudoranges of topics.ranges in mode tight.",
        live=True,
    )
    use_doppler: bool = parameter(True, "", "Fuse the Doppler of topics.ranges in mode tight.", live=True)
    time_offset: float = parameter(
        0.0,
        "s",
        "Added to the stamps: true time = stamp + offset. RINEX files are stamped with UTC: -18 or 18 s may be missing "
        "where a recording is stamped with GPS time.",
        minimum=-100.0,
        maximum=100.0,
    )
    gate_probability: float = parameter(
        0.99994,
        "",
        "Gate of each signal: the share of good measurements that passes; 0.99994 is four standard deviations. From "
        "2.5 on they are weighed down.",
        above=0.0,
        below=1.0,
        live=True,
    )
    code_std_floor: float = parameter(
        0.3,
        "m",
        "The standard deviation of a pseudorange is never taken smaller than this.",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    range_rate_std_floor: float = parameter(
        0.03,
        "m/s",
        "The standard deviation of a range rate (Doppler) is never taken smaller than this.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    elevation_mask_deg: float = parameter(
        10.0, "deg", "Satellites below this elevation are not used.", minimum=-90.0, maximum=90.0, live=True
    )
    cn0_mask: float = parameter(
        28.0,
        "dB-Hz",
        "Signals whose carrier-to-noise density is below this are not used; an unknown one passes.",
        minimum=0.0,
        maximum=60.0,
        live=True,
    )
    clock_drift_noise: float = parameter(
        0.3,
        "m/s/rts",
        "How fast the drift of the receiver's clock wanders: by this value times the square root of the seconds "
        "passed. 0.1 geodetic receiver, 0.3 usual, 0.6 hand-held or shaken. Too small makes one or two satellites "
        "worse than none.",
        minimum=0.0,
        maximum=1.0e3,
        live=True,
    )
    clock_bias_noise: float = parameter(
        0.1,
        "m/rts",
        "How fast the bias of the receiver's clock wanders besides its drift.",
        minimum=0.0,
        maximum=1.0e3,
        live=True,
    )
    correlation_time: float = parameter(
        120.0,
        "s",
        "How long the common error of the pseudoranges lasts (e-folding time): reflections, orbits, what the models "
        "leave of the atmosphere. 0: not modelled, and the estimate then trusts the mean of many epochs too much.",
        minimum=0.0,
        maximum=1.0e5,
    )
    correlated_std: float = parameter(
        1.5,
        "m",
        "With a correlation_time: the standard deviation of a position by errors that last, per horizontal axis ...",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    correlated_std_vertical: float = parameter(
        3.0,
        "m",
        "... and vertically, where the atmosphere is not averaged out. More without parameters of the ionosphere for "
        "the day (5 m): the stand-in may be wrong by its own size.",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    inter_system_std: float = parameter(
        10.0,
        "m",
        "Standard deviation of the offset between a constellation and GPS in the receiver at first.",
        above=0.0,
        maximum=1.0e4,
    )
    inter_system_std_glonass: float = parameter(30.0, "m", "The same for GLONASS.", above=0.0, maximum=1.0e4)
    inter_system_noise: float = parameter(
        0.02, "m/rts", "How fast these offsets wander.", minimum=0.0, maximum=100.0, live=True
    )
    use_point_solution: bool = parameter(
        False,
        "",
        "In mode loose: solve each epoch of topics.ranges for position and velocity, and fuse these instead of the "
        "receiver's own fixes.",
    )
    rinex_nav_files: str = parameter(
        "",
        "",
        "RINEX navigation files with the orbits and clocks of the satellites, separated by colons. Empty: they come "
        "by topics.ephemerides, or topics.ranges brings the satellites itself.",
        pattern=r"[^\0]*",
        pattern_text="paths separated by colons, or nothing",
    )


@dataclass(frozen=True)
class Zupt:
    enabled: bool = parameter(
        True,
        "",
        "While the vehicle stands still, hold velocity and turn rate at zero. Wheels, GNSS and the spread of the IMU's "
        "readings tell when it does.",
        live=True,
    )
    velocity_std: float = parameter(
        0.02,
        "m/s",
        "Standard deviation of the velocity of a vehicle that stands: it sways on its springs.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    rate_std: float = parameter(
        1.0e-4,
        "rad/s",
        "Standard deviation of its turn rate, as a mean over one second.",
        above=0.0,
        maximum=1.0,
        live=True,
    )


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


@dataclass(frozen=True)
class Estimate:
    wheel_scale: bool = parameter(
        True,
        "",
        "Estimate what the wheels multiply the speed with: nobody knows the radius of a tyre to a per mille.",
    )
    wheel_scale_std: float = parameter(
        0.03, "", "Standard deviation of the scale of the wheels at start.", above=0.0, maximum=1.0
    )
    wheel_scale_random_walk: float = parameter(
        5.0e-5,
        "1/rtHz",
        "How fast the scale of the wheels wanders with load and tyre pressure: by this value times the square root of "
        "the seconds passed.",
        minimum=0.0,
        maximum=1.0,
    )
    mounting: bool = parameter(
        True,
        "",
        "Estimate yaw and pitch of the direction in which the vehicle rolls against the x axis of base_link, where "
        "wheels or nhc need it.",
    )
    mounting_std_deg: float = parameter(
        2.0, "deg", "Standard deviation of these angles at start.", above=0.0, maximum=45.0
    )
    magnetic_bias: bool = parameter(
        False,
        "",
        "Estimate the hard iron that turns with the magnetometer. It shows as the vehicle turns.",
    )
    magnetic_bias_std: float = parameter(
        3.0e-6, "T", "Standard deviation per axis of this field at start.", above=0.0, maximum=1.0e-3
    )
    mounting_random_walk: float = parameter(
        3.0e-5,
        "rad/rtHz",
        "How fast these angles wander with the load: by this value times the square root of the seconds passed.",
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class History:
    window: float = parameter(
        2.0,
        "s",
        "How far behind the newest IMU stamp a message may lie and still be put where it belongs in time. "
        "Later ones are counted and never applied. Memory grows with it.",
        above=0.0,
        maximum=60.0,
    )


@dataclass(frozen=True)
class Alignment:
    initial_heading_deg: float = parameter(
        math.nan,
        "deg",
        "Heading at start when it is known: yaw of base_link, 0 = east, counter-clockwise. "
        ".nan = unknown: then a dual antenna, the magnetometer or imu_orientation tell it, in this order, or it is "
        "found from the accelerations and the course over ground.",
        minimum=-360.0,
        maximum=360.0,
        nan_allowed=True,
    )
    initial_heading_std_deg: float = parameter(
        5.0, "deg", "Standard deviation of initial_heading_deg.", above=0.0, maximum=180.0
    )
    static_duration: float = parameter(
        2.0, "s", "How long the IMU must be still to level from it.", minimum=0.1, maximum=600.0
    )
    moving_start_after: float = parameter(
        3.0,
        "s",
        "When no stillness was found for so long, the vehicle is taken to be moving and is levelled on the way.",
        minimum=0.1,
        maximum=600.0,
    )
    still_gyro_std: float = parameter(
        0.06,
        "rad/s",
        "Standard deviation of the angular rate within static_duration, per axis, below which the IMU counts as still. "
        "The default lets a car with its engine running pass.",
        above=0.0,
        maximum=10.0,
    )
    still_accel_std: float = parameter(
        0.4,
        "m/s2",
        "Standard deviation of the specific force within static_duration, per axis, below which the IMU counts as "
        "still. The default lets a car with its engine running pass.",
        above=0.0,
        maximum=100.0,
    )
    moving_tilt_std_deg: float = parameter(
        5.0, "deg", "Standard deviation of roll and of pitch after levelling on the way.", above=0.0, maximum=90.0
    )
    found_heading_std_deg: float = parameter(
        5.0,
        "deg",
        "An unknown heading is looked for by comparing the accelerations that the IMU and GNSS measure, in whatever "
        "direction the vehicle moves. It counts as known when its standard deviation falls below this.",
        above=0.0,
        maximum=30.0,
    )
    imu_orientation: str = choice(
        "unused",
        "What Imu.orientation is good for at start, where nothing better tells the heading: true_north, its yaw is 0 "
        "in the east (REP-103); magnetic_north, its yaw counts from magnetic east (REP-145), and the declination is "
        "added as for mag.",
        "true_north",
        "magnetic_north",
    )
    imu_orientation_std_deg: float = parameter(
        10.0,
        "deg",
        "Standard deviation of this heading at least.",
        above=0.0,
        maximum=90.0,
    )
    use_course: bool = parameter(
        True,
        "",
        "For vehicles that travel along their x axis, forward or in reverse: take the course over ground as the "
        "heading, once the accelerations have told it from reversing and side slip. false for what moves in any "
        "direction (a multirotor, a vessel in the current, a walker with a hand-held IMU).",
    )
    course_min_speed: float = parameter(
        1.5,
        "m/s",
        "Horizontal speed above which the course over ground tells the heading.",
        above=0.0,
        maximum=1000.0,
    )
    course_std_deg: float = parameter(
        4.0,
        "deg",
        "How far the course over ground may differ from the heading (side slip, a trailer, wind), as a standard "
        "deviation.",
        above=0.0,
        maximum=180.0,
    )
    good_heading_std_deg: float = parameter(
        3.0,
        "deg",
        "The state changes from ALIGNING to GOOD when the standard deviation of the heading falls below this.",
        above=0.0,
        maximum=180.0,
    )


@dataclass(frozen=True)
class WarmStart:
    file: str = parameter(
        "",
        "",
        "File in which the node keeps biases, position and heading from one run to the next: written at shutdown, read "
        "at start. Empty: none.",
        pattern=r"[^\0]*",
        pattern_text="a path, or nothing",
    )
    max_age: float = parameter(
        86400.0,
        "s",
        "A file older than this is not used. Age is counted in stamps of the IMU.",
        above=0.0,
        maximum=1.0e9,
    )
    heading_std_deg: float = parameter(
        2.0,
        "deg",
        "Standard deviation of the heading that a vehicle parked in between is given at least.",
        above=0.0,
        maximum=180.0,
    )
    position_tolerance: float = parameter(
        3.0,
        "m",
        "The first fix may be this far, plus three of its own standard deviations, from where the vehicle was left; "
        "otherwise it was moved, and its old heading is not used.",
        above=0.0,
        maximum=1.0e4,
    )


@dataclass(frozen=True)
class Output:
    tf: str = choice(
        "full",
        "Transforms the node publishes on /tf. full: map -> odom -> base_link. map_to_odom: only map -> odom; another "
        "node owns odom -> base_link, which is read from /tf. none: none.",
        "map_to_odom",
        "none",
    )
    rate_divisor: int = parameter(
        1, "", "Odometry and transforms are published for every so many IMU samples.", minimum=1, maximum=1000
    )
    two_d: bool = parameter(
        False,
        "",
        "For planar robots: publish z, roll and pitch as zero, and no vertical velocity and no roll and pitch rate. "
        "The estimator works in three dimensions all the same.",
    )


@dataclass(frozen=True)
class Parameters:
    """Every parameter; `Parameters()` holds the defaults, `dataclasses.replace` changes a copy."""

    frames: Frames = group_of(Frames, "Names of the coordinate frames.")
    topics: Topics = group_of(Topics, "Names of the input topics: relative to the namespace, or absolute with a slash.")
    datum: tuple[float, ...] = parameter(
        (),
        "deg, deg, m",
        "Origin of the map frame: [latitude, longitude, ellipsoidal altitude]. "
        "Empty: the first accepted fix becomes the origin and stays it.",
        lengths=(0, 3),
        minimum=(-90.0, -180.0, -1.0e4),
        maximum=(90.0, 180.0, 1.0e6),
    )
    mode: str = choice(
        "loose",
        "How GNSS is used. loose: the receiver's position and velocity (topics.gnss_fix, topics.gnss_velocity). tight: "
        "each satellite's pseudorange and Doppler (topics.ranges) in place of the first receiver's fixes; below four "
        "satellites the estimate then degrades gradually.",
        "tight",
    )
    imu: Imu = group_of(Imu, "Where the IMU sits and how good it is; biases and noise are in the axes of the IMU.")
    gnss: Gnss = group_of(Gnss, "The GNSS receiver: where its antenna sits and how far its messages are trusted.")
    second_gnss: SecondGnss = group_of(
        SecondGnss, "A second GNSS receiver with an antenna of its own; all else is as for the first."
    )
    heading: Heading = group_of(Heading, "Heading of a dual-antenna receiver.")
    mag: Mag = group_of(Mag, "Magnetometer.")
    wheel: Wheel = group_of(Wheel, "Wheel odometry.")
    body_velocity: BodyVelocity = group_of(BodyVelocity, "Velocity in the axes of the vehicle.")
    baro: Baro = group_of(Baro, "Barometer.")
    ranges: Ranges = group_of(Ranges, "What a GNSS receiver measures of each satellite: pseudorange and Doppler.")
    zupt: Zupt = group_of(Zupt, "Standing still.")
    nhc: Nhc = group_of(Nhc, "Non-holonomic constraint.")
    estimate: Estimate = group_of(Estimate, "What is estimated besides the motion and the biases of the IMU.")
    history: History = group_of(History, "Late and out-of-order messages.")
    alignment: Alignment = group_of(Alignment, "Start-up: levelling, heading, and when the estimate is called good.")
    warm_start: WarmStart = group_of(WarmStart, "What the node remembers of its last run.")
    output: Output = group_of(Output, "What the node publishes, and how.")


_RosLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)
