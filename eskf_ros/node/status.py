"""The node's diagnostics: the state, what it waits for, what is wrong and what to do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from eskf_ros.filter.layout import STREAM_NAMES, Status
from eskf_ros.node.clocks import clock_complaints
from eskf_ros.node.messages import key_values

if TYPE_CHECKING:
    from eskf_ros.node.node import EskfNode

SILENCE = 3.0
"""Seconds without a message after which a topic is called silent."""


def status_report(node: EskfNode, stamp: Time) -> DiagnosticArray:
    """One status: OK when the state is GOOD and nothing is wrong."""
    now = node.get_clock().now().nanoseconds
    row = node.navigator.odometry[0]
    status = Status(int(row["status"]))
    problems = [*node.navigator.complaints, *clock_complaints(node.monitors.values(), now)]
    problems += [f"{text} ({count} times)" for text, count in node.trouble.items()]
    waiting = waiting_for(node, status, now)
    level = DiagnosticStatus.OK if status == Status.GOOD and not problems else DiagnosticStatus.WARN
    report = DiagnosticArray()
    report.header.stamp = stamp
    report.status.append(
        DiagnosticStatus(
            level=level,
            name=f"{node.get_fully_qualified_name()}: navigation",
            hardware_id="eskf_ros",
            message="; ".join([status.name, *waiting, *problems]),
            values=key_values({**figures(node, row), **counters(node), **topics(node, now)}),
        )
    )
    return report


def waiting_for(node: EskfNode, status: Status, now: int) -> list[str]:
    """What keeps the state from the next rung."""
    names = node.parameters.topics
    if status in (Status.WAITING_IMU, Status.LEVELLING):
        return missing(node, names.imu, now) or ["standing still or driving steadily for a moment"]
    if status in (Status.WAITING_FIX, Status.COASTING):
        return missing(node, names.gnss_fix, now) or ["fixes come, but none was accepted lately: see eskf/aids"]
    if status == Status.WAITING_HEADING:
        speed = node.parameters.alignment.course_min_speed
        return missing(node, names.gnss_fix, now) or [f"heading: drive forward faster than {speed:g} m/s"]
    return []


def missing(node: EskfNode, name: str, now: int) -> list[str]:
    """Say so when nothing comes on a topic, and who could send."""
    monitor = node.monitors[name]
    timing = monitor.timing(now)
    if timing.silence <= SILENCE:
        return []
    publishers = node.count_publishers(monitor.topic)
    since = "no message" if math.isnan(timing.silence) else f"no message for {timing.silence:.0f} s"
    return [f"{since} on {monitor.topic}; {publishers} publishers"]


def figures(node: EskfNode, row: np.void) -> dict[str, object]:
    """Uncertainty, biases, and how much was published."""
    sigma = [math.sqrt(max(0.0, row["pose_covariance"][i, i])) for i in range(6)]
    return {
        "position std (m)": " ".join(f"{value:.3f}" for value in sigma[:3]),
        "heading std (deg)": f"{math.degrees(sigma[5]):.2f}",
        "accelerometer bias (m/s2)": " ".join(f"{value:.4f}" for value in row["accel_bias"]),
        "gyro bias (rad/s)": " ".join(f"{value:.6f}" for value in row["gyro_bias"]),
        "odometries published": node.published,
        "restarts": node.navigator.restarts,
        "resets": node.resets,
        "datum": node.navigator.datum,
        "window needed (s)": node.navigator.window_needed,
    }


def counters(node: EskfNode) -> dict[str, object]:
    """Measurements by stream and final verdict, IMU samples by what became of them."""
    found: dict[str, object] = {
        f"{STREAM_NAMES[stream]} {verdict.name.lower()}": count for (stream, verdict), count in node.verdicts.items()
    }
    found.update({f"imu {name}": count for name, count in node.navigator.imu_counts.items()})
    return found


def topics(node: EskfNode, now: int) -> dict[str, object]:
    """Rate and delay of each input."""
    found: dict[str, object] = {}
    for monitor in node.monitors.values():
        timing = monitor.timing(now)
        found[f"{monitor.topic} rate (Hz)"] = f"{timing.rate:.1f}"
        found[f"{monitor.topic} delay (s)"] = f"{timing.delay:.3f} +- {timing.spread:.3f}"
    return found
