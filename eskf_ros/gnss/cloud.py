"""The topic `gnss/ranges`: points of a sensor_msgs/PointCloud2 and the ranges of an epoch, both ways.

Knows the layout of the message but no ROS: a cloud is its list of fields and its bytes, seen as a structured array with
the fields of the sender (`points`). Node, replay and simulator share it. The fields are found by name; their order,
padding, byte order and number types are those of the sender, and unknown names are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.ranges import (
    ALREADY_TURNED,
    CODE_VALID,
    DOPPLER_VALID,
    SATELLITE_KNOWN,
    Status,
    allocate_ranges,
)
from eskf_ros.gnss.signals import GNSS_COUNT, SIGNAL_BY_UBLOX, SIGNALS, UNKNOWN_SIGNAL, Gnss
from eskf_ros.gnss.time import SECONDS_PER_WEEK

MAX_SIGNALS = 200
"""Signals of an epoch that are read, at most; the sky has fewer, a cloud with more is probably that of a lidar."""

REQUIRED = ("gnss_id", "sv_id", "gps_week", "gps_tow", "pseudorange")

NUMBER_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""numpy codes of the constants of sensor_msgs/PointField."""

_DATATYPES = {code: datatype for datatype, code in NUMBER_TYPES.items()}


class CloudError(ValueError):
    """A cloud does not have what its topic needs. The text is one line for the user."""


class PointField(NamedTuple):
    """A field as in sensor_msgs/PointField, whose count is ``length`` here; 0, which some senders leave, means 1."""

    name: str
    offset: int
    datatype: int
    length: int = 1


@lru_cache(maxsize=64)
def point_dtype(fields: tuple[PointField, ...], point_step: int, big_endian: bool) -> np.dtype[Any]:
    """Return the structured dtype of a point. Raises CloudError for impossible fields."""
    order = ">" if big_endian else "<"
    names, formats, offsets = [], [], []
    for field in fields:
        code = NUMBER_TYPES.get(field.datatype)
        if not field.name or code is None:
            continue
        if field.name in names:
            raise CloudError(f"field {field.name} is there twice")
        size = np.dtype(code).itemsize * max(field.length, 1)
        if field.offset + size > point_step:
            raise CloudError(f"field {field.name} ends at byte {field.offset + size} of points of {point_step} bytes")
        names.append(field.name)
        formats.append(f"({field.length},){order}{code}" if field.length > 1 else f"{order}{code}")
        offsets.append(field.offset)
    layout: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": point_step}
    return np.dtype(layout)


def points(
    fields: Sequence[PointField],
    data: Any,
    height: int,
    width: int,
    point_step: int,
    row_step: int,
    big_endian: bool,
) -> NDArray[Any]:
    """Return the points (height x width,) of a cloud as a view of ``data`` (bytes).

    Raises CloudError if the fields or the amount of data do not fit.
    """
    dtype = point_dtype(tuple(fields), point_step, big_endian)
    row = row_step if height > 1 else width * point_step
    if row < width * point_step:
        raise CloudError(f"rows of {row} bytes are too short for {width} points of {point_step} bytes")
    needed = (height - 1) * row + width * point_step if height and width else 0
    available = memoryview(data).nbytes
    if needed > available:
        raise CloudError(f"{available} bytes of data for {height} x {width} points of {point_step} bytes")
    if not needed:
        return np.zeros(0, dtype)
    found: NDArray[Any] = np.ndarray((height, width), dtype, data, 0, (row, point_step))
    return found.reshape(-1)


def points_of(message: Any) -> NDArray[Any]:
    """Return the points of a sensor_msgs/PointCloud2 object of a ROS client library. Raises CloudError."""
    fields = [PointField(field.name, field.offset, field.datatype, field.count) for field in message.fields]
    data, height, width = message.data, message.height, message.width
    return points(fields, data, height, width, message.point_step, message.row_step, bool(message.is_bigendian))


def fields_of(dtype: np.dtype[Any]) -> list[PointField]:
    """Return the fields of a structured dtype."""
    fields = []
    for name in dtype.names or ():
        kind, offset = dtype[name], (dtype.fields or {})[name][1]  # type: ignore[index]
        fields.append(PointField(name, offset, _DATATYPES[kind.base.str[1:]], math.prod(kind.shape)))
    return fields


