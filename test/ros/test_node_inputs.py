"""The table of inputs: the parameters it needs exist, and a message says the same to the node and to the replay."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from eskf_ros.bags import Batch, StringTable, decode, encode, message_dtype
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.settings import intakes_from
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.gnss.cloud import fields_of, write_epoch
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, SATELLITE_KNOWN, allocate_ranges
from eskf_ros.gnss.ranges import Status as RangeStatus
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.inputs.table import FIXES, INPUTS, RANGES
from eskf_ros.parameters.mapping import Leaf, from_mapping, leaves
from eskf_ros.parameters.schema import ParameterError
from eskf_ros.parameters.tree import Parameters
from support.ros_process import needs_ros

SECOND = 1_000_000_000
STAMP = 1_700_000_000_123_456_789
LEAVES: dict[str, Leaf] = {leaf.name: leaf for leaf in leaves()}
EVERY_TYPE = [(kind, name) for kind in INPUTS if kind.name not in RANGES for name in kind.types]
names = [f"{kind.name}-{name.rpartition('/')[2]}" for kind, name in EVERY_TYPE]


def serialised(type_name: str, frame: str = "sensor", seed: int = 1, stamp: int = STAMP) -> bytes:
    """A message with a different number in every place, in the layout of the recordings."""
    generator = np.random.default_rng(seed)
    message = np.zeros(1, message_dtype(type_name))
    for field in message.dtype.names or ():
        kind = message.dtype[field].base.kind
        message[field] = generator.normal(size=message[field].shape) if kind == "f" else 1
    message["stamp"] = stamp
    if "child_frame_id" in (message.dtype.names or ()):
        message["frame_id"], message["child_frame_id"] = 0, 1
    else:
        message["frame_id"] = 0
    return bytes(encode(type_name, message, [frame, "child"])[0])


def test_every_input_has_its_parameters() -> None:
    for kind in INPUTS:
        assert f"topics.{kind.name}" in LEAVES
        choice = LEAVES.get(f"topics.{kind.name}_type")
        assert (choice.rule.pattern.split("|") if choice else [kind.type]) == list(kind.types)
        assert kind.name in RANGES or kind.stream in intakes_from(Parameters())
    # Ephemerides are no measurements: they have no stream of their own.
    assert len({kind.name for kind in INPUTS}) == len({kind.stream for kind in INPUTS}) + 1 == len(INPUTS)
    assert {name for name in LEAVES if name.startswith("topics.") and name.endswith("_type")} == {
        f"topics.{kind.name}_type" for kind in INPUTS if kind.others
    }


def arguments_in_a_recording(kind: Any, type_name: str, data: bytes, arrival: int) -> list[Any]:
    strings = StringTable(["of another topic"])
    messages, valid = decode(type_name, np.frombuffer(data, np.uint8)[None], strings)
    assert valid is None
    return list(kind.of_type(type_name).arguments(Batch(np.array([arrival]), messages, strings.values)))


def same(a: Any, b: Any) -> bool:
    return np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else type(a) is type(b) and a == b


@needs_ros
@pytest.mark.parametrize(("kind", "type_name"), EVERY_TYPE, ids=names)
def test_node_and_replay_give_the_estimator_the_same_numbers(kind: Any, type_name: str) -> None:
    """A message that the message library has serialised, of every input in every type; and it has what was sent."""
    from rclpy.serialization import deserialize_message, serialize_message

    from eskf_ros.ros_node.subscriptions import AidInput, message_class

    choice = {f"topics.{kind.name}_type": type_name} if kind.others else {}
    source = AidInput(kind, from_mapping(choice), "topic")
    for seed, frame in enumerate(("sensor", "", "gps/antenna_2", "größe")):
        message = deserialize_message(serialised(type_name, frame, seed), message_class(type_name))
        data = serialize_message(message)
        batch = source.read(data, 5)
        assert batch.strings[int(batch.messages["frame_id"][0])] == frame
        (found,) = source.arguments(batch)
        (expected,) = arguments_in_a_recording(kind, type_name, data, 5)
        assert len(found) == len(expected)
        assert all(map(same, found, expected))
        assert found[0] == message.header.stamp.sec * SECOND + message.header.stamp.nanosec == STAMP
        kind.push_of(Navigator(Parameters()))(*found)


@needs_ros
@pytest.mark.parametrize(("kind", "type_name"), EVERY_TYPE, ids=names)
def test_what_is_no_message_is_refused_and_other_encodings_are_read(kind: Any, type_name: str) -> None:
    from eskf_ros.ros_node.subscriptions import AidInput

    choice = {f"topics.{kind.name}_type": type_name} if kind.others else {}
    source = AidInput(kind, from_mapping(choice), "topic")
    good = serialised(type_name)
    for bad in (b"", good[:3], good[:11], good[: len(good) // 2], b"\x7f" * 40):
        with pytest.raises(Exception, match=r".+"):
            source.read(bad, 5)
    (expected,) = source.arguments(source.read(good, 5))
    padded = good[:2] + b"\x00\x03" + good[4:]  # the padding at the end, counted in the options
    (found,) = source.arguments(source.read(padded, 5))
    assert all(map(same, found, expected))


@needs_ros
def test_clouds_reach_the_navigator_as_in_the_replay() -> None:
    """A cloud of ranges, serialised by the message library, read by the node and as in a recording."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import PointCloud2, PointField

    from eskf_ros.ros_node.subscriptions import open_inputs

    ranges = allocate_ranges(4)
    ranges["sv_id"], ranges["signal"] = np.arange(1, 5), 0
    ranges["satellite"] = 2.6e7 * np.eye(4, 3) + (1e5, 2e5, 3e5)
    ranges["satellite"][3] = 1.5e7
    ranges["satellite_velocity"], ranges["satellite_clock_drift"] = 1000.0, 0.0
    ranges["pseudorange"], ranges["doppler"], ranges["satellite_clock"] = 2.3e7, 100.0, 1e-4
    ranges["flags"] = CODE_VALID | DOPPLER_VALID | SATELLITE_KNOWN
    points = write_epoch(ranges, 2300, 1000.0, satellites=True)
    message = PointCloud2(height=1, width=4, point_step=points.itemsize, row_step=4 * points.itemsize, is_dense=True)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(STAMP, SECOND)
    message.fields = [
        PointField(name=f.name, offset=f.offset, datatype=f.datatype, count=f.length) for f in fields_of(points.dtype)
    ]
    message.data = points.tobytes()
    data = serialize_message(message)
    (source,) = (source for source in open_inputs(from_mapping({"mode": "tight"}), str) if source.kind.name == "ranges")
    ((stamp, found, arrival),) = source.arguments(source.read(data, 5))
    (expected,) = arguments_in_a_recording(source.kind, source.kind.type, data, 5)
    assert (stamp, arrival) == (STAMP, 5) == (expected[0], expected[2])
    assert found.tobytes() == expected[1].tobytes() == points.tobytes()
    navigator = Navigator(from_mapping({"mode": "tight"}))
    source.kind.push_of(navigator, RangeIntake(navigator, navigator.parameters))(stamp, found, arrival)
    assert navigator.range_statuses[RangeStatus.USABLE] == 4


