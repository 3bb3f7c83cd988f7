"""Pose and twist of base_link: an IMU mounted off its origin and turned against it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.filter.output.global_odometry import ODOMETRY, status_of, write_odometry
from eskf_ros.filter.output.local_odometry import LOCAL
from eskf_ros.filter.state.enums import Status
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER
from support.kernels import (
    USUAL_STDS,
    core,
    make_settings,
    random_covariance,
    random_state,
    to_rotation,
    with_error,
)

Array = NDArray[np.float64]

MOUNT_POSITION = (0.9, -0.4, 0.7)
MOUNT_RPY_DEG = (170.0, -35.0, 60.0)
MOUNTED = make_settings(imu__mount_position=list(MOUNT_POSITION), imu__mount_rpy_deg=list(MOUNT_RPY_DEG))
TURNED_ONLY = make_settings(imu__mount_rpy_deg=list(MOUNT_RPY_DEG))

ARM = [0.8, -0.3, 1.2]

seeds = pytest.mark.parametrize("seed", range(5))

PERTURBATION = np.repeat([1e-2, 1e-2, 1e-5, 1e-2, 1e-4], 3)


def published(state: Any, settings: Any) -> Any:
    row = allocate(ODOMETRY)[0]
    write_odometry(state, allocate(LOCAL)[0], settings, row)
    return row


def running(seed: int) -> Any:
    state = random_state(seed, far=100.0)
    core(state)[:] = random_covariance(seed, USUAL_STDS)
    state["recovery"]["absolute_stamp"] = 0
    return state


def pose_of_base(state: Any) -> tuple[Array, Rotation]:
    """Return position and attitude of base_link from those of the IMU by the mounting."""
    base = to_rotation(state["attitude"]) * Rotation.from_euler("xyz", MOUNT_RPY_DEG, degrees=True).inv()
    return state["position_map"] - base.apply(MOUNT_POSITION), base


def twist_of_base(state: Any, mount_position: Any) -> Array:
    """Return linear and angular velocity of base_link relative to the Earth in its own axes."""
    imu = to_rotation(state["attitude"])
    mount = Rotation.from_euler("xyz", MOUNT_RPY_DEG, degrees=True)
    rate = mount.apply(state["angular_rate"] - state["gyro_bias"] - imu.inv().apply(state["frame"]["earth_rate_map"]))
    linear = mount.apply(imu.inv().apply(state["velocity_map"])) - np.cross(rate, mount_position)
    return np.concatenate([linear, rate])


@seeds
def test_pose_and_twist_of_base_link(seed: int) -> None:
    state = running(seed)
    row = published(state, MOUNTED)
    position, attitude = pose_of_base(state)
    np.testing.assert_allclose(row["position_map"], position, rtol=0.0, atol=1e-12)
    w, x, y, z = row["attitude_body_to_map"]
    # w first: scipy has it last.
    assert (Rotation.from_quat([x, y, z, w]).inv() * attitude).magnitude() < 1e-14
    assert w >= 0.0
    twist = twist_of_base(state, MOUNT_POSITION)
    np.testing.assert_allclose(row["velocity_body"], twist[:3], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(row["angular_rate_body"], twist[3:], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(row["velocity_map"], attitude.apply(twist[:3]), rtol=0.0, atol=1e-12)


def test_quaternion_order_by_example() -> None:
    """An IMU on an upright robot that faces north: 90 degrees about up, w and z."""
    state = running(0)
    state["attitude"] = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    row = published(state, make_settings())
    np.testing.assert_allclose(row["attitude_body_to_map"], (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)), atol=1e-15)


@seeds
def test_pose_covariance_against_numerical_differentiation(seed: int) -> None:
    """Errors of base_link, fixed map axes, by differences of the pose that the true state has."""
    state = running(seed)
    position, attitude = pose_of_base(state)
    jacobian = np.empty((6, 15))
    for j in range(15):
        ends = []
        for sign in (1.0, -1.0):
            true_position, true_attitude = pose_of_base(with_error(state, sign * PERTURBATION[j] * np.eye(15)[j]))
            turn = (true_attitude * attitude.inv()).as_rotvec()
            ends.append(np.concatenate([true_position - position, turn]))
        jacobian[:, j] = (ends[0] - ends[1]) / (2.0 * PERTURBATION[j])
    expected = jacobian @ core(state) @ jacobian.T
    covariance = published(state, MOUNTED)["pose_covariance"]
    np.testing.assert_allclose(covariance, expected, rtol=0.0, atol=1e-8)
    assert (covariance == covariance.T).all()


def twist_jacobian(state: Any, mount_position: Any) -> Array:
    jacobian = np.empty((6, 15))
    for j in range(15):
        error = PERTURBATION[j] * np.eye(15)[j]
        plus, minus = (twist_of_base(with_error(state, k * error), mount_position) for k in (1.0, -1.0))
        jacobian[:, j] = (plus - minus) / (2.0 * PERTURBATION[j])
    return jacobian


def expected_twist_covariance(state: Any, mount_position: Any, settings: Any) -> Array:
    """Without what the rate's own error adds to the velocity over the mounting offset, and Earth rate times tilt."""
    jacobian = twist_jacobian(state, mount_position)
    jacobian[:3, 12:15] = 0.0
    jacobian[3:, 6:9] = 0.0
    expected = jacobian @ core(state) @ jacobian.T
    expected[:3, 3:] = expected[3:, :3] = 0.0
    expected[3:, 3:] += settings["gyro_noise_density"] ** 2 / state["imu"]["interval"] * np.eye(3)
    return np.asarray(expected)


