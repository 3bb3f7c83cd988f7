"""The node without a network: its callbacks are given serialised messages, and what it publishes is caught."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eskf_ros.bags import StringTable, decode, encode
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Quality, Status, Stream
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.ros_node.error_counter import FRESH, KINDS, Trouble
from support.robot import CONFIG, read_drive
from support.ros_process import free_domain, needs_ros

SECOND = 1_000_000_000
FIX, TWIST, IMU = "sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/TwistWithCovarianceStamped", "sensor_msgs/msg/Imu"
TYPES = {"imu/data": IMU, "gps/fix": FIX, "gps/vel": TWIST}
INPUTS = {"gps/fix": "gnss_fix", "gps/vel": "gnss_velocity"}

Drive = list[tuple[int, str, bytes]]


class Inside:
    """A node of this process whose clock is that of the recording, and what it published, by topic."""

    def __init__(self, *arguments: str) -> None:
        from rclpy.context import Context

        from eskf_ros.ros_node.node import EskfNode

        self.context = Context()
        words = ["--params-file", str(CONFIG), "--log-level", "fatal", *arguments]
        self.context.init(args=["--ros-args", *words], domain_id=free_domain())
        self.node: Any = EskfNode(context=self.context)
        self.time = 0
        self.node.now = lambda: self.time
        self.published: dict[str, list[Any]] = {}
        for publisher in self.node.output_publishers:
            publisher.publish = self.published.setdefault(publisher.topic_name, []).append
        self._callbacks: dict[str, Callable[[bytes], None]] = {}
        for subscription, _ in self.node.inputs:
            self._callbacks[subscription.topic_name.strip("/")] = subscription.callback

    def give(self, topic: str, data: bytes) -> None:
        self._callbacks[topic](data)

    def play(self, drive: Drive) -> None:
        for log_time, topic, data in drive:
            self.time = log_time
            self.give(topic, data)

    def report(self) -> Any:
        """The diagnostics of now; its values are in `values`."""
        self.node._report()
        status = self.published["/diagnostics"][-1].status[0]
        self.values = {pair.key: pair.value for pair in status.values}
        return status

    def close(self) -> None:
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def make() -> Iterator[Callable[..., Inside]]:
    made: list[Inside] = []

    def make_one(*arguments: str) -> Inside:
        made.append(Inside(*arguments))
        return made[-1]

    yield make_one
    for inside in made:
        inside.close()


@pytest.fixture(scope="module")
def drive() -> Drive:
    return read_drive(24.0)


@pytest.fixture(scope="module")
def start(drive: Drive) -> Drive:
    """The first eight seconds: at rest."""
    return [message for message in drive if message[0] < drive[0][0] + 8 * SECOND]


def changed(topic: str, data: bytes, change: Callable[[Any], None], frame: str = "") -> bytes:
    """The message after `change` was applied to its row; with another frame unless that is empty."""
    strings = StringTable()
    messages, _ = decode(TYPES[topic], np.frombuffer(data, np.uint8)[None], strings)
    change(messages)
    return bytes(encode(TYPES[topic], messages, [frame, ""] if frame else strings.values)[0])


@needs_ros
def test_the_second_receiver_is_known_by_its_frame(make, drive):
    """Its fixes and velocities get its own time offset and lever arm: as if somebody had told the estimator by hand."""
    offset, arm = 0.4, [-1.5, 0.3, 1.0]
    words = ("second_gnss.frame_id:=rear", f"second_gnss.time_offset:={offset}", f"second_gnss.lever_arm:={arm}")
    inside = make(*(word for given in words for word in ("-p", given)), "-p", "gnss.time_offset:=-0.05")
    reference = Navigator(inside.node.parameters)
    assert inside.node.parameters.second_gnss.lever_arm == tuple(arm)

    def earlier(messages: Any) -> None:
        messages["stamp"] -= round(offset * SECOND)

    for log_time, topic, data in drive:
        copies = [data] if topic == "imu/data" else [data, changed(topic, data, earlier, "rear")]
        for receiver, copy in enumerate(copies):
            inside.play([(log_time, topic, copy)])
            strings = StringTable()
            messages, _ = decode(TYPES[topic], np.frombuffer(copy, np.uint8)[None], strings)
            m, frame = messages[0], ("", "rear")[receiver]
            if topic == "imu/data":
                reference.push_imu(m["stamp"][None], m["linear_acceleration"][None], m["angular_velocity"][None])
            elif topic == "gps/fix":
                place = float(m["latitude"]), float(m["longitude"]), float(m["altitude"])
                covariance, kind, status = (
                    m["position_covariance"],
                    int(m["position_covariance_type"]),
                    int(m["status"]),
                )
                reference.push_gnss_position(int(m["stamp"]), *place, covariance, kind, status, log_time, frame)
            else:
                covariance = m["twist_covariance"].reshape(6, 6)[:3, :3].ravel()
                reference.push_gnss_velocity(int(m["stamp"]), m["linear_velocity"], covariance, log_time, frame)
    assert inside.node.navigator.state.tobytes() == reference.state.tobytes()
    records = reference.finish()
    for stream in (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY):
        assert [np.sum((records["stream"] == stream) & (records["source"] == source)) for source in (0, 1)] == [
            sum(INPUTS.get(topic) == stream.name.lower().replace("position", "fix") for _, topic, _ in drive)
        ] * 2
    status = inside.report()
    assert "sensor clocks differ" not in status.message
    assert {"/gps/fix rate (Hz)", "/gps/fix from rear rate (Hz)"} <= set(inside.values)
    assert float(inside.values["/gps/fix from rear rate (Hz)"]) == pytest.approx(5.0, rel=0.2)
    assert inside.values["fixes of the second receiver"] in ("FUSING", "SUSPICIOUS", "REACQUIRING")
    assert inside.values["place of the second GNSS antenna"] == "parameters"


@needs_ros
def test_the_second_antenna_is_found_on_tf_static(make):
    from test_node_frames import Rotation, transform

    inside = make("-p", "second_gnss.frame_id:=rear", "-p", "gnss.lever_arm:=[0.0, 0.0, 0.0]")
    message = SimpleNamespace(
        transforms=[
            transform("base_link", "front", (1.0, 0.0, 0.5), Rotation.identity()),
            transform("base_link", "rear", (-2.0, 0.0, 0.7), Rotation.identity()),
        ]
    )
    inside.node._on_static_transforms(message)
    fix = next(data for _, topic, data in read_drive(5.0) if topic == "gps/fix")
    inside.give("gps/fix", changed("gps/fix", fix, lambda messages: None, "rear"))
    assert inside.node.parameters.second_gnss.lever_arm == (-2.0, 0.0, 0.7)
    assert inside.node.parameters.gnss.lever_arm == (0.0, 0.0, 0.0)
    inside.give("gps/fix", changed("gps/fix", fix, lambda messages: None, "front"))
    assert inside.node.parameters.gnss.lever_arm == (1.0, 0.0, 0.5)
    assert inside.node.navigator.parameters == inside.node.parameters


@needs_ros
def test_a_place_found_in_time_restarts_nothing_and_one_found_late_does(make, start):
    """A barometer whose first message comes late is placed at once; an antenna that was taken for base_link is not."""
    from test_node_frames import Rotation, transform
    from test_node_inputs import serialised

    pressure = serialised("sensor_msgs/msg/FluidPressure", "baro", stamp=start[-1][0])
    inside = make("-p", "gnss.lever_arm:=[0.0, 0.0, 0.0]")
    inside.node._on_static_transforms(
        SimpleNamespace(transforms=[transform("base_link", "baro", (0.0, 0.5, 0.2), Rotation.identity())])
    )
    inside.play(start)
    inside.give("baro", pressure)
    assert inside.node.parameters.baro.position == (0.0, 0.5, 0.2)
    inside.report()
    assert inside.values["resets"] == "0"
    assert inside.values["place of the barometer"] == "/tf_static"
    assert inside.values["place of the GNSS antenna"] == "taken to be base_link"
    inside.node._on_static_transforms(
        SimpleNamespace(transforms=[transform("base_link", "gps", (1.0, 0.0, 2.0), Rotation.identity())])
    )
    assert inside.node.parameters.gnss.lever_arm == (1.0, 0.0, 2.0)
    inside.report()
    assert inside.values["resets"] == "1"


@needs_ros
@pytest.mark.parametrize(
    ("topic", "type_name", "position"),
    [
        ("body_velocity", TWIST, "mount_position"),
        ("gnss/heading", IMU, ""),
        ("imu/mag", "sensor_msgs/msg/MagneticField", ""),
    ],
)
def test_mountings_are_found_on_tf_static(make, start, topic, type_name, position):
    from test_node_frames import Rotation, transform
    from test_node_inputs import serialised

    inside = make()
    turned = transform(
        "base_link", "sensor", (0.3, 0.1, -0.4), Rotation.from_euler("xyz", (0.0, 0.0, 90.0), degrees=True)
    )
    inside.node._on_static_transforms(SimpleNamespace(transforms=[turned]))
    inside.give(topic, serialised(type_name, "sensor", stamp=start[-1][0]))
    mounted = getattr(inside.node.parameters, topic.split("/")[-1])
    assert mounted.mount_rpy_deg == pytest.approx((0.0, 0.0, 90.0))
    assert not position or getattr(mounted, position) == (0.3, 0.1, -0.4)


@needs_ros
def test_velocities_of_another_type(make, drive):
    """TwistStamped in place of TwistWithCovarianceStamped: fused, with the stand-in for the covariance."""
    from rclpy.serialization import deserialize_message, serialize_message

    inside = make("-p", "topics.gnss_velocity_type:=geometry_msgs/msg/TwistStamped")
    from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped

    bare: Drive = []
    for log_time, topic, data in drive:
        if topic == "gps/vel":
            message = deserialize_message(data, TwistWithCovarianceStamped)
            data = serialize_message(TwistStamped(header=message.header, twist=message.twist.twist))
        bare.append((log_time, topic, data))
    inside.play(bare)
    inside.report()
    assert int(inside.values["gnss_velocity fused"]) > 50
    assert not [key for key in inside.values if key.startswith("trouble")]


def initial_pose(
    x: float, y: float, yaw: float, frame: str = "map", variances: Any = (0.25, 0.25, 0, 0, 0, 0.07)
) -> bytes:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.serialization import serialize_message

    message = PoseWithCovarianceStamped()
    message.header.frame_id = frame
    pose = message.pose.pose
    pose.position.x, pose.position.y = x, y
    pose.orientation.z, pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    message.pose.covariance = np.diag(np.array(variances, float)).ravel()
    return bytes(serialize_message(message))


@needs_ros
def test_a_pose_drawn_in_rviz_moves_the_estimate(make, start):
    """RViz gives variances of x, y and yaw only; the height stays where it was, with the variance it had."""
    inside = make()
    inside.give("initialpose", initial_pose(5.0, -3.0, 2.0))
    assert "initialpose: not used" in inside.report().message
    inside.play(start)
    before = inside.node.navigator.odometry[0]
    inside.give("initialpose", initial_pose(5.0, -3.0, 2.0))
    after = inside.node.navigator.odometry[0]
    z = before["position_map"][2]
    assert after["position_map"] == pytest.approx([5.0, -3.0, z], abs=1e-9)
    w, x, y, q = after["attitude_body_to_map"]
    yaw = math.atan2(2 * (w * q + x * y), 1 - 2 * (y * y + q * q))
    assert yaw == pytest.approx(2.0, abs=1e-3)
    sigma = np.sqrt(np.diagonal(after["pose_covariance"]))
    assert sigma[[0, 1, 5]] == pytest.approx([0.5, 0.5, math.sqrt(0.07)], rel=0.02)
    assert sigma[2] == pytest.approx(math.sqrt(before["pose_covariance"][2, 2]), rel=0.02)
    assert after["status"] >= Status.ALIGNING


@needs_ros
@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"frame": "odom"}, "its frame is 'odom', not 'map'"),
        ({"frame": ""}, "its frame is '', not 'map'"),
        ({"x": math.nan}, "not finite"),
        ({"variances": (0.25, -1.0, 0, 0, 0, 0.07)}, "not positive"),
        ({"variances": (0.25, 0.25, 0, 0, 0, 0.0)}, "not positive"),
    ],
    ids=lambda value: str(value) if isinstance(value, str) else "",
)
def test_a_pose_that_cannot_be_used_changes_nothing_and_is_named(make, start, arguments, why):
    inside = make()
    inside.play(start)
    before = inside.node.navigator.state.tobytes()
    inside.give("initialpose", initial_pose(**{"x": 5.0, "y": -3.0, "yaw": 2.0, **arguments}))
    assert inside.node.navigator.state.tobytes() == before
    assert why in inside.report().message


@needs_ros
def test_an_imu_that_falls_silent_is_an_error(make, drive):
    """The estimate was GOOD, but nothing is published any more: that must not look well."""
    from diagnostic_msgs.msg import DiagnosticStatus

    inside = make()
    inside.play(drive)
    status = inside.report()
    assert (status.message, status.level) == ("GOOD", DiagnosticStatus.OK)
    inside.time += 5 * SECOND
    status = inside.report()
    assert status.message.startswith("WAITING_IMU; no message for 5 s on /imu/data; 0 publishers")
    assert status.level == DiagnosticStatus.ERROR


@needs_ros
def test_the_state_names_what_it_waits_for(make, drive, start):
    inside = make("-p", "alignment.good_heading_std_deg:=0.01")
    assert inside.report().message.startswith("WAITING_IMU; no message on /imu/data; 0 publishers")
    inside.play([message for message in start if message[1] == "imu/data"])
    assert inside.report().message.startswith("WAITING_FIX; no message on /gps/fix; 0 publishers")

    def without_fix(messages: Any) -> None:
        messages["status"] = -1

    lost = make()
    none = [(t, topic, changed(topic, d, without_fix) if topic == "gps/fix" else d) for t, topic, d in start]
    lost.play(none)
    assert lost.report().message.startswith("WAITING_FIX; fixes come, but none was accepted lately (the last: ")
    assert "no_fix): see eskf/aids" in lost.report().message
    inside = make("-p", "alignment.good_heading_std_deg:=0.01")
    inside.play(start)
    assert inside.report().message.startswith("WAITING_HEADING; speeding up, braking or turning tells the heading")
    inside.play(drive[len(start) :])
    assert inside.report().message.startswith("ALIGNING; a heading to 0.01 deg, which is known to 0.")


@needs_ros
def test_what_is_published_says_whose_it_is(make, drive):
    """gps/filtered is a fix (a message is made without one), and biases are in the frame of the IMU."""
    inside = make()
    inside.play(drive)
    inside.report()
    fix, bias = inside.published["/gps/filtered"][-1], inside.published["/imu/bias"][-1]
    assert fix.status.status == fix.status.STATUS_FIX
    assert fix.header.frame_id == "base_link"
    assert fix.position_covariance_type == fix.COVARIANCE_TYPE_KNOWN
    assert bias.header.frame_id == "imu_link"
    row = inside.node.navigator.odometry[0]
    datum = inside.node.navigator.datum
    assert [fix.latitude, fix.longitude, fix.altitude] == pytest.approx(
        MapFrame(datum).to_geodetic_deg(row["position_map"]), abs=1e-9
    )
    stamp = bias.header.stamp.sec * SECOND + bias.header.stamp.nanosec
    assert stamp == fix.header.stamp.sec * SECOND + fix.header.stamp.nanosec == row["stamp"]


@needs_ros
def test_verdicts_are_told_to_who_listens(make, drive):
    """Nobody listens: no message is made. Who begins to listen is told what the history holds, and then each once."""
    inside = make()
    middle = next(k for k, message in enumerate(drive) if message[0] > drive[0][0] + 20 * SECOND)
    inside.play(drive[:middle])
    assert inside.published["/eskf/aids"] == []
    inside.node._aids.get_subscription_count = lambda: 1
    inside.play(drive[middle:])
    told = [status for message in inside.published["/eskf/aids"] for status in message.status]
    values = [{pair.key: pair.value for pair in status.values} for status in told]
    keys = [(status.name, value["stamp"]) for status, value in zip(told, values)]
    assert len(keys) == len(set(keys))
    stamps = [float(value["stamp"]) * SECOND for value in values]
    expected = [m for m in drive if m[1] != "imu/data" and m[0] > drive[middle][0] - SECOND]
    assert len(keys) >= len(expected) - 4
    assert min(stamps) < drive[middle][0] < max(stamps)
    assert {status.message for status, at in zip(told, stamps) if at > drive[middle][0]} == {"fused"}
    assert {value["receiver"] for value in values} == {"0"}


@needs_ros
def test_a_clock_that_is_set_is_told_and_survived(make, drive, start, monkeypatch):
    """All stamps jump ahead by an hour: the alignment begins again with a word, and the estimate finds back."""
    from rclpy.impl.rcutils_logger import RcutilsLogger

    lines: list[str] = []
    inside = make()
    monkeypatch.setattr(RcutilsLogger, "warning", lambda self, text, **options: lines.append(text))
    monkeypatch.setattr(RcutilsLogger, "warn", lambda self, text, **options: lines.append(text))

    def later(messages: Any) -> None:
        messages["stamp"] += 3600 * SECOND

    inside.play(start)
    inside.report()
    assert lines == []
    inside.play([(t + 8 * SECOND, topic, changed(topic, data, later)) for t, topic, data in drive])
    inside.report()
    assert any("the stamps of /imu/data went ahead" in line for line in lines)
    assert any("the alignment began again" in line for line in lines)
    assert inside.values["resets"] == "0"
    assert inside.node.navigator.status == Status.GOOD


@needs_ros
@pytest.mark.parametrize("size", [-60.0, -5.0, -0.5, 5.0])
def test_a_clock_that_is_set_while_time_goes_on_costs_nothing(make, drive, size):
    """All stamps jump, arrivals do not: no reset, no restart, and every sample is answered under its own stamp."""
    inside = make()
    inside.node.steady = lambda: inside.time
    begin = drive[0][0] + 20 * SECOND

    def jump(messages: Any) -> None:
        messages["stamp"] += round(size * SECOND)

    inside.play([message for message in drive if message[0] < begin])
    before = len(inside.published["/odometry/global"])
    inside.play([(t, topic, changed(topic, data, jump)) for t, topic, data in drive if t >= begin])
    message = inside.report().message
    word = "forward" if size > 0.0 else "back"
    assert f"the clock of the IMU's stamps was set {word} by {abs(size):.1f} s" in message
    assert inside.values["resets"] == inside.values["restarts"] == inside.values["position resets"] == "0"
    assert inside.values["imu late"] == inside.values["imu bad_stamp"] == "0"
    count = sum(topic == "imu/data" and t >= begin for t, topic, _ in drive)
    assert len(inside.published["/odometry/global"]) - before == count
    assert inside.node.navigator.quality == Quality.GOOD


@needs_ros
def test_nanoseconds_of_a_second_and_more_are_named(make, start):
    """A driver that adds to the nanoseconds and forgets to carry: the sum is right, and it is told."""

    def uncarried(data: bytes) -> bytes:
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
        return data[:4] + struct.pack("<iI", seconds - 1, nanoseconds + SECOND) + data[12:]

    inside, plain = make(), make()
    inside.play([(t, topic, uncarried(data)) for t, topic, data in start])
    plain.play(start)
    message = inside.report().message
    for topic in ("/imu/data", "gps/fix", "gps/vel"):
        assert f"{topic}: messages have a second or more in header.stamp.nanosec" in message
    assert "nanosec" not in plain.report().message
    assert inside.node.navigator.odometry.tobytes() == plain.node.navigator.odometry.tobytes()


@needs_ros
def test_quality_says_whether_to_go_on(make, drive):
    """Once a second, and at once when it changes: no before the alignment, yes while all agree, no without the IMU."""
    inside = make()
    said = inside.published["/eskf/quality"]

    def of(message: Any) -> dict[str, str]:
        return {pair.key: pair.value for pair in message.values}

    inside.play([message for message in drive if message[0] < drive[0][0] + SECOND])
    inside.report()
    assert (said[-1].level, of(said[-1])["usable"], of(said[-1])["quality"]) == (b"\x02", "no", "NOT_ALIGNED")
    inside.play([message for message in drive if message[0] >= drive[0][0] + SECOND])
    # Said by itself when it became good, without a report.
    assert (said[-1].level, of(said[-1])["usable"], of(said[-1])["quality"]) == (b"\x00", "yes", "GOOD")
    count = len(said)
    inside.report()
    assert len(said) == count + 1
    inside.time += 5 * SECOND
    inside.report()
    assert (said[-1].level, of(said[-1])["usable"]) == (b"\x02", "no")
    assert said[-1].message.startswith("no IMU message has come for 5.")


@needs_ros
def test_a_message_that_comes_too_late_is_named_with_the_window(make, drive):
    inside = make("-p", "history.window:=0.5")
    late = next(k for k, message in enumerate(drive) if message[1] == "gps/fix" and message[0] > drive[0][0] + SECOND)
    inside.play([*drive[:late], *drive[late + 1 : late + 300], drive[late]])
    assert "gnss_position: a message came too late for history.window = 0.5 s (1 time)" in inside.report().message
    assert float(inside.values["window needed (s)"]) > 1.0
    assert inside.values["gnss_position outside_history"] == "1"


@needs_ros
def test_live_parameters_reach_the_estimator(make):
    from rclpy.parameter import Parameter

    inside = make()
    (result,) = inside.node.set_parameters([Parameter("gnss.use_velocity", value=False)])
    assert result.successful
    assert inside.node.navigator.parameters.gnss.use_velocity is False
    (result,) = inside.node.set_parameters([Parameter("gnss.covariance_scale", value=-1.0)])
    assert not result.successful
    assert "gnss.covariance_scale" in result.reason
    assert inside.node.navigator.parameters.gnss.covariance_scale == 1.0


@needs_ros
def test_no_bytes_on_any_topic_end_the_node(make, drive):
    """Random, cut, and damaged messages of every input between good ones: no exception, and finite numbers only."""
    from rclpy.serialization import deserialize_message, serialize_message
    from test_node_inputs import serialised

    inside = make()
    for publisher in inside.node.outputs.publishers:
        inside.published[publisher.topic_name].clear()
    random = np.random.default_rng(5)
    types = {"imu/data": IMU, **{source.name: source.kind.type for source in inside.node.aid_inputs}}
    assert {"initialpose", *types} == set(inside._callbacks)
    topics = ("initialpose", *types)
    for number, message in enumerate(drive[:4000]):
        inside.play([message])
        topic = topics[number % len(topics)]
        pose = topic == "initialpose"
        data = bytearray(
            initial_pose(1.0, 2.0, 3.0) if pose else serialised(types[topic], seed=number, stamp=message[0])
        )
        kind = random.integers(4)
        if kind == 0:
            data[4:] = random.bytes(len(data) - 4)
        elif kind == 1:
            data = data[: random.integers(len(data))]
        elif kind == 2:
            data[random.integers(len(data))] ^= 1 << int(random.integers(8))
        else:
            numbers = int(random.integers(1, 5))
            data[-8 * numbers :] = np.full(numbers, np.nan).tobytes()
        inside.give(topic, bytes(data))
    inside.report()
    assert len(inside.node.trouble.counts) > 5
    published = inside.published["/odometry/local"]
    assert len(published) > 1000
    from nav_msgs.msg import Odometry

    for data in published:
        message = deserialize_message(data, Odometry)
        numbers = np.frombuffer(serialize_message(message)[-37 * 8 :], "<f8")
        assert np.isfinite(numbers).all()
        assert np.isfinite(message.pose.covariance).all()


def test_trouble_is_a_problem_while_it_is_fresh_and_counted_for_ever() -> None:
    now, logged = [100.0], []
    trouble = Trouble(logged.append, lambda: now[0])
    trouble.note("a")
    trouble.note("a")
    now[0] += 0.5 * FRESH
    trouble.note("b")
    assert trouble.problems() == ["a (2 times)", "b (1 time)"]
    now[0] += 0.6 * FRESH
    assert trouble.problems() == ["b (1 time)"]
    now[0] += FRESH
    assert trouble.problems() == []
    trouble.note("a")
    assert trouble.problems() == ["a (3 times)"]
    assert logged == ["a", "b"]
    for number in range(2 * KINDS):
        trouble.note(str(number))
    assert len(trouble.counts) == KINDS == len(logged)
    trouble.note("a")
    assert trouble.counts["a"] == 4


# ---- the services of robot_localization, with messages that are only like its own


class Services:
    """What a node of robot_localization's clients would see."""

    def __init__(self, navigator: Navigator, monkeypatch: pytest.MonkeyPatch) -> None:
        from eskf_ros.ros_node import robot_localization

        kinds = SimpleNamespace(FromLL="FromLL", ToLL="ToLL", SetDatum="SetDatum", SetPose="SetPose")
        monkeypatch.setattr(robot_localization, "services", kinds)
        self.said: list[str] = []
        self.answers: dict[str, Callable[[Any, Any], Any]] = {}
        logger = SimpleNamespace(error=self.said.append, warn=self.said.append)
        node = SimpleNamespace(
            get_logger=lambda: logger,
            create_service=lambda kind, name, answer: self.answers.update({name: answer}),
        )
        robot_localization.RobotLocalizationServices(node, navigator, "map")

    def call(self, name: str, request: Any) -> Any:
        point = SimpleNamespace(x=0.0, y=0.0, z=0.0, latitude=0.0, longitude=0.0, altitude=0.0)
        return self.answers[name](request, SimpleNamespace(map_point=point, ll_point=point))


