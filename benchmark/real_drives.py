"""Two real drives through `eskf_replay`; writes the figures of docs/results.md and draws docs/real_drives.png.

    python benchmark/real_drives.py [--keep DIR]

Needs gtsam for KITTI, and drive_0708 below $ESKF_DATA or in shared/data beside the checkout (docs/results.md says where
both come from). `--keep` leaves the recordings, parameter files and last results in DIR.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eskf_ros import earth, parameters
from eskf_ros.bags import open_bag
from eskf_ros.simulate.map_frame import MapFrame

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from conftest import find_data_folder  # noqa: E402
from real_recordings import (  # noqa: E402
    FIX,
    OUTAGE_LENGTH,
    OUTAGE_SETS,
    Recording,
    drive_0708_recording,
    kitti_recording,
    replayed,
    results_folder,
)

Array = NDArray[np.float64]

RESULTS = ROOT / "docs" / "results.md"
FIGURE = ROOT / "docs" / "real_drives.png"
MARKERS = ("<!-- figures: written by benchmark/real_drives.py -->\n", "<!-- end of figures -->\n")
ODOMETRY = "nav_msgs/msg/Odometry"
ODOMETRY_TOPIC = "odometry/global"
AXES = ("horizontal", "vertical")


@dataclass(frozen=True)
class Replay:
    """A replay with outages: its summary and, at each truth position, the horizontal error and what was said of it.

    seconds (n,) since the first IMU stamp, error (n, 2) east and north in m, covariance (n, 2, 2) in m2.
    """

    summary: dict[str, Any]
    seconds: Array
    error: Array
    covariance: Array

    def ends_inside(self) -> int:
        """How many outages end with the true position inside the 95 % ellipse of the estimate."""
        ends = [outage["start"] + outage["length"] for outage in self.summary["outages"]]
        last = np.searchsorted(self.seconds, ends, side="right") - 1
        solved = np.linalg.solve(self.covariance[last], self.error[last][:, :, None])[:, :, 0]
        return int((np.einsum("ni,ni->n", self.error[last], solved) <= chi2.ppf(0.95, 2)).sum())


def main() -> int:
    """Convert, replay, write; returns the exit code."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave recordings and results here")
    options = parser.parse_args()
    text = RESULTS.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        try:
            kitti = [kitti_recording(folder, with_velocity) for with_velocity in (False, True)]
            source = find_data_folder("drive_0708")
        except (ModuleNotFoundError, FileNotFoundError) as missing:
            print(f"real_drives: {missing}", file=sys.stderr)
            return 2
        drive = [drive_0708_recording(folder, source, with_velocity) for with_velocity in (False, True)]
        content = figures(kitti, drive)
    print(content)
    RESULTS.write_text(between_markers(text, content), encoding="utf-8")
    return 0


def figures(kitti: Sequence[Recording], drive: Sequence[Recording]) -> str:
    """The tables of docs/results.md; each pair of recordings is without and with velocity. Draws the figure."""
    rows = {"KITTI": [], "drive_0708": []}  # type: dict[str, list[list[str]]]
    outage_rows, drawn = [], []
    for name, pair in (("KITTI", kitti), ("drive_0708", drive)):
        for aids, recording in zip(("position only", "with velocity"), pair, strict=True):
            for noise, config in (("chosen", recording.config), ("default", recording.default_config)):
                label = f"{aids}, {noise} noise"
                rows[name].append(error_row(label, replayed(recording.bag, config)))
                if name == "drive_0708":
                    replays = [replay_with_outages(recording, config, starts) for starts in OUTAGE_SETS]
                    outage_rows.append(outage_row(label, replays))
                    if noise == "chosen":
                        drawn.append((label, replays[0]))
    draw(drawn)
    headings = ["input", "horizontal, m", "vertical, m", "NIS", "NEES", "outside the gate", "restarts"]
    outage_headings = ["input", "outages", "horizontal, m", "vertical, m", "inside the 95 % ellipse", "restarts"]
    return (
        "\n### KITTI: between fixes ten seconds apart\n\n"
        + table(headings, rows["KITTI"])
        + "\n### drive_0708: between fixes one second apart\n\n"
        + table(headings, rows["drive_0708"])
        + f"\n### drive_0708: at the end of outages of {OUTAGE_LENGTH:g} s\n\n"
        + table(outage_headings, outage_rows)
        + "\n"
    )


def error_row(label: str, summary: dict[str, Any]) -> list[str]:
    """Errors against truth and what became of the aids, position before velocity."""
    aids = [aid for aid in summary["aids"].values() if aid["offered"]]
    nees = summary["nees"]["position"]
    return [
        label,
        *(metres(summary["error"][axis][key] for key in ("rms", "p50", "p95", "max")) for axis in AXES),
        "; ".join(f"{aid['nis_mean']:.2f}, {aid['nis_in_95']:.1%}" for aid in aids),
        f"{nees['mean']:.2f}, {nees['in_95']:.1%}",
        "; ".join(
            f"{aid['verdicts'].get('gate', 0) + aid['verdicts'].get('weighed_down', 0)} of {aid['offered']}"
            for aid in aids
        ),
        str(summary["restarts"]),
    ]


