"""RINEX observation files, versions 2, 3 and 4: pseudorange, Doppler and C/N0 of each signal, as arrays.

RINEX 2.11 tables A1 and A2, RINEX 3.04 tables A2 and A3; version 4 observation files are those of version 3. Phases are
not read. Unknown parts (SBAS, NavIC, events) and unreadable ones are left out and counted.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, allocate_ranges
from eskf_ros.gnss.rinex import Complaints, Header, RinexError, calendar, read_header, read_lines
from eskf_ros.gnss.signals import LETTERS, SIGNAL_BY_CODE, SIGNAL_CARRIER_HZ, Gnss
from eskf_ros.gnss.time import BEIDOU_OFFSET, Instant, from_calendar, leap_seconds, normalized

OBSERVATION = np.dtype(
    [
        ("epoch", "i4"),
        ("gnss_id", "u1"),
        ("sv_id", "u1"),
        ("signal", "u1"),
        ("pseudorange", "f8"),
        ("doppler", "f8"),
        ("cn0", "f8"),
    ],
    align=True,
)
"""One signal at one epoch (index into the epochs): m, Hz (positive when approaching), dB-Hz; NaN where missing."""

EPOCH = np.dtype([("week", "i4"), ("seconds", "f8"), ("first", "i8"), ("count", "i8")])
"""Time tag in GPS time by the receiver's clock, and index and number of the observations of the epoch."""

# RINEX 2 names a code by band and C or P, not by signal (RINEX 2.11, table 7).
_RINEX2_CODES = {
    "G": {"C1": "1C", "P1": "1W", "C2": "2X", "P2": "2W", "C5": "5X"},
    "R": {"C1": "1C", "P1": "1P", "C2": "2C", "P2": "2P"},
    "E": {"C1": "1X", "C5": "5X", "C7": "7X", "C8": "8X", "C6": "6X"},
    "C": {"C1": "2I", "C2": "2I", "C7": "7I", "C6": "6I"},
    "J": {"C1": "1C", "C2": "2X", "C5": "5X"},
}
_EVENTS = "event record not used"
_UNREADABLE = "unreadable epoch"
_WIDTH = 16
_DIGITS = 14


@dataclass
class Observations:
    """Content of an observation file.

    ``epochs`` (EPOCH) and ``observations`` (OBSERVATION) in the order of the file. ``approximate_position``: ECEF (m)
    of the header, NaN where absent. ``complaints``: what was left out.
    """

    epochs: NDArray[np.void]
    observations: NDArray[np.void]
    approximate_position: NDArray[np.float64]
    complaints: Complaints

    def ranges(self, epoch: int) -> NDArray[np.void]:
        """Return the ranges (RANGE) of one epoch, for `ranges.locate`."""
        first, count = int(self.epochs[epoch]["first"]), int(self.epochs[epoch]["count"])
        measured = self.observations[first : first + count]
        ranges = allocate_ranges(count)
        for name in ("gnss_id", "sv_id", "signal", "pseudorange", "doppler", "cn0"):
            ranges[name] = measured[name]
        ranges["carrier_hz"] = SIGNAL_CARRIER_HZ[measured["signal"]]
        ranges["carrier_hz"][measured["gnss_id"] == Gnss.GLONASS] = math.nan
        ranges["flags"] = np.where(np.isfinite(measured["pseudorange"]), CODE_VALID, 0)
        ranges["flags"] |= np.where(np.isfinite(measured["doppler"]), DOPPLER_VALID, 0)
        return ranges


@dataclass
class _Rows:
    """The lines of one constellation: satellite, epoch and text, one entry per satellite and epoch."""

    line: list[int]
    sv_id: list[int]
    epoch: list[int]
    text: list[str]


def read_observations(path: str | os.PathLike[str]) -> Observations:
    """Read a RINEX observation file, version 2, 3 or 4.

    Raises RinexError, naming file and line, if the file cannot be opened, is not a RINEX observation file, is
    compressed, or does not say which observations it holds.
    """
    path = Path(path)
    lines = read_lines(path)
    header = read_header(path, lines)
    if header.kind != "O":
        raise RinexError(f"{path}:1: RINEX type {header.kind!r} is not observation data (O)")
    complaints = Complaints(path)
    types = _types(path, header)
    scales = _scales(header)
    split = _split_2 if header.version < 3.0 else _split_3
    instants, rows = split(header, lines, types, complaints)
    parts = [
        _observations(letter, types[letter], rows[letter], scales, header.version, complaints)
        for letter in rows
        if letter in types
    ]
    found = np.concatenate(parts) if parts else np.zeros(0, OBSERVATION)
    found = found[np.lexsort([found["signal"], found["sv_id"], found["gnss_id"], found["epoch"]])]
    epochs = np.zeros(len(instants), EPOCH)
    if instants:
        epochs["week"], epochs["seconds"] = zip(*instants)
    bounds = np.searchsorted(found["epoch"], np.arange(len(instants) + 1))
    epochs["first"], epochs["count"] = bounds[:-1], np.diff(bounds)
    return Observations(epochs, found, _approximate_position(header), complaints)


