"""The search for an unknown heading: found from accelerations, whichever way the robot moves, or not at all."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from campaign.fault import DEFAULT_POSITION
from campaign.running import recording_of, run_one
from eskf_ros.filter.alignment.heading_search import (
    agrees_with_search,
    begin_search,
    hide_motion,
    is_faster_than,
    note_level,
    predict_search,
    turn_found,
    update_search,
)
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.predict import step
from eskf_ros.filter.state.enums import Status
from eskf_ros.filter.state.time import NEVER
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate
from faults import all_faults
from support.kernels import make_settings, make_state, make_work

DT = 0.01
VELOCITY_STD, POSITION_STD = 0.1, 1.0
LEVER = np.array([0.8, -0.3])
UNTURNED = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Search:
    """The search alone, on a made-up motion in the plane: ``turn`` (rad) leads from its level axes to the map."""

    def __init__(self, seed: int, turn: float, **parameters: Any) -> None:
        self.random = np.random.default_rng(seed)
        self.settings = make_settings(**parameters)
        self.state, self.work = make_state(), make_work()
        self.state["heading_known"] = 0
        note_level(self.state, 0.0, 0.0, UNTURNED, self.settings)
        self.to_map = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        self.position, self.velocity = np.zeros(2), np.zeros(2)
        self.tilt = self.random.normal(0.0, 0.01, 2)
        begin_search(self.state, *self.random.normal(self.to_map @ LEVER, POSITION_STD), POSITION_STD**2 + 1.0)

    def drive(self, acceleration: tuple[float, float], seconds: float, velocity: bool = True) -> None:
        """Accelerate (m/s2, level axes), with a fix every 0.2 s."""
        in_map = self.to_map @ acceleration
        noise = self.settings["accel_noise_density"] / math.sqrt(DT)
        for k in range(round(seconds / DT)):
            self.position += DT * self.velocity + 0.5 * DT**2 * in_map
            self.velocity += DT * in_map
            measured = np.add(acceleration, self.tilt) + self.random.normal(0.0, noise, 2)
            predict_search(self.state, tuple(measured), UNTURNED, DT, self.settings)
            if k % 20 == 19:
                self.fix(0, self.position + self.to_map @ LEVER, POSITION_STD, LEVER)
                if velocity:
                    self.fix(2, self.velocity, VELOCITY_STD, np.zeros(2))

    def fix(self, first: int, true: np.ndarray, std: float, lever: np.ndarray) -> None:
        measured = tuple(self.random.normal(true, std))
        noise = np.diag([std**2, std**2, 1.0])
        update_search(self.state, first, measured, tuple(lever), noise, chi2.ppf(0.9999, 2), self.work)


def error_of(found: float, turn: float) -> float:
    return math.remainder(found - turn, math.tau)


@pytest.mark.parametrize("forward", [1.0, -1.0], ids=["forward", "reverse"])
@pytest.mark.parametrize("turn", [-3.0, -1.0, 0.2, 2.0])
def test_a_pull_away_tells_the_turn_as_well_as_it_says(turn, forward):
    """Normalised error over 40 runs within its chi-square bounds; no direction of travel is preferred."""
    normalised = []
    for seed in range(40):
        search = Search(seed, turn)
        search.drive((1.5 * forward, 0.3), 4.0)
        found, std = turn_found(search.state)
        assert std < math.radians(4.0)
        normalised.append((error_of(found, turn) / std) ** 2)
    assert chi2.ppf(0.001, 40) < sum(normalised) < chi2.ppf(0.999, 40)


def test_position_alone_takes_longer_and_says_so():
    with_velocity, without = Search(1, 1.0), Search(1, 1.0)
    with_velocity.drive((1.0, 0.0), 4.0)
    without.drive((1.0, 0.0), 4.0, velocity=False)
    assert turn_found(without.state)[1] > 2.0 * turn_found(with_velocity.state)[1]
    without.drive((0.0, 0.0), 10.0, velocity=False)
    found, std = turn_found(without.state)
    assert abs(error_of(found, 1.0)) < 4.0 * std
    assert std < math.radians(15.0)


@pytest.mark.parametrize("speed", [0.0, 25.0])
def test_without_acceleration_nothing_is_found(speed):
    for seed in range(20):
        search = Search(seed, 2.0)
        search.velocity = search.to_map @ np.array([speed, 0.0])
        search.drive((0.0, 0.0), 30.0)
        assert turn_found(search.state)[1] == math.inf


def test_the_lever_arm_turns_with_the_heading():
    """A robot turning on the spot about its IMU shows its heading by the way of the antenna."""
    turn = 0.7
    search = Search(1, turn)
    search.tilt[:] = 0.0
    arm = np.array([2.0, 0.0])
    for k in range(600):
        predict_search(search.state, (0.0, 0.0), UNTURNED, DT, search.settings)
        angle = 0.01 * k
        lever = np.array([math.cos(angle) * arm[0], math.sin(angle) * arm[0]])
        if k % 20 == 19:
            search.fix(0, search.to_map @ lever, 0.02, lever)
    found, std = turn_found(search.state)
    assert std < math.radians(2.0)
    assert abs(error_of(found, turn)) < 4.0 * std


def test_a_model_that_does_not_hold_is_not_believed():
    """Accelerations that the IMU reads at half their size: the length of (cos, sin) comes out as two."""
    search = Search(1, 1.0)
    for _ in range(10):
        search.drive((2.0, 0.0), 0.2)
        search.velocity += 2.0 * 0.2 * search.to_map[:, 0]
    assert np.hypot(*search.state["search"]["estimate"][4:6]) > 1.5
    assert turn_found(search.state)[1] == math.inf


def turned(angle: float) -> Any:
    c, s = math.cos(angle), math.sin(angle)
    return ((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))


def test_a_bias_that_the_level_hid_comes_out_as_the_body_turns():
    """Quarter turns on the spot between short drives, levelled again on the way; (cos, sin) and bias stay honest."""
    bias_std, squares, bias_squares = 0.2, [], []
    for seed in range(40):
        search = Search(seed, 1.0)
        bias = search.random.normal(0.0, bias_std, 2)
        angle, hidden = 0.0, bias
        search.tilt[:] = 0.0
        search.state["search"]["started"] = 0
        note_level(search.state, 0.0, bias_std**2, turned(angle), search.settings)
        begin_search(search.state, *search.random.normal(search.to_map @ LEVER, POSITION_STD), POSITION_STD**2)
        for k in range(2400):
            second = k * DT % 6.0
            acceleration = np.array(turned(angle))[:2, 0] * (0.4 if second < 2.0 else -0.4 if second > 4.0 else 0.0)
            if k % 900 == 899:
                hidden = np.array(turned(angle))[:2, :2] @ bias
                note_level(search.state, 0.0, bias_std**2, turned(angle), search.settings)
            search.position += DT * search.velocity
            search.velocity += DT * search.to_map @ acceleration
            noise = search.random.normal(0.0, search.settings["accel_noise_density"] / math.sqrt(DT), 2)
            measured = acceleration + np.array(turned(angle))[:2, :2] @ bias - hidden + noise
            predict_search(search.state, tuple(measured), turned(angle), DT, search.settings)
            angle += DT * math.pi / 2.0 if 2.0 <= second < 3.0 else 0.0
            if k % 20 == 19:
                search.fix(0, search.position + search.to_map @ LEVER, POSITION_STD, LEVER)
        x, p = search.state["search"]["estimate"], search.state["search"]["covariance"]
        off = x[4:6] - search.to_map[:, 0]
        squares.append(off @ np.linalg.solve(p[4:6, 4:6], off))
        # What is added to the measured acceleration: the opposite of the bias.
        off = x[8:10] + search.to_map @ bias
        bias_squares.append(off @ np.linalg.solve(p[8:10, 8:10], off))
        assert np.sqrt(np.diag(p)[8:10]).max() < 0.7 * bias_std
    for found in (squares, bias_squares):
        assert chi2.ppf(1e-4, 80) < sum(found) < chi2.ppf(1.0 - 1e-4, 80), sum(found) / 80


@pytest.mark.parametrize(("name", "start", "stop"), [("field_robot", 7.0, 95.0), ("drive", 60.0, 90.0)])
def test_the_search_stays_honest_for_long(name: str, start: float, stop: float) -> None:
    """Fixes alone, never decided: turns on the spot, slopes, even braking that looks like a tilt at rest."""
    squares = []
    for seed in range(8):
        yaw = float(np.random.default_rng(seed).uniform(-180.0, 180.0))
        mount = (0.0, 0.0, yaw)
        recording = simulate(name, seed, grade="consumer", imu_rate=50.0, start=start, stop=stop, imu_rpy_deg=mount)
        undecided = {"alignment.found_heading_std_deg": 1e-3, "alignment.use_course": False}
        navigator, error = run(recording, velocity=False, **undecided)
        state = navigator.state[0]
        p = state["search"]["covariance"][4:6, 4:6]
        off = state["search"]["estimate"][4:6] - (math.cos(error), -math.sin(error))
        squares.append(off @ np.linalg.solve(p, off))
        assert np.sqrt(np.diag(p)).max() < 0.15
    assert sum(squares) < chi2.ppf(0.9999, 16), squares


def test_a_search_that_sees_a_drive_or_another_turn_contradicts_a_turn_in_place() -> None:
    """As far as it knows: nothing before it has begun, and no velocity right after."""
    variances, turn = (0.01, 0.0, 0.01), 1.0
    search = Search(1, turn)
    assert not is_faster_than(search.state, 0.3)
    assert agrees_with_search(search.state, math.cos(turn + 1.0), math.sin(turn + 1.0), variances)
    search.drive((0.0, 0.0), 10.0)
    assert not is_faster_than(search.state, 0.3)
    search.drive((0.8, 0.3), 4.0)
    assert is_faster_than(search.state, 0.3)
    assert not is_faster_than(search.state, 5.0)
    assert agrees_with_search(search.state, math.cos(turn), math.sin(turn), variances)
    assert not agrees_with_search(search.state, math.cos(turn + 1.0), math.sin(turn + 1.0), variances)
    assert not agrees_with_search(search.state, 1.6 * math.cos(turn), 1.6 * math.sin(turn), variances)
    search.state["search"]["started"] = 0
    assert not is_faster_than(search.state, 0.3)
    assert agrees_with_search(search.state, -math.cos(turn), -math.sin(turn), variances)


@pytest.mark.parametrize("turn_std", [0.05, 0.5, 3.0])
def test_a_hole_in_the_imu_hides_a_turn_from_the_search(turn_std: float) -> None:
    """Mean and covariance of (cos, sin) and velocity are those of as many searches, turned by chance."""
    search = Search(3, 1.0)
    search.drive((0.8, 0.3), 4.0)
    search.drive((-0.2, 0.5), 2.0)
    x, p = search.state["search"]["estimate"].copy(), search.state["search"]["covariance"].copy()
    random = np.random.default_rng(0)
    samples = random.multivariate_normal(x, p, 200_000)
    angles = random.normal(0.0, turn_std, len(samples))
    turned_by = np.exp(1j * angles) * (samples[:, 4] + 1j * samples[:, 5])
    samples[:, 4], samples[:, 5] = turned_by.real, turned_by.imag
    samples[:, 2:4] += random.normal(0.0, 0.5, (len(samples), 2))
    hide_motion(search.state, 0.5**2, turn_std**2)
    found = search.state["search"]
    np.testing.assert_allclose(found["estimate"][:6], samples[:, :6].mean(axis=0), atol=0.01)
    np.testing.assert_allclose(found["covariance"][2:6, 2:6], np.cov(samples[:, 2:6].T), atol=0.01)
    assert np.linalg.eigvalsh(found["covariance"]).min() > 0.0


def test_only_what_a_hole_hides_widens_the_search() -> None:
    search = Search(3, 1.0)
    search.drive((0.8, 0.3), 4.0)
    before = search.state["search"]["covariance"][4:6, 4:6].trace()
    search.state["spot"]["stamp"] = 1
    level, still = (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)
    step(search.state, level, still, level, still, 0.02, 0.0, search.settings, search.work)
    assert search.state["search"]["covariance"][4:6, 4:6].trace() == pytest.approx(before, rel=0.01)
    assert search.state["spot"]["stamp"] == 1
    step(search.state, level, still, level, still, 0.02, 1.6, search.settings, search.work)
    length = np.hypot(*search.state["search"]["estimate"][4:6])
    hidden = (length * float(search.settings["gap_gyro_std"])) ** 2 * 1.6 * 0.02
    found = search.state["search"]["covariance"][4:6, 4:6].trace()
    assert found == pytest.approx(before + hidden, rel=0.05)
    assert search.state["spot"]["stamp"] == NEVER


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["clean: field_robot", "skid-steer", "holes of 1.6 s, dropped: field_robot"])
def test_a_robot_with_positions_alone_is_never_certain_of_a_wrong_heading(name: str, seed: int) -> None:
    """Defaults, and all that a beginner has: it brakes for two seconds as quietly as it then stands.

    With holes, its ways to and fro would pass for the circle of the antenna in a turn in place.
    """
    fault = next(fault for fault in all_faults() if fault.name == name)
    trace = run_one(fault, recording_of(fault, seed), DEFAULT_POSITION)
    known = trace.is_known
    assert (np.abs(trace.heading_error[known]) < 5.0 * trace.heading_sigma[known]).all()
    assert (trace.error < 5.0 * trace.sigma).all()


def heading_of(quaternion: np.ndarray) -> float:
    w, x, y, z = quaternion
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def drive_of(seed: int, yaw_deg: float, **options: Any) -> Recording:
    """Eight seconds at rest, then fifteen of a pull-away, with an IMU mounted at any yaw."""
    return simulate(
        "drive",
        seed=seed,
        grade="consumer",
        imu_rate=100.0,
        start=12.0,
        stop=35.0,
        imu_rpy_deg=(0.0, 0.0, yaw_deg),
        **options,
    )


def run(recording: Recording, velocity: bool = True, **parameters: Any) -> tuple[Navigator, float]:
    """Return the navigator at the end, and its heading error (rad)."""
    navigator = Navigator(from_mapping({**recording.parameters(), **parameters}))
    done = 0
    for epoch, stamp in enumerate(recording.fix_stamp):
        end = int(np.searchsorted(recording.imu_stamp, stamp + 5_000_000, side="right"))
        part = slice(done, end)
        done = end
        place = (recording.fix_latitude_deg, recording.fix_longitude_deg, recording.fix_altitude)
        navigator.push_gnss_position(
            int(stamp), *(float(values[epoch]) for values in place), recording.fix_covariance[epoch], 2, 0
        )
        if velocity:
            navigator.push_gnss_velocity(
                int(stamp), recording.velocity_enu[epoch], recording.velocity_covariance[epoch]
            )
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
    row = navigator.odometry[0]
    true = heading_of(recording.truth_attitude_body_to_map[np.searchsorted(recording.truth_stamp, row["stamp"])])
    return navigator, math.remainder(heading_of(row["attitude_body_to_map"]) - true, math.tau)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("reverse", [False, True], ids=["forward", "reverse"])
def test_any_start_heading_is_found_within_three_degrees(seed, reverse):
    """In reverse: base_link is told the other way round, so that its x axis points backwards."""
    yaw = float(np.random.default_rng(seed).uniform(-180.0, 180.0))
    recording = drive_of(seed, yaw)
    x, y, z = recording.options.lever_arm
    other_way = {"gnss.lever_arm": [-x, -y, z], "imu.mount_rpy_deg": [0.0, 0.0, yaw - 180.0]} if reverse else {}
    navigator, error = run(recording, **other_way)
    assert navigator.status == Status.GOOD
    if reverse:
        error = math.remainder(error - math.pi, math.tau)
    assert abs(error) < math.radians(3.0)
    assert abs(error) < 4.0 * math.sqrt(navigator.odometry["pose_covariance"][0][5, 5])


def test_position_alone_finds_the_heading_too():
    navigator, error = run(drive_of(3, 100.0), velocity=False)
    assert navigator.odometry["heading_known"][0]
    assert abs(error) < 4.0 * math.sqrt(navigator.odometry["pose_covariance"][0][5, 5])


def test_side_slip_is_not_taken_for_heading():
    """base_link turned by 40 degrees: the robot moves like a crab. With or without the use of the course."""
    recording = drive_of(5, 0.0)
    x, y, z = recording.options.lever_arm
    c, s = math.cos(math.radians(40.0)), math.sin(math.radians(40.0))
    crab = {"gnss.lever_arm": [c * x + s * y, -s * x + c * y, z], "imu.mount_rpy_deg": [0.0, 0.0, -40.0]}
    for use_course in (True, False):
        navigator, error = run(recording, **crab, **{"alignment.use_course": use_course})
        assert navigator.odometry["heading_known"][0]
        assert abs(math.remainder(error - math.radians(40.0), math.tau)) < math.radians(3.0)