def point(**numbers: float) -> Any:
    return SimpleNamespace(**numbers)


@needs_ros
def test_services_of_robot_localization_answer(drive, monkeypatch):
    from geometry_msgs.msg import PoseWithCovarianceStamped

    navigator = Navigator(load(CONFIG))
    services = Services(navigator, monkeypatch)
    place = point(latitude=48.0, longitude=11.0, altitude=500.0)
    answer = services.call("fromLL", SimpleNamespace(ll_point=place)).map_point
    assert math.isnan(answer.x)
    assert "not known yet" in services.said[-1]
    assert math.isnan(services.call("toLL", SimpleNamespace(map_point=point(x=0.0, y=0.0, z=0.0))).ll_point.latitude)

    for _, topic, data in drive[:3000]:
        messages, _ = decode(TYPES[topic], np.frombuffer(data, np.uint8)[None], StringTable())
        m = messages[0]
        if topic == "imu/data":
            navigator.push_imu(m["stamp"][None], m["linear_acceleration"][None], m["angular_velocity"][None])
        elif topic == "gps/fix":
            where = float(m["latitude"]), float(m["longitude"]), float(m["altitude"])
            navigator.push_gnss_position(int(m["stamp"]), *where, m["position_covariance"], 2, 0)
    latitude, longitude, altitude = navigator.datum
    place = point(latitude=latitude + 1e-3, longitude=longitude - 1e-3, altitude=altitude + 5.0)
    there = services.call("fromLL", SimpleNamespace(ll_point=place)).map_point
    expected = MapFrame(navigator.datum).from_geodetic_deg(place.latitude, place.longitude, place.altitude)
    assert [there.x, there.y, there.z] == pytest.approx(expected, abs=1e-9)
    back = services.call("toLL", SimpleNamespace(map_point=point(x=there.x, y=there.y, z=there.z))).ll_point
    assert [back.latitude, back.longitude] == pytest.approx([place.latitude, place.longitude], abs=1e-11)
    assert back.altitude == pytest.approx(place.altitude, abs=1e-5)

    pose = PoseWithCovarianceStamped()
    pose.header.frame_id = "map"
    pose.pose.pose.position.x = 12.0
    pose.pose.covariance = np.diag([0.01] * 6).ravel()
    services.call("set_pose", SimpleNamespace(pose=pose))
    assert navigator.odometry[0]["position_map"] == pytest.approx([12.0, 0.0, 0.0], abs=1e-9)
    pose.header.frame_id = "odom"
    pose.pose.pose.position.x = 50.0
    services.call("set_pose", SimpleNamespace(pose=pose))
    assert "the frame is 'odom', not map" in services.said[-1]
    assert navigator.odometry[0]["position_map"][0] == pytest.approx(12.0, abs=1e-9)

    nowhere = point(latitude=math.nan, longitude=0.0, altitude=0.0)
    services.call("datum", SimpleNamespace(geo_pose=SimpleNamespace(position=nowhere)))
    assert "no place" in services.said[-1]
    services.call("datum", SimpleNamespace(geo_pose=SimpleNamespace(position=place)))
    assert navigator.datum == pytest.approx((place.latitude, place.longitude, place.altitude))
    services.call("datum", SimpleNamespace())
    assert "AttributeError" in services.said[-1]