def _types(path: Path, header: Header) -> dict[str, list[str]]:
    """Return the observation types by constellation letter. Raises RinexError if there are none."""
    types: dict[str, list[str]] = {}
    letter = ""
    for _, label, line in header.lines:
        if label == "SYS / # / OBS TYPES":
            letter = line[:1].strip() or letter
            types.setdefault(letter, []).extend(line[6:60].split())
        elif label == "# / TYPES OF OBSERV":
            types.setdefault("", []).extend(line[6:60].split())
    if not types:
        wanted = "# / TYPES OF OBSERV" if header.version < 3.0 else "SYS / # / OBS TYPES"
        raise RinexError(f"{path}:{header.end}: the header has no {wanted}: what the columns are is unknown")
    if header.version < 3.0:
        return dict.fromkeys(_RINEX2_CODES, types[""])
    return types


def _scales(header: Header) -> dict[tuple[str, str], float]:
    """Return the divisors of stored observations, by constellation and type ("" is any type)."""
    scales: dict[tuple[str, str], float] = {}
    for _, label, line in header.lines:
        if label == "SYS / SCALE FACTOR" and line[2:6].strip().isdigit():
            for name in line[10:58].split() or [""]:
                scales[line[:1], name] = float(line[2:6])
    return scales


def _approximate_position(header: Header) -> NDArray[np.float64]:
    for _, label, line in header.lines:
        if label == "APPROX POSITION XYZ":
            try:
                position = np.array([float(text) for text in line[:42].split()])
            except ValueError:
                break
            if position.shape == (3,) and np.linalg.norm(position) > 1e6:
                return position
    return np.full(3, math.nan)


def _clock(header: Header) -> str:
    """Return the time system of the epochs: GPS, GLO (UTC) or BDT; the others have GPS time."""
    for _, label, line in header.lines:
        if label == "TIME OF FIRST OBS" and line[48:51].strip():
            return line[48:51]
    return {"R": "GLO", "C": "BDT"}.get(header.system, "GPS")


def _instant(text: str, clock: str) -> Instant:
    """Return the GPS time of an epoch line. Raises ValueError."""
    year, month, day, hour, minute, second = calendar(text)
    week, seconds = from_calendar(year, month, day, hour, minute, second)
    if clock == "GLO":
        return normalized(week, seconds + leap_seconds(year, month, day))
    return normalized(week, seconds + (BEIDOU_OFFSET if clock == "BDT" else 0.0))


def _split_3(
    header: Header, lines: list[str], types: dict[str, list[str]], complaints: Complaints
) -> tuple[list[Instant], dict[str, _Rows]]:
    """Return the epochs, and the satellite lines by constellation (versions 3 and 4)."""
    clock = _clock(header)
    instants: list[Instant] = []
    rows = {letter: _Rows([], [], [], []) for letter in types if letter in LETTERS and letter != "S"}
    index = header.end
    while index < len(lines):
        line = lines[index]
        index += 1
        if not line.startswith(">"):
            if line.strip():
                complaints.add(index - 1, "line outside an epoch")
            continue
        try:
            flag, count = int(line[31:32] or "0"), int(line[32:35])
            if flag > 1:
                complaints.add(index - 1, _EVENTS)
                index += count
                continue
            instants.append(_instant(line[2:29], clock))
        except ValueError as error:
            complaints.add(index - 1, _UNREADABLE, str(error))
            while index < len(lines) and not lines[index].startswith(">"):
                index += 1
            continue
        for number in range(index, min(index + count, len(lines))):
            text = lines[number]
            if text.startswith(">"):
                complaints.add(number, "epoch with fewer satellites than it says")
                break
            index += 1
            row = rows.get(text[:1])
            satellite = text[1:3].strip()
            if row is None or not satellite.isdigit():
                complaints.add(number, f"satellite of constellation {text[:1]!r} not used")
                continue
            row.line.append(number)
            row.sv_id.append(int(satellite))
            row.epoch.append(len(instants) - 1)
            row.text.append(text[3:])
    return instants, rows


