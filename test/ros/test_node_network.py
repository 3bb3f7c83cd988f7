"""The real node among others: names, several nodes, peers that come and go, clocks, transforms, services."""

from __future__ import annotations

import math
import signal
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eskf_ros.filter.alignment.warm_start import Memory
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.ros_node.memory import read_memory, write_memory
from eskf_ros.simulate.scenario import simulate
from support import hostile_traffic
from support.robot import CONFIG, Robot, read_drive, stamp_of, start_node
from support.ros_process import Ros, needs_ros

pytestmark = needs_ros

PARAMETERS = ("--params-file", str(CONFIG))


@pytest.fixture
def ros() -> Iterator[Ros]:
    with Ros() as observer:
        yield observer


@pytest.fixture(scope="module")
def drive() -> list[tuple[int, str, bytes]]:
    return read_drive(24.0)


@pytest.fixture(scope="module")
def start(drive) -> list[tuple[int, str, bytes]]:
    """The first eight seconds: at rest."""
    return [message for message in drive if message[0] < drive[0][0] + 8_000_000_000]


def rotation_of(q: Any) -> Rotation:
    return Rotation.from_quat([q.x, q.y, q.z, q.w])


def vector(v: Any) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def tf2_messages() -> Any:
    return pytest.importorskip("tf2_msgs.msg", reason="needs tf2_msgs, which is not on PyPI: ros-jazzy-tf2-msgs")


def test_two_nodes_live_side_by_side_each_in_its_namespace(ros, start):
    left_node = start_node(ros, *PARAMETERS, "-r", "__ns:=/left")
    right_node = start_node(ros, *PARAMETERS, "-r", "__ns:=/right", "-r", "imu/data:=/sensors/imu")
    left, right = Robot(ros, "left/"), Robot(ros, "right/")
    left.wait_for_node()
    ros.until(lambda: right.diagnostics, 60.0, "the right node")
    left.play(start)
    ros.until(lambda: left.odometry["odometry/global"], what="odometry of the left node")
    ros.until(lambda: "/sensors/imu" in right.say(), what="the right node to name its remapped topic")
    assert right.say().startswith("WAITING_IMU")
    assert not right.odometry["odometry/local"]
    assert left_node.stop() == 0
    assert right_node.stop() == 0


