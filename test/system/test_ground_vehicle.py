"""What wheels and the constraint of a vehicle on wheels say: Jacobians, noise, and what they are worth in a tunnel."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.filter.measurements import nhc, wheel
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state import augmented_states
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE, NOWHERE
from eskf_ros.filter.state.time import NEVER
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.episodes import WheelSlip
from eskf_ros.simulate.scenario import Recording, simulate
from eskf_ros.simulate.scenarios import TUNNEL_START
from eskf_ros.simulate.wheel import WheelOdometer
from monte_carlo import BLOCKS, Run, nees, run
from support.kernels import copy_of, make_settings, make_work, random_covariance, random_state, to_rotation, with_error

Array = NDArray[np.float64]

MOUNT = {"imu__mount_position": [0.3, 0.1, -0.2], "imu__mount_rpy_deg": [10.0, -20.0, 130.0]}
POINTS = {"wheel__position": [-0.4, 0.7, -0.3], "nhc__position": [-1.2, 0.1, 0.4]}
SETTINGS = make_settings(**MOUNT, **POINTS)
PLAIN = make_settings(**MOUNT, **POINTS, estimate__mounting=False, estimate__wheel_scale=False)
REACH = int(SETTINGS["reach"][Stream.WHEEL])
BOTH = np.array([8.0, 0.3, 0.0, 0.01, 0.002, 0.0, 0.004, 0.0, -1.0])
SPEED_ONLY = np.array([8.0, 0.0, 0.0, 0.01, 0.0, 0.0, -1.0, 0.0, -1.0])
YAW_RATE_ONLY = np.array([0.0, 0.3, 0.0, -1.0, 0.0, 0.0, 0.004, 0.0, -1.0])

seeds = pytest.mark.parametrize("seed", range(5))


def moving(seed: int, settings: Any = SETTINGS) -> Any:
    """Return a running filter at a grid point, in motion, with whatever optional states the wheels need."""
    state = random_state(seed)
    rng = np.random.default_rng(seed)
    augmented_states.update_error_size(state, settings["reach"][Stream.WHEEL], settings)
    if state["error_size"] > ERROR_SIZE:
        state["optional"][:3] = rng.normal(0.0, (0.1, 0.1, 0.05))
    state["rest"]["block_end"] = state["stamp"]
    state["rest"]["block_count"], state["rest"]["block_half_count"] = 100, 50
    state["rest"]["block_sum"][:3] = 100 * state["specific_force"]
    return state


def shifted(state: Any, j: int, size: float) -> Any:
    """Return the state that is true when ``state`` is in error by ``size`` in error ``j``."""
    if j < ERROR_SIZE:
        return with_error(state, size * np.eye(ERROR_SIZE)[j])
    true = copy_of(state)
    true["optional"][j - ERROR_SIZE] += size
    return true


STEPS = np.concatenate([np.repeat([1.0, 1.0, 1e-5, 0.1, 1e-2], 3), np.full(REACH - ERROR_SIZE, 1e-5)])


def numerical_jacobian(predict: Callable[[Any, Any], Any], state: Any, settings: Any) -> Array:
    columns = []
    for j in range(int(state["error_size"])):
        plus, minus = (np.array(predict(shifted(state, j, k * STEPS[j]), settings)) for k in (1.0, -1.0))
        columns.append((plus - minus) / (2.0 * STEPS[j]))
    return np.array(columns).T


def vehicle_to_base(state: Any, settings: Any) -> Rotation:
    """Rotation of the vehicle's axes in base_link."""
    place = int(settings["mounting_at"])
    if place == NOWHERE:
        return Rotation.identity()
    yaw, pitch = state["optional"][place - ERROR_SIZE : place - ERROR_SIZE + 2]
    return Rotation.from_euler("ZY", [yaw, pitch])


def velocity_in_vehicle(state: Any, settings: Any, position_base: Any) -> tuple[Array, Array]:
    """Velocity of a point of base_link and angular rate, in the axes of the vehicle."""
    imu_to_base = Rotation.from_matrix(settings["imu_to_base"])
    turn = to_rotation(state["attitude"])
    rate = state["angular_rate"] - state["gyro_bias"] - turn.inv().apply(state["frame"]["earth_rate_map"])
    arm = imu_to_base.inv().apply(np.subtract(position_base, MOUNT["imu__mount_position"]))
    velocity = turn.inv().apply(state["velocity_map"]) + np.cross(rate, arm)
    to_vehicle = vehicle_to_base(state, settings).inv() * imu_to_base
    return to_vehicle.apply(velocity), to_vehicle.apply(rate)


