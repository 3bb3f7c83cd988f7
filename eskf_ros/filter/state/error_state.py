"""Indices of the error state: 15 errors that every robot has, and the augmented ones behind them."""

from __future__ import annotations

from eskf_ros.gnss.signals import BEIDOU_3, Gnss

# Error state: first index of each block of three. These 15 are the core; every robot has them.
POSITION = 0

VELOCITY = 3

ATTITUDE = 6

ACCEL_BIAS = 9

GYRO_BIAS = 12

ERROR_SIZE = 15

OPTIONAL_SIZES = {
    "position_error": 3,
    "mounting": 2,
    "wheel_scale": 1,
    "clock": 2,
    "inter_system": 6,
    "heading_offset": 1,
    "baro_offset": 1,
    "baro_scale": 1,
    "mag_error": 1,
    "magnetic_bias": 3,
}
"""Optional errors behind the core, and how many each is: see ``optional``.

``clock``: of the receiver, bias (m) and drift (m/s). ``inter_system``: by what the ranges of a constellation are longer
than those of GPS (m), in the order of `INTER_SYSTEM`.
"""

INTER_SYSTEM = (Gnss.GALILEO, BEIDOU_3, Gnss.GLONASS, Gnss.QZSS, Gnss.BEIDOU, Gnss.SBAS)
"""The constellations but GPS (`gnss.signals.time_group`), the most usual first: a state joins with those before it."""

OPTIONAL_CAPACITY = sum(OPTIONAL_SIZES.values())

ERROR_CAPACITY = ERROR_SIZE + OPTIONAL_CAPACITY

NOWHERE = ERROR_CAPACITY
"""The place of an optional error that is switched off: behind every error there can be."""

SOURCES = 2
"""GNSS receivers with antennas of their own, by their index."""
