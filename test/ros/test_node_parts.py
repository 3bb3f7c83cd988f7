"""The parts below the node: messages by hand agree with the message library, parameters, clocks, start and end."""

from __future__ import annotations

import math
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eskf_ros
from eskf_ros.compiled import COMPILED, Digests, sentence_on_compiling
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.state.memory import allocate
from eskf_ros.parameters.docs import to_yaml
from eskf_ros.parameters.mapping import leaves, to_mapping
from eskf_ros.parameters.schema import ParameterError
from eskf_ros.parameters.tree import Parameters
from eskf_ros.ros_node.cdr import ImuReader, LayoutError, OdometryMessageWriter, OdometryWriter, imu_from_message
from eskf_ros.ros_node.clocks import Stamp, StampMonitor, clock_complaints
from eskf_ros.ros_node.odometry import fill_odometry
from eskf_ros.ros_node.two_d import PLANAR_VARIANCE
from support.ros_process import Ros, free_domain, needs_ros

SECOND = 1_000_000_000
FRAMES = [*("x" * length for length in range(1, 18)), "", "imu_link", "robot_1/imu", "größe", "x" * 255]


# ---- messages


def imu_message(frame: str = "imu_link", seed: int = 1) -> Any:
    from sensor_msgs.msg import Imu

    numbers = iter(np.random.default_rng(seed).normal(size=37).tolist())
    message = Imu()
    message.header.frame_id = frame
    message.header.stamp.sec = 1_700_000_000
    message.header.stamp.nanosec = 123_456_789
    for vector, axes in (
        (message.orientation, "xyzw"),
        (message.angular_velocity, "xyz"),
        (message.linear_acceleration, "xyz"),
    ):
        for axis in axes:
            setattr(vector, axis, next(numbers))
    for name in ("orientation_covariance", "angular_velocity_covariance", "linear_acceleration_covariance"):
        setattr(message, name, np.array([next(numbers) for _ in range(9)]))
    return message


@needs_ros
def test_imu_reader_reads_what_the_message_library_wrote() -> None:
    from rclpy.serialization import serialize_message

    for reader in (ImuReader(), ImuReader()):
        # Each length after each other one, as when a driver is restarted with another frame.
        for seed, frame in enumerate([*FRAMES, *reversed(FRAMES), *FRAMES[::3]]):
            message = imu_message(frame, seed)
            sample = reader.read(serialize_message(message))
            assert sample == imu_from_message(message)
            assert sample is not None
            assert sample[0] == 1_700_000_000_123_456_789
            assert sample[1][2] == message.linear_acceleration.z
            assert sample[2][0] == message.angular_velocity.x
            assert sample[3] == frame.encode()


@needs_ros
def test_imu_reader_passes_numbers_on_unjudged() -> None:
    from rclpy.serialization import serialize_message

    message = imu_message()
    message.angular_velocity.y = math.nan
    message.linear_acceleration.x = -math.inf
    message.header.stamp.sec = -5
    sample = ImuReader().read(serialize_message(message))
    assert sample is not None
    stamp, force, rate, _ = sample
    assert stamp == -5 * SECOND + 123_456_789
    assert force[0] == -math.inf
    assert math.isnan(rate[1])


@needs_ros
def test_imu_reader_leaves_everything_unusual_to_the_message_library() -> None:
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import Imu

    good = serialize_message(imu_message("abc"))
    reader = ImuReader()

    def changed(place: int, new: bytes) -> bytes:
        return good[:place] + new + good[place + len(new) :]

    unusual = {
        "big-endian": changed(0, b"\x00\x00"),
        "XCDR2": changed(0, b"\x00\x07"),
        "options": changed(2, b"\x00\x01"),
        "short": good[:-1],
        "long": good + b"\0",
        "no length": good[:15],
        "nothing": b"",
        "length beyond the end": changed(12, b"\xff\xff\xff\xff"),
        "length zero": changed(12, b"\0\0\0\0"),
        "no closing NUL": changed(16, b"abcd"),
        "NUL within": changed(16, b"a\0c\0"),
    }
    for why, data in unusual.items():
        assert reader.read(data) is None, why
        assert reader.read(good) == imu_from_message(deserialize_message(good, Imu)), f"after {why}"


def serialized_imu(stamp: bytes, frame: bytes, padding: bytes, numbers: bytes) -> bytes:
    """Put together as the definition of CDR says; 37 numbers."""
    head = stamp + struct.pack("<I", len(frame) + 1) + frame + b"\0"
    return b"\0\1\0\0" + head + padding[: -len(head) % 8] + numbers


