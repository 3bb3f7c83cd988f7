"""KITTI (from the PyPI package gtsam): a car in a town, 3.7 km in 470 s.

Inertial unit of an OXTS RT3003 at 100 Hz and its position once a second, in metres east, north and up of an unknown
place; we put them near Karlsruhe. What the data say (checked with the accelerations and the course over ground):

- IMU axes are forward, left, up, specific force +9.8 upwards; car and IMU agree within 0.5 deg; position refers to it.
- Eight times there is no IMU sample for 1.5 to 1.6 s; the file bridges the hole with rows on a straight line, which
  miss up to 12 deg of a turn. `measured_rows` finds these rows and they are left out. Nearly two seconds more are
  missing between the first row and the second.
- A sample describes the motion 0.065 s (+-0.01) before the position of the same stamp (a low pass before the output).
- Positions repeat within a few centimetres from second to second; how far off they are together does not show here.
- There is no velocity. The velocity messages are a stand-in for the Doppler of a receiver: once every ten seconds
  the difference of the positions one second before and after, good to 0.13 m/s against the estimate from all
  positions. These neighbours are no truth, with or without velocity.
"""

from __future__ import annotations

import calendar
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import MapFrame, to_geodetic
from support.recordings.common import (
    GNSS_LATENCY,
    STATUS_FIX,
    Array,
    Fixes,
    Recording,
    diagonal,
    gnss_fix,
    gnss_velocity,
    imu,
    truth_fix,
    write_bag,
)

DATUM = (49.0, 8.43, 115.0)
MIDNIGHT = calendar.timegm((2011, 10, 3, 0, 0, 0))
TIME_OFFSET = 0.065
POSITION_STD = 0.05
VELOCITY_STD = (0.15, 0.15, 0.1)
DENSE = 60.0
STEP = 10

# What a user has to say about a car: where the sensors are and how their clocks differ.
INSTALLATION = f"""\
/**:
  ros__parameters:
    gnss.time_offset: {TIME_OFFSET}
"""

NOISE = """\
    imu.gyro_noise_density: 2.0e-4
    imu.gyro_bias_random_walk: 3.0e-6
    imu.accel_bias_random_walk: 1.7e-4
    # What a turn of a car hides in a hole of 1.6 s.
    imu.gap_gyro_std: 0.1
    imu.gap_accel_std: 1.0
"""


def kitti_recording(folder: Path, with_velocity: bool) -> Recording:
    """Write the KITTI drive to `folder`: each position of the first minute, then one in ten.

    Raises ModuleNotFoundError without gtsam.
    """
    time, specific_force, angular_rate = read_imu()
    position_time, position = read_positions()
    time, position_time = time + MIDNIGHT, position_time + MIDNIGHT
    count = len(position_time)
    geodetic = to_geodetic(MapFrame(DATUM).to_ecef(position))
    geodetic[:, :2] = np.degrees(geodetic[:, :2])
    covariance = diagonal(np.full((count, 3), POSITION_STD))
    fixes = Fixes(position_time, geodetic, covariance, np.full(count, STATUS_FIX, np.int8))
    every_ten = np.arange(count) % STEP == 0
    given = every_ten | (position_time <= position_time[0] + DENSE)

    inner = np.flatnonzero(every_ten[1:-1]) + 1
    interval = position_time[inner + 1] - position_time[inner - 1]
    velocity = (position[inner + 1] - position[inner - 1]) / interval[:, None]
    beside = np.zeros(count, bool)
    beside[np.concatenate([inner - 1, inner + 1])] = True
    topics = [
        imu(time, specific_force, angular_rate),
        gnss_fix(fixes[given], TIME_OFFSET),
        truth_fix(fixes[~given & ~beside], TIME_OFFSET),
    ]
    if with_velocity:
        std = np.tile(VELOCITY_STD, (len(inner), 1))
        arrival = position_time[inner] + TIME_OFFSET + GNSS_LATENCY
        topics.append(gnss_velocity(position_time[inner], velocity, std, arrival))
    bag = folder / ("kitti_velocity.mcap" if with_velocity else "kitti.mcap")
    write_bag(bag, *topics)
    return Recording(bag, INSTALLATION, NOISE)


def read_imu() -> tuple[Array, Array, Array]:
    """Time of day (n,) in s, specific force (n, 3), angular rate (n, 3) as measured: without the interpolated rows."""
    import gtsam

    table = np.loadtxt(gtsam.findExampleDataFile("KittiEquivBiasedImu.txt"), skiprows=1)
    time, readings = table[:, 0], table[:, 2:8]
    measured = measured_rows(time, readings)
    return time[measured], readings[measured, :3], readings[measured, 3:]


def measured_rows(time: Array, readings: Array) -> NDArray[np.bool_]:
    """True for the rows that were measured: no sensor puts three samples (n, 6) exactly on a straight line.

    The row before such a triple's middle is on the line too; the line ends in the first measured row after the hole.
    """
    slope = np.diff(readings, axis=0) / np.diff(time)[:, None]
    middle = np.concatenate([[False], np.abs(np.diff(slope, axis=0)).max(axis=1) < 1e-3, [False]])
    start = np.concatenate([middle[1:], [False]])
    return ~(middle | start)


def read_positions() -> tuple[Array, Array]:
    """Time of day (n,) in s and position (n, 3) in m, east, north, up."""
    import gtsam

    table = np.loadtxt(gtsam.findExampleDataFile("KittiGps_converted.txt"), skiprows=1, delimiter=",")
    return table[:, 0], table[:, 1:4]
