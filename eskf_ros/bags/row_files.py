"""Recordings read message by message: sqlite3 files, and directories that only the rosbags library reads."""

from __future__ import annotations

import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import IO, TYPE_CHECKING, NamedTuple

import numpy as np

from eskf_ros.bags.errors import BagError, one_line
from eskf_ros.bags.records import Block, Payloads, TopicInfo, group_by_length

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

_ROWS_PER_BLOCK = 8192
_BYTES_PER_BLOCK = 16 << 20

Row = tuple[str, int, bytes]  # topic, log time (ns), serialised message

_SOUND = "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"
"""Rows of the table of messages that can be messages: any column of sqlite3 takes any type of value."""


class _RowSource:
    """Blocks made of rows that come in the order of their log time."""

    name: str
    topics: dict[str, TopicInfo]
    start_time: int
    end_time: int
    bytes_total: int
    warnings: list[str]

    def _rows(self, topics: Container[str]) -> Iterator[Row]:
        raise NotImplementedError

    def blocks(self, topics: Mapping[str, str]) -> Iterator[Block]:
        """See `Source.blocks`."""
        wanted = {topic: info.count for topic, info in self.topics.items() if topic in topics}
        remaining = sum(wanted.values())
        bytes_per_row = self.bytes_total / max(remaining, 1)
        rows = self._survivors(wanted)
        first = next(rows, None)
        position = 0

        def load() -> dict[str, Payloads]:
            nonlocal first
            if first is None:
                return {}
            block, size = [first], len(first[2])
            first = None
            for row in rows:
                if (len(block) >= _ROWS_PER_BLOCK or size >= _BYTES_PER_BLOCK) and row[1] > block[-1][1]:
                    first = row
                    break
                block.append(row)
                size += len(row[2])
            return _by_topic(block)

        while first is not None:
            count = min(remaining, _ROWS_PER_BLOCK)
            remaining -= count
            position += 1
            yield Block(first[1], position, int(count * bytes_per_row), load)

    def _survivors(self, wanted: Mapping[str, int]) -> Iterator[Row]:
        """Yield the rows up to the first damage, which becomes a warning."""
        rows = self._rows(wanted)
        done = 0
        while True:
            try:
                row = next(rows, None)
            except Exception as error:  # any of three libraries, on damaged input: what was read is used
                total = sum(wanted.values())
                self.warnings.append(
                    f"{self.name}: damaged after {done} of {total} messages of {', '.join(wanted)} "
                    f"({one_line(error)}); the messages before are used"
                )
                return
            if row is None:
                return
            done += 1
            yield row


def _by_topic(rows: Sequence[Row]) -> dict[str, Payloads]:
    found = {}
    for topic in sorted({row[0] for row in rows}):
        chosen = [row for row in rows if row[0] == topic]
        log_time = np.array([row[1] for row in chosen], np.int64)
        found[topic] = Payloads(log_time, group_by_length([row[2] for row in chosen]))
    return found


class _Count(NamedTuple):
    """Number of messages, and log times (ns) of the first and the last."""

    messages: int
    first: int
    last: int

    def joined(self, other: _Count | None) -> _Count:
        """Return the same of both."""
        if other is None:
            return self
        return _Count(self.messages + other.messages, min(self.first, other.first), max(self.last, other.last))