def test_senders_and_listeners_come_and_go(ros, drive):
    """The sender dies in the middle and comes back; a listener that joins late gets what is sent from then on."""
    node = start_node(ros, *PARAMETERS)
    first = Robot(ros)
    first.wait_for_node()
    middle = drive[len(drive) // 2][0]
    first.play([message for message in drive if message[0] < middle])
    # On a busy machine the node is behind: what it still has to answer would reach the late listener too.
    until_now = first.odometry["odometry/global"]
    ros.until(
        lambda: until_now and stamp_of(until_now[-1]) > middle - 500_000_000, 60.0, "the answer to the first half"
    )
    first.leave()
    second = Robot(ros)
    second.wait_for_node()
    second.play([message for message in drive if message[0] >= middle])
    last = second.odometry["odometry/global"]
    ros.until(lambda: last and stamp_of(last[-1]) > drive[-1][0] - 1_000_000_000, what="the end of the drive")
    assert stamp_of(last[0]) >= middle - 1_000_000_000
    seen = len(second.diagnostics)
    ros.until(lambda: len(second.diagnostics) > seen + 1, what="a new report")
    assert second.value("resets") == "0"
    assert second.value("restarts") == "0"
    assert node.stop() == 0


def test_a_node_restarts_into_running_traffic(ros):
    """Killed in the middle of a drive, the next one levels on the way and publishes, with nobody else noticing."""
    recording = simulate("hour_drive", seed=3, start=40.0, stop=140.0)
    messages = hostile_traffic.drive(recording, time.time_ns())
    node = start_node(ros, *PARAMETERS)
    robot = Robot(ros)
    robot.wait_for_node()
    local = robot.odometry["odometry/local"]
    middle = next(k for k, message in enumerate(messages) if message[0] > 6 * 10**9)
    robot.play(messages[:middle], speed=2.0)
    ros.until(lambda: len(local) > 300, what="odometry of the first node")
    node.send_signal(signal.SIGTERM)
    robot.play(messages[middle : middle + 20], speed=1.0)
    assert node.stop() == 0
    assert "Traceback" not in node.output
    second = start_node(ros, *PARAMETERS)
    local.clear()
    robot.diagnostics.clear()
    robot.play(messages[middle + 20 :], speed=1.0, until=lambda: len(local) > 200)
    assert len(local) > 200
    assert robot.say().startswith(("WAITING", "LEVELLING", "ALIGNING", "GOOD"))
    assert second.stop() == 0
    assert "Traceback" not in second.output


STALLED = """
import sys, time
from std_msgs.msg import Empty
from eskf_ros.ros_node import main, node

class Stalled(node.EskfNode):
    def __init__(self, **options):
        super().__init__(**options)
        self.create_subscription(Empty, "stall", lambda message: time.sleep(3.0), 1)

node.EskfNode = Stalled
sys.exit(main.main())
"""


def test_no_sample_is_lost_while_the_node_is_busy_elsewhere(ros, tmp_path: Path):
    """600 samples come while a callback takes 3 s, on subscriptions as they are by default, which hold 1000."""
    from std_msgs.msg import Empty

    script = tmp_path / "stalled.py"
    script.write_text(STALLED)
    rate = 200
    recording = simulate("hour_drive", seed=3, imu_rate=float(rate), start=15.0, stop=24.0)
    messages = hostile_traffic.drive(recording, time.time_ns())
    node = ros.spawn([script, "--ros-args", *PARAMETERS])
    robot = Robot(ros)
    stall = ros.node.create_publisher(Empty, "stall", 1)
    robot.wait_for_node()
    ros.until(stall.get_subscription_count, what="the node that can be stalled")
    local = robot.odometry["odometry/local"]
    before = next(k for k, message in enumerate(messages) if message[0] > 3 * 10**9)
    robot.play(messages[:before], speed=1.0)
    ros.until(lambda: len(local) > 0.9 * rate, what="odometry")
    stall.publish(Empty())
    robot.play(messages[before:], speed=1.0)
    *_, last = (data for _, topic, data in messages if topic == "imu/data")
    seconds, nanoseconds = struct.unpack_from("<iI", last, 4)
    ros.until(lambda: stamp_of(local[-1]) == seconds * 10**9 + nanoseconds, what="the odometry of the last sample")
    steps = np.diff([stamp_of(message) for message in local])
    assert steps.max() < 1.5e9 / rate
    assert node.stop() == 0


def test_a_publisher_that_cannot_reach_the_node_is_named(ros):
    from geometry_msgs.msg import TwistStamped

    reliable = "qos_overrides./imu/data.subscription.reliability:=reliable"
    node = start_node(ros, "-p", reliable, "-p", "topics.gnss_fix:=other/fix", "-p", "topics.gnss_velocity:=other/vel")
    robot = Robot(ros, best_effort=True)
    wrong = ros.node.create_publisher(TwistStamped, "other/fix", 10)
    bare = ros.node.create_publisher(TwistStamped, "other/vel", 10)
    # Discovery tells the name of a node after its publishers: the first report may not know it yet.
    named = "the publisher /observer of /imu/data is best effort"
    ros.until(lambda: named in robot.say(), 60.0, "the best effort publisher to be named")
    ros.until(lambda: "sends geometry_msgs/msg/TwistStamped" in robot.say(), what="the wrong type to be named")
    choice = (
        "of /other/vel sends geometry_msgs/msg/TwistStamped, geometry_msgs/msg/TwistWithCovarianceStamped is expected"
    )
    ros.until(lambda: f"{choice} unless topics.gnss_velocity_type says otherwise" in robot.say(), what="the parameter")
    ros.node.destroy_publisher(wrong)
    ros.node.destroy_publisher(bare)
    assert node.stop() == 0


def test_a_topic_that_nobody_publishes_is_looked_for_elsewhere(ros):
    from sensor_msgs.msg import Imu

    node = start_node(ros, "-p", "topics.imu:=chassis/imu")
    robot = Robot(ros)
    there = "no message on /chassis/imu; 0 publishers (sensor_msgs/msg/Imu is published on /imu/data"
    ros.until(lambda: there in robot.say(), 60.0, "the topic that has such messages")
    publisher = ros.node.create_publisher(Imu, "chassis/imu", 10)
    ros.until(lambda: "no message on /chassis/imu; 1 publisher;" in f"{robot.say()};", what="the publisher")
    ros.node.destroy_publisher(publisher)
    assert node.stop() == 0


def test_simulated_time_that_starts_again(ros, start):
    """Reports come before there is a clock, carry its time afterwards, and a loop is one reset."""
    from rosgraph_msgs.msg import Clock

    node = start_node(ros, *PARAMETERS, "-p", "use_sim_time:=true")
    robot = Robot(ros)
    robot.wait_for_node()
    assert robot.diagnostics[-1].header.stamp.sec == 0
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    ros.until(lambda: clock.get_subscription_count(), what="the node to listen to the clock")

    def play() -> None:
        for first in range(0, len(start), 200):
            part = start[first : first + 200]
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(part[0][0], 10**9)
            clock.publish(message)
            robot.play(part)

    play()
    begin = start[0][0] // 10**9
    ros.until(lambda: begin <= robot.diagnostics[-1].header.stamp.sec <= begin + 9, what="a report in simulated time")
    ros.until(lambda: len(robot.odometry["odometry/local"]) > 900, what="the odometry of the first round")
    assert robot.value("resets") == "0"
    play()
    ros.until(lambda: robot.value("resets") == "1", what="the reset")
    stamps = [stamp_of(message) for message in robot.odometry["odometry/local"]]
    ros.until(lambda: len(robot.odometry["odometry/local"]) > 1800, what="the odometry of the second round")
    assert np.count_nonzero(np.diff(stamps) < 0) <= 1
    assert node.stop() == 0


def test_planar_output_at_a_fifth_of_the_rate(ros, start):
    node = start_node(ros, *PARAMETERS, "-p", "output.two_d:=true", "-p", "output.rate_divisor:=5")
    robot = Robot(ros)
    robot.wait_for_node()
    robot.play(start)
    ros.until(lambda: len(robot.odometry["odometry/global"]) > 150, what="odometry")
    for topic, messages in robot.odometry.items():
        steps = np.diff([stamp_of(message) for message in messages])
        assert np.median(steps) == pytest.approx(25e6, rel=0.01), topic
        for message in messages:
            pose, twist = message.pose, message.twist
            assert pose.pose.position.z == twist.twist.linear.z == 0.0
            assert pose.pose.orientation.x == pose.pose.orientation.y == 0.0
            assert twist.twist.angular.x == twist.twist.angular.y == 0.0
            for covariance in (np.reshape(pose.covariance, (6, 6)), np.reshape(twist.covariance, (6, 6))):
                assert np.array_equal(covariance, covariance.T)
                assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert node.stop() == 0


def test_a_parked_robot_starts_warm_and_leaves_a_file(ros, start, tmp_path: Path):
    """With what the last run knew, the heading is there before the robot moves; at the end the file is a new one."""
    file = tmp_path / "memory.json"
    parameters = load(CONFIG)
    fix = next(data for _, topic, data in start if topic == "gps/fix")
    latitude, longitude, altitude = place_of(fix)
    memory = Memory(
        stamp=start[0][0] - 600 * 10**9,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude=altitude,
        position_std=2.0,
        heading_deg=0.0,
        heading_std_deg=1.0,
        accel_bias=(0.0, 0.0, 0.0),
        accel_bias_std=(parameters.imu.accel_bias_std,) * 3,
        gyro_bias=(0.0, 0.0, 0.0),
        gyro_bias_std=(parameters.imu.gyro_bias_std,) * 3,
    )
    write_memory(file, memory)
    node = start_node(ros, *PARAMETERS, "-p", f"warm_start.file:={file}")
    robot = Robot(ros)
    robot.wait_for_node()
    robot.play(start)
    last = robot.odometry["odometry/global"]
    ros.until(lambda: last and stamp_of(last[-1]) > start[-1][0] - 100_000_000, what="the end of the drive")
    assert last[-1].pose.covariance[35] < math.radians(3.0) ** 2
    assert "warm start from what was known 600 s ago" in node.output
    assert node.stop() == 0
    left = read_memory(file)
    assert left is not None
    assert left.stamp > start[-1][0] - 1_000_000_000
    assert left.latitude_deg == pytest.approx(latitude, abs=1e-4)


def place_of(fix: bytes) -> tuple[float, float, float]:
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import NavSatFix

    message = deserialize_message(fix, NavSatFix)
    return message.latitude, message.longitude, message.altitude


class Transforms:
    """What comes on /tf."""

    def __init__(self, ros: Ros) -> None:
        self.found: dict[tuple[str, str], dict[int, Any]] = {}
        self.kind = tf2_messages().TFMessage
        ros.node.create_subscription(self.kind, "/tf", self._note, 10_000)

    def _note(self, message: Any) -> None:
        for transform in message.transforms:
            pair = (transform.header.frame_id, transform.child_frame_id)
            self.found.setdefault(pair, {})[stamp_of(transform)] = transform.transform


def test_transforms_lead_from_map_to_base_link(ros, start):
    """map -> odom -> base_link is the pose of odometry/global, and odom stays level."""
    tf2_messages()
    transforms = Transforms(ros)
    node = start_node(ros, *PARAMETERS)
    robot = Robot(ros)
    robot.wait_for_node()
    robot.play(start)
    ros.until(lambda: len(transforms.found.get(("map", "odom"), {})) > 500, what="transforms")
    odometry = {stamp_of(message): message for message in robot.odometry["odometry/global"]}
    local = {stamp_of(message): message for message in robot.odometry["odometry/local"]}
    stamps = sorted(set(odometry) & set(local) & set.intersection(*map(set, transforms.found.values())))
    assert len(stamps) > 400
    for stamp in stamps:
        upper, lower = transforms.found["map", "odom"][stamp], transforms.found["odom", "base_link"][stamp]
        assert upper.rotation.x == upper.rotation.y == 0.0
        pose = odometry[stamp].pose.pose
        turn = rotation_of(upper.rotation)
        assert np.allclose(vector(upper.translation) + turn.apply(vector(lower.translation)), vector(pose.position))
        assert (turn * rotation_of(lower.rotation) * rotation_of(pose.orientation).inv()).magnitude() < 1e-7
        assert np.array_equal(vector(lower.translation), vector(local[stamp].pose.pose.position))
    assert node.stop() == 0


def test_odom_to_base_link_of_another_node_is_completed(ros, start):
    """With output.tf map_to_odom: our map -> odom times its odom -> base_link is our position and heading."""
    from geometry_msgs.msg import TransformStamped

    tf2_messages()
    transforms = Transforms(ros)
    node = start_node(ros, *PARAMETERS, "-p", "output.tf:=map_to_odom")
    robot = Robot(ros)
    robot.wait_for_node()
    publisher = ros.node.create_publisher(transforms.kind, "/tf", 100)
    ros.until(lambda: publisher.get_subscription_count() >= 2, what="the node to listen to /tf")
    yaw = 0.4
    for first in range(0, len(start), 40):
        transform = TransformStamped()
        transform.header.frame_id, transform.child_frame_id = "odom", "base_link"
        transform.header.stamp.sec, transform.header.stamp.nanosec = divmod(start[first][0] - 3_000_000, 10**9)
        transform.transform.translation.x, transform.transform.translation.y = 7.0 + 0.01 * first, -2.0
        transform.transform.rotation.w, transform.transform.rotation.z = math.cos(yaw / 2), math.sin(yaw / 2)
        publisher.publish(transforms.kind(transforms=[transform]))
        robot.play(start[first : first + 40])
    ros.until(lambda: len(transforms.found.get(("map", "odom"), {})) > 10, what="map -> odom")
    ros.until(lambda: len(robot.odometry["odometry/global"]) > 900, what="odometry")
    times = np.array([stamp_of(message) for message in robot.odometry["odometry/global"]])
    positions = np.array([vector(message.pose.pose.position) for message in robot.odometry["odometry/global"]])
    own = transforms.found["odom", "base_link"]
    assert set(transforms.found["map", "odom"]) <= set(own)
    compared = 0
    for stamp, upper in transforms.found["map", "odom"].items():
        after = np.searchsorted(times, stamp)
        if not 0 < after < len(times) or times[after] - times[after - 1] > 6_000_000:
            continue  # the observer has missed a row: at a fix the position jumps from one to the next
        compared += 1
        place = vector(upper.translation) + rotation_of(upper.rotation).apply(vector(own[stamp].translation))
        expected = [np.interp(stamp, times, positions[:, axis]) for axis in range(3)]
        assert np.allclose(place, expected, atol=1e-6)
    assert compared > 10
    assert node.stop() == 0


def test_a_second_publisher_of_our_transform_is_reported(ros, start):
    from geometry_msgs.msg import TransformStamped

    kind = tf2_messages().TFMessage
    node = start_node(ros, *PARAMETERS)
    robot = Robot(ros)
    robot.wait_for_node()
    publisher = ros.node.create_publisher(kind, "/tf", 100)
    transform = TransformStamped()
    transform.header.frame_id, transform.child_frame_id = "odom", "base_link"
    robot.play(start[:500])

    def is_reported() -> bool:
        publisher.publish(kind(transforms=[transform]))
        return "odom -> base_link is published by another node too" in robot.say()

    ros.until(is_reported, 30.0, "the report")
    assert "/observer" in robot.say()
    assert node.stop() == 0


def test_places_of_the_sensors_come_from_static_transforms(ros, start):
    """The IMU hangs on a mast that hangs on base_link; the antenna is given as a parameter and stays."""
    from geometry_msgs.msg import TransformStamped
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import Imu

    kind = tf2_messages().TFMessage
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = ros.node.create_publisher(kind, "/tf_static", latched)
    imu = next(data for _, topic, data in start if topic == "imu/data")
    frame = deserialize_message(imu, Imu).header.frame_id
    mast, sensor = TransformStamped(), TransformStamped()
    mast.header.frame_id, mast.child_frame_id = "base_link", "mast"
    sensor.header.frame_id, sensor.child_frame_id = "mast", frame
    mast.transform.translation.z = 2.0
    mast.transform.rotation.z = mast.transform.rotation.w = math.sqrt(0.5)
    sensor.transform.translation.x = 0.5
    publisher.publish(kind(transforms=[mast, sensor]))
    node = start_node(ros, "-p", "gnss.lever_arm:=[1.0, 2.0, 3.0]")
    robot = Robot(ros)
    robot.wait_for_node()
    robot.play(start[:400])
    ros.until(lambda: robot.value("place of the IMU") == "/tf_static", what="the mount")
    assert "position 0.000 0.500 2.000 m, roll pitch yaw 0.00 0.00 90.00 deg" in node.output
    assert robot.value("place of the GNSS antenna") == "parameters"
    assert node.stop() == 0


def test_services_of_robot_localization(ros, drive, start):
    services = pytest.importorskip(
        "robot_localization.srv", reason="needs robot_localization, which is not on PyPI: ros-jazzy-robot-localization"
    )
    node = start_node(ros, *PARAMETERS)
    robot = Robot(ros)
    robot.wait_for_node()
    robot.play(start)
    ros.until(lambda: robot.odometry["odometry/global"], what="a position")
    datum = load(CONFIG).datum or tuple(map(float, robot.value("datum").strip("()").split(",")))

    def call(kind: Any, name: str, request: Any) -> Any:
        client = ros.node.create_client(kind, name)
        ros.until(client.service_is_ready, what=name)
        future = client.call_async(request)
        ros.until(future.done, what=f"an answer of {name}")
        return future.result()

    request = services.FromLL.Request()
    point = request.ll_point
    point.latitude, point.longitude, point.altitude = datum[0] + 1e-3, datum[1] - 1e-3, datum[2] + 5.0
    place = call(services.FromLL, "fromLL", request).map_point
    assert vector(place) == pytest.approx(
        MapFrame(tuple(datum)).from_geodetic_deg(point.latitude, point.longitude, point.altitude), abs=1e-6
    )
    back = services.ToLL.Request()
    back.map_point = place
    answer = call(services.ToLL, "toLL", back).ll_point
    assert (answer.latitude, answer.longitude) == pytest.approx((point.latitude, point.longitude), abs=1e-10)
    assert answer.altitude == pytest.approx(point.altitude, abs=1e-4)

    setting = services.SetPose.Request()
    setting.pose.pose.pose.position.x = 12.0
    setting.pose.pose.pose.orientation.w = 1.0
    setting.pose.pose.covariance = np.diag([0.01] * 6).ravel()
    call(services.SetPose, "set_pose", setting)
    after = [message for message in drive if message[0] > start[-1][0] and message[1] == "imu/data"]
    robot.play(after[:20])
    last = robot.odometry["odometry/global"]
    ros.until(lambda: stamp_of(last[-1]) > start[-1][0], what="odometry after the pose was set")
    assert last[-1].pose.pose.position.x == pytest.approx(12.0, abs=0.1)

    moved = services.SetDatum.Request()
    moved.geo_pose.position.latitude, moved.geo_pose.position.longitude = answer.latitude, answer.longitude
    moved.geo_pose.position.altitude = answer.altitude
    call(services.SetDatum, "datum", moved)
    zero = call(services.FromLL, "fromLL", request).map_point
    assert vector(zero) == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)
    assert node.stop() == 0
