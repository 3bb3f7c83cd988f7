"""The real node in its own process over DDS."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from robot import CONFIG, ROOT, TYPES, Robot, read_drive, stamp_of, start_node
from ros_process import Ros, needs_ros

from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters import load

pytestmark = needs_ros

RELIABLE = tuple(
    word for topic in TYPES for word in ("-p", f"qos_overrides./{topic}.subscription.reliability:=reliable")
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


@pytest.fixture(scope="module")
def replayed(drive) -> tuple[Navigator, np.ndarray]:
    """The same messages through the estimator without ROS: the navigator, and the row of the last IMU sample."""
    from geometry_msgs.msg import TwistWithCovarianceStamped
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import Imu, NavSatFix

    navigator = Navigator(load(CONFIG))
    for _, topic, data in last_imu_last(drive):
        if topic == "imu/data":
            m = deserialize_message(data, Imu)
            a, w = m.linear_acceleration, m.angular_velocity
            rows = navigator.push_imu(np.array([stamp_of(m)]), np.array([[a.x, a.y, a.z]]), np.array([[w.x, w.y, w.z]]))
        elif topic == "gps/fix":
            m = deserialize_message(data, NavSatFix)
            navigator.push_gnss_position(
                stamp_of(m), m.latitude, m.longitude, m.altitude, m.position_covariance, m.position_covariance_type, 0
            )
        else:
            m = deserialize_message(data, TwistWithCovarianceStamped)
            v = m.twist.twist.linear
            covariance = np.reshape(m.twist.covariance, (6, 6))[:3, :3].ravel()
            navigator.push_gnss_velocity(stamp_of(m), (v.x, v.y, v.z), covariance)
    return navigator, rows[0]


def test_the_node_ends_where_the_replay_ends_bit_for_bit(ros, drive, replayed):
    """Every IMU sample has its odometry, and the last one is that of the replay."""
    node = start_node(ros, "--params-file", str(CONFIG), *RELIABLE)
    robot = Robot(ros)
    robot.wait_for_node()
    *before, last = last_imu_last(drive)
    robot.play(before)
    navigator, row = replayed
    for _ in range(50):
        ros.spin_once(0.02)
    robot.publishers["imu/data"].publish(last[2])
    ros.until(
        lambda: robot.odometry["odometry/global"] and stamp_of(robot.odometry["odometry/global"][-1]) == row["stamp"]
    )
    message = robot.odometry["odometry/global"][-1]
    p, q = message.pose.pose.position, message.pose.pose.orientation
    assert [p.x, p.y, p.z] == row["position_map"].tolist()
    assert [q.w, q.x, q.y, q.z] == row["attitude_body_to_map"].tolist()
    assert message.pose.covariance.tolist() == row["pose_covariance"].ravel().tolist()
    assert message.twist.covariance.tolist() == row["twist_covariance"].ravel().tolist()
    stamps = [stamp_of(m) for m in robot.odometry["odometry/local"]]
    imu = navigator.imu_counts["offered"]
    assert stamps == sorted(set(stamps))
    # All but those before the attitude is level, in the first two seconds.
    assert imu - 2.1 * 200 <= len(stamps) <= imu
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


def test_a_wrong_parameter_is_named_and_ends_the_node(ros):
    node = start_node(ros, "-p", "gnss.lever_arn:=[1.0, 0.0, 0.0]")
    node.popen.wait(30)
    assert node.popen.returncode == 2
    assert "gnss.lever_arm" in node.output
    assert "Traceback" not in node.output


def test_the_node_imports_no_recording_or_plotting_library():
    """On a robot only numpy, scipy, numba and ROS are installed."""
    code = (
        "import sys, eskf_ros.node.node;"
        "bad = {'rosbags', 'mcap', 'matplotlib', 'rich', 'zstandard'} & set(sys.modules);"
        "sys.exit(', '.join(sorted(bad)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
