"""Loose and tight coupling side by side while only a few satellites are left; writes docs/results.md and a figure.

    python benchmark/satellites_masked.py [--runs 50]

A simulated car drives with all satellites in view, then for a minute with 8, 6, 4, 3, 2, 1 or none of them, drawn at
random for each run among those above 15 degrees. Loose: fixes of our own point solution of the same satellites, which
needs four. Every run has its own IMU errors, clock, satellites and place on the road; all numbers of satellites of a
run start from the same state.
"""

from __future__ import annotations

import argparse
import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.gnss.ephemeris import EPHEMERIS, Ephemerides
from eskf_ros.gnss.measurements import Masks, measured_epoch
from eskf_ros.gnss.point_solution import SolutionStatus, solve
from eskf_ros.gnss.ranges import locate
from eskf_ros.gnss.signals import Gnss
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.range_receiver import RangeReceiver
from eskf_ros.simulate.scenario import simulate
from monte_carlo import NO_SIDE_SLIP, state_error

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results.md"
FIGURE = ROOT / "docs" / "satellites_masked.png"
MARKERS = (
    "<!-- satellites: written by benchmark/satellites_masked.py -->\n",
    "<!-- end of satellites -->\n",
)

COUNTS = (8, 6, 4, 3, 2, 1, 0)
LENGTHS = (30.0, 60.0)
GRADES = ("consumer", "industrial")
LOWEST = math.radians(15.0)
FEWEST_FOR_A_FIX = 4
SECOND = 1_000_000_000
RESAMPLINGS = 2000


@dataclass(frozen=True)
class Kind:
    """A column of the tables: coupling, and how the drift of the receiver's clock wanders (m/s/sqrt(s))."""

    title: str
    is_tight: bool
    drift_noise: float


KINDS = (
    Kind("loose", False, 0.3),
    Kind("tight", True, 0.3),
    Kind("tight, oven-controlled clock", True, 0.01),
)


class Drive:
    """One run: a recording with ranges, and how a navigator is taken through it."""

    def __init__(self, grade: str, seed: int, drift_noise: float) -> None:
        receiver = RangeReceiver(latency=(0.0, 0.0), clock_drift_noise=drift_noise)
        recording = simulate("drive", seed, grade=grade, imu_rate=100.0, ranges=receiver)
        assert recording.ranges is not None
        self.recording, self.ranges, self.drift_noise = recording, recording.ranges, drift_noise
        records = [broadcast.record() for broadcast in self.ranges.broadcasts]
        self.ephemerides = Ephemerides(np.array(records, EPHEMERIS))
        self.klobuchar = self.ranges.klobuchar[Gnss.GPS]
        start = recording.imu_stamp[0] + round((100.0 + 10.0 * (seed % 10)) * SECOND)
        self.first_epoch = int(np.searchsorted(self.ranges.stamp, start))
        # The truth is at IMU stamps.
        self.start = int(np.searchsorted(recording.imu_stamp, start))
        self.names = self._ranked(np.random.default_rng([seed, 5]))

    def _ranked(self, rng: np.random.Generator) -> list[tuple[int, int]]:
        """Return the satellites in view at the start of the minute in the order in which they are kept."""
        k = self.first_epoch
        place = self.recording.frame.to_ecef(self._truth(self.start)[None, :])[0]
        instant = int(self.ranges.week[k]), float(self.ranges.seconds[k])
        receiver = (float(place[0]), float(place[1]), float(place[2]))
        signals = measured_epoch(self.ranges.epoch(k), *instant, self.ephemerides, receiver)
        high = signals[(signals["status"] == 0) & (signals["elevation"] > LOWEST)]
        names = [(int(row["gnss_id"]), int(row["sv_id"])) for row in high]
        return [names[index] for index in rng.permutation(len(names))]

    def _truth(self, sample: int) -> Array:
        stamp = self.recording.imu_stamp[sample]
        return np.asarray(self.recording.truth_position_map[np.searchsorted(self.recording.truth_stamp, stamp)])

    def navigator(self, kind: Kind) -> Navigator:
        """Return a navigator that knows the sensors."""
        mapping: dict[str, Any] = {**self.recording.parameters(), **NO_SIDE_SLIP}
        mapping["mode"] = "tight" if kind.is_tight else "loose"
        mapping["ranges.clock_drift_noise"] = self.drift_noise
        return Navigator(from_mapping(mapping))

    def signals(self, k: int, kept: int | None) -> NDArray[np.void]:
        """Return the ranges of epoch ``k``, of the first ``kept`` satellites or of all."""
        ranges = self.ranges.epoch(k).copy()
        if kept is None:
            return ranges
        names = set(self.names[:kept])
        return ranges[[(int(row["gnss_id"]), int(row["sv_id"])) in names for row in ranges]]

    def push(self, navigator: Navigator, kind: Kind, k: int, kept: int | None) -> None:
        """Give one epoch to a navigator, as ranges or as the fix that they give."""
        ranges, week, seconds = self.signals(k, kept), int(self.ranges.week[k]), float(self.ranges.seconds[k])
        stamp = int(self.ranges.stamp[k])
        if kind.is_tight:
            signals = measured_epoch(ranges, week, seconds, self.ephemerides, masks=Masks(elevation=-math.pi))
            navigator.push_ranges(stamp, (week, seconds), signals, self.klobuchar)
            return
        if len(ranges) < FEWEST_FOR_A_FIX:
            return
        locate(ranges, week, seconds, self.ephemerides)
        solution = solve(ranges, week, seconds, self.klobuchar)
        if solution.status == SolutionStatus.SOLVED:
            latitude, longitude, altitude = solution.geodetic
            degrees = math.degrees(latitude), math.degrees(longitude)
            navigator.push_gnss_position(stamp, *degrees, altitude, solution.covariance_enu.ravel(), 3, 0)
        if solution.velocity_status == SolutionStatus.SOLVED:
            navigator.push_gnss_velocity(
                stamp, solution.velocity_enu.tolist(), solution.velocity_covariance_enu.ravel()
            )

    def advance(self, navigator: Navigator, kind: Kind, samples: tuple[int, int], kept: int | None) -> None:
        """Feed IMU samples from ``samples[0]`` up to, without, ``samples[1]``, and the epochs among them."""
        recording, first = self.recording, samples[0]
        stamps = recording.imu_stamp
        bounds = stamps[samples[0] - 1] if samples[0] else 0, stamps[samples[1] - 1]
        for k in range(*np.searchsorted(self.ranges.stamp, bounds, side="right").tolist()):
            last = int(np.searchsorted(stamps, self.ranges.stamp[k], side="right"))
            part = slice(first, last)
            navigator.push_imu(stamps[part], recording.specific_force[part], recording.angular_rate[part])
            first = last
            self.push(navigator, kind, k, kept)
        part = slice(first, samples[1])
        navigator.push_imu(stamps[part], recording.specific_force[part], recording.angular_rate[part])
        navigator.take_records()

    def error(self, navigator: Navigator, sample: int) -> tuple[float, float]:
        """Return the horizontal error (m) right after IMU sample ``sample``, and its standard deviation by itself."""
        truth = int(np.searchsorted(self.recording.truth_stamp, self.recording.imu_stamp[sample]))
        state = navigator.state[0]
        error = state_error(self.recording, sample, truth, state)
        covariance = state["covariance"]
        return float(np.hypot(error[0], error[1])), math.sqrt(covariance[0, 0] + covariance[1, 1])


