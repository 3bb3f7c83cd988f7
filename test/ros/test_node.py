"""The real node in its own process over DDS."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from eskf_ros.bags import open_bag
from eskf_ros.replay.main import main as replay
from support.robot import CONFIG, ROOT, TYPES, Robot, read_drive, stamp_of, start_node
from support.ros_process import Ros, needs_ros

pytestmark = needs_ros

LOSSLESS = tuple(
    word
    for end in (*(f"{topic}.subscription" for topic in TYPES), "odometry/global.publisher", "odometry/local.publisher")
    for policy in ("reliability:=reliable", "depth:=100000")
    for word in ("-p", f"qos_overrides./{end}.{policy}")
)
"""For the comparison to the bit no message may get lost on a busy machine."""


@pytest.fixture
def ros() -> Iterator[Ros]:
    with Ros() as observer:
        yield observer


@pytest.fixture(scope="module")
def drive() -> list[tuple[int, str, bytes]]:
    return read_drive()


def last_imu_last(drive: list[tuple[int, str, bytes]]) -> list[tuple[int, str, bytes]]:
    """The drive with its last IMU sample at the very end, so that the odometry of that sample has seen everything."""
    last = max(index for index, (_, topic, _) in enumerate(drive) if topic == "imu/data")
    return [*drive[:last], *drive[last + 1 :], drive[last]]


def stamped(drive: list[tuple[int, str, bytes]]) -> Iterator[tuple[int, str, int]]:
    """Log time, topic and stamp (ns) of each message."""
    for log_time, topic, data in drive:
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
        yield log_time, topic, seconds * 1_000_000_000 + nanoseconds


@pytest.fixture(scope="module")
def patient(tmp_path_factory) -> Path:
    """The configuration with a history that reaches back to the start.

    However long this machine keeps a process waiting while others pass messages on, all of them are in time.
    """
    file = tmp_path_factory.mktemp("patient") / "patient.yaml"
    file.write_text(CONFIG.read_text() + "    history: {window: 60.0}\n")
    return file


@pytest.fixture(scope="module")
def replayed(drive, patient, tmp_path_factory) -> tuple[dict[str, Any], np.void]:
    """What `eskf_replay` makes of a bag of these messages: its summary, and its last odometry message."""
    folder = tmp_path_factory.mktemp("replayed")
    types = get_typestore(Stores.ROS2_JAZZY)
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=types) for topic, kind in TYPES.items()}
        # The order of log times is the order of arrival.
        for log_time, (_, topic, data) in enumerate(last_imu_last(drive), drive[0][0]):
            writer.write(connections[topic], log_time, data)
    words = [str(folder / "bag"), "--config", str(patient), "--out", str(folder), "--output-rate", "0", "--quiet"]
    assert replay(words) == 0
    with open_bag([folder / "bag_eskf" / "odometry.mcap"]) as reader:
        for batch in reader.batches({"/odometry/global": "nav_msgs/msg/Odometry"}):
            last = batch["/odometry/global"].messages[-1]
    return json.loads((folder / "bag_eskf" / "summary.json").read_text()), last


def test_the_node_ends_where_the_replay_ends_bit_for_bit(ros, drive, patient, replayed):
    """Every IMU sample has its odometry, and the last one is that of `eskf_replay` for a bag of the same messages."""
    node = start_node(ros, "--params-file", str(patient), *LOSSLESS)
    robot = Robot(ros)
    robot.wait_for_node()
    *before, last = last_imu_last(drive)
    robot.play(before)
    summary, expected = replayed
    # On a busy machine the node is seconds behind: it has to have seen everything before the last sample comes.
    newest = max(stamp for _, topic, stamp in stamped(before) if topic == "imu/data")
    local = robot.odometry["odometry/local"]
    ros.until(lambda: local and stamp_of(local[-1]) == newest, 60.0, "odometry of the last sample but one")
    for _ in range(50):
        ros.spin_once(0.02)
    robot.publishers["imu/data"].publish(last[2])
    odometry = robot.odometry["odometry/global"]

    def is_complete() -> bool:
        return all(messages and stamp_of(messages[-1]) == expected["stamp"] for messages in robot.odometry.values())

    ros.until(is_complete, what="odometry of the last sample")
    message = odometry[-1]
    p, q = message.pose.pose.position, message.pose.pose.orientation
    v, w = message.twist.twist.linear, message.twist.twist.angular
    assert [p.x, p.y, p.z] == expected["position"].tolist() == summary["final"]["position"]
    assert [q.x, q.y, q.z, q.w] == expected["orientation"].tolist()
    assert [v.x, v.y, v.z] == expected["linear_velocity"].tolist()
    assert [w.x, w.y, w.z] == expected["angular_velocity"].tolist()
    assert message.pose.covariance.tolist() == expected["pose_covariance"].ravel().tolist()
    assert message.twist.covariance.tolist() == expected["twist_covariance"].ravel().tolist()
    # Every IMU sample has its odometry, from the one that ends the levelling, in the first two seconds, to the last.
    imu_stamps = sorted(stamp for _, topic, stamp in stamped(drive) if topic == "imu/data")
    stamps = [stamp_of(m) for m in robot.odometry["odometry/local"]]
    assert stamps == imu_stamps[-len(stamps) :]
    assert len(imu_stamps) == summary["imu_count"]
    assert stamps[0] <= imu_stamps[0] + 2_100_000_000
    stamps = [stamp_of(m) for m in odometry]
    assert stamps == imu_stamps[-len(stamps) :]
    assert node.stop() == 0
    assert "Traceback" not in node.output


def test_the_node_says_what_it_waits_for(ros):
    node = start_node(ros)
    robot = Robot(ros)
    robot.wait_for_node()
    ros.until(lambda: "/imu/data" in robot.say(), what="diagnostics that name the missing topic")
    assert robot.say().startswith("WAITING_IMU")
    assert node.stop() == 0


def test_hostile_messages_leave_the_node_alive(ros, drive):
    """Random bytes, NaN, zero stamps: the node goes on, and then follows good data.

    On best-effort subscriptions, as they are by default: a reliable one waits for ever for a message of three bytes,
    which DDS itself refuses again and again.
    """
    node = start_node(ros, "--params-file", str(CONFIG))
    robot = Robot(ros)
    robot.wait_for_node()
    random = np.random.default_rng(1)
    for index in range(300):
        topic = tuple(robot.publishers)[index % 3]
        good = bytearray(next(data for _, t, data in drive if t == topic))
        kind = index % 4
        if kind == 0:
            good[4:] = random.bytes(len(good) - 4)
        elif kind == 1:
            good = good[: random.integers(0, len(good))]
        elif kind == 2:
            good[4:12] = bytes(8)
        else:
            good[-72:] = np.full(9, np.nan).tobytes()
        robot.publishers[topic].publish(bytes(good))
        ros.spin_once(0.001)
    robot.play(drive[: len(drive) // 2], speed=5.0)
    ros.until(lambda: robot.odometry["odometry/global"], what="odometry after hostile messages")
    for message in robot.odometry["odometry/local"] + robot.odometry["odometry/global"]:
        assert np.all(np.isfinite(message.pose.covariance))
        assert np.all(np.isfinite(message.twist.covariance))
    assert node.stop() == 0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["-p", "gnss.lever_arn:=[1.0, 0.0, 0.0]"], "gnss.lever_arm"),
        (["-p", "gnss.lever_arm:=[1, 2.0, 3.0]"], "gnss.lever_arm"),
        (["-p", "use_sim_time:=3"], "use_sim_time"),
        (["-p", "qos_overrides./imu/data.subscription.reliability:=maybe"], "maybe"),
        (["--params-file", "/nowhere/robot.yaml"], "/nowhere/robot.yaml"),
        (["-r", "__ns:=left"], "__ns:=left"),
    ],
)
def test_what_cannot_be_used_is_named_in_one_line_and_ends_the_node(ros, arguments, named):
    node = start_node(ros, *arguments)
    node.popen.wait(60)
    assert node.popen.returncode == 2
    said = [line for line in node.output.splitlines() if line.startswith("eskf_node: ")]
    assert len(said) == 1
    assert named in said[0]
    assert "Traceback" not in node.output


def test_the_node_imports_no_recording_or_plotting_library():
    """On a robot only numpy, scipy, numba and ROS are installed."""
    code = (
        "import sys, eskf_ros.ros_node.node;"
        "bad = {'rosbags', 'mcap', 'matplotlib', 'rich', 'zstandard', 'lz4', 'ruamel'} & set(sys.modules);"
        "sys.exit(', '.join(sorted(bad)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
