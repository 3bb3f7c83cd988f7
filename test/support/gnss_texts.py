"""Hand-made RINEX files: invented satellites, written column by column as the RINEX documents say.

The numbers of a message are in the order of the document, not of our reader's table: both must agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

# A Saturday: GPS week 2323, day 6.
DATE = "2024 07 20 02 00 00"
WEEK = 2323
TOE = 6 * 86400.0 + 7200.0
BEIDOU_WEEK = WEEK - 1356

MEO = {
    "crs": -61.21875,
    "delta_n": 4.3e-9,
    "m0": 0.7213,
    "cuc": -3.1e-6,
    "e": 0.0123,
    "cus": 8.2e-6,
    "sqrt_a": 5153.7,
    "cic": 1.1e-7,
    "omega0": -1.234,
    "cis": -5.2e-8,
    "i0": 0.961,
    "crc": 231.5,
    "omega": 0.83,
    "omega_dot": -8.1e-9,
    "idot": 3.2e-10,
}
"""An orbit like that of GPS, m and rad."""

GEO = {
    **MEO,
    "e": 0.0004,
    "sqrt_a": 6493.4,
    "i0": math.radians(5.0),
    "omega0": math.remainder(7.292115e-5 * TOE + math.pi, 2.0 * math.pi),
    "crs": -257.2,
    "crc": -667.0,
    "omega_dot": -2.6e-10,
}
"""A geostationary orbit as BeiDou gives it: in a frame tilted by 5 deg, which this inclination and node undo."""

CLOCK = (-1.51e-4, 2.3e-12, 0.0)


def header(version: str = "3.04", kind: str = "N: GNSS NAV DATA", *lines: str) -> str:
    """A header: version, type, and further header lines (60 columns and a label)."""
    first = f"{float(version):9.2f}{'':11}{kind:20}{'M: MIXED':20}RINEX VERSION / TYPE"
    return "\n".join([first, *lines, f"{'':60}END OF HEADER"]) + "\n"


def labelled(text: str, label: str) -> str:
    """One header line."""
    return f"{text:60}{label}"


def number(value: float | None) -> str:
    """19 columns, 12 digits, blank for None."""
    return f"{'':19}" if value is None else f"{value:19.12E}"


def record(start: str, clock: Sequence[float | None], rows: Sequence[Sequence[float | None]], margin: int = 4) -> str:
    """A record: satellite and date, three clock numbers, rows of four numbers behind ``margin`` blanks."""
    first = start + "".join(number(value) for value in clock)
    rest = [" " * margin + "".join(number(value) for value in row) for row in rows]
    return "\n".join([first, *rest]) + "\n"


def _orbit_rows(orbit: dict[str, float], issue: float | None, toe: float | None) -> list[list[float | None]]:
    return [
        [issue, orbit["crs"], orbit["delta_n"], orbit["m0"]],
        [orbit["cuc"], orbit["e"], orbit["cus"], orbit["sqrt_a"]],
        [toe, orbit["cic"], orbit["omega0"], orbit["cis"]],
        [orbit["i0"], orbit["crc"], orbit["omega"], orbit["omega_dot"]],
    ]


def lnav(
    satellite: str = "G05",
    date: str = DATE,
    toe: float | None = TOE,
    week: float | None = WEEK,
    issue: float = 45.0,
    health: float = 0.0,
    tgd: float | None = -1.1e-8,
    sent: float | None = None,
    fit: float | None = 4.0,
    clock: Sequence[float] = CLOCK,
    **orbit: float,
) -> str:
    """GPS or QZSS (RINEX 3.04, tables A6 and A12)."""
    full = {**MEO, **orbit}
    sent = (toe or 0.0) - 7200.0 if sent is None else sent
    rows = _orbit_rows(full, issue, toe)
    rows += [[full["idot"], 1.0, week, 0.0], [2.0, health, tgd, issue], [sent, fit]]
    return record(f"{satellite} {date}", clock, rows)


def galileo(
    satellite: str = "E11",
    date: str = DATE,
    toe: float = TOE,
    source: float = 0b10_0000_0101,
    issue: float = 77.0,
    health: float = 0.0,
    bgd_e5a: float | None = 3.5e-9,
    bgd_e5b: float | None = 4.1e-9,
    sent: float | None = None,
    clock: Sequence[float] = CLOCK,
    **orbit: float,
) -> str:
    """Galileo (RINEX 3.04, table A8); by default I/NAV from E1 and E5b."""
    full = {**MEO, "sqrt_a": 5440.6, "e": 0.0003, **orbit}
    rows = _orbit_rows(full, issue, toe)
    rows += [[full["idot"], source, float(WEEK), None], [3.12, health, bgd_e5a, bgd_e5b]]
    rows += [[toe + 600.0 if sent is None else sent]]
    return record(f"{satellite} {date}", clock, rows)


def beidou(
    satellite: str = "C21",
    date: str = DATE,
    toe: float = TOE,
    week: float = BEIDOU_WEEK,
    issue: float = 1.0,
    health: float = 0.0,
    tgd1: float = 8.6e-9,
    tgd2: float = -1.8e-9,
    clock: Sequence[float] = CLOCK,
    **orbit: float,
) -> str:
    """BeiDou D1 or D2 (RINEX 3.04, table A14); date and toe are BeiDou time."""
    full = {**(GEO if int(satellite[1:]) <= 5 else {**MEO, "sqrt_a": 5282.6}), **orbit}
    rows = _orbit_rows(full, issue, toe)
    rows += [[full["idot"], None, week, None], [2.0, health, tgd1, tgd2], [toe, issue]]
    return record(f"{satellite} {date}", clock, rows)


GLONASS_STATE = ((11931.2, 1.612, -9.3e-10), (-8337.5, -2.431, 1.9e-9), (20984.1, -1.871, 9.3e-10))
"""Position, velocity, acceleration of the axes: km, km/s, km/s2."""


def glonass(
    satellite: str = "R07",
    date: str = "2024 07 20 01 45 00",
    health: float = 0.0,
    channel: float = 5.0,
    sent: float = 6 * 86400.0 + 6300.0,
    clock: Sequence[float] = (8.7e-5, 9.1e-13),
    state: Sequence[Sequence[float]] = GLONASS_STATE,
    extra: Sequence[float | None] | None = None,
) -> str:
    """GLONASS (RINEX 3.04, table A10); the date is UTC. ``extra``: the fourth row of RINEX 3.05 and 4."""
    x, y, z = state
    rows: list[list[Any]] = [[*x, health], [*y, channel], [*z, 0.0]]
    if extra is not None:
        rows.append(list(extra))
    return record(f"{satellite} {date}", [*clock, sent], rows)


def cnav(
    satellite: str = "G05",
    date: str = DATE,
    a_rate: float = 6.1e-3,
    delta_n_rate: float = -6.1e-14,
    health: float = 0.0,
    tgd: float | None = -1.1e-8,
    isc: Sequence[float | None] = (-3.5e-10, -2.8e-9, 6.8e-9, 6.9e-9),
    clock: Sequence[float] = CLOCK,
    **orbit: float,
) -> str:
    """GPS or QZSS CNAV (RINEX 4.00, section 5.4.2) with the line that announces it."""
    full = {**MEO, **orbit}
    rows = _orbit_rows(full, None, TOE - 7200.0)
    rows[0][0] = a_rate
    rows += [[full["idot"], delta_n_rate, -6.0, 2.0], [-1.0, health, tgd, 1.0], list(isc), [TOE - 3600.0, float(WEEK)]]
    return f"> EPH {satellite} CNAV\n" + record(f"{satellite} {date}", clock, rows)


def beidou_cnav(message: str = "CNV1", satellite: str = "C21", health: float = 0.0, **orbit: float) -> str:
    """BeiDou CNAV-1, -2 or -3 (RINEX 4.00) with the line that announces it."""
    full = {**MEO, "sqrt_a": 5282.6, **orbit}
    rows = _orbit_rows(full, -1.1e-2, TOE)
    rows += [[full["idot"], 9.4e-14, 3.0, TOE], [0.0, -5.0, -1.0, -1.0]]
    if message == "CNV3":
        rows += [[15.0, health, 0.0, -5.1e-9], [TOE]]
    else:
        isc = [-8.7e-10, None] if message == "CNV1" else [None, -2.7e-9]
        rows += [[*isc, 9.5e-9, -5.8e-9], [-1.0, health, 0.0, 16.0], [TOE, None, None, 16.0]]
    return f"> EPH {satellite} {message}\n" + record(f"{satellite} {DATE}", CLOCK, rows)


def announced(text: str, message: str) -> str:
    """A record of version 3 as version 4 has it."""
    return f"> EPH {text[:3]} {message}\n{text}"


EVERYTHING = "".join(
    [
        header(),
        lnav("G05"),
        lnav("G31", m0=-2.1, e=0.021, omega0=2.9, i0=0.94),
        lnav("J02", sqrt_a=6493.7, e=0.075, i0=0.72),
        galileo("E11"),
        galileo("E25", m0=2.9, omega0=0.4),
        beidou("C21"),
        beidou("C03"),
        beidou("C08", sqrt_a=6493.2, i0=0.95, e=0.003),
        glonass("R07"),
    ]
)
"""One file with all constellations."""