def test_a_velocity_without_covariance_takes_the_stand_in() -> None:
    """TwistStamped has none: the estimator is told so, and not that the velocity is exact."""
    (kind,) = (kind for kind in INPUTS if kind.stream == Stream.GNSS_VELOCITY)
    data = serialised("geometry_msgs/msg/TwistStamped")
    (arguments,) = arguments_in_a_recording(kind, "geometry_msgs/msg/TwistStamped", data, 5)
    assert not np.any(arguments[2])
    navigator = Navigator(from_mapping({"gnss.unknown_velocity_std": 0.7}))
    kind.push_of(navigator)(*arguments)
    (waiting,) = navigator.finish()
    assert waiting["verdict"] == Verdict.WAITING
    assert navigator._offered[0]["payload"][[3, 6, 8]].tolist() == [0.7**2] * 3


@needs_ros
def test_each_receiver_has_its_own_offset_and_its_own_clock() -> None:
    from eskf_ros.ros_node.subscriptions import open_inputs

    given = {
        "gnss.time_offset": -0.1,
        "second_gnss.frame_id": "rear",
        "second_gnss.time_offset": -3.0,
        "wheel.time_offset": 0.25,
    }
    inputs = {source.kind.name: source for source in open_inputs(from_mapping(given), lambda name: f"/{name}")}
    fixes, wheel = inputs["gnss_fix"], inputs["wheel"]
    assert (fixes.receiver("front"), fixes.receiver("rear"), wheel.receiver("rear")) == (0, 1, 0)
    assert (fixes.offset(0), fixes.offset(1), wheel.offset(0)) == (-SECOND // 10, -3 * SECOND, SECOND // 4)
    assert [monitor.label for monitor in fixes.monitors] == ["/gps/fix", "/gps/fix from rear"]
    assert [monitor.topic for monitor in fixes.monitors] == ["/gps/fix", "/gps/fix"]
    assert len(wheel.monitors) == 1
    # Without a second receiver every frame is that of the first, the empty one too.
    one = {source.kind.name: source for source in open_inputs(Parameters(), str)}["gnss_fix"]
    assert (one.receiver(""), one.receiver("rear"), len(one.monitors)) == (0, 0, 1)


@needs_ros
@pytest.mark.parametrize("change", [{"mode": "tight"}, {"ranges.use_point_solution": True}])
def test_beside_ranges_the_node_listens_to_the_fixes_of_a_second_receiver_only(change: dict[str, Any]) -> None:
    from eskf_ros.ros_node.subscriptions import open_inputs

    def heard(given: dict[str, Any]) -> set[str]:
        return {source.kind.name for source in open_inputs(from_mapping(given), str)} & {*RANGES, *FIXES}

    assert heard({}) == heard({"second_gnss.frame_id": "rear"}) == set(FIXES)
    assert heard(change) == set(RANGES)
    assert heard({**change, "second_gnss.frame_id": "rear"}) == {*RANGES, *FIXES}


@needs_ros
def test_a_type_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from eskf_ros.ros_node.subscriptions import open_inputs

    monkeypatch.setitem(sys.modules, "nav_msgs.msg", None)
    with pytest.raises(ParameterError, match=r"topics\.wheel_type.*nav_msgs/msg/Odometry is not installed"):
        open_inputs(Parameters(), str)
