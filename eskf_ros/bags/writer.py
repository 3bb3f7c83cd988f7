"""Writing of MCAP files: whole chunks assembled by numpy.

The file has the form that `ros2 bag record` gives it with mcap storage (profile ros2, schemas ros2msg, message and
chunk index, statistics, the rosbag2 metadata record), and contains no wall-clock time: the same calls give the same
bytes.

Over 400 lines: one file format, written in one pass.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from eskf_ros.bags.errors import BagError
from eskf_ros.bags.mcap_file import MAGIC
from eskf_ros.bags.messages import encode_groups
from eskf_ros.bags.records import group_by_length

_CHUNK_BYTES = 2 << 20
_BUFFER_BYTES = 16 << 20  # kept back so that topics written in turn are sorted by time into common chunks
_ZSTD_LEVEL = 1
_RECORD_HEAD = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log", "<u8"),
    ("publish", "<u8"),
]


@dataclass
class _Topic:
    channel: int
    name: str
    type_name: str
    type_hash: str
    count: int = 0
    newest: int | None = None  # log time of the last message written


@dataclass
class _Records:
    """Message records of one topic and one length that wait to be written, in the order of their log time."""

    channel: int
    order: NDArray[np.int64]  # (n,) place among all messages written
    log_time: NDArray[np.int64]  # (n,) ns
    rows: NDArray[np.uint8]  # (n, length) complete message records
    first: int = 0  # rows before this one are written


@dataclass
class _Summary:
    chunks: list[ChunkIndex] = field(default_factory=list)
    start: int | None = None
    end: int = 0


class BagWriter:
    """Writes one .mcap file; a context manager. After an exception inside the file has no index, but can be read."""

    def __init__(self, path: Path, compression: str = "zstd", namespace: str = "") -> None:
        """Create the file, replacing one of that name. `compression` is zstd, lz4 or none.

        `namespace` is put before the names of topics: with a slash they are named as `ros2 bag record` does.

        Raises:
            BagError: the file cannot be created.
            ValueError: unknown compression.
        """
        if compression not in ("zstd", "lz4", "none"):
            raise ValueError(f"compression is zstd, lz4 or none, not {compression!r}")
        self.path = path
        self._namespace = namespace
        self._compression = "" if compression == "none" else compression
        self._topics: list[_Topic] = []
        self._schemas: dict[str, Schema] = {}
        self._channels: list[Channel] = []
        self._pending: list[_Records] = []
        self._pending_bytes = 0
        self._written = 0
        self._summary = _Summary()
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise self._failure(error) from error
        self._put(MAGIC + _record(Header("ros2", "eskf_ros")))

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            with suppress(OSError):  # a second failure would hide the first
                self._file.close()

    def add_topic(self, name: str, type_name: str) -> int:
        """Announce a topic; return the handle for `write`.

        Raises:
            BagError: the type is unknown to ROS 2 Jazzy's common messages, or the topic has been added before.
        """
        from rosbags.typesys import Stores, get_typestore

        name = self._namespace + name
        if any(topic.name == name for topic in self._topics):
            raise BagError(f"{self.path}: topic {name} is added twice")
        store = get_typestore(Stores.ROS2_JAZZY)
        if type_name not in store.fielddefs:
            raise BagError(f"{self.path}: topic {name}: unknown message type {type_name}")
        type_hash = store.hash_rihs01(type_name)
        if type_name not in self._schemas:
            definition, _ = store.generate_msgdef(type_name, ros_version=2)
            schema = Schema(len(self._schemas) + 1, definition.encode(), "ros2msg", type_name)
            self._schemas[type_name] = schema
            self._put(_record(schema))
        number = len(self._topics) + 1
        metadata = {"offered_qos_profiles": "", "topic_type_hash": type_hash}
        self._channels.append(Channel(number, name, "cdr", metadata, self._schemas[type_name].id))
        self._put(_record(self._channels[-1]))
        self._topics.append(_Topic(number, name, type_name, type_hash))
        return number - 1

    def write(
        self,
        handle: int,
        log_time: NDArray[np.int64],
        messages: NDArray[Any] | Sequence[bytes],
        strings: Sequence[str] = (),
    ) -> None:
        """Write messages of one topic.

        Messages of all topics are sorted by log time (equal times: as written) if they are written within some
        megabytes of each other; later ones come in later chunks, which readers merge.

        Args:
            handle: from `add_topic`.
            log_time: (n,) ns.
            messages: n messages: structured (see `message_dtype`), or serialised: (n, length) uint8, or n byte strings.
            strings: the strings whose indices are in the string fields of structured messages.

        Raises:
            BagError: structured messages of a type that cannot be encoded, or the disk is full.
            ValueError: there are not n messages.
        """
        topic = self._topics[handle]
        log_time = np.ascontiguousarray(log_time, np.int64)
        if len(messages) != len(log_time):
            raise ValueError(f"topic {topic.name}: {len(messages)} messages for {len(log_time)} times")
        if not len(log_time):
            return
        everything = slice(0, len(log_time))
        if not isinstance(messages, np.ndarray):
            for positions, rows in group_by_length(messages):
                self._append(topic, log_time, everything if positions is None else positions, rows)
        elif messages.dtype == np.uint8:
            self._append(topic, log_time, everything, messages)
        else:
            for chosen, rows in encode_groups(topic.type_name, messages, strings):
                self._append(topic, log_time, chosen, rows)
        topic.count += len(log_time)
        topic.newest = max(int(log_time.max()), topic.newest if topic.newest is not None else int(log_time.max()))
        self._written += len(log_time)
        if self._pending_bytes > _BUFFER_BYTES:
            # No topic is expected to write anything older than its newest message.
            complete = min(topic.newest for topic in self._topics if topic.newest is not None)
            self._flush(complete)
            if self._pending_bytes > 2 * _BUFFER_BYTES:
                self._flush(None)

    def _append(
        self, topic: _Topic, log_time: NDArray[np.int64], chosen: slice | NDArray[np.intp], payload: NDArray[np.uint8]
    ) -> None:
        """Queue the message records of equal length."""
        count, length = payload.shape
        times = log_time[chosen]
        order = self._written + np.arange(len(log_time), dtype=np.int64)[chosen]
        dtype = np.dtype([*_RECORD_HEAD, ("payload", f"V{length}")] if length else _RECORD_HEAD)
        records = np.empty(count, dtype)
        records["opcode"] = Opcode.MESSAGE
        records["length"] = dtype.itemsize - 9
        records["channel"] = topic.channel
        records["sequence"] = topic.count + np.arange(len(log_time), dtype=np.int64)[chosen] + 1
        records["log"] = records["publish"] = times
        if length:
            records["payload"] = np.ascontiguousarray(payload).view(f"V{length}")[:, 0]
        if (times[1:] < times[:-1]).any():
            sorting = np.argsort(times, kind="stable")
            times, order, records = times[sorting], order[sorting], records[sorting]
        rows = records.view(np.uint8).reshape(count, dtype.itemsize)
        self._pending.append(_Records(topic.channel, order, times, rows))
        self._pending_bytes += rows.nbytes

    def _flush(self, until: int | None) -> None:
        """Write the waiting messages not newer than `until` (None: all) in chunks, the last one only if it is full."""
        parts = []
        for records in self._pending:
            last = len(records.log_time) if until is None else int(np.searchsorted(records.log_time, until, "right"))
            if last > records.first:
                parts.append((records, records.first, last))
        if not parts:
            return
        log_time = np.concatenate([records.log_time[first:last] for records, first, last in parts])
        order = np.concatenate([records.order[first:last] for records, first, last in parts])
        sizes = np.concatenate([np.full(last - first, records.rows.shape[1]) for records, first, last in parts])
        part = np.repeat(np.arange(len(parts)), [last - first for _, first, last in parts])
        sorting = np.lexsort((order, log_time))
        log_time, sizes, part = log_time[sorting], sizes[sorting], part[sorting]
        ends = np.cumsum(sizes)
        begin = 0
        while begin < len(ends):
            base = int(ends[begin] - sizes[begin])
            end = int(np.searchsorted(ends, base + _CHUNK_BYTES)) + 1
            if end > len(ends):
                if until is not None:
                    break
                end = len(ends)
            self._write_chunk(log_time[begin:end], ends[begin:end] - sizes[begin:end] - base, part[begin:end], parts)
            begin = end
        self._pending = [records for records in self._pending if records.first < len(records.log_time)]
        self._pending_bytes = sum((len(r.log_time) - r.first) * r.rows.shape[1] for r in self._pending)

    def _write_chunk(
        self,
        log_time: NDArray[np.int64],
        offsets: NDArray[np.int64],
        part: NDArray[np.intp],
        parts: list[tuple[_Records, int, int]],
    ) -> None:
        """Write one chunk of messages, given by time, offset in the chunk, and the part whose next record each is."""
        last = parts[int(part[-1])][0].rows.shape[1]
        raw = np.empty(int(offsets[-1]) + last, np.uint8)
        index: dict[int, list[tuple[NDArray[np.int64], NDArray[np.int64]]]] = {}
        for number in np.unique(part):
            records = parts[number][0]
            chosen = np.flatnonzero(part == number)
            rows = records.rows[records.first : records.first + len(chosen)]
            records.first += len(chosen)
            length = rows.shape[1]
            windows = np.ndarray((len(raw) - length + 1,), f"V{length}", raw, 0, (1,))
            windows[offsets[chosen]] = rows.view(f"V{length}")[:, 0]
            index.setdefault(records.channel, []).append((log_time[chosen], offsets[chosen]))
        data = raw.tobytes() if self._compression == "" else self._compress(raw.data)
        chunk = Chunk(self._compression, data, int(log_time[-1]), int(log_time[0]), zlib.crc32(raw.data), len(raw))
        start = self._file.tell()
        record = _record(chunk)
        self._put(record)
        index_start = position = start + len(record)
        index_offsets: dict[int, int] = {}
        for channel in sorted(index):
            entries = np.concatenate([np.stack(pair, axis=1) for pair in index[channel]])
            entries = entries[np.argsort(entries[:, 1])]
            index_offsets[channel] = position
            position += self._put(_message_index(channel, entries))
        self._summary.chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=start,
                compression=self._compression,
                compressed_size=len(data),
                message_end_time=chunk.message_end_time,
                message_index_length=position - index_start,
                message_index_offsets=index_offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=len(raw),
            )
        )
        earliest = self._summary.start
        self._summary.start = chunk.message_start_time if earliest is None else min(earliest, chunk.message_start_time)
        self._summary.end = max(self._summary.end, chunk.message_end_time)

    def _compress(self, raw: memoryview) -> bytes:
        if self._compression == "zstd":
            return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(raw)
        return cast(bytes, lz4.frame.compress(raw))

    def _put(self, data: bytes) -> int:
        try:
            return self._file.write(data)
        except OSError as error:
            raise self._failure(error) from error

    def _failure(self, error: OSError) -> BagError:
        return BagError(f"{self.path}: cannot be written ({error.strerror})")

    def close(self) -> None:
        """Write the waiting messages, the index and the footer.

        Raises:
            BagError: the disk is full.
        """
        self._flush(None)
        metadata = Metadata("rosbag2", {"serialized_metadata": self._rosbag2_metadata()})
        metadata_start = self._file.tell()
        metadata_length = self._put(_record(metadata))
        self._put(_record(DataEnd(0)))
        summary_start = self._file.tell()
        counts = {topic.channel: topic.count for topic in self._topics}
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._summary.chunks),
            message_count=sum(counts.values()),
            message_end_time=self._summary.end,
            message_start_time=self._summary.start or 0,
            metadata_count=1,
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._summary.chunks),
            (Opcode.METADATA_INDEX, [MetadataIndex(metadata_start, metadata_length, "rosbag2")]),
        ]
        summary, offsets = b"", b""
        for opcode, records in groups:
            content = b"".join(map(_record, records))
            if content:
                offsets += _record(SummaryOffset(opcode, summary_start + len(summary), len(content)))
            summary += content
        offsets_start = summary_start + len(summary)
        # The checksum covers the summary and the footer up to the checksum itself.
        footer = _record(Footer(summary_start, offsets_start, 0))
        checksum = zlib.crc32(summary + offsets + footer[:-4])
        self._put(summary + offsets + _record(Footer(summary_start, offsets_start, checksum)) + MAGIC)
        try:
            self._file.close()
        except OSError as error:
            raise self._failure(error) from error

    def _rosbag2_metadata(self) -> str:
        """Return the content of metadata.yaml of `ros2 bag`, as JSON (which is valid YAML)."""
        start = self._summary.start or 0
        return json.dumps(
            {
                "version": 9,
                "storage_identifier": "mcap",
                "relative_file_paths": [self.path.name],
                "duration": {"nanoseconds": self._summary.end - start},
                "starting_time": {"nanoseconds_since_epoch": start},
                "message_count": sum(topic.count for topic in self._topics),
                "topics_with_message_count": [
                    {
                        "topic_metadata": {
                            "name": topic.name,
                            "type": topic.type_name,
                            "serialization_format": "cdr",
                            "offered_qos_profiles": [],
                            "type_description_hash": topic.type_hash,
                        },
                        "message_count": topic.count,
                    }
                    for topic in self._topics
                ],
                "compression_format": "",
                "compression_mode": "",
                "files": [],
                "custom_data": None,
                "ros_distro": "jazzy",
            }
        )


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return cast(bytes, builder.end())


def _message_index(channel: int, entries: NDArray[np.int64]) -> bytes:
    """Return a message index record; `entries` (n, 2) are log times and offsets."""
    body = entries.astype("<u8").tobytes()
    return b"".join(
        (
            bytes([Opcode.MESSAGE_INDEX]),
            (6 + len(body)).to_bytes(8, "little"),
            channel.to_bytes(2, "little"),
            len(body).to_bytes(4, "little"),
            body,
        )
    )