# ------------------------------------------------------------------------------------------------------- the equations


@seeds
@pytest.mark.parametrize("settings", [SETTINGS, PLAIN], ids=["all states", "no optional states"])
def test_prediction_of_wheels_is_the_velocity_of_their_point(seed: int, settings: Any) -> None:
    state = moving(seed, settings)
    velocity, rate = velocity_in_vehicle(state, settings, POINTS["wheel__position"])
    place = int(settings["wheel_scale_at"])
    scale = 1.0 if place == NOWHERE else 1.0 + state["optional"][place - ERROR_SIZE]
    np.testing.assert_allclose(wheel.predict(state, settings), (scale * velocity[0], rate[2]), rtol=0.0, atol=1e-12)


@seeds
@pytest.mark.parametrize("settings", [SETTINGS, PLAIN], ids=["all states", "no optional states"])
def test_constraint_is_on_lateral_and_vertical_velocity_of_its_point(seed: int, settings: Any) -> None:
    state = moving(seed, settings)
    velocity, _ = velocity_in_vehicle(state, settings, POINTS["nhc__position"])
    np.testing.assert_allclose(nhc.predict(state, settings), velocity[1:], rtol=0.0, atol=1e-12)


@seeds
@pytest.mark.parametrize("payload", [BOTH, SPEED_ONLY, YAW_RATE_ONLY], ids=["both", "speed", "yaw rate"])
@pytest.mark.parametrize("settings", [SETTINGS, PLAIN], ids=["all states", "no optional states"])
def test_jacobian_of_wheels(seed: int, payload: Array, settings: Any) -> None:
    state, work = moving(seed, settings), make_work()
    measured = [row for row, variance in enumerate((payload[3], payload[6])) if variance >= 0.0]
    assert wheel.linearize(state, payload, settings, work) == len(measured)
    expected = numerical_jacobian(wheel.predict, state, settings)[measured]
    size = int(state["error_size"])
    np.testing.assert_allclose(work["jacobian"][: len(measured), :size], expected, rtol=0.0, atol=1e-8)
    predicted = np.array(wheel.predict(state, settings))[measured]
    np.testing.assert_allclose(work["innovation"][: len(measured)], payload[measured] - predicted, rtol=0.0, atol=1e-12)
    assert np.linalg.eigvalsh(work["noise"][: len(measured), : len(measured)]).min() > 0.0