class SqliteFile(_RowSource):
    """One .db3 file as a `Source`."""

    def __init__(self, path: Path) -> None:
        """Open the file and count its messages.

        Raises:
            BagError: it cannot be opened or is no rosbag2 file.
        """
        self.name = str(path)
        self.warnings = []
        self.bytes_total = path.stat().st_size
        # A write-ahead log beside the file (of a recorder that was killed) contains the newest messages.
        access = "mode=ro" if path.with_name(path.name + "-wal").exists() else "mode=ro&immutable=1"
        self._copy = _without_partial_page(path)
        address = (Path(self._copy.name) if self._copy else path.absolute()).as_uri()
        try:
            self._connection = sqlite3.connect(f"{address}?{access}", uri=True)
            self._connection.text_factory = lambda text: text.decode("utf-8", "replace")
            try:
                topics = self._connection.execute("SELECT id, name, type FROM topics").fetchall()
            except BaseException:
                self._connection.close()
                raise
        except (sqlite3.Error, ValueError) as error:  # ValueError: an error text that is no UTF-8 (CPython)
            raise BagError(f"{path}: cannot be read as a rosbag2 sqlite3 file ({one_line(error)})") from error
        sound = [row for row in topics if tuple(map(type, row)) == (int, str, str) and row[1]]
        if len(sound) < len(topics):
            self.warnings.append(f"{path}: {len(topics) - len(sound)} of {len(topics)} topics cannot be read; skipped")
        self._names: dict[int, str] = {number: name for number, name, _ in sound}
        self._damaged = False
        try:
            counts = self._count(by_sqlite=True)
        except sqlite3.Error:
            self._damaged = True
            counts = self._count(by_sqlite=False)
        self.topics = {}
        for number, name, type_name in sound:
            known = self.topics[name].count if name in self.topics else 0
            self.topics[name] = TopicInfo(type_name, known + (counts[number].messages if number in counts else 0))
        known_counts = [counts[number] for number in self._names if number in counts]
        self.start_time = min((count.first for count in known_counts), default=0)
        self.end_time = max((count.last for count in known_counts), default=0)

    def _count(self, by_sqlite: bool) -> dict[int, _Count]:
        """Return what is known of the messages of each topic, and tell which rows are missing or cannot be read.

        Raises:
            sqlite3.Error: the file is damaged; not if counted row by row, which ends where the damage begins.
        """
        counts: dict[int, _Count] = {}
        total = strange = 0
        first_id, last_id = None, 0
        columns = "topic_id, %s, %s, %s, %s, %s"
        grouped = columns % ("timestamp", "timestamp", "1", "id", "id")
        if by_sqlite:
            grouped = columns % ("min(timestamp)", "max(timestamp)", "count(*)", "min(id)", "max(id)")
        table = "messages" if by_sqlite else "messages NOT INDEXED"
        grouping = " GROUP BY topic_id, sound" if by_sqlite else ""
        try:
            for number, first, last, count, low, high, sound in self._connection.execute(
                f"SELECT {grouped}, ({_SOUND}) AS sound FROM {table}{grouping}"
            ):
                total += count
                first_id, last_id = low if first_id is None else min(first_id, low), max(last_id, high)
                if sound and number in self._names:
                    counts[number] = _Count(count, first, last).joined(counts.get(number))
                else:
                    strange += count
        except sqlite3.Error as error:
            if by_sqlite:
                raise
            self.warnings.append(
                f"{self.name}: damaged after {total} messages ({one_line(error)}); the messages before are used"
            )
        if strange:
            self.warnings.append(f"{self.name}: {strange} of {total} messages have no topic, time or content; skipped")
        missing = last_id - (first_id or 1) + 1 - total
        if missing > 0:
            self.warnings.append(f"{self.name}: {missing} messages between the {total} that are there are missing")
        return counts

    def _rows(self, topics: Container[str]) -> Iterator[Row]:
        numbers = {number: name for number, name in self._names.items() if name in topics}
        chosen = ",".join(map(str, numbers))
        # Sorting needs every row; in a damaged file the rows are taken as they lie, which is the order of recording.
        table, order = ("messages NOT INDEXED", "") if self._damaged else ("messages", " ORDER BY timestamp, id")
        query = f"SELECT topic_id, timestamp, data FROM {table} WHERE topic_id IN ({chosen}) AND {_SOUND}{order}"
        with closing(self._connection.cursor()) as cursor:
            try:
                for number, time, data in cursor.execute(query):
                    yield numbers[number], time, data
            except sqlite3.Error:
                if not self._damaged:
                    raise

    def close(self) -> None:
        """Close the database."""
        self._connection.close()
        if self._copy:
            self._copy.close()


def _without_partial_page(path: Path) -> IO[bytes] | None:
    """Return a temporary copy without the last page, if that page is cut off, else None.

    sqlite3 would fill the page with zeros and return the message across the cut as if it were complete.
    """
    with path.open("rb") as file:
        (page_size,) = struct.unpack(">16xH", file.read(18).ljust(18, b"\x00"))
        page_size = 65536 if page_size == 1 else page_size
        size = path.stat().st_size
        if page_size < 512 or size % page_size == 0:
            return None
        copy = tempfile.NamedTemporaryFile(suffix=".db3")  # noqa: SIM115 (lives as long as the reader)
        file.seek(0)
        shutil.copyfileobj(file, copy)
    copy.truncate(size - size % page_size)
    copy.flush()
    return copy


class RosbagsDirectory(_RowSource):
    """A rosbag2 directory read by the rosbags library: compression by message or by file."""

    def __init__(self, path: Path) -> None:
        """Open the directory; compressed files are unpacked to a temporary folder.

        Raises:
            BagError: rosbags cannot open it.
        """
        from rosbags.rosbag2 import Reader

        self.name = str(path)
        self.warnings = []
        try:
            self._reader: Reader = Reader(path)
            self._reader.open()
            self._describe(path)
        except Exception as error:  # damaged input surfaces as many types there
            raise BagError(f"{path}: {one_line(error)}") from error

    def _describe(self, path: Path) -> None:
        self.topics = {name: TopicInfo(info.msgtype or "", info.msgcount) for name, info in self._reader.topics.items()}
        counted = self._reader.message_count > 0
        self.start_time, self.end_time = (self._reader.start_time, self._reader.end_time - 1) if counted else (0, 0)
        self.bytes_total = sum(file.stat().st_size for file in path.iterdir() if file.is_file())

    def _rows(self, topics: Container[str]) -> Iterator[Row]:
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        for connection, log_time, data in self._reader.messages(connections):
            if type(log_time) is int and isinstance(data, (bytes, memoryview)):
                yield connection.topic, log_time, bytes(data)

    def close(self) -> None:
        """Close the files and remove the temporary ones."""
        self._reader.close()
