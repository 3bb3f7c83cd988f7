"""husky_test1 (robot_localization): a Clearpath Husky around a parking lot, 396 m in 395 s, a ROS 1 bag.

Imu 30 Hz (a "slightly broken" 3DM-GX2), NavSatFix 2.5 Hz, wheel odometry 10 Hz; no truth. The way of a user: the bag
goes through `rosbags-convert` as it is, the parameters name its topics and the mounting of the authors' launch file.

- Gravity is on +y of the IMU, as the launch file has it; its gyro turns as the wheels say, within a few degrees in all.
- At 1 m/s the wheels shake the IMU: 0.45 m/s2 and 1.6 deg/s from sample to sample at 30 Hz, white by aliasing. Mean
  rates of straight stretches show a gyro bias below 0.1 deg/s.
- Fixes claim 0.8 to 1.3 m. In the first minute the altitude falls by 25 m, and the course of the fixes wanders by
  30 deg and more while wheels and gyro go straight.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import MapFrame
from support.recordings.common import Array, Recording

INSTALLATION = """\
/**:
  ros__parameters:
    topics.gnss_fix: fix
    topics.wheel: husky_velocity_controller/odom
    imu.mount_position: [0.0, -0.3, 0.52]
    imu.mount_rpy_deg: [90.0, 0.0, -90.0]
"""

NOISE = """\
    # What the wheels shake, folded in by sampling at 30 Hz.
    imu.gyro_noise_density: 5.0e-3
    imu.accel_noise_density: 0.1
    imu.gyro_bias_std: 0.002
    # Fixes wander by much more than they claim.
    gnss.covariance_scale: 10.0
    gnss.correlation_time: 30.0
"""

HEADING = ("alignment.initial_heading_deg: 115.0", "alignment.initial_heading_std_deg: 20.0")
"""The course of the first fixes: at 1 m/s and with fixes of 1 m the heading is not found by itself."""

HALF_WINDOW = 3_000_000_000
LEAST_SPEED = 0.8
LARGEST_TURN = 0.17


def husky_recording(folder: Path, source: Path) -> Recording:
    """Convert the bag in `source` to `folder`."""
    bag = folder / "husky"
    shutil.rmtree(bag, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    convert = [sys.executable, "-m", "rosbags.convert", "--src", str(source / "test1.bag"), "--dst", str(bag)]
    subprocess.run(convert, check=True)
    return Recording(bag, INSTALLATION, NOISE)


def course(fixes: NDArray[Any], wheel: NDArray[Any]) -> tuple[NDArray[np.int64], Array]:
    """Stamps (n,) and course over ground (n,), rad, 0 = east: of the fixes within 3 s, where the robot goes straight.

    So it does where the wheels say at least 0.8 m/s and turn by no more than 10 deg.
    """
    place = MapFrame(tuple(float(fixes[name][0]) for name in ("latitude", "longitude", "altitude")))  # type: ignore[arg-type]
    position = np.array([place.from_geodetic_deg(*p) for p in fixes[["latitude", "longitude", "altitude"]].tolist()])
    stamps, courses = [], []
    for stamp in fixes["stamp"][::5]:
        near = np.abs(fixes["stamp"] - stamp) < HALF_WINDOW
        rolling = np.abs(wheel["stamp"] - stamp) < HALF_WINDOW
        turned = wheel["angular_velocity"][rolling, 2].mean() * 2e-9 * HALF_WINDOW
        if wheel["linear_velocity"][rolling, 0].min() < LEAST_SPEED or abs(turned) > LARGEST_TURN:
            continue
        east, north, _ = np.polyfit((fixes["stamp"][near] - stamp) * 1e-9, position[near], 1)[0]
        stamps.append(stamp)
        courses.append(np.arctan2(north, east))
    return np.array(stamps), np.array(courses)
