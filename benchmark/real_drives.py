"""Real drives through `eskf_replay`; writes the figures of docs/results.md and draws docs/real_drives.png.

    python benchmark/real_drives.py [--keep DIR] [DRIVE ...]

Needs gtsam for KITTI, and the other drives below $ESKF_DATA or in shared/data beside the checkout (docs/results.md says
where they come from). `--keep` leaves the recordings, parameter files and last results in DIR.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

from eskf_ros.parameters.ros_yaml import load

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eskf_ros.bags import open_bag
from eskf_ros.geodesy import earth
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.gnss.ranges import ionosphere_free, one_per_satellite
from eskf_ros.gnss.signals import Gnss
from markdown_table import table

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from support.data import find_data_folder  # noqa: E402
from support.recordings import drive_0708, husky, tsukishima, walk  # noqa: E402
from support.recordings.common import FIX, IMU, ODOMETRY, Outages, Recording, replayed, results_folder  # noqa: E402
from support.recordings.kitti import kitti_recording  # noqa: E402
from support.recordings.nagoya import nagoya_ranges_recording, nagoya_recording  # noqa: E402
from support.recordings.static_mosaic import Pick, StaticReceiver, medium_earth_orbit  # noqa: E402
from support.recordings.thor75 import thor75_recording  # noqa: E402

Array = NDArray[np.float64]

RESULTS = ROOT / "docs" / "results.md"
FIGURE = ROOT / "docs" / "real_drives.png"
ODOMETRY_TOPIC = "/odometry/global"
AXES = ("horizontal", "vertical")
STATISTICS = ("rms", "p50", "p95", "max")
HEADINGS = ("input", "horizontal, m", "vertical, m", "NIS", "NEES", "outside the gate", "restarts")
PEER_HEADINGS = ("input", "horizontal, m", "vertical, m", "speed, m/s", "heading, deg", "NIS", "restarts")
EAST_NORTH_HEADINGS = ("input", "east, north 95 %, m", *HEADINGS[1:])
COURSE_HEADINGS = ("input", "heading known", "heading off the course, deg", "NIS", "restarts", "state at the end")
NAGOYA_HEADINGS = ("IMU, input", *HEADINGS[1:3], "heading, deg", "NIS", "NEES position; attitude", *HEADINGS[5:])
OUTAGE_HEADINGS = ("input", "outages", "horizontal, m", "vertical, m", "inside the 95 % ellipse", "restarts")
END_TOLERANCE = 1.0
"""An outage counts when there is truth in its last second."""


@dataclass(frozen=True)
class Variant:
    """A row of a table: what the estimator is given, as lines added to the parameter file."""

    label: str
    lines: tuple[str, ...] = ()
    chosen_noise: bool = True


NOISES = (Variant("chosen noise"), Variant("default noise", chosen_noise=False))
POSITION = "gnss.use_velocity: false"
NO_WHEEL = "wheel.use: false"
NHC = ("nhc.enabled: true", *tsukishima.REAR_AXLE)
CORRELATED = "gnss.correlation_time: 30.0"
TIGHT = ("mode: tight", f"ranges.time_offset: {tsukishima.TIME_OFFSET}")

INPUTS = (Variant("position only", (POSITION,)), Variant("with velocity"))
TSUKISHIMA = (
    Variant("position only", (POSITION, NO_WHEEL)),
    Variant("position only, default noise", (POSITION, NO_WHEEL), chosen_noise=False),
    Variant("position, NHC", (POSITION, NO_WHEEL, *NHC)),
    Variant("position, wheel", (POSITION, *NHC[2:])),
    Variant("position, wheel, NHC", (POSITION, *NHC)),
    Variant("with velocity", (NO_WHEEL,)),
    Variant("with velocity, default noise", (NO_WHEEL,), chosen_noise=False),
    Variant("with velocity, wheel, NHC", NHC),
)
TSUKISHIMA_RANGES = (
    Variant("loose, position only", (POSITION, NO_WHEEL)),
    Variant("loose, with velocity", (NO_WHEEL,)),
    Variant("loose, with velocity, correlated errors", (NO_WHEEL, CORRELATED)),
    Variant("tight", (*TIGHT, NO_WHEEL)),
    Variant("tight, wheel, NHC", (*TIGHT, *NHC)),
)
MASKED_COUNTS = (8, 4, 3, 2, 1, 0)
MASKED_HEADINGS = ("satellites", "loose, horizontal, m", "inside 95 %", "tight, horizontal, m", "inside 95 %")
STATIC_SYSTEMS = (Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.QZSS, Gnss.GLONASS)
STATIC_HEADINGS = ("ranges", "3D rms, m", "east / north / up rms, m")
RANGES = (
    Variant("loose, position only", (POSITION,)),
    Variant("loose, with velocity"),
    Variant("tight", TIGHT[:1]),
)
HUSKY = (
    Variant("without wheels", (NO_WHEEL,), chosen_noise=False),
    Variant("without wheels, chosen noise", (NO_WHEEL,)),
    Variant("without wheels, chosen noise, heading given", (NO_WHEEL, *husky.HEADING)),
    Variant("wheels", chosen_noise=False),
    Variant("wheels, chosen noise"),
    Variant("wheels, chosen noise, NHC", ("nhc.enabled: true",)),
)
NAGOYA_GRADES = ("consumer", "industrial", "tactical")
KNOWN_HEADING_DEG = 30.0
"""Standard deviation below which a heading counts as known."""


@dataclass(frozen=True)
class Replay:
    """A replay with outages: its summary and, at each truth position, the horizontal error and what was said of it.

    seconds (n,) since the first IMU stamp, error (n, 2) east and north in m, covariance (n, 2, 2) in m2.
    """

    summary: dict[str, Any]
    seconds: Array
    error: Array
    covariance: Array

    def known_ends(self) -> list[dict[str, Any]]:
        """The outages that have truth at their end, and `inside`: is it in the 95 % ellipse of the estimate?"""
        known = []
        for outage in self.summary["outages"]:
            end = outage["start"] + outage["length"]
            last = np.searchsorted(self.seconds, end, side="right") - 1
            if outage["horizontal"] is None or self.seconds[last] < end - END_TOLERANCE:
                continue
            nees = self.error[last] @ np.linalg.solve(self.covariance[last], self.error[last])
            known.append({**outage, "inside": nees <= chi2.ppf(0.95, 2)})
        return known


def main() -> int:
    """Convert, replay, write; returns the exit code."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave recordings and results here")
    parser.add_argument("drives", nargs="*", choices=[*DRIVES, []], metavar="DRIVE", help=f"one of {', '.join(DRIVES)}")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.drives or DRIVES:
            try:
                content = DRIVES[name](options.keep or Path(temporary))
            except (ModuleNotFoundError, FileNotFoundError) as missing:
                print(f"real_drives: {missing}", file=sys.stderr)
                return 2
            print(content)
            text = RESULTS.read_text(encoding="utf-8")
            RESULTS.write_text(between_markers(text, name, content), encoding="utf-8")
    return 0


