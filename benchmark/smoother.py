"""Is the smoother as wrong as it says, and what does it cost? Writes the figures of docs/smoother.md.

    python benchmark/smoother.py [--runs 100] [--sets 3]

Simulates `sets` times `runs` drives with and without tunnels, runs filter and smoother over them, and compares errors
with covariances. The exit code is 1 if a bar is missed. The figures of real drives come from
`benchmark/smoother_drives.py`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate
from eskf_ros.simulate.scenarios import scenario
from eskf_ros.smooth.smoother import Smoother
from monte_carlo import NO_REST, NO_SIDE_SLIP, Array, feed, nees, share_in_band

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "smoother.md"
MARKERS = ("<!-- figures: written by benchmark/smoother.py -->\n", "<!-- end of figures -->\n")

BLOCKS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9)}
RATE = 10.0
"""Hz of the rows."""
INTERVAL = 500_000_000
"""ns; time between two epochs that are compared: a multiple of that of the rows."""
SETTLED = 60.0
FIRST_SEED = 20_000
"""Apart from the seeds of the tests and of development."""
SHARE_BAR = (0.90, 0.99)
TUNNEL_BAR = 0.15
"""Largest share by which the error in a tunnel may differ from what the covariance predicts."""
COST_BAR = 2.5
"""Time of filter and smoother together, of that of the filter."""


@dataclass(frozen=True)
class Errors:
    """Position (map), velocity (base_link axes) and attitude (map) of runs: error (runs, n, 9), covariance of each.

    ``seconds`` (n,) from the start; ``covariance`` (runs, n, 9, 9) has no entries between the blocks.
    """

    seconds: Array
    error: Array
    covariance: Array

    def nees(self, block: str, since: float = SETTLED) -> Array:
        """NEES of a block (runs, epochs), from ``since`` (s) on."""
        chosen = self.seconds >= since
        return nees(self.error[:, chosen], self.covariance[:, chosen], BLOCKS[block])

    def inside(self, first: float, last: float) -> tuple[float, float]:
        """Horizontal position error (m) from ``first`` to ``last`` (s): root mean square, and what is predicted."""
        chosen = (self.seconds >= first) & (self.seconds <= last)
        square = (self.error[:, chosen, :2] ** 2).sum(axis=-1).mean()
        predicted = np.trace(self.covariance[:, chosen, :2, :2], axis1=-2, axis2=-1).mean()
        return float(np.sqrt(square)), float(np.sqrt(predicted))


@dataclass(frozen=True)
class Ensemble:
    """Runs that differ in the seed only: errors of filter and smoother, processor times (s) of both."""

    filter: Errors
    smoother: Errors
    filter_time: float
    smoother_time: float


def errors_of(recording: Recording, rows: NDArray[Any], stamps: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return error (n, 9) and covariance (n, 9, 9) of ODOMETRY rows at ``stamps`` (n,), which are those of truths."""
    rows = rows[np.searchsorted(rows["stamp"], stamps)]
    truth = np.searchsorted(recording.truth_stamp, stamps)
    true_attitude = Rotation.from_quat(recording.truth_attitude_body_to_map[truth][:, [1, 2, 3, 0]])
    attitude = Rotation.from_quat(rows["attitude_body_to_map"][:, [1, 2, 3, 0]])
    velocity_body = true_attitude.inv().apply(recording.truth_velocity_map[truth])
    error = np.concatenate(
        [
            recording.truth_position_map[truth] - rows["position_map"],
            velocity_body - rows["velocity_body"],
            (true_attitude * attitude.inv()).as_rotvec(),
        ],
        axis=1,
    )
    covariance = np.zeros((len(stamps), 9, 9))
    covariance[:, :3, :3] = rows["pose_covariance"][:, :3, :3]
    covariance[:, 3:6, 3:6] = rows["twist_covariance"][:, :3, :3]
    covariance[:, 6:, 6:] = rows["pose_covariance"][:, 3:, 3:]
    return error, covariance


def run(recording: Recording, changes: dict[str, Any]) -> tuple[NDArray[Any], NDArray[Any], float, float]:
    """Return the ODOMETRY rows of filter and smoother, and the processor times (s) of both."""
    parameters = from_mapping({**recording.parameters(), **NO_SIDE_SLIP, **NO_REST, **changes})
    times = []
    for keeps_log in (False, True):
        navigator = Navigator(parameters, output_rate=RATE, keeps_log=keeps_log)
        smoother = Smoother(navigator)
        # A second at once, as a replay has it: the rows are those of the final state within it.
        stops = np.arange(round(recording.options.imu_rate) - 1, len(recording.imu_stamp), 200)
        began = time.process_time()
        collected = []
        push = navigator.push_imu

        def keep(*samples: Any, arrivals: Any, push: Any = push, collected: list[Any] = collected) -> Any:
            collected.append(push(*samples, arrivals=arrivals))
            return collected[-1]

        navigator.push_imu = keep  # type: ignore[method-assign]
        for _ in feed(recording, navigator, stops):
            navigator.take_records()
            if keeps_log:
                smoother.collect()
        navigator.finish()
        smoothed: list[NDArray[Any]] = []
        if keeps_log:
            smoother.smooth()
            smoothed = list(smoother.rows())
        times.append(time.process_time() - began)
    rows = np.concatenate([np.zeros(0, ODOMETRY), *collected])
    return rows, np.concatenate([np.zeros(0, ODOMETRY), *smoothed]), times[0], times[1]


