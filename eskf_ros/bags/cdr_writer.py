"""Serialised messages with variable parts, one at a time: diagnostics, transforms, paths.

The encoding is that of `messages`: little-endian CDR, each number aligned to its own size counted from byte 4. It is
for messages that are written once a second; `messages.encode` is for whole arrays.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
DIAGNOSTIC_STATUS = "diagnostic_msgs/msg/DiagnosticStatus"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
PATH = "nav_msgs/msg/Path"

OK, WARN, ERROR = 0, 1, 2
"""Levels of diagnostic_msgs/DiagnosticStatus."""

Pose = tuple[float, ...]
"""x y z (m), then the quaternion x y z w."""


class Status(NamedTuple):
    """One diagnostic_msgs/DiagnosticStatus of this package."""

    level: int
    name: str
    message: str
    values: Mapping[str, str]


@lru_cache(maxsize=4096)
def _string(text: str) -> bytes:
    """Return a string, padded to four bytes: its length with the closing NUL, its bytes. Names come again and again."""
    encoded = text.encode() + b"\x00"
    return struct.pack("<I", len(encoded)) + encoded + bytes(-len(encoded) % 4)


class _Message:
    """A message that grows field by field."""

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")

    def numbers(self, code: str, *values: float) -> None:
        """Append numbers of one struct code."""
        size = struct.calcsize(code)
        self.data += bytes(-(len(self.data) - 4) % size)
        self.data += struct.pack(f"<{len(values)}{code}", *values)

    def strings(self, *texts: str) -> None:
        """Append strings, the last one without the padding that only another number or string would need."""
        self.data += bytes(-len(self.data) % 4) + b"".join(map(_string, texts))
        del self.data[len(self.data) - (-len(texts[-1].encode()) - 1) % 4 :]

    def header(self, stamp: int, frame: str) -> None:
        """Append a std_msgs/Header; ``stamp`` in ns."""
        seconds, nanoseconds = divmod(stamp, 1_000_000_000)
        self.numbers("i", seconds, nanoseconds)
        self.strings(frame)

    def status(self, status: Status) -> None:
        """Append a diagnostic_msgs/DiagnosticStatus."""
        self.numbers("B", status.level)
        self.strings(status.name, status.message, "eskf_ros")
        self.numbers("I", len(status.values))
        if status.values:
            self.strings(*chain.from_iterable(status.values.items()))


def diagnostic_status(status: Status) -> bytes:
    """Return a diagnostic_msgs/DiagnosticStatus."""
    message = _Message()
    message.status(status)
    return bytes(message.data)


def diagnostic_array(stamp: int, statuses: Iterable[Status]) -> bytes:
    """Return a diagnostic_msgs/DiagnosticArray; ``stamp`` in ns."""
    message, listed = _Message(), list(statuses)
    message.header(stamp, "")
    message.numbers("I", len(listed))
    for status in listed:
        message.status(status)
    return bytes(message.data)


def transforms(stamps: NDArray[np.int64], frame: str, child: str, poses: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return tf2_msgs/TFMessage (n, length), each with the pose (n, 7) of ``child`` in ``frame`` at a stamp (n,) ns."""
    message = _Message()
    message.numbers("I", 1)
    message.header(0, frame)
    message.strings(child)
    message.numbers("d", *(0.0,) * 7)
    rows = np.tile(np.frombuffer(bytes(message.data), np.uint8), (len(stamps), 1))
    # After the encapsulation and the count: seconds and nanoseconds; the pose is the end.
    times = np.stack(np.divmod(stamps, 1_000_000_000), axis=1).astype("<u4")
    rows[:, 8:16] = times.view(np.uint8)
    rows[:, -56:] = np.ascontiguousarray(poses, "<f8").view(np.uint8)
    return rows


def path(frame: str, poses: Iterable[tuple[int, Pose]]) -> bytes:
    """Return a nav_msgs/Path of (stamp in ns, pose), stamped as its first pose."""
    message, listed = _Message(), list(poses)
    message.header(listed[0][0] if listed else 0, frame)
    message.numbers("I", len(listed))
    for stamp, pose in listed:
        message.header(stamp, frame)
        message.numbers("d", *pose)
    return bytes(message.data)