def outage_row(label: str, replays: Sequence[Replay]) -> list[str]:
    """Errors at the end of all outages of several replays."""
    outages = [outage for replay in replays for outage in replay.summary["outages"]]
    cells = []
    for axis in AXES:
        errors = [outage[axis] for outage in outages]
        cells.append(metres([np.median(errors), np.percentile(errors, 95), max(errors)]))
    inside = sum(replay.ends_inside() for replay in replays)
    return [label, str(len(outages)), *cells, str(inside), str(sum(replay.summary["restarts"] for replay in replays))]


def metres(values: Iterable[float]) -> str:
    """Lengths in a cell: millimetres below a metre, centimetres above."""
    return " / ".join(f"{value:.3f}" if value < 1.0 else f"{value:.2f}" for value in values)


def table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def between_markers(text: str, content: str, markers: tuple[str, str] = MARKERS) -> str:
    """`text` with `content` between the markers; raises ValueError when they are not there."""
    before, begin, rest = text.partition(markers[0])
    _, end, after = rest.partition(markers[1])
    if not (begin and end):
        raise ValueError(f"{RESULTS}: the lines {markers[0].strip()!r} and {markers[1].strip()!r} are missing")
    return before + begin + content + end + after


def replay_with_outages(recording: Recording, config: Path, starts: Sequence[float]) -> Replay:
    """Replay with outages from `starts` (s) and read back the published odometry."""
    summary = replayed(recording.bag, config, starts)
    estimate = read(results_folder(recording.bag) / "odometry.mcap", ODOMETRY_TOPIC, ODOMETRY)
    truth = read(recording.bag, "/truth", FIX)
    first = int(read(recording.bag, "/imu/data", "sensor_msgs/msg/Imu")["stamp"][0])
    truth = truth[(truth["stamp"] >= estimate["stamp"][0]) & (truth["stamp"] <= estimate["stamp"][-1])]

    lever_arm = parameters.load(config).gnss.lever_arm
    antenna = estimate["position"] + Rotation.from_quat(estimate["orientation"]).apply(lever_arm)
    datum = MapFrame(tuple(summary["datum"]))
    truth_ecef = np.array(
        [
            earth.geodetic_to_ecef(math.radians(latitude), math.radians(longitude), altitude)
            for latitude, longitude, altitude in truth[["latitude", "longitude", "altitude"]].tolist()
        ]
    )
    truth_map = (truth_ecef - datum.origin_ecef) @ datum.rotation_map_to_ecef
    # The covariance changes little between rows 20 ms apart, the position is interpolated.
    at = [np.interp(truth["stamp"], estimate["stamp"], antenna[:, axis]) for axis in range(2)]
    covariance = estimate["pose_covariance"].reshape(-1, 6, 6)[:, :2, :2]
    before = np.searchsorted(estimate["stamp"], truth["stamp"], side="right") - 1
    return Replay(summary, (truth["stamp"] - first) * 1e-9, np.column_stack(at) - truth_map[:, :2], covariance[before])


def read(bag: Path, topic: str, type_name: str) -> NDArray[Any]:
    """All messages of a topic."""
    with open_bag([bag]) as reader:
        return np.concatenate([batch[topic].messages for batch in reader.batches({topic: type_name}) if topic in batch])


def draw(replays: Sequence[tuple[str, Replay]]) -> None:
    """Horizontal error and its standard deviation over time, outages shaded: one panel for each replay."""
    figure, panels = plt.subplots(
        len(replays), 1, figsize=(9, 5), sharex=True, sharey=True, constrained_layout=True, squeeze=False
    )
    for panel, (label, replay) in zip(panels[:, 0], replays, strict=True):
        for outage in replay.summary["outages"]:
            panel.axvspan(outage["start"], outage["start"] + outage["length"], color="0.88")
        sigma = np.sqrt(np.trace(replay.covariance, axis1=1, axis2=2))
        panel.semilogy(replay.seconds, sigma, color="tab:orange", linewidth=1, label="standard deviation published")
        error = np.linalg.norm(replay.error, axis=1)
        panel.semilogy(replay.seconds, error, ".", color="tab:blue", markersize=2, label="error")
        panel.set_ylim(1e-3, 1e3)
        panel.set_ylabel("horizontal, m")
        panel.set_title(f"drive_0708, {label}: outages of {OUTAGE_LENGTH:g} s in grey", fontsize=10)
    panels[0, 0].legend(loc="upper right", ncols=2, fontsize=8)
    panels[-1, 0].set_xlabel("s")
    figure.savefig(FIGURE, dpi=70)


if __name__ == "__main__":
    sys.exit(main())
