"""Small recordings of all kinds that are read, and what a disk, a transfer or a killed recorder does to them.

A recording is a mapping: file name -> content. With more than one file it is a rosbag2 directory.
"""

from __future__ import annotations

import sqlite3
import struct
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as LibraryWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from eskf_ros.bags import BagWriter, encode
from eskf_ros.simulate.frames import STRINGS
from eskf_ros.simulate.messages import topics_of
from eskf_ros.simulate.range_receiver import RangeReceiver
from eskf_ros.simulate.scenario import simulate
from eskf_ros.simulate.wheel import WheelOdometer

Files = Mapping[str, bytes]
Message = tuple[str, str, int, bytes]
"""Topic, type, log time (ns), serialised message."""

STORE = get_typestore(Stores.ROS2_JAZZY)
DRIVE = {"start": 18.0, "stop": 23.0, "imu_rate": 100.0, "truth_rate": 10.0, "outages": ()}
"""Five seconds: at rest, then moving."""


def drive() -> list[Message]:
    """Messages of a short drive with wheels and satellites, in the order of their log time."""
    sensors = {"wheel": WheelOdometer(rate=10.0), "ranges": RangeReceiver(rate=1.0, satellites=True)}
    messages = []
    for topic in topics_of(simulate("tunnel_drive", seed=1, **DRIVE, **sensors)):
        payloads = encode(topic.type_name, topic.messages(slice(None)), STRINGS)
        for time, payload in zip(topic.arrival.tolist(), payloads, strict=True):
            messages.append((topic.name, topic.type_name, time, bytes(payload)))
    return sorted(messages, key=lambda message: message[2])


def _mcap(messages: list[Message], folder: Path, **options: Any) -> None:
    with (folder / "bag.mcap").open("wb") as file:
        writer = LibraryWriter(file, **{"chunk_size": 20_000, **options})
        writer.start("ros2")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, type_name, time, payload in messages:
            if type_name not in schemas:
                definition, _ = STORE.generate_msgdef(type_name, ros_version=2)
                schemas[type_name] = writer.register_schema(type_name, "ros2msg", definition.encode())
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[type_name])
            writer.add_message(channels[topic], time, payload, time)
        writer.finish()


def _ours(messages: list[Message], folder: Path) -> None:
    with BagWriter(folder / "bag.mcap") as writer:
        handles: dict[str, int] = {}
        for topic, type_name, time, payload in messages:
            if topic not in handles:
                handles[topic] = writer.add_topic(topic, type_name)
            writer.write(handles[topic], np.array([time]), [payload])


def _rosbags(
    messages: list[Message], folder: Path, storage: StoragePlugin, mode: CompressionMode = CompressionMode.NONE
) -> None:

    writer = Writer(folder / "bag", version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, type_name, time, payload in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=STORE)
            writer.write(connections[topic], time, payload)


_MCAP: dict[str, dict[str, Any]] = {
    "mcap zstd": {"compression": CompressionType.ZSTD},
    "mcap lz4": {"compression": CompressionType.LZ4},
    "mcap": {"compression": CompressionType.NONE},
    "mcap without checksums": {"compression": CompressionType.NONE, "enable_crcs": False},
    "mcap without index": {"compression": CompressionType.ZSTD, "index_types": IndexType.NONE, "enable_crcs": False},
    "mcap without chunks": {"use_chunking": False},
}
_WRITERS: dict[str, Callable[[list[Message], Path], None]] = {
    **{name: lambda messages, folder, o=options: _mcap(messages, folder, **o) for name, options in _MCAP.items()},
    "mcap of eskf_simulate": _ours,
    "mcap directory": lambda messages, folder: _rosbags(messages, folder, StoragePlugin.MCAP),
    "db3 directory": lambda messages, folder: _rosbags(messages, folder, StoragePlugin.SQLITE3),
    "db3 compressed messages": lambda messages, folder: _rosbags(
        messages, folder, StoragePlugin.SQLITE3, CompressionMode.MESSAGE
    ),
    "db3 compressed file": lambda messages, folder: _rosbags(
        messages, folder, StoragePlugin.SQLITE3, CompressionMode.FILE
    ),
}


