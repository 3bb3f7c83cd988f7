"""Constellations and signals: numbers, names, carrier frequencies.

Constellations have the numbers of u-blox (the field ``gnss_id`` of the topic `gnss/ranges`), signals the names of
RINEX 3 (band and attribute, RINEX 3.04 tables 4 to 9) and, where u-blox has one, its ``sigId``.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from eskf_ros.compiled import njit

SPEED_OF_LIGHT = 299792458.0

L1 = 1575.42e6
L2 = 1227.60e6
L5 = 1176.45e6
E5B = 1207.14e6
E5 = 1191.795e6
E6 = 1278.75e6
B1I = 1561.098e6
B3I = 1268.52e6
G1 = 1602.0e6
G1_STEP = 0.5625e6
G2 = 1246.0e6
G2_STEP = 0.4375e6
G3 = 1202.025e6


class Gnss(IntEnum):
    """Constellation (u-blox numbering)."""

    GPS = 0
    SBAS = 1
    GALILEO = 2
    BEIDOU = 3
    QZSS = 5
    GLONASS = 6


GNSS_COUNT = 8
"""Length of a table indexed by ``gnss_id`` or `time_group`."""

IS_CONSTELLATION = np.isin(np.arange(GNSS_COUNT), list(Gnss))
"""By ``gnss_id``: whether it is one of `Gnss`."""

BEIDOU_3 = 4
"""`time_group` of the satellites of BeiDou-3 (a ``gnss_id`` that no constellation has)."""

LETTERS = {
    "G": Gnss.GPS,
    "S": Gnss.SBAS,
    "E": Gnss.GALILEO,
    "C": Gnss.BEIDOU,
    "J": Gnss.QZSS,
    "R": Gnss.GLONASS,
}
"""Constellation by its letter in RINEX."""

LOWEST_UPPER_BAND_HZ = 1.5e9
"""Hz; the carriers L1, E1, B1 and G1 are above, all others below."""

SLOT_COUNT = 8
NO_SLOT = -1


class Signal(NamedTuple):
    """A signal: constellation, RINEX 3 name, carrier (Hz; of channel 0 for GLONASS), slot, u-blox ``sigId`` numbers.

    ``slot``: index in the tables of group delay and health of an ephemeris (`eskf_ros.gnss.ephemeris`); `NO_SLOT` if no
    message gives the group delay.
    """

    gnss: Gnss
    code: str
    carrier_hz: float
    slot: int
    ublox: tuple[int, ...] = ()


SIGNALS: tuple[Signal, ...] = (
    Signal(Gnss.GPS, "1C", L1, 0, (0,)),
    Signal(Gnss.GPS, "1P", L1, 1),
    Signal(Gnss.GPS, "1W", L1, 1),
    Signal(Gnss.GPS, "1Y", L1, 1),
    Signal(Gnss.GPS, "1L", L1, 7),
    Signal(Gnss.GPS, "1X", L1, 7),
    Signal(Gnss.GPS, "1S", L1, 6),
    Signal(Gnss.GPS, "2W", L2, 2),
    Signal(Gnss.GPS, "2P", L2, 2),
    Signal(Gnss.GPS, "2Y", L2, 2),
    Signal(Gnss.GPS, "2L", L2, 3, (3,)),
    Signal(Gnss.GPS, "2S", L2, 3, (4,)),
    Signal(Gnss.GPS, "2X", L2, 3),
    Signal(Gnss.GPS, "5Q", L5, 5, (7,)),
    Signal(Gnss.GPS, "5I", L5, 4, (6,)),
    Signal(Gnss.GPS, "5X", L5, 5),
    Signal(Gnss.GALILEO, "1C", L1, 0, (0,)),
    Signal(Gnss.GALILEO, "1B", L1, 0, (1,)),
    Signal(Gnss.GALILEO, "1X", L1, 0),
    Signal(Gnss.GALILEO, "1A", L1, 0),
    Signal(Gnss.GALILEO, "1Z", L1, 0),
    Signal(Gnss.GALILEO, "7Q", E5B, 2, (6,)),
    Signal(Gnss.GALILEO, "7I", E5B, 2, (5,)),
    Signal(Gnss.GALILEO, "7X", E5B, 2),
    Signal(Gnss.GALILEO, "5Q", L5, 1, (4,)),
    Signal(Gnss.GALILEO, "5I", L5, 1, (3,)),
    Signal(Gnss.GALILEO, "5X", L5, 1),
    Signal(Gnss.GALILEO, "8Q", E5, NO_SLOT),
    Signal(Gnss.GALILEO, "8I", E5, NO_SLOT),
    Signal(Gnss.GALILEO, "8X", E5, NO_SLOT),
    Signal(Gnss.GALILEO, "6C", E6, NO_SLOT, (9,)),
    Signal(Gnss.GALILEO, "6B", E6, NO_SLOT, (8,)),
    Signal(Gnss.GALILEO, "6X", E6, NO_SLOT),
    Signal(Gnss.GALILEO, "6A", E6, NO_SLOT, (10,)),
    Signal(Gnss.GALILEO, "6Z", E6, NO_SLOT),
    Signal(Gnss.BEIDOU, "2I", B1I, 0, (0, 1)),
    Signal(Gnss.BEIDOU, "2Q", B1I, 0),
    Signal(Gnss.BEIDOU, "2X", B1I, 0),
    Signal(Gnss.BEIDOU, "1P", L1, 4, (5,)),
    Signal(Gnss.BEIDOU, "1D", L1, 3, (6,)),
    Signal(Gnss.BEIDOU, "1X", L1, 4),
    Signal(Gnss.BEIDOU, "6I", B3I, 2, (4, 10)),
    Signal(Gnss.BEIDOU, "6Q", B3I, 2),
    Signal(Gnss.BEIDOU, "6X", B3I, 2),
    Signal(Gnss.BEIDOU, "7I", E5B, 1, (2, 3)),
    Signal(Gnss.BEIDOU, "7Q", E5B, 1),
    Signal(Gnss.BEIDOU, "7X", E5B, 1),
    Signal(Gnss.BEIDOU, "5P", L5, 6, (7,)),
    Signal(Gnss.BEIDOU, "5D", L5, 5, (8,)),
    Signal(Gnss.BEIDOU, "5X", L5, 6),
    Signal(Gnss.BEIDOU, "7D", E5B, 7),
    Signal(Gnss.BEIDOU, "7P", E5B, NO_SLOT),
    Signal(Gnss.BEIDOU, "7Z", E5B, NO_SLOT),
    Signal(Gnss.BEIDOU, "8X", E5, NO_SLOT),
    Signal(Gnss.QZSS, "1C", L1, 0, (0,)),
    Signal(Gnss.QZSS, "1E", L1, 1, (12,)),
    Signal(Gnss.QZSS, "1L", L1, 7),
    Signal(Gnss.QZSS, "1X", L1, 7),
    Signal(Gnss.QZSS, "1S", L1, 6),
    Signal(Gnss.QZSS, "2L", L2, 3, (5,)),
    Signal(Gnss.QZSS, "2S", L2, 3, (4,)),
    Signal(Gnss.QZSS, "2X", L2, 3),
    Signal(Gnss.QZSS, "5Q", L5, 5, (9,)),
    Signal(Gnss.QZSS, "5I", L5, 4, (8,)),
    Signal(Gnss.QZSS, "5X", L5, 5),
    Signal(Gnss.GLONASS, "1C", G1, 0, (0,)),
    Signal(Gnss.GLONASS, "1P", G1, 0),
    Signal(Gnss.GLONASS, "2C", G2, 1, (2,)),
    Signal(Gnss.GLONASS, "2P", G2, 1),
    Signal(Gnss.GLONASS, "3Q", G3, NO_SLOT),
    Signal(Gnss.GLONASS, "3I", G3, NO_SLOT),
    Signal(Gnss.GLONASS, "3X", G3, NO_SLOT),
)
"""All signals; of the signals of one satellite the first in this list is used with a single frequency."""

UNKNOWN_SIGNAL = 255
"""Index of a signal that is not in the list."""

SIGNAL_BY_CODE = {(signal.gnss, signal.code): index for index, signal in enumerate(SIGNALS)}
SIGNAL_BY_UBLOX = {(signal.gnss, number): index for index, signal in enumerate(SIGNALS) for number in signal.ublox}

SIGNAL_GNSS = np.array([signal.gnss for signal in SIGNALS], np.int64)
SIGNAL_SLOT = np.array([signal.slot for signal in SIGNALS], np.int64)
SIGNAL_CARRIER_HZ = np.array([signal.carrier_hz for signal in SIGNALS])
_CHANNEL_STEP_HZ = np.array([{G1: G1_STEP, G2: G2_STEP}.get(signal.carrier_hz, 0.0) for signal in SIGNALS])


@njit
def carrier_hz(signal, channel):
    """Return the carrier frequency (Hz) of ``SIGNALS[signal]``; ``channel`` is that of a GLONASS satellite (-7 to 13).

    GLONASS ICD L1, L2, edition 5.1, section 3.3.1.1.
    """
    return SIGNAL_CARRIER_HZ[signal] + channel * _CHANNEL_STEP_HZ[signal]


@njit
def is_upper_band(signal, carrier):
    """Return whether a signal is around L1: neither ``SIGNALS[signal]`` nor its carrier (Hz, NaN unknown) denies it.

    Receivers delay the bands differently, by metres: a pseudorange of another band has another receiver clock in it.
    """
    listed = 0 <= signal < len(SIGNAL_CARRIER_HZ)
    if listed and SIGNAL_CARRIER_HZ[signal] < LOWEST_UPPER_BAND_HZ:
        return False
    return not carrier < LOWEST_UPPER_BAND_HZ


@njit
def is_beidou_geostationary(gnss_id, sv_id):
    """Return whether the ephemeris of a BeiDou satellite is in a tilted frame (BDS-SIS-ICD-B1I 3.0, section 5.2.4)."""
    return gnss_id == Gnss.BEIDOU and (sv_id <= 5 or sv_id >= 59)


@njit
def time_group(gnss_id, sv_id):
    """Return the group of satellites with a common offset in the receiver clock: ``gnss_id``, or `BEIDOU_3`.

    BeiDou-3 is apart from BeiDou-2 because receivers measure B1I of the two generations 1 to 3 m apart (0.5 ns and more
    in the filters and the group delays).
    """
    return BEIDOU_3 if gnss_id == Gnss.BEIDOU and sv_id >= _FIRST_BEIDOU_3 else gnss_id


_FIRST_BEIDOU_3 = 19
