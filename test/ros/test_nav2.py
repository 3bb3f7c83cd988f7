"""The node with config/nav2/eskf.yaml: topics, frames and services that Nav2 has of dual_ekf_navsat (docs/nav2.md)."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eskf_ros.bags import encode, open_bag
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.simulate.main import main as simulate
from support.robot import FIRST_START, ROOT, start_node
from support.ros_process import Ros, needs_ros

pytestmark = needs_ros

CONFIG = ROOT / "config" / "nav2" / "eskf.yaml"
SPEED = 3.0
TOPICS = {"imu/data": "imu", "gps/fix": "gps/fix", "gps/vel": "gps/vel", "wheel/odom": "odom"}
"""Topics of the recording, and those of the robot in the tutorial."""


@pytest.fixture
def ros() -> Iterator[Ros]:
    with Ros() as observer:
        yield observer


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, str, bytes]]:
    """Half a minute of a robot that turns in place and drives: log time, topic of the tutorial, message."""
    bag = tmp_path_factory.mktemp("nav2") / "robot.mcap"
    words = "field_robot --imu-rate 100 --set stop=45 --set lever_arm=0.0/0.0/0.0 --sensor wheel --quiet --out"
    assert simulate([*words.split(), str(bag)]) == 0
    messages = []
    with open_bag([bag]) as reader:
        types = {name: info.type for name, info in reader.topics.items() if name in TOPICS}
        for batch in reader.batches(types):
            for topic, part in batch.items():
                rows = encode(types[topic], part.messages, part.strings)
                messages += [(int(at), TOPICS[topic], bytes(row)) for at, row in zip(part.log_time, rows, strict=True)]
    return sorted(messages)


class Navigation:
    """What Nav2 sees of the node."""

    def __init__(self, ros: Ros) -> None:
        from diagnostic_msgs.msg import DiagnosticStatus
        from geometry_msgs.msg import TwistWithCovarianceStamped
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import Imu, NavSatFix

        self.ros = ros
        self.seen: dict[str, list[Any]] = {}
        self.subscriptions = [
            ros.node.create_subscription(kind, topic, self.seen.setdefault(topic, []).append, 10_000)
            for topic, kind in (
                ("/odometry/global", Odometry),
                ("/odometry/local", Odometry),
                ("/gps/filtered", NavSatFix),
                ("/eskf/quality", DiagnosticStatus),
            )
        ]
        if importlib.util.find_spec("tf2_msgs"):
            from tf2_msgs.msg import TFMessage

            self.subscriptions.append(
                ros.node.create_subscription(TFMessage, "/tf", self.seen.setdefault("/tf", []).append, 10_000)
            )
        kinds = {"imu": Imu, "gps/fix": NavSatFix, "gps/vel": TwistWithCovarianceStamped, "odom": Odometry}
        self.publishers = {topic: ros.node.create_publisher(kind, f"/{topic}", 10_000) for topic, kind in kinds.items()}

    def play(self, drive: list[tuple[int, str, bytes]]) -> None:
        self.ros.until(
            lambda: all(p.get_subscription_count() for p in self.publishers.values()), FIRST_START, "the node"
        )
        begin = time.monotonic()
        for log_time, topic, data in drive:
            while time.monotonic() - begin < (log_time - drive[0][0]) * 1e-9 / SPEED:
                self.ros.spin_once(0.0005)
            self.publishers[topic].publish(data)


def test_the_node_has_the_topics_and_frames_of_dual_ekf_navsat(ros: Ros, drive: list[tuple[int, str, bytes]]) -> None:
    start_node(ros, "--params-file", str(CONFIG))
    nav2 = Navigation(ros)
    nav2.play(drive)
    last_stamp = max(at for at, topic, _ in drive if topic == "imu")

    def is_through(topic: str) -> bool:
        newest = nav2.seen[topic][-1].header.stamp
        return bool(newest.sec * 10**9 + newest.nanosec > last_stamp - 200_000_000)

    # On a busy machine the observer is behind: each topic has its own queue.
    ros.until(lambda: is_through("/odometry/global") and is_through("/odometry/local"), 60.0, "the last odometry")
    for topic, frame in (("/odometry/global", "map"), ("/odometry/local", "odom")):
        message = nav2.seen[topic][-1]
        assert (message.header.frame_id, message.child_frame_id) == (frame, "base_footprint")
        assert message.pose.pose.position.z == 0.0, "costmaps lie in a plane"
        assert message.pose.pose.orientation.x == message.pose.pose.orientation.y == 0.0
    samples = sum(topic == "imu" for _, topic, _ in drive)
    assert 0.4 * samples < len(nav2.seen["/odometry/local"]) < 0.6 * samples, "rate_divisor: 2"
    # Without jumps: at most 1 m/s, and what the filter corrects is in map -> odom.
    local = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in nav2.seen["/odometry/local"]])
    assert np.linalg.norm(np.diff(local, axis=0), axis=1).max() < 0.25

    qualities = [{pair.key: pair.value for pair in message.values}["usable"] for message in nav2.seen["/eskf/quality"]]
    assert qualities[0] == "no"
    assert qualities[-1] == "yes", "the heading is known after a turn: waypoints may be sent"
    speeds = [message.twist.twist.linear.x for message in nav2.seen["/odometry/local"]]
    assert 0.7 < np.percentile(speeds, 95.0) < 0.9, "it drives at 0.8 m/s for fifteen seconds"
    if "/tf" in nav2.seen:
        pairs = {(t.header.frame_id, t.child_frame_id) for message in nav2.seen["/tf"] for t in message.transforms}
        assert pairs == {("map", "odom"), ("odom", "base_footprint")}


def test_from_ll_puts_a_waypoint_where_the_global_odometry_has_it(
    ros: Ros, drive: list[tuple[int, str, bytes]]
) -> None:
    """As Nav2's waypoint follower asks for it."""
    services = pytest.importorskip("robot_localization.srv", reason="ros-jazzy-robot-localization is not on PyPI")
    start_node(ros, "--params-file", str(CONFIG))
    nav2 = Navigation(ros)
    nav2.play(drive)
    client = ros.node.create_client(services.FromLL, "/fromLL")
    ros.until(client.service_is_ready, 20.0, "the service fromLL")
    place, request = nav2.seen["/gps/filtered"][-1], services.FromLL.Request()
    request.ll_point.latitude, request.ll_point.longitude = place.latitude, place.longitude
    request.ll_point.altitude = place.altitude
    answer = client.call_async(request)
    ros.until(answer.done, 10.0, "the answer of fromLL")
    point = answer.result().map_point
    stamp = place.header.stamp
    at = next(m for m in nav2.seen["/odometry/global"] if m.header.stamp == stamp).pose.pose.position
    assert (point.x, point.y) == pytest.approx((at.x, at.y), abs=1e-3)


def test_the_example_changes_what_it_says_and_no_places_of_sensors() -> None:
    from eskf_ros.parameters.ros_yaml import load

    example = load(CONFIG)
    assert example.gnss.lever_arm == (0.0, 0.0, 0.0), "or /tf_static would not be asked"
    assert example.output.tf == "full"
    text = (ROOT / "docs" / "nav2.md").read_text(encoding="utf-8")
    assert "config/nav2/eskf.yaml" in text
    assert Path(ROOT / "config/nav2/eskf.yaml").is_file()
    assert MapFrame((0.0, 0.0, 0.0)).from_geodetic_deg(0.0, 0.0, 0.0).tolist() == pytest.approx([0.0, 0.0, 0.0])
