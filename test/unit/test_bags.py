"""Recordings: what we write others read, what others write we read, and damage never costs more than what it hit."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import operator
import shutil
import sqlite3
import struct
import tracemalloc
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as LibraryWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from eskf_ros.bags import (
    MESSAGE_TYPES,
    BagError,
    BagReader,
    BagWriter,
    StringTable,
    decode,
    encode,
    message_dtype,
    open_bag,
)

IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
ODOMETRY = "nav_msgs/msg/Odometry"
COMPRESSIONS = ("zstd", "lz4", "none")
STORE = get_typestore(Stores.ROS2_JAZZY)
START = 1_720_000_000_123_456_789
FRAMES = ("imu_link", "map", "", "a_frame_id_of_another_length", "länge", "base_link")


def random_messages(type_name: str, count: int, seed: int = 0, frames: int = 1) -> np.ndarray:
    """Messages of random bits (NaN and infinity among them) with stamps 5 ms apart."""
    rng = np.random.default_rng(seed)
    dtype = message_dtype(type_name)
    messages = np.frombuffer(rng.bytes(count * dtype.itemsize), dtype).copy()
    messages["stamp"] = START + 5_000_000 * np.arange(count) - 3_000_000
    for field in MESSAGE_TYPES[type_name]:
        if field.code == "string":
            messages[field.name] = rng.integers(0, frames, count)
    return messages


def log_times(count: int) -> np.ndarray:
    return START + 5_000_000 * np.arange(count)


def bits(value: Any) -> bytes:
    return struct.pack("<d", value) if isinstance(value, float) else repr(value).encode()


def flat(messages: np.ndarray, strings: Sequence[str]) -> list[list[bytes]]:
    """Every message as the list of its numbers and strings, in the order of the definition."""
    text = {field.name for field in MESSAGE_TYPES[type_of(messages)] if field.code == "string"}
    columns = []
    for name in messages.dtype.names or ():
        values = messages[name].reshape(len(messages), -1).tolist()
        columns.append([[strings[row[0]]] for row in values] if name in text else values)
    return [[bits(value) for part in parts for value in part] for parts in zip(*columns, strict=True)]


def type_of(messages: np.ndarray) -> str:
    return next(name for name in MESSAGE_TYPES if message_dtype(name) == messages.dtype)


def flat_ros(message: Any) -> list[bytes]:
    """The same of a message as the rosbags library deserialises it."""
    if hasattr(message, "nanosec"):
        return [bits(message.sec * 1_000_000_000 + message.nanosec)]
    parts: list[bytes] = []
    for name, _ in STORE.fielddefs[message.__msgtype__][1]:
        value = getattr(message, name)
        if dataclasses.is_dataclass(value):
            parts += flat_ros(value)
        elif isinstance(value, np.ndarray):
            parts += [bits(number) for number in value.tolist()]
        else:
            parts.append(bits(value))
    return parts


def payloads(type_name: str, messages: np.ndarray, strings: Sequence[str] = FRAMES) -> list[bytes]:
    encoded = encode(type_name, messages, strings)
    return [bytes(row) for row in encoded]


def read(reader: BagReader, topics: dict[str, str]) -> dict[str, tuple[list[int], list[list[bytes]]]]:
    """Everything of some topics; checks on the way that batches do not overlap and are sorted."""
    result: dict[str, tuple[list[int], list[list[bytes]]]] = {topic: ([], []) for topic in topics}
    previous = None
    for batch in reader.batches(topics):
        assert batch
        first = min(int(part.log_time[0]) for part in batch.values())
        assert previous is None or first > previous
        previous = max(int(part.log_time[-1]) for part in batch.values())
        for topic, part in batch.items():
            assert len(part.log_time) == len(part.messages) > 0
            assert (part.log_time[1:] >= part.log_time[:-1]).all()
            result[topic][0].extend(part.log_time.tolist())
            result[topic][1].extend(flat(part.messages, part.strings))
    assert reader.bytes_done == reader.bytes_total
    return result


def write_ours(path: Path, count: int = 1000, compression: str = "zstd", step: int = 100) -> np.ndarray:
    messages = random_messages(IMU, count)
    with BagWriter(path, compression) as writer:
        handle = writer.add_topic("/imu/data", IMU)
        for begin in range(0, count, step):
            part = slice(begin, begin + step)
            writer.write(handle, log_times(count)[part], messages[part], FRAMES)
    return messages


def write_library(
    path: Path, rows: Iterable[tuple[str, int, bytes]], type_name: str = IMU, encoding: str = "cdr", **options: Any
) -> None:
    """A file of the mcap library: (topic, log time, payload) in this order."""
    with path.open("wb") as file:
        writer = LibraryWriter(file, **{"chunk_size": 20_000, **options})
        writer.start("ros2")
        definition, _ = STORE.generate_msgdef(type_name, ros_version=2)
        schema = writer.register_schema(type_name, "ros2msg", definition.encode())
        channels: dict[str, int] = {}
        for topic, time, data in rows:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], time, data, time)
        writer.finish()


def write_rosbags(
    path: Path, storage: StoragePlugin, mode: CompressionMode, messages: np.ndarray, times: np.ndarray
) -> None:
    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/imu/data", type_of(messages), typestore=STORE)
        for time, data in zip(times.tolist(), payloads(type_of(messages), messages), strict=True):
            writer.write(connection, time, data)


@pytest.mark.parametrize("frames", [1, len(FRAMES)])
@pytest.mark.parametrize("type_name", MESSAGE_TYPES)
def test_encoding_is_that_of_rosbags(type_name: str, frames: int) -> None:
    messages = random_messages(type_name, 50, frames=frames)
    for data, expected in zip(payloads(type_name, messages), flat(messages, FRAMES), strict=True):
        message = STORE.deserialize_cdr(data, type_name)
        assert flat_ros(message) == expected
        assert bytes(STORE.serialize_cdr(message, type_name)) == data


@pytest.mark.parametrize(
    ("type_name", "places"),
    [
        (IMU, {"angular_velocity": "angular_velocity.x", "linear_acceleration": "linear_acceleration.x"}),
        (FIX, {"latitude": "latitude", "longitude": "longitude", "altitude": "altitude"}),
        ("sensor_msgs/msg/FluidPressure", {"fluid_pressure": "fluid_pressure", "variance": "variance"}),
        (
            "geometry_msgs/msg/TwistStamped",
            {"linear_velocity": "twist.linear.x", "angular_velocity": "twist.angular.x"},
        ),
        (
            "geometry_msgs/msg/TwistWithCovarianceStamped",
            {"linear_velocity": "twist.twist.linear.x", "angular_velocity": "twist.twist.angular.x"},
        ),
        (ODOMETRY, {"pose_covariance": "pose.covariance", "twist_covariance": "twist.covariance"}),
    ],
)
def test_fields_of_equal_form_are_not_taken_for_each_other(type_name: str, places: dict[str, str]) -> None:
    messages = np.zeros(1, message_dtype(type_name))
    for number, name in enumerate(places):
        messages[name] = number + 1.0
    message = STORE.deserialize_cdr(payloads(type_name, messages)[0], type_name)
    for number, place in enumerate(places.values()):
        assert np.ravel(operator.attrgetter(place)(message))[0] == number + 1.0


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("type_name", MESSAGE_TYPES)
def test_decoding_mixed_byte_orders_strings_and_damage(type_name: str, little_endian: bool) -> None:
    messages = random_messages(type_name, 60, frames=2)
    messages["frame_id"] *= 3  # "imu_link" and the long one: two payload lengths, decoded apart
    for frame in (0, 3):
        part = messages[messages["frame_id"] == frame]
        if "child_frame_id" in (part.dtype.names or ()):
            part["child_frame_id"] = 0
        data = payloads(type_name, part)
        swapped = [
            bytes(STORE.serialize_cdr(STORE.deserialize_cdr(row, type_name), type_name, little_endian=little_endian))
            for row in data
        ]
        rows = np.frombuffer(b"".join(x for pair in zip(data, swapped, strict=True) for x in pair), np.uint8)
        rows = rows.reshape(2 * len(part), -1).copy()
        rows[4, :2] = (0, 99)  # no encapsulation we know
        rows[7, 12:16] = 0xFF  # an impossible string length
        strings = StringTable()
        decoded, valid = decode(type_name, rows, strings)
        assert valid is not None
        assert np.flatnonzero(~valid).tolist() == [4, 7]
        expected = flat(np.repeat(part, 2), FRAMES)
        found = flat(decoded[valid], strings.values)
        assert found == [row for number, row in enumerate(expected) if number not in (4, 7)]


@pytest.mark.parametrize("missing", [1, 8, 1000])
@pytest.mark.parametrize("type_name", MESSAGE_TYPES)
def test_payloads_too_short_for_their_type_are_invalid(type_name: str, missing: int) -> None:
    whole = np.frombuffer(payloads(type_name, random_messages(type_name, 1))[0], np.uint8)
    for length in {0, 3, 11, max(0, len(whole) - missing)}:
        _, valid = decode(type_name, np.tile(whole[:length], (5, 1)), StringTable())
        assert valid is not None
        assert not valid.any()
    assert decode(type_name, np.tile(whole, (5, 1)), StringTable())[1] is None


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("type_name", MESSAGE_TYPES)
def test_written_files_are_read_by_the_libraries_and_by_us(tmp_path: Path, type_name: str, compression: str) -> None:
    path = tmp_path / "ours.mcap"
    messages, times = random_messages(type_name, 1500, frames=2), log_times(1500)
    with BagWriter(path, compression) as writer:
        handle = writer.add_topic("/topic", type_name)
        for begin in range(0, 1500, 400):
            part = slice(begin, begin + 400)
            writer.write(handle, times[part], messages[part], FRAMES)
    expected = flat(messages, FRAMES)

    with path.open("rb") as file:
        library = make_reader(file, validate_crcs=True)
        summary = library.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 1500
        assert {index.compression for index in summary.chunk_indexes} == {"" if compression == "none" else compression}
        found = list(library.iter_messages())
        assert [message.log_time for *_, message in found] == times.tolist()
        assert [flat_ros(STORE.deserialize_cdr(message.data, type_name)) for *_, message in found] == expected
        assert {schema.name for schema, *_ in found if schema} == {type_name}
        assert [record.name for record in library.iter_metadata()] == ["rosbag2"]
    with path.open("rb") as file:  # front to back, each checksum looked at
        records = list(StreamReader(file, validate_crcs=True, emit_chunks=True).records)
        assert sum(isinstance(record, Chunk) for record in records) == len(summary.chunk_indexes)

    with Reader(path) as rosbags:
        assert rosbags.message_count == 1500
        found_rosbags = [
            (time, flat_ros(STORE.deserialize_cdr(data, type_name))) for _, time, data in rosbags.messages()
        ]
        assert found_rosbags == list(zip(times.tolist(), expected, strict=True))

    with open_bag([path]) as reader:
        assert {name: (info.type, info.count) for name, info in reader.topics.items()} == {"/topic": (type_name, 1500)}
        assert (reader.start_time, reader.end_time) == (times[0], times[-1])
        assert read(reader, {"/topic": type_name})["/topic"] == (times.tolist(), expected)
        assert reader.warnings == []


def test_topics_written_in_turn_lie_sorted_in_common_chunks(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    fast, slow = random_messages(ODOMETRY, 6000), random_messages(FIX, 30)
    fast_times, slow_times = log_times(6000), log_times(6000)[::200] + 1
    with BagWriter(path) as writer:
        first, second = writer.add_topic("/odom", ODOMETRY), writer.add_topic("/fix", FIX)
        writer.write(first, fast_times, fast, FRAMES)
        writer.write(second, slow_times, payloads(FIX, slow))
        writer.write(second, slow_times[:0], slow[:0], FRAMES)
    times = []
    with path.open("rb") as file:
        for record in StreamReader(file).records:
            if isinstance(record, Message):
                times.append(record.log_time)
    assert times == sorted([*fast_times.tolist(), *slow_times.tolist()])
    with open_bag([path]) as reader:
        found = read(reader, {"/odom": ODOMETRY, "/fix": FIX})
    assert found["/odom"] == (fast_times.tolist(), flat(fast, FRAMES))
    assert found["/fix"] == (slow_times.tolist(), flat(slow, FRAMES))


def test_topics_written_one_after_the_other_are_merged_on_reading(tmp_path: Path) -> None:
    # 60 MB each: more than the writer keeps back, so the chunks of the second lie behind those of the first.
    path, count = tmp_path / "long.mcap", 80_000
    messages, times = random_messages(ODOMETRY, 1000), log_times(count)
    with BagWriter(path, "none") as writer:
        for topic in ("/a", "/b"):
            handle = writer.add_topic(topic, ODOMETRY)
            for begin in range(0, count, 1000):
                writer.write(handle, times[begin : begin + 1000], messages, FRAMES)
    with open_bag([path]) as reader:
        previous, counts = 0, {"/a": 0, "/b": 0}
        for batch in reader.batches({"/a": ODOMETRY, "/b": ODOMETRY}):
            assert min(part.log_time[0] for part in batch.values()) > previous
            previous = max(part.log_time[-1] for part in batch.values())
            for topic, part in batch.items():
                begin = counts[topic]
                assert (part.log_time == times[begin : begin + len(part.log_time)]).all()
                counts[topic] += len(part.log_time)
        assert counts == {"/a": count, "/b": count}


def test_the_same_calls_give_the_same_bytes(tmp_path: Path) -> None:
    for compression in COMPRESSIONS:
        contents = []
        for name in ("first", "second"):
            (tmp_path / name).mkdir(exist_ok=True)
            write_ours(tmp_path / name / "same.mcap", compression=compression)
            contents.append((tmp_path / name / "same.mcap").read_bytes())
        assert contents[0] == contents[1]


STORAGES = [
    (StoragePlugin.MCAP, CompressionMode.NONE),
    (StoragePlugin.MCAP, CompressionMode.STORAGE),
    (StoragePlugin.SQLITE3, CompressionMode.NONE),
    (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    (StoragePlugin.SQLITE3, CompressionMode.FILE),
]


@pytest.mark.parametrize(("storage", "mode"), STORAGES)
@pytest.mark.parametrize("frames", [1, len(FRAMES)])
def test_bags_of_rosbags_are_read(tmp_path: Path, storage: StoragePlugin, mode: CompressionMode, frames: int) -> None:
    messages, times = random_messages(IMU, 9000, frames=frames), log_times(9000)
    write_rosbags(tmp_path / "bag", storage, mode, messages, times)
    with open_bag([tmp_path / "bag"]) as reader:
        assert reader.topics["/imu/data"].count == 9000
        assert (reader.start_time, reader.end_time) == (times[0], times[-1])
        assert read(reader, {"/imu/data": IMU})["/imu/data"] == (times.tolist(), flat(messages, FRAMES))
        assert reader.warnings == []
        again = sum(len(batch["/imu/data"].log_time) for batch in reader.batches({"/imu/data": IMU}))
        assert again == 9000
    for file in (tmp_path / "bag").glob("*.mcap" if storage == StoragePlugin.MCAP else "*.db3"):
        with open_bag([file]) as reader:
            assert reader.topics["/imu/data"].count == 9000


UNUSUAL = {
    "lz4": {"compression": CompressionType.LZ4},
    "zstd": {"compression": CompressionType.ZSTD},
    "unchunked": {"use_chunking": False},
    "no index": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.CHUNK},
    "no chunk index": {"index_types": IndexType.MESSAGE},
    "no statistics": {"use_statistics": False},
    "no channels in the summary": {"repeat_channels": False},
    "no schemas in the summary": {"repeat_schemas": False},
    "no summary": {
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "index_types": IndexType.NONE,
        "use_summary_offsets": False,
    },
    "no checksums": {"enable_crcs": False},
}


@pytest.mark.parametrize("options", UNUSUAL.values(), ids=UNUSUAL.keys())
def test_unusual_mcap_files_are_read(tmp_path: Path, options: dict[str, Any]) -> None:
    messages, times = random_messages(IMU, 500, frames=len(FRAMES)), log_times(500).tolist()
    data = payloads(IMU, messages)
    rows = [(topic, time, row) for time, row in zip(times, data, strict=True) for topic in ("/other", "/imu/data")]
    write_library(tmp_path / "unusual.mcap", rows, **options)
    with open_bag([tmp_path / "unusual.mcap"]) as reader:
        assert {name: (info.type, info.count) for name, info in reader.topics.items()} == {
            "/imu/data": (IMU, 500),
            "/other": (IMU, 500),
        }
        assert (reader.start_time, reader.end_time) == (times[0], times[-1])
        assert read(reader, {"/imu/data": IMU})["/imu/data"] == (times, flat(messages, FRAMES))
        assert reader.warnings == []


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10_000), spread=st.sampled_from([1, 5, 50, 500]), chunk=st.sampled_from([500, 5_000, 20_000])
)
def test_overlapping_chunks_come_out_in_time_order(tmp_path: Path, seed: int, spread: int, chunk: int) -> None:
    # Times that go back by up to `spread` messages, equal ones among them: sorted, file order among equals.
    rng = np.random.default_rng(seed)
    times = START + 1000 * (np.arange(300) + rng.integers(-spread, spread + 1, 300))
    messages = random_messages(IMU, 300, seed)
    data = payloads(IMU, messages)
    write_library(
        tmp_path / "bag.mcap",
        [("/imu/data", int(t), row) for t, row in zip(times, data, strict=True)],
        chunk_size=chunk,
    )
    order = np.argsort(times, kind="stable")
    with open_bag([tmp_path / "bag.mcap"]) as reader:
        found = read(reader, {"/imu/data": IMU})["/imu/data"]
    assert found == (times[order].tolist(), flat(messages[order], FRAMES))


def test_small_batches_also_with_overlapping_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eskf_ros.bags.reader._BATCH_MESSAGES", 1)
    test_overlapping_chunks_come_out_in_time_order.hypothesis.inner_test(tmp_path, 3, 50, 5_000)  # type: ignore[attr-defined]


def split_bag(directory: Path, messages: np.ndarray, times: np.ndarray, parts: int = 3) -> None:
    directory.mkdir()
    names = []
    for number, chosen in enumerate(np.array_split(np.arange(len(times)), parts)):
        names.append(f"split_{number}.mcap")
        with BagWriter(directory / names[-1]) as writer:
            writer.write(writer.add_topic("/imu/data", IMU), times[chosen], messages[chosen], FRAMES)
    listed = "".join(f"    - {name}\n" for name in names)
    (directory / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  relative_file_paths:\n{listed}"
    )


def test_split_bags(tmp_path: Path) -> None:
    messages, times = random_messages(IMU, 3000), log_times(3000)
    bag = tmp_path / "split"
    split_bag(bag, messages, times)
    with open_bag([bag]) as reader:
        assert read(reader, {"/imu/data": IMU})["/imu/data"] == (times.tolist(), flat(messages, FRAMES))
    # The files by name, in any order, are the same recording.
    with open_bag(sorted(bag.glob("*.mcap"), reverse=True)) as reader:
        assert read(reader, {"/imu/data": IMU})["/imu/data"] == (times.tolist(), flat(messages, FRAMES))
    # Without metadata.yaml (the recorder was killed), and with a broken one: a warning.
    (bag / "metadata.yaml").rename(tmp_path / "metadata.yaml")
    with open_bag([bag]) as reader:
        assert reader.topics["/imu/data"].count == 3000
        assert "metadata.yaml" in reader.warnings[0]
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    with open_bag([bag]) as reader:
        assert reader.topics["/imu/data"].count == 3000
        assert "metadata.yaml" in reader.warnings[0]
    # One file gone, one no bag: the rest is used.
    shutil.copy(tmp_path / "metadata.yaml", bag)
    (bag / "split_1.mcap").unlink()
    (bag / "split_2.mcap").write_text("nonsense")
    with open_bag([bag]) as reader:
        assert reader.topics["/imu/data"].count == 1000
        assert [("split_1.mcap" in line, "split_2.mcap" in line) for line in reader.warnings] == [
            (True, False),
            (False, True),
        ]


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("empty.mcap", b"", "the file is empty"),
        ("notes.txt", b"these are my notes\n", "not a ROS 2 recording"),
        ("old.bag", b"#ROSBAG V2.0\n", "rosbags-convert"),
        ("cut.mcap", b"\x89MCAP0\r\n", "no messages"),
        ("broken.db3", b"SQLite format 3\x00" + bytes(500), "cannot be read as a rosbag2 sqlite3 file"),
    ],
)
def test_what_is_no_recording_is_said_in_one_line(tmp_path: Path, name: str, content: bytes, expected: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(BagError, match=expected) as caught:
        open_bag([path])
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_empty_recordings(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"missing\.mcap: No such file"):
        open_bag([tmp_path / "missing.mcap"])
    with pytest.raises(BagError, match="not a ROS 2 recording"):
        open_bag([tmp_path])
    with BagWriter(tmp_path / "empty.mcap") as writer:
        writer.add_topic("/imu/data", IMU)
    with pytest.raises(BagError, match="holds no messages"):
        open_bag([tmp_path / "empty.mcap"])
    with contextlib.closing(sqlite3.connect(tmp_path / "other.db3")) as database:
        database.execute("CREATE TABLE people(name TEXT)")
    with pytest.raises(BagError, match="no such table: topics"):
        open_bag([tmp_path / "other.db3"])
    write_rosbags(tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE, random_messages(IMU, 0), log_times(0))
    with pytest.raises(BagError, match="holds no messages"):
        open_bag([tmp_path / "bag"])
    with pytest.raises(BagError, match="cannot be written"):
        BagWriter(tmp_path / "nowhere" / "a.mcap")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("count", [1, 20_000])
def test_a_full_disk_is_said(count: int) -> None:
    with (
        pytest.raises(BagError, match=r"/dev/full: cannot be written .No space left"),
        BagWriter(Path("/dev/full")) as w,
    ):
        w.write(w.add_topic("/odom", ODOMETRY), log_times(count), random_messages(ODOMETRY, count), FRAMES)


def test_wrong_topics_types_and_encodings_are_named(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    write_ours(path)
    with open_bag([path]) as reader:
        with pytest.raises(BagError, match=r"no topic /imu .* it holds /imu/data \(sensor_msgs/msg/Imu\)"):
            reader.batches({"/imu": IMU})
        with pytest.raises(BagError, match="is of type sensor_msgs/msg/Imu, not sensor_msgs/msg/NavSatFix"):
            reader.batches({"/imu/data": FIX})
        with pytest.raises(BagError, match="std_msgs/msg/String is not one that can be read"):
            reader.batches({"/imu/data": "std_msgs/msg/String"})
    write_library(path, [("/imu/data", START, b"{}")], encoding="json")
    with open_bag([path]) as reader, pytest.raises(BagError, match="/imu/data is encoded as 'json'"):
        list(reader.batches({"/imu/data": IMU}))
    with BagWriter(path) as writer:
        handle = writer.add_topic("/imu/data", IMU)
        with pytest.raises(BagError, match="twice"):
            writer.add_topic("/imu/data", IMU)
        with pytest.raises(BagError, match="unknown message type"):
            writer.add_topic("/x", "x/msg/Y")
        with pytest.raises(ValueError, match="2 messages for 3 times"):
            writer.write(handle, log_times(3), random_messages(IMU, 2), FRAMES)


@pytest.mark.parametrize("type_name", MESSAGE_TYPES)
def test_messages_that_are_not_of_their_type_are_counted(tmp_path: Path, type_name: str) -> None:
    data = payloads(type_name, random_messages(type_name, 100))
    rows = [("/topic", time, row) for time, row in zip(log_times(100).tolist(), data, strict=True)]
    rows[10] = ("/topic", rows[10][1], b"")
    rows[50] = ("/topic", rows[50][1], rows[50][2][:-1])
    write_library(tmp_path / "bag.mcap", rows, type_name)
    with open_bag([tmp_path / "bag.mcap"]) as reader:
        assert len(read(reader, {"/topic": type_name})["/topic"][0]) == 98
        assert len(reader.warnings) == 1
        assert "2 messages of topic /topic cannot be decoded" in reader.warnings[0]


def damaged_chunk(path: Path, number: int) -> tuple[int, int, int]:
    """Flip a byte in the middle of a chunk's data; returns its offset and the times it spans."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    index = summary.chunk_indexes[number]
    content = bytearray(path.read_bytes())
    content[index.chunk_start_offset + index.chunk_length // 2] ^= 0x55
    path.write_bytes(content)
    return index.chunk_start_offset, index.message_start_time, index.message_end_time


@pytest.mark.parametrize("cut_summary", [False, True])
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_a_corrupt_chunk_costs_that_chunk_only(tmp_path: Path, compression: CompressionType, cut_summary: bool) -> None:
    path = tmp_path / "bag.mcap"
    messages, times = random_messages(IMU, 500), log_times(500)
    rows = [("/imu/data", int(t), row) for t, row in zip(times, payloads(IMU, messages), strict=True)]
    write_library(path, rows, compression=compression)
    offset, first, last = damaged_chunk(path, 3)
    if cut_summary:
        path.write_bytes(path.read_bytes()[:-20])
    kept = (times < first) | (times > last)
    assert 0 < kept.sum() < 500
    with open_bag([path]) as reader:
        assert read(reader, {"/imu/data": IMU})["/imu/data"] == (times[kept].tolist(), flat(messages[kept], FRAMES))
        assert f"1 damaged chunk skipped, at byte {offset}" in reader.warnings[-1]
        # With the counts of its summary, the file also says of which topic how many are missing.
        assert len(reader.warnings) == (1 if cut_summary else 2)
        assert cut_summary or f"{kept.sum()} of 500 of /imu/data" in reader.warnings[0]


class Victims:
    """Small recordings of several kinds with the same messages of /imu/data."""

    def __init__(self, content: dict[str, bytes], times: list[int], messages: list[list[bytes]]) -> None:
        self.content = content
        self.times = times
        self.messages = messages

    def __repr__(self) -> str:
        return "Victims"

    def start_with(self, times: list[int], messages: list[list[bytes]]) -> bool:
        return self.times[: len(times)] == times and self.messages[: len(times)] == messages


@pytest.fixture(scope="module")
def victims(tmp_path_factory: pytest.TempPathFactory) -> Victims:
    folder = tmp_path_factory.mktemp("victims")
    messages, times = random_messages(IMU, 300, frames=2), log_times(300)
    rows = [("/imu/data", int(t), row) for t, row in zip(times, payloads(IMU, messages), strict=True)]
    files: dict[str, Path] = {}
    for name in ("zstd", "lz4", "none"):
        files[f"{name}.mcap"] = folder / f"{name}.mcap"
        compression = CompressionType[name.upper()]
        write_library(files[f"{name}.mcap"], rows, compression=compression)
    files["unchunked.mcap"] = folder / "unchunked.mcap"
    write_library(files["unchunked.mcap"], rows, use_chunking=False)
    files["ours.mcap"] = folder / "ours.mcap"
    with BagWriter(files["ours.mcap"]) as writer:
        writer.write(writer.add_topic("/imu/data", IMU), times, messages, FRAMES)
    write_rosbags(folder / "sqlite", StoragePlugin.SQLITE3, CompressionMode.NONE, messages, times)
    files["sqlite.db3"] = next((folder / "sqlite").glob("*.db3"))
    content = {name: path.read_bytes() for name, path in files.items()}
    return Victims(content, times.tolist(), flat(messages, FRAMES))


VICTIMS = ["zstd.mcap", "lz4.mcap", "none.mcap", "unchunked.mcap", "ours.mcap", "sqlite.db3"]


def read_whatever(path: Path, content: bytes) -> tuple[list[int], list[list[bytes]], list[str]] | None:
    """What can be read of a damaged file; None for a BagError."""
    path.write_bytes(content)
    try:
        with open_bag([path]) as reader:
            times, found = read(reader, {"/imu/data": IMU})["/imu/data"]
            assert not any("\n" in line for line in reader.warnings)
            return times, found, reader.warnings
    except BagError as error:
        said = str(error)
    assert "\n" not in said
    assert str(path) in said
    return None


@pytest.mark.parametrize("name", VICTIMS)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_cut_file_gives_the_messages_before_the_cut(tmp_path: Path, victims: Victims, name: str, data: Any) -> None:
    content = victims.content[name]
    cut = data.draw(st.integers(0, len(content) - 1))
    result = read_whatever(tmp_path / name, content[:cut])
    if result is not None:
        times, messages, warnings = result
        assert victims.start_with(times, messages)
        assert len(times) == len(victims.times) or warnings, "messages are missing and nothing is said"


@pytest.mark.parametrize("name", ["zstd.mcap", "lz4.mcap", "none.mcap", "unchunked.mcap"])
def test_a_cut_mcap_file_gives_all_that_is_whole(tmp_path: Path, victims: Victims, name: str) -> None:
    content = victims.content[name]
    found = []
    for cut in range(2000, len(content), len(content) // 25):
        result = read_whatever(tmp_path / name, content[:cut])
        found.append(len(result[0]) if result else 0)
        # At most the block of compressed data that was hit is lost.
        block = 400 if name in ("none.mcap", "unchunked.mcap") else 25_000
        assert found[-1] >= len(victims.times) * (cut - 2 * block) / len(content) - 2
    assert found == sorted(found)


@pytest.mark.parametrize("name", VICTIMS)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_bytes_never_raise_anything_but_bag_error(
    tmp_path: Path, victims: Victims, name: str, data: Any
) -> None:
    content = bytearray(victims.content[name])
    places = data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=4))
    if data.draw(st.booleans()):
        places = [place % 600 if place % 2 else len(content) - 1 - place % 600 for place in places]  # the headers
    for place in places:
        content[place] = data.draw(st.integers(0, 255))
    read_whatever(tmp_path / name, bytes(content))


