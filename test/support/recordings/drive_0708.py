"""drive_0708 (rtklibexplorer/GNSS_IMU): a car, 4.1 km in 549 s, consumer IMU on the roof, RTK at 4 Hz.

- IMU axes are backward, right, up. Over 4 m/s and straight ahead the velocity lies 5.1 deg to the left of -x and
  6.8 deg above it, which is how the author of the data mounts it (5.35 and 6.79 deg).
- The stamps in the file run 257 ppm fast: the counter of the sensor took 548.590 s for what is spread over
  548.731 s. Without the correction the offset to GNSS grows from 0.15 s to 0.26 s along the drive.
- Then IMU stamps are 0.13 s (+-0.01) later than those of the positions with the same motion, and the velocity of
  the receiver is 0.13 s (+-0.01) older than its position; vertically 0.2 s more, hence 0.1 m/s at least.
- Altitudes are above mean sea level. A constant of some metres changes nothing here.
- The running engine turns the pitch gyro by 2.3 deg/s (rms) at rest, folded in by sampling at 100 Hz; on the road it
  wanders by 1 to 3 deg of pitch in 15 s. The noise densities of the parameters are what the drive needs, not those
  of the data sheet. One g reads 9.93 m/s2.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from support.recordings.common import (
    GNSS_LATENCY,
    STATUS_FIX,
    STATUS_GBAS,
    Fixes,
    Recording,
    diagonal,
    gnss_fix,
    gnss_velocity,
    imu,
    read_rtklib,
    truth_fix,
    write_bag,
)

CLOCK_RATE = 548.590 / 548.731
TIME_OFFSET = 0.13
VELOCITY_AGE = 0.13
VELOCITY_STD = (0.05, 0.05, 0.1)

INSTALLATION = f"""\
/**:
  ros__parameters:
    imu.mount_position: [0.0, 0.0, 0.65]
    imu.mount_rpy_deg: [0.0, -6.8, 174.9]
    gnss.lever_arm: [0.0, 0.05, 0.65]
    gnss.time_offset: {TIME_OFFSET}
"""

NOISE = """\
    # Vibration of roof and engine.
    imu.gyro_noise_density: 3.5e-3
    imu.accel_bias_random_walk: 3.0e-4
    gnss.position_std_floor: 0.01
"""

OUTAGE_LENGTH = 15.0
OUTAGE_SETS = tuple(
    tuple((start, OUTAGE_LENGTH) for start in np.arange(first, 548.6 - 30.0 - OUTAGE_LENGTH, 45.0).tolist())
    for first in (40.0, 55.0, 70.0)
)
"""Outages (start, length in s): every 45 s, with 30 s of fixes between them, in three staggered replays."""


def drive_0708_recording(folder: Path, source: Path, with_velocity: bool) -> Recording:
    """Write drive_0708 (the folder `source`) to `folder`: one RTK solution a second; the other three are the truth."""
    table = np.loadtxt(source / "imu_1934_stamped.csv", delimiter=",", comments="#")
    time = table[0, 0] + (table[:, 0] - table[0, 0]) * CLOCK_RATE
    solution_time, solution = read_rtklib(source / "gnss_1934_sf.pos")
    quality, covariance = solution[:, 3], diagonal(solution[:, [6, 5, 7]])
    status = np.where(quality == 1, STATUS_GBAS, STATUS_FIX).astype(np.int8)
    fixes = Fixes(solution_time, solution[:, :3], covariance, status)
    # Epochs are at x.499, x.749, x.999 and x.249 s.
    given = np.abs(np.round(solution_time) - solution_time) < 0.1
    topics = [
        imu(time, table[:, 1:4], table[:, 4:7]),
        gnss_fix(fixes[given], TIME_OFFSET),
        truth_fix(fixes[~given & (quality == 1)], TIME_OFFSET),
    ]
    if with_velocity:
        std = np.maximum(solution[given][:, [17, 16, 18]], VELOCITY_STD)
        arrival = solution_time[given] + TIME_OFFSET + GNSS_LATENCY
        velocity = solution[given][:, [14, 13, 15]]
        topics.append(gnss_velocity(solution_time[given] - VELOCITY_AGE, velocity, std, arrival))
    bag = folder / ("drive_0708_velocity.mcap" if with_velocity else "drive_0708.mcap")
    write_bag(bag, *topics)
    return Recording(bag, INSTALLATION, NOISE)
