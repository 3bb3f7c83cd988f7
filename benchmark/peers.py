"""Our estimate beside other filters on the same recordings; writes docs/peers.md.

    python benchmark/peers.py [--export DIR]                                    # the drives of docs/peers.md
    python benchmark/peers.py BAG --config FILE --truth TOPIC [--outage S:L] [--export DIR]

A parameter file with `mode: tight` compares tightly coupled filters, by the ranges of GPS alone (see `peers_tight.py`).

Needs sidereon and, for the last column, evo (both on PyPI). `--export` leaves each recording as KF-GINS, RTKLIB,
sidereon and evo read it. Without BAG the table goes to docs/peers.md, else to the terminal.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros import read_bag
from eskf_ros.bags import open_bag
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.state.enums import Status
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.inputs.table import FIX
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.feed import Feed
from eskf_ros.replay.summary import truth_result
from eskf_ros.replay.topics import find_topics, truth_converter
from eskf_ros.replay.truth import TruthComparison
from eskf_ros.simulate.main import main as simulate_bag
from eskf_ros.simulate.range_receiver import RangeReceiver
from eskf_ros.simulate.scenario import simulate
from markdown_table import table
from peers_export import export, write_tum
from peers_sidereon import SECOND, GaveUpError, Inputs, Run, gyro_bias_at_rest, run_loose
from peers_tight import GpsIntake, run_tight

ROOT = Path(__file__).resolve().parents[1]
DOCUMENT = ROOT / "docs" / "peers.md"
MARKERS = ("<!-- peers: written by benchmark/peers.py -->\n", "<!-- end of peers -->\n")
HEADINGS = (
    "filter",
    "horizontal rms / 95 %, m",
    "vertical rms, m",
    "heading rms, deg",
    "outage ends median / largest, m",
    "NEES (3)",
    "us per sample",
    "evo APE rms, m",
)
HOLDS_GYRO_BIAS = (("", False), (", gyro bias held at ours", True))
"""How sidereon is run, with what is added to its name."""
NOT_RUN = (
    ("KF-GINS", "C++ source, no package; `kf-gins.yaml` and its two files are exported"),
    ("robot_localization, FusionCore", "C++ nodes of ROS 2, not on PyPI"),
)
CITY_OUTAGES = ((110.0, 30.0), (180.0, 30.0), (250.0, 30.0))
HEADING_STD_DEG = 3.0
"""The comparison starts when our heading is known this well: others cannot start by themselves."""

sys.path.insert(0, str(ROOT / "test"))

from support.data import find_data_folder  # noqa: E402
from support.recordings import drive_0708, tsukishima, walk  # noqa: E402

Outages = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Drive:
    """A recording with its truth, and the outages (start, length in s from the first IMU stamp) that are cut."""

    title: str
    bag: Path
    parameters: Parameters
    truth: str
    outages: Outages


@dataclass(frozen=True)
class Ours:
    """Our rows from the start of the comparison on, truth epochs after it, the point that these are of, the datum.

    ``intake``: what was heard of the satellites, in mode tight.
    """

    run: Run
    start: NDArray[Any]
    epochs: NDArray[Any]
    point: tuple[float, ...]
    datum: tuple[float, float, float]
    first_stamp: int
    intake: GpsIntake | None


def run_ours(drive: Drive) -> Ours:
    """Replay a recording, with a row for each IMU sample."""
    parameters = drive.parameters
    rows, used = [], 0.0
    with open_bag([drive.bag]) as reader:
        topics, _ = find_topics(reader, drive.bag, parameters, drive.truth)
        to_epochs = truth_converter(topics, drive.bag, parameters)
        navigator = Navigator(parameters, output_rate=0.0)
        intake = GpsIntake(navigator, parameters) if parameters.mode == "tight" else None
        feed = Feed(navigator, topics, outages=drive.outages, intake=intake)
        epochs = []
        for batch in feed.ordered(reader.batches(topics.wanted())):
            began = time.process_time()
            rows.append(feed.push(batch).copy())
            used += time.process_time() - began
            if topics.truth in batch:
                epochs.append(to_epochs(batch[topics.truth]))
        navigator.finish()
    estimate = np.concatenate(rows)
    heading_std = np.degrees(np.sqrt(estimate["pose_covariance"][:, 5, 5]))
    ready = (estimate["status"] == Status.GOOD) & estimate["heading_known"] & (heading_std < HEADING_STD_DEG)
    first = int(np.argmax(ready))
    truth = np.concatenate(epochs)
    assert navigator.datum is not None
    assert feed.first_stamp is not None
    return Ours(
        run=Run(estimate[first + 1 :], 1e6 * used / feed.imu_count),
        start=estimate[first],
        epochs=truth[truth["stamp"] > estimate["stamp"][first]],
        point=parameters.gnss.lever_arm if topics.truth_type == FIX else (0.0, 0.0, 0.0),
        datum=navigator.datum,
        first_stamp=feed.first_stamp,
        intake=intake,
    )


def inputs_of(drive: Drive, first_stamp: int) -> Inputs:
    """What other filters are given: the same messages by stamp, without delays, and without those withheld."""
    tables = read_bag(drive.bag, replace(drive.parameters, mode="loose"))
    imu, fix = tables["imu"], tables["gnss_position"]
    seconds = (fix["stamp"] - first_stamp) / SECOND
    kept = fix["status"] >= 0
    for start, length in drive.outages:
        kept &= ~((seconds >= start) & (seconds < start + length))
    offset = round(drive.parameters.gnss.time_offset * SECOND)
    covariance = fix["covariance"].reshape(-1, 3, 3).copy()
    for axis in range(3):
        covariance[:, axis, axis] = np.maximum(covariance[:, axis, axis], drive.parameters.gnss.position_std_floor**2)
    velocity = np.full((len(seconds), 3), np.nan)
    velocity_covariance = np.full((len(seconds), 3, 3), np.nan)
    if "gnss_velocity" in tables and drive.parameters.gnss.use_velocity:
        given = tables["gnss_velocity"]
        _, here, there = np.intersect1d(fix["stamp"], given["stamp"], return_indices=True)
        velocity[here] = given["velocity"][there]
        velocity_covariance[here] = given["covariance"].reshape(-1, 3, 3)[there]
    geodetic = np.column_stack([np.radians(fix["latitude_deg"]), np.radians(fix["longitude_deg"]), fix["altitude"]])
    return Inputs(
        imu["stamp"],
        imu["specific_force"],
        imu["angular_rate"],
        fix["stamp"][kept] + offset,
        geodetic[kept],
        covariance[kept],
        velocity[kept],
        velocity_covariance[kept],
    )


def scored(name: str, run: Run, ours: Ours, drive: Drive, folder: Path) -> list[str]:
    """A row of the table."""
    comparison = TruthComparison(ours.point)
    comparison.add_truth(ours.epochs)
    comparison.add_rows(run.rows, ours.datum)
    compared = comparison.compared()
    result = truth_result(drive.truth, len(ours.epochs), compared)
    error = result["error"]
    seconds = (compared["stamp"] - ours.first_stamp) / SECOND
    ends = []
    for start, length in drive.outages:
        inside = compared["horizontal"][(seconds >= start) & (seconds <= start + length)]
        if len(inside) and start > (int(ours.start["stamp"]) - ours.first_stamp) / SECOND:
            ends.append(inside[-1])
    path = folder / f"{name.replace(' ', '_').replace(',', '')}.tum"
    write_tum(path, run.rows)
    heading = error["heading_deg"]
    return [
        name,
        f"{error['horizontal']['rms']:.2f} / {error['horizontal']['p95']:.2f}",
        f"{error['vertical']['rms']:.2f}",
        f"{heading['rms']:.2f}" if heading else "-",
        f"{np.median(ends):.1f} / {max(ends):.1f}" if ends else "-",
        f"{result['nees']['position']['mean']:.1f}",
        f"{run.microseconds:.1f}",
        evo_error(path, folder / "truth.tum", ours.point),
    ]


def write_truth(folder: Path, ours: Ours) -> None:
    """The truth as evo reads it; without attitudes the identity stands for them."""
    frame = MapFrame(ours.datum)
    rows = np.zeros(len(ours.epochs), ODOMETRY)
    rows["stamp"] = ours.epochs["stamp"]
    rows["position_map"] = (ours.epochs["position_ecef"] - frame.origin_ecef) @ frame.rotation_map_to_ecef
    rows["attitude_body_to_map"][:, 0] = 1.0
    write_tum(folder / "truth.tum", rows)


def evo_error(estimate: Path, truth: Path, point: tuple[float, ...]) -> str:
    """Absolute position error (3D, rms) after evo, without alignment; of base_link, so only where truth is of that."""
    if any(point):
        return "-"
    try:
        from evo.core import metrics, sync
        from evo.tools import file_interface
    except ImportError:
        return "evo is not installed"
    pair = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(str(truth)), file_interface.read_tum_trajectory_file(str(estimate))
    )
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data(pair)
    return f"{error.get_statistic(metrics.StatisticsType.rmse):.2f}"


def run_sidereon(drive: Drive, ours: Ours, inputs: Inputs, frame: MapFrame, holds_gyro_bias: bool) -> Run:
    """Run the filter of sidereon that is coupled as ours is."""
    if ours.intake is None:
        return run_loose(inputs, ours.start, frame, drive.parameters, "EKF", holds_gyro_bias)
    return run_tight(inputs, ours.intake, ours.run.rows, ours.start, frame, drive.parameters, holds_gyro_bias)


def compared_drive(drive: Drive, folder: Path) -> str:
    """Table of a drive; its exports lie in the folder afterwards."""
    run_ours(drive)  # What has to be compiled or loaded is not of the estimator.
    ours = run_ours(drive)
    inputs, frame = inputs_of(drive, ours.first_stamp), MapFrame(ours.datum)
    export(folder, inputs, ours.start, frame, drive.parameters)
    write_truth(folder, ours)
    rows = [scored("eskf_ros", ours.run, ours, drive, folder)]
    for suffix, holds_gyro_bias in HOLDS_GYRO_BIAS:
        name = f"sidereon {drive.parameters.mode} EKF{suffix}"
        try:
            run = run_sidereon(drive, ours, inputs, frame, holds_gyro_bias)
        except ImportError:
            rows.append([name, "not installed", *["-"] * (len(HEADINGS) - 2)])
            continue
        except GaveUpError as error:
            rows.append([name, f"gave up: {error}", *["-"] * (len(HEADINGS) - 2)])
            continue
        rows.append(scored(name, run, ours, drive, folder))
    if ours.intake is None:
        rows += [[name, f"not run: {why}", *["-"] * (len(HEADINGS) - 2)] for name, why in NOT_RUN]
    return f"### {drive.title}\n\n{table(HEADINGS, rows)}\n"


def at_rest() -> str:
    """What sidereon makes of a gyro bias at rest, as a sentence."""
    try:
        true, found, deviation = gyro_bias_at_rest()
    except ImportError:
        return "sidereon is not installed.\n"
    version = metadata.version("sidereon")
    return (
        f"sidereon {version} at rest, without noise, fixes of 1 cm for a minute: a gyro bias of {true:g} rad/s is "
        f"estimated as {found:.4f} +- {deviation:.6f} rad/s.\n"
    )


def our_drives(folder: Path) -> list[Drive]:
    """The drives of docs/peers.md: the bundled one, simulated ones with outages, and real ones if they are there."""
    tunnel = Drive(
        "Bundled drive through a tunnel of 45 s (simulated, industrial IMU, fixes of 1 m and velocities)",
        ROOT / "bags" / "tunnel_drive.mcap",
        load(ROOT / "config" / "tunnel_drive.yaml"),
        "truth",
        (),
    )
    found = [tunnel]
    for grade, seed in (("consumer", 1), ("industrial", 2)):
        bag = folder / f"drive_{grade}.mcap"
        simulate_bag(["drive", "--grade", grade, "--seed", str(seed), "--out", str(bag), "--quiet"])
        parameters = from_mapping(simulate("drive", seed, grade=grade).parameters())
        title = f"City drive (simulated, {grade} IMU, fixes of 1 m and velocities), three outages of 30 s"
        found.append(Drive(title, bag, parameters, "truth", CITY_OUTAGES))
    found.append(simulated_ranges(folder))
    for real in (real_fixes, real_city_ranges, real_walk_ranges):
        try:
            found.append(real(folder))
        except FileNotFoundError as error:
            print(error, file=sys.stderr)
    return found


def simulated_ranges(folder: Path) -> Drive:
    """A city drive with ranges of GPS."""
    bag, receiver = folder / "drive_ranges.mcap", RangeReceiver(systems="G")
    options = ["--grade", "industrial", "--seed", "2", "--sensor", "ranges:systems=G"]
    simulate_bag(["drive", *options, "--out", str(bag), "--quiet"])
    mapping = simulate("drive", 2, grade="industrial", ranges=receiver).parameters()
    title = "Tight: city drive (simulated, industrial IMU, ranges of GPS), three outages of 30 s"
    return Drive(title, bag, from_mapping({**mapping, "mode": "tight"}), "truth", CITY_OUTAGES)


def real_fixes(folder: Path) -> Drive:
    """drive_0708 with its positions."""
    recording = drive_0708.drive_0708_recording(folder, find_data_folder("drive_0708"), with_velocity=False)
    title = "drive_0708 (real, consumer IMU, RTK positions at 1 Hz), outages of 15 s every 45 s"
    parameters = load(recording.config((), chosen_noise=True))
    return Drive(title, recording.bag, parameters, "truth", drive_0708.OUTAGE_SETS[0])


def real_city_ranges(folder: Path) -> Drive:
    """The part of tsukishima with ranges; truth without the constant between them and the RTK positions."""
    recording = tsukishima.tsukishima_ranges_recording(folder, find_data_folder("tsukishima_20201105"))
    lines = ("mode: tight", f"ranges.time_offset: {tsukishima.TIME_OFFSET}", "wheel.use: false")
    title = "Tight: tsukishima (real, MEMS IMU, ranges of GPS on L1 between tall buildings)"
    return Drive(title, recording.bag, load(recording.config(lines, chosen_noise=True)), "truth_shifted", ())


def real_walk_ranges(folder: Path) -> Drive:
    """walk_0827 with the ranges of the four GPS satellites whose ephemerides it has."""
    recording = walk.walk_ranges_recording(folder, find_data_folder("walk_0827"))
    title = "Tight: walk_0827 (real, IMU in the hand, ranges of four GPS satellites)"
    return Drive(title, recording.bag, load(recording.config(("mode: tight",), chosen_noise=True)), "truth", ())


def _outage(text: str) -> tuple[float, float]:
    start, length = (float(part) for part in text.split(":"))
    return start, length


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, and print or write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", nargs="?", type=Path, metavar="BAG", help="a recording with truth")
    parser.add_argument("--config", type=Path, metavar="FILE", help="parameter file of the node")
    parser.add_argument("--truth", default="truth", metavar="TOPIC")
    parser.add_argument("--outage", action="append", default=[], type=_outage, metavar="START:LENGTH")
    parser.add_argument("--export", type=Path, metavar="DIR", help="leave the files for other programs there")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.bag:
            parameters = load(options.config) if options.config else Parameters()
            drives = [Drive(options.bag.name, options.bag, parameters, options.truth, tuple(options.outage))]
        else:
            drives = our_drives(folder)
        texts = [compared_drive(drive, (options.export or folder) / drive.bag.stem) for drive in drives]
    if options.bag:
        print("\n".join(texts))
        return 0
    texts.insert(0, at_rest())
    document = DOCUMENT.read_text(encoding="utf-8")
    before, after = document.split(MARKERS[0])[0], document.split(MARKERS[1])[1]
    DOCUMENT.write_text(before + MARKERS[0] + "\n" + "\n".join(texts) + MARKERS[1] + after, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