@seeds
def test_twist_covariance_of_a_turned_imu(seed: int) -> None:
    state = running(seed)
    expected = expected_twist_covariance(state, (0.0, 0.0, 0.0), TURNED_ONLY)
    covariance = published(state, TURNED_ONLY)["twist_covariance"]
    # 1e-6 of a velocity variance: the Earth rate.
    np.testing.assert_allclose(covariance, expected, rtol=0.0, atol=1e-6)
    assert (covariance == covariance.T).all()


@seeds
def test_twist_covariance_of_an_imu_off_the_origin(seed: int) -> None:
    """omega x offset is known in body axes whatever the attitude: the error is R' (dv + v_imu x theta)."""
    state = running(seed)
    expected = expected_twist_covariance(state, MOUNT_POSITION, MOUNTED)
    covariance = published(state, MOUNTED)["twist_covariance"]
    np.testing.assert_allclose(covariance, expected, rtol=0.0, atol=1e-6)


@seeds
def test_what_faults_of_the_installation_do_is_published_as_if_the_state_had_that_error(seed: int) -> None:
    """One vector d of errors adds d d' to the covariance of the core."""
    state, other = running(seed), running(seed)
    effect = np.random.default_rng(seed).normal(size=15) * np.sqrt(np.diag(core(state)))
    effect[9:] = 0.0
    core(other)[:] += np.outer(effect, effect)
    state["installation"]["considered"][1] = effect
    before = published(state, MOUNTED)
    state["installation"]["is_considered"][1] = 1
    row, expected = published(state, MOUNTED), published(other, MOUNTED)
    assert not np.allclose(before["pose_covariance"], row["pose_covariance"])
    for name in ("pose_covariance", "twist_covariance"):
        np.testing.assert_allclose(row[name][:3, :3], expected[name][:3, :3], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(row["pose_covariance"], expected["pose_covariance"], rtol=1e-9, atol=1e-12)


@seeds
def test_an_unknown_heading_leaves_the_place_about_the_antenna_unknown(seed: int) -> None:
    """What is added is the mean square over all headings of the distance to the base_link of the published one."""
    settings = make_settings(
        imu__mount_position=list(MOUNT_POSITION), imu__mount_rpy_deg=list(MOUNT_RPY_DEG), gnss__lever_arm=ARM
    )
    state = running(seed)
    state["heading_known"] = 0
    core(state)[8, 8] = math.pi**2
    row = published(state, settings)
    w, x, y, z = row["attitude_body_to_map"]
    arm = Rotation.from_quat([x, y, z, w]).apply(ARM)
    turns = Rotation.from_euler("z", np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)[:, None])
    moved = turns.apply(arm) - arm
    expected = core(state)[:3, :3] + 0.5 * (moved[:, :2] ** 2).sum(axis=1).mean() * np.diag([1.0, 1.0, 0.0])
    np.testing.assert_allclose(row["pose_covariance"][:3, :3], expected, rtol=1e-9, atol=1e-12)