def kitti_figures(folder: Path) -> str:
    """Errors between fixes ten seconds apart."""
    rows = []
    for aids, with_velocity in (("position only", False), ("with velocity", True)):
        recording = kitti_recording(folder, with_velocity)
        for noise in NOISES:
            summary = replayed(recording, chosen_noise=noise.chosen_noise)
            rows.append(error_row(f"{aids}, {noise.label}", summary))
    return table(HEADINGS, rows)


def drive_0708_figures(folder: Path) -> str:
    """Errors between fixes one second apart, and at the end of outages."""
    source = find_data_folder("drive_0708")
    rows, outage_rows, drawn = [], [], []
    for aids, with_velocity in (("position only", False), ("with velocity", True)):
        recording = drive_0708.drive_0708_recording(folder, source, with_velocity)
        for noise in NOISES:
            label = f"{aids}, {noise.label}"
            rows.append(error_row(label, replayed(recording, chosen_noise=noise.chosen_noise)))
            replays = [replay_with_outages(recording, noise, outages) for outages in drive_0708.OUTAGE_SETS]
            outage_rows.append(outage_row(label, replays))
            if noise.chosen_noise:
                drawn.append((label, replays[0]))
    draw(drawn)
    return (
        f"Between fixes one second apart:\n\n{table(HEADINGS, rows)}\n"
        f"At the end of outages of {drive_0708.OUTAGE_LENGTH:g} s:\n\n{table(OUTAGE_HEADINGS, outage_rows)}"
    )


