"""How soon and how well an unknown heading is found: `python benchmark/heading.py [--runs 500]`.

A consumer IMU stands still for eight seconds on a robot that points anywhere, then the robot pulls away. Heading error
15 s later, when the heading was called known, and how often it was then wrong by more than three sigma and ten degrees.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np

from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters import from_mapping
from eskf_ros.simulate.scenario import simulate

PULL_AWAY = 20.0
"""When the scenario `drive` begins to move (s); at most 2 m/s2."""

AFTER = 15.0


def heading_of(quaternion: np.ndarray) -> float:
    """Heading (rad) of a quaternion w x y z."""
    w, x, y, z = quaternion
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def run(seed: int, velocity: bool, reverse: bool, grade: str) -> tuple[float, float, float, float]:
    """Return error and sigma at the end, and time since the pull-away and error when known (deg, s; NaN: never)."""
    yaw = float(np.random.default_rng(seed).uniform(-180.0, 180.0))
    recording = simulate(
        "drive",
        seed=seed,
        grade=grade,
        imu_rate=100.0,
        start=PULL_AWAY - 8.0,
        stop=PULL_AWAY + AFTER,
        imu_rpy_deg=(0.0, 0.0, yaw),
    )
    parameters: dict[str, Any] = recording.parameters()
    offset = 0.0
    if reverse:
        # base_link the other way round: what drives forward here drives backwards for the filter.
        x, y, z = recording.options.lever_arm
        parameters |= {"gnss.lever_arm": [-x, -y, z], "imu.mount_rpy_deg": [0.0, 0.0, yaw - 180.0]}
        offset = math.pi
    navigator = Navigator(from_mapping(parameters))
    known_after, known_error = math.nan, math.nan
    done = 0
    start = recording.imu_stamp[0]

    def error() -> float:
        row = navigator.odometry[0]
        true = heading_of(recording.truth_attitude_body_to_map[np.searchsorted(recording.truth_stamp, row["stamp"])])
        return math.degrees(math.remainder(heading_of(row["attitude_body_to_map"]) - true - offset, math.tau))

    for epoch, stamp in enumerate(recording.fix_stamp):
        end = int(np.searchsorted(recording.imu_stamp, stamp + 5_000_000, side="right"))
        part = slice(done, end)
        done = end
        place = (recording.fix_latitude_deg, recording.fix_longitude_deg, recording.fix_altitude)
        navigator.push_gnss_position(
            int(stamp), *(float(values[epoch]) for values in place), recording.fix_covariance[epoch], 2, 0
        )
        if velocity:
            navigator.push_gnss_velocity(
                int(stamp), recording.velocity_enu[epoch], recording.velocity_covariance[epoch]
            )
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        if math.isnan(known_after) and navigator.odometry["heading_known"][0]:
            known_after, known_error = (stamp - start) * 1e-9 - 8.0, error()
    sigma = math.degrees(math.sqrt(navigator.odometry["pose_covariance"][0][5, 5]))
    return error(), sigma, known_after, known_error


def main() -> None:
    """Run all cases and print one line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=500)
    runs = parser.parse_args().runs
    print(
        f"{runs} runs each           known   after p50/p95 s   error then p95/max   after 15 s p50/p95/max deg   wrong"
    )
    for name, velocity, reverse, grade in (
        ("with velocity", True, False, "consumer"),
        ("in reverse", True, True, "consumer"),
        ("position only", False, False, "consumer"),
        ("industrial IMU", True, False, "industrial"),
    ):
        found = np.array([run(seed, velocity, reverse, grade) for seed in range(runs)])
        known = ~np.isnan(found[:, 2])
        last = np.abs(found[known, 0])
        wrong = np.count_nonzero((last > 10.0) & (last > 3.0 * found[known, 1]))
        at, then = found[known, 2], np.abs(found[known, 3])
        print(
            f"{name:20} {100.0 * known.mean():6.1f} % {np.median(at):7.1f} {np.percentile(at, 95):6.1f}"
            f" {np.percentile(then, 95):10.2f} {then.max():7.2f}"
            f" {np.median(last):10.2f} {np.percentile(last, 95):6.2f} {last.max():6.2f} {wrong:15d}",
            flush=True,
        )


if __name__ == "__main__":
    main()
