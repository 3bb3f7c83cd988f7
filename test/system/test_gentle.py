"""Rest that is none, and slow robots.

Smooth creep, trains, slow turns; tractors, mowers, a turn in place; boats that crab; a start in flight. Bars of the
issue on trust, on a few seeds.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.dual_antenna import DualAntenna
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.wheel import WheelOdometer
from monte_carlo import Run, run
from support import gentle
from support.aided import AidedNavigator

YAW = 8
HEADING_DEG = 35.0
IMU_NOISE = ("gyro_noise_density", "accel_noise_density", "gyro_bias_random_walk", "accel_bias_random_walk")


def estimated(recording: Recording, is_told: bool = True, **parameters: Any) -> Run:
    """Run a recording; ``is_told``: with the noise of its IMU, else with the default, which is far wider."""
    navigator = AidedNavigator(recording, **parameters)
    if not is_told:
        given = {
            name: value for name, value in recording.parameters().items() if name.removeprefix("imu.") not in IMU_NOISE
        }
        navigator.configure(from_mapping({**given, **{k.replace("__", "."): v for k, v in parameters.items()}}))
        navigator.reset()
    return run(recording, navigator, 1.0)


def recorded(name: str, move: gentle.Move, seed: int, **options: Any) -> Recording:
    return gentle.recorded(name, move, seed, HEADING_DEG, grade="consumer", imu_rate=50.0, **options)


GIVEN: dict[str, Any] = {"alignment__initial_heading_deg": HEADING_DEG}


@pytest.mark.parametrize("is_told", [True, False], ids=["told", "default"])
@pytest.mark.parametrize("velocity_std", [None, 0.05, 0.1])
@pytest.mark.parametrize("rate", [5.0, 1.0])
@pytest.mark.parametrize("speed", [0.1, 0.4, 1.0])
def test_a_smooth_creep_is_no_rest(speed: float, rate: float, velocity_std: float | None, is_told: bool) -> None:
    """With fixes of 0.8 m and velocities, or without: not one zero velocity is fused while the robot moves."""
    std = velocity_std or 0.1
    recording = recorded(
        f"creep {speed}",
        gentle.creep(speed),
        seed=1,
        gnss_rate=rate,
        position_std=(0.8, 1.2),
        velocity_std=(std, 1.5 * std),
    )
    result = estimated(recording, is_told, **GIVEN, gnss__use_velocity=velocity_std is not None)
    assert gentle.false_rest(recording, result.records) == 0
    horizontal = np.hypot(result.error[:, 0], result.error[:, 1])
    sigma = np.sqrt(result.covariance[:, 0, 0] + result.covariance[:, 1, 1])
    assert (horizontal[result.aligned] < 5.0 * sigma[result.aligned]).all()


@pytest.mark.parametrize("velocity", [True, False], ids=["with velocity", "position only"])
def test_a_train_is_not_at_rest_before_it_stands(velocity: bool) -> None:
    recording = recorded("train", gentle.TRAIN, seed=2)
    result = estimated(recording, is_told=False, **GIVEN, gnss__use_velocity=velocity)
    assert gentle.false_rest(recording, result.records) == 0


@pytest.mark.parametrize("rest", [30.0, 0.0], ids=["after a rest", "from the beginning"])
@pytest.mark.parametrize("rate_deg", [0.2, 0.5, 2.0])
def test_a_slow_turn_that_a_dual_antenna_sees_is_no_rest(rate_deg: float, rest: float) -> None:
    """The heading follows the turn within its sigma: it is not frozen by zero rates."""
    for is_told in (True, False):
        recording = recorded(
            f"turn {rate_deg} {rest}", gentle.slow_turn(rate_deg, rest), seed=3, dual_antenna=DualAntenna()
        )
        result = estimated(recording, is_told)
        assert gentle.false_rest(recording, result.records) == 0
        error, variance = result.error[result.aligned, YAW], result.covariance[result.aligned, YAW, YAW]
        assert (error**2 < 25.0 * variance).all()


@pytest.mark.parametrize("seed", range(3))
def test_without_an_antenna_the_gyro_itself_shows_a_slow_turn(seed: int) -> None:
    """After a rest its bias is known well enough, whatever noise the parameters allow."""
    recording = recorded("turn alone", gentle.slow_turn(0.2), seed)
    result = estimated(recording, is_told=False, **GIVEN)
    assert gentle.false_rest(recording, result.records) == 0


@pytest.mark.parametrize("is_told", [True, False], ids=["told", "default"])
def test_what_stands_is_held(is_told: bool) -> None:
    """From a few seconds after the stop on with velocities or RTK fixes, from a minute on with fixes of a metre."""
    parked = gentle.drive((gentle.Hold(20.0), gentle.SpeedTo(8.0), gentle.SpeedTo(0.0), gentle.Hold(150.0)))
    stop = 20.0 + 5.2 + 5.2
    for changes, options, since in (
        ({}, {}, stop + 6.0),
        ({"gnss__use_velocity": False}, {"position_std": (0.02, 0.04), "gnss_rate": 1.0}, stop + 6.0),
        ({"gnss__use_velocity": False}, {}, stop + 60.0),
    ):
        recording = recorded("parked again", parked, seed=4, **options)
        result = estimated(recording, is_told, **GIVEN, **changes)
        assert gentle.false_rest(recording, result.records) == 0
        assert gentle.true_rest(recording, result.records, since) > 0.8


# ------------------------------------------------------------------------------------------------------- the heading

RTK: dict[str, Any] = {"gnss_rate": 1.0, "position_std": (0.02, 0.04), "velocity_std": (0.05, 0.08)}


def assert_found(recording: Recording, result: Run, within: float = 60.0) -> None:
    """The heading is known ``within`` so many seconds after the robot began to move, and right then."""
    moving = np.linalg.norm(recording.truth_velocity_map, axis=1) > 0.02
    moving |= np.linalg.norm(recording.truth_angular_rate_body, axis=1) > 0.01
    begin = (recording.truth_stamp[np.argmax(moving)] - recording.imu_stamp[0]) * 1e-9
    assert result.aligned.any()
    first = int(np.argmax(result.aligned))
    assert result.seconds[first] - begin <= within
    error, sigma = abs(result.error[first, YAW]), math.sqrt(result.covariance[first, YAW, YAW])
    assert error < 3.0 * sigma
    assert error < math.radians(15.0)


@pytest.mark.parametrize("is_told", [True, False], ids=["told", "default"])
@pytest.mark.parametrize("has_wheels", [False, True], ids=["", "wheels"])
@pytest.mark.parametrize("velocity", [True, False], ids=["with velocity", "position only"])
def test_a_tractor_at_half_a_metre_per_second_knows_its_heading(
    velocity: bool, has_wheels: bool, is_told: bool
) -> None:
    for seed in range(2):
        wheel = WheelOdometer(rate=10.0) if has_wheels else None
        recording = recorded(f"tractor {has_wheels}", gentle.TRACTOR, seed, stop=100.0, wheel=wheel, **RTK)
        assert_found(recording, estimated(recording, is_told, gnss__use_velocity=velocity))


@pytest.mark.parametrize("is_told", [True, False], ids=["told", "default"])
def test_a_mower_knows_its_heading(is_told: bool) -> None:
    for seed in range(2):
        recording = recorded("mower", gentle.MOWER, seed, lever_arm=(0.3, 0.0, 0.4), **RTK)
        assert_found(recording, estimated(recording, is_told, gnss__use_velocity=False))


@pytest.mark.parametrize("rate", [1.0, 5.0])
def test_the_circle_of_an_antenna_tells_the_heading_of_a_turn_in_place(rate: float) -> None:
    """The antenna is 0.3 m off, its fixes are good to a centimetre; two degrees wrong at the most."""
    options: dict[str, Any] = {"lever_arm": (0.3, 0.0, 0.4), "gnss_rate": rate, "position_std": (0.01, 0.02)}
    for seed in range(3):
        recording = recorded("turning", gentle.TURNING, seed, **options)
        assert_found(recording, estimated(recording, is_told=False, gnss__use_velocity=False))


def test_a_boat_that_crabs_is_not_locked_onto_its_course() -> None:
    """A current sets it off by 40 degrees. The heading is found from the waves, and is as wrong as it says."""
    squares = []
    for seed in range(6):
        recording = gentle.recorded("crab", gentle.crabbing_boat, seed, HEADING_DEG, grade="industrial", imu_rate=50.0)
        result = estimated(recording)
        assert result.aligned.any()
        variance = result.covariance[result.aligned, YAW, YAW]
        ratio = result.error[result.aligned, YAW] ** 2 / variance
        assert ratio.max() < 25.0
        squares.append(ratio.mean())
    # Errors of one run are all alike: six runs with the mean 1.
    assert np.mean(squares) < 2.8


@pytest.mark.parametrize("velocity", [True, False], ids=["with velocity", "position only"])
@pytest.mark.parametrize("speed", [60.0, 150.0, 250.0])
def test_a_start_in_flight_finds_its_heading(speed: float, velocity: bool) -> None:
    """Switched on six seconds before a turn."""
    start = 5.0 + speed / 8.0 + 15.2
    recording = recorded(f"flight {speed}", gentle.flight(speed), 1, start=start, stop=start + 60.0)
    result = estimated(recording, gnss__use_velocity=velocity)
    assert_found(recording, result, within=30.0)