@given(
    st.binary(min_size=8, max_size=8),
    st.binary(max_size=40).map(lambda frame: frame.replace(b"\0", b"x")),
    st.binary(min_size=8, max_size=8),
    st.binary(min_size=37 * 8, max_size=37 * 8),
)
def test_imu_reader_reads_any_numbers(stamp: bytes, frame: bytes, padding: bytes, numbers: bytes) -> None:
    """Any bits: NaN, infinities, denormals, names that are no text; what fills the gap after the name is garbage."""
    sample = SHARED_READER.read(serialized_imu(stamp, frame, padding, numbers))
    assert sample is not None
    seconds, nanoseconds = struct.unpack("<iI", stamp)
    assert sample[0] == seconds * SECOND + nanoseconds
    doubles = np.frombuffer(numbers, "<f8")
    np.testing.assert_array_equal(sample[1], doubles[25:28])
    np.testing.assert_array_equal(sample[2], doubles[13:16])
    assert sample[3] == frame


@given(
    st.one_of(
        st.binary(max_size=400),
        st.builds(
            lambda length, body: b"\0\1\0\0" + body[:8] + struct.pack("<I", length) + body[8:],
            st.one_of(st.integers(0, 40), st.integers(0, 2**32 - 1)),
            st.binary(min_size=200, max_size=400),
        ),
        st.builds(
            lambda frame, place, wrong: bytes(
                wrong if k == place else byte
                for k, byte in enumerate(serialized_imu(b"12345678", frame, b"12345678", bytes(296)))
            ),
            st.binary(max_size=20),
            st.integers(0, 50),
            st.integers(0, 255),
        ),
    )
)
def test_imu_reader_takes_any_bytes(data: bytes) -> None:
    """Never an exception, and what it gives has the form it should have."""
    sample = SHARED_READER.read(data)
    if sample is not None:
        stamp, force, rate, frame = sample
        assert isinstance(stamp, int)
        assert len(force) == len(rate) == 3
        assert all(isinstance(number, float) for number in (*force, *rate))
        assert b"\0" not in frame
        assert data[16 : 16 + len(frame) + 1] == frame + b"\0"


SHARED_READER = ImuReader()
"""One for all examples: what an earlier message left behind must not harm a later one."""


STAMP = 1_700_000_001_000_000_007


def odometry_numbers(seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=85)


def check_odometry(message: Any, frame: str, child: str, numbers: np.ndarray) -> None:
    pose, twist = message.pose.pose, message.twist.twist
    assert message.header.stamp.sec * SECOND + message.header.stamp.nanosec == STAMP
    assert (message.header.frame_id, message.child_frame_id) == (frame, child)
    p, q, v, w = pose.position, pose.orientation, twist.linear, twist.angular
    assert [p.x, p.y, p.z, q.x, q.y, q.z, q.w] == numbers[:7].tolist()
    assert message.pose.covariance.tolist() == numbers[7:43].tolist()
    assert [v.x, v.y, v.z, w.x, w.y, w.z] == numbers[43:49].tolist()
    assert message.twist.covariance.tolist() == numbers[49:].tolist()


@needs_ros
def test_odometry_writer_writes_what_the_message_library_reads() -> None:
    from nav_msgs.msg import Odometry
    from rclpy.serialization import deserialize_message, serialize_message

    children = FRAMES[::2]
    for seed, (frame, child) in enumerate((frame, child) for frame in FRAMES for child in children):
        numbers = odometry_numbers(seed)
        data = OdometryWriter(frame, child).write(STAMP, numbers)
        assert type(data) is bytes  # publish() takes nothing else
        message = deserialize_message(data, Odometry)
        check_odometry(message, frame, child, numbers)
        assert len(serialize_message(message)) == len(data)


@needs_ros
def test_odometry_writer_keeps_nothing_of_earlier_messages() -> None:
    from nav_msgs.msg import Odometry
    from rclpy.serialization import deserialize_message

    writer = OdometryWriter("odom", "base_link")
    first = writer.write(STAMP + 1, odometry_numbers(1))
    kept = bytes(first)
    second = writer.write(STAMP, odometry_numbers(2))
    assert first == kept
    check_odometry(deserialize_message(second, Odometry), "odom", "base_link", odometry_numbers(2))


@needs_ros
def test_odometry_by_message_is_the_same() -> None:
    numbers = odometry_numbers()
    message = OdometryMessageWriter("odom", "base_link").write(STAMP, numbers)
    check_odometry(message, "odom", "base_link", numbers)
    numbers[:] = 0.0  # the next row is written to the same place
    check_odometry(message, "odom", "base_link", odometry_numbers())


