"""The topic `gnss/ephemerides`: one point per navigation message, its numbers as FLOAT64 fields in RINEX units.

Fields by name, any order, NaN for numbers that were not sent: ``gnss_id``, ``sv_id``, ``message`` (`ephemeris.Message`;
default: the usual one of the satellite), ``toc_week`` and ``toc`` (reference of the clock on the constellation's own
time scale, for GLONASS tb in UTC; weeks count from 6 January 1980), and the names of `ephemeris.kepler_record` and
`ephemeris.glonass_record`: angles in rad, distances in m (GLONASS km), times in s. ``alpha0`` to ``beta3`` are the
Klobuchar parameters of the constellation.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.cloud import number_column, require, whole_column
from eskf_ros.gnss.ephemeris import (
    CLOCK_FIELDS,
    DELAY_FIELDS,
    EPHEMERIS,
    KEPLER_FIELDS,
    SATELLITE_KEYS,
    Broadcast,
    Message,
    usual_message,
)
from eskf_ros.gnss.signals import Gnss
from eskf_ros.gnss.time import SECONDS_PER_WEEK, date_of, leap_seconds

MAX_EPHEMERIDES = 4000
"""Points of a message that are read, at most: a day of all constellations."""

REQUIRED = ("gnss_id", "sv_id", "toc_week", "toc", "af0", "af1")

KLOBUCHAR_FIELDS = tuple(f"{row}{column}" for row in ("alpha", "beta") for column in range(4))
_MESSAGE_FIELDS = ("toe", "issue", "health", "accuracy", "sent", "fit", "source", "flags", "channel")
_GLONASS_FIELDS = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")
PARAMETERS = (*CLOCK_FIELDS, *KEPLER_FIELDS, *_MESSAGE_FIELDS, *DELAY_FIELDS, *_GLONASS_FIELDS)
"""Names of the numbers in `Broadcast.fields`."""

_HIGHEST_WEEK = 20_000

NO_SATELLITE = "no satellite of a constellation with ephemerides"
NO_MESSAGE = "unknown message"
NO_TIME = "no reference time"


@dataclass
class EphemerisCloud:
    """Content of a message.

    ``broadcasts``: the navigation messages; ``klobuchar``: parameters (8,) by constellation, if given; ``refused``:
    number of points left out, by reason.
    """

    broadcasts: list[Broadcast] = field(default_factory=list)
    klobuchar: dict[Gnss, NDArray[np.float64]] = field(default_factory=dict)
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def records(self) -> NDArray[np.void]:
        """The ephemerides (EPHEMERIS), unchecked."""
        return np.array([broadcast.record() for broadcast in self.broadcasts], EPHEMERIS)


def read_ephemerides(found: NDArray[Any]) -> EphemerisCloud:
    """Return the navigation messages in the points of a cloud. Raises CloudError if a required field is missing."""
    require(found, REQUIRED)
    read = EphemerisCloud()
    if len(found) > MAX_EPHEMERIDES:
        read.refused[f"beyond {MAX_EPHEMERIDES} points"] = len(found) - MAX_EPHEMERIDES
        found = found[:MAX_EPHEMERIDES]
    there = found.dtype.names or ()
    gnss_ids, sv_ids = whole_column(found, "gnss_id", -1).tolist(), whole_column(found, "sv_id", -1).tolist()
    messages = whole_column(found, "message", -1).tolist()
    weeks, tocs = whole_column(found, "toc_week", -1).tolist(), number_column(found, "toc").tolist()
    names = [name for name in PARAMETERS if name in there]
    columns = np.stack([number_column(found, name) for name in names], axis=1)
    leaps = whole_column(found, "leap_seconds", -1).tolist()
    with_klobuchar = all(name in there for name in KLOBUCHAR_FIELDS)
    klobuchar = np.stack([number_column(found, name) for name in KLOBUCHAR_FIELDS], axis=1)
    for k, (gnss_id, sv_id, week, toc) in enumerate(zip(gnss_ids, sv_ids, weeks, tocs)):
        gnss = Gnss(gnss_id) if gnss_id in _WITH_EPHEMERIDES else None
        if gnss is None or not 0 < sv_id < SATELLITE_KEYS:
            read.refused[NO_SATELLITE] += 1
            continue
        if with_klobuchar and np.isfinite(klobuchar[k]).all():
            read.klobuchar[gnss] = klobuchar[k]
        fields = {name: value for name, value in zip(names, columns[k].tolist()) if not math.isnan(value)}
        usual = usual_message(gnss, sv_id, _finite(fields.get("source", 0.0)))
        message = _MESSAGES.get(messages[k]) if messages[k] >= 0 else usual
        if message is None or (message == Message.FDMA) != (gnss == Gnss.GLONASS):
            read.refused[NO_MESSAGE] += 1
            continue
        if not (0 <= week < _HIGHEST_WEEK and 0.0 <= toc < SECONDS_PER_WEEK):
            read.refused[NO_TIME] += 1
            continue
        leap = leaps[k]
        if gnss == Gnss.GLONASS and leap < 0:
            date = date_of(week, toc)
            leap = leap_seconds(date.year, date.month, date.day)
        read.broadcasts.append(Broadcast(gnss, sv_id, message, week, toc, fields, max(0, leap)))
    return read


def write_ephemerides(
    broadcasts: Sequence[Broadcast], klobuchar: Mapping[Gnss, NDArray[np.float64]] | None = None
) -> NDArray[Any]:
    """Return points with the fields that at least one of the messages needs."""
    klobuchar = klobuchar or {}
    used = {name for broadcast in broadcasts for name in broadcast.fields}
    names = ["gnss_id", "sv_id", "message", "toc_week", "toc"]
    names += [name for name in PARAMETERS if name in used or name in REQUIRED]
    if any(broadcast.gnss == Gnss.GLONASS for broadcast in broadcasts):
        names.append("leap_seconds")
    if klobuchar:
        names += KLOBUCHAR_FIELDS
    found = np.full(len(broadcasts), math.nan, np.dtype([(name, "<f8") for name in names]))
    for point, broadcast in zip(found, broadcasts):
        point["gnss_id"], point["sv_id"], point["message"] = broadcast.gnss, broadcast.sv_id, broadcast.message
        point["toc_week"], point["toc"] = broadcast.week, broadcast.seconds
        for name, value in broadcast.fields.items():
            if name in names:
                point[name] = value
        if broadcast.gnss == Gnss.GLONASS:
            point["leap_seconds"] = broadcast.leap
        for name, value in zip(KLOBUCHAR_FIELDS, klobuchar.get(broadcast.gnss, ())):
            point[name] = value
    return found


def _finite(value: float) -> float:
    return value if abs(value) < 2.0**31 else 0.0


_MESSAGES = {int(message): message for message in Message}
_WITH_EPHEMERIDES = frozenset(int(gnss) for gnss in Gnss if usual_message(gnss, 1) is not None)