def tsukishima_figures(folder: Path) -> str:
    """Errors between fixes one second apart, and at the end of outages."""
    recording = tsukishima.tsukishima_recording(folder, find_data_folder("tsukishima_20201105"))
    rows, outage_rows = [], []
    for variant in TSUKISHIMA:
        rows.append(variant_row(recording, variant))
        replays = [replay_with_outages(recording, variant, outages) for outages in tsukishima.OUTAGE_SETS]
        outage_rows.append(outage_row(variant.label, replays))
    with_ranges = tsukishima.tsukishima_ranges_recording(folder, find_data_folder("tsukishima_20201105"))
    window = [
        east_north_row(f"{variant.label}{label}", replay_with_outages(with_ranges, variant, (), truth))
        for truth, label in (("truth", ""), ("truth_shifted", ", constant removed"))
        for variant in TSUKISHIMA_RANGES
    ]
    return (
        f"Between fixes one second apart:\n\n{table(HEADINGS, rows)}\n"
        f"At the end of outages of {tsukishima.OUTAGE_LENGTH:g} s:\n\n{table(OUTAGE_HEADINGS, outage_rows)}\n"
        f"The 850 s with raw measurements, on our own point solutions:\n\n{table(EAST_NORTH_HEADINGS, window)}"
    )


def thor75_figures(folder: Path) -> str:
    """Differences to the filter on board."""
    recording = thor75_recording(folder, find_data_folder("thor75_flight"))
    rows = []
    for variant in INPUTS:
        summary = replayed(recording, *variant.lines, truth="peer")
        errors = [numbers(summary["error"][key], STATISTICS) for key in (*AXES, "speed", "heading_deg")]
        rows.append([variant.label, *errors, aid_cells(summary)[0], str(summary["restarts"])])
    return table(PEER_HEADINGS, rows)


def husky_figures(folder: Path) -> str:
    """What becomes of the heading: it is compared with the course over ground of the fixes."""
    recording = husky.husky_recording(folder, find_data_folder("husky_test1"))
    rows = []
    for variant in HUSKY:
        summary = replayed(recording, *variant.lines, chosen_noise=variant.chosen_noise, truth="")
        estimate = read(results_folder(recording.bag) / "odometry.mcap", ODOMETRY_TOPIC, ODOMETRY)
        time, course = husky.course(
            read(recording.bag, "/fix", FIX), read(recording.bag, "/husky_velocity_controller/odom", ODOMETRY)
        )
        row = np.minimum(np.searchsorted(estimate["stamp"], time), len(estimate) - 1)
        known = estimate["pose_covariance"][row, 35] < math.radians(KNOWN_HEADING_DEG) ** 2
        yaw = Rotation.from_quat(estimate["orientation"][row]).as_euler("ZYX")[:, 0]
        off = np.abs(np.degrees(np.angle(np.exp(1j * (yaw - course)))))[known]
        percentiles = dict(zip(STATISTICS[1:], np.percentile(off, [50, 95, 100]), strict=True)) if len(off) else None
        cells = [f"{known.mean():.0%} of the time", numbers(percentiles, STATISTICS[1:])]
        end = summary["final"]["status"]
        rows.append([variant.label, *cells, aid_cells(summary)[0], str(summary["restarts"]), end])
    return table(COURSE_HEADINGS, rows)


def walk_figures(folder: Path) -> str:
    """Errors between fixes one second apart, and at the end of outages."""
    recording = walk.walk_recording(folder, find_data_folder("walk_0827"))
    text = f"Between fixes one second apart:\n\n{table(HEADINGS, [variant_row(recording, v) for v in INPUTS])}"
    for length, outage_sets in walk.OUTAGE_SETS.items():
        rows = [
            outage_row(v.label, [replay_with_outages(recording, v, outages) for outages in outage_sets]) for v in INPUTS
        ]
        text += f"\nAt the end of outages of {length:g} s:\n\n{table(OUTAGE_HEADINGS, rows)}"
    with_ranges = walk.walk_ranges_recording(folder, find_data_folder("walk_0827"))
    rows = [variant_row(with_ranges, variant) for variant in RANGES]
    text += f"\nOn our own point solutions, four times a second:\n\n{table(HEADINGS, rows)}"
    masks = [masked_row(folder, count) for count in MASKED_COUNTS]
    return f"{text}\nAfter 30 s with so many satellites, three times:\n\n{table(MASKED_HEADINGS, masks)}"


