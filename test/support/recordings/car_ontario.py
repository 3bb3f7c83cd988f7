"""car_ontario (yongkyuns/imu_gnss_fusion): a car, seven drives, a consumer IMU at 99.5 Hz in odd mounts, GNSS at 2 Hz.

Fixes and velocities are those of the receiver with its standard deviations. Its own running estimate of the mounting of
the IMU is what a calibration is compared with: the last row is the settled one. Antenna and rear axle are not known.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

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
    write_bag,
)

DRIVES = (
    "urban-short-turn-loop-nominal-001",
    "urban-medium-turn-loop-nominal-001",
    "urban-stop-go-tight-turns-nominal-001",
    "urban-stop-go-large-mount-001",
    "parkinglot-maneuvers",
    "urban-low-speed-low-signal-001",
    "mixed-road-long-drive-large-mount-001",
)

EPOCH = 1.6e9
"""s; the files count from the start of the drive, stamps have to be of some day."""

INSTALLATION = """\
/**:
  ros__parameters:
    imu.mount_rpy_deg: [0.0, 0.0, 0.0]
"""


def car_ontario_recording(folder: Path, source: Path, drive: str) -> Recording:
    """Write one of `DRIVES` (below the folder `source`) to `folder`; its IMU has no mounting in the parameters."""
    readings, solution = read(source / drive / "imu.csv.gz"), read(source / drive / "gnss.csv.gz")
    time = solution[:, 0] + EPOCH
    fixes = Fixes(time, solution[:, 1:4], diagonal(solution[:, [8, 7, 9]]), np.full(len(time), STATUS_FIX, np.int8))
    velocity = solution[:, [5, 4, 6]] * (1.0, 1.0, -1.0)
    bag = folder / f"{drive}.mcap"
    write_bag(
        bag,
        imu(readings[:, 0] + EPOCH, readings[:, 4:7], readings[:, 1:4]),
        gnss_fix(fixes, 0.0),
        gnss_velocity(time, velocity, solution[:, [11, 10, 12]], time + GNSS_LATENCY),
    )
    return Recording(bag, INSTALLATION, "")


def reference_mounting(source: Path, drive: str) -> Rotation:
    """IMU to vehicle, as the receiver has settled on it."""
    return Rotation.from_euler("xyz", read(source / drive / "reference_mount.csv.gz")[-1, 1:4], degrees=True)


def read(path: Path) -> Array:
    """The numbers of a compressed CSV file."""
    with gzip.open(path, "rt", encoding="ascii") as file:
        return np.loadtxt(file, delimiter=",", skiprows=1)
