"""The smoother behind the replay and the Python API: honest in tunnels, better on real drives, files that agree."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import eskf_ros
from eskf_ros.bags import open_bag
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.replay.main import main
from eskf_ros.replay.results import NAMES, SMOOTHED_NAME
from eskf_ros.simulate.scenario import simulate
from eskf_ros.smooth.fixed_lag import FixedLag
from monte_carlo import NO_REST, feed
from smoother import ensemble, errors_of
from smoother_drives import (
    NHC,
    REAR_AXLE,
    RURAL_OUTAGES,
    TOKYO_OUTAGES,
    WITHOUT_VELOCITY,
    WITHOUT_WHEELS,
    inside_outages,
    smoothed_summary,
)
from support.recordings.drive_0708 import drive_0708_recording
from support.recordings.kitti import kitti_recording
from support.recordings.tsukishima import tsukishima_recording

CHECKOUT = Path(__file__).resolve().parents[2]
BAG = CHECKOUT / "bags" / "tunnel_drive.mcap"
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
TUNNEL = (125.0, 170.0)
RUNS = 40


def replayed(out: Path, *options: str) -> Path:
    assert main([str(BAG), f"--config={CONFIG}", f"--out={out}", "--quiet", *options]) == 0
    return out / "tunnel_drive_eskf"


def test_the_error_in_a_tunnel_is_what_the_covariance_says() -> None:
    """And the errors outside are: small ensembles scatter, `benchmark/smoother.py` has the large one."""
    runs = ensemble("tunnel_drive", range(RUNS))
    achieved, predicted = runs.smoother.inside(*TUNNEL)
    by_filter, _ = runs.filter.inside(*TUNNEL)
    assert abs(achieved / predicted - 1.0) < 0.15
    assert achieved < 0.2 * by_filter
    for block in ("position", "velocity", "attitude"):
        assert 2.4 < runs.smoother.nees(block).mean() < 3.8, block


def test_results_of_a_replay(tmp_path: Path) -> None:
    """The smoothed trajectory in all three files, better than the filter's; without the option it is gone."""
    folder = replayed(tmp_path, "--smooth", "--truth=truth")
    summary = json.loads((folder / "summary.json").read_text())
    smoothed = summary["smoothed"]
    assert smoothed["breaks"] == 0
    assert smoothed["error"]["horizontal"]["rms"] < 0.5 * summary["error"]["horizontal"]["rms"]
    assert 0.85 < smoothed["nees"]["position"]["in_95"] <= 1.0
    table = np.loadtxt(folder / SMOOTHED_NAME)
    filtered = np.loadtxt(folder / "trajectory.tum")
    # It begins at the first fix; the filter could publish only when that had arrived.
    np.testing.assert_array_equal(table[table[:, 0] >= filtered[0, 0], 0], filtered[:, 0])
    assert len(table) - len(filtered) < 10
    with open_bag([folder / "odometry.mcap"]) as bag:
        assert "/odometry/smoothed" in bag.topics
        parts = [
            batch["/odometry/smoothed"].messages
            for batch in bag.batches({"/odometry/smoothed": "nav_msgs/msg/Odometry"})
        ]
    messages = np.concatenate(parts)
    np.testing.assert_allclose(messages["position"], table[:, 1:4], atol=1e-6)
    assert (messages["pose_covariance"].reshape(-1, 6, 6).diagonal(axis1=1, axis2=2) > 0.0).all()
    folder = replayed(tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == sorted(NAMES)


@pytest.fixture(scope="module")
def tables() -> dict[str, Any]:
    recording = simulate("drive", 2, stop=80.0)
    return {
        "imu": {
            "stamp": recording.imu_stamp,
            "specific_force": recording.specific_force,
            "angular_rate": recording.angular_rate,
        },
        "gnss_position": {
            "stamp": recording.fix_stamp,
            "latitude_deg": recording.fix_latitude_deg,
            "longitude_deg": recording.fix_longitude_deg,
            "altitude": recording.fix_altitude,
            "covariance": recording.fix_covariance,
        },
        "parameters": {**recording.parameters(), **NO_REST},
    }


def test_smooth_of_a_result(tables: dict[str, Any]) -> None:
    """Whole or in pieces the same, as often as one asks, and the filter may go on meanwhile."""
    parameters = tables["parameters"]
    whole = eskf_ros.run(tables["imu"], tables["gnss_position"], parameters=parameters, output_rate=10.0).smooth()
    filter_ = eskf_ros.Filter(parameters, 10.0, smooth=True)
    half = len(tables["imu"]["stamp"]) // 2
    parts = [
        {name: values[part] for name, values in tables["imu"].items()} for part in (slice(half), slice(half, None))
    ]
    filter_.push_imu(parts[0])
    filter_.push_gnss_position(tables["gnss_position"])
    early = filter_.result()
    filter_.push_imu(parts[1])
    late = filter_.result()
    for smoothed in (late.smooth(), late.smooth()):
        assert whole.odometry.tobytes() == smoothed.odometry.tobytes()
    first = early.smooth().odometry
    assert 0 < len(first) < len(whole.odometry)
    assert first.dtype == ODOMETRY
    # What came later made it better.
    std = [np.sqrt(np.trace(rows["pose_covariance"][len(first) - 1, :3, :3])) for rows in (first, whole.odometry)]
    assert std[1] < 0.9 * std[0]


def test_without_a_log_there_is_nothing_to_smooth(tables: dict[str, Any]) -> None:
    filter_ = eskf_ros.Filter(tables["parameters"])
    filter_.push_imu(tables["imu"])
    with pytest.raises(ValueError, match="smooth=True"):
        filter_.result().smooth()


def test_a_silent_imu_is_a_break(tables: dict[str, Any]) -> None:
    """Nothing is smoothed over six seconds without IMU: right before them the estimate is the filter's own."""
    stamps = tables["imu"]["stamp"]
    begin = stamps[0] + 60 * 10**9
    kept = (stamps < begin) | (stamps >= begin + 6 * 10**9)
    imu = {name: values[kept] for name, values in tables["imu"].items()}
    result = eskf_ros.run(imu, tables["gnss_position"], parameters=tables["parameters"], output_rate=10.0)
    smoothed = result.smooth()
    assert result.summary["restarts"] == smoothed.breaks == 1
    rows = [found["position_map"][found["stamp"] < begin][-1] for found in (result.odometry, smoothed.odometry)]
    earlier = [
        found["position_map"][found["stamp"] < begin - 5 * 10**9][-1] for found in (result.odometry, smoothed.odometry)
    ]
    np.testing.assert_allclose(rows[0], rows[1], atol=0.1)
    assert np.linalg.norm(earlier[0] - earlier[1]) > 1e-3


def test_a_fixed_lag_gives_most_of_it() -> None:
    """Ten seconds after each moment the estimate is far better than at it, in order, without holes, and honest."""
    recording = simulate("tunnel_drive", 4)
    navigator = Navigator(from_mapping({**recording.parameters(), **NO_REST}), keeps_log=True)
    fixed_lag = FixedLag(navigator, 10.0)
    parts, late = [], 0
    for i, _ in feed(recording, navigator, np.arange(199, len(recording.imu_stamp), 200)):
        rows = fixed_lag.update()
        parts.append(rows)
        if len(rows):
            late = max(late, int(recording.imu_stamp[i] - rows["stamp"][-1]))
    rows = np.concatenate(parts)
    assert late < 14 * 10**9
    assert set(np.diff(rows["stamp"][1:]).tolist()) == {20_000_000}
    last = int(np.searchsorted(rows["stamp"], recording.imu_stamp[-1] - 14 * 10**9))
    assert last > len(rows) - 100
    stamps = np.intersect1d(rows["stamp"][rows["heading_known"]], recording.truth_stamp)[50:]
    error, covariance = errors_of(recording, rows, stamps)
    seconds = (stamps - recording.imu_stamp[0]) * 1e-9
    outside = (seconds < TUNNEL[0] - 15.0) | (seconds > TUNNEL[1])
    assert np.sqrt((error[outside, :2] ** 2).sum(axis=1).mean()) < 0.3
    squares = np.einsum("ni,ni->n", error[:, :3], np.linalg.solve(covariance[:, :3, :3], error[:, :3, None])[..., 0])
    assert squares.mean() < 6.0


@pytest.mark.parametrize(
    ("lines", "half", "most"),
    [((), 0.28, 0.62), ((NHC,), 0.23, 0.48)],
    ids=["positions", "nhc"],
)
def test_drive_0708_inside_outages(
    tmp_path: Path, data_folder: Callable[[str], Path], lines: tuple[str, ...], half: float, most: float
) -> None:
    recording = drive_0708_recording(tmp_path, data_folder("drive_0708"), False)
    row = inside_outages(recording, RURAL_OUTAGES, *lines)
    assert row.count == 31
    assert row.breaks == 0
    assert row.smoother[0] <= half
    assert row.smoother[1] <= most


TOKYO_NHC = (NHC, *REAR_AXLE)


@pytest.mark.parametrize(
    ("lines", "half", "most"),
    [
        ((WITHOUT_VELOCITY,), 0.34, 2.6),
        (TOKYO_NHC, 0.25, 0.78),
    ],
    ids=["positions", "velocities-nhc"],
)
def test_tsukishima_inside_outages(
    tmp_path: Path, data_folder: Callable[[str], Path], lines: tuple[str, ...], half: float, most: float
) -> None:
    """The least and the most that a car has. What lies between is in the benchmark, with its one missed bar."""
    recording = tsukishima_recording(tmp_path, data_folder("tsukishima_20201105"))
    row = inside_outages(recording, TOKYO_OUTAGES, WITHOUT_WHEELS, *lines)
    assert row.count == 43
    assert row.smoother[0] <= half
    assert row.smoother[1] <= most


def test_kitti_with_a_fix_every_ten_seconds(tmp_path: Path) -> None:
    pytest.importorskip("gtsam", reason="KITTI comes with the package gtsam, which is not installed")
    for with_velocity in (False, True):
        summary = smoothed_summary(kitti_recording(tmp_path, with_velocity))
        smoothed = summary["smoothed"]["error"]["horizontal"]
        assert smoothed["rms"] <= 0.5 * summary["error"]["horizontal"]["rms"]
        assert summary["smoothed"]["nees"]["position"]["in_95"] > 0.9