def _split_2(
    header: Header, lines: list[str], types: dict[str, list[str]], complaints: Complaints
) -> tuple[list[Instant], dict[str, _Rows]]:
    """Return the epochs, and the observations of each satellite in one line, by constellation (version 2)."""
    clock = _clock(header)
    instants: list[Instant] = []
    rows = {letter: _Rows([], [], [], []) for letter in types}
    lines_per_satellite = -(-len(types["G"]) // 5)
    home = header.system if header.system in types else "G"
    index = header.end
    while index < len(lines):
        line = lines[index]
        index += 1
        if not line.strip():
            continue
        try:
            flag, count = int(line[26:29].strip() or "0"), int(line[29:32])
            if flag > 1:
                complaints.add(index - 1, _EVENTS)
                index += count
                continue
            instant = _instant(line[:26], clock)
        except ValueError as error:
            # Nothing in version 2 marks the start of an epoch: each line is tried.
            complaints.add(index - 1, _UNREADABLE, str(error))
            continue
        names = line[32:68].ljust(36)
        for _ in range((count - 1) // 12):
            names += lines[index][32:68].ljust(36) if index < len(lines) else ""
            index += 1
        instants.append(instant)
        for satellite in range(count):
            name = names[3 * satellite : 3 * satellite + 3]
            first = index + satellite * lines_per_satellite
            row = rows.get(name[:1].strip() or home)
            if row is None or not name[1:].strip().isdigit():
                complaints.add(first, f"satellite of constellation {name[:1]!r} not used")
                continue
            row.line.append(first)
            row.sv_id.append(int(name[1:]))
            row.epoch.append(len(instants) - 1)
            row.text.append("".join(text.ljust(80)[:80] for text in lines[first : first + lines_per_satellite]))
        index += count * lines_per_satellite
    return instants, rows


def _observations(
    letter: str,
    types: list[str],
    rows: _Rows,
    scales: dict[tuple[str, str], float],
    version: float,
    complaints: Complaints,
) -> NDArray[np.void]:
    """Return the observations of one constellation: one for each signal with a pseudorange or a Doppler."""
    gnss = LETTERS[letter]
    width = _WIDTH * len(types)
    cells = np.array([text.ljust(width)[:width] for text in rows.text], f"S{width}").view(f"S{_WIDTH}")
    cells = cells.reshape(len(rows.text), len(types))
    parts = []
    for code, columns in _signals(letter, types, version).items():
        signal = SIGNAL_BY_CODE.get((gnss, code))
        if signal is None:
            complaints.add(0, f"signal {letter} {code} not known")
            continue
        part = np.zeros(len(rows.text), OBSERVATION)
        part["epoch"], part["sv_id"] = rows.epoch, rows.sv_id
        part["gnss_id"], part["signal"] = gnss, signal
        for name, kind in (("pseudorange", "C"), ("doppler", "D"), ("cn0", "S")):
            column = columns.get(kind)
            part[name] = math.nan
            if column is not None:
                scale = scales.get((letter, types[column]), scales.get((letter, ""), 1.0))
                part[name] = _numbers(cells[:, column], rows, complaints) / scale
        part["pseudorange"][part["pseudorange"] == 0.0] = math.nan
        measured = np.isfinite(part["pseudorange"])
        if version >= 3.0:
            # In version 2 the Doppler is that of the band, and no sign of a signal.
            measured |= np.isfinite(part["doppler"])
        parts.append(part[measured])
    return np.concatenate(parts) if parts else np.zeros(0, OBSERVATION)


def _signals(letter: str, types: list[str], version: float) -> dict[str, dict[str, int]]:
    """Return the column of pseudorange (C), Doppler (D) and C/N0 (S) by RINEX 3 name of the signal."""
    columns: dict[str, dict[str, int]] = {}
    if version < 3.0:
        for column, name in enumerate(types):
            code = _RINEX2_CODES[letter].get(name)
            if code is not None:
                columns.setdefault(code, {})["C"] = column
        for found in columns.values():
            for kind in "DS":
                band = types[found["C"]][1]
                if kind + band in types:
                    found[kind] = types.index(kind + band)
        return columns
    for column, name in enumerate(types):
        code = name[1:]
        if letter == "C" and code in (("1I", "1Q", "1X") if version < 3.03 else ("1I", "1Q")):
            # RINEX 3.02 calls B1I band 1; every other version calls it band 2 and B1C band 1.
            code = "2" + code[1]
        if name[:1] in ("C", "D", "S") and len(name) == 3:
            columns.setdefault(code, {})[name[0]] = column
    return columns


def _numbers(cells: NDArray[np.bytes_], rows: _Rows, complaints: Complaints) -> NDArray[np.float64]:
    """Return the numbers of one column, NaN where blank or unreadable (the latter is a complaint)."""
    digits = cells.astype(f"S{_DIGITS}")
    digits[np.char.strip(digits) == b""] = b"nan"
    try:
        return digits.astype(np.float64)
    except ValueError:
        values = np.full(len(digits), math.nan)
        for index, text in enumerate(digits):
            try:
                values[index] = float(text)
            except ValueError:
                complaints.add(rows.line[index], "unreadable observation", repr(text.decode("ascii", "replace")))
        return values
