"""The calibration campaign: simulated city drives with a known installation, of which nothing is told.

    python benchmark/calibration.py [--seeds N] [--jobs N] [CASE ...]

Prints the table of docs/calibrate.md for each case: error, sigma and error over sigma of each constant.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.calibration.calibrate import calibrate
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate
from eskf_ros.simulate.wheel import WheelOdometer
from markdown_table import table

Array = NDArray[np.float64]

LEVER_ARM = (0.8, -0.2, 1.4)
MOUNT_RPY_DEG = (24.0, -31.0, 110.0)
"""deg; far from anything a parameter file says: the coarse mounting has to find it."""

TIME_OFFSET, VELOCITY_TIME_OFFSET, WHEEL_TIME_OFFSET = -0.08, -0.13, -0.04
WHEEL_SCALE = 1.02

TRUTH = {
    "lever_arm_x": LEVER_ARM[0],
    "lever_arm_y": LEVER_ARM[1],
    "lever_arm_z": LEVER_ARM[2],
    "time_offset": TIME_OFFSET,
    "velocity_time_offset": VELOCITY_TIME_OFFSET,
    "mounting_yaw": MOUNT_RPY_DEG[2],
    "mounting_pitch": MOUNT_RPY_DEG[1],
    "mounting_roll": MOUNT_RPY_DEG[0],
    "wheel_scale": WHEEL_SCALE,
    "wheel_time_offset": WHEEL_TIME_OFFSET,
    "nhc_position": 0.0,
}
"""What `eskf_calibrate` should find, in the units of the parameters."""

CASES = {"rtk": 0.02, "1 m fixes": 1.0}
"""Horizontal standard deviation of the fixes (m)."""

HEADINGS = ("constant", "shown in", "error, median", "error, largest", "sigma, median", "rms of error / sigma")


@dataclass(frozen=True)
class Outcome:
    """What one run has found: value minus truth, sigma, and whether it was shown, by constant."""

    error: dict[str, float]
    sigma: dict[str, float]
    is_shown: dict[str, bool]


def tables_of(recording: Recording, offsets: Sequence[float] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    """Return a simulated recording as tables whose stamps lack time offsets (s): positions, velocities, wheels."""
    position, velocity, wheels = (round(offset * 1e9) for offset in offsets)
    tables: dict[str, Any] = {
        "imu": {
            "stamp": recording.imu_stamp,
            "specific_force": recording.specific_force,
            "angular_rate": recording.angular_rate,
        },
        "gnss_position": {
            "stamp": recording.fix_stamp - position,
            "latitude_deg": recording.fix_latitude_deg,
            "longitude_deg": recording.fix_longitude_deg,
            "altitude": recording.fix_altitude,
            "covariance": recording.fix_covariance,
            "status": recording.fix_status,
        },
        "gnss_velocity": {
            "stamp": recording.velocity_stamp - position - velocity,
            "velocity": recording.velocity_enu,
            "covariance": recording.velocity_covariance,
        },
    }
    heading = recording.dual_antenna
    if heading is not None:
        variance = np.full(len(heading.stamp), math.radians(heading.sensor.yaw_std_deg) ** 2)
        tables["heading"] = {"stamp": heading.stamp, "yaw": heading.yaw, "covariance": variance}
    wheel = recording.wheel
    if wheel is not None:
        tables["wheel"] = {
            "stamp": wheel.stamp - wheels,
            "speed": wheel.speed,
            "yaw_rate": wheel.yaw_rate,
            "covariance": np.tile([wheel.speed_variance, wheel.yaw_rate_variance], (len(wheel.speed), 1)),
        }
    return tables


def city_drive(seed: int, position_std: float, stop: float = 600.0) -> Recording:
    """Return ten minutes in a city with a consumer IMU in an odd mount."""
    return simulate(
        "hour_drive",
        seed,
        grade="consumer",
        imu_rate=100.0,
        position_std=(position_std, 1.5 * position_std),
        stop=stop,
        imu_rpy_deg=MOUNT_RPY_DEG,
        lever_arm=LEVER_ARM,
        gyro_scale_std=0.003,
        accel_scale_std=0.003,
        wheel=WheelOdometer(scale_error=WHEEL_SCALE - 1.0, scale_std=0.0, rate=20.0),
    )


def outcome(seed: int, position_std: float) -> Outcome:
    """Calibrate one drive with nothing known."""
    tables = tables_of(city_drive(seed, position_std), (TIME_OFFSET, VELOCITY_TIME_OFFSET, WHEEL_TIME_OFFSET))
    found = calibrate(tables, from_mapping({}), compares=False)
    named = {name: found.named(name) for name in TRUTH}
    return Outcome(
        {name: finding.value - TRUTH[name] for name, finding in named.items()},
        {name: finding.std for name, finding in named.items()},
        {name: finding.is_shown for name, finding in named.items()},
    )


def rows_of(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Return a row for each constant."""
    rows = []
    for name in TRUTH:
        error = np.array([one.error[name] for one in outcomes])
        sigma = np.array([one.sigma[name] for one in outcomes])
        shown = sum(one.is_shown[name] for one in outcomes)
        ratio = np.sqrt(np.mean((error / sigma) ** 2))
        size = np.abs(error)
        cells = [f"{value:.2g}" for value in (np.median(size), size.max(), np.median(sigma), ratio)]
        rows.append([name, f"{shown} of {len(outcomes)}", *cells])
    return rows


def main() -> int:
    """Run the campaign; returns the exit code."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("cases", nargs="*", choices=[*CASES, []], metavar="CASE", help=f"one of {', '.join(CASES)}")
    options = parser.parse_args()
    for case in options.cases or CASES:
        with ProcessPoolExecutor(options.jobs) as pool:
            outcomes = list(pool.map(partial(outcome, position_std=CASES[case]), range(options.seeds)))
        print(f"\n{case}, {options.seeds} drives of ten minutes:\n\n{table(HEADINGS, rows_of(outcomes))}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