def masked_row(folder: Path, count: int) -> list[str]:
    """Horizontal errors when few satellites have been left for a while, loose and tight."""
    cells = []
    for variant in RANGES[1:]:
        errors, inside = [], 0
        for start, length in walk.MASKED:
            recording = walk.walk_ranges_recording(folder, find_data_folder("walk_0827"), count, start, length)
            replay = replay_with_outages(recording, variant, ())
            last = int(np.searchsorted(replay.seconds, start + length)) - 1
            errors.append(float(np.linalg.norm(replay.error[last])))
            nees = replay.error[last] @ np.linalg.solve(replay.covariance[last], replay.error[last])
            inside += int(nees <= chi2.ppf(0.95, 2))
        cells += [cell(errors), str(inside)]
    return [str(count), *cells]


def static_figures(folder: Path) -> str:
    """Point solutions of a receiver at rest."""
    receiver = StaticReceiver(find_data_folder("static_mosaic"))
    cases: tuple[tuple[str, tuple[Gnss, ...], Pick], ...] = (
        ("one frequency, all", STATIC_SYSTEMS, one_per_satellite),
        *((f"one frequency, {gnss.name}", (gnss,), one_per_satellite) for gnss in STATIC_SYSTEMS if gnss != Gnss.QZSS),
        ("ionosphere-free, GPS, Galileo", STATIC_SYSTEMS[:2], ionosphere_free),
        (
            "ionosphere-free, GPS, Galileo, BeiDou's medium orbits",
            STATIC_SYSTEMS[:3],
            lambda ranges: ionosphere_free(ranges[medium_earth_orbit(ranges)]),
        ),
        ("ionosphere-free, GPS, Galileo, BeiDou, QZSS", STATIC_SYSTEMS[:4], ionosphere_free),
    )
    rows = []
    for label, systems, pick in cases:
        solutions = receiver.solutions(systems, pick)
        off = np.array([solution.position_ecef - receiver.position for solution in solutions]) @ receiver.enu
        east_north_up = np.sqrt(np.mean(off**2, axis=0)).tolist()
        rows.append([label, cell([receiver.error(solutions)]), cell(east_north_up)])
    return table(STATIC_HEADINGS, rows)


def nagoya_figures(folder: Path) -> str:
    """Errors against the true trajectory, by grade of the simulated IMU."""
    source = find_data_folder("nagoya_20240720")
    rows, simulated = [], []
    for grade in NAGOYA_GRADES:
        recording = nagoya_recording(folder, source, grade)
        rows += [nagoya_row(f"{grade}, {variant.label}", recording, variant) for variant in INPUTS]
    for grade in NAGOYA_GRADES[:2]:
        recording = nagoya_ranges_recording(folder, source, grade)
        simulated += [nagoya_row(f"{grade}, {variant.label}", recording, variant) for variant in RANGES]
    return (
        f"On the real fixes of the receiver:\n\n{table(NAGOYA_HEADINGS, rows)}\n"
        f"On our own point solutions of simulated ranges:\n\n{table(NAGOYA_HEADINGS, simulated)}"
    )


def nagoya_row(label: str, recording: Recording, variant: Variant) -> list[str]:
    """Errors of position and heading, and consistency of position and attitude."""
    summary = replayed(recording, *variant.lines)
    nis, outside = aid_cells(summary)
    errors = [numbers(summary["error"][key], STATISTICS) for key in (*AXES, "heading_deg")]
    nees = "; ".join(consistency(summary["nees"][key]) for key in ("position", "attitude"))
    return [label, *errors, nis, nees, outside, str(summary["restarts"])]


DRIVES: dict[str, Callable[[Path], str]] = {
    "kitti": kitti_figures,
    "drive_0708": drive_0708_figures,
    "tsukishima": tsukishima_figures,
    "thor75": thor75_figures,
    "husky": husky_figures,
    "walk": walk_figures,
    "nagoya": nagoya_figures,
    "static": static_figures,
}


def variant_row(recording: Recording, variant: Variant) -> list[str]:
    """Errors of a replay."""
    return error_row(variant.label, replayed(recording, *variant.lines, chosen_noise=variant.chosen_noise))