def ensemble(name: str, seeds: Iterable[int], changes: dict[str, Any] | None = None, **options: Any) -> Ensemble:
    """Simulate scenario ``name`` for all ``seeds``; ``options``, ``changes`` as in `monte_carlo.ensemble`."""
    found: list[Any] = []
    for seed in seeds:
        recording = simulate(name, seed, **options)
        rows, smoothed, filter_time, smoother_time = run(recording, changes or {})
        known = rows["stamp"][rows["heading_known"] == 1]
        both = np.intersect1d(known, smoothed["stamp"][smoothed["heading_known"] == 1])
        stamps = np.intersect1d(both, recording.truth_stamp)
        stamps = stamps[stamps % INTERVAL == 0]
        found.append((recording, rows, smoothed, stamps, filter_time, smoother_time))
    common = found[0][3]
    for item in found[1:]:
        common = np.intersect1d(common, item[3])
    start = found[0][0].imu_stamp[0]
    seconds = (common - start) * 1e-9
    parts = []
    for which in (1, 2):
        errors = [errors_of(item[0], item[which], common) for item in found]
        parts.append(Errors(seconds, np.array([e for e, _ in errors]), np.array([c for _, c in errors])))
    return Ensemble(parts[0], parts[1], sum(i[4] for i in found[1:]), sum(i[5] for i in found[1:]))


def report(name: str, runs: Ensemble, count: int, tunnels: list[tuple[float, float]]) -> tuple[list[str], bool]:
    """Return the lines of one scenario and whether its bars are met; ``count`` runs are a set."""
    total = len(runs.smoother.error)
    lines = [
        f"**{name}**, {total // count} sets of {count} runs",
        "",
        "| errors | filter, rms | smoother, rms | mean NEES | ideal | epochs in band | of single sets | bar |",
        "|---|---|---|---|---|---|---|---|",
    ]
    passed = True
    for block, part in BLOCKS.items():
        values = runs.smoother.nees(block)
        shares = [share_in_band(values[i : i + count], 3) for i in range(0, total, count)]
        share = float(np.mean(shares))
        good = SHARE_BAR[0] <= share <= SHARE_BAR[1]
        passed &= good
        rms = [
            float(np.sqrt((e.error[:, e.seconds >= SETTLED, part] ** 2).sum(-1).mean()))
            for e in (runs.filter, runs.smoother)
        ]
        lines.append(
            f"| {block} | {rms[0]:.4f} | {rms[1]:.4f} | {values.mean():.2f} | 3 | {share:.1%} "
            f"| {min(shares):.0%} to {max(shares):.0%} | {'pass' if good else 'MISSED'} |"
        )
    if tunnels:
        heading = "| tunnel, s | filter, rms m | smoother, rms m | predicted by its covariance, m | ratio |"
        lines += ["", heading, "|---|---|---|---|---|"]
    for first, last in tunnels:
        by_filter, _ = runs.filter.inside(first, last)
        achieved, predicted = runs.smoother.inside(first, last)
        passed &= abs(achieved / predicted - 1.0) <= TUNNEL_BAR
        lines.append(
            f"| {first:g} to {last:g} | {by_filter:.2f} | {achieved:.3f} | {predicted:.3f} "
            f"| {achieved / predicted:.3f} |"
        )
    cost = runs.smoother_time / runs.filter_time
    passed &= cost <= COST_BAR
    lines += ["", f"Filter and smoother together take {cost:.2f} times as long as the filter alone.", ""]
    return lines, passed


def main() -> int:
    """Run the campaign and write the document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--sets", type=int, default=3)
    options = parser.parse_args()
    lines: list[str] = []
    passed = True
    for name in ("tunnel_drive", "drive"):
        tunnels = [(float(first), float(last)) for first, last in scenario(name).outages]
        runs = ensemble(name, range(FIRST_SEED, FIRST_SEED + options.sets * options.runs))
        part, good = report(name, runs, options.runs, tunnels)
        lines += part
        passed &= good
        print("\n".join(part), flush=True)
    before, _, rest = RESULTS.read_text(encoding="utf-8").partition(MARKERS[0])
    _, _, after = rest.partition(MARKERS[1])
    text = before + MARKERS[0] + "\n" + "\n".join(lines) + "\n" + MARKERS[1] + after
    RESULTS.write_text(text, encoding="utf-8")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
