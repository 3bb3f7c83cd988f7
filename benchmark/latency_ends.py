"""The two ends of benchmark/node_latency.py: what plays a drive to the node, and what takes its odometry.

    latency_ends.py send RESULT NODE_PID RATE SECONDS LATE    # LATE: 1 when all of GNSS comes 500 ms late, else 0
    latency_ends.py receive RESULT                            # until SIGINT

Both save what they saw to RESULT, an .npz file; times are time.monotonic_ns, one clock for all processes.
"""

from __future__ import annotations

import os
import signal
import struct
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu, NavSatFix

from eskf_ros.bags import encode
from eskf_ros.simulate.frames import STRINGS
from eskf_ros.simulate.messages import topics_of
from eskf_ros.simulate.scenario import simulate

START = 15.0
"""Seconds into the drive: the car still stands for the five seconds that levelling needs two of."""

SETTLED = 10.0
"""Seconds after which the state is GOOD."""

PREPARATION = 5_000_000_000
"""Time (ns) to serialise the drive."""

USUAL_DELAY, LATE_DELAY = (0.08, 0.2), (0.5, 0.5)
"""Shortest and longest time (s) from the stamp of a fix to its arrival."""

TYPES = {"imu/data": Imu, "gps/fix": NavSatFix, "gps/vel": TwistWithCovarianceStamped}

Message = tuple[int, str, bytes]
"""When to publish it (ns from the first one), topic, serialised message."""


def drive(rate: float, seconds: float, delay: tuple[float, float], first_stamp: int) -> list[Message]:
    """The simulator's hour_drive with stamps from `first_stamp` on, in the order of publishing.

    IMU samples are published at their stamp; what GNSS sends half way between two of them, so that it is clear which
    sample is the first one after it.
    """
    recording = simulate("hour_drive", imu_rate=rate, latency=delay, start=START, stop=START + SETTLED + seconds)
    begin, period = int(recording.imu_stamp[0]), round(1e9 / rate)
    found = []
    for topic in topics_of(recording):
        if topic.name in TYPES:
            rows = topic.messages(slice(None))
            due = topic.arrival - begin
            due = rows["stamp"] - begin if topic.name == "imu/data" else due // period * period + period // 2
            rows["stamp"] += first_stamp - begin
            found += [(int(t), topic.name, bytes(data)) for t, data in zip(due, encode(topic.type_name, rows, STRINGS))]
    return sorted(found, key=lambda message: message[0])


def stamp_of(data: bytes) -> int:
    """The stamp (ns) of a serialised message that begins with a header."""
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
    return int(seconds * 1_000_000_000 + nanoseconds)


def processor_time(pid: int) -> float:
    """Seconds that all threads of a process have run so far (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def send(result: Path, node_pid: int, rate: float, seconds: float, is_late: bool) -> None:
    """Publish the drive; save what happened from `SETTLED` on.

    `sent`: stamp and time of each IMU sample (n, 2). `after_gnss`: stamps of those that were the first one after a
    fix or velocity. `processor`: share of one core that the node took.
    """
    rclpy.init()
    node = rclpy.create_node("sender")
    publishers = {topic: node.create_publisher(kind, topic, QoSProfile(depth=100)) for topic, kind in TYPES.items()}
    while not all(publisher.get_subscription_count() for publisher in publishers.values()):
        time.sleep(0.05)
    begin = time.monotonic_ns() + PREPARATION
    messages = drive(rate, seconds, LATE_DELAY if is_late else USUAL_DELAY, time.time_ns() + PREPARATION)

    sent, after_gnss = [], []
    follows_gnss, measured_from, processor = False, 0, 0.0
    for due, topic, data in messages:
        time.sleep(max(0.0, (begin + due - time.monotonic_ns()) * 1e-9))
        if due >= SETTLED * 1e9:
            if not measured_from:
                measured_from, processor = time.monotonic_ns(), processor_time(node_pid)
            if topic == "imu/data":
                sent.append((stamp_of(data), time.monotonic_ns()))
                if follows_gnss:
                    after_gnss.append(stamp_of(data))
            follows_gnss = topic != "imu/data"
        publishers[topic].publish(data)
    processor = (processor_time(node_pid) - processor) / (1e-9 * (time.monotonic_ns() - measured_from))
    time.sleep(0.5)
    np.savez(result, sent=np.array(sent), after_gnss=np.array(after_gnss, np.int64), processor=processor)


def receive(result: Path) -> None:
    """Take odometry until SIGINT; save stamp and time of each (`received`, (n, 2)), and when GOOD was first reported.

    Through a wait set of its own: an executor would add its own time to what is measured.
    """
    stopped: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: stopped.append(number))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("receiver")
    qos = QoSProfile(depth=10_000)
    odometry, diagnostics = (
        node.create_subscription(kind, topic, lambda message: None, qos).handle
        for kind, topic in ((Odometry, "odometry/global"), (DiagnosticArray, "/diagnostics"))
    )
    received: list[tuple[int, int]] = []
    good_since = np.iinfo(np.int64).max
    with odometry, diagnostics, node.context.handle:
        wait_set: Any = rclpy_implementation.WaitSet(2, 0, 0, 0, 0, 0, node.context.handle)
        while not stopped:
            wait_set.clear_entities()
            wait_set.add_subscription(odometry)
            wait_set.add_subscription(diagnostics)
            wait_set.wait(100_000_000)
            while (taken := odometry.take_message(Odometry, True)) is not None:
                received.append((stamp_of(taken[0]), time.monotonic_ns()))
            taken = diagnostics.take_message(DiagnosticArray, False)
            if taken is not None and taken[0].status[0].message.startswith("GOOD"):
                good_since = min(good_since, time.monotonic_ns())
    np.savez(result, received=np.array(received, np.int64).reshape(-1, 2), good_since=good_since)


if __name__ == "__main__":
    if sys.argv[1] == "send":
        send(Path(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5]), sys.argv[6] == "1")
    else:
        receive(Path(sys.argv[2]))
