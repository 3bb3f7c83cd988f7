"""Broadcast ephemerides: one record per satellite and issue, checked, sorted, without duplicates.

`kepler_record` and `glonass_record` take the numbers of a navigation message by name, in RINEX units (rad, m, s; km for
GLONASS), from any file or topic. All that depends on the kind of message is resolved there: times become GPS time,
group delays and health become tables indexed by the slot of a signal (`eskf_ros.gnss.signals`), so that the kernels
need no knowledge of messages.

Over 400 lines: a record with its fields, limits and checks for each constellation.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.gnss.signals import E5B, GNSS_COUNT, L1, L2, L5, SLOT_COUNT, Gnss, is_beidou_geostationary
from eskf_ros.gnss.time import (
    BEIDOU_OFFSET,
    SECONDS_PER_DAY,
    SECONDS_PER_WEEK,
    Instant,
    normalized,
    week_near,
)


class Message(IntEnum):
    """Navigation message (names of RINEX 4). Of several that serve a signal the one with the lowest number is used."""

    LNAV = 0
    INAV = 1
    FNAV = 2
    D1 = 3
    D2 = 4
    FDMA = 5
    CNAV = 6
    CNV1 = 7
    CNV2 = 8
    CNV3 = 9


class Fault(IntEnum):
    """Why an ephemeris is refused."""

    NONE = 0
    NON_FINITE = 1
    BAD_VALUE = 2
    DUPLICATE = 3


NO_ISSUE = -1
"""Issue of a message that has none (CNAV), and the request for any issue."""

KEPLER_FIELDS = (
    "sqrt_a",
    "a_rate",
    "e",
    "m0",
    "delta_n",
    "delta_n_rate",
    "i0",
    "idot",
    "omega0",
    "omega",
    "omega_dot",
    "cuc",
    "cus",
    "crc",
    "crs",
    "cic",
    "cis",
)
"""Orbit parameters with the names and meaning of IS-GPS-200N, tables 20-II and 30-I (m, rad, s; sqrt_a in sqrt(m))."""

CLOCK_FIELDS = ("af0", "af1", "af2")
GLONASS_FIELDS = ("position", "velocity", "acceleration")

EPHEMERIS = np.dtype(
    [
        ("gnss_id", "i4"),
        ("sv_id", "i4"),
        ("message", "i4"),
        ("issue", "i4"),
        ("toe_week", "i4"),
        ("toc_week", "i4"),
        ("sent_week", "i4"),
        ("channel", "i4"),
        # Eight bytes, because a gap would have arbitrary content and records are compared by their bytes.
        ("unhealthy", "i8"),
        ("toe", "f8"),
        ("toc", "f8"),
        ("sent", "f8"),
        ("max_lead", "f8"),
        ("max_age", "f8"),
        ("accuracy", "f8"),
        ("toe_own", "f8"),
        *((name, "f8") for name in KEPLER_FIELDS + CLOCK_FIELDS),
        ("position", "f8", (3,)),
        ("velocity", "f8", (3,)),
        ("acceleration", "f8", (3,)),
        ("group_delay", "f8", (SLOT_COUNT,)),
    ],
    align=True,
)
"""One broadcast ephemeris.

- ``issue``: IODE, IODnav or AODE; for GLONASS the number of the quarter of an hour in the Moscow day.
- ``toe``, ``toc``, ``sent``: seconds of GPS week of ephemeris, clock and transmission (NaN unknown), with their weeks.
- ``toe_own``: seconds of week of ``toe`` in the constellation's own time, as the longitude of the node needs it.
- ``max_lead``, ``max_age``: seconds before and after ``toe`` for which the orbit is good.
- ``accuracy``: URA or SISA, m (NaN unknown).
- ``af0``, ``af1``, ``af2``: clock polynomial from ``toc`` (s, s/s, s/s2), for GLONASS -TauN and GammaN.
- ``position``, ``velocity``, ``acceleration``: GLONASS state at ``toe`` in PZ-90.11 (m, m/s, m/s2, the acceleration by
  Sun and Moon); ``channel``: GLONASS frequency channel.
