"""Is the filter as wrong as it says? Writes the figures of docs/consistency.md and draws docs/consistency.png.

    python benchmark/consistency.py [--runs 100] [--sets 10] [--variant-runs 100]

Simulates `sets` times `runs` drives of each scenario, and `variant-runs` of each variant, runs the estimator over them
and compares its errors with its covariance. About ten minutes on one core. The exit code is 1 if a bar is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from monte_carlo import BLOCKS, Array, Ensemble, ensemble, mean_band, share_in_band

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "consistency.md"
FIGURE = ROOT / "docs" / "consistency.png"
MARKERS = ("<!-- figures: written by benchmark/consistency.py -->\n", "<!-- end of figures -->\n")

SHARE_BAR = (0.90, 0.99)
"""Wanted share of epochs at which the mean NEES of a set of runs lies in its 95 % band, mean of the sets."""

SETTLED = 60.0
"""From here on (s) nothing is left of the start-up."""

SCENARIOS = ("drive", "tunnel_drive")
FIRST_SEED = 10_000
"""Apart from the seeds of the tests and of development."""


@dataclass(frozen=True)
class Variant:
    """Another sensor set on the tunnel drive: options of the simulation, parameters of the estimator."""

    label: str
    options: dict[str, Any]
    changes: dict[str, Any]


VARIANTS = (
    Variant("consumer grade IMU", {"grade": "consumer"}, {}),
    Variant("tactical grade IMU", {"grade": "tactical"}, {}),
    Variant(
        "IMU mounted at (0.9, -0.4, 0.6) m, turned by (10, -20, 120) deg",
        {"imu_position": (0.9, -0.4, 0.6), "imu_rpy_deg": (10.0, -20.0, 120.0)},
        {},
    ),
    Variant("GNSS position only", {}, {"gnss.use_velocity": False}),
)


def progress_of(label: str, count: int) -> Callable[[int], None]:
    """Return what shows on the terminal how many of ``count`` runs are done."""

    def show(done: int) -> None:
        if sys.stderr.isatty() or done == count:
            print(f"\r{label}: {done} of {count} runs", end="\n" if done == count else "", file=sys.stderr, flush=True)

    return show


def degrees_of(block: str) -> int:
    return BLOCKS[block].stop - BLOCKS[block].start


def shares_of_sets(nees: Array, degrees: int, runs: int) -> Array:
    """Return the share of epochs in the band for each disjoint set of ``runs`` runs; ``nees`` (all runs, epochs)."""
    return np.array([share_in_band(nees[i : i + runs], degrees) for i in range(0, len(nees) - runs + 1, runs)])


def nees_table(result: Ensemble, runs: int) -> tuple[list[str], bool]:
    """Return the lines of the table of one scenario and whether all blocks meet the bar."""
    low, high = SHARE_BAR
    lines = [
        "| errors | mean NEES | ideal | epochs in band | of single sets | from 60 s on | bar |",
        "|---|---|---|---|---|---|---|",
    ]
    passed = True
    for block in BLOCKS:
        degrees, nees = degrees_of(block), result.nees[block]
        shares = shares_of_sets(nees, degrees, runs)
        settled = shares_of_sets(nees[:, result.seconds >= SETTLED], degrees, runs).mean()
        good = low <= shares.mean() <= high
        scatter = f"{shares.min():.0%} to {shares.max():.0%}"
        passed &= good
        lines.append(
            f"| {block} | {nees.mean():.2f} | {degrees} | {shares.mean():.1%} | {scatter} "
            f"| {settled:.1%} | {'pass' if good else 'MISSED'} |"
        )
    return lines, passed


def nis_table(result: Ensemble) -> tuple[list[str], bool]:
    """Return the lines of the table of NIS and whether all streams are in their band."""
    lines = ["| measurement | offered | mean NIS | 95 % band | outside the gate | bar |", "|---|---|---|---|---|---|"]
    passed = True
    for stream, nis in result.nis.items():
        low, high = mean_band(3, len(nis))
        good = low <= nis.mean() <= high
        passed &= good
        lines.append(
            f"| {stream} | {len(nis)} | {nis.mean():.4f} | {low:.4f} to {high:.4f} | {result.gated[stream]:.2%} "
            f"| {'pass' if good else 'MISSED'} |"
        )
    return lines, passed


def variant_line(variant: Variant, result: Ensemble) -> str:
    """Return the row of one variant: mean NEES and share in band by block, mean NIS by stream."""
    cells = [
        f"{result.nees[block].mean():.2f} ({share_in_band(result.nees[block], degrees_of(block)):.0%})"
        for block in BLOCKS
    ]
    nis = ", ".join(f"{values.mean():.3f}" for values in result.nis.values())
    return f"| {variant.label} | {' | '.join(cells)} | {nis} |"


def draw(results: dict[str, Ensemble], runs: int) -> None:
    """Draw the mean NEES of the first set over time, with its band."""
    shown = ("position", "velocity", "attitude", "accelerometer bias", "gyro bias", "all 15")
    figure, axes = plt.subplots(len(shown), len(results), figsize=(10, 9), sharex="col", squeeze=False)
    for column, (name, result) in enumerate(results.items()):
        for row, block in enumerate(shown):
            axis = axes[row, column]
            degrees = degrees_of(block)
            low, high = mean_band(degrees, runs)
            axis.axhspan(low, high, color="0.88", label="95 % band")
            axis.axhline(degrees, color="0.6", linewidth=0.8)
            axis.plot(result.seconds, result.nees[block][:runs].mean(axis=0), linewidth=0.9, color="C0")
            axis.set_ylim(degrees - 3.0 * (degrees - low), degrees + 3.0 * (high - degrees))
            if name == "tunnel_drive":
                axis.axvspan(125.0, 170.0, color="C1", alpha=0.15, linewidth=0, label="tunnel")
            if column == 0:
                axis.set_ylabel(block)
        axes[0, column].set_title(f"{name}: mean NEES of {runs} runs", fontsize=10)
        axes[0, column].legend(loc="upper right", fontsize=7, ncols=2)
        axes[-1, column].set_xlabel("seconds")
    figure.tight_layout()
    figure.savefig(FIGURE, dpi=80)


def main() -> int:
    """Simulate, run, write; returns the exit code."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100, help="runs in a set, whose mean NEES is judged per epoch")
    parser.add_argument("--sets", type=int, default=10, help="disjoint sets of seeds")
    parser.add_argument("--variant-runs", type=int, default=100, help="runs of each variant; 0 leaves them out")
    arguments = parser.parse_args()
    begin = time.perf_counter()
    count = arguments.runs * arguments.sets
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    results, lines, passed = {}, [], True
    for name in SCENARIOS:
        result = ensemble(name, seeds, interval=1.0, progress=progress_of(name, count))
        results[name] = result
        lines += [
            "",
            f"### {name}",
            "",
            f"{arguments.sets} sets of {arguments.runs} runs, {result.seconds[0]:.0f} s to",
        ]
        lines[-1] += f" {result.seconds[-1]:.0f} s, one epoch per second."
        for table in (nees_table(result, arguments.runs), nis_table(result)):
            lines += ["", *table[0]]
            passed &= table[1]
    if arguments.variant_runs:
        lines += ["", "### Other sensors, tunnel_drive", ""]
        lines += [
            f"Mean NEES of {arguments.variant_runs} runs and share of epochs in the band; mean NIS by stream.",
            "",
        ]
        lines += [f"| | {' | '.join(BLOCKS)} | NIS |", "|---" * (len(BLOCKS) + 2) + "|"]
        for variant in VARIANTS:
            show = progress_of(variant.label, arguments.variant_runs)
            chosen = range(FIRST_SEED, FIRST_SEED + arguments.variant_runs)
            lines.append(
                variant_line(
                    variant, ensemble("tunnel_drive", chosen, variant.changes, 1.0, progress=show, **variant.options)
                )
            )
    print("\n".join(lines))
    head, _, rest = RESULTS.read_text(encoding="utf-8").partition(MARKERS[0])
    tail = rest.partition(MARKERS[1])[2]
    RESULTS.write_text(f"{head}{MARKERS[0]}" + "\n".join(lines) + f"\n\n{MARKERS[1]}{tail}", encoding="utf-8")
    draw(results, arguments.runs)
    print(
        f"\n{RESULTS} and {FIGURE} written, {time.perf_counter() - begin:.0f} s; {'pass' if passed else 'BAR MISSED'}"
    )
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
