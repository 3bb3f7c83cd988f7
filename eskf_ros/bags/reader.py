"""Recordings as a stream of typed batches in the order of log time, with bounded memory."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags.errors import BagError
from eskf_ros.bags.mcap_file import MAGIC, McapFile
from eskf_ros.bags.messages import UNCARRIED, StringTable, decode, message_dtype
from eskf_ros.bags.records import Batch, Block, Payloads, Source, TopicInfo
from eskf_ros.bags.row_files import RosbagsDirectory, SqliteFile

__all__ = ["BagReader", "Batch", "TopicInfo", "open_bag"]

_BATCH_MESSAGES = 8192  # smaller batches are collected: a bag with images has few other messages in a chunk


@dataclass
class _Piece:
    """Decoded messages of one topic from one block, sorted like a batch; `order` is the position of the block."""

    order: tuple[int, int]
    log_time: NDArray[np.int64]
    messages: NDArray[Any]


class BagReader:
    """One recording, in one or more files.

    Attributes:
        topics: type and message count of every topic (of all types, readable or not).
        start_time, end_time: log times of the first and the last message, ns.
        bytes_total, bytes_done: progress of `batches`, in bytes of the files.
        strings: the frame ids read so far; `frame_id` of all batches are indices into it.
        warnings: faults of the recording, one line each; complete when `batches` is exhausted.
    """

    def __init__(self, sources: Sequence[Source], warnings: Sequence[str] = ()) -> None:
        """Take opened files (`sources`) in the order given by the user.

        Raises:
            BagError: they have no message, or disagree about the type of a topic.
        """
        self._sources = sources
        self._own_warnings = list(warnings)
        self._strings = StringTable()
        self.bytes_total = sum(source.bytes_total for source in sources)
        self.bytes_done = 0
        self.topics: dict[str, TopicInfo] = {}
        for source in sources:
            for topic, info in source.topics.items():
                known = self.topics.get(topic, TopicInfo(info.type, 0))
                if known.type != info.type:
                    raise BagError(f"{source.name}: topic {topic} is {info.type} here but {known.type} in another file")
                self.topics[topic] = TopicInfo(info.type, known.count + info.count)
        filled = [source for source in sources if any(info.count for info in source.topics.values())]
        if not filled:
            names = ", ".join(source.name for source in sources)
            raise BagError("; ".join([f"{names}: the recording holds no messages", *self.warnings]))
        self.start_time = min(source.start_time for source in filled)
        self.end_time = max(source.end_time for source in filled)

    @property
    def warnings(self) -> list[str]:
        """Faults found so far, one line each."""
        return [*self._own_warnings, *(line for source in self._sources for line in source.warnings)]

    @property
    def strings(self) -> Sequence[str]:
        """The frame ids read so far."""
        return self._strings.values

    def close(self) -> None:
        """Close the files."""
        for source in self._sources:
            source.close()

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def batches(self, topics: Mapping[str, str]) -> Iterator[dict[str, Batch]]:
        """Read the recording once, from start to end.

        Batches follow each other in log time without overlap (all times of one are below all times of the next); each
        holds the topics that have messages in it. Memory is bounded by a few blocks of the file: if the time ranges of
        blocks overlap, the newer messages wait until the older blocks are read.

        Args:
            topics: topic name -> message type, as in {"imu/data": "sensor_msgs/msg/Imu"}.

        Raises:
            BagError: a topic is not in the recording, is of another type, or of a type that cannot be decoded.
        """
        for topic, type_name in topics.items():
            message_dtype(type_name)
            if topic not in self.topics:
                there = ", ".join(f"{name} ({info.type})" for name, info in sorted(self.topics.items()))
                raise BagError(f"{self._sources[0].name}: no topic {topic} in the recording; it holds {there}")
            if self.topics[topic].type != type_name:
                raise BagError(
                    f"{self._sources[0].name}: topic {topic} is of type {self.topics[topic].type}, not {type_name}"
                )
        return self._batches(topics)

    def serialised(self, topics: Iterable[str]) -> Iterator[tuple[str, Payloads]]:
        """Read the recording once and yield the messages as they are stored: (topic, messages), not strictly in order.

        Blocks come by their start time, so that messages far apart in time come in order. Topics may have any type.
        """
        for _, block in self._blocks({topic: self.topics[topic].type for topic in topics}):
            yield from block.load().items()

    def _batches(self, topics: Mapping[str, str]) -> Iterator[dict[str, Batch]]:
        self.bytes_done = 0
        found = dict.fromkeys(topics, 0)
        malformed: dict[str, int] = {}
        uncarried: dict[str, int] = {}
        misplaced = 0
        pending: dict[str, list[_Piece]] = {topic: [] for topic in topics}
        waiting = 0
        emitted = np.iinfo(np.int64).min  # every message before this time has been given out
        blocks = self._blocks(topics)
        following = next(blocks, None)
        while following:
            order, block = following
            loaded = block.load()
            following = next(blocks, None)
            for topic, payloads in loaded.items():
                found[topic] += len(payloads.log_time)
                already = self._strings.uncarried
                piece, bad = self._decode(topics[topic], payloads, order)
                if self._strings.uncarried > already:
                    uncarried[topic] = uncarried.get(topic, 0) + self._strings.uncarried - already
                if bad:
                    malformed[topic] = malformed.get(topic, 0) + bad
                late = int(np.searchsorted(piece.log_time, emitted))
                if late:
                    misplaced += late
                    piece = _Piece(order, piece.log_time[late:], piece.messages[late:])
                if len(piece.log_time):
                    pending[topic].append(piece)
                    waiting += len(piece.log_time)
            self.bytes_done += block.size
            if following is None or (waiting >= _BATCH_MESSAGES and following[1].start > emitted):
                until = following[1].start if following else None
                batch = self._take(pending, until)
                waiting = sum(len(piece.log_time) for pieces in pending.values() for piece in pieces)
                if batch:
                    emitted = until if until is not None else emitted
                    yield batch
        self.bytes_done = self.bytes_total
        stated = {topic: self.topics[topic].count for topic in topics}
        self._own_warnings += _differences(self._sources[0].name, found, stated)
        for topic, count in malformed.items():
            self._own_warnings.append(
                f"{self._sources[0].name}: "
                f"{count} messages of topic {topic} cannot be decoded as {topics[topic]}; skipped"
            )
        for topic, count in uncarried.items():
            self._own_warnings.append(f"{self._sources[0].name}: {count} messages of topic {topic} {UNCARRIED}")
        if misplaced:
            self._own_warnings.append(
                f"{self._sources[0].name}: {misplaced} messages lie outside the time range stated in the file; skipped"
            )

    def _blocks(self, topics: Mapping[str, str]) -> Iterator[tuple[tuple[int, int], Block]]:
        """Yield the blocks of all sources in the order of their start, with their position (source, position)."""

        def of_source(number: int, source: Source) -> Iterator[tuple[int, tuple[int, int], Block]]:
            for block in source.blocks(topics):
                yield block.start, (number, block.position), block

        streams = [of_source(number, source) for number, source in enumerate(self._sources)]
        for _, order, block in heapq.merge(*streams, key=lambda item: item[:2]):
            yield order, block

    def _decode(self, type_name: str, payloads: Payloads, order: tuple[int, int]) -> tuple[_Piece, int]:
        """Decode and sort the messages of a block; return also how many cannot be decoded."""
        log_time = payloads.log_time
        keep: NDArray[np.bool_] | None = None
        if len(payloads.groups) == 1 and payloads.groups[0][0] is None:
            messages, keep = decode(type_name, payloads.groups[0][1], self._strings)
        else:
            messages = np.empty(len(log_time), message_dtype(type_name))
            keep = np.ones(len(log_time), bool)
            for positions, rows in payloads.groups:
                decoded, valid = decode(type_name, rows, self._strings)
                messages[positions] = decoded
                if valid is not None:
                    keep[positions] = valid
        if keep is not None:
            log_time, messages = log_time[keep], messages[keep]
        log_time, messages = _sorted(log_time, messages)
        return _Piece(order, log_time, messages), len(payloads.log_time) - len(log_time)

    def _take(self, pending: dict[str, list[_Piece]], until: int | None) -> dict[str, Batch]:
        """Take the messages before `until` (None: all) out of `pending`."""
        batch: dict[str, Batch] = {}
        for topic, pieces in pending.items():
            taken: list[_Piece] = []
            left: list[_Piece] = []
            for piece in pieces:
                count = len(piece.log_time) if until is None else int(np.searchsorted(piece.log_time, until))
                if count:
                    taken.append(_Piece(piece.order, piece.log_time[:count], piece.messages[:count]))
                if count < len(piece.log_time):
                    left.append(_Piece(piece.order, piece.log_time[count:], piece.messages[count:]))
            pending[topic] = left
            if taken:
                taken.sort(key=lambda piece: piece.order)
                log_time = np.concatenate([piece.log_time for piece in taken])
                messages = taken[0].messages if len(taken) == 1 else np.concatenate([p.messages for p in taken])
                batch[topic] = Batch(*_sorted(log_time, messages), self._strings.values)
        return batch


def _sorted(log_time: NDArray[np.int64], messages: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[Any]]:
    if (log_time[1:] >= log_time[:-1]).all():
        return log_time, messages
    order = np.argsort(log_time, kind="stable")
    return log_time[order], messages[order]


def open_bag(paths: Sequence[Path]) -> BagReader:
    """Open a recording.

    Args:
        paths: rosbag2 directories, .mcap or .db3 files; several are read as one recording.

    Raises:
        BagError: a path does not exist, is no ROS 2 recording, or there is no message in any of them.
    """
    sources: list[Source] = []
    warnings: list[str] = []
    try:
        for path in paths:
            if path.is_dir():
                sources.extend(_open_directory(path, warnings))
            else:
                sources.append(_open_file(path))
        if not sources:
            raise BagError("no recording given")
        return BagReader(sources, warnings)
    except BaseException as error:
        for source in sources:
            source.close()
        if isinstance(error, OSError):
            raise BagError(f"{error.filename}: {error.strerror}") from error
        raise


def _open_file(path: Path) -> Source:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise BagError(f"{path}: {error.strerror}") from error
    if head.startswith(MAGIC):
        return McapFile(path)
    if head.startswith(b"SQLite format 3\x00"):
        return SqliteFile(path)
    if head.startswith(b"#ROSBAG V"):
        raise BagError(f"{path}: this is a ROS 1 bag; `rosbags-convert --src {path} --dst DIR` makes a ROS 2 bag of it")
    if not head:
        raise BagError(f"{path}: the file is empty")
    raise BagError(f"{path}: not a ROS 2 recording (a rosbag2 directory, an .mcap or a .db3 file is needed)")


def _open_directory(path: Path, warnings: list[str]) -> list[Source]:
    """Return the files of a rosbag2 directory; unreadable files become warnings as long as one can be opened."""
    metadata = path / "metadata.yaml"
    files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    information: dict[str, Any] = {}
    if metadata.exists():
        information = _read_metadata(metadata, warnings)
        if str(information.get("compression_mode")).lower() in ("message", "file"):
            return [RosbagsDirectory(path)]
        files = _listed(information, path) or files
    elif files:
        warnings.append(f"{path}: no metadata.yaml (was the recording cut off?); all files in the directory are read")
    if not files:
        raise BagError(f"{path}: not a ROS 2 recording (no metadata.yaml, .mcap or .db3 file in this directory)")
    sources: list[Source] = []
    failures: list[BagError] = []
    for file in files:
        try:
            sources.append(_open_file(file))
        except BagError as error:
            failures.append(error)
    if not sources:
        raise failures[0]
    warnings.extend(f"{failure}; the other files are used" for failure in failures)
    stated = _stated(information)
    there = {topic: sum(source.topics[topic].count for source in sources if topic in source.topics) for topic in stated}
    warnings += _differences(str(metadata), there, stated)
    return sources


def _differences(name: str, found: dict[str, int], stated: dict[str, int]) -> list[str]:
    """Return what to say of topics with another number of messages than a file states: one line, or none."""
    differing = [f"{count} of {stated[topic]} of {topic}" for topic, count in found.items() if count != stated[topic]]
    return [f"{name}: messages found, of those it states: {', '.join(differing)}"] if differing else []


def _listed(information: dict[str, Any], path: Path) -> list[Path]:
    """Return the files that metadata.yaml names; what is no list of names names none."""
    names = information.get("relative_file_paths")
    return [path / Path(name).name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def _stated(information: dict[str, Any]) -> dict[str, int]:
    """Return the numbers of messages by topic of metadata.yaml, as far as it has them."""
    found = {}
    entries = information.get("topics_with_message_count")
    for entry in entries if isinstance(entries, list) else []:
        if isinstance(entry, dict) and isinstance(entry.get("topic_metadata"), dict):
            name, count = entry["topic_metadata"].get("name"), entry.get("message_count")
            if isinstance(name, str) and isinstance(count, int):
                found[name] = count
    return found


def _read_metadata(path: Path, warnings: list[str]) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        information = YAML(typ="safe").load(path)["rosbag2_bagfile_information"]
        if not isinstance(information, dict):
            raise TypeError("not a mapping")
    except (OSError, YAMLError, KeyError, TypeError, UnicodeDecodeError) as error:
        warnings.append(f"{path}: cannot be read ({type(error).__name__}); all files in the directory are read")
        return {}
    return information