- ``group_delay``: seconds by which a signal leaves later than the clock polynomial says, NaN if the message does not
  tell.
- ``unhealthy``: bit per slot.
"""

SATELLITE_KEYS = 256
"""Satellite numbers per constellation in the index of `Ephemerides`."""

ALL_SLOTS = (1 << SLOT_COUNT) - 1

# Time (s) for which an ephemeris is used before and after its reference time. GPS: half the usual fit interval to both
# sides (IS-GPS-200N, section 20.3.3.4.3.1); Galileo and BeiDou are fitted to the hours that follow. Over one day, the
# errors at these limits were 2 to 9 m (95 %) against precise orbits and against the ephemerides in force; an hour later
# they are 10 m for Galileo and 100 m for GLONASS.
_LEAD_AND_AGE = {
    Gnss.GPS: (7200.0, 7200.0),
    Gnss.QZSS: (5400.0, 5400.0),
    Gnss.GALILEO: (1800.0, 12600.0),
    Gnss.BEIDOU: (5400.0, 10800.0),
    Gnss.GLONASS: (1800.0, 1800.0),
}

_NOT_BROADCAST = 9.9e8
"""Smallest value that means "not broadcast": RINEX 3.05 and 4 write .999999999999E+09 or 9.999E+09."""

_GAMMA_L2 = (L1 / L2) ** 2
_GAMMA_E5A = (L1 / L5) ** 2
_GAMMA_E5B = (L1 / E5B) ** 2

Fields = Mapping[str, float]


class Broadcast(NamedTuple):
    """A navigation message as it was sent; a record is made from it.

    ``week``, ``seconds``: reference time of the clock (GLONASS: tb in UTC) on the constellation's own time scale, the
    week counted from 6 January 1980. ``fields``: the other numbers by the names of `kepler_record` or `glonass_record`,
    in RINEX units; numbers that were not sent are absent. ``leap``: GPS time minus UTC (s), for GLONASS.
    """

    gnss: Gnss
    sv_id: int
    message: Message
    week: int
    seconds: float
    fields: dict[str, float]
    leap: int = 0

    def record(self) -> np.void:
        """Return the ephemeris (EPHEMERIS)."""
        if self.gnss == Gnss.GLONASS:
            return glonass_record(self.sv_id, (self.week, self.seconds), self.leap, self.fields)
        return kepler_record(self.gnss, self.sv_id, self.message, (self.week, self.seconds), self.fields)


def usual_message(gnss: Gnss, sv_id: int, source: float = 0.0) -> Message | None:
    """Return the usual message of a satellite, where only the satellite is named; None without broadcast ephemerides.

    ``source``: Galileo's data sources (RINEX 3.04, table A8): bit 9 clock of E5b, bit 8 of E5a; bits 0 and 2 I/NAV, bit
    1 F/NAV.
    """
    if gnss == Gnss.BEIDOU:
        return Message.D2 if is_beidou_geostationary(gnss, sv_id) else Message.D1
    if gnss == Gnss.GALILEO:
        bits = int(source)
        if bits & 0x200 or (bits & 0x5 and not bits & 0x100):
            return Message.INAV
        return Message.FNAV if bits & 0x102 else Message.INAV
    return {Gnss.GPS: Message.LNAV, Gnss.QZSS: Message.LNAV, Gnss.GLONASS: Message.FDMA}.get(gnss)


def kepler_record(gnss: Gnss, sv_id: int, message: Message, toc: Instant, fields: Fields) -> np.void:
    """Return the record (EPHEMERIS) of a message with Kepler elements: all constellations but GLONASS.

    ``toc``: clock reference on the constellation's own time scale, its week counted from 6 January 1980. ``fields``:
    `KEPLER_FIELDS`, `CLOCK_FIELDS`, ``toe`` (seconds of own week; default ``toc``), ``issue``, ``health``,
    ``accuracy``, ``sent`` (seconds of own week), ``fit`` (hours) and the delays ``tgd``, ``tgd2``, ``isc_*``,
    ``bgd_*``, in RINEX units. Missing numbers are NaN; if the orbit needs them, `Ephemerides.add` refuses the record.
    """
    record = np.zeros(1, EPHEMERIS)[0]
    offset = BEIDOU_OFFSET if gnss == Gnss.BEIDOU else 0.0
    toe_own = _seconds(fields.get("toe", toc[1]))
    toe_week = week_near(toe_own, toc) if math.isfinite(toe_own + toc[1]) else 0
    sent = _seconds(fields.get("sent", math.nan))
    sent_week = week_near(sent, (toe_week, toe_own)) if math.isfinite(sent + toe_own) else 0
    record["gnss_id"], record["sv_id"], record["message"] = gnss, sv_id, message
    record["issue"] = _integer(fields.get("issue", math.nan), NO_ISSUE)
    record["toc_week"], record["toc"] = _shifted(toc[0], toc[1], offset)
    record["toe_own"] = toe_own
    record["toe_week"], record["toe"] = _shifted(toe_week, toe_own, offset)
    record["sent_week"], record["sent"] = _shifted(sent_week, sent, offset)
    record["max_lead"], record["max_age"] = _LEAD_AND_AGE[gnss]
    if gnss == Gnss.GPS and 4.0 < fields.get("fit", math.nan) <= 26.0:
        record["max_lead"] = record["max_age"] = 1800.0 * fields["fit"]
    record["accuracy"] = fields.get("accuracy", math.nan)
    for name in CLOCK_FIELDS + KEPLER_FIELDS:
        record[name] = fields.get(name, 0.0 if name in ("a_rate", "delta_n_rate", "af2") else math.nan)
    record["group_delay"] = group_delays(gnss, message, fields)
    record["unhealthy"] = unhealthy_slots(gnss, message, _integer(fields.get("health", math.nan), 0))
    return record


def glonass_record(sv_id: int, tb_utc: Instant, leap: int, fields: Fields) -> np.void:
    """Return the record (EPHEMERIS) of a GLONASS message.

    ``tb_utc``: reference time in UTC, its week counted from 6 January 1980 without leap seconds; ``leap``: GPS time
    minus UTC then, s. ``fields``: ``x y z`` km, ``vx vy vz`` km/s, ``ax ay az`` km/s2, ``af0`` = -TauN s, ``af1`` =
    +GammaN, ``channel``, ``health``, ``flags`` (health flags, from RINEX 3.05 on), ``delta_tau`` s (L2 minus L1),
    ``accuracy`` m, ``sent`` (seconds of the UTC week, or of the day).
    """
    record = np.zeros(1, EPHEMERIS)[0]
    record["gnss_id"], record["sv_id"], record["message"] = Gnss.GLONASS, sv_id, Message.FDMA
    moscow = (tb_utc[1] + 10800.0) % SECONDS_PER_DAY
    record["issue"] = int(moscow // 900.0)
    record["toe_week"], record["toe"] = record["toc_week"], record["toc"] = normalized(tb_utc[0], tb_utc[1] + leap)
    record["toe_own"] = tb_utc[1]
    sent = _seconds(fields.get("sent", math.nan))
    if 0.0 <= sent < SECONDS_PER_DAY:
        # RINEX 2 counts from midnight; so do the first day of a week and RINEX 3.
        sent += SECONDS_PER_DAY * round((tb_utc[1] - sent) / SECONDS_PER_DAY)
    sent_week = week_near(sent, tb_utc) if math.isfinite(sent) else 0
    record["sent_week"], record["sent"] = _shifted(sent_week, sent, leap)
    record["max_lead"], record["max_age"] = _LEAD_AND_AGE[Gnss.GLONASS]
    record["accuracy"] = fields.get("accuracy", math.nan)
    record["af0"], record["af1"] = fields.get("af0", math.nan), fields.get("af1", math.nan)
    record["channel"] = _integer(fields.get("channel", math.nan), 0)
    for name, axes in (("position", "xyz"), ("velocity", ("vx", "vy", "vz")), ("acceleration", ("ax", "ay", "az"))):
        record[name] = [1e3 * fields.get(axis, math.nan) for axis in axes]
    record["group_delay"] = group_delays(Gnss.GLONASS, Message.FDMA, fields)
    ill = _integer(fields.get("health", math.nan), 0) != 0 or _integer(_broadcast(fields, "flags"), 0) & 4
    record["unhealthy"] = ALL_SLOTS if ill else 0
    return record


def group_delays(gnss: Gnss, message: Message, fields: Fields) -> NDArray[np.float64]:
    """Return the group delay (s) of each slot: what a user of that signal alone subtracts from the clock polynomial.

    NaN if the message does not tell. The polynomials refer to:

    - GPS, QZSS: L1 P(Y) and L2 P(Y), or L1 C/A and L2C, combined free of the ionosphere. IS-GPS-200N, sections
      20.3.3.3.3.2 (TGD) and 30.3.3.3.1.1 (ISC, CNAV), IS-GPS-705 (L5), IS-GPS-800 (L1C); IS-QZSS-PNT. LNAV takes L1 C/A
      for L1 P(Y) and L2C for L2 P(Y): a few decimetres.
    - Galileo: I/NAV to E1 and E5b, F/NAV to E1 and E5a (OS-SIS-ICD 2.1, section 5.1.5). E5a with the clock of I/NAV
      follows from both: E1 leaves BGD(E1,E5b) after the one and BGD(E1,E5a) after the other clock.
    - BeiDou: B3I (BDS-SIS-ICD-B1I 3.0, B1C 1.0, B2a 1.0, B2b 1.0).
    - GLONASS: L1; L2 is later by delta tau (ICD 5.1, section 4.4).
    """
    delays = np.full(SLOT_COUNT, math.nan)
    value = {name: _broadcast(fields, name) for name in DELAY_FIELDS}
    tgd = value["tgd"]
    if gnss in (Gnss.GPS, Gnss.QZSS):
        delays[:4] = tgd, tgd, _GAMMA_L2 * tgd, _GAMMA_L2 * tgd
        if message != Message.LNAV:
            for slot, name in ((0, "isc_l1ca"), (3, "isc_l2c"), (4, "isc_l5i"), (5, "isc_l5q")):
                delays[slot] = tgd - value[name]
            delays[6], delays[7] = tgd - value["isc_l1cd"], tgd - value["isc_l1cp"]
            if gnss == Gnss.QZSS:
                # L1 C/B has the group delay of L1 C/A.
                delays[1] = delays[0]
    elif gnss == Gnss.GALILEO:
        e5a, e5b = value["bgd_e5a"], value["bgd_e5b"]
        if message == Message.FNAV:
            delays[:2] = e5a, _GAMMA_E5A * e5a
        else:
            delays[:3] = e5b, e5b + (_GAMMA_E5A - 1.0) * e5a, _GAMMA_E5B * e5b
    elif gnss == Gnss.BEIDOU:
        delays[2] = 0.0
        if message in (Message.D1, Message.D2):
            delays[:2] = tgd, value["tgd2"]
        else:
            pilot, b2a = value["tgd_b1cp"], value["tgd_b2ap"]
            delays[3:7] = pilot + value["isc_b1cd"], pilot, b2a + value["isc_b2ad"], b2a
            delays[7] = value["tgd_b2bi"]
    else:
        delays[:2] = 0.0, value["delta_tau"]
    return delays


def unhealthy_slots(gnss: Gnss, message: Message, health: int) -> int:
    """Return a bit for each slot whose signal or data must not be used, from the health word as in RINEX.

    GPS LNAV and BeiDou: anything but zero condemns the satellite. GPS CNAV: bits of L1, L2, L5 (IS-GPS-200N, section
    30.3.3.1.1.2; satellites without L5 say so here). QZSS LNAV: L1 as a whole, L1 C/A, L2C, L5, L1C, L1 C/B, of which
    L1 C/A and L1 C/B exclude each other (IS-QZSS-PNT). Galileo: validity and health of E1, E5a, E5b in three bits each
    (RINEX 3.04, table A8).
    """
    if gnss == Gnss.GALILEO:
        return sum(1 << slot for slot in range(3) if health >> (3 * slot) & 7)
    if gnss == Gnss.QZSS and message == Message.LNAV:
        by_bit = {5: (0, 1), 4: (0,), 3: (3,), 2: (4, 5), 1: (6, 7), 0: (1,)}
    elif gnss in (Gnss.GPS, Gnss.QZSS) and message == Message.CNAV:
        by_bit = {2: (0, 1), 1: (2, 3), 0: (4, 5)}
    else:
        return ALL_SLOTS if health else 0
    return sum({1 << slot for bit, slots in by_bit.items() if health >> bit & 1 for slot in slots})


class Ephemerides:
    """A store of ephemerides in a fixed order without duplicates, independent of the order in which they came.

    ``records`` (EPHEMERIS) is sorted by satellite, message and time; ``first`` is its index: the satellite ``sv_id`` of
    ``gnss_id`` has ``records[first[k]:first[k + 1]]`` with k = 256 gnss_id + sv_id. ``refused`` counts by `Fault`.
    """

    def __init__(self, records: NDArray[np.void] | None = None) -> None:
        self.records = np.zeros(0, EPHEMERIS)
        self.first = np.zeros(GNSS_COUNT * SATELLITE_KEYS + 1, np.int64)
        self.refused: Counter[Fault] = Counter()
        self._known: set[bytes] = set()
        if records is not None:
            self.add(records)

    def __len__(self) -> int:
        return len(self.records)

    def add(self, records: NDArray[np.void]) -> None:
        """Add records (EPHEMERIS); those with a `Fault` are counted in ``refused`` and left out."""
        faults = check(records)
        for fault in (Fault.NON_FINITE, Fault.BAD_VALUE):
            self.refused[fault] += int(np.count_nonzero(faults == fault))
        sound = records[faults == Fault.NONE]
        if self._known.issuperset(_payloads(sound).tolist()):
            # A receiver repeats known ephemerides: nothing to sort.
            self.refused[Fault.DUPLICATE] += len(sound)
            return
        sorted_once, duplicates = _sorted_once(np.concatenate([self.records, sound]))
        self.refused[Fault.DUPLICATE] += duplicates
        self._hold(sorted_once)

    def unknown(self, records: NDArray[np.void]) -> NDArray[np.void]:
        """Return those records that have no `Fault` and are not in the store yet, byte for byte."""
        fresh = records[[payload not in self._known for payload in _payloads(records).tolist()]]
        return fresh[check(fresh) == Fault.NONE]

    def drop_ended(self, week: int, seconds: float) -> None:
        """Forget records whose time (``toe`` and ``max_age``) ended before an instant of GPS time.

        The last record of each message of a satellite stays: it distinguishes a satellite with old ephemerides from one
        that never had any.
        """
        records = self.records
        since_toe = (week - records["toe_week"]) * SECONDS_PER_WEEK + (seconds - records["toe"])
        identity = [records[name] for name in ("gnss_id", "sv_id", "message")]
        last = np.ones(len(records), np.bool_)
        last[:-1] = np.any([key[1:] != key[:-1] for key in identity], axis=0)
        kept = last | ~(since_toe > records["max_age"])
        if not kept.all():
            self._hold(records[kept])

    def _hold(self, records: NDArray[np.void]) -> None:
        """Replace the content of the store by sorted records."""
        self.records = records
        self._known = set(_payloads(records).tolist())
        keys = SATELLITE_KEYS * records["gnss_id"].astype(np.int64) + records["sv_id"]
        self.first = np.searchsorted(keys, np.arange(GNSS_COUNT * SATELLITE_KEYS + 1))

    def of(self, gnss_id: int, sv_id: int) -> NDArray[np.void]:
        """Return the records of one satellite (a view)."""
        key = SATELLITE_KEYS * gnss_id + sv_id
        return self.records[self.first[key] : self.first[key + 1]]


def check(records: NDArray[np.void]) -> NDArray[np.int64]:
    """Return a `Fault` for each record: missing parameters, or values that no satellite of its kind can have."""
    glonass = records["gnss_id"] == Gnss.GLONASS
    finite = np.isfinite(records["toe"] + records["toc"] + records["af0"] + records["af1"] + records["af2"])
    kepler = np.stack([records[name] for name in KEPLER_FIELDS], axis=-1)
    state = np.concatenate([records[name] for name in GLONASS_FIELDS], axis=-1)
    finite &= np.where(glonass, np.isfinite(state).all(axis=-1), np.isfinite(kepler).all(axis=-1))
    with np.errstate(invalid="ignore", over="ignore"):
        orbit = (
            (np.abs(records["sqrt_a"] - 5800.0) < 1200.0)
            & (np.abs(records["e"] - 0.25) <= 0.25)
            & (np.abs(records["toe_own"] - 0.5 * SECONDS_PER_WEEK) <= 0.5 * SECONDS_PER_WEEK)
            & (np.abs(kepler[:, 6:]).max(axis=-1, initial=0.0) < 1e5)
        )
        radius = np.linalg.norm(records["position"], axis=-1)
        speed = np.linalg.norm(records["velocity"], axis=-1)
        possible = np.where(glonass, (np.abs(radius - 25.5e6) < 1.5e6) & (speed < 5e3), orbit)
        possible &= np.abs(records["af0"]) < 0.1
        apart = (records["toe_week"] - records["toc_week"]) * SECONDS_PER_WEEK + (records["toe"] - records["toc"])
        possible &= np.abs(apart) < SECONDS_PER_DAY
    possible &= (records["sv_id"] > 0) & (records["sv_id"] < SATELLITE_KEYS)
    return np.where(finite, np.where(possible, Fault.NONE, Fault.BAD_VALUE), Fault.NON_FINITE).astype(np.int64)


def _payloads(records: NDArray[np.void]) -> NDArray[np.bytes_]:
    """Return the bytes of each record, for comparisons; these ignore zeros at the end, which does no harm here."""
    return np.ascontiguousarray(records).view(f"S{EPHEMERIS.itemsize}")


def _sorted_once(records: NDArray[np.void]) -> tuple[NDArray[np.void], int]:
    """Return the sorted records, of each issue the one sent last, and the number of those left out."""
    sent = records["sent_week"] * SECONDS_PER_WEEK + np.nan_to_num(records["sent"], nan=-np.inf)
    payload = _payloads(records)
    identity = [records[name] for name in ("gnss_id", "sv_id", "message", "toe_week", "toe", "issue")]
    order = np.lexsort([payload, sent, *reversed(identity)])
    last = np.ones(len(records), np.bool_)
    if len(records) > 1:
        last[:-1] = np.any([key[order][1:] != key[order][:-1] for key in identity], axis=0)
    return records[order[last]], len(records) - int(np.count_nonzero(last))


DELAY_FIELDS = (
    "tgd",
    "tgd2",
    "isc_l1ca",
    "isc_l2c",
    "isc_l5i",
    "isc_l5q",
    "isc_l1cd",
    "isc_l1cp",
    "bgd_e5a",
    "bgd_e5b",
    "tgd_b1cp",
    "tgd_b2ap",
    "tgd_b2bi",
    "isc_b1cd",
    "isc_b2ad",
    "delta_tau",
)


def _broadcast(fields: Fields, name: str) -> float:
    value = fields.get(name, math.nan)
    return value if abs(value) < _NOT_BROADCAST else math.nan


def _seconds(value: float) -> float:
    """Return seconds of a week; NaN for a number that is far from any week."""
    return value if abs(value) < 1e8 else math.nan


def _integer(value: float, otherwise: int) -> int:
    return round(value) if math.isfinite(value) and abs(value) < 2**31 else otherwise


def _shifted(week: int, seconds: float, offset: float) -> Instant:
    return normalized(week, seconds + offset) if math.isfinite(seconds) else (week, seconds)
