"""Publishers for every IMU sample: both odometries and the transforms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from eskf_ros.parameters.tree import Parameters
from eskf_ros.ros_node import transforms
from eskf_ros.ros_node.cdr import AnyOdometryWriter, LayoutError, OdometryMessageWriter, OdometryWriter
from eskf_ros.ros_node.odometry import GLOBAL, LOCAL, NUMBERS, fill_odometry
from eskf_ros.ros_node.transforms import TransformOutput
from eskf_ros.ros_node.two_d import flatten

OUTPUT_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)

ODOMETRY_QOS = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
"""After a stall the node answers a second of IMU samples at once: the queue holds them until subscribers read them."""

OVERRIDING = QoSOverridingOptions.with_default_policies()


class Outputs:
    """Publishes the rows of the estimator; nothing that is not finite leaves the node.

    Attributes:
        published: rows that were published as odometry.
        transforms: the output on /tf; None if it is switched off.
    """

    def __init__(self, node: Node, parameters: Parameters, note_trouble: Callable[[str], None]) -> None:
        self._node = node
        self._note_trouble = note_trouble
        self._two_d = parameters.output.two_d
        self._divisor = parameters.output.rate_divisor
        self._rows = 0
        self._numbers = np.zeros((2, NUMBERS))
        self.published = 0
        frames = parameters.frames
        self._global_writer = self._writer(frames.map, frames.base_link)
        self._local_writer = self._writer(frames.odom, frames.base_link)
        self._global = node.create_publisher(
            Odometry, "odometry/global", ODOMETRY_QOS, qos_overriding_options=OVERRIDING
        )
        self._local = node.create_publisher(Odometry, "odometry/local", ODOMETRY_QOS, qos_overriding_options=OVERRIDING)
        self.publishers: tuple[Any, ...] = (self._global, self._local)
        if parameters.smoother.lag > 0.0:
            self._smoothed = node.create_publisher(
                Odometry, "odometry/smoothed", ODOMETRY_QOS, qos_overriding_options=OVERRIDING
            )
            self.publishers = (*self.publishers, self._smoothed)
        self.transforms = self._open_transforms(parameters)

    def publish(self, rows: np.ndarray, index: int) -> None:
        """Publish row ``index`` of the ODOMETRY rows; the row may be changed."""
        self._rows += 1
        if self._rows % self._divisor:
            return
        row = rows[index]
        if self._two_d:
            flatten(row)
        if not fill_odometry(rows, index, self._two_d, self._numbers):
            self._note_trouble("a result was not finite and was not published")
            return
        stamp = int(row["stamp"])
        self._local.publish(self._local_writer.write(stamp, self._numbers[LOCAL]))
        if row["position_known"]:
            self._global.publish(self._global_writer.write(stamp, self._numbers[GLOBAL]))
        if self.transforms is not None:
            self.transforms.send(row)
        self.published += 1

    def publish_smoothed(self, rows: np.ndarray) -> None:
        """Publish smoothed ODOMETRY rows (n,); they may be changed."""
        for index in range(len(rows)):
            if self._two_d:
                flatten(rows[index])
            if fill_odometry(rows, index, self._two_d, self._numbers):
                self._smoothed.publish(self._global_writer.write(int(rows[index]["stamp"]), self._numbers[GLOBAL]))

    def _writer(self, frame: str, child_frame: str) -> AnyOdometryWriter:
        try:
            return OdometryWriter(frame, child_frame)
        except LayoutError as error:
            self._node.get_logger().warn(f"{error}; publishing through message objects, which costs more")
            return OdometryMessageWriter(frame, child_frame)

    def _open_transforms(self, parameters: Parameters) -> TransformOutput | None:
        mode = parameters.output.tf
        if mode == "none":
            return None
        if transforms.TFMessage is None:
            self._node.get_logger().warn(
                f"output.tf is {mode}, but the package tf2_msgs is not there: no transforms are published "
                "(install ros-jazzy-tf2-msgs, or set output.tf to none)"
            )
            return None
        # Volatile and reliable, like the broadcaster of tf2.
        publisher: Any = self._node.create_publisher(transforms.TFMessage, "/tf", OUTPUT_QOS)
        return TransformOutput(mode, parameters.frames, publisher.publish)
