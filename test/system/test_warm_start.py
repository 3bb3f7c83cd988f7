"""Warm start, and the pose or the datum that somebody sets: told from outside, believed as far as it deserves."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from eskf_ros.filter.alignment.warm_start import Memory
from eskf_ros.filter.history.records import RECORD
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Status, Verdict
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.ros_node.memory import read_memory, write_memory
from eskf_ros.simulate.scenario import Recording, simulate

HOUR = 3600.0


@pytest.fixture(scope="module")
def parked() -> Recording:
    """The drive before it begins: ten seconds at rest."""
    return simulate("drive", seed=3, imu_rate=100.0, start=5.0, stop=15.0)


def true_memory(recording: Recording) -> Memory:
    """What an earlier run would have left: the truth, and standard deviations that fit it."""
    w, x, y, z = recording.truth_attitude_body_to_map[0]
    heading = math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    latitude, longitude, altitude = recording.frame.to_geodetic_deg(recording.truth_position_map[0])
    return Memory(
        stamp=int(recording.imu_stamp[0]) - round(HOUR * 1e9),
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude=altitude,
        position_std=1.0,
        heading_deg=heading,
        heading_std_deg=0.5,
        accel_bias=tuple(recording.accel_bias[0].tolist()),
        accel_bias_std=(0.01, 0.01, 0.01),
        gyro_bias=tuple(recording.gyro_bias[0].tolist()),
        gyro_bias_std=(1e-4, 1e-4, 1e-4),
    )


def run(recording: Recording, memory: Memory | None, **parameters: object) -> Navigator:
    navigator = Navigator(from_mapping({**recording.parameters(), **parameters}))
    if memory is not None:
        navigator.warm_start(memory, HOUR)
    feed(navigator, recording)
    return navigator


def feed(navigator: Navigator, recording: Recording, after: int = 0) -> None:
    """Give all that is newer than ``after`` (ns) in the order of stamps."""
    done = int(np.searchsorted(recording.imu_stamp, after, side="right"))
    for epoch in np.flatnonzero(recording.fix_stamp > after):
        stamp = int(recording.fix_stamp[epoch])
        end = int(np.searchsorted(recording.imu_stamp, stamp, side="right"))
        part = slice(done, end)
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        done = end
        place = (recording.fix_latitude_deg, recording.fix_longitude_deg, recording.fix_altitude)
        navigator.push_gnss_position(
            stamp, *(float(values[epoch]) for values in place), recording.fix_covariance[epoch], 2, 0
        )
    part = slice(done, len(recording.imu_stamp))
    navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])


def heading_deg(navigator: Navigator) -> float:
    w, x, y, z = navigator.odometry["attitude_body_to_map"][0]
    return math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def test_a_parked_robot_navigates_before_it_moves(parked):
    memory = true_memory(parked)
    assert run(parked, None).status == Status.WAITING_HEADING
    navigator = run(parked, memory)
    assert navigator.status == Status.GOOD
    row = navigator.odometry[0]
    assert abs(math.remainder(heading_deg(navigator) - memory.heading_deg, 360.0)) < 0.5
    # No surer than the floor of the parameter allows, and not vaguer than both together say.
    assert 2.0 <= math.degrees(math.sqrt(row["pose_covariance"][5, 5])) < 2.5
    # Levelled with the remembered bias, the tilt is ten times better than a cold start can say.
    cold = run(parked, None).odometry[0]
    assert row["pose_covariance"][3, 3] < 0.1 * cold["pose_covariance"][3, 3]
    error = row["accel_bias"] - parked.accel_bias[-1]
    assert np.all(np.abs(error) < 4.0 * row["accel_bias_std"])


def test_a_robot_that_was_moved_forgets_its_heading(parked):
    elsewhere = dataclasses.replace(true_memory(parked), latitude_deg=true_memory(parked).latitude_deg + 0.001)
    assert run(parked, elsewhere).status == Status.WAITING_HEADING


def test_a_reset_forgets_the_earlier_run_too(parked):
    """The robot may have turned where it stands."""
    navigator = run(parked, true_memory(parked))
    assert navigator.status == Status.GOOD
    navigator.reset()
    feed(navigator, parked)
    assert navigator.status == Status.WAITING_HEADING


def test_remembered_heading_means_the_same_under_another_datum(parked):
    """East at the robot is not the x axis of a map whose origin is two degrees away."""
    memory = true_memory(parked)
    latitude, longitude, altitude = parked.datum
    navigator = run(parked, memory, datum=[latitude, longitude + 2.0, altitude])
    # The robot's meridian leans towards that of the datum, to the right: its east is turned clockwise in the map.
    convergence = -2.0 * math.sin(math.radians(latitude))
    turned = math.remainder(heading_deg(navigator) - memory.heading_deg, 360.0)
    assert turned == pytest.approx(convergence, abs=0.1)
    assert convergence < -1.0


@pytest.mark.parametrize("name", ["gyro_bias", "accel_bias"])
def test_a_bias_that_the_rest_contradicts_is_dropped(parked, name):
    """The level is then, to the bit, that of a cold start (without fixes: the heading would change what follows)."""
    wrong = dataclasses.replace(true_memory(parked), **{name: (0.0, 0.0, 0.5)})
    found, cold, good = (
        run(parked, memory, **{"gnss.use_position": False}).state for memory in (wrong, None, true_memory(parked))
    )
    assert cold["level_known"][0] == 1
    for field in ("attitude", "accel_bias", "gyro_bias", "covariance"):
        assert np.array_equal(found[field], cold[field])
        assert not np.array_equal(good[field], cold[field])


def test_an_old_memory_is_vaguer(parked):
    navigator = Navigator(from_mapping(parked.parameters()))
    stds = []
    for age in (0.0, HOUR, 1000.0 * HOUR):
        navigator.warm_start(true_memory(parked), age)
        stds.append(float(navigator._settings[0]["remembered_gyro_bias_std"]))
    assert stds[0] < stds[1] < stds[2] <= navigator.parameters.imu.gyro_bias_std


def test_what_a_run_leaves_is_where_it_ended():
    recording = simulate("drive", seed=3, imu_rate=100.0, start=10.0, stop=80.0)
    navigator = Navigator(from_mapping(recording.parameters()))
    assert navigator.memory is None
    feed(navigator, recording)
    memory = navigator.memory
    assert memory is not None
    assert memory.stamp == recording.imu_stamp[-1]
    position = recording.frame.from_geodetic_deg(memory.latitude_deg, memory.longitude_deg, memory.altitude)
    assert np.allclose(position, navigator.odometry["position_map"][0], atol=1e-6)
    assert memory.heading_deg == pytest.approx(heading_deg(navigator), abs=0.05)
    assert memory.gyro_bias == tuple(navigator.odometry["gyro_bias"][0].tolist())


def test_the_file_gives_back_what_was_written(tmp_path, parked):
    memory = true_memory(parked)
    path = tmp_path / "below" / "memory.json"
    assert read_memory(path) is None
    write_memory(path, memory)
    assert read_memory(path) == memory
    assert os.listdir(path.parent) == ["memory.json"]


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path, parked, monkeypatch):
    path = tmp_path / "memory.json"
    write_memory(path, true_memory(parked))
    before = path.read_bytes()

    def fail(descriptor: int) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr("eskf_ros.ros_node.memory.os.fsync", fail)
    with pytest.raises(OSError, match="full"):
        write_memory(path, dataclasses.replace(true_memory(parked), altitude=1.0))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["memory.json"]


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        lambda text: text.replace('"version": 1', '"version": 2'),
        lambda text: text.replace('"altitude"', '"height"'),
        lambda text: text.replace('"position_std": 1.0', '"position_std": NaN'),
        lambda text: text.replace('"position_std": 1.0', '"position_std": "one"'),
        lambda text: text.replace("0.01,\n", "", 1),
        lambda text: "\xff",
    ],
    ids=["cut", "list", "version", "name", "nan", "text", "two numbers", "no json"],
)
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, parked, change):
    path = tmp_path / "memory.json"
    write_memory(path, true_memory(parked))
    changed = change(path.read_text())
    assert changed != path.read_text()
    path.write_text(changed, encoding="latin-1")
    with pytest.raises(ValueError, match=r"memory\.json"):
        read_memory(path)


@pytest.mark.parametrize("content", ["null", "3", '"x"', "true", "[[1]]", "[" * 100_000])
def test_a_file_that_is_no_object_is_named(tmp_path: Path, content):
    path = tmp_path / "memory.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"memory\.json"):
        read_memory(path)


@pytest.mark.parametrize("bad", [None, True, "1", [], [1.0], {}, math.nan, math.inf, 10**400], ids=repr)
@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Memory)])
def test_a_value_of_the_wrong_type_is_named(tmp_path: Path, parked, name, bad):
    """In a field of one number, and as one of the three of a bias."""
    path = tmp_path / "memory.json"
    write_memory(path, true_memory(parked))
    content = json.loads(path.read_text())
    candidates = [bad, [0.1, bad, 0.1]] if isinstance(content[name], list) else [bad]
    for candidate in candidates:
        path.write_text(json.dumps(content | {name: candidate}))
        with pytest.raises(ValueError, match=rf"memory\.json .*: {name} is not"):
            read_memory(path)


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("stamp", 1.5),
        ("gyro_bias", 0.1),
        ("gyro_bias", [0.1, 0.1]),
        ("gyro_bias", [0.1, 0.1, 0.1, 0.1]),
        ("altitude", [1.0, 2.0, 3.0]),
    ],
)
def test_a_value_of_the_wrong_shape_is_named(tmp_path: Path, parked, name, bad):
    path = tmp_path / "memory.json"
    write_memory(path, true_memory(parked))
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: bad}))
    with pytest.raises(ValueError, match=rf"memory\.json .*: {name} is not"):
        read_memory(path)


def test_a_pose_that_is_set_is_where_the_robot_is(parked):
    """Position, heading and their covariance are those given; fixes then pull it back as far as both are trusted."""
    navigator = run(parked, None, **{"imu.mount_position": [0.5, -0.3, 0.8], "imu.mount_rpy_deg": [0.0, 0.0, 90.0]})
    tilt = navigator.odometry["pose_covariance"][0][3:5, 3:5]
    covariance = np.diag([0.04, 0.09, 0.16])
    assert navigator.set_pose((10.0, -20.0, 3.0), covariance, 1.2, 0.05)
    row = navigator.odometry[0]
    assert row["position_map"] == pytest.approx((10.0, -20.0, 3.0), abs=1e-9)
    assert math.radians(heading_deg(navigator)) == pytest.approx(1.2, abs=1e-6)
    # base_link is 0.94 m from the IMU, whose position is known so well: the tilt's error comes on top.
    lever = 0.9 * math.sqrt(max(np.diagonal(tilt)) + 0.05**2)
    assert np.all(np.diagonal(row["pose_covariance"])[:3] >= np.diagonal(covariance) - 1e-12)
    assert np.all(np.diagonal(row["pose_covariance"])[:3] <= np.diagonal(covariance) + lever**2)
    assert math.sqrt(row["pose_covariance"][5, 5]) == pytest.approx(0.05, rel=0.01)
    assert np.linalg.eigvalsh(navigator.state["covariance"][0]).min() > -1e-12


def test_no_pose_before_there_is_a_level_and_a_map(parked):
    navigator = Navigator(from_mapping({**parked.parameters(), "datum": []}))
    assert not navigator.set_pose((0.0, 0.0, 0.0), np.eye(3), 0.0, 1.0)


def test_a_datum_may_be_set_before_the_first_fix(parked):
    navigator = Navigator(from_mapping({**parked.parameters(), "datum": []}))
    latitude, longitude, altitude = parked.datum
    navigator.set_datum(latitude, longitude, altitude)
    feed(navigator, parked)
    assert navigator.datum == pytest.approx(parked.datum, abs=1e-12)
    assert np.allclose(navigator.odometry["position_map"][0], parked.truth_position_map[-1], atol=5.0)


def test_every_verdict_is_told_once_and_without_late_data_it_is_final(parked):
    navigator = Navigator(from_mapping(parked.parameters()))
    told = []
    for epoch, stamp in enumerate(parked.fix_stamp):
        part = (parked.imu_stamp <= stamp + 10_000_000) & (parked.imu_stamp > navigator.state["imu"]["stamp"][0])
        place = (parked.fix_latitude_deg, parked.fix_longitude_deg, parked.fix_altitude)
        navigator.push_gnss_position(
            int(stamp), *(float(values[epoch]) for values in place), parked.fix_covariance[epoch], 2, 0
        )
        assert len(navigator.take_live()) == 0
        assert navigator.waiting == 1
        navigator.push_imu(parked.imu_stamp[part], parked.specific_force[part], parked.angular_rate[part])
        told.append(navigator.take_live())
        assert navigator.waiting == 0
    live, final = np.concatenate(told), navigator.finish()
    assert len(live) == len(parked.fix_stamp)
    assert live.dtype == RECORD
    assert live.tobytes() == final.tobytes()
    assert {Verdict(int(v)) for v in live["verdict"]} == {Verdict.FUSED, Verdict.BEFORE_ALIGNMENT}
