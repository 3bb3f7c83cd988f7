"""Records that the file formats share: a recording is a sequence of blocks of serialised messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TopicInfo:
    """Type (as in `sensor_msgs/msg/Imu`) and number of messages of a topic."""

    type: str
    count: int


@dataclass
class Batch:
    """Messages of one topic, sorted by (log time, order in the file)."""

    log_time: NDArray[np.int64]  # (n,) ns
    messages: NDArray[Any]  # (n,) structured, see `message_dtype`
    strings: Sequence[str]  # what `frame_id` (and `child_frame_id`) of the messages are indices into


class Payloads(NamedTuple):
    """Serialised messages of one topic in file order: times (n,) int64 ns, and the payloads in groups of equal length.

    A group is (positions in `times`, or None for all of them in order; bytes (m, length) uint8).
    """

    log_time: NDArray[np.int64]
    groups: list[tuple[NDArray[np.intp] | None, NDArray[np.uint8]]]


@dataclass
class Block:
    """A part of a recording that is read in one go.

    No message in it is older than `start`; `position` orders the blocks as they lie in the file. `load` reads it
    and finds the messages of each wanted topic. (Reading one block ahead in a worker thread was measured: no gain.)
    """

    start: int
    position: int
    size: int
    load: Callable[[], dict[str, Payloads]]


class Source(Protocol):
    """One file of a recording. Times are log times in ns; `warnings` (one line each) grows while blocks are read."""

    name: str
    topics: dict[str, TopicInfo]
    start_time: int
    end_time: int
    bytes_total: int

    @property
    def warnings(self) -> list[str]: ...

    def blocks(self, topics: Mapping[str, str]) -> Iterator[Block]:
        """Yield the blocks with messages of `topics` (name -> type) in the order of their start.

        A block is loaded before the next one is requested.
        """
        ...

    def close(self) -> None: ...


def group_by_length(payloads: Sequence[bytes]) -> list[tuple[NDArray[np.intp] | None, NDArray[np.uint8]]]:
    """Return byte strings in groups of equal length, see `Payloads`."""
    lengths = np.fromiter(map(len, payloads), np.intp, len(payloads))
    distinct = np.unique(lengths)
    if len(distinct) == 1:
        rows = np.frombuffer(b"".join(payloads), np.uint8)
        return [(None, rows.reshape(len(payloads), int(distinct[0])))]
    groups: list[tuple[NDArray[np.intp] | None, NDArray[np.uint8]]] = []
    for length in distinct:
        positions = np.flatnonzero(lengths == length)
        rows = np.frombuffer(b"".join([payloads[position] for position in positions.tolist()]), np.uint8)
        groups.append((positions, rows.reshape(len(positions), int(length))))
    return groups