def test_damaged_sqlite_gives_the_rows_before_the_damage(tmp_path: Path, victims: Victims) -> None:
    spoilt = bytearray(victims.content["sqlite.db3"])
    spoilt[-20_000:] = bytes(20_000)
    result = read_whatever(tmp_path / "sqlite.db3", bytes(spoilt))
    assert result is not None
    times, messages, warnings = result
    assert 100 < len(times) < 300
    assert victims.start_with(times, messages)
    assert f"damaged after {len(times)}" in warnings[0]


def test_a_writer_left_by_an_exception_leaves_a_readable_file(tmp_path: Path) -> None:
    path, count = tmp_path / "bag.mcap", 40_000
    messages = random_messages(ODOMETRY, count)

    def write() -> None:
        with BagWriter(path) as writer:
            writer.write(writer.add_topic("/odom", ODOMETRY), log_times(count), messages, FRAMES)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    with open_bag([path]) as reader:
        assert "cut off" in reader.warnings[0]
        assert 10_000 < reader.topics["/odom"].count <= count


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    peaks = []
    for repeats in (4, 16):
        path = tmp_path / f"{repeats}.mcap"
        messages = random_messages(IMU, 10_000)
        with BagWriter(path) as writer:
            handle = writer.add_topic("/imu/data", IMU)
            for number in range(repeats):
                writer.write(handle, log_times(10_000) + number * 50_000_000_000, messages, FRAMES)
        tracemalloc.start()
        with open_bag([path]) as reader:
            total = sum(len(batch["/imu/data"].log_time) for batch in reader.batches({"/imu/data": IMU}))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert total == 10_000 * repeats
    assert peaks[1] < 1.2 * peaks[0]