@pytest.mark.parametrize("is_planar", [False, True])
def test_rows_become_the_numbers_of_both_messages(is_planar: bool) -> None:
    generator = np.random.default_rng(1)
    rows = allocate(ODOMETRY, 2)
    row = rows[1]
    for name in ODOMETRY.names or ():
        if ODOMETRY[name].base.kind == "f":
            row[name] = generator.normal(size=ODOMETRY[name].shape)
    numbers = np.full((2, 85), np.nan)
    assert fill_odometry(rows, 1, is_planar, numbers)
    twist = [*row["velocity_body"], *row["angular_rate_body"], *row["twist_covariance"].ravel()]
    local = np.zeros((6, 6))
    local[[0, 1, 2], [0, 1, 2]] = row["local_position_variance"]
    local[3:5, 3:5] = row["pose_covariance"][3:5, 3:5]
    local[5, 5] = row["local_heading_variance"]
    if is_planar:
        local[2, 2] = PLANAR_VARIANCE
    for found, frame, covariance in zip(numbers, ("map", "odom"), (row["pose_covariance"], local)):
        attitude = row[f"attitude_body_to_{frame}"][[1, 2, 3, 0]]
        assert found.tolist() == [*row[f"position_{frame}"], *attitude, *covariance.ravel(), *twist]
    row["twist_covariance"][5, 0] = math.inf
    assert not fill_odometry(rows, 1, is_planar, numbers)


