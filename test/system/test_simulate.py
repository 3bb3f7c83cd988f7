"""The simulator: truth consistent in itself and with the samples, errors as declared, the same bytes for a seed."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.simulate import main as command
from eskf_ros.simulate.imu import GRADES, ImuMount, SensorErrors, grade_parameters, ideal_interval_means, ideal_samples
from eskf_ros.simulate.scenario import (
    DATUM,
    SCENARIOS,
    Recording,
    scenario,
    simulate,
    trajectory,
)
from support.simulated import (
    FRAME,
    TOPICS,
    antenna_errors,
    assert_chi_square,
    assert_imu_integrates_back,
    read,
    seconds,
)

Array = NDArray[np.float64]

CHECKOUT = Path(__file__).resolve().parents[2]
LEVER_ARM = (0.8, -0.2, 1.4)


# -------------------------------------------------------------------------------------------------------------- IMU


def test_still_imu_feels_gravity_and_the_rotation_of_the_earth() -> None:
    force, rate = ideal_samples(trajectory("tunnel_drive"), FRAME, np.array([0.0, 10.0]))
    # Somigliana at the datum's latitude, reduced to its altitude (0.3086 mGal/m).
    sine2 = math.sin(math.radians(DATUM[0])) ** 2
    gravity = 9.7803253359 * (1.0 + 0.00193185265241 * sine2) / math.sqrt(1.0 - 0.00669437999013 * sine2)
    assert force[0] == pytest.approx([0.0, 0.0, gravity - 3.086e-6 * DATUM[2]], abs=2e-5)
    assert np.linalg.norm(rate, axis=1) == pytest.approx(7.292115e-5, rel=1e-12)
    assert rate[0, 2] == pytest.approx(7.292115e-5 * math.sin(math.radians(DATUM[0])))
    np.testing.assert_array_equal(force[0], force[1])


def test_imu_integrates_back_to_the_truth() -> None:
    """Through a start, turns and a stop, with an IMU mounted off base_link and askew, in the inertial frame."""
    mount = ImuMount((0.7, -0.4, 0.9), (3.0, -5.0, 100.0))
    assert_imu_integrates_back(trajectory("tunnel_drive"), [18.0, 24.0, 30.0, 45.0, 60.0], mount)


def test_interval_mean_is_the_mean() -> None:
    path = trajectory("tunnel_drive")
    times = np.array([25.0, 27.5, 52.0])
    interval = 0.01
    mean = ideal_interval_means(path, FRAME, times, interval)
    fine = np.linspace(-interval, 0.0, 2001)
    for row, t in enumerate(times):
        dense = ideal_samples(path, FRAME, t + fine)
        for quantity in (0, 1):
            trapezoids = 0.5 * (dense[quantity][1:] + dense[quantity][:-1])
            np.testing.assert_allclose(mean[quantity][row], trapezoids.mean(axis=0), atol=1e-8)
    instant = simulate("drive", stop=30.0)
    averaged = simulate("drive", stop=30.0, imu_interval_mean=True)
    # A mean over 5 ms is the value 2.5 ms earlier: a speeding car shows the difference.
    assert np.abs(instant.specific_force - averaged.specific_force).max() > 1e-3


def test_imu_noise_is_white_and_as_strong_as_declared() -> None:
    recording = simulate("drive", seed=5, grade="industrial")
    ideal_force, ideal_rate = ideal_samples(trajectory("drive"), FRAME, seconds(recording.imu_stamp))
    for measured, ideal, bias, sensor in (
        (recording.specific_force, ideal_force, recording.accel_bias, "accel"),
        (recording.angular_rate, ideal_rate, recording.gyro_bias, "gyro"),
    ):
        density = GRADES["industrial"][f"imu.{sensor}_noise_density"]
        noise = (measured - ideal - bias) / (density * math.sqrt(200.0))
        assert_chi_square(noise)
        assert np.abs(noise.mean(axis=0)).max() < 5.0 / math.sqrt(len(noise))
        for lag in (1, 2, 10, 200):
            assert np.abs(np.mean(noise[lag:] * noise[:-lag], axis=0)).max() < 5.0 / math.sqrt(len(noise))
        # Allan deviation of white noise at 1 s: the density itself.
        seconds_mean = (noise * density * math.sqrt(200.0))[: len(noise) // 200 * 200].reshape(-1, 200, 3).mean(axis=1)
        allan = math.sqrt(0.5 * np.mean(np.diff(seconds_mean, axis=0) ** 2))
        assert allan == pytest.approx(density, rel=0.15)


def test_bias_starts_and_walks_as_declared() -> None:
    errors = SensorErrors(noise_density=1e-3, bias_random_walk=2e-4, bias_std=0.03)
    rate, count = 100.0, 2001
    runs = [errors.apply(np.zeros((count, 3)), rate, np.random.SeedSequence(seed))[1] for seed in range(200)]
    biases = np.stack(runs)
    assert_chi_square(biases[:, 0] / 0.03)
    for steps in (1, 100, 2000):
        walked = biases[:, steps] - biases[:, 0]
        assert_chi_square(walked / (2e-4 * math.sqrt(steps / rate)))
    steps_of_one_run = np.diff(biases[0], axis=0)
    assert np.abs(np.mean(steps_of_one_run[1:] * steps_of_one_run[:-1])) < 5.0 * (2e-4**2 / rate) / math.sqrt(3 * count)


def test_scale_factor_and_quantisation_only_when_asked_for() -> None:
    plain = simulate("drive", seed=2, stop=40.0)
    scaled = simulate("drive", seed=2, stop=40.0, accel_scale_std=1e-2)
    ratio = (scaled.specific_force - plain.specific_force)[:, 2] / plain.specific_force[:, 2]
    assert 1e-4 < abs(ratio[0]) < 0.05
    np.testing.assert_allclose(ratio, ratio[0], rtol=0.1)
    np.testing.assert_array_equal(scaled.angular_rate, plain.angular_rate)
    quantised = simulate("drive", seed=2, stop=40.0, gyro_quantum=1e-3)
    np.testing.assert_allclose(quantised.angular_rate * 1e3, np.round(quantised.angular_rate * 1e3), atol=1e-9)
    assert np.abs(quantised.angular_rate - plain.angular_rate).max() <= 0.5e-3 + 1e-12


def test_grades_are_parameters_of_the_estimator() -> None:
    recording = simulate("drive", stop=5.0, grade="consumer")
    tree = from_mapping(recording.parameters())
    assert tree.imu.gyro_noise_density == GRADES["consumer"]["imu.gyro_noise_density"]
    assert tuple(tree.gnss.lever_arm) == LEVER_ARM
    for name, value in GRADES["tactical"].items():
        assert 0.0 < value < GRADES["industrial"][name] < GRADES["consumer"][name]
    with pytest.raises(ValueError, match="consumer, industrial, tactical"):
        grade_parameters("perfect")


# ------------------------------------------------------------------------------------------------------------- GNSS


def test_gnss_errors_are_as_their_covariance_says() -> None:
    recording = simulate("drive", seed=3)
    position_error, velocity_error = antenna_errors(recording.name, recording, LEVER_ARM)
    for error, covariance in (
        (position_error, recording.fix_covariance),
        (velocity_error, recording.velocity_covariance),
    ):
        matrices = covariance.reshape(-1, 3, 3)
        normalized = error / np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
        assert_chi_square(normalized)
        for axis in range(3):
            assert_chi_square(normalized[:, axis])
        assert np.abs(np.mean(normalized[1:] * normalized[:-1], axis=0)).max() < 5.0 / math.sqrt(len(error))
    # Without the lever arm the same check fails, so it does see it: in position and, in turns, in velocity.
    position_off, velocity_off = antenna_errors(recording.name, recording, (0.0, 0.0, 0.0))
    assert np.sum(position_off**2) > 1.5 * np.sum(position_error**2)
    turning = np.abs(trajectory("drive").motion(seconds(recording.fix_stamp)).angular_rate_body[:, 2]) > 0.3
    assert turning.sum() > 50
    assert np.sum(velocity_off[turning] ** 2) > 1.5 * np.sum(velocity_error[turning] ** 2)


def test_gnss_arrives_late_and_in_order() -> None:
    recording = simulate("drive", seed=4)
    np.testing.assert_array_equal(recording.fix_stamp, recording.velocity_stamp)
    np.testing.assert_array_equal(np.diff(recording.fix_stamp), 200_000_000)
    latency = (recording.fix_arrival - recording.fix_stamp) * 1e-9
    assert 0.08 <= latency.min() < 0.085
    assert 0.195 < latency.max() <= 0.2
    after = (recording.velocity_arrival - recording.fix_arrival) * 1e-9
    assert 0.0 < after.min() < after.max() <= 0.002
    fast = simulate("drive", seed=4, gnss_rate=20.0, stop=60.0)
    assert (np.diff(fast.fix_arrival) >= 0).all()
    assert (np.diff(fast.imu_arrival) >= 0).all()
    delay = (fast.imu_arrival - fast.imu_stamp) * 1e-9
    assert 0.0 < delay.min() < delay.max() < 0.002


# -------------------------------------------------------------------------------------------------------- scenarios


def test_tunnel_drive_is_what_it_says() -> None:
    recording = simulate("tunnel_drive")
    t = seconds(recording.truth_stamp)
    speed = np.linalg.norm(recording.truth_velocity_map, axis=1)
    assert 180.0 < t[-1] < 240.0
    assert (speed[t < 20.0] == 0.0).all()
    (tunnel,) = recording.outages
    assert tunnel[1] - tunnel[0] == 45.0
    assert speed[(t > tunnel[0]) & (t < tunnel[1])].min() > 14.0
    fixes = seconds(recording.fix_stamp)
    assert not ((fixes >= tunnel[0]) & (fixes <= tunnel[1])).any()
    assert np.diff(fixes).max() == pytest.approx(45.2)
    moving = np.concatenate([[False], speed > 0.01, [False]])
    assert np.count_nonzero(np.diff(moving.astype(int)) == -1) == 3
    yaw_rate = recording.truth_angular_rate_body[:, 2]
    assert np.count_nonzero(np.diff((np.abs(yaw_rate) > 0.05).astype(int)) == 1) >= 8
    assert recording.options.lever_arm == LEVER_ARM
    np.testing.assert_array_equal(np.diff(recording.imu_stamp), 5_000_000)


def test_truth_lies_on_imu_stamps_whatever_the_rates() -> None:
    for imu_rate, truth_rate, expected in ((200.0, 50.0, 50.0), (125.0, 50.0, 125.0 / 3.0), (30.0, 50.0, 30.0)):
        recording = simulate("drive", stop=30.0, imu_rate=imu_rate, truth_rate=truth_rate)
        assert np.isin(recording.truth_stamp, recording.imu_stamp).all()
        assert len(recording.truth_stamp) == pytest.approx(30.0 * expected, abs=1.0)
        assert len(recording.imu_stamp) == 30.0 * imu_rate


def test_a_part_of_a_scenario_has_the_truth_of_the_whole() -> None:
    whole, part = simulate("drive"), simulate("drive", start=40.0, stop=60.0)
    assert seconds(part.imu_stamp)[[0, -1]] == pytest.approx([40.005, 60.0])
    there = np.isin(whole.truth_stamp, part.truth_stamp)
    np.testing.assert_array_equal(whole.truth_position_map[there], part.truth_position_map)
    assert np.isin(part.fix_stamp, whole.fix_stamp).all()
    with pytest.raises(ValueError, match="start 50 and stop 40"):
        simulate("drive", start=50.0, stop=40.0)


# ------------------------------------------------------------------------------------------------------ determinism


def random_arrays(recording: Recording) -> dict[str, NDArray[Any]]:
    names = (
        "specific_force angular_rate accel_bias gyro_bias imu_arrival fix_arrival fix_latitude_deg fix_longitude_deg "
        "fix_altitude velocity_arrival velocity_enu"
    )
    return {name: getattr(recording, name) for name in names.split()}


def test_same_seed_same_bytes_and_another_seed_differs_everywhere() -> None:
    first, again, other = (random_arrays(simulate("drive", seed=seed, stop=60.0)) for seed in (7, 7, 8))
    for name, array in first.items():
        assert array.tobytes() == again[name].tobytes(), name
        assert array.tobytes() != other[name].tobytes(), name


def test_one_sensor_does_not_change_the_numbers_of_another() -> None:
    base = simulate("tunnel_drive", seed=9)
    for options in ({"gnss_rate": 2.0}, {"outages": ()}, {"position_std": (3.0, 5.0)}, {"lever_arm": (0.0, 0.0, 0.0)}):
        changed = simulate("tunnel_drive", seed=9, **options)
        np.testing.assert_array_equal(changed.specific_force, base.specific_force)
        np.testing.assert_array_equal(changed.angular_rate, base.angular_rate)
    graded = simulate("tunnel_drive", seed=9, grade="tactical")
    np.testing.assert_array_equal(graded.fix_latitude_deg, base.fix_latitude_deg)
    np.testing.assert_array_equal(graded.fix_arrival, base.fix_arrival)
    # An outage removes messages and leaves all others as they were.
    without_tunnel = simulate("tunnel_drive", seed=9, outages=())
    there = np.isin(without_tunnel.fix_stamp, base.fix_stamp)
    assert there.sum() == len(base.fix_stamp) == len(there) - 225
    np.testing.assert_array_equal(without_tunnel.fix_altitude[there], base.fix_altitude)
    np.testing.assert_array_equal(without_tunnel.velocity_enu[there], base.velocity_enu)


def test_seeds_of_one_scenario_share_the_truth() -> None:
    first, second = simulate("drive", seed=1), simulate("drive", seed=2)
    assert first.truth_position_map is second.truth_position_map
    assert first.imu_stamp is second.imu_stamp


def test_options_are_checked() -> None:
    with pytest.raises(ValueError, match="drive, tunnel_drive, hour_drive"):
        simulate("flight")
    with pytest.raises(ValueError, match="imu_rate must be a positive"):
        simulate("drive", imu_rate=0.0)
    with pytest.raises(TypeError, match="gnss_frequency"):
        simulate("drive", gnss_frequency=5.0)


# ---------------------------------------------------------------------------------------------------------- command


def test_command_writes_a_recording_with_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.mcap"
    assert command.main(["drive", "--seed", "3", "--imu-rate", "100", "--out", str(path)]) == 0
    printed = capsys.readouterr().out
    assert f"{path}: drive, seed 3, 28" in printed
    assert "gnss.lever_arm: [0.8, -0.2, 1.4]" in printed
    recording = simulate("drive", 3, imu_rate=100.0)
    content = read(path, TOPICS)

    log, imu, frames = content["imu/data"]
    assert frames == [["imu_link"]]
    np.testing.assert_array_equal(log, recording.imu_arrival)
    np.testing.assert_array_equal(imu["stamp"], recording.imu_stamp)
    np.testing.assert_array_equal(imu["linear_acceleration"], recording.specific_force)
    np.testing.assert_array_equal(imu["angular_velocity"], recording.angular_rate)
    assert (imu["orientation_covariance"][:, 0] == -1.0).all()

    log, fix, frames = content["gps/fix"]
    assert frames == [["gps"]]
    np.testing.assert_array_equal(log, recording.fix_arrival)
    np.testing.assert_array_equal(fix["latitude"], recording.fix_latitude_deg)
    np.testing.assert_array_equal(fix["position_covariance"], recording.fix_covariance)
    assert (fix["status"] >= 0).all()
    assert (fix["position_covariance_type"] == 2).all()

    log, velocity, _ = content["gps/vel"]
    np.testing.assert_array_equal(log, recording.velocity_arrival)
    np.testing.assert_array_equal(velocity["linear_velocity"], recording.velocity_enu)
    covariance = velocity["twist_covariance"].reshape(-1, 6, 6)[:, :3, :3].reshape(-1, 9)
    np.testing.assert_array_equal(covariance, recording.velocity_covariance)


def test_truth_of_the_recording_is_of_base_link_in_the_earth_frame() -> None:
    _, truth, frames = read(CHECKOUT / "bags" / "tunnel_drive.mcap", TOPICS)["truth"]
    assert frames == [["earth"], ["base_link"]]
    t = seconds(truth["stamp"])
    motion = trajectory("tunnel_drive").motion(t)
    expected = np.stack(pymap3d.enu2ecef(*motion.position_map.T, *DATUM), axis=-1)
    np.testing.assert_allclose(truth["position"], expected, atol=1e-6)
    # The twist in base_link, turned by the orientation, is the derivative of the ECEF position.
    body_to_ecef = Rotation.from_quat(truth["orientation"])
    velocity = body_to_ecef.apply(truth["linear_velocity"])
    moved = np.gradient(truth["position"], t, axis=0)
    np.testing.assert_allclose(velocity[1:-1], moved[1:-1], atol=5e-3)
    assert np.abs(velocity).max() > 10.0
    turned = (body_to_ecef[:-2].inv() * body_to_ecef[2:]).as_rotvec() / (t[2:] - t[:-2])[:, None]
    np.testing.assert_allclose(truth["angular_velocity"][1:-1], turned, atol=2e-3)
    # Up in the body is up at the datum, first of all.
    latitude, longitude = math.radians(DATUM[0]), math.radians(DATUM[1])
    up = [math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude), math.sin(latitude)]
    np.testing.assert_allclose(body_to_ecef[0].apply([0.0, 0.0, 1.0]), up, atol=1e-9)


def test_bundled_recording_is_what_the_command_makes(tmp_path: Path) -> None:
    path = tmp_path / "tunnel_drive.mcap"
    assert command.main(["tunnel_drive", "--truth-rate", "20", "--quiet", "--out", str(path)]) == 0
    made, bundled = read(path, TOPICS), read(CHECKOUT / "bags" / "tunnel_drive.mcap", TOPICS)
    for topic in TOPICS:
        np.testing.assert_array_equal(made[topic][0], bundled[topic][0])
        assert made[topic][2] == bundled[topic][2]
        for name in made[topic][1].dtype.names or ():
            if name in ("frame_id", "child_frame_id"):
                continue
            # Sine and cosine may differ in the last digit between processors: 1e-9 m of 6400 km, and nothing else.
            np.testing.assert_allclose(made[topic][1][name], bundled[topic][1][name], rtol=1e-13, atol=4e-9)
    again = tmp_path / "again" / path.name
    again.parent.mkdir()
    assert command.main(["tunnel_drive", "--truth-rate", "20", "--quiet", "--out", str(again)]) == 0
    assert again.read_bytes() == path.read_bytes()


def test_configuration_of_the_bundled_recording_describes_its_sensors() -> None:
    tree = load(CHECKOUT / "config" / "tunnel_drive.yaml")
    truth = from_mapping({k: v for k, v in simulate("tunnel_drive").parameters().items() if k != "datum"})
    assert dataclasses.asdict(tree.imu) == dataclasses.asdict(truth.imu)
    assert dataclasses.asdict(tree.gnss) == dataclasses.asdict(truth.gnss)


def test_mistakes_cost_one_line_and_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected in (
        (["flight"], "unknown scenario 'flight'; there are drive, tunnel_drive, hour_drive"),
        ([], "name a scenario: drive, tunnel_drive, hour_drive"),
        (["drive", "--imu-rate", "-1"], "imu_rate must be a positive number of Hz, not -1.0"),
        (["drive", "--out", str(tmp_path / "none" / "a.mcap")], "there is no folder"),
    ):
        assert command.main(arguments) == 2
        printed = capsys.readouterr()
        assert expected in printed.err
        assert printed.err.count("\n") == 1
        assert not printed.out
    for arguments in (["drive", "--grade", "perfect"], ["drive", "--seed", "-1"]):
        with pytest.raises(SystemExit) as caught:
            command.main(arguments)
        assert caught.value.code == 2
    assert not list(tmp_path.iterdir())


def test_list_describes_the_scenarios(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--list"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed and found.description in printed for name, found in SCENARIOS.items())
    with pytest.raises(ValueError, match="unknown scenario"):
        scenario("flight")


def test_interrupted_run_leaves_no_half_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"an older recording")

    def interrupted(self: object, *_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("eskf_ros.bags.BagWriter.close", interrupted)
    assert command.main(["drive", "--out", str(path)]) == 130
    assert path.read_bytes() == b"an older recording"
    assert list(tmp_path.iterdir()) == [path]
    assert "interrupted" in capsys.readouterr().err
