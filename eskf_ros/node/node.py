"""The ROS node: turns messages into calls of the `Navigator`, and its rows into messages. No navigation here."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from eskf_ros.filter.layout import Verdict
from eskf_ros.filter.navigator import Navigator, compile_kernels
from eskf_ros.node.cdr import (
    AnyOdometryWriter,
    ImuReader,
    ImuSample,
    LayoutError,
    OdometryMessageWriter,
    OdometryWriter,
    imu_from_message,
)
from eskf_ros.node.clocks import SECOND, Stamp, StampMonitor
from eskf_ros.node.declare import LiveParameters, declare
from eskf_ros.node.messages import bias_message, fix_message, record_statuses
from eskf_ros.node.status import status_report
from eskf_ros.parameters import Parameters

INPUT_DEPTH = 1000
"""A second of a fast IMU: what may wait while the computer is busy elsewhere."""

GNSS_DEPTH = 50
REPORT_PERIOD = 1.0


class EskfNode(Node):
    """Subscribes to IMU and GNSS, publishes odometry for every IMU sample, diagnostics and biases once a second.

    A message that cannot be used is counted and named in the diagnostics; it never ends the node.
    """

    def __init__(self) -> None:
        super().__init__("eskf_node")
        self.parameters = declare(self)
        self.navigator = Navigator(self.parameters)
        self.trouble: dict[str, int] = {}
        self.verdicts: dict[tuple[int, Verdict], int] = {}
        self.published = 0
        self.resets = 0
        self._compile()
        self._live = LiveParameters(self, self.parameters, self._configure)

        frames, topics = self.parameters.frames, self.parameters.topics
        self._global_writer = self._writer(frames.map, frames.base_link)
        self._local_writer = self._writer(frames.odom, frames.base_link)
        output = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        self._global = self.create_publisher(Odometry, "odometry/global", output)
        self._local = self.create_publisher(Odometry, "odometry/local", output)
        self._filtered = self.create_publisher(NavSatFix, "gps/filtered", output)
        self._bias = self.create_publisher(TwistWithCovarianceStamped, "imu/bias", output)
        self._aids = self.create_publisher(DiagnosticArray, "eskf/aids", output)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", output)

        window = self.parameters.history.window
        self.monitors = {
            name: StampMonitor(self.resolve_topic_name(name), window)
            for name in (topics.imu, topics.gnss_fix, topics.gnss_velocity)
        }
        self._imu_reader = ImuReader()
        # Best effort matches every publisher, reliable ones too.
        imu_qos = QoSProfile(depth=INPUT_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        gnss_qos = QoSProfile(depth=GNSS_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        for qos in (imu_qos, gnss_qos):
            qos.durability = DurabilityPolicy.VOLATILE
        overriding = QoSOverridingOptions.with_default_policies()
        # All come serialised: a message that cannot be read fails in our callback, not in the executor.
        self.inputs = [
            self.create_subscription(
                kind, topic, self._contained(callback), qos, raw=True, qos_overriding_options=overriding
            )
            for kind, topic, callback, qos in (
                (Imu, topics.imu, self._on_imu, imu_qos),
                (NavSatFix, topics.gnss_fix, self._on_fix, gnss_qos),
                (TwistWithCovarianceStamped, topics.gnss_velocity, self._on_velocity, gnss_qos),
            )
        ]
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/set_datum_here", self._on_set_datum_here)
        self.create_timer(REPORT_PERIOD, self._contained(self._report))
        self.get_logger().info("ready: waiting for " + ", ".join(m.topic for m in self.monitors.values()))

    def close(self) -> None:
        """Publish the last report; called while the publishers still work."""
        self._contained(self._report)()

    def _compile(self) -> None:
        """Have every kernel compiled before the first message comes: from the cache, or anew for half a minute."""
        self.get_logger().info("starting the estimator; the first start after an installation compiles it (a minute)")
        compile_kernels()

    def _writer(self, frame: str, child_frame: str) -> AnyOdometryWriter:
        try:
            return OdometryWriter(frame, child_frame)
        except LayoutError as error:
            self.get_logger().warn(f"{error}; publishing through message objects, which costs more")
            return OdometryMessageWriter(frame, child_frame)

    def _contained(self, callback: Any) -> Any:
        """Let no message and no mistake of ours end the node: count it, log it, go on."""

        def contain(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                self.note_trouble(f"{callback.__name__.removeprefix('_on_')}: {type(error).__name__}: {error}")

        return contain

    def note_trouble(self, text: str) -> None:
        """Count a kind of trouble, and log it the first time."""
        if text not in self.trouble and len(self.trouble) < 100:
            self.get_logger().error(text)
            self.trouble[text] = 0
        if text in self.trouble:
            self.trouble[text] += 1

    def _configure(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.navigator.configure(parameters)

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _is_usable(self, topic: str, stamp: int) -> bool:
        judgement = self.monitors[topic].note(stamp, self._now())
        if judgement == Stamp.STARTED_AGAIN and topic == self.parameters.topics.imu:
            self._reset(f"the stamps of {self.monitors[topic].topic} went back")
        return judgement != Stamp.ZERO

    def _reset(self, why: str) -> None:
        self.get_logger().warn(f"{why}: the estimator starts again")
        self.navigator.reset()
        self.resets += 1
        for topic, monitor in self.monitors.items():
            if topic != self.parameters.topics.imu:
                monitor.restart()

    def _on_imu(self, data: bytes) -> None:
        sample: ImuSample | None = self._imu_reader.read(data)
        if sample is None:
            sample = imu_from_message(deserialize_message(data, Imu))
        stamp, specific_force, angular_rate, _ = sample
        if not self._is_usable(self.parameters.topics.imu, stamp):
            return
        rows = self.navigator.push_imu(np.array([stamp]), np.array([specific_force]), np.array([angular_rate]))
        for row in rows:
            self._publish(row)

    def _on_fix(self, data: bytes) -> None:
        message: NavSatFix = deserialize_message(data, NavSatFix)
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        if self._is_usable(self.parameters.topics.gnss_fix, stamp):
            self.navigator.push_gnss_position(
                stamp,
                message.latitude,
                message.longitude,
                message.altitude,
                message.position_covariance,
                message.position_covariance_type,
                message.status.status,
                self._now(),
            )

    def _on_velocity(self, data: bytes) -> None:
        message: TwistWithCovarianceStamped = deserialize_message(data, TwistWithCovarianceStamped)
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        if self._is_usable(self.parameters.topics.gnss_velocity, stamp):
            linear = message.twist.twist.linear
            covariance = np.reshape(message.twist.covariance, (6, 6))[:3, :3].ravel()
            self.navigator.push_gnss_velocity(stamp, (linear.x, linear.y, linear.z), covariance, self._now())

    def _publish(self, row: np.void) -> None:
        """Publish both odometries of one IMU sample; nothing that is not finite leaves the node."""
        pose, twist = row["pose_covariance"], row["twist_covariance"]
        velocity, rate = row["velocity_body"].tolist(), row["angular_rate_body"].tolist()
        local_position, local_attitude = row["position_odom"].tolist(), row["attitude_body_to_odom"].tolist()
        position, attitude = row["position_map"].tolist(), row["attitude_body_to_map"].tolist()
        if not math.isfinite(
            sum(velocity) + sum(rate) + sum(local_position) + sum(position) + sum(attitude) + pose.sum() + twist.sum()
        ):
            self.note_trouble("a result was not finite and was not published")
            return
        stamp = int(row["stamp"])
        local_pose = np.diag([float(row["local_position_variance"])] * 3 + [0.0] * 3)
        local_pose[3:, 3:] = pose[3:, 3:]
        local_pose[5, :] = local_pose[:, 5] = 0.0
        local_pose[5, 5] = row["local_heading_variance"]
        self._local.publish(
            self._local_writer.write(stamp, local_position, local_attitude, local_pose, velocity, rate, twist)
        )
        if row["position_known"]:
            self._global.publish(self._global_writer.write(stamp, position, attitude, pose, velocity, rate, twist))
        self.published += 1

    def _report(self) -> None:
        """Once a second: records, biases, filtered fix, diagnostics."""
        records = self.navigator.take_records()
        for record in records:
            key = (int(record["stream"]), Verdict(int(record["verdict"])))
            self.verdicts[key] = self.verdicts.get(key, 0) + 1
        stamp = self.get_clock().now().to_msg()
        if len(records):
            self._aids.publish(record_statuses(records, stamp))
        row, datum = self.navigator.odometry[0], self.navigator.datum
        self._bias.publish(bias_message(row, self.parameters.frames.base_link))
        if row["position_known"] and datum is not None:
            self._filtered.publish(fix_message(row, datum, self.parameters.frames.base_link))
        self._diagnostics.publish(status_report(self, stamp))

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._reset("reset was asked for")
        response.success, response.message = True, "the estimator starts again"
        return response

    def _on_set_datum_here(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.navigator.set_datum_here()
        response.message = (
            "the map begins at the present position" if response.success else "the position is not known yet"
        )
        return response