def number_column(found: NDArray[Any], name: str, missing: float = math.nan) -> NDArray[np.float64]:
    """Return a field of points as float64, or ``missing`` without such a field. Raises CloudError for a list."""
    if name not in (found.dtype.names or ()):
        return np.full(len(found), missing)
    if found.dtype[name].shape:
        raise CloudError(f"field {name} holds {math.prod(found.dtype[name].shape)} numbers, not one")
    with np.errstate(invalid="ignore"):  # of a damaged message: a signalling NaN
        return np.asarray(found[name]).astype(np.float64)


def whole_column(found: NDArray[Any], name: str, missing: int) -> NDArray[np.int64]:
    """Return a field of points as integers; -1 for what is no integer or has more than 32 bits."""
    if name in (found.dtype.names or ()) and found.dtype[name].str[1:] in ("u1", "u2", "i2"):
        return np.asarray(found[name]).astype(np.int64)
    numbers = number_column(found, name, missing)
    whole = np.isfinite(numbers) & (np.abs(numbers) < 2.0**31)
    return np.where(whole, np.rint(np.where(whole, numbers, 0.0)), -1.0).astype(np.int64)


def require(found: NDArray[Any], names: Sequence[str]) -> None:
    """Raise CloudError naming those of ``names`` that the points lack."""
    there = found.dtype.names or ()
    missing = [name for name in names if name not in there]
    if missing:
        raise CloudError(f"no field {', '.join(missing)} (fields: {', '.join(there) or 'none'})")


@dataclass
class Epoch:
    """The measurements of a receiver at one instant.

    ``week``, ``seconds``: GPS time by its own clock (seconds NaN if no time tag is a time). ``ranges``: RANGE, not
    located; unusable ones with their status. ``left_out``: points beyond `MAX_SIGNALS`, which are not read.
    """

    week: int
    seconds: float
    ranges: NDArray[np.void]
    left_out: int = 0


def read_epoch(found: NDArray[Any]) -> Epoch:
    """Return the epoch in the points of a cloud. Raises CloudError if a required field is missing, naming it.

    Ranges whose time tag differs from that of most of the others get the status WRONG_TIME: they belong to another
    epoch.
    """
    require(found, REQUIRED)
    left_out = max(0, len(found) - MAX_SIGNALS)
    found = found[:MAX_SIGNALS]
    ranges = allocate_ranges(len(found))
    ranges["gnss_id"], ranges["sv_id"] = whole_column(found, "gnss_id", -1), whole_column(found, "sv_id", -1)
    for name in ("carrier_hz", "pseudorange", "pseudorange_std", "doppler", "doppler_std", "cn0"):
        ranges[name] = number_column(found, name)
    ranges["signal"] = _signals(ranges["gnss_id"], ranges["carrier_hz"], found)
    for axis, letter in enumerate("xyz"):
        ranges["satellite"][:, axis] = number_column(found, f"sat_{letter}")
        ranges["satellite_velocity"][:, axis] = number_column(found, f"sat_v{letter}")
    ranges["satellite_clock"] = number_column(found, "sat_clk")
    ranges["satellite_clock_drift"] = number_column(found, "sat_clk_drift", 0.0)
    flags = whole_column(found, "flags", CODE_VALID | DOPPLER_VALID | SATELLITE_KNOWN)
    flags[flags < 0] = 0
    for bit, measured in (
        (CODE_VALID, np.isfinite(ranges["pseudorange"])),
        (DOPPLER_VALID, np.isfinite(ranges["doppler"])),
        (SATELLITE_KNOWN, np.isfinite(ranges["satellite"]).all(axis=1)),
    ):
        flags[~measured] &= ~bit
    flags[flags & SATELLITE_KNOWN == 0] &= ~ALREADY_TURNED
    ranges["flags"] = flags
    week, seconds, of_epoch = _time_tag(whole_column(found, "gps_week", -1), number_column(found, "gps_tow"))
    ranges["status"][~of_epoch] = Status.WRONG_TIME
    return Epoch(week, seconds, ranges, left_out)


_PLAIN = [
    ("gnss_id", "u1"),
    ("sv_id", "u1"),
    ("sig_id", "u1"),
    ("flags", "u1"),
    ("gps_week", "<u2"),
    ("gps_tow", "<f8"),
    ("carrier_hz", "<f8"),
    ("pseudorange", "<f8"),
    ("pseudorange_std", "<f4"),
    ("doppler", "<f8"),
    ("doppler_std", "<f4"),
    ("cn0", "<f4"),
]
_SATELLITE = [(f"sat_{name}", "<f8") for name in ("x", "y", "z", "vx", "vy", "vz", "clk", "clk_drift")]
PLAIN_POINT = np.dtype(_PLAIN)
"""Points of 54 bytes that `write_epoch` makes without satellites."""

