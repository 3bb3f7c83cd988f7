"""Magnetometer and Imu.orientation: Jacobian, the model of the Earth's field, honest sigma, iron and disturbances."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from test_aiding import geodetic_of, local_axes_in_map

from eskf_ros.filter.measurements import mag
from eskf_ros.filter.state import augmented_states
from eskf_ros.filter.state.enums import Status, Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.geodesy import magnetic_model
from eskf_ros.geodesy.magnetic_model import FieldUnknown, field_at
from eskf_ros.simulate.dual_antenna import DualAntenna
from eskf_ros.simulate.episodes import MagneticDisturbance
from eskf_ros.simulate.magnetometer import Magnetometer
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import START_STAMP, simulate
from monte_carlo import feed, nees, run
from support.aided import AidedNavigator, run_aided
from support.kernels import Array, copy_of, make_settings, make_work, random_covariance, random_state, with_error

SECOND = 1_000_000_000
MOUNT = {"mag__mount_rpy_deg": [20.0, 30.0, -50.0], "imu__mount_rpy_deg": [10.0, -20.0, 130.0]}
SETTINGS = make_settings(estimate__magnetic_bias=True, **MOUNT)
ERROR, IRON = int(SETTINGS["mag_error_at"]), int(SETTINGS["magnetic_bias_at"])
DECLINATION, INCLINATION, STRENGTH = math.radians(-17.0), math.radians(58.0), 48e-6

# What the simulated magnetometer measures, where no library tells it.
FIELD = {"mag__use": True, "mag__declination_deg": 4.3}

seeds = pytest.mark.parametrize("seed", range(5))
places = pytest.mark.parametrize("far", [0.0, 50e3, 500e3])


def installed() -> bool:
    try:
        field_at(48.0, 11.0, 500.0, START_STAMP)
    except FieldUnknown:
        return False
    return True


needs_model = pytest.mark.skipif(not installed(), reason="pygeomag is not installed")


def in_the_field(seed: int, far: float, with_model: bool = True) -> tuple[Any, Array]:
    """Return a running filter in a magnetic field and the payload of an error-free reading, by way of pymap3d."""
    state = random_state(seed, far)
    augmented_states.update_error_size(state, SETTINGS["reach"][Stream.MAG], SETTINGS)
    rng = np.random.default_rng(seed)
    state["optional"][ERROR - ERROR_SIZE] = rng.normal(0.0, 0.05)
    state["optional"][IRON - ERROR_SIZE : IRON - ERROR_SIZE + 3] = rng.normal(0.0, 3e-6, 3)
    state["mag"]["declination"], state["mag"]["inclination"] = DECLINATION, INCLINATION
    state["mag"]["strength"] = STRENGTH if with_model else 0.0
    state["mag"]["field_known"] = 1
    # The error turns the field clockwise: the angle from east that is measured is larger by it.
    angle = 0.5 * math.pi - DECLINATION + state["optional"][ERROR - ERROR_SIZE]
    level = math.cos(INCLINATION)
    local = STRENGTH * np.array([level * math.cos(angle), level * math.sin(angle), -math.sin(INCLINATION)])
    in_map = local_axes_in_map(state, *geodetic_of(state)[:2]) @ local
    w, x, y, z = state["attitude"]
    base = Rotation.from_euler("xyz", MOUNT["imu__mount_rpy_deg"], degrees=True).apply(
        Rotation.from_quat([x, y, z, w]).inv().apply(in_map)
    )
    sensor = Rotation.from_euler("xyz", MOUNT["mag__mount_rpy_deg"], degrees=True).inv().apply(base)
    sensor = sensor + state["optional"][IRON - ERROR_SIZE : IRON - ERROR_SIZE + 3]
    covariance = random_covariance(seed, [0.3e-6, 0.5e-6, 0.4e-6])
    return state, np.array([*sensor, *covariance[np.triu_indices(3)], *np.zeros(7)])


# ------------------------------------------------------------------------------------------------ the measurement


@places
@seeds
@pytest.mark.parametrize("with_model", [True, False])
def test_jacobian(seed: int, far: float, with_model: bool) -> None:
    state, payload = in_the_field(seed, far, with_model)
    work = make_work()
    assert mag.linearize(state, payload, SETTINGS, work) == 1
    expected = np.zeros(work["jacobian"].shape[1])

    def difference(plus: Any, minus: Any, step: float) -> float:
        return (mag.predict(plus, payload, SETTINGS) - mag.predict(minus, payload, SETTINGS)) / (2.0 * step)

    for j in range(6, 9):
        error = 1e-5 * np.eye(15)[j]
        expected[j] = difference(with_error(state, error), with_error(state, -error), 1e-5)
    for j, step in ((ERROR, 1e-5), *((IRON + k, 1e-10) for k in range(3))):
        plus, minus = copy_of(state), copy_of(state)
        plus["optional"][j - ERROR_SIZE] += step
        minus["optional"][j - ERROR_SIZE] -= step
        expected[j] = difference(plus, minus, step)
    np.testing.assert_allclose(work["jacobian"][0], expected, rtol=1e-5, atol=1e-6)
    assert np.linalg.norm(expected[6:9]) > 1.5


@places
@seeds
def test_the_field_points_to_magnetic_north(seed: int, far: float) -> None:
    """At the place of the robot, with the error, the hard iron and the declination in their signs."""
    state, payload = in_the_field(seed, far)
    work = make_work()
    mag.linearize(state, payload, SETTINGS, work)
    assert work["innovation"][0] == pytest.approx(0.0, abs=1e-8)
    turned = with_error(state, 0.01 * np.eye(15)[8])
    mag.linearize(turned, payload, SETTINGS, work)
    assert work["innovation"][0] < -0.005


@seeds
def test_its_noise_is_that_of_the_angle(seed: int) -> None:
    state, payload = in_the_field(seed, 0.0)
    rng = np.random.default_rng(seed)
    covariance = np.zeros((3, 3))
    covariance[np.triu_indices(3)] = payload[3:9]
    covariance = covariance + np.triu(covariance, 1).T
    angles = []
    for noise in rng.multivariate_normal(np.zeros(3), covariance, 2000):
        noisy = payload.copy()
        noisy[:3] += noise
        angles.append(mag.predict(state, noisy, SETTINGS))
    work = make_work()
    mag.linearize(state, payload, SETTINGS, work)
    assert np.std(np.unwrap(angles)) == pytest.approx(math.sqrt(work["noise"][0, 0]), rel=0.08)


def test_where_the_field_is_upright_it_tells_no_heading() -> None:
    state, payload = in_the_field(1, 0.0)
    up = np.array([0.0, 0.0, -50e-6])
    w, x, y, z = state["attitude"]
    payload[:3] = np.array(SETTINGS["mag"]["sensor_to_imu"]).T @ Rotation.from_quat([x, y, z, w]).inv().apply(up)
    payload[:3] += state["optional"][IRON - ERROR_SIZE : IRON - ERROR_SIZE + 3]
    assert mag.linearize(state, payload, SETTINGS, make_work()) == 0


@pytest.mark.parametrize("way", [(0.0, 0.0), (3.0, 0.05), (30.0, 0.0), (0.0, 0.7), (400.0, 2.0)])
def test_the_error_changes_with_the_way_and_keeps_its_variance(way: tuple[float, float]) -> None:
    state, _ = in_the_field(2, 0.0)
    std = SETTINGS["optional_std"][ERROR - ERROR_SIZE]
    state["mag"]["position"], state["mag"]["heading"] = state["position_map"], 3.1
    state["covariance"][ERROR, 0] = state["covariance"][0, ERROR] = 0.01
    before = float(state["optional"][ERROR - ERROR_SIZE])
    state["position_map"][0] += way[0]
    mag.propagate_mag_error(state, math.remainder(3.1 + way[1], math.tau), SETTINGS)
    length = way[0] / SETTINGS["mag"]["error_distance"] + way[1]
    remaining = math.exp(-length) if length > 0.2 else 1.0
    assert state["optional"][ERROR - ERROR_SIZE] == pytest.approx(before * remaining)
    assert state["covariance"][ERROR, 0] == state["covariance"][0, ERROR] == pytest.approx(0.01 * remaining)
    assert state["covariance"][ERROR, ERROR] == pytest.approx(std**2)


# ------------------------------------------------------------------------------------------------------ the model


@needs_model
@pytest.mark.parametrize(
    ("latitude", "longitude", "declination", "inclination", "microtesla"),
    [(48.1, 11.6, 4.2, 64.4, 48.7), (-22.9, -43.2, -23.0, -42.8, 23.1), (35.7, 139.7, -8.0, 49.7, 46.7)],
    ids=["Munich", "Rio de Janeiro", "Tokyo"],
)
def test_field_of_places(
    latitude: float, longitude: float, declination: float, inclination: float, microtesla: float
) -> None:
    found = field_at(latitude, longitude, 100.0, START_STAMP)
    np.testing.assert_allclose(np.degrees(found[:2]), (declination, inclination), atol=0.5)
    assert found[2] == pytest.approx(microtesla * 1e-6, rel=0.02)


@needs_model
def test_field_has_no_large_steps_and_knows_the_past() -> None:
    across = [field_at(48.0 + k / 37.0, 11.0, 500.0, START_STAMP)[0] for k in range(100)]
    assert 0.0 < np.degrees(np.abs(np.diff(across)).max()) < 0.05
    years = [field_at(48.0, 11.0, 500.0, round((2010.5 + k - 1970.0) * 31_556_952e9))[0] for k in range(20)]
    # From one edition of the model to the next it changes by a little more or less than by the years.
    assert 0.1 < np.degrees(np.diff(years)).mean() < 0.2
    assert np.degrees(np.abs(np.diff(years)).max()) < 0.3


def test_stamps_without_a_date_are_named() -> None:
    with pytest.raises(FieldUnknown, match=r"1970.*mag\.declination_deg"):
        field_at(48.0, 11.0, 500.0, 3 * SECOND)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygeomag", None)
    for cached in (magnetic_model._model, magnetic_model._field_of_cell):
        cached.cache_clear()
    with pytest.raises(FieldUnknown, match=r"pip install pygeomag, or set mag\.declination_deg"):
        field_at(48.0, 11.0, 500.0, START_STAMP)
    recording = simulate("parked", 1, imu_rate=50.0, stop=10.0, magnetometer=Magnetometer(rate=10.0))
    navigator = AidedNavigator(recording, mag__use=True)
    run_through(recording, navigator)
    assert navigator.status == Status.WAITING_HEADING
    assert [sentence for sentence in navigator.complaints if "pygeomag" in sentence]
    records = navigator.finish()
    assert set(records["verdict"][records["stream"] == Stream.MAG]) == {Verdict.BEFORE_ALIGNMENT}


# -------------------------------------------------------------------------------------------------- start and sigma


def run_through(recording: Recording, navigator: AidedNavigator) -> None:
    for _ in feed(recording, navigator, np.array([len(recording.imu_stamp) - 1])):
        pass


def test_it_is_used_only_where_asked_for() -> None:
    recording = simulate("parked", 1, imu_rate=50.0, stop=10.0, magnetometer=Magnetometer(rate=10.0))
    navigator = AidedNavigator(recording)
    run_through(recording, navigator)
    records = navigator.finish()
    assert set(records["verdict"][records["stream"] == Stream.MAG]) == {Verdict.DISABLED}
    assert navigator.status == Status.WAITING_HEADING


def test_a_parked_robot_gets_a_heading_as_good_as_iron_leaves_it() -> None:
    """Hard iron of a degree or two that nobody estimates: for five minutes the sigma does not shrink below it."""
    yaw, attitude = [], []
    sensor = Magnetometer(hard_iron_std=1.5e-6, rpy_deg=(180.0, 0.0, 90.0), rate=5.0)
    for seed in range(8):
        recording = simulate("parked", seed, imu_rate=50.0, stop=120.0, magnetometer=sensor)
        result = run_aided(recording, **FIELD)
        known = result.aligned
        assert result.seconds[known][0] < 7.0
        sigma = np.degrees(np.sqrt(result.covariance[known, 8, 8]))
        assert 3.0 < sigma[-1] <= sigma[0] < 4.5
        yaw.append(nees(result.error[known], result.covariance[known], slice(8, 9))[-1])
        # Thousands of noisy readings drag neither tilt nor biases.
        attitude.append(nees(result.error[known], result.covariance[known], slice(6, 9))[-1])
    assert sum(yaw) < chi2.ppf(0.999, 8)
    assert sum(attitude) < chi2.ppf(0.999, 24)


@pytest.mark.parametrize("name", ["multirotor", "drive"])
def test_hard_iron_is_found_while_turning_and_the_covariance_is_honest(name: str) -> None:
    attitude, iron = [], []
    for seed in range(3):
        sensor = Magnetometer(hard_iron_std=3e-6, rate=5.0)
        recording = simulate(name, seed, imu_rate=50.0, stop=130.0, magnetometer=sensor)
        navigator = AidedNavigator(
            recording,
            **FIELD,
            mag__error_std_deg=1.0,
            estimate__magnetic_bias=True,
            alignment__use_course=False,
        )
        result = run(recording, navigator)
        state, place = navigator.state[0], int(navigator._settings["magnetic_bias_at"][0])
        covariance = state["covariance"][place : place + 3, place : place + 3]
        assert recording.magnetometer is not None
        off = recording.magnetometer.hard_iron - state["optional"][place - ERROR_SIZE : place - ERROR_SIZE + 3]
        iron.append(off @ np.linalg.solve(covariance, off))
        # The level axes of the robot.
        assert np.sqrt(np.diag(covariance))[:2].max() < 1.5e-6
        known = result.aligned
        attitude.append(nees(result.error[known], result.covariance[known], slice(6, 9)).mean())
        records = result.records[(result.records["stream"] == Stream.MAG) & (result.records["dof"] > 0)]
        # The sigma of the error that remains besides hard iron, of which the simulated sensor has none, is part of it.
        assert 0.6 < records["nis"].mean() < 1.2
    assert sum(iron) < chi2.ppf(0.9999, 9), iron
    assert 1.0 < np.mean(attitude) < 6.0, attitude


def test_a_better_sensor_goes_first() -> None:
    recording = simulate(
        "parked", 1, imu_rate=50.0, stop=12.0, dual_antenna=DualAntenna(rate=1.0), magnetometer=Magnetometer(rate=50.0)
    )
    navigator = AidedNavigator(recording, **FIELD)
    run_through(recording, navigator)
    records = navigator.finish()
    known = [records["stamp"][(records["stream"] == s) & (records["verdict"] == Verdict.FUSED)][0] for s in (3, 4)]
    assert known[0] <= known[1]
    assert navigator.odometry["pose_covariance"][0, 5, 5] < math.radians(0.3) ** 2


# ------------------------------------------------------------------------------------------------- what goes wrong


@needs_model
@pytest.mark.parametrize("strength", [12e-6, 40e-6])
def test_a_disturbed_field_is_not_used(strength: float) -> None:
    """Ten seconds beside a steel door: refused by strength or inclination, and the heading stays what it was."""
    episode = MagneticDisturbance(20.0, 10.0, field=(strength, 0.0, 0.3 * strength))
    recording = simulate(
        "parked", 2, imu_rate=50.0, stop=40.0, magnetometer=Magnetometer(rate=10.0), episodes=(episode,)
    )
    result = run_aided(recording, mag__use=True)
    records = result.records[result.records["stream"] == Stream.MAG]
    seconds = (records["stamp"] - START_STAMP) * 1e-9
    during = (seconds > 20.0) & (seconds < 30.0)
    assert set(records["verdict"][during]) == {Verdict.GATE}
    assert np.mean(records["verdict"][seconds > 32.0] == Verdict.FUSED) > 0.95
    yaw = result.error[result.seconds > 19.0, 8]
    assert np.ptp(np.degrees(yaw)) < 1.0


@needs_model
def test_a_disturbed_field_starts_nothing() -> None:
    episode = MagneticDisturbance(0.0, 12.0, field=(30e-6, 0.0, 0.0))
    recording = simulate(
        "parked", 2, imu_rate=50.0, stop=20.0, magnetometer=Magnetometer(rate=10.0), episodes=(episode,)
    )
    result = run_aided(recording, mag__use=True)
    assert result.seconds[result.aligned][0] > 12.9
    assert abs(result.error[-1, 8]) < 3.5 * math.sqrt(result.covariance[-1, 8, 8])


def test_wrong_axes_are_named() -> None:
    """North-east-down as if it were forward-left-up; with the model the field dips to the wrong side, too."""
    recording = simulate("parked", 2, imu_rate=50.0, stop=25.0, magnetometer=Magnetometer(rate=10.0))
    navigator = AidedNavigator(
        recording, **FIELD, mag__mount_rpy_deg=[180.0, 0.0, 0.0], alignment__initial_heading_deg=-75.0
    )
    run_through(recording, navigator)
    words = "dips by" if installed() else "magnetometer differ"
    assert [sentence for sentence in navigator.complaints if words in sentence and "mag.mount_rpy_deg" in sentence]


# ------------------------------------------------------------------------------------------------ Imu.orientation


@pytest.mark.parametrize("north", ["true_north", "magnetic_north"])
def test_the_orientation_of_the_imu_may_start_the_filter(north: str) -> None:
    """Mounted upside down and askew; from magnetic north it is 20 degrees off, which the declination takes back."""
    mount, declination = (180.0, 10.0, 140.0), 20.0
    recording = simulate("parked", 3, imu_rate=50.0, stop=12.0, imu_rpy_deg=mount)
    navigator = AidedNavigator(
        recording,
        alignment__imu_orientation=north,
        alignment__imu_orientation_std_deg=8.0,
        mag__declination_deg=declination,
    )
    own_error = 5.0 + (declination if north == "magnetic_north" else 0.0)
    truth = Rotation.from_quat(np.roll(recording.truth_attitude_body_to_map[0], -1))
    imu = truth * Rotation.from_euler("xyz", mount, degrees=True)
    told = (Rotation.from_euler("z", own_error, degrees=True) * imu).as_quat()
    for begin in range(0, len(recording.imu_stamp), 10):
        stamps = recording.imu_stamp[begin : begin + 10]
        navigator.push_imu_orientation(stamps, np.tile(told, (10, 1)), np.zeros((10, 9)))
        before = stamps[0] - SECOND // 50
        for row in np.flatnonzero((recording.fix_stamp > before) & (recording.fix_stamp <= stamps[-1])):
            place = recording.fix_latitude_deg[row], recording.fix_longitude_deg[row], recording.fix_altitude[row]
            navigator.push_gnss_position(
                int(recording.fix_stamp[row]), *map(float, place), recording.fix_covariance[row], 2, 0
            )
        part = slice(begin, begin + 10)
        navigator.push_imu(stamps, recording.specific_force[part], recording.angular_rate[part])
    row = navigator.odometry[0]
    assert row["heading_known"]
    x, y, z = np.roll(row["attitude_body_to_map"], -1)[:3]
    yaw = Rotation.from_quat([x, y, z, row["attitude_body_to_map"][0]]).as_euler("ZYX", degrees=True)[0]
    assert yaw == pytest.approx(-75.0 + 5.0, abs=1.0)
    assert 7.0 < math.degrees(math.sqrt(row["pose_covariance"][5, 5])) < 8.5


@pytest.mark.parametrize("variance", [1000.0, math.pi**2, 1.01])
def test_an_orientation_that_is_unknown_tells_no_heading(variance: float) -> None:
    """Drivers say with a large variance that they do not know the yaw."""
    recording = simulate("parked", 3, imu_rate=50.0, stop=10.0)
    navigator = AidedNavigator(recording, alignment__imu_orientation="true_north")
    count = len(recording.imu_stamp)
    covariance = np.tile(np.diag([0.01, 0.01, variance]).ravel(), (count, 1))
    navigator.push_imu_orientation(recording.imu_stamp, np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), covariance)
    run_through(recording, navigator)
    assert navigator.status == Status.WAITING_HEADING


def test_an_orientation_nobody_asked_for_is_not_used() -> None:
    recording = simulate("parked", 3, imu_rate=50.0, stop=10.0)
    navigator = AidedNavigator(recording)
    count = len(recording.imu_stamp)
    navigator.push_imu_orientation(recording.imu_stamp, np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), np.zeros((count, 9)))
    run_through(recording, navigator)
    assert navigator.status == Status.WAITING_HEADING
    assert not (navigator.finish()["stream"] == Stream.HEADING).any()
