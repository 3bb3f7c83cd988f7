"""ROS 2 messages as numpy structured arrays, and their serialised form (CDR) both ways, whole arrays at a time.

A message type is described once, in `MESSAGE_TYPES`: the fields in the order of its .msg definition, nested messages
written flat. Everything else (the dtype, decoding, encoding) follows from that table.

In memory a message is one row of `message_dtype(type_name)`:

- a time is one int64, nanoseconds (sec * 1e9 + nanosec);
- a string is an int32: its index in a `StringTable`, because nearly all messages of a topic carry the same frame id;
- everything else is the number or the fixed-length array of the definition (quaternions stay x y z w).

Point clouds have variable fields and a variable number of points: `eskf_ros.bags.clouds`.

On the wire (OMG CDR, the encoding of rosbag2): 4 bytes of encapsulation (00 01 00 00 little-endian, 00 00 00 00
big-endian), then the fields, each aligned to its own size counted from byte 4; a string is a uint32 length that counts
the closing NUL, then the bytes. The position of a field thus depends only on the lengths of the strings before it, and
messages with equal string lengths are decoded together by one structured view.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags.clouds import CLOUD_DTYPE, POINT_CLOUD, decode_cloud, encode_cloud
from eskf_ros.bags.errors import BagError
from eskf_ros.bags.records import group_by_length

_TIME = "time"
_STRING = "string"


@dataclass(frozen=True)
class Field:
    """One field: its name, `time`, `string` or a numpy scalar code, and the length of a fixed array (0: a scalar)."""

    name: str
    code: str
    count: int = 0


_HEADER = (Field("stamp", _TIME), Field("frame_id", _STRING))
_VELOCITIES = (Field("linear_velocity", "f8", 3), Field("angular_velocity", "f8", 3))
_TWIST = (*_VELOCITIES, Field("twist_covariance", "f8", 36))
_POSE = (Field("position", "f8", 3), Field("orientation", "f8", 4), Field("pose_covariance", "f8", 36))

MESSAGE_TYPES: dict[str, tuple[Field, ...]] = {
    "sensor_msgs/msg/Imu": (
        *_HEADER,
        Field("orientation", "f8", 4),
        Field("orientation_covariance", "f8", 9),
        Field("angular_velocity", "f8", 3),
        Field("angular_velocity_covariance", "f8", 9),
        Field("linear_acceleration", "f8", 3),
        Field("linear_acceleration_covariance", "f8", 9),
    ),
    "sensor_msgs/msg/NavSatFix": (
        *_HEADER,
        Field("status", "i1"),
        Field("service", "u2"),
        Field("latitude", "f8"),
        Field("longitude", "f8"),
        Field("altitude", "f8"),
        Field("position_covariance", "f8", 9),
        Field("position_covariance_type", "u1"),
    ),
    "sensor_msgs/msg/MagneticField": (
        *_HEADER,
        Field("magnetic_field", "f8", 3),
        Field("magnetic_field_covariance", "f8", 9),
    ),
    "sensor_msgs/msg/Range": (
        *_HEADER,
        Field("radiation_type", "u1"),
        Field("field_of_view", "f4"),
        Field("min_range", "f4"),
        Field("max_range", "f4"),
        Field("range", "f4"),
        Field("variance", "f4"),
    ),
    "sensor_msgs/msg/FluidPressure": (*_HEADER, Field("fluid_pressure", "f8"), Field("variance", "f8")),
    "geometry_msgs/msg/TwistStamped": (*_HEADER, *_VELOCITIES),
    "geometry_msgs/msg/TwistWithCovarianceStamped": (*_HEADER, *_TWIST),
    "geometry_msgs/msg/QuaternionStamped": (*_HEADER, Field("quaternion", "f8", 4)),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (*_HEADER, *_POSE),
    "nav_msgs/msg/Odometry": (*_HEADER, Field("child_frame_id", _STRING), *_POSE, *_TWIST),
}
"""The messages with fixed fields; those of `POINT_CLOUD` have variable ones, see `eskf_ros.bags.clouds`."""


UNCARRIED = (
    "have a second or more in header.stamp.nanosec, and were taken as sec + nanosec: the driver must carry it over, or "
    "it writes something else there"
)
"""What is said of messages with such stamps."""


class StringTable:
    """The distinct strings of a recording; messages hold indices into `values`, which only ever grows.

    `uncarried` counts the messages that were decoded with it whose stamps have a second or more of nanoseconds.
    """

    def __init__(self, values: Sequence[str] = ()) -> None:
        self.uncarried = 0
        self.values: list[str] = []
        self._index: dict[str, int] = {}
        for value in values:
            self.index(value)

    def index(self, value: str) -> int:
        """Return the index of `value`, which is appended if it is new."""
        found = self._index.get(value)
        if found is None:
            found = self._index[value] = len(self.values)
            self.values.append(value)
        return found


def _fields_of(type_name: str) -> tuple[Field, ...]:
    try:
        return MESSAGE_TYPES[type_name]
    except KeyError:
        known = ", ".join((*MESSAGE_TYPES, POINT_CLOUD))
        raise BagError(f"message type {type_name} is not one that can be read or written here ({known})") from None


@cache
def message_dtype(type_name: str) -> np.dtype[Any]:
    """Return the structured dtype of one message in memory. Raises BagError for an unknown type."""
    if type_name == POINT_CLOUD:
        return CLOUD_DTYPE
    memory_code = {_TIME: "i8", _STRING: "i4"}
    return np.dtype(
        [
            (field.name, memory_code.get(field.code, field.code), *((field.count,) if field.count else ()))
            for field in _fields_of(type_name)
        ],
        align=True,
    )


class _Layout(NamedTuple):
    """Positions of the fields of a message on the wire, for one set of string lengths and one byte order.

    `wire` and `memory` are structured dtypes with the same field names: assigning one to the other moves everything but
    times and strings. Neighbouring fields with the same layout in both are merged to one block, copied as bytes.
    """

    wire: np.dtype[Any]
    memory: np.dtype[Any]
    seconds: dict[str, int]  # byte offset of the int32 of each time; its uint32 of nanoseconds follows
    lengths: dict[str, int]  # byte offset of the uint32 length of each string; its bytes follow
    size: int


def _align(position: int, size: int) -> int:
    return -(-position // size) * size


@lru_cache(maxsize=1024)
def _layout(type_name: str, string_sizes: tuple[int, ...], order: str) -> _Layout:
    """Return the layout of a message. `string_sizes` are in bytes, the NUL counted; `order` is "<" or ">"."""
    memory_dtype = message_dtype(type_name)
    seconds: dict[str, int] = {}
    lengths: dict[str, int] = {}
    blocks: list[tuple[str, str, int, int, int]] = []  # name, format, wire offset, memory offset, bytes
    position = 0
    sizes = iter(string_sizes)
    for field in _fields_of(type_name):
        if field.code == _TIME:
            position = _align(position, 4)
            seconds[field.name] = 4 + position
            position += 8
        elif field.code == _STRING:
            position = _align(position, 4)
            lengths[field.name] = 4 + position
            position += 4 + next(sizes)
        else:
            item = np.dtype(field.code).itemsize
            position = _align(position, item)
            size = item * max(field.count, 1)
            wire_offset, memory_offset = 4 + position, memory_dtype.fields[field.name][1]  # type: ignore[index]
            previous = blocks[-1] if blocks else None
            if (
                np.dtype(order + "f8").isnative
                and previous is not None
                and previous[2] + previous[4] == wire_offset
                and previous[3] + previous[4] == memory_offset
            ):
                size += previous[4]
                blocks[-1] = (previous[0], f"V{size}", previous[2], previous[3], size)
            else:
                shape = f"({field.count},)" if field.count else ""
                blocks.append((field.name, f"{shape}{order}{field.code}", wire_offset, memory_offset, size))
            position += item * max(field.count, 1)

    def dtype(offset_column: int, itemsize: int) -> np.dtype[Any]:
        description: Any = {
            "names": [block[0] for block in blocks],
            "formats": [block[1] if offset_column == 2 else _native(block[1]) for block in blocks],
            "offsets": [block[offset_column] for block in blocks],
            "itemsize": itemsize,
        }
        return np.dtype(description)

    return _Layout(dtype(2, 4 + position), dtype(3, memory_dtype.itemsize), seconds, lengths, 4 + position)


def _native(code: str) -> str:
    return code.replace(">", "=").replace("<", "=")


def _column(rows: NDArray[np.uint8], offset: int, code: str) -> NDArray[Any]:
    """Return the number at byte `offset` of every row, as a view."""
    return np.ndarray((rows.shape[0],), code, rows, offset, (rows.shape[1],))  # type: ignore[call-overload,no-any-return]


def _structured(rows: NDArray[np.uint8], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return a structured view of the start of every row."""
    return np.ndarray((rows.shape[0],), dtype, rows, 0, (rows.shape[1],))


