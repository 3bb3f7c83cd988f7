"""From robot_localization: one or two filter nodes (EKF or UKF) and navsat_transform.

The parameters are those that its ROS 2 sources declare (ros_filter.cpp, navsat_transform.cpp), with those of older
releases that are still in people's files.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from eskf_ros.migrate.conversion import BUILT_IN, CONVERTED, NONE, Conversion, Entry, Section
from eskf_ros.parameters.tree import Parameters

_NO_MODEL = "the IMU is the motion model here; its noise is imu.gyro_noise_density and imu.accel_noise_density"
_GATES = "every measurement has a chi-square gate here, on by default: GROUP.gate_probability of the sensor"
_COMMANDS = "commands are no measurements; the IMU shows what the robot does"
_CARTESIAN = "there is no UTM grid: map is east, north, up at the datum"
_AT_ONCE = "it begins with the first fix"

TABLE = (
    Entry("map_frame", CONVERTED, "`frames.map`"),
    Entry("odom_frame", CONVERTED, "`frames.odom`"),
    Entry("base_link_frame", CONVERTED, "`frames.base_link`"),
    Entry("world_frame", CONVERTED, "`odometry/global` is in map, `odometry/local` in odom: one node gives both"),
    Entry("base_link_frame_output", NONE, "odometry is of frames.base_link"),
    Entry("tf_prefix", NONE, "write whole names in frames.*"),
    Entry("publish_tf", CONVERTED, "`output.tf`: full; map_to_odom if another node has odom -> base_link; none"),
    Entry("two_d_mode", CONVERTED, "`output.two_d`; the estimator works in three dimensions all the same"),
    Entry("frequency", NONE, "odometry comes for every IMU sample; output.rate_divisor thins it"),
    Entry("sensor_timeout", BUILT_IN, "COASTING, and what is missing is named in the diagnostics"),
    Entry("transform_time_offset", NONE, "transforms carry the stamp of the IMU sample"),
    Entry("transform_timeout", BUILT_IN, "the places of the sensors are read from /tf_static once"),
    Entry("print_diagnostics", BUILT_IN, "/diagnostics, always"),
    Entry("debug", BUILT_IN, "eskf/aids has every innovation with its verdict"),
    Entry("debug_out_file", BUILT_IN, "eskf_replay writes aids.csv"),
    Entry("permit_corrected_publication", BUILT_IN, "odometry is published once for each IMU sample"),
    Entry("publish_acceleration", NONE, "take the acceleration from the IMU, with imu/bias"),
    Entry("smooth_lagged_data", BUILT_IN, "late messages are put where they belong in time, always"),
    Entry("history_length", CONVERTED, "`history.window`, 2 s at least"),
    Entry("reset_on_time_jump", BUILT_IN, "clocks that are set, and recordings that loop, are noticed"),
    Entry("predict_to_current_time", NONE, "odometry is of the stamp of the newest IMU sample"),
    Entry("disabled_at_startup", NONE, "start the node later"),
    Entry("use_control", NONE, _COMMANDS),
    Entry("stamped_control", NONE, _COMMANDS),
    Entry("control_timeout", NONE, _COMMANDS),
    Entry("control_config", NONE, _COMMANDS),
    Entry("acceleration_limits", NONE, _COMMANDS),
    Entry("deceleration_limits", NONE, _COMMANDS),
    Entry("acceleration_gains", NONE, _COMMANDS),
    Entry("deceleration_gains", NONE, _COMMANDS),
    Entry("process_noise_covariance", NONE, _NO_MODEL),
    Entry("dynamic_process_noise_covariance", NONE, _NO_MODEL),
    Entry("gravitational_acceleration", BUILT_IN, "normal gravity at the place and height of the robot"),
    Entry("initial_state", CONVERTED, "its yaw: `alignment.initial_heading_deg`; the rest comes from the sensors"),
    Entry("initial_estimate_covariance", CONVERTED, "with a yaw in initial_state: `alignment.initial_heading_std_deg`"),
    Entry("filter_type", BUILT_IN, "an error-state Kalman filter"),
    Entry("alpha", NONE, "no unscented transform here"),
    Entry("beta", NONE, "no unscented transform here"),
    Entry("kappa", NONE, "no unscented transform here"),
    Entry("imuN", CONVERTED, "`topics.imu`, of the first one; there is one IMU"),
    Entry("imuN_config", CONVERTED, "rates and specific force are always used; a yaw: `alignment.imu_orientation`"),
    Entry("imuN_remove_gravitational_acceleration", BUILT_IN, "the IMU must report gravity: +g upwards at rest"),
    Entry("imuN_linear_acceleration_rejection_threshold", NONE, "implausible IMU samples widen what is known instead"),
    Entry("odomN", CONVERTED, "`topics.wheel` or `topics.body_velocity`; none for that of navsat_transform"),
    Entry("odomN_config", CONVERTED, "`topics.wheel` with a velocity ahead, else `topics.body_velocity`"),
    Entry("odomN_pose_use_child_frame", NONE, "poses are not fused"),
    Entry("twistN", CONVERTED, "`topics.wheel` or `topics.body_velocity`, as for odomN"),
    Entry("twistN_config", CONVERTED, "`topics.wheel` or `topics.body_velocity`, as odomN_config"),
    Entry("poseN", NONE, "poses are not fused; a yaw can come as sensor_msgs/Imu on topics.heading"),
    Entry("poseN_config", NONE, "poses are not fused"),
    *(Entry(f"{kind}N_queue_size", BUILT_IN, "a second of messages may wait") for kind in ("imu", "odom", "twist")),
    *(Entry(f"{kind}N_nodelay", BUILT_IN, "a setting of ROS 1") for kind in ("imu", "odom", "twist", "pose")),
    *(
        Entry(f"{kind}N_{how}", NONE, "velocities are used as they are, and poses are not fused")
        for how in ("differential", "relative")
        for kind in ("imu", "odom", "twist", "pose")
    ),
    *(
        Entry(f"{kind}N_{part}rejection_threshold", NONE, _GATES)
        for kind in ("imu", "odom")
        for part in ("pose_", "twist_")
    ),
    Entry("twistN_rejection_threshold", NONE, _GATES),
    Entry("poseN_rejection_threshold", NONE, "poses are not fused"),
    Entry("poseN_queue_size", NONE, "poses are not fused"),
    Entry("delay", BUILT_IN, _AT_ONCE),
    Entry("magnetic_declination_radians", CONVERTED, "not 0: `alignment.imu_orientation` is magnetic_north"),
    Entry("yaw_offset", NONE, "yaw must be 0 in the east (REP-103): mend it in the driver, or let the filter find it"),
    Entry("zero_altitude", CONVERTED, "`output.two_d`"),
    Entry("publish_filtered_gps", BUILT_IN, "gps/filtered, always"),
    Entry("use_odometry_yaw", BUILT_IN, "one filter knows position and heading together"),
    Entry("wait_for_datum", CONVERTED, "true: `datum`"),
    Entry("datum", CONVERTED, "`datum`: latitude and longitude; the altitude is 0 there; map is not turned"),
    Entry("use_local_cartesian", BUILT_IN, _CARTESIAN),
    Entry("broadcast_cartesian_transform", NONE, _CARTESIAN),
    Entry("broadcast_cartesian_transform_as_parent_frame", NONE, _CARTESIAN),
    Entry("broadcast_utm_transform", NONE, _CARTESIAN),
    Entry("broadcast_utm_transform_as_parent_frame", NONE, _CARTESIAN),
    Entry("use_sim_time", BUILT_IN, "give it to the node as before: -p use_sim_time:=true"),
)

_YAW, _VX, _VY, _VZ = 5, 6, 7, 8
"""Places in a `*_config`: x y z roll pitch yaw vx vy vz vroll vpitch vyaw ax ay az."""

_NAVSAT_ONLY = {"magnetic_declination_radians", "yaw_offset", "zero_altitude", "use_odometry_yaw", "wait_for_datum"}
_LEAST_WINDOW = Parameters().history.window


@dataclass(frozen=True)
class _Source:
    """An input of a filter: kind (imu, odom, twist, pose) with number, topic, and which of the 15 values are used."""

    name: str
    topic: str
    used: tuple[bool, ...]
    is_absolute: bool

    @property
    def is_fix(self) -> bool:
        """Whether it is the odometry that navsat_transform makes of the fixes."""
        return re.search(r"gps|gnss|navsat", self.topic) is not None


def is_filter(section: Section) -> bool:
    """Whether these are the parameters of an EKF or UKF node."""
    return any(re.fullmatch(r"world_frame|(odom|imu|twist|pose)\d+", name) for name in section[1])


def is_navsat(section: Section) -> bool:
    """Whether these are the parameters of navsat_transform."""
    return bool(_NAVSAT_ONLY & set(section[1])) or "navsat" in section[0]


def convert(sections: Sequence[Section], source: str) -> Conversion:
    """Return our parameters for these nodes."""
    found = Conversion(source, TABLE)
    filters = [section for section in sections if is_filter(section)]
    navsats = [section for section in sections if is_navsat(section) and not is_filter(section)]
    for _, given in (*filters, *navsats):
        found.account(given)
    # What is fused with the fixes is what counts: the filter whose world is map, where there are two.
    filters.sort(key=lambda section: not _is_global(section[1]))
    if filters:
        _frames(found, filters)
        _inputs(found, filters)
        _start(found, *filters[0])
    navsat = navsats[0][1] if navsats else {}
    _navsat(found, navsats[0][0] if navsats else "", navsat)
    _orientation(found, _sources(filters[0][1]) if filters else [], navsat if navsats else None)
    found.check("gps/fix and gps/vel are the topics of the receiver: set topics.gnss_fix and topics.gnss_velocity")
    found.check(
        "the places of IMU and antenna are looked up on /tf_static by the frames of the messages; without transforms "
        "set gnss.lever_arm, imu.mount_position and imu.mount_rpy_deg"
    )
    return found


def _is_global(given: Mapping[str, object]) -> bool:
    world = given.get("world_frame", given.get("odom_frame", "odom"))
    return world == given.get("map_frame", "map")


def _frames(found: Conversion, filters: Sequence[Section]) -> None:
    node, given = filters[0]
    for theirs, ours in (("map_frame", "map"), ("odom_frame", "odom"), ("base_link_frame", "base_link")):
        if theirs in given:
            found.set(f"frames.{ours}", given[theirs], f"{theirs} of {node}")
    publishes = {_is_global(values): bool(values.get("publish_tf", True)) for _, values in filters}
    if not any(publishes.values()):
        found.set("output.tf", "none", "publish_tf: false")
    elif publishes.get(True) and not publishes.get(False):
        found.set("output.tf", "map_to_odom", f"only {node}, whose world is map, published a transform")
        found.check("output.tf: full if nobody but this node is to give odom -> base_link, which then is not read")
    if any(values.get("two_d_mode") for _, values in filters):
        found.set("output.two_d", True, "two_d_mode")
    lengths = [float(str(values.get("history_length", 0.0))) for _, values in filters]
    if max(lengths) > _LEAST_WINDOW:
        found.set("history.window", max(lengths), "history_length")


def _sources(given: Mapping[str, object]) -> list[_Source]:
    sources = []
    for name, topic in given.items():
        if re.fullmatch(r"(odom|imu|twist|pose)\d+", name):
            config = given.get(f"{name}_config", ())
            used = tuple(bool(value) for value in config) if isinstance(config, list | tuple) else ()
            is_absolute = not (given.get(f"{name}_differential") or given.get(f"{name}_relative"))
            sources.append(_Source(name, str(topic), (*used, *(False,) * (15 - len(used))), is_absolute))
    return sources


def _inputs(found: Conversion, filters: Sequence[Section]) -> None:
    sources: dict[str, _Source] = {}
    for _, given in filters:
        for source in _sources(given):
            sources.setdefault(source.topic, source)
    for topic, source in sources.items():
        kind = source.name.rstrip("0123456789")
        if kind == "imu":
            if "topics.imu" in found.values:
                found.check(f"{source.name} ({topic}) is not used: there is one IMU")
            else:
                found.set("topics.imu", topic, source.name)
        elif kind in ("odom", "twist") and not source.is_fix:
            _velocity(found, kind, source)
    if "topics.imu" not in found.values:
        found.check("no IMU was fused, and this node cannot do without: topics.imu, sensor_msgs/Imu with gravity in it")


def _velocity(found: Conversion, kind: str, source: _Source) -> None:
    """Take an odometry or a twist for wheels, or for a velocity in body axes, as long as these have none yet."""
    message = "nav_msgs/msg/Odometry" if kind == "odom" else "geometry_msgs/msg/TwistWithCovarianceStamped"
    if not any(source.used[_VX : _VZ + 1]):
        found.check(f"{source.name} ({source.topic}) is not used: its pose or yaw rate alone is not fused")
        return
    if source.used[_VX] and "topics.wheel" not in found.values:
        ours = "wheel"
        if source.used[_VY]:
            found.check(
                f"{source.name} gave the velocity across too. Wheels that cannot slip: set nhc.enabled. Robots "
                "that drive sideways (mecanum, omni wheels): make it topics.body_velocity in place of topics.wheel"
            )
    elif "topics.body_velocity" not in found.values:
        ours = "body_velocity"
    else:
        found.check(
            f"{source.name} ({source.topic}) is not used: there is one topics.wheel and one topics.body_velocity"
        )
        return
    found.set(f"topics.{ours}", source.topic, source.name)
    found.set(f"topics.{ours}_type", message, source.name)
    if any(source.used[: _YAW + 1]):
        found.check(f"of {source.name} ({source.topic}) the velocities are used, the pose is not")


def _start(found: Conversion, node: str, given: Mapping[str, object]) -> None:
    """Take the yaw of the initial state, if it has one, with its variance."""
    state, covariance = given.get("initial_state"), given.get("initial_estimate_covariance")
    if not isinstance(state, list) or len(state) <= _YAW or not float(state[_YAW]):
        return
    found.set("alignment.initial_heading_deg", math.degrees(float(state[_YAW])), f"initial_state of {node}")
    variance = 0.0
    if isinstance(covariance, list) and len(covariance) in (15, 225):
        variance = float(covariance[_YAW * (16 if len(covariance) == 225 else 1)])
    if 1e-4 < variance < math.pi**2:
        std = math.degrees(math.sqrt(variance))
        found.set("alignment.initial_heading_std_deg", std, "initial_estimate_covariance")


def _navsat(found: Conversion, node: str, given: Mapping[str, object]) -> None:
    if given.get("zero_altitude"):
        found.set("output.two_d", True, "zero_altitude")
    datum = given.get("datum")
    if given.get("wait_for_datum") and isinstance(datum, list) and len(datum) >= 2:
        found.set("datum", [float(datum[0]), float(datum[1]), 0.0], f"datum of {node}")
        found.check("datum: the altitude of the origin (ellipsoidal) is 0, as in navsat_transform")
        if len(datum) > 2 and float(datum[2]):
            found.check(
                f"datum: the heading of {float(datum[2]):g} rad turned the map there; here map is east, north, up"
            )
    elif given.get("wait_for_datum"):
        found.check("wait_for_datum: the first fix becomes the origin here; the service datum moves it")


def _orientation(found: Conversion, sources: Sequence[_Source], navsat: Mapping[str, object] | None) -> None:
    """Take the yaw of the IMU as a heading at start, where the filter or navsat_transform took it."""
    fused = any(source.name.startswith("imu") and source.used[_YAW] and source.is_absolute for source in sources)
    given = navsat or {}
    asked = navsat is not None and not given.get("use_odometry_yaw") and not given.get("wait_for_datum")
    if not fused and not asked:
        return
    if float(str(given.get("yaw_offset", 0.0))):
        found.check(
            f"yaw_offset {given['yaw_offset']}: the yaw of this IMU is not 0 in the east and is not used; the filter "
            "finds the heading as the robot drives. Or mend the driver and set alignment.imu_orientation"
        )
    elif float(str(given.get("magnetic_declination_radians", 0.0))):
        found.set("alignment.imu_orientation", "magnetic_north", "magnetic_declination_radians is not 0")
        found.check(
            f"magnetic_declination_radians {given['magnetic_declination_radians']} is not taken over, because people "
            "give it with either sign: the World Magnetic Model has it (pip install pygeomag), or set "
            "mag.declination_deg, east positive"
        )
    else:
        found.set("alignment.imu_orientation", "true_north", "the yaw of the IMU was used; here at start only")
        found.check("alignment.imu_orientation: is the yaw of this IMU 0 in the true east? Else unused: it is found")