@seeds
def test_clocks_that_are_apart_leave_the_way_of_that_time_unknown(seed: int) -> None:
    state = running(seed)
    before = published(state, MOUNTED)
    state["motion"]["turns"]["lag"] = 1.2
    row = published(state, MOUNTED)
    way = 1.2 * row["velocity_map"]
    added = row["pose_covariance"] - before["pose_covariance"]
    np.testing.assert_allclose(added[:3, :3], np.outer(way, way), rtol=1e-9, atol=1e-9)
    assert not added[3:].any()


@seeds
def test_fixes_that_have_jumped_and_are_believed_may_be_off_by_the_jump(seed: int) -> None:
    """It fades with time, and nothing is added while they are refused and the estimate has stayed where it was."""
    state = running(seed)
    before = published(state, MOUNTED)["pose_covariance"]
    motion = state["motion"]
    motion["jumps"], motion["offset"], motion["offset_stamp"] = 1, (12.0, -9.0), state["stamp"]
    added = published(state, MOUNTED)["pose_covariance"] - before
    np.testing.assert_allclose(added[:2, :2], np.outer((12.0, -9.0), (12.0, -9.0)), rtol=1e-9, atol=1e-9)
    assert not added[2:].any()
    motion["offset_stamp"] = state["stamp"] - round(60e9)
    later = published(state, MOUNTED)["pose_covariance"] - before
    np.testing.assert_allclose(later, added * np.exp(-2.0), rtol=1e-9, atol=1e-9)
    state["trust"]["refused"][0, 0] = 1
    state["trust"]["refused_innovation"][0, 0, :2] = np.exp(-1.0) * np.array([12.0, -9.0])
    np.testing.assert_array_equal(published(state, MOUNTED)["pose_covariance"], before)


@seeds
def test_biases_are_in_imu_axes(seed: int) -> None:
    state = running(seed)
    row = published(state, MOUNTED)
    np.testing.assert_array_equal(row["accel_bias"], state["accel_bias"])
    np.testing.assert_array_equal(row["gyro_bias"], state["gyro_bias"])
    stds = np.sqrt(np.diag(core(state)))
    np.testing.assert_array_equal(row["accel_bias_std"], stds[9:12])
    np.testing.assert_array_equal(row["gyro_bias_std"], stds[12:15])


def test_status_is_a_ladder() -> None:
    state = running(1)
    core(state)[8, 8] = 1e-6
    settings = make_settings()
    assert status_of(state, settings) == Status.GOOD
    state["stamp"] = 999_999_999
    assert status_of(state, settings) == Status.GOOD
    state["stamp"] = 1_000_000_001
    assert status_of(state, settings) == Status.COASTING
    # One fix per second: two of them may stay away.
    state["recovery"]["absolute_interval"] = 1_000_000_000
    assert status_of(state, settings) == Status.GOOD
    state["stamp"] = 2_000_000_001
    assert status_of(state, settings) == Status.COASTING
    # A fix per minute: three seconds are the longest that is not called coasting.
    state["recovery"]["absolute_interval"] = 60_000_000_000
    state["stamp"] = 3_000_000_001
    assert status_of(state, settings) == Status.COASTING
    state["stamp"] = 0
    core(state)[8, 8] = (1.01 * settings["good_heading_std"]) ** 2
    assert status_of(state, settings) == Status.ALIGNING
    for field, status in (
        ("heading_known", Status.WAITING_HEADING),
        ("position_known", Status.WAITING_FIX),
        ("level_known", Status.LEVELLING),
    ):
        state[field] = 0
        assert status_of(state, settings) == status
    state["imu"]["stamp"] = NEVER
    assert status_of(state, settings) == Status.WAITING_IMU
