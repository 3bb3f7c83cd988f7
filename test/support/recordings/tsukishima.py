"""tsukishima_20201105 (kakusang2020): a car between the tall buildings of Tokyo, 11.3 km in 1871 s.

A MEMS IMU at 50 Hz, wheel pulses at 50 Hz, an u-blox F9P with RTK and Doppler velocity at 5 Hz.

Clocks, by correlation, fixed once:

- GNSS time is 17.985 s (+-0.015) ahead of the IMU: changes of the RTK and of the Doppler speed over two seconds against
  the integral of the forward acceleration (17.99 and 18.02), and what the estimator's monitor of the time offset says.
  GNSS stamps are UTC (leap seconds 18), so they are 0.015 s early. The yaw rate says 17.88 against the course of the
  Doppler velocity; with that, positions are twice as far off and the monitor says so.
- It is 17.34 s (+-0.02) ahead of the wheel speed: smallest median difference to the Doppler speed. The wheel speed is
  0.645 s older than the IMU sample of the same row. 5.09 pulses are a metre. The speed has steps of 0.2 m/s; they last
  longer than 20 ms, and one sample in five is given.

Axes: IMU x right, y forward, z up, found by the accelerations along the course and the sign of the turns. Over 5 m/s
and straight ahead the velocity of the estimate lies 2.3 deg above the IMU's y axis and 0.3 deg to the right of it. In
turns it moves sideways by 0.9 to 1.3 m times the yaw rate: so far behind the antenna is the rear axle.

RTK calls 7233 of 8851 epochs fixed and claims 4 to 16 mm, but among the buildings many are wrong by metres: one step
in twenty from one fixed epoch to the next is over 0.4 m off what the wheels measured. Truth are fixed epochs in runs of
at least five seconds in which every step agrees with the wheels within 0.25 m and changes the height by less than
0.25 m: 5457 epochs.

Raw measurements (GPS and QZSS on L1, five times a second) cover the first 853 s; satellites, their clocks and the
troposphere are applied by the authors. No parameters of the ionosphere came with them; the defaults stand in. Our point
solutions lie 2.4 m east, 1.3 m north and 7 m below RTK, in the first minute as in the last: the ionosphere, or the
datum of the base station.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from eskf_ros.geodesy.map_frame import east_north_up_to_ecef
from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.ranges import (
    ALREADY_TURNED,
    CLOCK_APPLIED,
    CODE_VALID,
    DOPPLER_VALID,
    SATELLITE_KNOWN,
    TROPOSPHERE_APPLIED,
    allocate_ranges,
    locate,
)
from eskf_ros.gnss.rinex_nav import read_navigation
from eskf_ros.gnss.signals import L1, SIGNAL_BY_CODE, SPEED_OF_LIGHT, Gnss
from support.recordings.common import (
    GNSS_LATENCY,
    STATUS_GBAS,
    Array,
    Fixes,
    Recording,
    differences,
    ecef_to_geodetic_deg,
    gnss_fix,
    gnss_velocity,
    gps_to_unix,
    imu,
    shifted,
    truth_fix,
    wheel,
    write_bag,
)
from support.recordings.satellites import RangeEpochs, gnss_ephemerides, gnss_ranges, solved_fixes

WEEK = 2130
LEAP_SECONDS = 18
TIME_OFFSET = 0.015
WHEEL_AGE = 0.645
PULSES_PER_METRE = 5.09
WHEEL_STD = 0.1
VELOCITY_STD = (0.15, 0.15, 0.3)
FIXED = 1
LONGEST_STEP = 0.25
SHORTEST_RUN = 25
STEP_TOLERANCE = 0.25
STANDING = 100.0

INSTALLATION = f"""\
/**:
  ros__parameters:
    imu.mount_rpy_deg: [-2.3, 0.0, -89.7]
    gnss.lever_arm: [0.0, 0.0, 0.6]
    gnss.time_offset: {TIME_OFFSET}
    wheel.time_offset: {-WHEEL_AGE}
"""

NOISE = """\
    # Many a solution that is called fixed is wrong: 0.1 m believes them, and the filter starts again 5 times.
    gnss.position_std_floor: 0.3
    # The forward accelerometer is 0.5 m/s2 off.
    imu.accel_bias_std: 0.5
    imu.accel_bias_random_walk: 1.0e-3
    imu.gyro_noise_density: 7.0e-4
"""

REAR_AXLE = ("wheel.position: [-1.2, 0.0, 0.0]", "nhc.position: [-1.2, 0.0, 0.0]")

RANGES_NOISE = """\
    # No parameters of the ionosphere for the day.
    ranges.correlated_std_vertical: 5.0
    imu.accel_bias_std: 0.5
    imu.accel_bias_random_walk: 1.0e-3
    imu.gyro_noise_density: 7.0e-4
"""

OUTAGE_LENGTH = 30.0
OUTAGE_SETS = tuple(
    tuple((start, OUTAGE_LENGTH) for start in np.arange(first, 1800.0, 120.0).tolist())
    for first in (180.0, 210.0, 240.0, 270.0)
)
"""Outages (start, length in s): every two minutes while the car moves, in four staggered replays."""


def tsukishima_recording(folder: Path, source: Path) -> Recording:
    """Write the drive (the folder `source`) to `folder`: a fixed RTK position and a Doppler velocity every second."""
    time, readings, speed = read_imu(source)
    fixes, confirmed = read_rtk(source, time, speed)
    # The receiver was switched on 22 s before the IMU.
    given = (fixes.time == np.round(fixes.time)) & (fixes.time > time[0])
    velocity_time, velocity, velocity_std = read_velocity(source)
    whole = (np.abs(velocity_time - np.round(velocity_time)) < 0.01) & (velocity_time > time[0])
    bag = folder / "tsukishima.mcap"
    write_bag(
        bag,
        imu(time, readings[:, :3], readings[:, 3:]),
        gnss_fix(fixes[given], TIME_OFFSET),
        gnss_velocity(
            velocity_time[whole],
            velocity[whole],
            velocity_std[whole],
            velocity_time[whole] + TIME_OFFSET + GNSS_LATENCY,
        ),
        wheel(time[::5], speed[::5], WHEEL_STD, time[::5]),
        truth_fix(fixes[confirmed & ~given], TIME_OFFSET),
    )
    return Recording(bag, INSTALLATION, NOISE)


def tsukishima_ranges_recording(folder: Path, source: Path) -> Recording:
    """Write the part of the drive that has ranges: them and our own point solutions five times a second, wheels.

    `truth` are all confirmed RTK positions, `truth_shifted` the same, shifted by what the point solutions differ from
    them (median) while the car stands at the start.
    """
    time, readings, speed = read_imu(source)
    fixes, confirmed = read_rtk(source, time, speed)
    epochs = read_ranges(source)
    epochs = epochs[epochs.time > time[0]]
    during = time < epochs.time[-1] + TIME_OFFSET
    solved, velocity_time, velocity, velocity_std = solved_fixes(epochs, Ephemerides())
    truth = fixes[confirmed & (fixes.time > time[0]) & (fixes.time < epochs.time[-1])]
    standing = solved.time < time[0] + STANDING
    shift = np.median(differences(solved[standing], truth), axis=0)
    bag = folder / "tsukishima_ranges.mcap"
    write_bag(
        bag,
        imu(time[during], readings[during, :3], readings[during, 3:]),
        gnss_fix(solved, TIME_OFFSET),
        gnss_velocity(velocity_time, velocity, velocity_std, velocity_time + TIME_OFFSET + GNSS_LATENCY),
        gnss_ranges(epochs, epochs.time + TIME_OFFSET + GNSS_LATENCY),
        gnss_ephemerides(time[0], read_navigation(source / "base.nav").broadcasts),
        wheel(time[during][::5], speed[during][::5], WHEEL_STD, time[during][::5]),
        truth_fix(truth, TIME_OFFSET),
        truth_fix(shifted(truth, shift), TIME_OFFSET, "truth_shifted"),
    )
    return Recording(bag, INSTALLATION, RANGES_NOISE)


def read_imu(source: Path) -> tuple[Array, Array, Array]:
    """IMU stamps (n,) in s, specific force and angular rate (n, 6) in IMU axes, wheel speed of the same rows (n,)."""
    table = loadmat(source / "IMUData1105.mat")["IMUData"]
    speed = loadmat(source / "IMUData_CarSpeed.mat")["IMUCarSpeed"][:, 8] / PULSES_PER_METRE
    return gps_to_unix(WEEK, table[:, 0], 0), table[:, 1:7], speed


def read_rtk(source: Path, wheel_time: Array, wheel_speed: Array) -> tuple[Fixes, NDArray[np.bool_]]:
    """The positions with fixed ambiguities, and which of them (n,) the wheels and their neighbours confirm."""
    table = np.loadtxt(source / "RTK1105.csv", delimiter=",")
    table = table[table[:, 4] == FIXED]
    time, position, std = gps_to_unix(WEEK, table[:, 0], LEAP_SECONDS), table[:, 1:4], table[:, 6:12]
    geodetic = ecef_to_geodetic_deg(position)
    # RTKLIB gives roots of variances and signed roots of covariances: xx yy zz xy yz zx.
    squares = np.sign(std) * std**2
    covariance = squares[:, [0, 3, 5, 3, 1, 4, 5, 4, 2]].reshape(-1, 3, 3)
    to_ecef = east_north_up_to_ecef(np.radians(geodetic))
    covariance = to_ecef.transpose(0, 2, 1) @ covariance @ to_ecef
    fixes = Fixes(time, geodetic, covariance, np.full(len(time), STATUS_GBAS, np.int8))

    distance = np.interp(time + TIME_OFFSET + WHEEL_AGE, wheel_time, np.cumsum(wheel_speed * np.gradient(wheel_time)))
    step = np.linalg.norm(np.diff(position, axis=0), axis=1)
    follows = (
        (np.diff(time) < LONGEST_STEP)
        & (np.abs(step - np.diff(distance)) < STEP_TOLERANCE)
        & (np.abs(np.diff(geodetic[:, 2])) < STEP_TOLERANCE)
    )
    run = np.concatenate([[0], np.cumsum(~follows)])
    return fixes, np.bincount(run)[run] >= SHORTEST_RUN


def read_velocity(source: Path) -> tuple[Array, Array, Array]:
    """Time (n,) in s, East-North-Up velocity (n, 3) in m/s from Doppler, its standard deviations (n, 3)."""
    table = np.loadtxt(source / "GNSSvel1105.csv", delimiter=",")
    return gps_to_unix(WEEK, table[:, 0], LEAP_SECONDS), table[:, 2:5], np.tile(VELOCITY_STD, (len(table), 1))


def read_ranges(source: Path) -> RangeEpochs:
    """The ranges of the first part of the drive: GPS and QZSS on L1."""
    rows = loadmat(source / "GNSSTCData_GQ.mat")["GNSSTCData"]
    rows = rows[rows[:, 2] > 0.0]
    starts = np.flatnonzero(np.diff(rows[:, 2], prepend=-1.0))
    seconds = rows[starts, 2]
    ranges = [ranges_of(part) for part in np.split(rows, starts[1:])]
    return RangeEpochs(gps_to_unix(WEEK, seconds, LEAP_SECONDS), WEEK, seconds, ranges)


def ranges_of(rows: Array) -> NDArray[np.void]:
    """Ranges whose satellites, troposphere and satellite clocks the authors of the recording have put in."""
    ranges = allocate_ranges(len(rows))
    # Numbers of QZSS repeat those of GPS; they are farther away.
    ranges["gnss_id"] = np.where(rows[:, 4] > 30e6, Gnss.QZSS, Gnss.GPS)
    ranges["sv_id"], ranges["signal"], ranges["carrier_hz"] = rows[:, 3], SIGNAL_BY_CODE[Gnss.GPS, "1C"], L1
    ranges["pseudorange"], ranges["cn0"] = rows[:, 4], rows[:, 14]
    ranges["satellite"], ranges["satellite_velocity"] = rows[:, 5:8], rows[:, 10:13]
    ranges["satellite_clock"], ranges["satellite_clock_drift"] = 0.0, rows[:, 9]
    ranges["doppler"] = -rows[:, 8] * L1 / SPEED_OF_LIGHT
    ranges["flags"] = CODE_VALID | DOPPLER_VALID | SATELLITE_KNOWN | CLOCK_APPLIED
    ranges["flags"] |= TROPOSPHERE_APPLIED | ALREADY_TURNED
    locate(ranges, WEEK, 0.0, Ephemerides())
    return ranges
