"""Starts that are no standstill, and gyros that are worse than their parameters: honest, or named."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from eskf_ros.filter.layout import blank_state
from eskf_ros.filter.state.enums import Status
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity import residual_motion
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import simulate
from monte_carlo import Run, feed, nees
from support.aided import AidedNavigator, run_aided
from support.kernels import make_settings

PARTS = 8
RATE = 100.0


def run_through(recording: Recording, navigator: AidedNavigator) -> None:
    for _ in feed(recording, navigator, np.array([len(recording.imu_stamp) - 1])):
        pass


# ------------------------------------------------------------------------------------------- slow motion in a window


def window_of(rates: Any) -> Any:
    """Return a state that has seen a window of 2 s with these rates (200, 3) rad/s."""
    state = blank_state()[0]
    state["stamp"] = 10**9
    for k, rate in enumerate(rates):
        state["stamp"] += 10_000_000
        state["angular_rate"] = rate
        residual_motion.add_to_part(state)
        # What the watch for stillness does between the first and the last sample of a window.
        state["window"]["start"] = 1
        assert k < 199 or state["residual"]["parts"] == PARTS - 1
    return state


@pytest.mark.parametrize("vibration", [0.0, 0.05])
def test_noise_and_vibration_are_no_sway(vibration: float) -> None:
    """An engine at 27 Hz shakes the gyro by 3 deg/s: within a quarter of a second nothing is left of it."""
    density = make_settings()["gyro_noise_density"]
    rng = np.random.default_rng(1)
    shaking = vibration * np.sin(2.0 * math.pi * 27.0 * np.arange(200) / RATE)[:, None]
    found = 0
    for _ in range(300):
        noise = density * math.sqrt(RATE) * rng.normal(size=(200, 3))
        found += residual_motion.sway_variance(window_of(noise + shaking), 3, density) > 0.0
    assert found <= 2


def test_waves_are_sway_of_their_size() -> None:
    density = make_settings()["gyro_noise_density"]
    times = np.arange(200) / RATE
    for phase in np.arange(8) * math.pi / 4.0:
        rate = 0.1 * np.sin(2.0 * math.pi * 0.2 * times + phase)
        found = math.sqrt(residual_motion.sway_variance(window_of(np.outer(rate, [0.0, 1.0, 0.0])), 3, density))
        assert found == pytest.approx(np.std(rate), rel=0.3)


def test_a_new_window_begins_new_parts() -> None:
    state = window_of(np.ones((200, 3)))
    state["window"]["start"] = NEVER
    state["angular_rate"] = 0.0
    residual_motion.add_to_part(state)
    assert state["residual"]["parts"] == 0
    assert (state["residual"]["part_sum"] == 0.0).all()


@pytest.mark.parametrize("grade", ["consumer", "industrial"])
@pytest.mark.parametrize("name", ["boat", "walk"])
def test_what_is_never_at_rest_is_not_levelled_as_if_it_were(name: str, grade: str) -> None:
    """The gyro bias, which a false rest would set to the rate of the moment, is within its sigma at all times."""
    worst = []
    for seed in range(3):
        recording = simulate(name, seed, grade=grade, imu_rate=50.0, stop=40.0)
        result = run_aided(recording, alignment__use_course=False)
        later = result.seconds > 5.0
        sigma = np.sqrt(np.einsum("nii->ni", result.covariance[later, 12:15, 12:15]))
        worst.append(np.abs(result.error[later, 12:15] / sigma).max())
    assert max(worst) < 4.5, worst


def settled_heading(name: str, seed: int, stop: float, **changes: Any) -> Run:
    recording = simulate(name, seed, imu_rate=50.0, stop=stop)
    return run_aided(recording, alignment__use_course=False, **changes)


@pytest.mark.parametrize(("name", "stop"), [("boat", 70.0), ("walk", 50.0), ("multirotor", 80.0)])
def test_whatever_moves_finds_its_heading_by_its_accelerations(name: str, stop: float) -> None:
    """No stop, no course: waves, steps and gusts are accelerations too."""
    squares = []
    for seed in range(3):
        result = settled_heading(name, seed, stop)
        assert result.aligned[-1], (name, seed)
        error, sigma = result.error[-1, 8], math.sqrt(result.covariance[-1, 8, 8])
        assert sigma < math.radians(3.0)
        squares.append((error / sigma) ** 2)
        attitude = nees(result.error[result.aligned], result.covariance[result.aligned], slice(6, 9))
        assert attitude.mean() < 8.0, (name, seed)
    assert sum(squares) < chi2.ppf(0.9999, 3), squares


def test_at_constant_velocity_the_heading_stays_unknown_and_says_so() -> None:
    recording = simulate("motorway", 1, grade="consumer", imu_rate=50.0, stop=60.0)
    navigator = AidedNavigator(recording)
    run_through(recording, navigator)
    assert navigator.status == Status.WAITING_HEADING
    assert navigator.odometry["pose_covariance"][0, 5, 5] > 0.9 * math.pi**2


# --------------------------------------------------------------------------------------- gyros worse than expected


def with_offset(deg_per_s: tuple[float, float, float], **parameters: Any) -> tuple[Recording, AidedNavigator]:
    """A drive after 20 s at rest; the offset is nothing the filter is told."""
    offset = tuple(math.radians(value) for value in deg_per_s)
    recording = simulate("drive", 3, grade="industrial", imu_rate=50.0, stop=60.0, gyro_offset=offset)
    navigator = AidedNavigator(recording, **parameters)
    run_through(recording, navigator)
    return recording, navigator


@pytest.mark.parametrize("axis", range(3))
def test_a_gyro_bias_of_three_degrees_per_second_is_survived_when_it_is_allowed_for(axis: int) -> None:
    offset = (0.0, 0.0, 0.0)[:axis] + (3.0,) + (0.0, 0.0, 0.0)[axis + 1 :]
    recording, navigator = with_offset(offset, imu__gyro_bias_std=0.03)
    assert navigator.complaints == []
    assert navigator.status == Status.GOOD
    state = navigator.state[0]
    off = np.degrees(recording.gyro_bias[-1] - state["gyro_bias"])
    assert np.abs(off).max() < 0.02
    sigma = np.sqrt(np.diag(state["covariance"])[12:15])
    assert (np.abs(np.radians(off)) < 4.0 * sigma).all()


@pytest.mark.parametrize("axis", range(3))
def test_a_gyro_bias_of_three_degrees_per_second_is_named_when_nobody_expects_it(axis: int) -> None:
    """With the default of 0.57 deg/s (and with the 0.17 of this grade) it is no bias that could be believed at once."""
    offset = (0.0, 0.0, 0.0)[:axis] + (-3.0,) + (0.0, 0.0, 0.0)[axis + 1 :]
    for std in (0.003, 0.01):
        _, navigator = with_offset(offset, imu__gyro_bias_std=std)
        assert [sentence for sentence in navigator.complaints if "imu.gyro_bias_std" in sentence], navigator.complaints


@pytest.mark.parametrize("name", ["boat", "walk", "multirotor", "parked", "field_robot"])
def test_motion_is_not_called_a_bias(name: str) -> None:
    recording = simulate(name, 2, grade="consumer", imu_rate=50.0, stop=80.0)
    navigator = AidedNavigator(recording)
    run_through(recording, navigator)
    assert navigator.complaints == []


@pytest.mark.parametrize("seed", range(3))
def test_any_mounting_is_fine_when_it_is_told_and_named_when_it_is_not(seed: int) -> None:
    rpy_deg = tuple(float(angle) for angle in np.random.default_rng(seed).uniform([100, -60, -180], [260, 60, 180]))
    recording = simulate("drive", seed, imu_rate=50.0, stop=50.0, imu_rpy_deg=rpy_deg)
    navigator = AidedNavigator(recording)
    run_through(recording, navigator)
    assert navigator.complaints == []
    assert navigator.status == Status.GOOD
    untold = AidedNavigator(recording, imu__mount_rpy_deg=[0.0, 0.0, 0.0])
    run_through(recording, untold)
    assert [sentence for sentence in untold.complaints if "imu.mount_rpy_deg" in sentence]


def test_a_driver_that_removes_gravity_is_named() -> None:
    recording = simulate("drive", 1, imu_rate=50.0, stop=40.0, gravity_removed=True, imu_rpy_deg=(10.0, 20.0, 30.0))
    navigator = AidedNavigator(recording)
    run_through(recording, navigator)
    assert [sentence for sentence in navigator.complaints if "removes gravity" in sentence]


# -------------------------------------------------------------------------------------------------- the Earth rate


@pytest.mark.parametrize("grade", ["industrial", "tactical"])
def test_the_earth_rate_is_neither_absorbed_nor_believed_too_much(grade: str) -> None:
    """Parked with a heading that is wrong as its sigma says.

    An error of the heading lets the horizontal Earth rate look like a bias, and a known bias tells the heading: the
    sigmas of both stay honest, for heading and bias together.
    """
    heading, bias = [], []
    for seed in range(6):
        recording = simulate("parked", seed, grade=grade, imu_rate=50.0, stop=200.0)
        wrong = 4.0 * float(np.random.default_rng(seed).normal())
        result = run_aided(
            recording, alignment__initial_heading_deg=-75.0 + wrong, alignment__initial_heading_std_deg=4.0
        )
        heading.append(nees(result.error[-1:], result.covariance[-1:], slice(8, 9))[0])
        bias.append(nees(result.error[-1:], result.covariance[-1:], slice(12, 15))[0])
    assert sum(heading) < chi2.ppf(0.999, 6), heading
    assert sum(bias) < chi2.ppf(0.999, 18), bias
