"""Jacobian, innovation and noise of every aid, near the datum and far from it, at any attitude."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray

from eskf_ros.filter.measurements import gnss_position, gnss_velocity
from eskf_ros.geodesy.earth import EARTH_RATE
from support.kernels import copy_of, make_settings, make_work, random_covariance, random_state, to_rotation, with_error

Array = NDArray[np.float64]

PERTURBATION = np.repeat([1.0, 1.0, 1e-5, 0.1, 1e-2], 3)
LEVER_ARM = (0.8, -0.2, 1.4)
MOUNT = {"imu__mount_position": [0.3, 0.1, -0.2], "imu__mount_rpy_deg": [10.0, -20.0, 130.0]}
SETTINGS = make_settings(gnss__lever_arm=list(LEVER_ARM), **MOUNT)
LONG_ARM = make_settings(gnss__lever_arm=[25.0, -12.0, 8.0], **MOUNT)

places = pytest.mark.parametrize("far", [0.0, 50e3, 500e3])
seeds = pytest.mark.parametrize("seed", range(5))


def payload_of(first: Any, covariance: Array) -> Array:
    return np.array([*first, *covariance[np.triu_indices(3)]])


def geodetic_of(state: Any) -> tuple[float, float, float]:
    """Return latitude, longitude (rad), altitude (m) of the body, by pymap3d."""
    ecef = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ state["position_map"]
    latitude, longitude, altitude = pymap3d.ecef2geodetic(*ecef, deg=False)
    return float(latitude), float(longitude), float(altitude)


def local_axes_in_map(state: Any, latitude: float, longitude: float) -> Array:
    """Return east, north and up at a place as columns in map axes, by pymap3d."""
    columns = [pymap3d.enu2ecefv(*unit, latitude, longitude, deg=False) for unit in np.eye(3)]
    return np.asarray(state["frame"]["map_to_ecef"].T @ np.array(columns, dtype=float).T)


def numerical_jacobian(aid: ModuleType, state: Any, settings: Any) -> Array:
    """Differentiate the prediction by the error of the state, q_true = dq(theta) q."""
    jacobian = np.empty((3, 15))
    for j in range(15):
        error = PERTURBATION[j] * np.eye(15)[j]
        plus, minus = (np.array(aid.predict(with_error(state, k * error), 0, settings)) for k in (1.0, -1.0))
        jacobian[:, j] = (plus - minus) / (2.0 * PERTURBATION[j])
    return jacobian


def example(seed: int, far: float) -> tuple[Any, Array]:
    state = random_state(seed, far)
    return state, random_covariance(seed, [1.0, 0.7, 2.0])


@places
@seeds
@pytest.mark.parametrize("settings", [SETTINGS, LONG_ARM], ids=["short", "long"])
def test_jacobian_of_position(seed: int, far: float, settings: Any) -> None:
    state, covariance = example(seed, far)
    work = make_work()
    assert gnss_position.linearize(state, payload_of(geodetic_of(state), covariance), 0, settings, work) == 3
    # Differences of coordinates of 500 km round at 1e-10 m over the step of 1e-5 rad.
    expected = numerical_jacobian(gnss_position, state, settings)
    np.testing.assert_allclose(work["jacobian"][:, :15], expected, rtol=0.0, atol=1e-8 + 4e-11 * far)


@places
@seeds
@pytest.mark.parametrize("settings", [SETTINGS, LONG_ARM], ids=["short", "long"])
def test_jacobian_of_velocity(seed: int, far: float, settings: Any) -> None:
    """All columns: velocity, attitude through the lever arm and through the Earth rate, gyro bias."""
    state, covariance = example(seed, far)
    work = make_work()
    assert gnss_velocity.linearize(state, payload_of((3.0, -4.0, 0.5), covariance), 0, settings, work) == 3
    expected = numerical_jacobian(gnss_velocity, state, settings)
    np.testing.assert_allclose(work["jacobian"][:, :15], expected, rtol=0.0, atol=3e-9)


def test_earth_rate_is_in_the_velocity_jacobian() -> None:
    """A body at rest on the Earth: what is left of the attitude columns is the Earth rate's part alone."""
    state, covariance = example(1, 0.0)
    turn = to_rotation(state["attitude"])
    state["angular_rate"] = state["gyro_bias"] + turn.inv().apply(state["frame"]["earth_rate_map"])
    work = make_work()
    gnss_velocity.linearize(state, payload_of((0.0, 0.0, 0.0), covariance), 0, LONG_ARM, work)
    np.testing.assert_allclose(gnss_velocity.predict(state, 0, LONG_ARM), state["velocity_map"], rtol=0.0, atol=1e-14)
    part = work["jacobian"][:, 6:9]
    assert np.abs(part).max() > 0.1 * EARTH_RATE * np.linalg.norm(LONG_ARM["lever_arms_body"][0])
    expected = numerical_jacobian(gnss_velocity, state, LONG_ARM)[:, 6:9]
    np.testing.assert_allclose(part, expected, rtol=0.0, atol=2e-9)


