"""The frames of a recording's messages."""

from __future__ import annotations

from enum import IntEnum


class Frame(IntEnum):
    """Index of a frame in `STRINGS`."""

    IMU = 0
    GNSS = 1
    EARTH = 2
    BASE = 3
    SECOND_GNSS = 4
    ODOM = 5
    WHEEL = 6
    MAGNETOMETER = 7
    BAROMETER = 8
    BODY_VELOCITY = 9


STRINGS = (
    "imu_link",
    "gps",
    "earth",
    "base_link",
    "gps2",
    "odom",
    "wheel_link",
    "magnetometer_link",
    "barometer_link",
    "body_velocity_link",
)
"""The frames' names; messages hold indices into them."""