@seeds
@pytest.mark.parametrize("settings", [SETTINGS, PLAIN], ids=["all states", "no optional states"])
def test_jacobian_of_the_constraint(seed: int, settings: Any) -> None:
    state, work = moving(seed, settings), make_work()
    assert nhc.linearize(state, settings, work) == 2
    expected = numerical_jacobian(nhc.predict, state, settings)
    np.testing.assert_allclose(work["jacobian"][:2, : int(state["error_size"])], expected, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(work["innovation"][:2], -np.array(nhc.predict(state, settings)), rtol=0.0, atol=1e-12)


def test_linearizing_changes_nothing_but_the_work() -> None:
    state, work = moving(3), make_work()
    state["covariance"][:REACH, :REACH] = random_covariance(1, STEPS[:REACH])
    before = copy_of(state)
    for linearize in (
        lambda: wheel.linearize(state, BOTH, SETTINGS, work),
        lambda: nhc.linearize(state, SETTINGS, work),
    ):
        work["jacobian"] = work["noise"] = 7.0
        linearize()
        once = work.copy()
        linearize()
        assert state.tobytes() == before.tobytes()
        for name in ("jacobian", "noise", "innovation"):
            np.testing.assert_array_equal(work[name][:2, ...], once[name][:2, ...])


# ----------------------------------------------------------------------------------------------------------- the noise


def test_what_slips_with_every_message_counts_as_often_as_it_lasts() -> None:
    """The part that lasts has the information of one message per two seconds, however many there are."""
    state, work = moving(1), make_work()
    state["rest"]["wheel_stamp"] = NEVER
    wheel.linearize(state, SPEED_ONLY, SETTINGS, work)
    once = float(work["noise"][0, 0])
    lasting = []
    for interval in (0.1, 0.02):
        state["rest"]["wheel_stamp"] = state["stamp"] - round(interval * 1e9)
        wheel.linearize(state, SPEED_ONLY, SETTINGS, work)
        lasting.append((work["noise"][0, 0] - once) * interval)
    single = lasting[0] / (2.0 * wheel.SLIP_TIME - 0.1)
    assert single > 0.0
    assert lasting[1] == pytest.approx(single * (2.0 * wheel.SLIP_TIME - 0.02))


def test_wheels_are_believed_less_the_harder_they_push() -> None:
    level = Rotation.identity()
    noise = []
    for acceleration in (0.0, 3.0):
        state, work = moving(1, PLAIN), make_work()
        state["attitude"] = (1.0, 0.0, 0.0, 0.0)
        state["velocity_map"] = (10.0, 0.0, 0.0)
        state["accel_bias"] = 0.0
        state["specific_force"] = level.apply([acceleration, 0.0, 9.81])
        wheel.linearize(state, SPEED_ONLY, PLAIN, work)
        noise.append(float(work["noise"][0, 0]))
    assert noise[1] > 1.5 * noise[0]


def test_wheels_in_a_turn_say_little_of_the_yaw_rate() -> None:
    """The track of skidding tyres is no constant: the sensor's own noise is the least of it."""
    noise = []
    for turn_rate in (0.0, 0.5):
        state, work = moving(1, PLAIN), make_work()
        state["velocity_map"] = 0.0
        state["rest"]["wheel_stamp"] = state["stamp"] - 20_000_000
        up = np.array(PLAIN["imu_to_base"])[2]
        state["angular_rate"] = (
            state["gyro_bias"]
            + to_rotation(state["attitude"]).inv().apply(state["frame"]["earth_rate_map"])
            + turn_rate * up
        )
        wheel.linearize(state, YAW_RATE_ONLY, PLAIN, work)
        noise.append(float(work["noise"][0, 0]))
    assert noise[1] > noise[0] + (0.01 * 0.5) ** 2 * 2.0 * wheel.TURN_ERROR_TIME / 0.02


def deviation(state: Any, settings: Any = PLAIN) -> float:
    """Standard deviation (m/s) of the lateral velocity."""
    work = make_work()
    assert nhc.linearize(state, settings, work) == 2
    return math.sqrt(work["noise"][0, 0])


def driving(speed: float, lateral_acceleration: float) -> Any:
    state = moving(1, PLAIN)
    state["attitude"] = (1.0, 0.0, 0.0, 0.0)
    state["velocity_map"] = np.array(PLAIN["imu_to_base"])[0] * speed
    state["rest"]["block_sum"][:3] = 100 * (state["accel_bias"] + (0.0, lateral_acceleration, 9.81))
    return state


def test_the_constraint_is_looser_in_turns_and_while_wheels_slip() -> None:
    straight, turning, slipping = driving(10.0, 0.0), driving(10.0, 2.0), driving(10.0, 0.0)
    slipping["rest"]["slip_stamp"] = slipping["stamp"] - 10**9
    over = driving(10.0, 0.0)
    over["rest"]["slip_stamp"] = over["stamp"] - 2 * 10**9
    assert deviation(turning) > 1.5 * deviation(straight)
    assert deviation(slipping) > 3.0 * deviation(straight)
    assert deviation(over) == deviation(straight)


@pytest.mark.parametrize("missing", ["block", "samples", "gap", "heading"])
def test_the_constraint_does_not_hold(missing: str) -> None:
    state, work = driving(10.0, 0.0), make_work()
    assert nhc.linearize(state, PLAIN, work) == 2
    if missing == "block":
        state["rest"]["block_end"] += 10**9
    elif missing == "samples":
        state["rest"]["block_count"], state["rest"]["block_half_count"] = 2, 1
    elif missing == "gap":
        state["rest"]["block_broken"] = 1
    else:
        state["covariance"][8, 8] = 0.3**2
    assert nhc.linearize(state, PLAIN, work) == 0


# ---------------------------------------------------------------------------------------------------- in the simulation

SENSOR = WheelOdometer(position=(0.0, 0.6, 0.0), scale_std=0.02, rate=10.0)
TOLD = {"wheel.position": [0.0, 0.6, 0.0]}
WITHOUT = {"wheel.use": False}
WHEELS = TOLD
CONSTRAINT = {"wheel.use": False, "nhc.enabled": True}
EVERYTHING = {**TOLD, "nhc.enabled": True}


def through_tunnel(seed: int, length: float, **options: Any) -> Recording:
    options = {"grade": "consumer", "imu_rate": 100.0, "wheel": SENSOR, **options}
    return simulate("long_tunnel", seed, stop=TUNNEL_START + length, **options)


def estimated(recording: Recording, changes: dict[str, Any]) -> tuple[Run, Navigator]:
    navigator = Navigator(from_mapping({**recording.parameters(), **changes}))
    return run(recording, navigator, 1.0), navigator


def horizontal_error(result: Run) -> float:
    return math.hypot(*result.error[-1, :2])


def test_a_minute_in_a_tunnel() -> None:
    """Each alone holds the error down by much, and both together more."""
    errors: dict[str, list[float]] = {}
    for seed in range(6):
        recording = through_tunnel(seed, 60.0)
        for name, changes in (
            ("none", WITHOUT),
            ("wheels", WHEELS),
            ("constraint", CONSTRAINT),
            ("both", EVERYTHING),
        ):
            errors.setdefault(name, []).append(horizontal_error(estimated(recording, changes)[0]))
    rms = {name: math.sqrt(np.mean(np.square(values))) for name, values in errors.items()}
    assert rms["wheels"] < 0.2 * rms["none"], rms
    assert rms["constraint"] < 0.2 * rms["none"], rms
    assert rms["both"] < 0.8 * min(rms["wheels"], rms["constraint"]), rms


@pytest.mark.parametrize("changes", [WHEELS, CONSTRAINT, EVERYTHING], ids=["wheels", "constraint", "both"])
def test_the_covariance_stays_honest_in_the_tunnel(changes: dict[str, Any]) -> None:
    """On tyres that slip sideways, with wheels of unknown size: the error is what the covariance says, or less."""
    means: dict[str, list[float]] = {}
    for seed in range(12):
        result, _ = estimated(through_tunnel(seed, 120.0), changes)
        tunnel = result.seconds > TUNNEL_START
        for name in ("position", "velocity", "attitude"):
            values = nees(result.error[tunnel], result.covariance[tunnel], BLOCKS[name])
            means.setdefault(name, []).append(values.mean())
    for name, values in means.items():
        # Of 12 consistent runs, whose epochs are all alike, the mean exceeds 4.5 once in a hundred times.
        assert 0.5 < np.mean(values) < 4.5, (name, np.mean(values))


def test_scale_and_mounting_are_found() -> None:
    """The IMU is turned by 1.2 and -0.8 deg in pitch and yaw against what the parameters say, and wheels are small."""
    sensor = WheelOdometer(scale_error=0.03, scale_std=0.0, rate=10.0)
    recording = simulate("drive", 1, imu_rate=100.0, wheel=sensor, imu_rpy_deg=(0.0, 1.2, -0.8))
    changes = {"nhc.enabled": True, "imu.mount_rpy_deg": [0.0, 0.0, 0.0]}
    result, navigator = estimated(recording, changes)
    state, settings = navigator.state[0], make_settings(**{k.replace(".", "__"): v for k, v in changes.items()})
    mounting, scale = int(settings["mounting_at"]), int(settings["wheel_scale_at"])
    found = state["optional"][np.array([mounting, mounting + 1, scale]) - ERROR_SIZE]
    sigma = np.sqrt(np.diag(state["covariance"])[[mounting, mounting + 1, scale]])
    # The body in the axes of the IMU, which the parameters take for base_link.
    yaw, pitch, _ = Rotation.from_euler("xyz", recording.options.imu_rpy_deg, degrees=True).inv().as_euler("ZYX")
    truth = np.array([yaw, pitch, 0.03])
    assert (np.abs(truth) > 0.01).all()
    assert (np.abs(found - truth) < 4.0 * sigma).all(), (found, truth, sigma)
    assert (sigma < (0.004, 0.004, 0.003)).all(), sigma
    assert result.aligned[-1]


@pytest.mark.parametrize("factor", [0.0, 1.4], ids=["locked", "spinning"])
def test_slipping_wheels_are_refused(factor: float) -> None:
    """Four seconds of it in a tunnel: gated, and no worse than without the wheels at that time."""
    slip = WheelSlip(start=TUNNEL_START + 10.0, length=4.0, factor=factor)
    for seed in range(3):
        bad, good = (through_tunnel(seed, 30.0, episodes=episodes) for episodes in ((slip,), ()))
        (slipped, _), (rolled, _) = estimated(bad, EVERYTHING), estimated(good, EVERYTHING)
        records = slipped.records[slipped.records["stream"] == Stream.WHEEL]
        seconds = (records["stamp"] - bad.imu_stamp[0]) * 1e-9
        during = (seconds > TUNNEL_START + 10.1) & (seconds < TUNNEL_START + 13.9)
        assert (records["verdict"][during] == Verdict.GATE).all()
        after = (seconds > TUNNEL_START + 14.1) & (seconds < TUNNEL_START + 30.0)
        assert np.mean(records["verdict"][after] == Verdict.FUSED) > 0.95
        assert horizontal_error(slipped) < horizontal_error(rolled) + 2.0
