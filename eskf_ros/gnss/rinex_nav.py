"""RINEX navigation files, versions 2, 3 and 4: GPS, Galileo, BeiDou, QZSS and GLONASS ephemerides, Klobuchar.

RINEX 2.11 tables A4 and A11, RINEX 3.05 appendix A5 to A14, RINEX 4.00 section 5. The reader is tolerant: unknown
records (SBAS, NavIC, Earth orientation ...) and unreadable ones are left out, counted by reason, and the first places
are named.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.ephemeris import EPHEMERIS, Broadcast, Message, usual_message
from eskf_ros.gnss.rinex import Complaints, Header, RinexError, calendar, numbers, read_header, read_lines
from eskf_ros.gnss.signals import LETTERS, Gnss
from eskf_ros.gnss.time import from_calendar, leap_seconds, week_near

# Names of the numbers after the clock, in the order of the file (None: not used). Names as in
# `ephemeris.kepler_record`.
_ORBIT = "crs delta_n m0 cuc e cus sqrt_a toe cic omega0 cis i0 crc omega omega_dot idot"
_MODERN = "a_rate crs delta_n m0 cuc e cus sqrt_a {} cic omega0 cis i0 crc omega omega_dot idot delta_n_rate"


def _names(text: str) -> tuple[str | None, ...]:
    return tuple(None if name == "-" else name for name in text.split())


_LNAV = _names(f"issue {_ORBIT} - week - accuracy health tgd - sent fit")
_GALILEO = _names(f"issue {_ORBIT} source week - accuracy health bgd_e5a bgd_e5b sent")
_BEIDOU = _names(f"issue {_ORBIT} - week - accuracy health tgd tgd2 sent")
_CNAV = _MODERN.format("-") + " - - - health tgd - isc_l1ca isc_l2c isc_l5i isc_l5q"
_BEIDOU_CNAV = _MODERN.format("toe") + " - - - - - -"

LAYOUTS: dict[tuple[Gnss, Message], tuple[str | None, ...]] = {
    (Gnss.GPS, Message.LNAV): _LNAV,
    (Gnss.QZSS, Message.LNAV): _LNAV,
    (Gnss.GPS, Message.CNAV): _names(f"{_CNAV} sent"),
    (Gnss.QZSS, Message.CNAV): _names(f"{_CNAV} sent"),
    (Gnss.GPS, Message.CNV2): _names(f"{_CNAV} isc_l1cd isc_l1cp - - sent"),
    (Gnss.QZSS, Message.CNV2): _names(f"{_CNAV} isc_l1cd isc_l1cp - - sent"),
    (Gnss.GALILEO, Message.INAV): _GALILEO,
    (Gnss.GALILEO, Message.FNAV): _GALILEO,
    (Gnss.BEIDOU, Message.D1): _BEIDOU,
    (Gnss.BEIDOU, Message.D2): _BEIDOU,
    (Gnss.BEIDOU, Message.CNV1): _names(f"{_BEIDOU_CNAV} isc_b1cd - tgd_b1cp tgd_b2ap - health - - sent - - issue"),
    (Gnss.BEIDOU, Message.CNV2): _names(f"{_BEIDOU_CNAV} - isc_b2ad tgd_b1cp tgd_b2ap - health - - sent - - issue"),
    (Gnss.BEIDOU, Message.CNV3): _names(f"{_BEIDOU_CNAV} - health - tgd_b2bi sent"),
    (Gnss.GLONASS, Message.FDMA): _names("x vx ax health y vy ay channel z vz az - - delta_tau accuracy flags"),
}

_KLOBUCHAR = {"GPS": Gnss.GPS, "QZS": Gnss.QZSS, "BDS": Gnss.BEIDOU}
_REFUSED_SYSTEMS = {"S": "SBAS", "I": "NavIC"}

# Least count of numbers after the clock that contains all orbit parameters; a shorter record is cut off.
_SHORTEST = {Message.FDMA: 11}
_SHORTEST_KEPLER = 17

WRONG_WEEK = "week number contradicts the date, which is used"
UNREADABLE = "unreadable record"


@dataclass
class Navigation:
    """Content of navigation files.

    ``broadcasts``: the messages in the order of the file. ``ephemerides``: the records (EPHEMERIS) made of them,
    unchecked (`ephemeris.Ephemerides` checks, sorts, removes duplicates). ``klobuchar``: eight parameters (alpha 0 to
    3, beta 0 to 3) by constellation, if given. ``leap_seconds``: of the header, None if absent. ``complaints``: what
    was left out.
    """

    broadcasts: list[Broadcast]
    ephemerides: NDArray[np.void]
    klobuchar: dict[Gnss, NDArray[np.float64]]
    leap_seconds: int | None
    complaints: Complaints


@dataclass
class _Reading:
    """State of reading one file."""

    complaints: Complaints
    klobuchar: dict[Gnss, list[float]] = field(default_factory=dict)
    broadcasts: list[Broadcast] = field(default_factory=list)
    records: list[np.void] = field(default_factory=list)

    def add(self, broadcast: Broadcast) -> None:
        self.records.append(broadcast.record())
        self.broadcasts.append(broadcast)


def read_navigation(path: str | os.PathLike[str]) -> Navigation:
    """Read a RINEX navigation file, version 2 (GPS or GLONASS), 3 or 4 (any).

    Raises RinexError, naming file and line, if the file cannot be opened or is not a RINEX navigation file.
    """
    path = Path(path)
    lines = read_lines(path)
    header = read_header(path, lines)
    if header.version < 3.0:
        if header.kind not in "NG":
            raise RinexError(f"{path}:1: RINEX 2 type {header.kind!r}: N (GPS) and G (GLONASS) are read")
    elif header.kind != "N":
        raise RinexError(f"{path}:1: RINEX type {header.kind!r} is not navigation data (N)")
    reading = _Reading(Complaints(path))
    leap = _read_header_lines(header, reading)
    for index, kind, block in _blocks(header, lines):
        try:
            _read_block(header, index, kind, block, leap, reading)
        except ValueError as error:
            reading.complaints.add(index, UNREADABLE, str(error))
    return Navigation(
        reading.broadcasts,
        np.array(reading.records, EPHEMERIS),
        {gnss: np.array(values) for gnss, values in reading.klobuchar.items()},
        leap,
        reading.complaints,
    )


def _read_header_lines(header: Header, reading: _Reading) -> int | None:
    """Take the ionosphere parameters of a header (versions 2 and 3); return its leap seconds."""
    leap = None
    for index, label, line in header.lines:
        try:
            if label == "LEAP SECONDS" and line[:6].strip() and line[24:27] != "BDS":
                leap = int(line[:6])
            elif label in ("ION ALPHA", "ION BETA"):
                values = numbers(line, 2, 4, 12)
                _set_klobuchar(reading, Gnss.GPS, label == "ION BETA", values)
            elif label == "IONOSPHERIC CORR" and line[:3] in _KLOBUCHAR and line[3:4] in ("A", "B"):
                values = numbers(line, 5, 4, 12)
                _set_klobuchar(reading, _KLOBUCHAR[line[:3]], line[3] == "B", values)
        except ValueError as error:
            reading.complaints.add(index, "unreadable header line", str(error))
    return leap


def _set_klobuchar(reading: _Reading, gnss: Gnss, beta: bool, values: list[float]) -> None:
    eight = reading.klobuchar.setdefault(gnss, [math.nan] * 8)
    eight[4 * beta : 4 * beta + 4] = [0.0 if math.isnan(value) else value for value in values]


def _blocks(header: Header, lines: list[str]) -> Iterator[tuple[int, str, list[str]]]:
    """Yield line index, type line (version 4, else empty) and lines of each record.

    A record starts where the first columns are not blank: with the satellite, in version 4 with '>'.
    """
    start, kind = None, ""
    mark = 2 if header.version < 3.0 else 1
    for index in range(header.end, len(lines)):
        line = lines[index]
        if header.version >= 4.0:
            begins = line.startswith(">")
        else:
            begins = bool(line[:mark].strip())
        if begins:
            if start is not None:
                yield start, kind, lines[start:index]
            kind = line if header.version >= 4.0 else ""
            start = index + 1 if kind else index
    if start is not None:
        yield start, kind, lines[start:]


def _read_block(header: Header, index: int, kind: str, block: list[str], leap: int | None, reading: _Reading) -> None:
    """Read one record. Raises ValueError if it cannot be read."""
    if not block:
        raise ValueError("nothing follows its type")
    if header.version < 3.0:
        letter = "R" if header.kind == "G" else "G"
        satellite, date, clock = block[0][:2], block[0][2:22], 22
    else:
        words = kind.split()
        if words[1:2] == ["ION"] and len(words) >= 4:
            _read_ionosphere(words, block, index, reading)
            return
        if kind and words[1:2] != ["EPH"]:
            reading.complaints.add(index - 1, f"{' '.join(words[1:2]) or 'unnamed'} record not used")
            return
        letter, satellite, date, clock = block[0][:1], block[0][1:3], block[0][3:23], 23
    if letter in _REFUSED_SYSTEMS:
        reading.complaints.add(index, f"{_REFUSED_SYSTEMS[letter]} ephemeris not used")
        return
    if letter not in LETTERS:
        raise ValueError(f"unknown constellation {letter!r}")
    gnss, sv_id = LETTERS[letter], int(satellite)
    clock_values = numbers(block[0], clock, 3)
    orbit = [value for line in block[1:] for value in numbers(line, clock - 19, 4)]
    message = _message(gnss, sv_id, kind, orbit)
    layout = LAYOUTS.get((gnss, message)) if message is not None else None
    if message is None or layout is None:
        reading.complaints.add(index, f"{letter} message {kind.split()[-1]} not used")
        return
    if len(orbit) < _SHORTEST.get(message, _SHORTEST_KEPLER):
        raise ValueError(f"{letter}{satellite} has {len(block)} lines only: cut off")
    fields = {name: value for name, value in zip(layout, orbit) if name is not None and not math.isnan(value)}
    if any(map(math.isinf, (*clock_values, *fields.values()))):
        raise ValueError(f"{letter}{satellite} has a number that is infinite")
    year, month, day, hour, minute, second = calendar(date)
    toc = from_calendar(year, month, day, hour, minute, second)
    if gnss == Gnss.GLONASS:
        fields["af0"], fields["af1"], fields["sent"] = clock_values
        known = leap_seconds(year, month, day)
        reading.add(Broadcast(gnss, sv_id, message, *toc, fields, max(known, leap or known)))
        return
    fields["af0"], fields["af1"], fields["af2"] = clock_values
    reading.add(Broadcast(gnss, sv_id, message, *toc, fields))
    if "week" in fields and "toe" in fields:
        # Weeks may have 10 bits or another origin: that of BeiDou is GPS week 1356, 332 modulo 1024.
        difference = round(week_near(fields["toe"], toc) - fields["week"]) % 1024
        if difference not in (0, 332):
            reading.complaints.add(index, WRONG_WEEK, f"{letter}{satellite} week {fields['week']:.0f}")


def _message(gnss: Gnss, sv_id: int, kind: str, orbit: list[float]) -> Message | None:
    """Return the navigation message of a record; None if it is not in `Message`."""
    words = kind.split()
    if len(words) >= 4:
        return Message.__members__.get(words[3])
    source = orbit[17] if len(orbit) > 17 and math.isfinite(orbit[17]) else 0.0
    return usual_message(gnss, sv_id, source)


def _read_ionosphere(words: list[str], block: list[str], index: int, reading: _Reading) -> None:
    """Take the Klobuchar parameters of a version 4 record. Raises ValueError if they cannot be read."""
    gnss = LETTERS.get(words[2][:1])
    if gnss is None or gnss not in _KLOBUCHAR.values() or words[3] not in ("LNAV", "D1D2"):
        reading.complaints.add(index - 1, f"ION {words[2][:1]} {words[3]} record not used")
        return
    values = numbers(block[0], 23, 3) + [value for line in block[1:] for value in numbers(line, 4, 4)]
    if len(values) < 8 or any(math.isnan(value) for value in values[:8]):
        raise ValueError(f"ION {words[2]} {words[3]} lacks parameters")
    if gnss == Gnss.QZSS and values[8:9] == [1.0]:
        # Parameters fitted to Japan, not the wide area.
        return
    reading.klobuchar[gnss] = values[:8]
