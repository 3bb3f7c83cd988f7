"""A robot for tests with the real node: publishes the bundled recording over DDS and listens to what the node says."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from eskf_ros.bags import encode, open_bag
from support.ros_process import Process, Ros

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "tunnel_drive.yaml"
TYPES = {
    "imu/data": "sensor_msgs/msg/Imu",
    "gps/fix": "sensor_msgs/msg/NavSatFix",
    "gps/vel": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
FIRST_START = 300.0
"""s; the longest start of a node: the first one after an edit of the kernels compiles them."""
SECONDS = 32.0
SPEED = 4.0


def read_drive(seconds: float = SECONDS) -> list[tuple[int, str, bytes]]:
    """The first part of the bundled recording: log time, topic, serialised message, in recorded order."""
    with open_bag([ROOT / "bags" / "tunnel_drive.mcap"]) as reader:
        end = reader.start_time + round(seconds * 1e9)
        found = []
        for batch in reader.batches(TYPES):
            for topic, part in batch.items():
                rows = encode(TYPES[topic], part.messages, part.strings)
                found += [(int(t), topic, bytes(row)) for t, row in zip(part.log_time, rows) if t < end]
    return sorted(found)


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


class Robot:
    """Publishes the drive and listens to the node."""

    def __init__(self, ros: Ros, prefix: str = "", best_effort: bool = False) -> None:
        """`prefix` is the namespace of the node, with a slash at its end."""
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import TwistWithCovarianceStamped
        from nav_msgs.msg import Odometry
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import Imu, NavSatFix

        self.ros = ros
        self.node_name = f"/{prefix}eskf_node"
        self.odometry: dict[str, list[Any]] = {"odometry/global": [], "odometry/local": []}
        self.diagnostics: list[Any] = []
        classes = {"imu/data": Imu, "gps/fix": NavSatFix, "gps/vel": TwistWithCovarianceStamped}
        qos = QoSProfile(depth=10_000)
        input_qos = QoSProfile(depth=10_000)
        if best_effort:
            input_qos.reliability = ReliabilityPolicy.BEST_EFFORT
        self.publishers = {
            topic: ros.node.create_publisher(kind, prefix + topic, input_qos) for topic, kind in classes.items()
        }
        self.subscriptions = [
            ros.node.create_subscription(Odometry, prefix + topic, self.odometry[topic].append, qos)
            for topic in self.odometry
        ]
        self.subscriptions.append(
            ros.node.create_subscription(DiagnosticArray, "/diagnostics", self._note_diagnostics, qos)
        )

    def _note_diagnostics(self, message: Any) -> None:
        if message.status[0].name.startswith(f"{self.node_name}:"):
            self.diagnostics.append(message)

    def wait_for_node(self) -> None:
        def is_ready() -> bool:
            return bool(self.diagnostics) and all(p.get_subscription_count() for p in self.publishers.values())

        self.ros.until(is_ready, FIRST_START, "the node to subscribe and to report")

    def play(
        self,
        drive: list[tuple[int, str, bytes]],
        speed: float = SPEED,
        until: Callable[[], object] = lambda: False,
    ) -> None:
        """Publish in recorded order and time, to the end or until a condition holds."""
        start, begin = drive[0][0], time.monotonic()
        for log_time, topic, data in drive:
            if until():
                return
            while time.monotonic() - begin < (log_time - start) * 1e-9 / speed:
                self.ros.spin_once(0.0005)
            self.publishers[topic].publish(data)

    def value(self, key: str) -> str:
        """One value of the last diagnostics."""
        return next(pair.value for pair in self.diagnostics[-1].status[0].values if pair.key == key)

    def leave(self) -> None:
        """Stop publishing and listening."""
        for publisher in self.publishers.values():
            self.ros.node.destroy_publisher(publisher)
        for subscription in self.subscriptions:
            self.ros.node.destroy_subscription(subscription)

    def say(self) -> str:
        return self.diagnostics[-1].status[0].message if self.diagnostics else ""


def start_node(ros: Ros, *arguments: str) -> Process:
    return ros.spawn([sys.executable, "-m", "eskf_ros.ros_node.main", "--ros-args", *arguments])