def recordings() -> dict[str, Files]:
    """The same drive in every kind of file that is read; `db3` alone and split in two directories' files, too."""
    messages = drive()
    found: dict[str, Files] = {}
    for name, write in _WRITERS.items():
        with tempfile.TemporaryDirectory() as place:
            write(messages, Path(place))
            files = sorted(path for path in Path(place).rglob("*") if path.is_file())
            found[name] = {path.name: path.read_bytes() for path in files}
    (database,) = (content for name, content in found["db3 directory"].items() if name.endswith(".db3"))
    found["db3"] = {"bag.db3": database}
    found["two mcap files"] = {
        "a.mcap": _part(messages[: len(messages) // 2]),
        "b.mcap": _part(messages[len(messages) // 2 :]),
    }
    return found


def _part(messages: list[Message]) -> bytes:
    with tempfile.TemporaryDirectory() as place:
        _mcap(messages, Path(place))
        return (Path(place) / "bag.mcap").read_bytes()


def write(files: Files, folder: Path) -> Path:
    """Write a recording into an empty folder; returns what to replay: the only file, or the folder."""
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder if len(files) > 1 else folder / next(iter(files))


@dataclass(frozen=True)
class Damage:
    """What is done to the content of one file; ``kinds``: endings of the names of files that it is done to."""

    spoil: Callable[[np.random.Generator, bytes], bytes]
    kinds: tuple[str, ...] = (".mcap", ".db3", ".zstd", ".yaml")


def _stretch(rng: np.random.Generator, size: int, longest: int = 8192) -> tuple[int, int]:
    """A part of the file: bytes or whole pages of 4096 bytes."""
    if rng.random() < 0.5 and size > 8192:
        begin = 4096 * int(rng.integers(size // 4096))
        return begin, min(size, begin + 4096 * int(rng.integers(1, 4)))
    begin = int(rng.integers(size))
    return begin, min(size, begin + int(2 ** rng.uniform(0.0, np.log2(longest))))


def _flip(rng: np.random.Generator, content: bytes) -> bytes:
    spoilt = bytearray(content)
    for place in rng.integers(8 * len(content), size=int(rng.integers(1, 9))).tolist():
        spoilt[place // 8] ^= 1 << place % 8
    return bytes(spoilt)


def _noise(rng: np.random.Generator, content: bytes) -> bytes:
    begin, end = _stretch(rng, len(content), 256)
    return content[:begin] + rng.bytes(end - begin) + content[end:]


def _cut(rng: np.random.Generator, content: bytes) -> bytes:
    return content[: int(rng.integers(len(content)))]


def _hole(rng: np.random.Generator, content: bytes) -> bytes:
    begin, end = _stretch(rng, len(content))
    return content[:begin] + content[end:]


def _double(rng: np.random.Generator, content: bytes) -> bytes:
    begin, end = _stretch(rng, len(content))
    return content[:end] + content[begin:end] + content[end:]


def _swap(rng: np.random.Generator, content: bytes) -> bytes:
    begin, end = _stretch(rng, len(content))
    other = int(rng.integers(max(1, len(content) - (end - begin))))
    spoilt = bytearray(content)
    spoilt[begin:end], spoilt[other : other + end - begin] = (
        content[other : other + end - begin],
        content[begin:end],
    )
    return bytes(spoilt)


def _zero(rng: np.random.Generator, content: bytes) -> bytes:
    begin, end = _stretch(rng, len(content))
    return content[:begin] + bytes(end - begin) + content[end:]


_LENGTHS = (0, 1, 2, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 1 << 20, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 40, (1 << 63) - 1)


def _false_number(rng: np.random.Generator, content: bytes) -> bytes:
    """A number of 2, 4 or 8 bytes somewhere becomes one that lengths and counts go wrong by."""
    size = int(rng.choice([2, 4, 8]))
    place = int(rng.integers(max(1, len(content) - size)))
    return _with_number(rng, content, place, size, str(rng.choice(["little", "big"])))


def _with_number(rng: np.random.Generator, content: bytes, place: int, size: int, order: Any) -> bytes:
    value = int(rng.choice([*_LENGTHS, len(content), (1 << 64) - 1], p=None) if rng.random() < 0.7 else 0)
    value = (
        value if rng.random() < 0.7 else int.from_bytes(content[place : place + size], order) + int(rng.integers(-3, 4))
    )
    return content[:place] + (value % (1 << 8 * size)).to_bytes(size, order) + content[place + size :]


def _mcap_records(content: bytes) -> list[int]:
    """Offsets of the records of a whole mcap file, those in uncompressed chunks included."""
    places: list[int] = []

    def walk(position: int, end: int) -> None:
        while position + 9 <= end:
            opcode, length = struct.unpack_from("<BQ", content, position)
            places.append(position)
            if opcode == 6 and struct.unpack_from("<I", content, position + 37)[0] == 0:
                walk(position + 49, position + 9 + length)
            position += 9 + length

    walk(8, len(content) - 8)
    return places


def _false_record(rng: np.random.Generator, content: bytes) -> bytes:
    """A number in the first bytes of an mcap record: opcode, length, time, channel, sizes."""
    places = _mcap_records(content)
    rare = [place for place in places if content[place] not in (5, 7)]
    place = int(rng.choice(rare if rng.random() < 0.6 else places))
    if rng.random() < 0.2:
        return content[:place] + bytes([int(rng.integers(0, 17))]) + content[place + 1 :]
    offset = 1 if rng.random() < 0.4 else int(rng.integers(1, 60))
    return _with_number(rng, content, place + offset, int(rng.choice([2, 4, 8])), "little")


_STRANGE: tuple[Any, ...] = (
    None,
    "",
    "text",
    b"",
    b"\xff\xfe",
    "\ud7ff",
    0,
    1,
    -1,
    77,
    1.5,
    -1e300,
    (1 << 63) - 1,
    -(1 << 63),
    1e300,
    float("inf"),
)
_COLUMNS = {"topics": ("id", "name", "type", "serialization_format"), "messages": ("topic_id", "timestamp", "data")}


def _strange_value(rng: np.random.Generator, content: bytes) -> bytes:
    """A database that is whole, with text, bytes, nothing or extreme numbers where others belong, or without parts."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        path.write_bytes(content)
        connection = sqlite3.connect(path)
        table = str(rng.choice(list(_COLUMNS)))
        choice = rng.random()
        try:
            if choice < 0.05:
                connection.execute(f"DROP TABLE {table}")
            elif choice < 0.1:
                connection.execute(f"ALTER TABLE {table} RENAME COLUMN {rng.choice(_COLUMNS[table])} TO other")
            elif choice < 0.2:
                first = int(rng.integers(300))
                connection.execute(f"DELETE FROM {table} WHERE rowid BETWEEN ? AND ?", (first, first + 50))
            else:
                column = str(rng.choice(_COLUMNS[table]))
                value = _STRANGE[int(rng.integers(len(_STRANGE)))]
                share = int(rng.choice([1, 2, 10]))
                connection.execute(f"UPDATE {table} SET {column} = ? WHERE rowid % ? = 0", (value, share))
            connection.commit()
        except sqlite3.Error:  # a column with a constraint refuses the value
            connection.rollback()
        finally:
            connection.close()
        return path.read_bytes()


def _strange_line(rng: np.random.Generator, content: bytes) -> bytes:
    """A line of metadata.yaml is dropped, doubled, or gets another value."""
    lines = content.decode().split("\n")
    place = int(rng.integers(len(lines)))
    key = lines[place].split(":")[0]
    values = (
        "",
        "null",
        "[]",
        "{}",
        "-1",
        "text",
        "1e400",
        "[[",
        "!!python/object:os.system {}",
        "&a [*a]",
        "99999999999999999999",
        "../../etc",
    )
    choice = rng.random()
    if choice < 0.2:
        del lines[place]
    elif choice < 0.3:
        lines.insert(place, lines[place])
    else:
        lines[place] = f"{key}: {rng.choice(values)}"
    return "\n".join(lines).encode()


DAMAGES = {
    "flipped bits": Damage(_flip),
    "noise": Damage(_noise),
    "cut": Damage(_cut),
    "hole": Damage(_hole),
    "doubled block": Damage(_double),
    "swapped blocks": Damage(_swap),
    "zeroed block": Damage(_zero),
    "false number": Damage(_false_number),
    "false record": Damage(_false_record, (".mcap",)),
    "strange value": Damage(_strange_value, (".db3",)),
    "strange line": Damage(_strange_line, (".yaml",)),
}


def damaged(recordings: Mapping[str, Files], seed: int) -> tuple[str, str, Files]:
    """A recording with a damage: names of both, and the files. One in six has two damages."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(list(recordings)))
    files = dict(recordings[kind])
    damage = str(rng.choice(list(DAMAGES)))
    fitting = [name for name in files if Path(name).suffix in DAMAGES[damage].kinds]
    if not fitting:
        return damaged(recordings, seed + (1 << 32))
    # The data are hit more often than metadata.yaml, unless the damage is made for that.
    data = [name for name in fitting if not name.endswith(".yaml")]
    name = str(rng.choice(data if data and rng.random() < 0.8 else fitting))
    files[name] = DAMAGES[damage].spoil(rng, files[name])
    if rng.random() < 1.0 / 6.0 and files[name]:
        second = str(rng.choice(["flipped bits", "cut", "zeroed block", "doubled block"]))
        files[name] = DAMAGES[second].spoil(rng, files[name])
    return kind, damage, files
