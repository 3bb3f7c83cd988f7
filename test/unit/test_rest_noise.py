"""White noise of the gyros, measured at rest: what it is, and what is none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import eskf_ros.filter
from eskf_ros.filter.inertial.gyro_noise import gyro_density, gyro_noise_variance
from eskf_ros.filter.integrity.sample_report import noise_complaints
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.body_velocity import BodyVelocity
from eskf_ros.simulate.scenario import simulate
from eskf_ros.simulate.wheel import WheelOdometer
from monte_carlo import feed
from support.aided import AidedNavigator

Array = NDArray[np.float64]

FILTER = Path(eskf_ros.filter.__file__).parent
RATE = 200
TOLD = 1e-4
"""rad/s/rtHz."""

NAME = "imu.gyro_noise_density"
TIMES = np.arange(40 * RATE) / RATE


def standing(
    rates: Array, seconds: float = 40.0, parameters: Mapping[str, Any] = MappingProxyType({NAME: TOLD})
) -> tuple[Any, Any]:
    """Return state and settings of a filter whose IMU has stood still, but for these rates (n, 3) in rad/s."""
    navigator = Navigator(from_mapping(dict(parameters)))
    count = round(seconds * RATE)
    force = (0.0, 0.0, 9.81) + 0.01 * np.random.default_rng(0).normal(size=(count, 3))
    navigator.push_imu(10**9 + np.arange(count) * (10**9 // RATE), force, rates[:count])
    return navigator._states[0], navigator._settings[0]


def white(density: float, seed: int = 1, seconds: float = 40.0) -> Array:
    rng = np.random.default_rng(seed)
    return np.asarray(density * math.sqrt(RATE) * rng.normal(size=(round(seconds * RATE), 3)))


@pytest.mark.parametrize("ratio", [2.0, 5.0, 10.0])
def test_gyros_that_are_noisier_than_told_are_measured_allowed_for_and_named(ratio: float) -> None:
    state, settings = standing(white(ratio * TOLD))
    assert gyro_density(state, settings) == pytest.approx(ratio * TOLD, rel=0.15)
    assert gyro_noise_variance(state, settings) == pytest.approx((ratio * TOLD) ** 2 * RATE, rel=0.3)
    (sentence,) = noise_complaints(state, settings)
    name, _, value = sentence.rpartition(" to ")
    assert NAME in name
    assert float(value) == pytest.approx(ratio * TOLD, rel=0.15)


@pytest.mark.parametrize("ratio", [0.1, 1.0])
def test_gyros_as_good_as_told_are_as_told(ratio: float) -> None:
    """Twenty gyros: noise of five windows alone is never taken for more."""
    for seed in range(20):
        state, settings = standing(white(ratio * TOLD, seed), 10.5)
        assert 0.0 < state["gyro_noise"]["density"] < 1.5 * TOLD
        assert gyro_density(state, settings) == TOLD
        assert noise_complaints(state, settings) == []


def test_vibration_and_sway_are_no_noise() -> None:
    """An engine at 27 Hz and waves of 2 s turn it by 0.25 deg/s: one shows in the changes only, one in the parts."""
    for frequency in (27.0, 0.5):
        swing = math.radians(0.25) * np.sin(2.0 * math.pi * frequency * TIMES)
        state, settings = standing(white(TOLD) + np.outer(swing, (0.0, 0.0, 1.0)))
        assert state["gyro_noise"]["windows"] > 15
        assert gyro_density(state, settings) == TOLD


def test_nothing_is_concluded_from_a_few_windows() -> None:
    state, settings = standing(white(10.0 * TOLD), 9.9)
    assert 0 < state["gyro_noise"]["windows"] < 5
    assert gyro_density(state, settings) == TOLD


@pytest.mark.parametrize("quantum", [1.0, 3.0, 30.0])
def test_a_coarse_sensor_is_as_noisy_as_told(quantum: float) -> None:
    """A resolution of up to three standard deviations adds little; a coarser one hides the noise."""
    step = quantum * TOLD * math.sqrt(RATE)
    state, settings = standing(np.round(white(TOLD) / step) * step)
    assert gyro_density(state, settings) == TOLD
    assert (state["gyro_noise"]["density"] > 0.8 * TOLD) == (quantum < 30.0)


WINDOW_TOO_SHORT = {"alignment__static_duration": 0.5}
"""Of its parts the noise is not measured: it stays what it was set to."""


def moved(told: float, shown: float, scenario: str, options: dict[str, Any], given: dict[str, Any]) -> Array:
    """Return the odometry, five times a second, of a robot at rest and in motion, with all its sensors.

    The noise of its gyros is ``told`` to the filter, and they have ``shown`` one before.
    """
    sensors = {"wheel": WheelOdometer(rate=10.0), "body_velocity": BodyVelocity(axes="xy", rate=10.0)}
    recording = simulate(scenario, 4, imu_rate=100.0, **{**sensors, **options})
    levers = {"nhc__position": (0.5, 0.2, -0.3), "body_velocity__mount_position": (0.5, 0.2, -0.3)}
    navigator = AidedNavigator(recording, **levers, **WINDOW_TOO_SHORT, imu__gyro_noise_density=told, **given)
    navigator._states["gyro_noise"]["density"] = shown
    rows = [navigator.odometry for _ in feed(recording, navigator, np.arange(199, len(recording.imu_stamp), 20))]
    assert navigator._states[0]["gyro_noise"]["windows"] == 0
    return np.concatenate([[row[0][name].ravel() for row in rows] for name in ODOMETRY.names or ()], axis=1)


@pytest.mark.parametrize(
    ("scenario", "options", "given"),
    [
        ("drive", {"stop": 60.0}, {"nhc__enabled": True, "zupt__enabled": True}),
        (
            "drive",
            {"stop": 60.0},
            {"nhc__enabled": True, "wheel__use": False, "body_velocity__use": False, "zupt__enabled": True}
            | {"alignment__initial_heading_deg": 0.0, "alignment__initial_heading_std_deg": 60.0},
        ),
        ("drive", {"start": 85.0, "stop": 125.0}, {"wheel__use": False, "alignment__moving_start_after": 4.0}),
        ("turn_in_place:20", {"stop": 60.0, "lever_arm": (0.3, 0.0, 1.0), "position_std": (0.01, 0.02)}, {}),
    ],
    ids=["all sensors", "heading given", "begun in motion", "turn in place"],
)
def test_what_the_gyros_have_shown_counts_as_if_it_were_told(
    scenario: str, options: dict[str, Any], given: dict[str, Any]
) -> None:
    """To the last bit: level, rest, search for the heading, prediction, receiver, wheels and constraints."""
    as_told = moved(1e-3, 0.0, scenario, options, given)
    np.testing.assert_array_equal(moved(1e-4, 1e-3, scenario, options, given), as_told)
    assert not np.array_equal(moved(1e-4, 0.0, scenario, options, given), as_told)


def test_at_rest_what_the_gyros_have_shown_counts_soon() -> None:
    """A minute after the start biases and heading are as uncertain as if the noise had been told."""
    given = {"alignment.initial_heading_deg": 0.0, "alignment.initial_heading_std_deg": 1.0, "zupt.enabled": True}

    def sigmas(told: float) -> Array:
        state, _ = standing(white(10.0 * TOLD, seconds=60.0), 60.0, {NAME: told, **given})
        return np.asarray(np.sqrt(np.diag(state["covariance"])[[6, 7, 8, 12, 13, 14]]))

    np.testing.assert_allclose(sigmas(TOLD), sigmas(10.0 * TOLD), rtol=0.1)


def test_a_gyro_as_noisy_as_the_defaults_leaves_rest_unbroken() -> None:
    """In two seconds its noise turns the level by 0.1 deg, which would pass for an acceleration of 0.02 m/s2."""
    for seed in range(10):
        state, _ = standing(white(1.5e-3, seed, seconds=60.0), 60.0, {})
        assert state["window"]["still_samples"] > 57 * RATE


def test_one_place_decides_how_noisy_the_gyros_are() -> None:
    """A kernel that reads the parameter itself would not learn what the gyros have shown."""
    readers = [path.name for path in FILTER.rglob("*.py") if "settings.gyro_noise_density" in path.read_text()]
    assert readers == ["gyro_noise.py"]
