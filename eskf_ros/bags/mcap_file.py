"""Reading of MCAP files (https://mcap.dev/spec): chunks found by the index, messages gathered by numpy.

A healthy recording ends with a summary: channels, counts and the position of every chunk. After each chunk come the
(time, offset) pairs of its messages, so the messages of a topic are one strided gather from the decompressed chunk,
without a Python statement per message. A file without a usable summary (cut off, damaged, or written without) is walked
record by record once to build the same list of chunks, and so is a chunk without a message index.

Over 400 lines: one file format, read in one pass.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, cast

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics
from numpy.typing import NDArray

from eskf_ros.bags.errors import BagError
from eskf_ros.bags.records import Block, Payloads, TopicInfo

MAGIC = b"\x89MCAP0\r\n"
_PREFIX = struct.Struct("<BQ")  # opcode and length of every record
_CHUNK_HEADER = struct.Struct("<QQQI")  # start, end, uncompressed size, uncompressed CRC
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER_SIZE = 9 + 20
_PAYLOAD_OFFSET = 9 + _MESSAGE.size
_LARGEST_CHUNK = 1 << 32  # a larger size is damage, not a recording
_LOOSE_REGION = 1 << 20  # bytes of messages outside chunks that are read in one go
_LAST_TIME = (1 << 63) - 1


class _Damage(Exception):
    """A part of the file cannot be read; the text says why."""


@dataclass
class _Chunk:
    """A chunk record, or a run of records that lie in the file outside any chunk (`loose`)."""

    offset: int
    length: int
    start: int
    end: int
    index_length: int = 0
    index_offsets: dict[int, int] = field(default_factory=dict)  # channel -> offset of its message index in the file
    loose: bool = False


@dataclass
class _Messages:
    """The messages found in a run of records, in file order: channels, log times (ns), offsets of the records."""

    channel: NDArray[np.int64]
    log_time: NDArray[np.int64]
    offset: NDArray[np.int64]


def _decompress(compression: str, data: bytes | memoryview, size: int, incomplete: bool) -> bytes | memoryview:
    """Decompress a chunk of `size` bytes; `incomplete`: `data` is cut off, return as much as possible."""
    if compression == "":
        return data
    if size > _LARGEST_CHUNK:
        raise _Damage(f"impossible chunk size {size}")
    try:
        if compression == "zstd":
            if not incomplete:
                raw = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
                if len(raw) == size:
                    return raw
            stream = zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True)
            return stream.read(size)
        if compression == "lz4":
            return cast(bytes, lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=-1 if incomplete else size))
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, ValueError) as error:
        raise _Damage(f"{compression} data cannot be decompressed") from error
    raise _Damage(f"unknown compression {compression!r}")


def _open_chunk(record: bytes | memoryview, incomplete: bool) -> tuple[memoryview, int, int]:
    """Return the uncompressed records of a chunk and its first and last time; raises _Damage."""
    try:
        opcode, length = _PREFIX.unpack_from(record)
        start, end, size, crc = _CHUNK_HEADER.unpack_from(record, 9)
        (name_length,) = struct.unpack_from("<I", record, 37)
        compression = bytes(record[41 : 41 + name_length]).decode()
        (data_length,) = struct.unpack_from("<Q", record, 41 + name_length)
    except (struct.error, UnicodeDecodeError) as error:
        raise _Damage("chunk header cannot be read") from error
    begin = 49 + name_length
    if opcode != Opcode.CHUNK or begin + data_length > 9 + length or (begin + data_length > len(record)) != incomplete:
        raise _Damage("no valid chunk record here")
    raw = memoryview(_decompress(compression, memoryview(record)[begin : begin + data_length], size, incomplete))
    if not incomplete:
        if len(raw) != size:
            raise _Damage(f"chunk has {len(raw)} bytes instead of {size}")
        if crc and zlib.crc32(raw) != crc:
            raise _Damage("chunk has a wrong checksum")
    return raw, start, end


class McapFile:
    """One .mcap file as a `Source`."""

    def __init__(self, path: Path) -> None:
        """Read the summary, or scan the file if there is none.

        Raises:
            BagError: the file cannot be opened or is no MCAP file.
        """
        self.path = path
        self.name = str(path)
        self._warnings: list[str] = []
        self.start_time = 0
        self.end_time = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: dict[int, int] = {}
        self._stated: dict[int, int] = {}  # messages by channel as the statistics say, if they can be read
        self._chunks: list[_Chunk] = []
        self._skipped: dict[int, str] = {}  # offset of a damaged chunk -> what is wrong
        try:
            self.bytes_total = path.stat().st_size
            with path.open("rb") as file:
                if file.read(len(MAGIC)) != MAGIC:
                    raise BagError(f"{path}: not an mcap file")
                if self._read_summary(file):
                    self._counts = self._stated
                else:
                    self._scan(file)
        except OSError as error:
            raise BagError(f"{path}: {error.strerror or error}") from error
        self.topics: dict[str, TopicInfo] = {}
        for number, channel in sorted(self._channels.items()):
            known = self.topics.get(channel.topic)
            self.topics[channel.topic] = TopicInfo(
                known.type if known else self._type_of(channel),
                (known.count if known else 0) + max(self._counts.get(number, 0), self._stated.get(number, 0)),
            )
        strangers = sum(count for number, count in self._counts.items() if number not in self._channels)
        if strangers:
            self._warnings.append(f"{self.path}: {strangers} messages belong to no known topic; skipped")

    @property
    def warnings(self) -> list[str]:
        """Faults found so far, one line each."""
        if not self._skipped:
            return self._warnings
        offset, reason = next(iter(self._skipped.items()))
        count = len(self._skipped)
        chunks = "1 damaged chunk skipped," if count == 1 else f"{count} damaged chunks skipped, the first"
        return [*self._warnings, f"{self.path}: {chunks} at byte {offset} ({reason})"]

    def close(self) -> None:
        """Do nothing: no file stays open between reads."""

    def _read_at(self, file: BinaryIO, offset: int, size: int) -> bytes:
        """Return up to `size` bytes; offset and size may come from a damaged record."""
        available = self.bytes_total - offset
        if available <= 0:
            return b""
        file.seek(offset)
        return file.read(min(size, available, _LARGEST_CHUNK))

    def _type_of(self, channel: Channel) -> str:
        schema = self._schemas.get(channel.schema_id)
        return schema.name if schema else ""

    def _read_summary(self, file: BinaryIO) -> bool:
        """Read channels, counts and chunks from the end of the file; return False if they are incomplete."""
        tail = self._read_at(file, max(0, self.bytes_total - _FOOTER_SIZE - len(MAGIC)), _FOOTER_SIZE + len(MAGIC))
        if not tail.endswith(MAGIC) or len(tail) != _FOOTER_SIZE + len(MAGIC):
            return False
        if _PREFIX.unpack_from(tail) != (Opcode.FOOTER, 20):
            return False
        footer = Footer.read(ReadDataStream(BytesIO(tail[9:])))
        footer_offset = self.bytes_total - len(tail)
        if not len(MAGIC) < footer.summary_start <= footer_offset:
            return False
        summary = self._read_at(file, footer.summary_start, footer_offset - footer.summary_start)
        if footer.summary_crc and zlib.crc32(tail[:25], zlib.crc32(summary)) != footer.summary_crc:
            self._warnings.append(f"{self.path}: the summary at its end is damaged; the file is read without it")
            return False
        statistics: Statistics | None = None
        position = 0
        try:
            while position < len(summary):
                opcode, length = _PREFIX.unpack_from(summary, position)
                self._read_channel_or_schema(opcode, summary[position + 9 : position + 9 + length])
                stream = ReadDataStream(BytesIO(summary[position + 9 : position + 9 + length]))
                if opcode == Opcode.STATISTICS:
                    statistics = Statistics.read(stream)
                elif opcode == Opcode.CHUNK_INDEX:
                    index = ChunkIndex.read(stream)
                    self._chunks.append(
                        _Chunk(
                            index.chunk_start_offset,
                            index.chunk_length,
                            index.message_start_time,
                            index.message_end_time,
                            index.message_index_length,
                            index.message_index_offsets,
                        )
                    )
                position += 9 + length
        except (McapError, struct.error, UnicodeDecodeError, OverflowError):
            statistics = None
        if statistics is not None:
            self._stated = statistics.channel_message_counts
        if statistics is None or not self._is_complete(statistics):
            self._schemas.clear()
            self._channels.clear()
            self._chunks.clear()
            return False
        self.start_time, self.end_time = statistics.message_start_time, statistics.message_end_time
        return True

    def _is_complete(self, statistics: Statistics) -> bool:
        """Return whether the summary describes every message: all channels, all chunks, none outside a chunk."""
        if len(self._channels) < statistics.channel_count or len(self._chunks) != statistics.chunk_count:
            return False
        if any(channel.schema_id and channel.schema_id not in self._schemas for channel in self._channels.values()):
            return False
        if statistics.message_count and not self._chunks:
            return False
        if all(chunk.index_offsets for chunk in self._chunks):
            # A message index record takes 15 bytes and 16 per message.
            indexed = sum(chunk.index_length - 15 * len(chunk.index_offsets) for chunk in self._chunks)
            return indexed == 16 * statistics.message_count
        return True

    def _read_channel_or_schema(self, opcode: int, content: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(content)))
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(content)))
            self._channels[channel.id] = channel

    def _scan(self, file: BinaryIO) -> None:
        """Walk the records from the start and list the chunks and the messages outside chunks.

        Stops, with a warning, at the first record that is cut off or damaged; the records before it are used.
        """
        position = len(MAGIC)
        loose: _Chunk | None = None
        ended, reason = False, "the file is cut off"
        first, last = _LAST_TIME, 0
        while position + 9 <= self.bytes_total:
            head = self._read_at(file, position, _PAYLOAD_OFFSET)
            opcode, length = _PREFIX.unpack_from(head)
            end = position + 9 + length
            if opcode == 0 or (opcode == Opcode.CHUNK and length < 40) or (opcode == Opcode.MESSAGE and length < 22):
                reason = "damaged record"
                break
            incomplete = end > self.bytes_total
            if opcode == Opcode.CHUNK:
                loose = None
                try:
                    raw, start, _ = _open_chunk(self._read_at(file, position, 9 + length), incomplete)
                    times = self._survey(raw, None if incomplete else position)
                except _Damage as damage:
                    if incomplete:
                        break
                    self._skipped[position] = str(damage)
                else:
                    if len(times):
                        self._chunks.append(_Chunk(position, 9 + length, start, int(times.max())))
                        first, last = min(first, int(times.min())), max(last, int(times.max()))
            if incomplete:
                break
            if opcode == Opcode.MESSAGE:
                channel, _, time, _ = _MESSAGE.unpack_from(head, 9)
                time = min(time, _LAST_TIME)
                self._counts[channel] = self._counts.get(channel, 0) + 1
                first, last = min(first, time), max(last, time)
                if loose is None or end - loose.offset > _LOOSE_REGION:
                    loose = _Chunk(position, 0, time, time, loose=True)
                    self._chunks.append(loose)
                loose.length, loose.start, loose.end = end - loose.offset, min(loose.start, time), max(loose.end, time)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._read_channel_or_schema(opcode, self._read_at(file, position + 9, length))
                except (McapError, struct.error, UnicodeDecodeError):
                    reason = "damaged record"
                    break
            elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                ended = True
                break
            position = end
        if not ended:
            self._warnings.append(
                f"{self.path}: {reason} at byte {position} of {self.bytes_total}; the messages before it are used"
            )
        self.start_time, self.end_time = (first, last) if self._chunks else (0, 0)

    def _survey(self, raw: memoryview, chunk: int | None) -> NDArray[np.int64]:
        """Count the messages of a chunk by channel; return their times. ``chunk`` as in `_walk`."""
        messages = self._walk(raw, chunk)
        for number, count in zip(*np.unique(messages.channel, return_counts=True), strict=True):
            self._counts[int(number)] = self._counts.get(int(number), 0) + int(count)
        return messages.log_time

    def _walk(self, raw: memoryview, chunk: int | None) -> _Messages:
        """Find the messages in a run of records one by one; remember channels and schemas on the way.

        Ends at the first damaged record, which is told with ``chunk``, the offset of the run in the file; None for a
        run that is known to be cut off.
        """
        channels: list[int] = []
        times: list[int] = []
        offsets: list[int] = []
        position, size = 0, len(raw)
        while position + 9 <= size:
            opcode, length = _PREFIX.unpack_from(raw, position)
            end = position + 9 + length
            if end > size or opcode == 0:
                break
            if opcode == Opcode.MESSAGE:
                if length < _MESSAGE.size:
                    break
                channel, _, time, _ = _MESSAGE.unpack_from(raw, position + 9)
                channels.append(channel)
                times.append(min(time, _LAST_TIME))
                offsets.append(position)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._read_channel_or_schema(opcode, bytes(raw[position + 9 : end]))
                except (McapError, struct.error, UnicodeDecodeError):
                    break
            position = end
        if position < size and chunk is not None:
            reason = f"damaged record at byte {position} of {size} of its messages; those before it are used"
            self._skipped.setdefault(chunk, reason)
        return _Messages(np.array(channels, np.int64), np.array(times, np.int64), np.array(offsets, np.int64))

    def blocks(self, topics: Mapping[str, str]) -> Iterator[Block]:
        """See `Source.blocks`.

        Raises:
            BagError: a wanted topic is not serialised as CDR.
        """
        wanted = {number: channel.topic for number, channel in self._channels.items() if channel.topic in topics}
        for number, topic in wanted.items():
            encoding = self._channels[number].message_encoding
            if encoding != "cdr":
                raise BagError(
                    f"{self.path}: topic {topic} is encoded as {encoding!r}; only ROS 2 messages (cdr) can be read"
                )
        for chunk in sorted(self._chunks, key=lambda chunk: (chunk.start, chunk.offset)):
            if not chunk.index_offsets or not wanted.keys().isdisjoint(chunk.index_offsets):
                yield self._block(chunk, wanted)

    def _block(self, chunk: _Chunk, wanted: dict[int, str]) -> Block:
        def load() -> dict[str, Payloads]:
            try:
                with self.path.open("rb") as file:
                    record = self._read_at(file, chunk.offset, chunk.length + chunk.index_length)
                incomplete = chunk.offset + chunk.length > self.bytes_total
                if chunk.loose:
                    raw = memoryview(record)
                else:
                    raw, _, _ = _open_chunk(memoryview(record)[: chunk.length], incomplete)
            except (_Damage, OSError) as error:
                self._skipped[chunk.offset] = str(error)
                return {}
            index = memoryview(record)[chunk.length :]
            found = self._indexed(raw, index, chunk, wanted) if chunk.index_offsets else None
            if found is None:
                found = self._walked(raw, wanted, None if incomplete else chunk.offset)
            return {topic: _payloads(raw, offsets) for topic, offsets in found.items()}

        return Block(min(chunk.start, _LAST_TIME), chunk.offset, chunk.length + chunk.index_length, load)

    def _indexed(
        self, raw: memoryview, index: memoryview, chunk: _Chunk, wanted: dict[int, str]
    ) -> dict[str, NDArray[np.int64]] | None:
        """Return the offsets of the messages of each wanted topic by the message index; None if the index is wrong."""
        found: dict[str, list[NDArray[np.int64]]] = {}
        for number, offset in chunk.index_offsets.items():
            if number not in wanted:
                continue
            begin = offset - chunk.offset - chunk.length
            if not 0 <= begin <= len(index) - 15:
                return None
            opcode, _, channel, size = struct.unpack_from("<BQHI", index, begin)
            if opcode != Opcode.MESSAGE_INDEX or channel != number or size % 16 or begin + 15 + size > len(index):
                return None
            if size == 0:
                continue
            offsets = np.frombuffer(index, "<i8", size // 8, begin + 15)[1::2]
            if not _are_messages(raw, offsets, number):
                return None
            found.setdefault(wanted[number], []).append(offsets)
        # The order of the index may differ from that of the file.
        return {topic: np.sort(np.concatenate(parts)) for topic, parts in found.items()}

    def _walked(self, raw: memoryview, wanted: dict[int, str], chunk: int | None) -> dict[str, NDArray[np.int64]]:
        messages = self._walk(raw, chunk)
        found = {}
        for topic in sorted(set(wanted.values())):
            numbers = [number for number, name in wanted.items() if name == topic]
            offsets = messages.offset[np.isin(messages.channel, numbers)]
            if len(offsets):
                found[topic] = offsets
        return found


def _gather(raw: memoryview, offsets: NDArray[np.int64], size: int) -> NDArray[np.void]:
    """Return the `size` bytes at each of `offsets` (all inside `raw`): one copy each, no Python loop."""
    windows = np.ndarray((len(raw) - size + 1,), f"V{size}", raw, 0, (1,))
    return cast("NDArray[np.void]", windows[offsets])


def _are_messages(raw: memoryview, offsets: NDArray[np.int64], channel: int) -> bool:
    """Return whether a whole message record of the channel lies at every offset."""
    if int(offsets.min()) < 0 or int(offsets.max()) > len(raw) - _PAYLOAD_OFFSET:
        return False
    heads = _gather(raw, offsets, 11).view([("opcode", "u1"), ("length", "<i8"), ("channel", "<u2")])
    lengths = heads["length"].astype(np.int64)  # out of the rows first: reductions over unaligned numbers are slow
    return bool(
        (heads["opcode"] == Opcode.MESSAGE).all()
        and (heads["channel"] == channel).all()
        and int(lengths.min()) >= _MESSAGE.size
        and int((offsets + 9 + lengths).max()) <= len(raw)
        and int(lengths.max()) <= len(raw)
    )


def _payloads(raw: memoryview, offsets: NDArray[np.int64]) -> Payloads:
    """Gather the messages at `offsets` (known to be whole message records)."""
    heads = _gather(raw, offsets, 23).view([("opcode", "u1"), ("length", "<i8"), ("ids", "V6"), ("time", "<i8")])
    lengths = heads["length"].astype(np.int64) - _MESSAGE.size
    log_time = heads["time"].astype(np.int64)
    groups: list[tuple[NDArray[np.intp] | None, NDArray[np.uint8]]] = []
    for length in [int(lengths[0])] if (lengths == lengths[0]).all() else np.unique(lengths).tolist():
        positions = None if (lengths == length).all() else np.flatnonzero(lengths == length)
        chosen = offsets if positions is None else offsets[positions]
        if length:
            rows = _gather(raw, chosen + _PAYLOAD_OFFSET, length).view(np.uint8)
        else:
            rows = np.empty(0, np.uint8)
        groups.append((positions, rows.reshape(len(chosen), length)))
    return Payloads(log_time, groups)