_ENCAPSULATION = {b"\x00\x01": "<", b"\x00\x00": ">"}


def decode(
    type_name: str, rows: NDArray[np.uint8], strings: StringTable
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Decode serialised messages of equal length.

    Args:
        type_name: a key of `MESSAGE_TYPES`.
        rows: (n, length) contiguous bytes, one serialised message per row.
        strings: the table in which the strings of the messages are looked up or added.

    Returns:
        The messages, structured, shape (n,); and None or, if some rows are no such message (too short, another
        encoding), a bool array (n,) that is False for them (their contents are then meaningless).

    Raises:
        BagError: the type is unknown.
    """
    messages = np.empty(rows.shape[0], message_dtype(type_name))
    valid = np.ones(rows.shape[0], bool)
    if type_name == POINT_CLOUD:
        for position, row in enumerate(rows):
            valid[position] = decode_cloud(row, messages[position : position + 1], strings.index)
        return messages, (None if valid.all() else valid)
    _decode_into(messages, valid, type_name, rows, strings)
    return messages, (None if valid.all() else valid)


def _decode_into(
    messages: NDArray[Any], valid: NDArray[np.bool_], type_name: str, rows: NDArray[np.uint8], strings: StringTable
) -> None:
    count, width = rows.shape
    if count == 0:
        return
    order = _ENCAPSULATION.get(rows[0, :2].tobytes(), "") if width >= 4 else ""
    sizes: list[int] = []
    deciding = [_column(rows, 0, "u2")] if order else []
    for number, field in enumerate(field for field in _fields_of(type_name) if field.code == _STRING):
        # The lengths of the strings before it determine the position of the next length.
        offset = _layout(type_name, (*sizes, *(0,) * (_string_count(type_name) - number)), order or "<").lengths[
            field.name
        ]
        if not order or offset + 4 > width:
            order = ""
            break
        deciding.append(_column(rows, offset, order + "u4"))
        sizes.append(int(deciding[-1][0]))
        if sizes[-1] > width:
            order = ""
            break
    for column in deciding:
        same = column == column[0]
        if not same.all():
            # Rows differ in byte order or a string length: decode those like the first row, then the others.
            for chosen in (same, ~same):
                part, part_valid = np.empty(int(chosen.sum()), messages.dtype), np.ones(int(chosen.sum()), bool)
                _decode_into(part, part_valid, type_name, rows[chosen], strings)
                messages[chosen], valid[chosen] = part, part_valid
            return
    layout = _layout(type_name, tuple(sizes), order) if order else None
    if layout is None or layout.size > width:
        valid[:] = False
        return
    target, source = _structured_messages(messages, layout.memory), _structured(rows, layout.wire)
    for name in layout.wire.names or ():
        target[name] = source[name]
    for name, offset in layout.seconds.items():
        stamp = messages[name]
        stamp[:] = _column(rows, offset, order + "i4")
        stamp *= 1_000_000_000
        nanoseconds = _column(rows, offset + 4, order + "u4")
        strings.uncarried += int(np.count_nonzero(nanoseconds >= 1_000_000_000))
        stamp += nanoseconds
    for (name, offset), size in zip(layout.lengths.items(), sizes, strict=True):
        messages[name] = _intern(rows[:, offset + 4 : offset + 4 + size], strings)


@cache
def _string_count(type_name: str) -> int:
    return sum(field.code == _STRING for field in _fields_of(type_name))


def _structured_messages(messages: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    return np.ndarray(messages.shape, dtype, messages, 0, messages.strides)


def _intern(text: NDArray[np.uint8], strings: StringTable) -> int | NDArray[np.int32]:
    """Return the indices of the strings in the rows of `text`, (n, size) bytes; one int if all are equal."""
    if text.shape[1] == 0 or (text == text[0]).all():
        return strings.index(_text(text[0].tobytes()))
    values, inverse = np.unique(np.ascontiguousarray(text).view(f"S{text.shape[1]}")[:, 0], return_inverse=True)
    return np.array([strings.index(_text(bytes(value))) for value in values], np.int32)[inverse]


def _text(data: bytes) -> str:
    return data.split(b"\x00", 1)[0].decode("utf-8", "replace")


def encode(type_name: str, messages: NDArray[Any], strings: Sequence[str]) -> NDArray[np.uint8] | list[bytes]:
    """Serialise messages: little-endian CDR, padding zero.

    Args:
        type_name: a key of `MESSAGE_TYPES`.
        messages: structured, (n,), of dtype `message_dtype(type_name)`.
        strings: the strings whose indices are in the string fields of the messages.

    Returns:
        (n, length) bytes, or a list of n byte strings if their lengths differ.

    Raises:
        BagError: the type is unknown.
        IndexError: a string field is not an index into `strings`.
    """
    groups = list(encode_groups(type_name, messages, strings))
    if len({rows.shape[1] for _, rows in groups}) == 1:
        encoded = np.empty((len(messages), groups[0][1].shape[1]), np.uint8)
        for chosen, rows in groups:
            encoded[chosen] = rows
        return encoded
    payloads: list[bytes] = [b""] * len(messages)
    for chosen, rows in groups:
        for position, row in zip(np.arange(len(messages))[chosen], rows, strict=True):
            payloads[position] = row.tobytes()
    return payloads


def encode_groups(
    type_name: str, messages: NDArray[Any], strings: Sequence[str]
) -> Iterator[tuple[slice | NDArray[np.intp], NDArray[np.uint8]]]:
    """Yield groups of equal length, encoded as by `encode`: (which messages, their bytes (m, length))."""
    if type_name == POINT_CLOUD:
        payloads = [encode_cloud(message, strings[int(message["frame_id"])]) for message in messages]
        if payloads:
            for positions, rows in group_by_length(payloads):
                yield slice(0, len(messages)) if positions is None else positions, rows
        return
    names = [field.name for field in _fields_of(type_name) if field.code == _STRING]
    if not len(messages):
        return
    if all((messages[name] == messages[name][0]).all() for name in names):
        groups: list[slice | NDArray[np.intp]] = [slice(0, len(messages))]
    else:
        codes = np.stack([messages[name] for name in names], axis=1)
        _, inverse = np.unique(codes, axis=0, return_inverse=True)
        groups = [np.flatnonzero(inverse.ravel() == group) for group in range(int(inverse.max()) + 1)]
    for chosen in groups:
        part = messages[chosen]
        texts = [strings[int(part[name][0])].encode() + b"\x00" for name in names]
        layout = _layout(type_name, tuple(len(text) for text in texts), "<")
        rows = np.zeros((len(part), layout.size), np.uint8)
        rows[:, 1] = 1
        target, source = _structured(rows, layout.wire), _structured_messages(part, layout.memory)
        for name in layout.wire.names or ():
            target[name] = source[name]
        for name, offset in layout.seconds.items():
            seconds, nanoseconds = np.divmod(part[name], 1_000_000_000)
            _column(rows, offset, "<i4")[:] = seconds
            _column(rows, offset + 4, "<u4")[:] = nanoseconds
        for text, offset in zip(texts, layout.lengths.values(), strict=True):
            _column(rows, offset, "<u4")[:] = len(text)
            rows[:, offset + 4 : offset + 4 + len(text)] = np.frombuffer(text, np.uint8)
        yield chosen, rows
