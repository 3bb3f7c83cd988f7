"""Navigation messages as a RINEX 3.04 navigation file, in the layouts that `eskf_ros.gnss.rinex_nav` reads."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.ephemeris import Broadcast
from eskf_ros.gnss.rinex_nav import LAYOUTS
from eskf_ros.gnss.signals import LETTERS, Gnss
from eskf_ros.gnss.time import date_of

_LETTER = {gnss: letter for letter, gnss in LETTERS.items()}
_KLOBUCHAR_NAMES = {Gnss.GPS: "GPS", Gnss.QZSS: "QZS", Gnss.BEIDOU: "BDS"}
_BEIDOU_WEEK = 1356
_PER_LINE = 4


def navigation_text(
    broadcasts: Sequence[Broadcast],
    klobuchar: Mapping[Gnss, NDArray[np.float64]],
    leap: int,
    comments: Sequence[str] = (),
) -> str:
    """Return the text of a file with ``broadcasts`` in the order given; numbers keep 13 digits, ``klobuchar`` 5.

    ``leap``: GPS time minus UTC, s. ``comments``: lines of at most 60 characters. Only messages that RINEX 3 knows:
    LNAV, I/NAV, F/NAV, D1, D2.
    """
    header = [_labelled("     3.04           N: GNSS NAV DATA    M: MIXED", "RINEX VERSION / TYPE")]
    header.append(_labelled("eskf_ros", "PGM / RUN BY / DATE"))
    header += [_labelled(comment, "COMMENT") for comment in comments]
    for gnss, parameters in klobuchar.items():
        for row, letter in enumerate("AB"):
            numbers = "".join(f"{value:12.4E}" for value in parameters[4 * row : 4 * row + 4])
            header.append(_labelled(f"{_KLOBUCHAR_NAMES[gnss]}{letter} {numbers}", "IONOSPHERIC CORR"))
    header += [_labelled(f"{leap:6d}", "LEAP SECONDS"), _labelled("", "END OF HEADER")]
    return "\n".join([*header, *(line for broadcast in broadcasts for line in _record(broadcast))]) + "\n"


def rounded(value: float) -> float:
    """Return the number that is read back after this number was written."""
    return float(_number(value))


def _labelled(text: str, label: str) -> str:
    return f"{text:60.60}{label}"


def _number(value: float) -> str:
    return f"{value:19.12E}"


def _record(broadcast: Broadcast) -> list[str]:
    fields, seconds = broadcast.fields, broadcast.seconds
    date = date_of(broadcast.week, seconds)
    minute, second = divmod(round(seconds) % 86400, 60)
    stamp = f"{date.year:4d} {date.month:02d} {date.day:02d} {minute // 60:02d} {minute % 60:02d} {second:02d}"
    clock = "".join(_number(fields.get(name, 0.0)) for name in ("af0", "af1", "af2"))
    week = broadcast.week - (_BEIDOU_WEEK if broadcast.gnss == Gnss.BEIDOU else 0)
    orbit = [
        float(week) if name == "week" else fields.get(name or "", 0.0)
        for name in LAYOUTS[broadcast.gnss, broadcast.message]
    ]
    lines = [f"{_LETTER[broadcast.gnss]}{broadcast.sv_id:02d} {stamp}{clock}"]
    for first in range(0, math.ceil(len(orbit) / _PER_LINE) * _PER_LINE, _PER_LINE):
        lines.append("    " + "".join(map(_number, orbit[first : first + _PER_LINE])))
    return lines