def run(grade: str, seed: int, kind: Kind) -> Array:
    """Return horizontal errors (m) and their claimed standard deviations, (counts, lengths, 2), of one run."""
    drive = Drive(grade, seed, kind.drift_noise)
    prepared = drive.navigator(kind)
    drive.advance(prepared, kind, (0, drive.start), None)
    result = np.empty((len(COUNTS), len(LENGTHS), 2))
    for row, count in enumerate(COUNTS):
        if not kind.is_tight and count < FEWEST_FOR_A_FIX and count != COUNTS[-1]:
            continue
        navigator, sample = copy.deepcopy(prepared), drive.start
        for column, length in enumerate(LENGTHS):
            # 100 Hz.
            end = drive.start + round(100.0 * length)
            drive.advance(navigator, kind, (sample, end), count)
            result[row, column] = drive.error(navigator, end - 1)
            sample = end
    if not kind.is_tight:
        few = [row for row, count in enumerate(COUNTS) if count < FEWEST_FOR_A_FIX]
        result[few] = result[-1]
    return result


def resampled(errors: Array, percentile: float, rng: np.random.Generator) -> Array:
    """Return the percentile of resampled runs (last axis first); the same resampling for equal generators."""
    chosen = rng.integers(0, len(errors), (RESAMPLINGS, len(errors)))
    return np.asarray(np.percentile(errors[chosen], percentile, axis=1))


def cell(errors: Array) -> str:
    """Return p50 and p95 with their 95 % bootstrap intervals."""
    texts = []
    for percentile in (50.0, 95.0):
        low, high = np.percentile(resampled(errors, percentile, np.random.default_rng(1)), [2.5, 97.5])
        texts.append(f"{number(np.percentile(errors, percentile))} [{number(low)}, {number(high)}]")
    return " / ".join(texts)


def difference(errors: Array, others: Array) -> str:
    """Return by how much p50 and p95 are larger than those of ``others`` of the same runs, with 95 % intervals."""
    texts = []
    for percentile in (50.0, 95.0):
        change = np.percentile(errors, percentile) - np.percentile(others, percentile)
        draws = [resampled(values, percentile, np.random.default_rng(1)) for values in (errors, others)]
        low, high = np.percentile(draws[0] - draws[1], [2.5, 97.5])
        texts.append(f"{change:+.1f} [{low:+.1f}, {high:+.1f}]")
    return " / ".join(texts)


def number(value: float) -> str:
    return f"{value:.2f}" if value < 9.995 else f"{value:.1f}"


