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

from recordings.common import Recording

INSTALLATION = """\
/**:
  ros__parameters:
    topics.gnss_fix: fix
    imu.mount_position: [0.0, -0.3, 0.52]
    imu.mount_rpy_deg: [90.0, 0.0, -90.0]
"""

NOISE = """\
    # What the wheels shake, folded in by sampling at 30 Hz.
    imu.gyro_noise_density: 5.0e-3
    imu.accel_noise_density: 0.1
    imu.gyro_bias_std: 0.002
"""

HEADING = ("alignment.initial_heading_deg: 115.0", "alignment.initial_heading_std_deg: 20.0")
"""The course of the first fixes: at 1 m/s and with fixes of 1 m the heading is not found by itself."""


def husky_recording(folder: Path, source: Path) -> Recording:
    """Convert the bag in `source` to `folder`."""
    bag = folder / "husky"
    shutil.rmtree(bag, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    convert = [sys.executable, "-m", "rosbags.convert", "--src", str(source / "test1.bag"), "--dst", str(bag)]
    subprocess.run(convert, check=True)
    return Recording(bag, INSTALLATION, NOISE)
