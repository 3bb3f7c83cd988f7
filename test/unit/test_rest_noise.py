"""White noise of the gyros, measured at rest: what it is, and what is none."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.filter.inertial.gyro_noise import gyro_density, gyro_noise_variance
from eskf_ros.filter.integrity.sample_report import noise_complaints
from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters.mapping import from_mapping

Array = NDArray[np.float64]

RATE = 200
TOLD = 1e-4
"""rad/s/rtHz."""

TIMES = np.arange(40 * RATE) / RATE


def standing(rates: Array, seconds: float = 40.0) -> tuple[Any, Any]:
    """Return state and settings of a filter whose IMU has stood still, but for these rates (n, 3) in rad/s."""
    navigator = Navigator(from_mapping({"imu.gyro_noise_density": TOLD}))
    count = round(seconds * RATE)
    force = (0.0, 0.0, 9.81) + 0.01 * np.random.default_rng(0).normal(size=(count, 3))
    navigator.push_imu(10**9 + np.arange(count) * (10**9 // RATE), force, rates[:count])
    return navigator._states[0], navigator._settings[0]


def white(density: float, seed: int = 1) -> Array:
    rng = np.random.default_rng(seed)
    return np.asarray(density * math.sqrt(RATE) * rng.normal(size=(len(TIMES), 3)))


@pytest.mark.parametrize("ratio", [2.0, 5.0, 10.0])
def test_gyros_that_are_noisier_than_told_are_measured_allowed_for_and_named(ratio: float) -> None:
    state, settings = standing(white(ratio * TOLD))
    assert gyro_density(state, settings) == pytest.approx(ratio * TOLD, rel=0.15)
    assert gyro_noise_variance(state, settings) == pytest.approx((ratio * TOLD) ** 2 * RATE, rel=0.3)
    (sentence,) = noise_complaints(state, settings)
    name, _, value = sentence.rpartition(" to ")
    assert "imu.gyro_noise_density" in name
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