def table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |\n"
    yield f"|{' --- |' * len(head)}\n"
    for row in rows:
        yield f"| {' | '.join(row)} |\n"


def report(results: dict[str, dict[str, Array]], runs: int) -> str:
    """Return the text between the markers."""
    lines = [
        "\n",
        f"Horizontal error in m at the end, {runs} runs: p50 / p95, each with its 95 % bootstrap interval.\n",
    ]
    titles = [kind.title for kind in KINDS]
    for grade, of_kind in results.items():
        for column, length in enumerate(LENGTHS):
            lines += ["\n", f"### {grade} IMU, {length:g} s\n", "\n"]
            rows = [
                [str(count), *(cell(of_kind[title][:, row, column, 0]) for title in titles)]
                for row, count in enumerate(COUNTS)
            ]
            lines += table(["satellites", *titles], rows)
    lines += [
        "\n",
        "Few satellites against none, tight: change of p50 / p95 in m (95 % interval by resampling the same runs).\n",
        "\n",
    ]
    rows = []
    for grade, of_kind in results.items():
        for column, length in enumerate(LENGTHS):
            for count in (3, 2, 1):
                row = COUNTS.index(count)
                changes = [
                    difference(of_kind[title][:, row, column, 0], of_kind[title][:, -1, column, 0])
                    for title in titles[1:]
                ]
                rows.append([f"{grade}, {length:g} s", str(count), *changes])
    lines += table(["IMU, length", "satellites", *titles[1:]], rows)
    lines += ["\n", "Error in units of its own standard deviation, rms (ideal 1):\n", "\n"]
    rows = []
    for grade, of_kind in results.items():
        for column, length in enumerate(LENGTHS):
            ratios = [
                np.sqrt(np.mean((errors := of_kind[title][:, :, column])[..., 0] ** 2 / errors[..., 1] ** 2, axis=0))
                for title in titles[1:]
            ]
            for title, ratio in zip(titles[1:], ratios):
                rows.append([f"{grade}, {length:g} s", title, *(f"{value:.2f}" for value in ratio)])
    lines += table(["IMU, length", "", *(str(count) for count in COUNTS)], rows)
    return "".join([*lines, "\n", "![Horizontal error by the number of satellites](satellites_masked.png)\n", "\n"])


def draw(results: dict[str, dict[str, Array]]) -> None:
    """Draw p50 and p95 by the number of satellites."""
    figure, panels = plt.subplots(
        len(results),
        len(LENGTHS),
        figsize=(9.0, 3.2 * len(results)),
        sharex=True,
        squeeze=False,
        constrained_layout=True,
    )
    colours = dict(zip((kind.title for kind in KINDS), ("0.45", "tab:blue", "tab:green")))
    places = np.arange(len(COUNTS))
    for row, (grade, of_kind) in enumerate(results.items()):
        for column, length in enumerate(LENGTHS):
            panel = panels[row, column]
            for title, errors in of_kind.items():
                for percentile, style in ((50.0, "-"), (95.0, ":")):
                    values = np.percentile(errors[:, :, column, 0], percentile, axis=0)
                    label = title if percentile == 50.0 else None
                    panel.plot(places, values, style, marker="o", markersize=3, color=colours[title], label=label)
            panel.set(title=f"{grade} IMU, {length:g} s", yscale="log", xticks=places)
            panel.set_xticklabels([str(count) for count in COUNTS])
            panel.grid(True, which="both", alpha=0.3)
    panels[0, 0].legend(fontsize=8, title="p50 solid, p95 dotted", title_fontsize=8)
    for panel in panels[-1]:
        panel.set_xlabel("satellites")
    for panel in panels[:, 0]:
        panel.set_ylabel("horizontal error, m")
    figure.savefig(FIGURE, dpi=80)


def between_markers(text: str, content: str) -> str:
    """`text` with `content` between the markers; raises ValueError when they are not there."""
    before, begin, rest = text.partition(MARKERS[0])
    _, end, after = rest.partition(MARKERS[1])
    if not (begin and end):
        raise ValueError(f"{RESULTS}: the lines {MARKERS[0].strip()!r} and {MARKERS[1].strip()!r} are missing")
    return before + begin + content + end + after


def main() -> None:
    """Run, write, draw."""
    parser = argparse.ArgumentParser(description="Loose and tight coupling with few satellites")
    parser.add_argument("--runs", type=int, default=50)
    runs = parser.parse_args().runs
    results: dict[str, dict[str, Array]] = {}
    for grade in GRADES:
        results[grade] = {}
        for kind in KINDS:
            results[grade][kind.title] = np.array([run(grade, seed, kind) for seed in range(runs)])
            median = np.median(results[grade][kind.title][..., 0], axis=0)
            print(grade, kind.title, np.round(median, 2).T.tolist(), flush=True)
    RESULTS.write_text(between_markers(RESULTS.read_text(encoding="utf-8"), report(results, runs)), encoding="utf-8")
    draw(results)


if __name__ == "__main__":
    main()
