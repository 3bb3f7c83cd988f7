"""From FusionCore (its parameters of August 2026)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from eskf_ros.geodesy.earth import ecef_to_geodetic
from eskf_ros.migrate.conversion import BUILT_IN, CONVERTED, NONE, Conversion, Entry, Section
from eskf_ros.parameters.tree import Parameters

_GATES = "every measurement has a chi-square gate here, GROUP.gate_probability: 0.999, three axes: 16.27"
_RECOVERY = "outages, and fixes that contradict the estimate, need no settings"
_NOISE = "the IMU is the motion model: imu.*_noise_density, imu.*_bias_random_walk"
_ADAPTIVE = "fixes that scatter more than they claim are used with the noise they show"
_COURSE = "accelerations and course tell the heading, without thresholds"
_NO_POSE = "poses are not fused; topics.body_velocity takes the velocity of an odometry of any kind"
_FIX_GATE = "covariances say what a fix is worth, and the gate whether it fits"
_SECOND_IMU = "there is one IMU"
_PER_SAMPLE = "is per sample there, per square root of hertz here: value / sqrt(IMU rate)"

TABLE = (
    Entry("base_frame", CONVERTED, "`frames.base_link`"),
    Entry("odom_frame", CONVERTED, "`frames.odom`; the global estimate is in `frames.map`"),
    Entry("publish_rate", NONE, "odometry comes for every IMU sample; output.rate_divisor thins it"),
    Entry("publish.force_2d", CONVERTED, "`output.two_d`; that sets roll and pitch to zero too"),
    Entry("publish.tf", CONVERTED, "`output.tf`: full or none"),
    Entry("autostart", NONE, "a plain node, not a lifecycle node"),
    Entry("imu.topic", CONVERTED, "`topics.imu`"),
    Entry("imu.gyro_noise", NONE, f"imu.gyro_noise_density; it {_PER_SAMPLE}"),
    Entry("imu.accel_noise", NONE, f"imu.accel_noise_density; it {_PER_SAMPLE}"),
    Entry("imu.has_magnetometer", CONVERTED, "`alignment.imu_orientation`: magnetic_north, at start only"),
    Entry("imu.remove_gravitational_acceleration", BUILT_IN, "the IMU must report gravity: +g upwards at rest"),
    Entry("imu.frame_id", NONE, "set imu.mount_position and imu.mount_rpy_deg where messages have no frame"),
    Entry("imu.lever_arm_x", CONVERTED, "`imu.mount_position`"),
    Entry("imu.lever_arm_y", CONVERTED, "`imu.mount_position`"),
    Entry("imu.lever_arm_z", CONVERTED, "`imu.mount_position`"),
    Entry("imu2.topic", NONE, _SECOND_IMU),
    Entry("imu2.frame_id", NONE, _SECOND_IMU),
    Entry("imu2.remove_gravitational_acceleration", NONE, _SECOND_IMU),
    Entry("encoder.topic", CONVERTED, "`topics.wheel`"),
    Entry("encoder.vel_noise", CONVERTED, "`wheel.unknown_speed_std`: for messages without covariance"),
    Entry("encoder.yaw_noise", CONVERTED, "`wheel.unknown_yaw_rate_std`: for messages without covariance"),
    Entry("encoder.nhc_vy_sigma", CONVERTED, "below 1: `nhc.enabled` and `nhc.lateral_std`"),
    Entry("encoder.nhc_auto_detect", NONE, "nhc.enabled says whether the robot can move sideways"),
    Entry("encoder2.topic", CONVERTED, "`topics.body_velocity`, unless the radar is there"),
    Entry("encoder2.vel_noise", CONVERTED, "`body_velocity.unknown_std`"),
    Entry("encoder2.yaw_noise", NONE, "of body_velocity the yaw rate is not used"),
    Entry("radar.velocity_topic", CONVERTED, "`topics.body_velocity`"),
    Entry("radar.vel_noise", CONVERTED, "`body_velocity.unknown_std`"),
    Entry("gnss.fix_topic", CONVERTED, "`topics.gnss_fix`"),
    Entry(
        "gnss.fix2_topic", NONE, "the second receiver shares the topics and has second_gnss.frame_id: remap its driver"
    ),
    Entry("gnss.use_gps_fix", NONE, "sensor_msgs/NavSatFix is read, gps_msgs/GPSFix is not"),
    Entry("gnss.velocity_topic", NONE, "topics.gnss_velocity takes a twist in east, north, up, not nav_msgs/Odometry"),
    Entry("gnss.base_noise_xy", CONVERTED, "`gnss.status_std_horizontal`: for fixes without covariance"),
    Entry("gnss.base_noise_z", CONVERTED, "`gnss.status_std_vertical`: for fixes without covariance"),
    Entry("gnss.heading_noise", CONVERTED, "`heading.unknown_std_deg`: for messages without covariance"),
    Entry("gnss.heading_topic", CONVERTED, "`topics.heading`"),
    Entry("gnss.azimuth_topic", NONE, "topics.heading takes sensor_msgs/Imu"),
    *(Entry(f"gnss.lever_arm_{axis}", CONVERTED, "`gnss.lever_arm`") for axis in "xyz"),
    *(Entry(f"gnss.lever_arm2_{axis}", CONVERTED, "`second_gnss.lever_arm`") for axis in "xyz"),
    Entry("gnss.apply_lever_arm_pre_heading", BUILT_IN, "the lever arm is in the equations, always"),
    Entry("gnss.lever_arm_max_heading_sigma_deg", BUILT_IN, "the lever arm is in the equations, always"),
    *(
        Entry(f"gnss.{name}", NONE, _FIX_GATE)
        for name in (
            "max_hdop",
            "max_vdop",
            "max_sigma_xy",
            "max_sigma_z",
            "min_satellites",
            "min_fix_type",
            "max_speed",
            "max_speed_margin",
            "max_speed_sigma_k",
            "max_speed_drift_k",
        )
    ),
    *(
        Entry(f"gnss.{name}", BUILT_IN, _RECOVERY)
        for name in (
            "coast_n",
            "coast_min_gap_s",
            "coast_q_factor",
            "coast_timeout_s",
            "coast_q_bias_factor",
            "coast_imu_wz_scale",
            "recovery_rejection_n",
            "p_inflate_sigma",
            "recovery_timeout_s",
        )
    ),
    Entry("gnss.track_heading_enabled", CONVERTED, "`alignment.use_course`"),
    *(
        Entry(f"gnss.track_heading_{name}", BUILT_IN, _COURSE)
        for name in ("min_dist", "max_sigma", "min_speed", "max_yaw_rate")
    ),
    Entry("magnetometer.enabled", CONVERTED, "`mag.use`"),
    Entry("magnetometer.topic", CONVERTED, "`topics.mag`"),
    Entry("magnetometer.noise_rad", CONVERTED, "`mag.error_std_deg`"),
    Entry("magnetometer.declination_rad", CONVERTED, "`mag.declination_deg`, unless 0: then the World Magnetic Model"),
    Entry("magnetometer.chi2_threshold", NONE, _GATES),
    Entry("magnetometer.hard_iron", NONE, "let the driver take it off; estimate.magnetic_bias finds what is left"),
    Entry("magnetometer.soft_iron", NONE, "let the driver take it off"),
    Entry("magnetometer.field_strength", BUILT_IN, "from the World Magnetic Model"),
    Entry("magnetometer.field_tolerance", CONVERTED, "`mag.strength_tolerance`"),
    Entry("max_measurement_delay", CONVERTED, "`history.window`, 2 s at least"),
    Entry("outlier_rejection", NONE, _GATES),
    *(Entry(f"outlier_threshold_{name}", NONE, _GATES) for name in ("gnss", "imu", "enc", "hdg", "vslam")),
    *(
        Entry(f"vslam.{name}", NONE, _NO_POSE)
        for name in ("topic", "position_noise", "orientation_noise", "frame_id", "reinit_n")
    ),
    *(
        Entry(f"adaptive.{name}", BUILT_IN, _ADAPTIVE)
        for name in ("imu", "encoder", "gnss", "ground_constraint", "window", "alpha")
    ),
    Entry("zupt.enabled", CONVERTED, "`zupt.enabled`"),
    Entry("zupt.velocity_threshold", BUILT_IN, "all sensors that could see a motion tell whether the robot stands"),
    Entry("zupt.angular_threshold", BUILT_IN, "all sensors that could see a motion tell whether the robot stands"),
    Entry("zupt.noise_sigma", CONVERTED, "`zupt.velocity_std`"),
    Entry("ground_constraint.vz_sigma", CONVERTED, "with nhc.enabled: `nhc.vertical_std`"),
    Entry("ground_constraint.az_sigma", NONE, "the accelerometer tells"),
    Entry("ground_constraint.z_position_sigma", NONE, "a barometer helps; output.two_d publishes height zero"),
    Entry("init.stationary_window", CONVERTED, "not 0: `alignment.static_duration`"),
    Entry("init.wait_for_all_sensors", BUILT_IN, "each sensor is used from its first message on"),
    Entry("init.sensor_wait_timeout", BUILT_IN, "each sensor is used from its first message on"),
    Entry("replay.checkpoint_path", BUILT_IN, "eskf_replay repeats bit for bit; warm_start.file is for the next run"),
    Entry("motion_model", CONVERTED, "DifferentialDrive, Ackermann: `nhc.enabled`"),
    Entry("motion_model_params.wheelbase", NONE, "nhc.position is the middle of the axle that does not steer"),
    *(
        Entry(f"ukf.q_{name}", NONE, _NOISE)
        for name in (
            "position",
            "orientation",
            "velocity",
            "angular_vel",
            "acceleration",
            "gyro_bias",
            "accel_bias",
            "encoder_wz_bias",
        )
    ),
    Entry("input.gnss_crs", NONE, "fixes are WGS84, as NavSatFix says"),
    Entry("output.crs", NONE, "map is east, north, up at the datum"),
    Entry("output.convert_to_enu_at_reference", BUILT_IN, "map is east, north, up at the datum"),
    Entry("reference.use_first_fix", CONVERTED, "true: no `datum`"),
    *(Entry(f"reference.{axis}", CONVERTED, "`datum`, where the output is in EPSG:4978") for axis in "xyz"),
    Entry("use_sim_time", BUILT_IN, "give it to the node as before: -p use_sim_time:=true"),
)

_SAME = {
    "base_frame": "frames.base_link",
    "odom_frame": "frames.odom",
    "publish.force_2d": "output.two_d",
    "encoder.vel_noise": "wheel.unknown_speed_std",
    "encoder.yaw_noise": "wheel.unknown_yaw_rate_std",
    "gnss.heading_topic": "topics.heading",
    "gnss.track_heading_enabled": "alignment.use_course",
    "magnetometer.enabled": "mag.use",
    "magnetometer.topic": "topics.mag",
    "magnetometer.field_tolerance": "mag.strength_tolerance",
    "zupt.enabled": "zupt.enabled",
    "zupt.noise_sigma": "zupt.velocity_std",
}
"""Parameters that mean the same in both, in the same unit."""

_IN_RADIANS = {"gnss.heading_noise": "heading.unknown_std_deg", "magnetometer.noise_rad": "mag.error_std_deg"}
_TOPICS = {"imu.topic": "/imu/data", "encoder.topic": "/odom/wheels", "gnss.fix_topic": "/gnss/fix"}
"""Their topics with their defaults, which are not ours."""

_PLACES = {
    "imu.lever_arm": "imu.mount_position",
    "gnss.lever_arm": "gnss.lever_arm",
    "gnss.lever_arm2": "second_gnss.lever_arm",
}
_STILL_SIDEWAYS = 1.0
"""m/s; a lateral standard deviation from which on their constraint is called off."""


def is_fusioncore(section: Section) -> bool:
    """Whether these are the parameters of a FusionCore node."""
    return section[0] == "fusioncore" or any(name.startswith(("ukf.", "encoder.")) for name in section[1])


def convert(sections: Sequence[Section], source: str) -> Conversion:
    """Return our parameters for this node."""
    found = Conversion(source, TABLE)
    node, given = next(section for section in sections if is_fusioncore(section))
    found.account(given)
    for theirs, ours in _SAME.items():
        if given.get(theirs, "") != "":
            found.set(ours, given[theirs], theirs)
    for theirs, ours in _IN_RADIANS.items():
        if theirs in given:
            found.set(ours, math.degrees(_number(given, theirs)), theirs)
    names = ("imu", "wheel", "gnss_fix")
    for (theirs, default), ours in zip(_TOPICS.items(), names, strict=True):
        found.set(f"topics.{ours}", given.get(theirs, default), theirs if theirs in given else f"default of {theirs}")
    for theirs, ours in _PLACES.items():
        place = [_number(given, f"{theirs}_{axis}") for axis in "xyz"]
        if any(place):
            found.set(ours, place, f"{theirs}_x, _y, _z")
    if given.get("publish.tf") is False:
        found.set("output.tf", "none", "publish.tf")
    _sensors(found, given)
    _constraint(found, given)
    _datum(found, given)
    found.check(f"{node} gave its global estimate in {given.get('odom_frame', 'odom')}: it is in map here, which jumps")
    found.check("imu.gyro_noise, imu.accel_noise: the defaults here suit a cheap IMU on a shaken vehicle")
    return found


def _number(given: Mapping[str, object], name: str) -> float:
    return float(str(given.get(name, 0.0)))


def _sensors(found: Conversion, given: Mapping[str, object]) -> None:
    """Take what needs more than another name."""
    gnss = Parameters().gnss
    for theirs, ours, usual in (
        ("gnss.base_noise_xy", "status_std_horizontal", gnss.status_std_horizontal),
        ("gnss.base_noise_z", "status_std_vertical", gnss.status_std_vertical),
    ):
        if theirs in given:
            # One number there, one for each status here: the ratios of the defaults are kept.
            scale = _number(given, theirs) / usual[0]
            found.set(f"gnss.{ours}", [round(scale * value, 6) for value in usual], theirs)
    for theirs, noise in (("radar.velocity_topic", "radar.vel_noise"), ("encoder2.topic", "encoder2.vel_noise")):
        if given.get(theirs) and "topics.body_velocity" not in found.values:
            found.set("topics.body_velocity", given[theirs], theirs)
            found.set("topics.body_velocity_type", "nav_msgs/msg/Odometry", theirs)
            if noise in given:
                found.set("body_velocity.unknown_std", given[noise], noise)
        elif given.get(theirs):
            found.check(f"{theirs} ({given[theirs]}) is not used: there is one topics.body_velocity")
    for theirs in ("gnss.velocity_topic", "gnss.azimuth_topic", "gnss.fix2_topic", "vslam.topic", "imu2.topic"):
        if given.get(theirs):
            found.check(f"{theirs} ({given[theirs]}) is not used as it is")
    if given.get("imu.has_magnetometer"):
        found.set("alignment.imu_orientation", "magnetic_north", "imu.has_magnetometer")
    if given.get("imu.remove_gravitational_acceleration"):
        found.check("the driver of this IMU removes gravity: tell it not to, the filter needs it (+g upwards at rest)")
    if _number(given, "magnetometer.declination_rad"):
        declination = math.degrees(_number(given, "magnetometer.declination_rad"))
        found.set("mag.declination_deg", declination, "magnetometer.declination_rad")
    if _number(given, "max_measurement_delay") > Parameters().history.window:
        found.set("history.window", given["max_measurement_delay"], "max_measurement_delay")
    if _number(given, "init.stationary_window"):
        found.set("alignment.static_duration", given["init.stationary_window"], "init.stationary_window")


def _constraint(found: Conversion, given: Mapping[str, object]) -> None:
    """Take the non-holonomic constraint, where the file asks for it."""
    origin = ""
    if given.get("motion_model") in ("DifferentialDrive", "Ackermann"):
        origin = "motion_model"
    if "encoder.nhc_vy_sigma" in given and _number(given, "encoder.nhc_vy_sigma") < _STILL_SIDEWAYS:
        origin = "encoder.nhc_vy_sigma"
        found.set("nhc.lateral_std", given[origin], origin)
    if not origin:
        found.check("encoder.nhc_vy_sigma is on there by default: set nhc.enabled if the robot cannot move sideways")
        return
    found.set("nhc.enabled", True, origin)
    found.check("nhc.position: the point of base_link that does not move sideways, the middle of the rear axle")
    if "ground_constraint.vz_sigma" in given:
        found.set("nhc.vertical_std", given["ground_constraint.vz_sigma"], "ground_constraint.vz_sigma")


def _datum(found: Conversion, given: Mapping[str, object]) -> None:
    """Take a fixed origin, which FusionCore has in the axes of output.crs."""
    if given.get("reference.use_first_fix", True):
        return
    if given.get("output.crs", "EPSG:4978") != "EPSG:4978":
        found.check(f"reference.x, y, z are in {given['output.crs']}: set datum to latitude, longitude and altitude")
        return
    latitude, longitude, altitude = ecef_to_geodetic(*(_number(given, f"reference.{axis}") for axis in "xyz"))
    place = [math.degrees(latitude), math.degrees(longitude), float(altitude)]
    found.set("datum", place, "reference.x, y, z in EPSG:4978")
