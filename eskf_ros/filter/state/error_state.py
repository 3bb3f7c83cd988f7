"""Indices of the error state: 15 core errors that every robot has, and the augmented states behind them.

The core, three errors each: position (m), velocity (m/s) and attitude (rad) in map, accelerometer bias (m/s2) and gyro
bias (rad/s) in IMU axes.
"""

from __future__ import annotations

from eskf_ros.gnss.signals import BEIDOU_3, Gnss

# First index of each block of three.
POSITION = 0

VELOCITY = 3

ATTITUDE = 6

ACCEL_BIAS = 9

GYRO_BIAS = 12

ERROR_SIZE = 15

OPTIONAL_SIZES = {
    "position_error": 3,
    "lever_arm": 3,
    "time_offset": 1,
    "velocity_time_offset": 1,
    "imu_scale": 6,
    "mounting": 2,
    "wheel_scale": 1,
    "wheel_time_offset": 1,
    "nhc_position": 1,
    "clock": 2,
    "inter_system": 6,
    "heading_offset": 1,
    "baro_offset": 1,
    "baro_scale": 1,
    "mag_error": 1,
    "magnetic_bias": 3,
}
"""Augmented states in the order of their indices, and how many errors each has; see `augmented_states`.

The first four are what positions and velocities of a receiver need: the humble lane has them, too. ``imu_scale``: of
the three accelerometers, then of the three gyros. ``clock``: of the receiver, bias (m) and drift (m/s).
``inter_system``: offset of the ranges of a constellation from those of GPS (m), in the order of `INTER_SYSTEM`.
"""

INTER_SYSTEM = (Gnss.GALILEO, BEIDOU_3, Gnss.GLONASS, Gnss.QZSS, Gnss.BEIDOU, Gnss.SBAS)
"""The constellations other than GPS (`gnss.signals.time_group`), the most common first: activating the offset of one
activates those before it.
"""

OPTIONAL_CAPACITY = sum(OPTIONAL_SIZES.values())

ERROR_CAPACITY = ERROR_SIZE + OPTIONAL_CAPACITY

NOWHERE = ERROR_CAPACITY
"""Index of an augmented state that is switched off: it is never below ``state.error_size``."""

SOURCES = 2
"""Number of GNSS receivers with an antenna of their own; the source of a fix is the index of its receiver."""
