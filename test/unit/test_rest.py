"""Rest and velocities of the body: Jacobians, heading of a parked robot, and what must not pass for rest."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.filter.measurements import body_velocity, zaru, zupt
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import CONSTRAINT_INTERVAL, Stream, Verdict
from eskf_ros.filter.state.error_state import GYRO_BIAS
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.body_velocity import BodyVelocity
from eskf_ros.simulate.episodes import Outage
from eskf_ros.simulate.scenario import simulate
from eskf_ros.simulate.wheel import WheelOdometer
from support.aided import run, run_aided
from support.kernels import copy_of, make_settings, make_work, random_state, with_error

Array = NDArray[np.float64]

PERTURBATION = np.repeat([1.0, 1.0, 1e-5, 0.1, 1e-2], 3)
RPY_DEG = (10.0, -20.0, 40.0)
SETTINGS = make_settings(
    imu__mount_position=[0.3, 0.1, -0.2],
    imu__mount_rpy_deg=[160.0, -25.0, 130.0],
    body_velocity__mount_position=[1.5, -0.4, -0.6],
    body_velocity__mount_rpy_deg=list(RPY_DEG),
)
YAW = 8

seeds = pytest.mark.parametrize("seed", range(5))


def numerical_jacobian(predict: Any, state: Any) -> Array:
    """Differentiate three predicted values by the error of the state, q_true = dq(theta) q."""
    columns = []
    for j in range(15):
        error = PERTURBATION[j] * np.eye(15)[j]
        plus, minus = (np.array(predict(with_error(state, sign * error))) for sign in (1.0, -1.0))
        columns.append((plus - minus) / (2.0 * PERTURBATION[j]))
    return np.array(columns).T


@seeds
@pytest.mark.parametrize("absent", [(), (1,), (0, 2)])
def test_jacobian_of_body_velocities(seed: int, absent: tuple[int, ...]) -> None:
    state, work = random_state(seed), make_work()
    payload = np.zeros(16)
    payload[[3, 6, 8]] = 0.04, 0.09, 0.01
    for axis in absent:
        payload[(3, 6, 8)[axis]] = -1.0
    size = body_velocity.linearize(state, payload, SETTINGS, work)
    measured = [axis for axis in range(3) if axis not in absent]
    assert size == len(measured)
    expected = numerical_jacobian(lambda s: body_velocity.predict(s, SETTINGS), state)[measured]
    np.testing.assert_allclose(work["jacobian"][:size, :15], expected, rtol=1e-5, atol=1e-6)
    assert (np.linalg.eigvalsh(work["noise"][:size, :size]) > 0.0).all()


@seeds
def test_body_velocity_is_that_of_its_point_in_its_axes(seed: int) -> None:
    """By scipy's rotations: velocity of the IMU and the turning of the arm, in the axes of the sensor."""
    state = random_state(seed)
    body_to_map = Rotation.from_quat(state["attitude"][[1, 2, 3, 0]])
    imu_to_base = Rotation.from_euler("xyz", [160.0, -25.0, 130.0], degrees=True)
    sensor_to_base = Rotation.from_euler("xyz", RPY_DEG, degrees=True)
    rate = state["angular_rate"] - state["gyro_bias"] - body_to_map.inv().apply(state["frame"]["earth_rate_map"])
    arm = imu_to_base.inv().apply(np.subtract([1.5, -0.4, -0.6], [0.3, 0.1, -0.2]))
    velocity_body = body_to_map.inv().apply(state["velocity_map"]) + np.cross(rate, arm)
    expected = sensor_to_base.inv().apply(imu_to_base.apply(velocity_body))
    np.testing.assert_allclose(body_velocity.predict(state, SETTINGS), expected, rtol=1e-9, atol=1e-9)


def resting(seed: int) -> Any:
    """A state at a grid point whose IMU has been quiet since the last one, and whose wheels stand."""
    state = random_state(seed)
    state["velocity_map"] = np.random.default_rng(seed).normal(0.0, 0.01, 3)
    state["covariance"][:15, :15] = np.diag(np.repeat([1.0, 0.01, 1e-4, 0.01, 1e-6], 3))
    stamp = 100 * CONSTRAINT_INTERVAL
    state["stamp"] = state["imu"]["stamp"] = state["rest"]["block_end"] = state["rest"]["resting_stamp"] = stamp
    state["rest"]["block_count"], state["rest"]["block_half_count"] = 10, 5
    # At rest the gyros read their bias and the turn of the Earth.
    state["angular_rate"] = np.array(zaru.predict(state)) + np.random.default_rng(seed).normal(0.0, 5e-4, 3)
    readings = np.concatenate([state["specific_force"], state["angular_rate"]])
    state["rest"]["block_sum"], state["rest"]["block_half_sum"] = 10.0 * readings, 5.0 * readings
    state["rest"]["block_square_sum"] = 10.0 * readings**2
    return state


