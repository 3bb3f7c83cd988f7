"""Recordings read message by message: sqlite3 files, and directories that only the rosbags library reads."""

from __future__ import annotations

import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from eskf_ros.bags.errors import BagError, one_line
from eskf_ros.bags.records import Block, Payloads, TopicInfo, group_by_length

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

_ROWS_PER_BLOCK = 8192
_BYTES_PER_BLOCK = 16 << 20

Row = tuple[str, int, bytes]  # topic, log time (ns), serialised message


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
        wanted = {topic: info.count for topic, info in self.topics.items() if topic in topics and info.count}
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
            try:
                topics = self._connection.execute("SELECT id, name, type FROM topics").fetchall()
            except BaseException:
                self._connection.close()
                raise
        except (sqlite3.Error, ValueError) as error:  # ValueError: an error text that is no UTF-8 (CPython)
            raise BagError(f"{path}: cannot be read as a rosbag2 sqlite3 file ({one_line(error)})") from error
        self._names: dict[int, str] = {number: name for number, name, _ in topics}
        self._damaged = False
        counts: dict[int, tuple[int, int, int]] = {}
        try:
            for number, *values in self._connection.execute(
                "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
            ):
                count, first, last = map(int, values)
                counts[number] = (count, first, last)
        except (sqlite3.Error, TypeError, ValueError):
            self._damaged = True
            counts = self._count_survivors()
        self.topics = {}
        for number, name, type_name in topics:
            known = self.topics[name].count if name in self.topics else 0
            self.topics[name] = TopicInfo(type_name, known + counts.get(number, (0, 0, 0))[0])
        self.start_time = min((first for _, first, _ in counts.values()), default=0)
        self.end_time = max((last for _, _, last in counts.values()), default=0)

    def _count_survivors(self) -> dict[int, tuple[int, int, int]]:
        counts: dict[int, tuple[int, int, int]] = {}
        try:
            for number, time in self._connection.execute("SELECT topic_id, timestamp FROM messages NOT INDEXED"):
                count, first, last = counts.get(number, (0, time, time))
                counts[number] = (count + 1, min(first, time), max(last, time))
        except (sqlite3.Error, TypeError, ValueError) as error:
            done = sum(count for count, _, _ in counts.values())
            self.warnings.append(
                f"{self.name}: damaged after {done} messages ({one_line(error)}); the messages before are used"
            )
        return counts

    def _rows(self, topics: Container[str]) -> Iterator[Row]:
        numbers = {number: name for number, name in self._names.items() if name in topics}
        chosen = ",".join(map(str, numbers))
        # Sorting needs every row; in a damaged file the rows are taken as they lie, which is the order of recording.
        table, order = ("messages NOT INDEXED", "") if self._damaged else ("messages", " ORDER BY timestamp, id")
        query = f"SELECT topic_id, timestamp, data FROM {table} WHERE topic_id IN ({chosen}){order}"
        with closing(self._connection.cursor()) as cursor:
            try:
                for number, time, data in cursor.execute(query):
                    yield numbers[number], int(time), bytes(data)
            except (sqlite3.Error, TypeError, ValueError):
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
        except Exception as error:  # damaged input surfaces as many types there
            raise BagError(f"{path}: {one_line(error)}") from error
        self.topics = {name: TopicInfo(info.msgtype or "", info.msgcount) for name, info in self._reader.topics.items()}
        counted = self._reader.message_count > 0
        self.start_time, self.end_time = (self._reader.start_time, self._reader.end_time - 1) if counted else (0, 0)
        self.bytes_total = sum(file.stat().st_size for file in path.iterdir() if file.is_file())

    def _rows(self, topics: Container[str]) -> Iterator[Row]:
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        for connection, log_time, data in self._reader.messages(connections):
            yield connection.topic, log_time, bytes(data)

    def close(self) -> None:
        """Close the files and remove the temporary ones."""
        self._reader.close()
