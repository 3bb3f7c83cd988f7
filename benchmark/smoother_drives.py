"""How well does the smoother bridge outages of GNSS on real drives? Writes the first table of docs/smoother.md.

    python benchmark/smoother_drives.py

Needs the recordings (see `test/support/data.py`) and, for KITTI, the package gtsam. The exit code is 1 if a bar is
missed.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from eskf_ros.replay.main import main as replay  # noqa: E402
from support.data import find_data_folder  # noqa: E402
from support.recordings.car_ontario import DRIVES, car_ontario_recording  # noqa: E402
from support.recordings.car_ontario import OUTAGE_SETS as ONTARIO_OUTAGES  # noqa: E402
from support.recordings.common import Outages, Recording, results_folder  # noqa: E402
from support.recordings.drive_0708 import OUTAGE_SETS as RURAL_OUTAGES  # noqa: E402
from support.recordings.drive_0708 import drive_0708_recording  # noqa: E402
from support.recordings.kitti import kitti_recording  # noqa: E402
from support.recordings.tsukishima import OUTAGE_SETS as TOKYO_OUTAGES  # noqa: E402
from support.recordings.tsukishima import REAR_AXLE, tsukishima_recording  # noqa: E402

RESULTS = ROOT / "docs" / "smoother.md"
MARKERS = ("<!-- drives: written by benchmark/smoother_drives.py -->\n", "<!-- end of drives -->\n")
NHC = "nhc.enabled: true"
WITHOUT_WHEELS = "wheel.use: false"
WITHOUT_VELOCITY = "gnss.use_velocity: false"


class Row(NamedTuple):
    """Largest errors (m) inside outages by filter and smoother, 50 % and 95 %; their number, breaks of the smoother."""

    filter: tuple[float, float]
    smoother: tuple[float, float]
    count: int
    breaks: int


def smoothed_summary(recording: Recording, *lines: str, outages: Outages = ()) -> dict[str, Any]:
    """summary.json of `eskf_replay --smooth` with the parameters of the recording and `lines`."""
    options = [f"--outage={start:g}:{length:g}" for start, length in outages]
    config = f"--config={recording.config(lines, True)}"
    if replay([str(recording.bag), config, "--quiet", "--smooth", "--truth=truth", *options]) != 0:
        raise RuntimeError(f"eskf_replay {recording.bag} failed")
    return json.loads((results_folder(recording.bag) / "summary.json").read_text())  # type: ignore[no-any-return]


def inside_outages(recording: Recording, sets: tuple[Outages, ...], *lines: str) -> Row:
    """Replay with each set of outages; largest horizontal errors inside them."""
    return inside_outages_of([(recording, sets)], *lines)


def inside_outages_of(recordings: list[tuple[Recording, tuple[Outages, ...]]], *lines: str) -> Row:
    """Replay each recording with each of its sets of outages; largest horizontal errors inside all of them."""
    errors: dict[str, list[float]] = {"filter": [], "smoother": []}
    breaks = 0
    for recording, outages in [(recording, outages) for recording, sets in recordings for outages in sets]:
        summary = smoothed_summary(recording, *lines, outages=outages)
        breaks += summary["smoothed"]["breaks"]
        for name, found in (("filter", summary), ("smoother", summary["smoothed"])):
            errors[name] += [o["horizontal_max"] for o in found["outages"] if o["horizontal_max"] is not None]
    half_and_most = [tuple(np.percentile(errors[name], [50.0, 95.0]).tolist()) for name in ("filter", "smoother")]
    return Row(*half_and_most, len(errors["smoother"]), breaks)


def main() -> int:
    """Replay all drives and write the table."""
    lines = ["| drive | outages | filter | smoother | breaks | bar |", "|---|---|---|---|---|---|"]
    passed = True
    with tempfile.TemporaryDirectory() as folder:
        rural = drive_0708_recording(Path(folder), find_data_folder("drive_0708"), False)
        tokyo = tsukishima_recording(Path(folder), find_data_folder("tsukishima_20201105"))
        cases = (
            ("drive_0708, positions", rural, RURAL_OUTAGES, (), (0.28, 0.62)),
            ("drive_0708, positions and NHC", rural, RURAL_OUTAGES, (NHC,), (0.23, 0.48)),
            ("tsukishima, positions", tokyo, TOKYO_OUTAGES, (WITHOUT_WHEELS, WITHOUT_VELOCITY), (0.34, 2.6)),
            (
                "tsukishima, positions and NHC",
                tokyo,
                TOKYO_OUTAGES,
                (WITHOUT_WHEELS, WITHOUT_VELOCITY, NHC, *REAR_AXLE),
                (0.25, 0.78),
            ),
            ("tsukishima, with Doppler velocity", tokyo, TOKYO_OUTAGES, (WITHOUT_WHEELS,), (0.34, 2.6)),
            (
                "tsukishima, with Doppler velocity and NHC",
                tokyo,
                TOKYO_OUTAGES,
                (WITHOUT_WHEELS, NHC, *REAR_AXLE),
                (0.25, 0.78),
            ),
        )
        for label, recording, sets, changes, bar in cases:
            row = inside_outages(recording, sets, *changes)
            good = row.smoother[0] <= bar[0] and row.smoother[1] <= bar[1]
            passed &= good
            lines.append(
                f"| {label} | {row.count} of {sets[0][0][1]:g} s | {row.filter[0]:.2f}, {row.filter[1]:.2f} m "
                f"| {row.smoother[0]:.2f}, {row.smoother[1]:.2f} m | {row.breaks} "
                f"| {bar[0]}, {bar[1]}: {'pass' if good else 'MISSED'} |"
            )
            print(lines[-1], flush=True)
        ontario = [
            (car_ontario_recording(Path(folder), find_data_folder("car_ontario"), name), ONTARIO_OUTAGES[name])
            for name in DRIVES
        ]
        for label, changes in (("car_ontario, seven drives", ()), ("car_ontario, seven drives, with NHC", (NHC,))):
            row = inside_outages_of(ontario, *changes)
            lines.append(
                f"| {label} | {row.count} of 30 s | {row.filter[0]:.2f}, {row.filter[1]:.2f} m "
                f"| {row.smoother[0]:.2f}, {row.smoother[1]:.2f} m | {row.breaks} | none |"
            )
            print(lines[-1], flush=True)
        for with_velocity in (False, True):
            summary = smoothed_summary(kitti_recording(Path(folder), with_velocity))
            fixes = "a fix and a velocity" if with_velocity else "a fix"
            by_filter, smoothed = (found["error"]["horizontal"]["rms"] for found in (summary, summary["smoothed"]))
            passed &= smoothed <= 0.5 * by_filter
            lines.append(
                f"| KITTI, {fixes} every 10 s, rms of all | | {by_filter:.2f} m "
                f"| {smoothed:.2f} m | {summary['smoothed']['breaks']} "
                f"| half: {'pass' if smoothed <= 0.5 * by_filter else 'MISSED'} |"
            )
            print(lines[-1], flush=True)
    before, _, rest = RESULTS.read_text(encoding="utf-8").partition(MARKERS[0])
    _, _, after = rest.partition(MARKERS[1])
    RESULTS.write_text(before + MARKERS[0] + "\n" + "\n".join(lines) + "\n\n" + MARKERS[1] + after, encoding="utf-8")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