@needs_ros
@pytest.mark.parametrize("use", ["unused", "true_north"])
def test_the_orientation_of_the_imu_tells_the_heading_if_asked_to(make, start, use):
    """A parked robot knows which way it stands; nobody asks an IMU that was not named as a source."""
    inside = make("-p", f"alignment.imu_orientation:={use}")
    yaw = math.radians(70.0)

    def oriented(messages: Any) -> None:
        messages["orientation"] = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        messages["orientation_covariance"] = 0.0

    inside.play(
        [(t, topic, changed(topic, data, oriented) if topic == "imu/data" else data) for t, topic, data in start]
    )
    row = inside.node.navigator.odometry[0]
    assert bool(row["heading_known"]) == (use == "true_north")
    if use == "true_north":
        w, x, y, z = row["attitude_body_to_map"]
        found = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        # The x axis of base_link, as the IMU, mounted askew, says it points.
        x, y, _ = inside.node.navigator._settings["imu_to_base"][0, 0]
        told = yaw + math.atan2(y, x)
        std = math.sqrt(row["pose_covariance"][5, 5])
        assert std < math.radians(15.0)
        assert abs(math.remainder(found - told, math.tau)) < 3.0 * std


@needs_ros
def test_smoothed_odometry_comes_late_and_surer(make):
    """With a lag, each position comes again: in order, at 50 Hz, not later than lag and window say, and surer."""
    inside = make("-p", "smoother.lag:=3.0")
    drive = read_drive(50.0)
    begin = drive[0][0]
    for second in range(51):
        inside.play([m for m in drive if begin + second * SECOND <= m[0] < begin + (second + 1) * SECOND])
        inside.report()
    name = next(topic for topic in inside.published if topic.endswith("odometry/smoothed"))
    strings = StringTable()
    kind = "nav_msgs/msg/Odometry"
    live, smoothed = (
        np.concatenate(
            [decode(kind, np.frombuffer(data, np.uint8)[None], strings)[0] for data in inside.published[topic]]
        )
        for topic in (name.replace("smoothed", "global"), name)
    )
    assert set(np.diff(smoothed["stamp"][1:]).tolist()) == {20_000_000}
    assert 4 * SECOND < live["stamp"][-1] - smoothed["stamp"][-1] < 7 * SECOND
    _, first, second = np.intersect1d(live["stamp"], smoothed["stamp"], return_indices=True)
    variance = [rows["pose_covariance"].reshape(-1, 36)[i, 0] for rows, i in ((live, first), (smoothed, second))]
    # The car stands for 20 s; then it needs some to find its heading.
    assert np.median((variance[1] / variance[0])[-500:]) < 0.8
    assert make().node.fixed_lag is None