@seeds
def test_jacobian_of_rest(seed: int) -> None:
    state, work = resting(seed), make_work()
    assert zupt.linearize(state, SETTINGS, work) == 3
    np.testing.assert_allclose(work["innovation"], -state["velocity_map"])
    np.testing.assert_allclose(
        work["jacobian"][:, :15], numerical_jacobian(lambda s: s["velocity_map"], state), atol=1e-9
    )
    assert zaru.linearize(state, SETTINGS, work) == 3
    np.testing.assert_allclose(work["innovation"], state["angular_rate"] - np.array(zaru.predict(state)), atol=1e-12)
    np.testing.assert_allclose(work["jacobian"][:, :15], numerical_jacobian(zaru.predict, state), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("evidence", ["motion", "shaking", "turn", "gap"])
def test_what_is_no_rest(evidence: str) -> None:
    state, work = resting(1), make_work()
    if evidence == "motion":
        state["rest"]["moving_stamp"] = state["stamp"]
    elif evidence == "shaking":
        state["rest"]["block_square_sum"] += 10.0 * np.repeat([1.0, 0.04], 3)
    elif evidence == "turn":
        state["rest"]["block_half_sum"][5] += 5.0 * 0.3
    else:
        state["rest"]["block_broken"] = 1
    before = copy_of(state)
    assert zupt.linearize(state, SETTINGS, work) == zaru.linearize(state, SETTINGS, work) == 0
    assert state.tobytes() == before.tobytes()


def through(name: str, seed: int, zupt_enabled: bool, **options: Any) -> tuple[Any, Any]:
    recording = simulate(name, seed, grade="consumer", imu_rate=100.0, **options)
    w, x, y, z = recording.truth_attitude_body_to_map[0]
    yaw_deg = math.degrees(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    heading = {"alignment.initial_heading_deg": yaw_deg, "alignment.initial_heading_std_deg": 1.0}
    given = {**recording.parameters(), **heading, "zupt.enabled": zupt_enabled}
    navigator = Navigator(from_mapping(given))
    return run(recording, navigator, 1.0), navigator


@pytest.mark.parametrize(("name", "axes"), [("multirotor", "xy"), ("boat", "xyz")])
def test_velocities_of_the_body_carry_through_an_outage(name: str, axes: str) -> None:
    """An optical flow sensor on a multirotor, a Doppler log on a boat: half a minute without GNSS."""
    ends: dict[bool, list[float]] = {True: [], False: []}
    heading = {"alignment__initial_heading_std_deg": 1.0}
    for seed in range(4):
        sensor = BodyVelocity(axes=axes, rate=10.0)
        recording = simulate(
            name, seed, grade="consumer", imu_rate=50.0, stop=80.0, body_velocity=sensor, episodes=(Outage(45.0, 30.0),)
        )
        w, x, y, z = recording.truth_attitude_body_to_map[0]
        heading["alignment__initial_heading_deg"] = math.degrees(
            math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        )
        for is_used, kept in ends.items():
            result = run_aided(recording, 1.0, body_velocity__use=is_used, **heading)
            end = int(np.searchsorted(result.seconds, 74.5))
            kept.append(float(np.linalg.norm(result.error[end, :2])))
            if is_used:
                covariance = result.covariance[end, :2, :2]
                assert result.error[end, :2] @ np.linalg.solve(covariance, result.error[end, :2]) < 14.0
    assert np.median(ends[True]) < 0.25 * np.median(ends[False]), ends


def test_the_heading_of_a_parked_robot_does_not_drift() -> None:
    """Ten minutes: with rest known it stays, within its sigma; the Earth's rate is not taken for a bias."""
    held, drifted = [], []
    for seed in range(3):
        for enabled, kept in ((True, held), (False, drifted)):
            result, _ = through("parked", seed, enabled, wheel=WheelOdometer(rate=10.0))
            first = np.searchsorted(result.seconds, 10.0)
            kept.append(abs(result.error[-1, YAW] - result.error[first, YAW]))
            if enabled:
                bias = result.error[-1, GYRO_BIAS : GYRO_BIAS + 3]
                sigma = np.sqrt(np.diag(result.covariance[-1])[GYRO_BIAS : GYRO_BIAS + 3])
                assert (np.abs(bias) < 4.0 * sigma).all()
                assert abs(result.error[-1, YAW]) < 4.0 * math.sqrt(result.covariance[-1, YAW, YAW])
    assert max(held) < math.radians(0.5)
    assert max(held) < 0.2 * max(drifted)


@pytest.mark.parametrize("seed", range(2))
def test_a_smooth_motorway_is_no_rest(seed: int) -> None:
    """GNSS velocity sees the motion: not one zero is fused once the car moves."""
    result, _ = through("motorway", seed, True)
    records = result.records
    zeros = records[(records["stream"] == Stream.ZUPT) & (records["verdict"] == Verdict.FUSED)]
    assert len(zeros) == 0


@pytest.mark.parametrize("std", [0.02, 0.3])
def test_two_antennas_of_a_robot_at_rest_are_no_motion(std: float) -> None:
    """They are two metres apart, and each stays where it is."""
    recording = simulate("parked", 5, imu_rate=100.0, stop=60.0, lever_arm=(0.0, 0.0, 0.0), position_std=(std, std))
    second = {"second_gnss.frame_id": "rear", "second_gnss.lever_arm": [-2.0, 0.0, 0.0]}
    navigator = Navigator(from_mapping({**recording.parameters(), "gnss.use_velocity": False, **second}))
    apart = 2.0 / 6.37e6
    done = 0
    for k, stamp in enumerate(recording.fix_stamp):
        until = int(np.searchsorted(recording.imu_stamp, stamp))
        part = slice(done, until)
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        done = until
        latitude, longitude = float(recording.fix_latitude_deg[k]), float(recording.fix_longitude_deg[k])
        for shift, frame in ((0.0, "front"), (math.degrees(apart), "rear")):
            navigator.push_gnss_position(
                int(stamp),
                latitude + shift,
                longitude,
                float(recording.fix_altitude[k]),
                recording.fix_covariance[k],
                2,
                0,
                frame_id=frame,
            )
    state = navigator.state[0]
    assert state["rest"]["moving_stamp"] < recording.imu_stamp[0]
    assert state["window"]["still_samples"] > 4000
