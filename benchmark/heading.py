"""How soon and how well an unknown heading is found: `python benchmark/heading.py [--runs 500] [--case NAME ...]`.

An IMU stands still for eight seconds in any direction on a robot, which then pulls away (boat and walker are never
still, and what is switched on at speed has driven for eight seconds). Known: in how many runs the heading was found at
all until the end; when, after the pull-away; how wrong it was then and at the end; how often it was wrong at the end by
more than three sigma and ten degrees.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import simulate


@dataclass(frozen=True)
class Case:
    """What moves: scenario, when it pulls away, how long after that the run ends (s)."""

    scenario: str = "drive"
    pull_away: float = 20.0
    after: float = 15.0
    velocity: bool = True
    reverse: bool = False
    use_course: bool = True
    grade: str = "consumer"


CASES = {
    "with velocity": Case(),
    "in reverse": Case(reverse=True),
    "position only": Case(velocity=False),
    "industrial IMU": Case(grade="industrial"),
    "without the course": Case(use_course=False),
    "switched on at speed": Case("drive", 68.0, 30.0),
    "at speed, no velocity": Case("drive", 68.0, 30.0, velocity=False),
    "field robot, 0.4 m/s2": Case("field_robot", 15.0, 60.0),
    "field robot, no velocity": Case("field_robot", 15.0, 150.0, velocity=False),
    "multirotor": Case("multirotor", 20.0, 40.0, use_course=False),
    "walker": Case("walk", 15.0, 40.0, use_course=False),
    "boat, consumer IMU": Case("boat", 40.0, 60.0, use_course=False),
    "boat, industrial IMU": Case("boat", 40.0, 60.0, use_course=False, grade="industrial"),
    "motorway": Case("motorway", 8.0, 60.0),
}


def heading_of(quaternion: np.ndarray) -> float:
    """Heading (rad) of a quaternion w x y z."""
    w, x, y, z = quaternion
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def run(seed: int, case: Case) -> tuple[float, float, float, float]:
    """Return error and sigma at the end, and time since the pull-away and error when known (deg, s; NaN: never)."""
    yaw = float(np.random.default_rng(seed).uniform(-180.0, 180.0))
    recording = simulate(
        case.scenario,
        seed=seed,
        grade=case.grade,
        imu_rate=100.0,
        start=case.pull_away - 8.0,
        stop=case.pull_away + case.after,
        imu_rpy_deg=(0.0, 0.0, yaw),
    )
    parameters: dict[str, Any] = {**recording.parameters(), "alignment.use_course": case.use_course}
    offset = 0.0
    if case.reverse:
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
        if case.velocity:
            navigator.push_gnss_velocity(
                int(stamp), recording.velocity_enu[epoch], recording.velocity_covariance[epoch]
            )
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        if math.isnan(known_after) and navigator.odometry["heading_known"][0]:
            known_after, known_error = (stamp - start) * 1e-9 - 8.0, error()
    sigma = math.degrees(math.sqrt(navigator.odometry["pose_covariance"][0][5, 5]))
    return error(), sigma, known_after, known_error


def main() -> None:
    """Run the cases and print one line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES), metavar="NAME")
    options = parser.parse_args()
    print(f"{options.runs} runs each")
    print(
        f"{'':25} {'known':>8}  {'after p50/p95 s':>16}  {'error then p95/max':>19}  "
        f"{'at the end p50/p95/max deg':>27}  {'(error/sigma)2':>14}  wrong"
    )
    for name in options.case:
        found = np.array([run(seed, CASES[name]) for seed in range(options.runs)])
        known = ~np.isnan(found[:, 2])
        if not known.any():
            print(f"{name:25} {0.0:6.1f} %", flush=True)
            continue
        last, sigma = np.abs(found[known, 0]), found[known, 1]
        wrong = np.count_nonzero((last > 10.0) & (last > 3.0 * sigma))
        at, then = found[known, 2], np.abs(found[known, 3])
        print(
            f"{name:25} {100.0 * known.mean():6.1f} %  {np.median(at):8.1f} {np.percentile(at, 95):7.1f}"
            f"  {np.percentile(then, 95):11.2f} {then.max():7.2f}"
            f"  {np.median(last):13.2f} {np.percentile(last, 95):6.2f} {last.max():6.2f}"
            f"  {np.mean((last / sigma) ** 2):14.2f}  {wrong:5d}",
            flush=True,
        )


if __name__ == "__main__":
    main()
