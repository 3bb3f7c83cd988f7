"""sensor_msgs/PointCloud2 in recordings: one message is a row of stamp, frame and its points.

The points are a structured array with the fields of the sender, an object in the row: messages of one topic differ in
the number of their points, but can still be sorted and joined as rows.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.cloud import CloudError, PointField, fields_of, points

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"

CLOUD_DTYPE = np.dtype([("stamp", "i8"), ("frame_id", "i4"), ("points", "O")], align=True)
"""``stamp`` ns, ``frame_id`` an index into the strings, ``points`` a structured array (n,), see `gnss.cloud`."""

_MOST_FIELDS = 1000
"""Fields of a point that are read, at most; more are damage."""


def cloud_messages(stamps: NDArray[np.int64], clouds: Sequence[NDArray[Any]], frame_id: int = 0) -> NDArray[Any]:
    """Return messages (CLOUD_DTYPE) with the points of ``clouds``."""
    messages = np.empty(len(clouds), CLOUD_DTYPE)
    messages["stamp"], messages["frame_id"] = stamps, frame_id
    for position, cloud in enumerate(clouds):
        messages["points"][position] = cloud
    return messages


class _Wire:
    """Reads numbers of a CDR message one after the other, each aligned to its size counted from byte 4."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data = data
        self.position = 4
        self._order = order

    def number(self, code: str) -> int:
        size = struct.calcsize(code)
        start = 4 + -(-(self.position - 4) // size) * size
        (value,) = struct.unpack_from(self._order + code, self.data, start)
        self.position = start + size
        return int(value)

    def text(self) -> str:
        text = self.skip(self.number("I"))
        return text.split(b"\x00", 1)[0].decode("utf-8", "replace")

    def skip(self, length: int) -> bytes:
        text = self.data[self.position : self.position + length]
        if len(text) < length:
            raise struct.error
        self.position += length
        return text


@lru_cache(maxsize=64)
def _fields(block: bytes, count: int, order: str) -> tuple[PointField, ...]:
    """Return the fields in their part of a message."""
    wire = _Wire(b"\x00" * 4 + block, order)
    return tuple(PointField(wire.text(), wire.number("I"), wire.number("B"), wire.number("I")) for _ in range(count))


def _fields_end(data: bytes, start: int, count: int, order: str) -> int:
    """Return the end of the fields that begin at ``start`` (aligned to 4); `_fields` is cached by their bytes."""
    length = struct.Struct(order + "I")
    position = start
    for _ in range(count):
        # Name, offset, type, count; all but the type are aligned to 4.
        position += 4 + length.unpack_from(data, position)[0]
        position += -position % 4 + 12
    return position


def decode_cloud(payload: NDArray[np.uint8], message: NDArray[Any], index: Callable[[str], int]) -> bool:
    """Decode a serialised message into a row, ``message`` (1,) of CLOUD_DTYPE; return False if it is not a cloud.

    ``index`` gives the index of a frame id.
    """
    data = payload.tobytes()
    order = {b"\x00\x01": "<", b"\x00\x00": ">"}.get(data[:2])
    message["points"] = None
    if order is None:
        return False
    wire = _Wire(data, order)
    try:
        stamp = wire.number("i") * 1_000_000_000 + wire.number("I")
        frame = wire.text()
        height, width, count = wire.number("I"), wire.number("I"), wire.number("I")
        if count > _MOST_FIELDS:
            return False
        start = wire.position
        fields = _fields(wire.skip(_fields_end(data, start, count, order) - start), count, order)
        big_endian = bool(wire.number("B"))
        point_step, row_step, size = wire.number("I"), wire.number("I"), wire.number("I")
        content = memoryview(data)[wire.position : wire.position + size]
        wire.position += size
        wire.number("B")
        found = points(fields, content, height, width, point_step, row_step, big_endian)
    except (struct.error, CloudError):
        return False
    message["stamp"], message["frame_id"] = stamp, index(frame)
    message["points"][0] = found
    return True


def encode_cloud(message: np.void, frame: str) -> bytes:
    """Serialise a row of CLOUD_DTYPE: little-endian CDR; the byte order of the points is that of their array."""
    found = np.ascontiguousarray(message["points"])
    fields = fields_of(found.dtype)
    big_endian = any(found.dtype[field.name].base.str[0] == ">" for field in fields)
    wire = bytearray(b"\x00\x01\x00\x00")

    def number(code: str, value: int) -> None:
        size = struct.calcsize(code)
        wire.extend(b"\x00" * (-(len(wire) - 4) % size) + struct.pack("<" + code, value))

    def text(value: str) -> None:
        encoded = value.encode() + b"\x00"
        number("I", len(encoded))
        wire.extend(encoded)

    seconds, nanoseconds = divmod(int(message["stamp"]), 1_000_000_000)
    number("i", seconds)
    number("I", nanoseconds)
    text(frame)
    for value in (1, len(found), len(fields)):
        number("I", value)
    for field in fields:
        text(field.name)
        number("I", field.offset)
        number("B", field.datatype)
        number("I", field.length)
    number("B", big_endian)
    for value in (found.dtype.itemsize, found.dtype.itemsize * len(found), found.nbytes):
        number("I", value)
    wire.extend(found.tobytes())
    number("B", 1)
    return bytes(wire)