SATELLITE_POINT = np.dtype(_PLAIN + _SATELLITE)
"""Points of 118 bytes that `write_epoch` makes with satellites."""


def write_epoch(ranges: NDArray[np.void], week: int, seconds: float, satellites: bool = False) -> NDArray[Any]:
    """Return the points of ranges (RANGE) with one time tag: PLAIN_POINT, or SATELLITE_POINT with ``satellites``.

    With ``satellites`` the known satellite states (`SATELLITE_KNOWN`) are written, too. A signal for which u-blox has
    no number (P(Y) codes) cannot be written and is left out.
    """
    known = ranges["signal"] < len(SIGNALS)
    number = np.where(known, UBLOX_NUMBER[np.where(known, ranges["signal"], 0)], -1)
    ranges, number = ranges[number >= 0], number[number >= 0]
    found = np.zeros(len(ranges), SATELLITE_POINT if satellites else PLAIN_POINT)
    found["sig_id"] = number
    found["gps_week"], found["gps_tow"] = week, seconds
    same = (
        "gnss_id",
        "sv_id",
        "flags",
        "carrier_hz",
        "pseudorange",
        "pseudorange_std",
        "doppler",
        "doppler_std",
        "cn0",
    )
    for name in same:
        found[name] = ranges[name]
    if not satellites:
        found["flags"] &= 0xFF & ~(SATELLITE_KNOWN | ALREADY_TURNED)
        return found
    for axis, letter in enumerate("xyz"):
        found[f"sat_{letter}"] = ranges["satellite"][:, axis]
        found[f"sat_v{letter}"] = ranges["satellite_velocity"][:, axis]
    found["sat_clk"], found["sat_clk_drift"] = ranges["satellite_clock"], ranges["satellite_clock_drift"]
    return found


def _time_tag(weeks: NDArray[np.int64], seconds: NDArray[np.float64]) -> tuple[int, float, NDArray[np.bool_]]:
    """Return the time tag that most points have, of equally frequent ones the earliest, and which points have it."""
    possible = (weeks >= 0) & (seconds >= 0.0) & (seconds < SECONDS_PER_WEEK)
    if possible.all() and len(weeks) and (weeks == weeks[0]).all() and (seconds == seconds[0]).all():
        return int(weeks[0]), float(seconds[0]), possible
    if not possible.any():
        return 0, math.nan, possible
    tags, counts = np.unique(np.stack([weeks[possible], seconds[possible]], axis=1), axis=0, return_counts=True)
    week, second = tags[np.argmax(counts)].tolist()
    return int(week), second, (weeks == week) & (seconds == second)


def _signals(gnss_id: NDArray[np.int32], carrier_hz: NDArray[np.float64], found: NDArray[Any]) -> NDArray[np.int64]:
    """Return the signal of each point: by ``sig_id``, without that field by the carrier, else the default signal."""
    known = (gnss_id >= 0) & (gnss_id < GNSS_COUNT)
    row = np.where(known, gnss_id, GNSS_COUNT)
    if "sig_id" in (found.dtype.names or ()):
        number = whole_column(found, "sig_id", 0)
        return _BY_UBLOX[row, np.where((number >= 0) & (number < 256), number, 255)]
    first = _BY_UBLOX[row, 0]
    for index, signal in reversed(list(enumerate(SIGNALS))):
        # The channels of GLONASS are 4 MHz to both sides at most, other carriers farther apart.
        near = 5e6 if signal.gnss == Gnss.GLONASS else 1e6
        first[(gnss_id == signal.gnss) & (np.abs(carrier_hz - signal.carrier_hz) < near)] = index
    return first


def _ublox_tables() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return signal by constellation and u-blox number (unknown in the last row and column), and number by signal.

    A signal without a number of its own has that of one with the same carrier and group delay, -1 when there is none.
    """
    signals = np.full((GNSS_COUNT + 1, 256), UNKNOWN_SIGNAL)
    for (gnss, number), index in SIGNAL_BY_UBLOX.items():
        signals[gnss, number] = index
    numbers = np.full(len(SIGNALS), -1)
    for index, signal in enumerate(SIGNALS):
        for twin in (signal, *SIGNALS):
            same = (twin.gnss, twin.carrier_hz, twin.slot) == (signal.gnss, signal.carrier_hz, signal.slot)
            if same and twin.ublox:
                numbers[index] = twin.ublox[0]
                break
    return signals, numbers


_BY_UBLOX, UBLOX_NUMBER = _ublox_tables()
