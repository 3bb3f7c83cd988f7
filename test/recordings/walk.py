"""walk_0827 (rtklibexplorer/GNSS_IMU): a hand-held IMU and an u-blox X20P, 134 s, tight turns in a back yard.

IMU at 166 Hz, RTK solution (NAV-PVT) and raw measurements four times a second.

- Stamps are GPS time in Unix seconds. IMU and positions agree within 0.02 s (mean NIS by offset), the velocity of the
  receiver is 0.12 s (+-0.02) older than its position (as on drive_0708).
- IMU axes are right, backward, up, as the author says; how the hand holds it differs by some 20 deg from step to step.
  It is within 5 cm of the antenna.
- The solutions of the first 87 s have fixed ambiguities; only these are truth. They are 5.6 m east,
  4.5 m north and 3 m above WGS84, as the base station is.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recordings.common import (
    GNSS_LATENCY,
    STATUS_FIX,
    STATUS_GBAS,
    Array,
    Fixes,
    Recording,
    diagonal,
    gnss_fix,
    gnss_velocity,
    gps_to_unix,
    imu,
    truth_fix,
    write_bag,
)

WEEK = 2381
STANDARD_GRAVITY = 9.80665
TIME_OFFSET = 0.0
VELOCITY_AGE = 0.12
FIXED = 2

INSTALLATION = f"""\
/**:
  ros__parameters:
    imu.mount_rpy_deg: [0.0, 0.0, 90.0]
    gnss.time_offset: {TIME_OFFSET}
"""

NOISE = """\
    # A hand points it elsewhere than the feet go.
    alignment.use_course: false
"""

OUTAGE_SETS = {
    15.0: (((25.0, 15.0), (60.0, 15.0)), ((40.0, 15.0),), ((50.0, 15.0),), ((70.0, 15.0),)),
    30.0: (((25.0, 30.0),), ((40.0, 30.0),), ((55.0, 30.0),)),
}
"""Outages (start, length in s) by length, while the walker moves and the truth is fixed."""


def walk_recording(folder: Path, source: Path) -> Recording:
    """Write the walk (the folder `source`) to `folder`: one RTK solution a second; the other three are the truth."""
    time, specific_force, angular_rate = read_imu(source)
    fixes, velocity, velocity_std = read_solution(source)
    given = np.abs(fixes.time - np.round(fixes.time)) < 0.1
    bag = folder / "walk.mcap"
    write_bag(
        bag,
        imu(time, specific_force, angular_rate),
        gnss_fix(fixes[given], TIME_OFFSET),
        gnss_velocity(
            fixes.time[given] - VELOCITY_AGE,
            velocity[given],
            velocity_std[given],
            fixes.time[given] + TIME_OFFSET + GNSS_LATENCY,
        ),
        truth_fix(fixes[~given & (fixes.status == STATUS_GBAS)], TIME_OFFSET),
    )
    return Recording(bag, INSTALLATION, NOISE)


def read_imu(source: Path) -> tuple[Array, Array, Array]:
    """Stamps (n,) in s, specific force (n, 3) in m/s2 and angular rate (n, 3) in rad/s in IMU axes."""
    table = np.loadtxt(source / "imu.csv", delimiter=",", skiprows=1)
    return gps_to_unix(WEEK, table[:, 0], 0), table[:, 1:4] * STANDARD_GRAVITY, table[:, 4:7]


def read_solution(source: Path) -> tuple[Fixes, Array, Array]:
    """The RTK solution of the receiver: positions, East-North-Up velocities (n, 3) in m/s, their deviations (n, 3)."""
    table = np.loadtxt(source / "truth_navpvt.csv", delimiter=",", skiprows=1)
    horizontal, vertical, speed = table[:, 7], table[:, 8], table[:, 9]
    # The receiver gives the accuracy of the horizontal position and of the velocity as a whole.
    std = np.column_stack([horizontal, horizontal, vertical]) / np.array([np.sqrt(2.0), np.sqrt(2.0), 1.0])
    fixes = Fixes(
        gps_to_unix(WEEK, table[:, 0] * 1e-3, 0),
        table[:, 1:4],
        diagonal(std),
        np.where(table[:, 11] == FIXED, STATUS_GBAS, STATUS_FIX).astype(np.int8),
    )
    velocity = table[:, [5, 4, 6]] * np.array([1.0, 1.0, -1.0])
    return fixes, velocity, np.repeat(speed[:, None], 3, axis=1) / np.sqrt(3.0)
