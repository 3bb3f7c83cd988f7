"""The parts of the calibration: coarse mounting, roll, noise, information of several recordings, what is refused."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibration import tables_of
from eskf_ros.calibration.coarse_mounting import coarse_mounting
from eskf_ros.calibration.combine import combine
from eskf_ros.calibration.constants import CONSTANTS, as_states, begin_stds, changed, constants_of, places_of
from eskf_ros.calibration.findings import Calibration, Finding, findings_of
from eskf_ros.calibration.noise import rest_and_road
from eskf_ros.calibration.recording import Pass
from eskf_ros.calibration.report import parameter_file
from eskf_ros.calibration.roll import ROW_RATE, Roll, roll_of
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.settings import settings_from
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.parameters.mapping import from_mapping, to_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.parameters.tree import Parameters
from eskf_ros.simulate.scenario import simulate

Array = NDArray[np.float64]

UNKNOWN_ROLL = Roll((math.nan, math.nan), (math.nan, math.nan))
NOISE = {"imu.gyro_noise_density": 2e-4, "imu.accel_noise_density": 2e-3}
"""Of the simulated consumer IMU."""


def drive(**options: Any) -> dict[str, Any]:
    return tables_of(simulate("drive", 3, grade="consumer", imu_rate=50.0, stop=120.0, **options))


def a_pass(correction: Any, covariance: Array, prior_std: Array, nis: float = 1.0) -> Pass:
    return Pass(np.asarray(correction, float), covariance, prior_std, {"gnss_position": nis}, UNKNOWN_ROLL, 0)


@pytest.mark.parametrize("seed", range(4))
def test_coarse_mounting_is_found_from_any_orientation(seed: int) -> None:
    mount = Rotation.random(random_state=seed)
    coarse = coarse_mounting(drive(imu_rpy_deg=tuple(mount.as_euler("xyz", degrees=True))))
    assert coarse is not None
    assert math.degrees((coarse.rotation.inv() * mount).magnitude()) < 3.0
    assert abs(coarse.lag) < 0.06


def test_coarse_mounting_finds_late_velocities() -> None:
    tables = drive()
    tables["gnss_velocity"]["stamp"] = tables["gnss_velocity"]["stamp"] + 300_000_000
    coarse = coarse_mounting(tables)
    assert coarse is not None
    assert coarse.lag == pytest.approx(0.3, abs=0.051)


@pytest.mark.parametrize("scenario", ["parked", "motorway"])
def test_who_does_not_accelerate_shows_no_mounting(scenario: str) -> None:
    assert coarse_mounting(tables_of(simulate(scenario, 1, imu_rate=50.0, stop=90.0))) is None


def test_recordings_add_up_to_least_squares_over_all() -> None:
    """Three linear recordings: the same mean and covariance as one least squares with the prior once."""
    rng = np.random.default_rng(4)
    prior_std, moved, truth = np.array([1.0, 0.01, 5.0]), np.array([0.3, -0.002, 1.0]), np.array([0.5, 0.004, -2.0])
    prior = np.diag(prior_std**-2.0)
    information, vector, passes = prior.copy(), -prior @ moved, []
    for count in (4, 5, 6):
        design = rng.normal(size=(count, 3)) / prior_std
        measured = design @ (truth - moved) + rng.normal(size=count)
        covariance = np.linalg.inv(design.T @ design + prior)
        passes.append(a_pass(covariance @ design.T @ measured, covariance, prior_std))
        information += design.T @ design
        vector += design.T @ measured
    combined = combine(passes, moved, prior_std)
    np.testing.assert_allclose(combined.covariance, np.linalg.inv(information), rtol=1e-9)
    np.testing.assert_allclose(combined.correction, np.linalg.solve(information, vector), rtol=1e-9)


def test_recordings_that_contradict_each_other_are_told() -> None:
    prior_std, covariance = np.array([1.0]), np.array([[1e-4]])
    apart = combine([a_pass([value], covariance, prior_std) for value in (-0.1, 0.1)], np.zeros(1), prior_std)
    assert apart.spread[0] == pytest.approx(math.sqrt(200.0), rel=1e-3)
    alone = combine([a_pass([0.1], covariance, prior_std)], np.zeros(1), prior_std)
    assert alone.spread[0] == 1.0


def test_another_base_link_leaves_imu_and_antenna_where_they_are() -> None:
    given = {
        "imu.mount_rpy_deg": [20.0, -10.0, 70.0],
        "imu.mount_position": [0.2, 0.1, 0.3],
        "gnss.lever_arm": [1.0, -0.5, 1.2],
        "heading.mount_rpy_deg": [0.0, 5.0, 90.0],
    }
    before = from_mapping(given)
    corrections = {"mounting_roll": 0.02, "mounting_pitch": -0.03, "mounting_yaw": 0.1}
    corrections |= {"lever_arm_x": 0.0, "heading_offset": 0.0}
    after = changed(before, corrections)
    to_old = Rotation.from_euler("xyz", before.imu.mount_rpy_deg, degrees=True)
    to_new = Rotation.from_euler("xyz", after.imu.mount_rpy_deg, degrees=True)
    # The vehicle's axes in the old base_link: yaw, then pitch, then roll.
    vehicle_to_old = Rotation.from_euler("ZYX", [0.1, -0.03, 0.02])
    assert (to_new.inv() * vehicle_to_old.inv() * to_old).magnitude() < 1e-9
    arms = [
        turn.inv().apply(np.subtract(parameters.gnss.lever_arm, parameters.imu.mount_position))
        for turn, parameters in ((to_old, before), (to_new, after))
    ]
    np.testing.assert_allclose(arms[1], arms[0], atol=1e-9)
    lines = [
        turn.inv() * Rotation.from_euler("xyz", parameters.heading.mount_rpy_deg, degrees=True)
        for turn, parameters in ((to_old, before), (to_new, after))
    ]
    assert (lines[0].inv() * lines[1]).magnitude() < 1e-9
    assert changed(before, {"mounting_yaw": 0.1}).heading == before.heading


def test_each_constant_is_a_state_of_its_own() -> None:
    constants = constants_of({"gnss_position", "gnss_velocity", "wheel", "heading"}, True)
    assert constants == CONSTANTS
    first_std = begin_stds(constants, np.array([constant.prior_std for constant in constants]))
    states = as_states(Parameters(), constants, True, first_std)
    places = places_of(states, constants)
    np.testing.assert_allclose(settings_from(states)[0]["optional_std"][np.array(places) - ERROR_SIZE], first_std)
    assert len(set(places)) == len(places)
    assert min(places) >= ERROR_SIZE
    assert {c.name for c in constants_of({"gnss_position"}, False)} == {
        *(f"lever_arm_{axis}" for axis in "xyz"),
        "time_offset",
        *(f"{sensor}_scale_{axis}" for sensor in ("accel", "gyro") for axis in "xyz"),
    }


def rows_in_turns(roll: float, camber: float, lean: float) -> NDArray[Any]:
    """A vehicle that turns left and right on a cambered road and leans out; base_link is rolled against it."""
    rows = np.zeros(3000, ODOMETRY)
    time = np.arange(3000) / ROW_RATE
    yaw_rate = 0.3 * np.sign(np.sin(time / 5.0)) * (np.sin(time / 2.5) > 0.0)
    rows["heading_known"], rows["velocity_map"][:, 0] = True, 8.0
    outwards = lean * 8.0 * yaw_rate
    rows["angular_rate_body"][:, 1] = yaw_rate * np.sin(roll + outwards)
    rows["angular_rate_body"][:, 2] = yaw_rate * np.cos(roll)
    attitude = Rotation.from_euler("ZYX", np.stack([0.0 * time, 0.0 * time, camber + roll + outwards], axis=1))
    rows["attitude_body_to_map"] = np.roll(attitude.as_quat(), 1, axis=1)
    return rows


def test_turns_tell_the_roll_whatever_the_camber_and_the_springs() -> None:
    roll = roll_of(rows_in_turns(math.radians(2.0), math.radians(1.0), 0.01))
    assert math.degrees(roll.by_turns[0]) == pytest.approx(2.0, abs=0.05)
    assert math.degrees(roll.by_road[0]) == pytest.approx(3.0, abs=0.05)
    assert math.degrees(roll.joint[0]) < 2.5
    straight = rows_in_turns(0.0, 0.02, 0.0)
    straight["angular_rate_body"] = 0.0
    assert math.isnan(roll_of(straight).by_turns[0])
    assert not roll_of(straight[:50]).is_known


def test_noise_is_that_of_the_imu_at_rest_and_on_the_road() -> None:
    rest, road = rest_and_road(tables_of(simulate("drive", 3, grade="consumer", imu_rate=100.0, stop=200.0)))
    assert rest is not None
    assert road is not None
    for density in (rest, road):
        assert density.gyro == pytest.approx(NOISE["imu.gyro_noise_density"], rel=0.2)
        assert density.accel == pytest.approx(NOISE["imu.accel_noise_density"], rel=0.25)


def judged(covariance: Array) -> dict[str, Finding]:
    constants = CONSTANTS[:3]
    prior_std = np.array([constant.prior_std for constant in constants])
    one = a_pass([0.5, 0.0, 0.0], covariance, prior_std, nis=4.0)
    combined = combine([one], np.zeros(3), prior_std)
    current = changed(Parameters(), {"lever_arm_x": 0.5})
    return {
        finding.name: finding for finding in findings_of(constants, Parameters(), current, combined, [one], np.zeros(3))
    }


def test_what_the_motion_did_not_show_is_refused_with_the_motion_that_would() -> None:
    found = judged(np.diag([0.02, 0.03, 0.8]) ** 2)
    assert [found[f"lever_arm_{axis}"].is_shown for axis in "xyz"] == [True, True, False]
    assert "roll and pitch" in found["lever_arm_z"].text
    assert found["lever_arm_x"].value == 0.5
    # Innovations twice as large as they should be: so are the sigmas.
    assert found["lever_arm_x"].std == pytest.approx(0.04, rel=1e-3)


def test_what_was_not_told_apart_is_refused() -> None:
    covariance = np.diag([0.2, 0.2, 0.03]) ** 2
    covariance[0, 1] = covariance[1, 0] = 0.99 * 0.04
    found = judged(covariance)
    assert [found[f"lever_arm_{axis}"].is_shown for axis in "xyz"] == [False, False, True]
    assert "lever_arm_y" in found["lever_arm_x"].text


def test_the_file_is_one_the_node_takes(tmp_path: Path) -> None:
    before = from_mapping({"topics.imu": "/imu", "imu.accel_bias_std": 0.4})
    after = changed(before, {"lever_arm_x": 0.7654321, "mounting_yaw": 0.3, "mounting_pitch": 0.01})
    findings = [
        Finding("lever_arm_x", "gnss.lever_arm", 0, 0.0, 0.7654321, 0.01, "m", True, "sigma 0.01 m"),
        Finding("time_offset", "gnss.time_offset", None, 0.0, 0.1, 0.2, "s", False, "not shown: it takes braking"),
    ]
    text = parameter_file(Calibration(before, after, findings, {}, ["a.mcap"], 3, []))
    path = tmp_path / "found.yaml"
    path.write_text(text, encoding="utf-8")
    for name, value in to_mapping(load(path)).items():
        expected = to_mapping(after)[name]
        if isinstance(expected, tuple | float) and np.all(np.isfinite(expected)):
            np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-12, err_msg=name)
    assert "# lever_arm_x: sigma 0.01 m" in text
    assert "# time_offset: not shown" in text
    assert "gnss.time_offset:" not in text


def test_all_refused_is_still_a_file_the_node_takes(tmp_path: Path) -> None:
    path = tmp_path / "nothing.yaml"
    path.write_text(parameter_file(Calibration(Parameters(), Parameters(), [], {}, ["a"], 1, [])), encoding="utf-8")
    assert dataclasses.asdict(load(path)) is not None


def test_allan_deviation_finds_noise_and_random_walk() -> None:
    pytest.importorskip("allantools")
    from eskf_ros.calibration.static import parameters_of, static_noise

    rng, rate, seconds = np.random.default_rng(1), 50.0, 7200
    count = int(rate * seconds)
    density, walk = np.array([2e-3] * 3 + [2e-4] * 3), np.array([3e-4] * 3 + [2e-5] * 3)
    bias = np.cumsum(rng.normal(size=(count, 6)) * walk / math.sqrt(rate), axis=0)
    readings = bias + rng.normal(size=(count, 6)) * density * math.sqrt(rate)
    stamp = 10**18 + np.round(np.arange(count) / rate * 1e9).astype(np.int64)
    noise = static_noise({"stamp": stamp, "specific_force": readings[:, :3], "angular_rate": readings[:, 3:]})
    assert noise.warnings == []
    found = parameters_of(noise)
    assert found["imu.gyro_noise_density"][0] == pytest.approx(2e-4, rel=0.15)
    assert found["imu.accel_noise_density"][0] == pytest.approx(2e-3, rel=0.15)
    # The worst of three axes, each known to a third.
    assert found["imu.gyro_bias_random_walk"][0] == pytest.approx(2.6e-5, rel=0.4)
    assert found["imu.accel_bias_random_walk"][0] == pytest.approx(3.9e-4, rel=0.4)


def test_an_imu_that_was_touched_is_told() -> None:
    pytest.importorskip("allantools")
    from eskf_ros.calibration.static import static_noise

    rng = np.random.default_rng(2)
    readings = rng.normal(size=(6000, 6))
    readings[3000:3100, 0] += 5.0
    stamp = 10**18 + np.arange(6000, dtype=np.int64) * 20_000_000
    table = {"stamp": stamp, "specific_force": readings[:, :3], "angular_rate": readings[:, 3:]}
    assert "60 s after the start" in static_noise(table).warnings[0]
    with pytest.raises(ValueError, match="too short"):
        static_noise({name: column[:1000] for name, column in table.items()})