@places
@seeds
def test_innovation_of_position(seed: int, far: float) -> None:
    """A fix of the antenna, its coordinates by pymap3d, 3 m off: the innovation is the 3 m."""
    state, covariance = example(seed, far)
    lever_arm = np.array(SETTINGS["lever_arms_body"][0])
    antenna = state["position_map"] + to_rotation(state["attitude"]).apply(lever_arm)
    off = np.array([1.0, -2.0, 2.0])
    ecef = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ (antenna + off)
    # pymap3d's inverse is too coarse; one step with its forward function sharpens it.
    geodetic = np.array([float(value) for value in pymap3d.ecef2geodetic(*ecef, deg=False)])
    for _ in range(3):
        miss = ecef - np.array(pymap3d.geodetic2ecef(*geodetic, deg=False), dtype=float)
        east, north, up = np.array(pymap3d.ecef2enuv(*miss, geodetic[0], geodetic[1], deg=False), dtype=float)
        radius = 6.37e6
        geodetic += (north / radius, east / radius / math.cos(geodetic[0]), up)
    work = make_work()
    gnss_position.linearize(state, payload_of(geodetic, covariance), 0, SETTINGS, work)
    np.testing.assert_allclose(work["innovation"], off, rtol=0.0, atol=2e-8)


@places
@seeds
def test_innovation_of_velocity(seed: int, far: float) -> None:
    """East, north and up of the place of the robot, not of the datum; the rate is free of bias and of Earth rate."""
    state, covariance = example(seed, far)
    turn = to_rotation(state["attitude"])
    rate = state["angular_rate"] - state["gyro_bias"] - turn.inv().apply(state["frame"]["earth_rate_map"])
    antenna = state["velocity_map"] + turn.apply(np.cross(rate, SETTINGS["lever_arms_body"][0]))
    latitude, longitude, _ = geodetic_of(state)
    off = np.array([0.1, -0.2, 0.3])
    axes = local_axes_in_map(state, latitude, longitude)
    work = make_work()
    gnss_velocity.linearize(state, payload_of(axes.T @ (antenna + off), covariance), 0, SETTINGS, work)
    np.testing.assert_allclose(work["innovation"], off, rtol=0.0, atol=1e-7)


def test_lever_arm_is_from_the_imu_in_its_axes() -> None:
    """The parameter is the antenna in base_link; the filter's own arm starts at the IMU and has its axes."""
    state = random_state(3)
    imu_to_base = np.array(SETTINGS["imu_to_base"])
    base_to_map = to_rotation(state["attitude"]).as_matrix() @ imu_to_base.T
    base = state["position_map"] - base_to_map @ np.array(MOUNT["imu__mount_position"])
    np.testing.assert_allclose(
        gnss_position.predict(state, 0, SETTINGS), base + base_to_map @ np.array(LEVER_ARM), rtol=0.0, atol=1e-12
    )


@places
@seeds
def test_noise_is_turned_to_map_axes(seed: int, far: float) -> None:
    state, covariance = example(seed, far)
    latitude, longitude, altitude = geodetic_of(state)
    axes = local_axes_in_map(state, latitude, longitude)
    work = make_work()
    gnss_position.linearize(state, payload_of((latitude, longitude, altitude), covariance), 0, SETTINGS, work)
    np.testing.assert_allclose(work["noise"], axes @ covariance @ axes.T, rtol=0.0, atol=1e-7)

    gnss_velocity.linearize(state, payload_of((1.0, 2.0, 3.0), covariance), 0, SETTINGS, work)
    arm = np.array(SETTINGS["lever_arms_body"][0])
    cross = np.array([[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]])
    sway = to_rotation(state["attitude"]).as_matrix() @ cross
    rate_variance = SETTINGS["gyro_noise_density"] ** 2 / state["imu"]["interval"]
    expected = axes @ covariance @ axes.T + rate_variance * sway @ sway.T
    np.testing.assert_allclose(work["noise"], expected, rtol=0.0, atol=1e-7)


@seeds
def test_unknown_heading_leaves_the_lever_arm_to_the_noise(seed: int) -> None:
    state, covariance = example(seed, 0.0)
    payload = payload_of(geodetic_of(state), covariance)
    work, known = make_work(), make_work()
    arm = to_rotation(state["attitude"]).apply(SETTINGS["lever_arms_body"][0])
    gnss_position.linearize(state, payload, 0, SETTINGS, known)
    state["heading_known"] = 0
    gnss_position.linearize(state, payload, 0, SETTINGS, work)
    assert (work["jacobian"][:, :15] == np.eye(3, 15)).all()
    extra = work["noise"] - known["noise"]
    np.testing.assert_allclose(extra, np.diag([1.0, 1.0, 0.0]) * (arm[0] ** 2 + arm[1] ** 2), rtol=0.0, atol=1e-12)
    gnss_velocity.linearize(state, payload, 0, SETTINGS, work)
    assert (work["jacobian"][:, :15] == np.eye(3, 15, 3)).all()


@seeds
@pytest.mark.parametrize("aid", [gnss_position, gnss_velocity], ids=["position", "velocity"])
def test_linearizing_changes_nothing_but_the_work(seed: int, aid: ModuleType) -> None:
    state, covariance = example(seed, 100.0)
    before = copy_of(state)
    payload = payload_of(geodetic_of(state), covariance)
    work = make_work()
    work["jacobian"] = 7.0
    work["noise"] = 7.0
    aid.linearize(state, payload, 0, SETTINGS, work)
    once = work.copy()
    aid.linearize(state, payload, 0, SETTINGS, work)
    assert state.tobytes() == before.tobytes()
    for name in ("jacobian", "noise", "innovation"):
        np.testing.assert_array_equal(work[name], once[name])
