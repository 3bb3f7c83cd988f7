"""What benchmark/peers.py hands to other programs: the same physics in their units and axes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.simulate.main import main
from eskf_ros.simulate.range_receiver import RangeReceiver
from eskf_ros.simulate.scenario import simulate
from peers import Drive, Ours, inputs_of, run_ours, run_sidereon, scored, write_truth
from peers_export import export

CHECKOUT = Path(__file__).resolve().parents[2]
DRIVE = Drive(
    "tunnel",
    CHECKOUT / "bags" / "tunnel_drive.mcap",
    load(CHECKOUT / "config" / "tunnel_drive.yaml"),
    "truth",
    ((80.0, 20.0),),
)


@pytest.fixture(scope="module")
def ours() -> Ours:
    return run_ours(DRIVE)


@pytest.fixture(scope="module")
def folder(ours: Ours, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("export")
    export(place, inputs_of(DRIVE, ours.first_stamp), ours.start, MapFrame(ours.datum), DRIVE.parameters)
    write_truth(place, ours)
    return place


def test_kf_gins_gets_increments_forward_right_down(folder: Path) -> None:
    # At rest the force is upwards, that is along the negative third axis; a step of 5 ms at 200 Hz.
    table = np.loadtxt(folder / "kf_gins_imu.txt")
    rest = table[:2000]
    assert np.diff(table[:, 0]) == pytest.approx(0.005, abs=1e-6)
    assert rest[:, 4:].mean(axis=0) == pytest.approx([0.0, 0.0, -9.81 * 0.005], abs=0.002)


def test_outages_are_withheld_and_positions_are_the_same_in_all_files(folder: Path, ours: Ours) -> None:
    gnss = np.loadtxt(folder / "kf_gins_gnss.txt")
    begin = np.loadtxt(folder / "kf_gins_imu.txt", max_rows=1)[0] - 0.005
    seconds = gnss[:, 0] - begin
    assert not ((seconds > 80.01) & (seconds < 99.99)).any()
    assert ((seconds > 79.0) & (seconds < 101.0)).any()
    lines = [line.split() for line in (folder / "rtklib.pos").read_text().splitlines() if not line.startswith("%")]
    positions = np.array([[float(value) for value in line[2:5]] for line in lines])
    assert positions == pytest.approx(gnss[:, 1:4], abs=1e-4)


def test_kf_gins_starts_where_we_are(folder: Path, ours: Ours) -> None:
    configuration = YAML(typ="safe").load(folder / "kf-gins.yaml")
    start: Any = ours.start
    place = MapFrame(ours.datum).to_geodetic_deg(start["position_map"])
    assert configuration["initpos"][:2] == pytest.approx(place[:2], abs=1e-9)
    assert configuration["initpos"][2] == pytest.approx(place[2], abs=1e-3)
    east, north, up = start["velocity_map"]
    assert configuration["initvel"] == pytest.approx([north, east, -up], abs=1e-3)
    # Course and heading of a car agree; it starts to move here.
    course = np.degrees(np.arctan2(east, north))
    assert configuration["initatt"][2] == pytest.approx(course, abs=5.0)
    assert configuration["antlever"] == pytest.approx([0.8, 0.2, -1.4])


def test_the_judge_finds_what_the_replay_finds(folder: Path, ours: Ours) -> None:
    row = scored("eskf_ros", ours.run, ours, DRIVE, folder)
    rms = float(row[1].split(" / ")[0])
    assert 0.1 < rms < 5.0
    assert float(row[5]) == pytest.approx(3.0, abs=2.0)  # NEES
    if row[7] not in ("-", "evo is not installed"):
        assert float(row[7]) == pytest.approx(rms, rel=0.1)


def test_sidereon_gets_the_ranges_that_we_get(tmp_path: Path) -> None:
    # With another time, another satellite clock or another sign of the Doppler it would be lost within seconds.
    pytest.importorskip("sidereon")
    bag = tmp_path / "ranges.mcap"
    main(["drive", "--imu-rate", "50", "--sensor", "ranges:systems=G", "--out", str(bag), "--quiet"])
    options = {"imu_rate": 50.0, "ranges": RangeReceiver(systems="G")}
    parameters = from_mapping({**simulate("drive", 0, **options).parameters(), "mode": "tight"})
    drive = Drive("ranges", bag, parameters, "truth", ())
    ours = run_ours(drive)
    inputs = inputs_of(drive, ours.first_stamp)
    run = run_sidereon(drive, ours, inputs, MapFrame(ours.datum), holds_gyro_bias=True)
    both = np.intersect1d(run.rows["stamp"], ours.run.rows["stamp"], return_indices=True)
    apart = run.rows["position_map"][both[1]] - ours.run.rows["position_map"][both[2]]
    # The errors of the ranges last: ours and theirs share most of them, 5 m and more vertically.
    assert np.sqrt(np.mean(np.sum(apart[:, :2] ** 2, axis=1))) < 2.0
    assert np.sqrt(np.mean(apart[:, 2] ** 2)) < 3.0
