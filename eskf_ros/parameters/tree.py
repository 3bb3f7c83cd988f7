"""The parameters of eskf_ros: names, units, defaults, ranges and descriptions.

The dataclasses below, and those in the files of the measurements (`filter.rows`), are the only places where a parameter
is defined. `python -m eskf_ros.parameters` generates `config/eskf.yaml` and `docs/parameters.md` from them, and
`ros_yaml.load` reads the ROS 2 parameter files of users.

Values are Python floats, integers, bools, strings and tuples of floats. Angles whose name ends in `_deg` are degrees,
all others are in the SI unit stated with them. Nothing here imports ROS.

Over 400 lines: it is a table of parameters, and one place for all of them is easier to search than many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from eskf_ros.filter.rows import CONSTRAINTS, SENSORS
from eskf_ros.filter.tight.signal import Ranges
from eskf_ros.parameters.schema import (
    FRAME_NAME,
    TIME_OFFSET,
    TOPIC_NAME,
    TYPE_OF_TOPIC,
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


if TYPE_CHECKING:
    from eskf_ros.filter.measurements.baro import Baro
    from eskf_ros.filter.measurements.body_velocity import BodyVelocity
    from eskf_ros.filter.measurements.heading import Heading
    from eskf_ros.filter.measurements.mag import Mag
    from eskf_ros.filter.measurements.nhc import Nhc
    from eskf_ros.filter.measurements.wheel import Wheel
    from eskf_ros.filter.measurements.zupt import Zupt


def _with_topics(topics: type) -> type:
    """Add the topic of each sensor of the estimator, and the choice of its type, before those of the ranges."""
    fields: dict[str, Any] = {}
    for name, kind in topics.__annotations__.items():
        if name == "ranges":
            for row in SENSORS:
                fields[row.name] = str
                setattr(topics, row.name, parameter(row.topic, "", row.topic_about, **TOPIC_NAME))
                if len(row.types) > 1:
                    fields[f"{row.name}_type"] = str
                    setattr(topics, f"{row.name}_type", choice(row.types[0], TYPE_OF_TOPIC, *row.types[1:]))
        fields[name] = kind
    topics.__annotations__ = fields
    return topics


def _with_groups(parameters: type) -> type:
    """Add the parameters of each sensor before those of the ranges, and of each constraint after them."""
    fields: dict[str, Any] = {}
    for name, kind in parameters.__annotations__.items():
        for row in SENSORS if name == "ranges" else CONSTRAINTS if name == "estimate" else ():
            if row.group is not None:
                fields[row.name] = row.group
                setattr(parameters, row.name, group_of(row.group, row.about))
        fields[name] = kind
    parameters.__annotations__ = fields
    return parameters


@dataclass(frozen=True)
@_with_topics
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
        "(tactical): use that on a smooth vehicle. It is measured at rest, too; what is measured is used, and said, "
        "where it is more than 1.5 times this.",
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
    gyro_scale: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "",
        "By which share the gyros read too much, along x, y, z of the IMU: reading = (1 + scale) rate + bias.",
        minimum=-0.2,
        maximum=0.2,
    )
    accel_scale: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), "", "The same of the accelerometers.", minimum=-0.2, maximum=0.2
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
        **TIME_OFFSET,
    )
    velocity_time_offset: float = parameter(
        0.0,
        "s",
        "Added to the stamps of the velocities, of both receivers, besides time_offset. Negative when the receiver "
        "filters its velocity, which is then older than the position of the same epoch.",
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
        60.0,
        "s",
        "How long the lasting part of the error of a position lasts (e-folding time); without corrections 30 to 300 s "
        "is usual. 0: fixes err independently of each other, and the estimate trusts their mean.",
        minimum=0.0,
        maximum=1.0e5,
    )
    correlated_share: float = parameter(
        0.0,
        "",
        "Share of the variance of each fix that lasts; the rest is new every time. 0: learned from what the fixes "
        "claim and how much they scatter.",
        minimum=0.0,
        maximum=0.99,
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
        **TIME_OFFSET,
    )


@dataclass(frozen=True)
class Estimate:
    lever_arm: bool = parameter(
        False,
        "",
        "Estimate what gnss.lever_arm lacks, from positions and velocities of the first receiver. Turns show x and y, "
        "roll and pitch show z; what nothing shows stays uncertain. eskf_calibrate does it once and for all.",
    )
    lever_arm_std: float = parameter(
        0.5, "m", "Standard deviation of gnss.lever_arm per axis at start.", above=0.0, maximum=100.0
    )
    time_offset: bool = parameter(
        False,
        "",
        "Estimate what gnss.time_offset, gnss.velocity_time_offset and wheel.time_offset lack. Accelerations show it.",
    )
    time_offset_std: float = parameter(
        0.1, "s", "Standard deviation of each of the three at start.", above=0.0, maximum=10.0
    )
    imu_scale: bool = parameter(
        False,
        "",
        "Estimate what imu.gyro_scale and imu.accel_scale lack. Turns show the one about the vertical; the others need "
        "a motion that turns and accelerates along all axes.",
    )
    imu_scale_std: float = parameter(
        0.01, "", "Standard deviation of these scales per axis at start.", above=0.0, maximum=0.2
    )
    nhc_position: bool = parameter(
        False, "", "Estimate how far ahead of nhc.position the axle is that does not steer. Turns show it."
    )
    nhc_position_std: float = parameter(
        1.0, "m", "Standard deviation of this distance at start.", above=0.0, maximum=100.0
    )
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
class Smoother:
    lag: float = parameter(
        0.0,
        "s",
        "Publish odometry/smoothed: each estimate again when the measurements of this many seconds after it have come. "
        "It comes history.window later still. 0: off.",
        minimum=0.0,
        maximum=600.0,
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
        "When the vehicle was not found at rest for this time, it is taken to be moving and is levelled on the way.",
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
        0.2,
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
class Quality:
    position_std: float = parameter(
        5.0,
        "m",
        "Above this horizontal standard deviation (east and north together) the estimate is not usable.",
        above=0.0,
        maximum=1.0e6,
        live=True,
    )
    coast_time: float = parameter(
        10.0,
        "s",
        "How long the estimate stays usable without an accepted position, as far as position_std allows.",
        minimum=0.0,
        maximum=1.0e6,
        live=True,
    )
    settle_time: float = parameter(
        5.0,
        "s",
        "How long the estimate is not usable after position and velocity were reset to the fixes.",
        minimum=0.0,
        maximum=1.0e6,
        live=True,
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
        1,
        "",
        "Odometry and transforms are published for one IMU sample in this number of samples.",
        minimum=1,
        maximum=1000,
    )
    two_d: bool = parameter(
        False,
        "",
        "For planar robots: publish z, roll and pitch as zero, and no vertical velocity and no roll and pitch rate. "
        "The estimator works in three dimensions all the same.",
    )


@dataclass(frozen=True)
@_with_groups
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
    if TYPE_CHECKING:  # from the rows of the measurements, for the checker only
        heading: Heading = Heading()
        mag: Mag = Mag()
        wheel: Wheel = Wheel()
        body_velocity: BodyVelocity = BodyVelocity()
        baro: Baro = Baro()
        zupt: Zupt = Zupt()
        nhc: Nhc = Nhc()
    ranges: Ranges = group_of(Ranges, "What a GNSS receiver measures of each satellite: pseudorange and Doppler.")
    estimate: Estimate = group_of(Estimate, "What is estimated besides the motion and the biases of the IMU.")
    history: History = group_of(History, "Late and out-of-order messages.")
    smoother: Smoother = group_of(Smoother, "The smoothed trajectory of the node, late and better.")
    alignment: Alignment = group_of(Alignment, "Start-up: levelling, heading, and when the estimate is called good.")
    quality: Quality = group_of(Quality, "When the estimate is called usable (eskf/quality).")
    warm_start: WarmStart = group_of(WarmStart, "What the node remembers of its last run.")
    output: Output = group_of(Output, "What the node publishes, and how.")
