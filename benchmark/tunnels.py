"""Tunnels of half a minute to five: how far off the estimate is at their end, for each IMU and each aid.

    python benchmark/tunnels.py [--runs 50]

Writes its tables to docs/results.md. A car drives a lap with GNSS, then through a tunnel with bends, slow traffic and
stops, on tyres that slip sideways, with wheels of a size known to two per cent. Needs nothing but the simulator.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import simulate
from eskf_ros.simulate.scenarios import TUNNEL_START
from eskf_ros.simulate.wheel import WheelOdometer
from monte_carlo import run

Array = NDArray[np.float64]

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results.md"
MARKERS = ("<!-- tunnels: written by benchmark/tunnels.py -->\n", "<!-- end of tunnels -->\n")

FIRST_SEED = 40_000
"""Apart from the seeds of the tests and of development."""

GRADES = ("consumer", "industrial", "tactical")
LENGTHS = (30.0, 60.0, 120.0, 300.0)
SENSOR = WheelOdometer(position=(0.0, 0.6, 0.0), scale_std=0.02, rate=10.0)

VIBRATION = (0.3, 0.01)
"""A road shakes the car (m/s2, rad/s at 10 m/s): that it stands shows in how quiet it is."""

WHEEL = {"wheel.position": [0.0, 0.6, 0.0], "zupt.enabled": False}
NO_WHEEL = {"wheel.use": False, "zupt.enabled": False}
ZUPT, NHC = {"zupt.enabled": True}, {"nhc.enabled": True}
VARIANTS: dict[str, dict[str, Any]] = {
    "IMU alone": NO_WHEEL,
    "ZUPT": {**NO_WHEEL, **ZUPT},
    "NHC": {**NO_WHEEL, **NHC},
    "ZUPT + NHC": {**NO_WHEEL, **ZUPT, **NHC},
    "wheel": WHEEL,
    "wheel + ZUPT + NHC": {**WHEEL, **ZUPT, **NHC},
}


def errors_of(recording: Recording, changes: dict[str, Any]) -> Array:
    """Return the horizontal error (m) at the end of tunnels of the `LENGTHS`."""
    result = run(recording, Navigator(from_mapping({**recording.parameters(), **changes})), 1.0)
    ends = np.minimum(np.searchsorted(result.seconds, TUNNEL_START + np.array(LENGTHS)), len(result.seconds) - 1)
    return np.asarray(np.hypot(result.error[ends, 0], result.error[ends, 1]))


def distances_of(recording: Recording) -> Array:
    """Return the way (m) driven in tunnels of the `LENGTHS`."""
    seconds = (recording.truth_stamp - recording.truth_stamp[0]) * 1e-9
    steps = np.linalg.norm(np.diff(recording.truth_position_map, axis=0), axis=1)
    inside = [(seconds[1:] > TUNNEL_START) & (seconds[1:] <= TUNNEL_START + length) for length in LENGTHS]
    return np.array([steps[chosen].sum() for chosen in inside])


def short(value: float) -> str:
    """Return a number with two or three digits."""
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"


def table(grade: str, runs: int) -> str:
    """Simulate `runs` drives with one IMU; return the table of it in Markdown."""
    errors: dict[str, list[Array]] = {name: [] for name in VARIANTS}
    for seed in range(FIRST_SEED, FIRST_SEED + runs):
        options = {"imu_rate": 100.0, "stop": TUNNEL_START + LENGTHS[-1], "wheel": SENSOR, "vibration": VIBRATION}
        recording = simulate("long_tunnel", seed, grade=grade, **options)
        for name, changes in VARIANTS.items():
            errors[name].append(errors_of(recording, changes))
        print(f"{grade}: {seed - FIRST_SEED + 1} of {runs}", end="\r", flush=True)
    print()
    way = distances_of(recording)
    heads = [f"{length:.0f} s, {metres:.0f} m" for length, metres in zip(LENGTHS, way)]
    lines = [f"### {grade} IMU", "", f"| aids | {' | '.join(heads)} |", "| --- |" + " --- |" * len(LENGTHS)]
    for name, values in errors.items():
        half, most = np.percentile(values, [50.0, 95.0], axis=0)
        cells = [f"{short(a)} / {short(b)}, {short(100.0 * a / d)} %" for a, b, d in zip(half, most, way)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run everything and write the tables between the markers."""
    parser = argparse.ArgumentParser(description="horizontal errors at the end of tunnels")
    parser.add_argument("--runs", type=int, default=50, help="drives with each IMU (default 50)")
    runs = parser.parse_args().runs
    head = f"Horizontal error in m at the end, {runs} runs: p50 / p95, and p50 as a share of the way.\n"
    content = "\n".join(["", head, *(table(grade, runs) for grade in GRADES), ""])
    text = RESULTS.read_text(encoding="utf-8")
    before, begin, rest = text.partition(MARKERS[0])
    _, end, after = rest.partition(MARKERS[1])
    if not end:
        raise ValueError(f"{RESULTS}: the lines {MARKERS[0].strip()!r} and {MARKERS[1].strip()!r} are missing")
    RESULTS.write_text(before + begin + content + end + after, encoding="utf-8")
    print(content)


if __name__ == "__main__":
    main()
