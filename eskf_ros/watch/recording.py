"""Diagnostics from a recording: one of the robot, or odometry.mcap of a replay."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from eskf_ros.bags import BagError
from eskf_ros.watch.seen import DIAGNOSTICS, QUALITY, Report

TYPES = ("diagnostic_msgs/msg/DiagnosticArray", "diagnostic_msgs/msg/DiagnosticStatus")


def report_of(status: Any, stamp: float) -> Report:
    """Return a diagnostic_msgs/DiagnosticStatus, of ROS or of rosbags, as a report."""
    level = status.level if isinstance(status.level, int) else int.from_bytes(status.level, "little")
    return Report(stamp, status.name, level, status.message, {pair.key: pair.value for pair in status.values})


def reports(bag: Path) -> Iterator[Report]:
    """Return all reports of a recording in the order of its log times.

    Raises BagError if it cannot be read, or has neither of the topics.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            wanted = [
                connection
                for connection in reader.connections
                if connection.msgtype in TYPES
                and (f"/{connection.topic.lstrip('/')}" == DIAGNOSTICS or connection.topic.endswith(QUALITY))
            ]
            if not wanted:
                there = ", ".join(sorted({connection.topic for connection in reader.connections}))
                raise BagError(f"{bag}: there is neither {DIAGNOSTICS} nor {QUALITY} in it, but {there}")
            for connection, log_time, data in reader.messages(wanted):
                message: Any = reader.deserialize(data, connection.msgtype)
                statuses = message.status if connection.msgtype == TYPES[0] else [message]
                for status in statuses:
                    yield report_of(status, log_time * 1e-9)
    except (AnyReaderError, OSError) as error:
        raise BagError(f"{bag}: {error}") from error