def error_row(label: str, summary: dict[str, Any]) -> list[str]:
    """Errors against truth and what became of the aids, position before velocity."""
    nis, outside = aid_cells(summary)
    errors = [numbers(summary["error"][axis], STATISTICS) for axis in AXES]
    return [label, *errors, nis, consistency(summary["nees"]["position"]), outside, str(summary["restarts"])]


def east_north_row(label: str, replay: Replay) -> list[str]:
    """Errors of a replay, those of east and north apart too."""
    east_north = np.percentile(np.abs(replay.error), 95.0, axis=0).tolist()
    label, *cells = error_row(label, replay.summary)
    return [label, cell(east_north), *cells]


def aid_cells(summary: dict[str, Any]) -> tuple[str, str]:
    """NIS, and how many were outside the gate, of the aids that were judged."""
    aids = [aid for aid in summary["aids"].values() if aid["nis_mean"] is not None]
    outside = [aid["verdicts"].get("gate", 0) + aid["verdicts"].get("weighed_down", 0) for aid in aids]
    return (
        "; ".join(f"{aid['nis_mean']:.2f}, {aid['nis_in_95']:.1%}" for aid in aids),
        "; ".join(f"{count} of {aid['offered']}" for count, aid in zip(outside, aids, strict=True)),
    )


def consistency(nees: dict[str, float] | None) -> str:
    """Mean and share inside the 95 % bound."""
    return "-" if nees is None else f"{nees['mean']:.2f}, {nees['in_95']:.1%}"


def outage_row(label: str, replays: Sequence[Replay]) -> list[str]:
    """Errors at the end of all outages of several replays."""
    outages = [outage for replay in replays for outage in replay.known_ends()]
    cells = []
    for axis in AXES:
        errors = [outage[axis] for outage in outages]
        cells.append(cell([np.median(errors), np.percentile(errors, 95), max(errors)]))
    inside = sum(outage["inside"] for outage in outages)
    return [label, str(len(outages)), *cells, str(inside), str(sum(replay.summary["restarts"] for replay in replays))]


def numbers(error: dict[str, float] | None, keys: Iterable[str]) -> str:
    """Statistics of an error in a cell; a dash when there is none."""
    return "-" if error is None else cell(error[key] for key in keys)


def cell(values: Iterable[float]) -> str:
    """Numbers in a cell: three decimals below one, two above."""
    return " / ".join(f"{value:.3f}" if value < 1.0 else f"{value:.2f}" for value in values)


def between_markers(text: str, name: str, content: str) -> str:
    """`text` with `content` between the markers of a drive; raises ValueError when they are not there."""
    begin, end = f"<!-- figures of {name}: written by benchmark/real_drives.py -->\n", f"<!-- end of {name} -->\n"
    before, begin_found, rest = text.partition(begin)
    _, end_found, after = rest.partition(end)
    if not (begin_found and end_found):
        raise ValueError(f"{RESULTS}: the lines {begin.strip()!r} and {end.strip()!r} are missing")
    return f"{before}{begin}\n{content}\n{end}{after}"


def replay_with_outages(recording: Recording, variant: Variant, outages: Outages, truth_topic: str = "truth") -> Replay:
    """Replay with outages and read back the published odometry."""
    summary = replayed(recording, *variant.lines, outages=outages, chosen_noise=variant.chosen_noise, truth=truth_topic)
    estimate = read(results_folder(recording.bag) / "odometry.mcap", ODOMETRY_TOPIC, ODOMETRY)
    truth = read(recording.bag, f"/{truth_topic}", FIX)
    first = int(read(recording.bag, "/imu/data", IMU)["stamp"][0])
    truth = truth[(truth["stamp"] >= estimate["stamp"][0]) & (truth["stamp"] <= estimate["stamp"][-1])]

    lever_arm = load(recording.config(variant.lines, variant.chosen_noise)).gnss.lever_arm
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
        panel.set_title(f"drive_0708, {label}: outages of {drive_0708.OUTAGE_LENGTH:g} s in grey", fontsize=10)
    panels[0, 0].legend(loc="upper right", ncols=2, fontsize=8)
    panels[-1, 0].set_xlabel("s")
    figure.savefig(FIGURE, dpi=70)


if __name__ == "__main__":
    sys.exit(main())
