"""car_ontario (yongkyuns/imu_gnss_fusion): seven drives of a car, consumer IMU in any orientation, receiver at 2 Hz.

The receiver's own settled estimate of how the IMU is mounted is used as it stands. Lever arm and rear axle are unknown.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from support.recordings.common import (
    GNSS_LATENCY,
    STATUS_FIX,
    Fixes,
    Recording,
    diagonal,
    gnss_fix,
    gnss_velocity,
    imu,
    truth_fix,
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

START = 1_700_000_000.0
"""s of Unix time; the recordings count from zero."""

OUTAGE_SETS = {
    name: tuple(tuple((start, 30.0) for start in np.arange(first, last, 120.0).tolist()) for first in (60.0, 120.0))
    for name, last in zip(DRIVES, (140.0, 270.0, 490.0, 450.0, 620.0, 1210.0, 1230.0))
}
"""Outages (start, length in s) of each drive: every 120 s, in two staggered replays."""


def car_ontario_recording(folder: Path, source: Path, name: str) -> Recording:
    """Write one of the `DRIVES` of car_ontario (the folder `source`) to `folder`; its fixes are the truth, too."""
    samples, solution, mount = (
        np.loadtxt(source / name / f"{table}.csv.gz", delimiter=",", skiprows=1)
        for table in ("imu", "gnss", "reference_mount")
    )
    time, solution_time = START + samples[:, 0], START + solution[:, 0]
    covariance = diagonal(solution[:, [8, 7, 9]])
    fixes = Fixes(solution_time, solution[:, 1:4], covariance, np.full(len(solution), STATUS_FIX, np.int8))
    velocity = solution[:, [5, 4, 6]] * (1.0, 1.0, -1.0)
    bag = folder / f"{name}.mcap"
    write_bag(
        bag,
        imu(time, samples[:, 4:7], samples[:, 1:4]),
        gnss_fix(fixes, 0.0),
        gnss_velocity(solution_time, velocity, solution[:, [11, 10, 12]], solution_time + GNSS_LATENCY),
        truth_fix(fixes, 0.0),
    )
    roll, pitch, yaw = mount[-1, 1:4].tolist()
    installation = f"/**:\n  ros__parameters:\n    imu.mount_rpy_deg: [{roll}, {pitch}, {yaw}]\n"
    return Recording(bag, installation, "")