def test_progress_grows_to_the_size_of_the_files(tmp_path: Path) -> None:
    messages, times = random_messages(IMU, 30_000), log_times(30_000)
    for storage in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        write_rosbags(tmp_path / storage.name, storage, CompressionMode.NONE, messages, times)
        with open_bag([tmp_path / storage.name]) as reader:
            done = [reader.bytes_done for _ in reader.batches({"/imu/data": IMU})]
            assert done == sorted(done)
            assert len(done) > 2
            assert 0 < done[0] < 0.6 * reader.bytes_total
            assert reader.bytes_done == reader.bytes_total


def test_a_sqlite_file_with_a_write_ahead_log(tmp_path: Path) -> None:
    messages, times = random_messages(IMU, 50), log_times(50)
    write_rosbags(tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.NONE, messages, times)
    path = next((tmp_path / "bag").glob("*.db3"))
    recorder = sqlite3.connect(path)
    recorder.execute("PRAGMA journal_mode=WAL")
    recorder.execute("DELETE FROM messages WHERE id > 40")
    recorder.commit()  # lies in the log, not in the file, as long as the recorder is there
    with open_bag([path]) as reader:
        assert len(read(reader, {"/imu/data": IMU})["/imu/data"][0]) == 40
    recorder.close()


def test_library_files_by_stream(tmp_path: Path) -> None:
    # Zstandard frames without their size, as streaming compressors (the mcap command) write them.
    import zstandard

    from eskf_ros.bags.mcap_file import _decompress

    content = np.random.default_rng(0).bytes(300_000)
    stream = io.BytesIO()
    for part in (content[:100_000], content[100_000:]):
        compressor = zstandard.ZstdCompressor().compressobj()
        stream.write(compressor.compress(part) + compressor.flush())
    assert bytes(_decompress("zstd", stream.getvalue(), len(content), False)) == content
