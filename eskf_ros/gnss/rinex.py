"""Parts that RINEX navigation and observation files share: lines, header, numbers, complaints."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from eskf_ros.gnss.time import Instant, from_calendar

KEPT_NOTES = 20
"""Places of a file that are named, at most."""


class RinexError(ValueError):
    """A file cannot be read as RINEX. Its text is one line for the user: file, line, what is wrong, what to do."""


@dataclass
class Complaints:
    """What was left out of a file: counts by reason, and the first few places as ``file:line: reason``."""

    path: Path
    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def add(self, line: int, reason: str, detail: str = "") -> None:
        """Count ``reason``; ``line`` counts from 0, ``detail`` goes to the note only."""
        self.counts[reason] += 1
        if len(self.notes) < KEPT_NOTES:
            self.notes.append(f"{self.path}:{line + 1}: {reason}{': ' if detail else ''}{detail}")


@dataclass(frozen=True)
class Header:
    """Version, kind ("N", "O", "G" ...), constellation letter, and the header lines with their number and label."""

    version: float
    kind: str
    system: str
    lines: list[tuple[int, str, str]]
    end: int
    """Index of the first line after the header."""


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file. Raises RinexError if it cannot be read."""
    try:
        text = path.read_bytes().decode("ascii", "replace")
    except OSError as error:
        raise RinexError(f"{path}: {error.strerror or error}") from error
    return text.splitlines()


def read_header(path: Path, lines: list[str]) -> Header:
    """Return the header of a RINEX file, version 2 to 4. Raises RinexError if there is none, or it is compressed."""
    if not lines or lines[0][60:80].strip() != "RINEX VERSION / TYPE":
        if lines and lines[0][60:80].strip() == "CRINEX VERS   / TYPE":
            raise RinexError(f"{path}:1: Hatanaka-compressed RINEX: decompress it first (crx2rnx)")
        raise RinexError(f"{path}:1: not a RINEX file: the first line is not RINEX VERSION / TYPE")
    version = number(lines[0][:9])
    if not 2.0 <= version < 5.0:
        raise RinexError(f"{path}:1: RINEX version {lines[0][:9].strip() or 'missing'}: 2, 3 and 4 are understood")
    labelled: list[tuple[int, str, str]] = []
    for index, line in enumerate(lines):
        label = line[60:80].strip()
        if label == "END OF HEADER":
            return Header(version, lines[0][20:21], lines[0][40:41], labelled, index + 1)
        labelled.append((index, label, line))
    raise RinexError(f"{path}:{len(lines)}: the header has no END OF HEADER: the file is cut off")


def number(text: str) -> float:
    """Return a number in Fortran notation (D for E), NaN for a blank. Raises ValueError for anything else."""
    return numbers(text, 0, 1, len(text))[0]


def numbers(line: str, start: int, count: int, width: int = 19) -> list[float]:
    """Return ``count`` numbers of ``width`` columns each from column ``start`` on, like `number`."""
    line = line.replace("D", "E").replace("d", "e")
    texts = [line[begin : begin + width] for begin in range(start, start + count * width, width)]
    return [float(text) if text and not text.isspace() else math.nan for text in texts]


def calendar(text: str) -> tuple[int, int, int, int, int, float]:
    """Return year, month, day, hour, minute, second from six blank-separated numbers; two-digit years are 1980 to 2079.

    Raises ValueError when there are not six numbers.
    """
    parts = text.split()
    if len(parts) != 6:
        raise ValueError(f"no date and time: {text.strip()!r}")
    year, month, day, hour, minute = (int(part) for part in parts[:5])
    if year < 100:
        year += 1900 if year >= 80 else 2000
    return year, month, day, hour, minute, number(parts[5])


def instant(text: str) -> Instant:
    """Return (week, seconds) of six blank-separated numbers, on their own time scale. Raises ValueError."""
    return from_calendar(*calendar(text))