@needs_ros
def test_another_layout_of_odometry_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A message library whose Odometry has other fields, here the real one reading another message."""
    import nav_msgs.msg
    from geometry_msgs.msg import PoseWithCovarianceStamped

    monkeypatch.setattr(nav_msgs.msg, "Odometry", PoseWithCovarianceStamped)
    with pytest.raises(LayoutError, match="Odometry"):
        OdometryWriter("odom", "base_link")


@needs_ros
def test_odometry_writer_refuses_a_name_that_ros_would_cut() -> None:
    with pytest.raises(LayoutError):
        OdometryWriter("od\0om", "base_link")


# ---- parameters


@pytest.fixture
def make_node() -> Iterator[Callable[..., Any]]:
    """`make_node("-p", "gnss.time_offset:=1.5")` is a node in a context of its own, started with those arguments."""
    pytest.importorskip("rclpy", reason="needs rclpy: source a ROS 2 installation or install .[ros]")
    from rclpy.context import Context
    from rclpy.node import Node

    made = []

    def make(*arguments: str) -> Any:
        context = Context()
        context.init(args=["--ros-args", *arguments] if arguments else [], domain_id=free_domain())
        made.append((context, Node("eskf_node", context=context)))
        return made[-1][1]

    yield make
    for context, node in made:
        node.destroy_node()
        context.try_shutdown()


def test_every_parameter_is_declared_with_its_default_and_explained(make_node: Callable[..., Any]) -> None:
    from eskf_ros.ros_node.declare import declare

    node = make_node()
    parameters = declare(node)
    assert to_mapping(parameters) == to_mapping(Parameters())
    for leaf in leaves():
        value = node.get_parameter(leaf.name).value
        assert leaf.convert(value) == leaf.default or value != value
        descriptor = node.describe_parameter(leaf.name)
        assert descriptor.description.startswith(leaf.rule.description)
        assert descriptor.additional_constraints == leaf.allowed()
        assert descriptor.read_only is not leaf.rule.live
    (bounds,) = node.describe_parameter("gnss.gate_probability").floating_point_range
    assert (bounds.from_value, bounds.to_value) == (0.0, 1.0)
    assert "[m/s2]" in node.describe_parameter("imu.accel_bias_std").description
    assert node.get_parameter("datum").value == []


def test_parameter_file_with_all_defaults_is_accepted(make_node: Callable[..., Any], tmp_path: Path) -> None:
    from eskf_ros.ros_node.declare import declare, unused_overrides

    file = tmp_path / "eskf.yaml"
    file.write_text(to_yaml(), encoding="utf-8")
    node = make_node("--params-file", str(file))
    assert to_mapping(declare(node)) == to_mapping(Parameters())
    assert unused_overrides(node) == []


def test_values_from_file_and_command_line(make_node: Callable[..., Any], tmp_path: Path) -> None:
    """Integers are fine for numbers, an empty datum means none, and the command line wins."""
    from eskf_ros.ros_node.declare import declare

    file = tmp_path / "mine.yaml"
    file.write_text(
        textwrap.dedent("""
            /**:
              ros__parameters:
                datum: []
                frames: {base_link: body}
                gnss: {lever_arm: [1, 0, -2], covariance_scale: 4, time_offset: -0.1}
                imu: {gyro_noise_density: 1e-3}
            """),
        encoding="utf-8",
    )
    node = make_node("--params-file", str(file), "-p", "gnss.time_offset:=-1", "-p", "gnss.use_velocity:=false")
    parameters = declare(node)
    assert parameters.datum == ()
    assert parameters.frames.base_link == "body"
    assert parameters.gnss.lever_arm == (1.0, 0.0, -2.0)
    assert parameters.gnss.covariance_scale == 4.0
    assert parameters.gnss.time_offset == -1.0
    assert parameters.gnss.use_velocity is False
    assert parameters.imu.gyro_noise_density == 1e-3
    assert isinstance(node.get_parameter("gnss.covariance_scale").value, float)
    datum = make_node("-p", "datum:=[48.0, 11.5, 500.0]")
    assert declare(datum).datum == (48.0, 11.5, 500.0)
    assert list(datum.get_parameter("datum").value) == [48.0, 11.5, 500.0]


def test_unknown_and_impossible_overrides_are_all_named(make_node: Callable[..., Any]) -> None:
    from eskf_ros.ros_node.declare import declare

    node = make_node(
        *("-p", "gnss.gate_probabillity:=0.9"),
        *("-p", "imu.accel_bias_std:=99.0"),
        *("-p", "frames.map:=5"),
        *("-p", "gnss.lever_arm:=[1.0, 2.0]"),
        *("-p", "use_sim_time:=true"),
        *("-p", "qos_overrides./imu/data.subscription.depth:=7"),
    )
    with pytest.raises(ParameterError) as caught:
        declare(node, "mine.yaml")
    problems = sorted(caught.value.problems)
    assert len(problems) == 4
    assert problems[0].startswith("frames.map: 5 is not allowed")
    assert "gnss.gate_probabillity: unknown parameter" in problems[1]
    assert "did you mean gnss.gate_probability?" in problems[1]
    assert problems[2].startswith("gnss.lever_arm: [1.0, 2.0] is not allowed here, it takes 3 numbers")
    assert "imu.accel_bias_std: 99.0 is not allowed here, it takes a number 0 to 10 [m/s2]" in problems[3]
    assert str(caught.value).startswith("mine.yaml: ")
    assert not node.has_parameter("frames.map")


def test_overrides_that_nothing_used_are_found(make_node: Callable[..., Any]) -> None:
    from rclpy.qos import QoSProfile
    from rclpy.qos_overriding_options import QoSOverridingOptions
    from std_msgs.msg import Empty

    from eskf_ros.ros_node.declare import declare, unused_overrides

    node = make_node(
        *("-p", "qos_overrides./used.subscription.depth:=7"), *("-p", "qos_overrides./typo.subscription.depth:=7")
    )
    declare(node)
    node.create_subscription(
        Empty,
        "used",
        lambda message: None,
        QoSProfile(depth=1),
        qos_overriding_options=QoSOverridingOptions.with_default_policies(),
    )
    assert unused_overrides(node) == ["qos_overrides./typo.subscription.depth"]


def test_live_parameters_change_and_the_others_do_not(make_node: Callable[..., Any]) -> None:
    from rclpy.parameter import Parameter

    from eskf_ros.ros_node.declare import LiveParameters, declare

    node = make_node()
    told: list[Parameters] = []
    live = LiveParameters(node, declare(node), told.append)

    def set_one(name: str, value: object) -> Any:
        (result,) = node.set_parameters([Parameter(name, value=value)])
        return result

    assert set_one("gnss.gate_probability", 0.99).successful
    assert told[-1].gnss.gate_probability == live.current.gnss.gate_probability == 0.99
    assert set_one("gnss.covariance_scale", 2).successful
    changed = {"gnss.gate_probability": 0.99, "gnss.covariance_scale": 2.0}
    assert to_mapping(told[-1]) == {**to_mapping(Parameters()), **changed}
    assert live.current.gnss.covariance_scale == 2.0
    assert node.get_parameter("gnss.covariance_scale").type_ == Parameter.Type.DOUBLE
    assert set_one("gnss.status_std_vertical", [1, 2, 3]).successful
    assert live.current.gnss.status_std_vertical == (1.0, 2.0, 3.0)
    before, count = live.current, len(told)
    refusals: list[tuple[str, object, str]] = [
        # The bound itself is excluded, which a ROS range cannot say.
        ("gnss.gate_probability", 1.0, "above 0 and below 1"),
        ("gnss.gate_probability", 1.5, "1.0"),
        ("gnss.covariance_scale", math.nan, "Max: 1000000.0"),
        ("gnss.status_std_horizontal", [1.0, 2.0], "3 numbers, each above 0"),
        ("gnss.status_std_horizontal", [1.0, 2.0, -1.0], "3 numbers, each above 0"),
        ("gnss.status_std_horizontal", "wide", "DOUBLE_ARRAY"),
        ("gnss.use_position", 1, "BOOL"),
        ("frames.map", "world", "read-only"),
        ("history.window", 3.0, "read-only"),
    ]
    for name, value, reason in refusals:
        result = set_one(name, value)
        assert not result.successful, name
        assert reason in result.reason
        assert name in result.reason or "type" in result.reason
    both = [Parameter("gnss.velocity_std_floor", value=1.0), Parameter("gnss.position_std_floor", value=-1.0)]
    assert not node.set_parameters_atomically(both).successful
    assert live.current is before
    assert len(told) == count
    assert node.set_parameters_atomically([both[0], Parameter("gnss.use_velocity", value=False)]).successful
    assert len(told) == count + 1
    assert set_one("use_sim_time", False).successful
    assert len(told) == count + 1


# ---- clocks


def feed(monitor: StampMonitor, first: int, count: int, step: int, delay: int = 0) -> list[Stamp]:
    return [monitor.note(first + k * step, first + k * step + delay) for k in range(count)]


def test_delay_spread_and_rate() -> None:
    monitor = StampMonitor("imu/data")
    empty = monitor.timing(0)
    assert math.isnan(empty.delay)
    assert empty.rate == 0.0
    generator = random.Random(1)
    for k in range(500):
        stamp = 100 * SECOND + k * 5_000_000
        arrival = stamp + 3_000_000 + generator.randrange(2_000_000)
        assert monitor.note(stamp, arrival) is Stamp.IN_ORDER
    timing = monitor.timing(arrival)
    assert timing.delay == pytest.approx(0.004, abs=0.0004)
    assert timing.spread == pytest.approx(0.0018, abs=0.0003)
    assert timing.rate == pytest.approx(200.0, rel=1e-6)
    assert timing.silence == 0.0
    later = monitor.timing(arrival + 10 * SECOND)
    assert later.silence == 10.0
    assert later.rate < 12.0


@given(st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1)), max_size=40))
def test_monitor_takes_any_stamps(messages: list[tuple[int, int]]) -> None:
    monitor = StampMonitor("imu/data")
    for stamp, arrival in messages:
        monitor.note(stamp, arrival)
        timing = monitor.timing(arrival)
        assert timing.rate >= 0.0
        clock_complaints([monitor], arrival)


def test_zero_stamps_are_told_apart_and_explained() -> None:
    monitor = StampMonitor("gps/fix")
    assert monitor.note(0, 5 * SECOND) is Stamp.ZERO
    assert monitor.zero_count == 1
    (text,) = clock_complaints([monitor], 5 * SECOND)
    assert "1 message on gps/fix with stamp zero" in text
    assert "header.stamp" in text
    assert monitor.note(6 * SECOND, 6 * SECOND) is Stamp.IN_ORDER
    assert clock_complaints([monitor], 6 * SECOND) == []


def test_a_looping_recording_is_one_restart() -> None:
    monitor = StampMonitor("imu/data", window=2.0)
    period = 5_000_000
    for loop in range(3):
        verdicts = [
            monitor.note(50 * SECOND + k * period, (100 + 20 * loop) * SECOND + k * period) for k in range(4000)
        ]
        expected = [Stamp.ELSEWHERE] * 4 + [Stamp.STARTED_AGAIN] if loop else []
        assert verdicts[:5] == (expected or [Stamp.IN_ORDER] * 5)
        assert set(verdicts[5:]) == {Stamp.IN_ORDER}
    assert monitor.restart_count == 2


def test_a_simulation_reset_with_its_clock_is_one_restart() -> None:
    monitor = StampMonitor("imu/data", window=2.0)
    feed(monitor, 500 * SECOND, 300, 10_000_000)
    verdicts = feed(monitor, 1 * SECOND, 300, 10_000_000)
    assert verdicts.count(Stamp.STARTED_AGAIN) == 1
    assert monitor.timing(4 * SECOND).delay == 0.0


@pytest.mark.parametrize("wrong", ["past", "future", "random"])
def test_single_wrong_stamps_restart_nothing(wrong: str) -> None:
    monitor = StampMonitor("imu/data", window=2.0)
    generator = random.Random(2)
    for k in range(2000):
        now = 1000 * SECOND + k * 5_000_000
        if k % 3 == 1 or (1000 < k < 1100 and wrong == "random"):
            odd = {"past": now - 60 * SECOND, "future": now + 10**6 * SECOND, "random": generator.randrange(1, 2**62)}
            assert monitor.note(odd[wrong] if k % 3 == 1 else generator.randrange(1, 2**62), now) is Stamp.ELSEWHERE
        else:
            assert monitor.note(now, now) is Stamp.IN_ORDER
    assert monitor.restart_count == 0


def test_late_messages_within_the_window_are_in_order() -> None:
    monitor = StampMonitor("gps/fix", window=2.0)
    now = 100 * SECOND
    for k in range(50):
        stamp = now + k * 200_000_000 - (1_900_000_000 if k % 7 == 3 else 0)
        assert monitor.note(stamp, now + k * 200_000_000) is Stamp.IN_ORDER


def test_pauses_and_slow_topics_are_in_order() -> None:
    monitor = StampMonitor("gps/fix", window=2.0)
    assert set(feed(monitor, 100 * SECOND, 20, 10 * SECOND, delay=SECOND // 10)) == {Stamp.IN_ORDER}
    assert monitor.timing(100 * SECOND + 190 * SECOND).rate == pytest.approx(0.1)


def test_a_clock_set_forward_is_followed() -> None:
    """Stamps of a sensor that gets its time from GNSS a while after start: the arrivals do not jump with them."""
    monitor = StampMonitor("imu/data", window=2.0)
    feed(monitor, 100 * SECOND, 50, 10_000_000)
    verdicts = [monitor.note(10**6 * SECOND + k * 10_000_000, 101 * SECOND + k * 10_000_000) for k in range(50)]
    assert verdicts == [Stamp.ELSEWHERE] * 4 + [Stamp.WENT_AHEAD] + [Stamp.IN_ORDER] * 45
    assert monitor.restart_count == 0


def test_clocks_that_differ_are_named() -> None:
    imu, fix = StampMonitor("imu/data"), StampMonitor("gps/fix")
    feed(imu, 100 * SECOND, 200, 5_000_000, delay=2_000_000)
    feed(fix, 100 * SECOND, 5, 200_000_000, delay=150_000_000)
    now = 101 * SECOND
    assert clock_complaints([imu, fix], now) == []
    fix.restart()
    feed(fix, 100 * SECOND, 5, 200_000_000, delay=3_102_000_000)
    (text,) = clock_complaints([imu, fix], now)
    assert text.startswith("sensor clocks differ by 3.1 s: messages on gps/fix arrive 3.1 s after their stamp")
    assert "imu/data 0.0 s after" in text
    fix.restart()
    feed(fix, 100 * SECOND, 5, 200_000_000, delay=-3_102_000_000)
    assert "gps/fix 3.1 s before their stamp" in clock_complaints([imu, fix], now)[0]
    # In a recording both are days behind; what counts is still the difference.
    for monitor, delay in ((imu, 0), (fix, 7)):
        monitor.restart()
        feed(monitor, 100 * SECOND, 20, 5_000_000, delay=200 * 86400 * SECOND + delay * SECOND)
    (text,) = clock_complaints([imu, fix], 0)
    assert text.startswith("sensor clocks differ by 7.0 s: the stamps on gps/fix are that much further behind")


def test_a_recording_without_its_clock_is_guessed() -> None:
    imu, fix = StampMonitor("imu/data"), StampMonitor("gps/fix")
    for monitor in (imu, fix):
        feed(monitor, 100 * SECOND, 20, 5_000_000, delay=200 * 86400 * SECOND)
    (text,) = clock_complaints([imu, fix], 0)
    assert "200.0 days after their stamp" in text
    assert "use_sim_time" in text


# ---- start and end


NODE = """
import sys
from eskf_ros.ros_node.process import StopFlag, run
stop = StopFlag()
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
import numpy as np
import eskf_ros
from eskf_ros.ros_node.cdr import ImuReader, OdometryWriter

class Echo(Node):
    def __init__(self):
        super().__init__("echo")
        self.reader, self.writer = ImuReader(), OdometryWriter("odom", "base_link")
        self.output = self.create_publisher(Odometry, "odometry/local", 100)
        quality = QoSProfile(depth=500, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(Imu, "imu/data", self.take, quality, raw=True)
        self.create_timer(0.01, lambda: None)

    def take(self, data):
        stamp, force, rate, frame = self.reader.read(data)
        if force[0] == 666.0:
            raise ValueError("a mistake in a callback")
        numbers = [*force, 0.0, 0.0, 0.0, 1.0, *np.eye(6).ravel(), *rate, *rate, *np.eye(6).ravel()]
        self.output.publish(self.writer.write(stamp, np.array(numbers)))

    def close(self):
        print("closed", self.context.ok(), flush=True)

run(Echo, stop)
"""


@pytest.fixture
def ros() -> Iterator[Ros]:
    with Ros() as observer:
        yield observer


@pytest.fixture(scope="module")
def node_script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    script = tmp_path_factory.mktemp("life") / "echo.py"
    script.write_text(NODE, encoding="utf-8")
    return script


class Traffic:
    """Imu messages to the node in the other process and the odometry that comes back."""

    def __init__(self, ros: Ros) -> None:
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import Imu

        self._ros = ros
        self.publisher = ros.node.create_publisher(Imu, "imu/data", 100)
        self.received: list[Any] = []
        self._subscription = ros.node.create_subscription(Odometry, "odometry/local", self.received.append, 100)
        self.message = imu_message()
        self.sent = 0

    def send(self) -> None:
        self.message.header.stamp.nanosec = self.sent
        self.publisher.publish(self.message)
        self.sent += 1
        self._ros.spin_once(0.002)

    def close(self) -> None:
        self._ros.node.destroy_publisher(self.publisher)
        self._ros.node.destroy_subscription(self._subscription)


@pytest.fixture
def traffic(ros: Ros) -> Iterator[Traffic]:
    made = Traffic(ros)
    yield made
    made.close()


def flows(traffic: Traffic) -> Callable[[], bool]:
    def enough() -> bool:
        traffic.send()
        return len(traffic.received) > 10

    return enough


@needs_ros
@pytest.mark.parametrize(
    "signals",
    [
        [signal.SIGINT],
        [signal.SIGTERM],
        [signal.SIGINT, signal.SIGINT],
        [signal.SIGTERM, signal.SIGINT, signal.SIGTERM],
    ],
    ids=lambda signals: "+".join(number.name for number in signals),
)
def test_signals_under_load_end_with_exit_code_zero(
    ros: Ros, traffic: Traffic, node_script: Path, signals: list[signal.Signals]
) -> None:
    process = ros.spawn([node_script])
    ros.until(flows(traffic), what="odometry from the node")
    odometry = traffic.received[-1]
    assert odometry.pose.pose.position.z == traffic.message.linear_acceleration.z
    assert odometry.twist.twist.angular.y == traffic.message.angular_velocity.y
    assert odometry.child_frame_id == "base_link"
    for _ in range(random.randrange(30)):
        traffic.send()
    for number in signals:
        process.send_signal(number)
        for _ in range(random.randrange(4)):
            traffic.send()
    begin = time.monotonic()
    while process.is_running and time.monotonic() < begin + 5.0:
        traffic.send()
    assert process.stop() == 0
    assert process.output == "closed True\n"
    assert time.monotonic() - begin < 3.0


@pytest.mark.parametrize("events_executor", [True, False])
def test_either_executor_serves_the_node(
    make_node: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, events_executor: bool
) -> None:
    """Installations of Jazzy before 7.1.4 have no events executor; the loop is the same."""
    from rclpy.executors import SingleThreadedExecutor

    from eskf_ros.ros_node.process import StopFlag, make_executor, spin

    if not events_executor:
        monkeypatch.setitem(sys.modules, "rclpy.experimental.events_executor", None)
    handlers = {number: signal.getsignal(number) for number in StopFlag.SIGNALS}
    try:
        stop = StopFlag()
        node = make_node()
        executor = make_executor(node.context)
        assert isinstance(executor, SingleThreadedExecutor) is not events_executor
        executor.shutdown()
        calls: list[float] = []

        def tick() -> None:
            calls.append(time.monotonic())
            if len(calls) == 5:
                signal.raise_signal(signal.SIGTERM)

        node.create_timer(0.01, tick)
        begin = time.monotonic()
        spin(node, stop)
        assert stop.set
        assert len(calls) in (5, 6)
        assert time.monotonic() - begin < 2.0
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@needs_ros
def test_an_error_in_a_callback_comes_out_and_the_node_is_still_closed(
    ros: Ros, traffic: Traffic, node_script: Path
) -> None:
    process = ros.spawn([node_script])
    ros.until(flows(traffic), what="odometry from the node")
    traffic.message.linear_acceleration.x = 666.0
    traffic.send()
    ros.until(lambda: not process.is_running, what="the end of the node")
    assert process.stop() == 1
    assert "closed True\n" in process.output
    assert "ValueError: a mistake in a callback" in process.output


@needs_ros
def test_a_signal_while_the_node_is_made_ends_at_once(ros: Ros, tmp_path: Path) -> None:
    """The first start compiles for up to a minute; launch kills what has not ended after some seconds."""
    script = tmp_path / "slow.py"
    slow = 'super().__init__("echo")\n        print(1, flush=True)\n        __import__("time").sleep(60)'
    script.write_text(NODE.replace('super().__init__("echo")', slow))
    process = ros.spawn([script])
    ros.until(lambda: "1" in process.output, what="the node to be under way")
    assert process.stop(signal.SIGTERM, timeout=30.0) == 0
    assert process.output == "1\n"


@needs_ros
def test_a_signal_before_the_node_exists_ends_cleanly(ros: Ros, tmp_path: Path) -> None:
    script = tmp_path / "early.py"
    script.write_text("print('up', flush=True)\n" + NODE.replace("stop = StopFlag()", "stop = StopFlag()\nprint(1)"))
    process = ros.spawn([script])
    ros.until(lambda: "1" in process.output, what="the handlers")
    assert process.stop(signal.SIGTERM) == 0
    assert process.output == "up\n1\nclosed True\n"


@needs_ros
def test_parameters_change_over_the_network(ros: Ros, tmp_path: Path) -> None:
    """The events executor serves parameter calls, and a refusal arrives with its reason."""
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    script = tmp_path / "live.py"
    script.write_text(
        textwrap.dedent("""
            from eskf_ros.ros_node.process import StopFlag, run
            stop = StopFlag()
            from rclpy.node import Node
            from eskf_ros.ros_node.declare import LiveParameters, declare

            class Live(Node):
                def __init__(self):
                    super().__init__("live")
                    self.live = LiveParameters(self, declare(self), self.tell)

                def tell(self, parameters):
                    print(parameters.gnss.covariance_scale, flush=True)

                def close(self):
                    pass

            run(Live, stop)
            """),
        encoding="utf-8",
    )
    process = ros.spawn([script])
    client = ros.node.create_client(SetParameters, "/live/set_parameters")
    ros.until(client.service_is_ready, what="the parameter service")

    def set_scale(value: ParameterValue) -> Any:
        parameter = Parameter(name="gnss.covariance_scale", value=value)
        future = client.call_async(SetParameters.Request(parameters=[parameter]))
        ros.until(future.done, what="the answer")
        (result,) = future.result().results
        return result

    assert set_scale(ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=3)).successful
    refused = set_scale(ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=0.0))
    assert not refused.successful
    assert "gnss.covariance_scale: 0.0 is not allowed here, it takes a number above 0, at most 1e+06" in refused.reason
    ros.node.destroy_client(client)
    assert process.stop() == 0
    assert process.output == "3.0\n"


@pytest.mark.skipif(not COMPILED, reason="the kernels run uncompiled here")
def test_compiling_is_told_and_loading_from_the_cache_is_not(tmp_path: Path) -> None:
    script = tmp_path / "doubled.py"
    script.write_text(
        textwrap.dedent("""
            from eskf_ros.compiled import njit, while_compiling

            @njit
            def doubled(x):
                return 2 * x

            told = []
            with while_compiling(told.append):
                doubled(1.0), doubled(1), doubled(2.0)
            doubled(1j)
            print(told)
            """)
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    environment["PYTHONPATH"] = str(Path(eskf_ros.__file__).parent.parent)
    for expected in ("[1, 2]\n", "[]\n"):
        command = [sys.executable, str(script)]
        assert subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout == expected


@pytest.mark.parametrize(
    ("file", "kernels", "is_compiled_anew"),
    [
        ("filter/measurements/kalman_update.py", "filter.fuse", True),  # it calls them
        ("filter/measurements/kalman_update.py", "filter.measurements.zupt", False),
        ("filter/measurements/zupt.py", "filter.fuse", True),
        ("filter/measurements/zupt.py", "filter.predict", False),
        ("filter/state/error_state.py", "filter.inertial.covariance", True),  # it has none, but they take its constants
        ("filter/tight/epoch.py", "filter.loop", True),
        ("filter/tight/epoch.py", "filter.integrity.recovery", False),
        ("ros_node/two_d.py", "ros_node.odometry", True),
        ("ros_node/two_d.py", "filter.loop", False),
        ("parameters/tree.py", "filter.loop", False),
        ("replay/main.py", "filter.loop", False),
    ],
)
def test_an_edit_recompiles_what_depends_on_it(tmp_path: Path, file: str, kernels: str, is_compiled_anew: bool) -> None:
    package = tmp_path / "eskf_ros"
    shutil.copytree(Path(eskf_ros.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    before = Digests(package).of(kernels)
    assert before == Digests(Path(eskf_ros.__file__).parent).of(kernels)
    (package / file).write_text((package / file).read_text(encoding="utf-8") + "\nANOTHER = 1\n", encoding="utf-8")
    assert (Digests(package).of(kernels) != before) == is_compiled_anew


def test_compiling_says_so_at_once_and_then_seldom() -> None:
    said: list[str] = []
    tell = sentence_on_compiling(said.append)
    for count in range(1, 100):
        tell(count)
    assert len(said) == 1
    assert said[0].startswith("compiling the estimator: 1 of about 488 functions in 0 s")


@pytest.mark.skipif(not COMPILED, reason="the kernels run uncompiled here")
def test_the_command_compiles_without_ros_and_says_where() -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None; from eskf_ros.ros_node.main import main; "
        "status = main(['--compile']); "
        "from eskf_ros.compiled import CACHE_FOLDER; from eskf_ros.filter import navigator; "
        "from eskf_ros.gnss import measurements; from eskf_ros.ros_node import odometry; "
        "print(len(navigator.advance.signatures), len(measurements.measure.signatures), "
        "len(odometry.fill_odometry.signatures)); print(CACHE_FOLDER); sys.exit(status)"
    )
    ended = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    *_, said, compiled, folder = ended.stdout.splitlines()
    assert "0" not in compiled.split()
    assert said == f"eskf_node: compiled; the machine code is in {folder}"
    assert list(Path(folder).rglob("*.nbc"))


def test_without_numba_there_is_nothing_to_compile() -> None:
    code = "import sys; from eskf_ros.ros_node.main import main; sys.exit(main(['--compile']))"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, check=False, capture_output=True, text=True)
    assert ended.returncode == 2
    assert "nothing to compile" in ended.stderr


def test_catching_signals_costs_no_import_of_ros() -> None:
    """They must be caught before the second that importing rclpy takes."""
    code = (
        "import sys; from eskf_ros.ros_node.process import StopFlag; StopFlag(); "
        "sys.exit(any(name in sys.modules for name in ('rclpy', 'numpy', 'numba')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_no_two_test_processes_share_a_domain() -> None:
    free_domain()
    folders = [Path(eskf_ros.__file__).parent.parent, Path(__file__).parents[1]]
    code = f"import sys; sys.path[:0] = {[str(folder) for folder in folders]}\n"
    code += "from support import ros_process; print(ros_process.free_domain())"
    other = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert int(other.stdout) != free_domain()
