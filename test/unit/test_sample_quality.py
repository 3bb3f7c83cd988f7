"""Samples that do not measure: what they cost, over exactly their time, and what a good sensor does not pay for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.compiled import njit
from eskf_ros.filter import predict
from eskf_ros.filter.history.records import IMU
from eskf_ros.filter.inertial.sample_doubt import hide, shaken_velocity
from eskf_ros.filter.inertial.sample_quality import judge_sample
from eskf_ros.filter.integrity.sample_report import sample_complaints
from eskf_ros.filter.loop import take_sample
from eskf_ros.filter.measurements.gnss_velocity import add_unmeasured_motion
from eskf_ros.filter.state.memory import allocate
from support.kernels import make_settings, make_state, make_work, to_rotation

Array = NDArray[np.float64]

RATE = 100
SETTINGS, WORK = make_settings(), make_work()
SPEED = (15.0, 0.0, 0.0)
FORCE_NOISE, RATE_NOISE = 0.05, 0.005
"""m/s2, rad/s; standard deviation of a reading."""


@njit
def _run(state, samples, widened, speed, holds_speed, settings, work):
    for k in range(len(samples)):
        sample = samples[k]
        judge_sample(state, sample, sample.stamp, settings)
        widened[k] = state.quality.is_doubted
        predict.propagate(state, sample.stamp, sample, sample.stamp, settings, work)
        take_sample(state, sample, sample.stamp)
        if holds_speed:
            for i in range(3):
                # Somebody else holds position and velocity; this is about what an interval adds.
                state.velocity_map[i] = speed[i]


def readings(seconds: float, seed: int = 1) -> Array:
    """Six axes of a level robot (n, 6): slow turns, gentle acceleration, white noise."""
    t = np.arange(round(seconds * RATE)) / RATE
    rng = np.random.default_rng(seed)
    force = FORCE_NOISE * rng.normal(size=(len(t), 3)) + (0.0, 0.0, 9.8)
    rate = RATE_NOISE * rng.normal(size=(len(t), 3))
    force[:, 1] += 1.5 * np.sin(0.5 * t)
    rate[:, 2] += 0.25 * np.sin(0.5 * t)
    return np.hstack([force, rate])


def run(
    values: Array,
    speed: tuple[float, float, float] = SPEED,
    kept: Any = None,
    holds_speed: bool = True,
) -> tuple[Any, NDArray[np.int64]]:
    """The state after all samples, and which of the intervals were widened."""
    samples = allocate(IMU, len(values))
    samples["stamp"] = np.arange(1, len(values) + 1) * (1_000_000_000 // RATE)
    samples["specific_force"], samples["angular_rate"] = values[:, :3], values[:, 3:]
    if kept is not None:
        samples = samples[kept]
    state = make_state(velocity=speed)
    widened = np.zeros(len(samples), np.int64)
    _run(state, samples, widened, speed, holds_speed, SETTINGS, WORK)
    return state, widened


def attitude_std(state: Any) -> Array:
    return np.asarray(np.sqrt(np.diag(state["covariance"])[6:9]))


HOLE = slice(3000, 3160)


def filled(kind: str) -> Array:
    values = readings(40.0)
    first, last = values[HOLE.start].copy(), values[HOLE.stop].copy()
    share = np.linspace(0.0, 1.0, HOLE.stop - HOLE.start + 1)[:-1, None]
    values[HOLE] = first if kind == "repeated" else (1.0 - share) * first + share * last
    return values


@pytest.mark.parametrize("kind", ["repeated", "bridged"])
def test_a_filled_hole_costs_what_a_hole_costs(kind: str) -> None:
    """Velocity and attitude are as uncertain after it as if the samples were missing, and no sample more is."""
    state, widened = run(filled(kind))
    kept = np.ones(4000, bool)
    kept[HOLE.start + 1 : HOLE.stop] = False
    missing, _ = run(readings(40.0), kept=kept)
    clean, _ = run(readings(40.0))
    np.testing.assert_allclose(attitude_std(state), attitude_std(missing), rtol=0.05)
    assert (attitude_std(clean) < 0.03 * attitude_std(missing)).all()
    begin, end = np.flatnonzero(widened)[[0, -1]]
    assert HOLE.start < begin < HOLE.start + 0.15 * RATE
    assert abs(end - HOLE.stop) <= 1
    (sentence,) = sample_complaints(state)
    assert sentence.startswith("1 holes in the IMU data are filled")


def test_an_extreme_that_is_sent_again_is_no_end_of_the_range() -> None:
    """A hole filled with the hardest braking of the drive: 160 readings of the lowest value, to the last bit."""
    values = filled("repeated")
    values[HOLE, 0] = values[:, 0].min() - 0.1
    state, _ = run(values)
    (sentence,) = sample_complaints(state)
    assert sentence.startswith("1 holes in the IMU data are filled")


@pytest.mark.parametrize("is_turning", [False, True])
def test_while_standing_a_repeated_sample_costs_nothing(is_turning: bool) -> None:
    """But where it turns, a robot does not stand, however slow it is."""
    values = filled("repeated")
    values[:, 5] -= 0.0 if is_turning else 0.25 * np.sin(0.5 * np.arange(len(values)) / RATE)
    values[HOLE, 5] = values[HOLE.start, 5]
    _, widened = run(values, speed=(0.0, 0.0, 0.0))
    assert widened.any() == is_turning


@pytest.mark.parametrize("quantum", [0.0, 0.3, 1.0, 3.0, 10.0])
def test_a_coarse_sensor_that_works_costs_nothing(quantum: float) -> None:
    """Steps of up to ten standard deviations of the noise: repeated readings are usual then. Half an hour each."""
    values = readings(1800.0)
    if quantum:
        steps = quantum * np.repeat([FORCE_NOISE, RATE_NOISE], 3)
        values = np.round(values / steps) * steps
    state, widened = run(values)
    assert not widened.any()
    assert not sample_complaints(state)


def test_a_simulation_without_noise_costs_nothing() -> None:
    """Constant readings, straight lines and steps, again and again."""
    t = np.arange(60_000) / RATE
    values = np.zeros((len(t), 6))
    values[:, 2] = 9.81
    values[:, 5] = 0.2 * np.clip(np.sin(0.2 * t) * 3.0, -1.0, 1.0)
    values[:, 1] = 15.0 * values[:, 5]
    values[:, 0] = np.where(t % 20.0 < 2.0, 1.0, 0.0)
    state, widened = run(values)
    assert not widened.any()
    assert not sample_complaints(state)


def test_a_clipped_gyro_opens_the_heading_alone() -> None:
    values = readings(60.0)
    values[1000:, 5] = np.clip(2.0 * values[1000:, 5], -0.3, 0.3)
    state, widened = run(values)
    clipped = np.abs(values[:, 5]) == 0.3
    # From the seventh equal sample of a run on, and after it nothing.
    late = np.logical_and.reduce([np.roll(clipped, k) for k in range(7)])
    assert widened[late & (np.arange(len(values)) > 1000)].all()
    assert not widened[~clipped].any()
    std = attitude_std(state)
    assert std[2] > 0.2
    assert (std[:2] < 0.02).all()
    (sentence,) = sample_complaints(state)
    assert sentence.startswith("the z gyro is clipped at")
    assert "0.30 rad/s" in sentence


def test_a_gyro_that_is_clipped_while_the_robot_turns_in_place_opens_the_heading() -> None:
    """0.8 rad in 2 s are not read. A gyro that reads a rate does not say that the robot stands."""
    values, truth = readings(40.0), readings(40.0)
    truth[2000:2200, 5] += 0.7
    values[2000:2200, 5] = 0.3
    state, widened = run(values, speed=(0.0, 0.0, 0.0))
    clean, _ = run(truth, speed=(0.0, 0.0, 0.0))
    assert widened[2010:2200].all()
    error = (to_rotation(state["attitude"]) * to_rotation(clean["attitude"]).inv()).magnitude()
    assert error < 0.8
    assert 0.4 * error < attitude_std(state)[2] < 1.5
    assert attitude_std(state)[2] > 0.5


def test_a_rate_that_stops_at_the_same_size_twice_is_clipped_although_more_was_read_before() -> None:
    values = readings(40.0)
    values[500, 5], values[600, 5] = 0.9, -0.9
    values[2000:2030, 5] = 0.4
    values[2500:2540, 5] = -0.4
    state, widened = run(values)
    assert not widened[:2500].any()
    assert widened[2510:2540].all()
    (sentence,) = sample_complaints(state)
    assert sentence.startswith("the z gyro is clipped at -0.40 rad/s")


def shaken(seconds: float, amplitude: float, frequency: float = 23.0) -> Array:
    """Readings of a robot whose three accelerometers are shaken from 20 s on, each axis at its phase."""
    values = readings(seconds)
    phase = np.array([0.1, 0.45, 0.8])
    t = np.arange(len(values))[2000:, None] / RATE
    values[2000:, :3] += amplitude * np.sin(2.0 * math.pi * (frequency * t + phase))
    return values


def test_what_vibration_loses_at_the_end_of_the_range_is_within_its_sigma() -> None:
    """A quarter of the samples is clipped, never three in a row; all lose upward force: 0.9 m/s2 on the mean."""
    values = shaken(30.0, 15.0)
    clipped = values.copy()
    clipped[:, 2] = np.minimum(values[:, 2], 19.6)
    lost = (values - clipped)[:, 2].sum() / RATE
    assert lost > 8.0
    free = [run(each, holds_speed=False)[0] for each in (values, clipped)]
    error = abs(float(free[1]["velocity_map"][2] - free[0]["velocity_map"][2]))
    std = math.sqrt(float(free[1]["covariance"][5, 5]) - float(free[0]["covariance"][5, 5]))
    assert error < lost
    assert 0.3 * error < std < 4.0 * lost
    horizontal = np.diag(free[1]["covariance"] - free[0]["covariance"])[3:5]
    assert (horizontal < (0.1 * std) ** 2).all()


def test_errors_of_clipped_samples_add_in_amplitude() -> None:
    """Ten pieces of 0.1 s within a second, with pauses as long: nearly the variance of one second, not of ten parts."""
    quality = make_state()["quality"]
    total = 0.0
    for k in range(10):
        quality["doubt"][5] = 0.0
        hide(quality, 5, 0.3, 0.1, 1_000_000_000 + 200_000_000 * k, 0.1)
        total += 0.1 * float(quality["doubt"][5])
    assert 0.5 * 0.3**2 < total < 0.3**2


@pytest.mark.parametrize("frequency", [12.0, 23.0, 40.0])
def test_the_velocity_of_a_vibration_is_known_from_how_readings_change(frequency: float) -> None:
    state, _ = run(shaken(40.0, 10.0, frequency))
    expected = 10.0 / math.sqrt(2.0) / (2.0 * math.pi * frequency)
    assert abs(shaken_velocity(state["quality"], 1.0 / RATE) / expected - 1.0) < 0.2


def test_noise_and_slow_motion_are_no_vibration() -> None:
    state, _ = run(readings(40.0))
    assert shaken_velocity(state["quality"], 1.0 / RATE) < 0.001
    values = np.zeros((4000, 6))
    values[:, 0] = 5.0 * np.sin(2.0 * math.pi * np.arange(4000) / RATE)
    state, _ = run(values)
    assert shaken_velocity(state["quality"], 1.0 / RATE) == 0.0


def test_a_rate_that_is_not_measured_moves_the_antenna() -> None:
    """Clipped about z with the antenna 2 m ahead: the velocity across is uncertain, the others are not."""
    state = make_state()
    state["quality"]["is_doubted"] = 1
    state["quality"]["error"][5] = 0.3
    WORK["noise"][:] = 0.0
    add_unmeasured_motion(state, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (2.0, 0.0, 0.0), WORK)
    np.testing.assert_allclose(np.diag(WORK["noise"]), [0.0, 0.6**2, 0.0], atol=1e-12)


def test_a_stuck_axis_opens_its_own_direction() -> None:
    values = readings(40.0)
    values[2000:3000, 0] = values[2000, 0]
    state, widened = run(values)
    assert widened[2060:3000].all()
    assert not widened[:2040].any()
    assert not widened[3001:].any()
    (sentence,) = sample_complaints(state)
    assert sentence.startswith("the x accelerometer was stuck at")


def test_a_hard_shock_is_taken_by_half() -> None:
    """0.1 s of 100 m/s2 and 8 rad/s: whether the body followed or stayed, the error is about one sigma along each axis.

    And no more than half the blow, 0.8 rad.
    """
    values = readings(40.0)
    direction = np.array([0.6, -0.64, 0.48])
    values[3000:3010, :3] += 100.0 * direction
    values[3000:3010, 3:] += 8.0 * direction
    state, widened = run(values)
    clean, _ = run(readings(40.0))
    assert widened[3000:3010].all()
    assert not widened[:3000].any()
    assert not widened[3011:].any()
    added = np.sqrt(attitude_std(state) ** 2 - attitude_std(clean) ** 2)
    turned = (to_rotation(state["attitude"]) * to_rotation(clean["attitude"]).inv()).magnitude()
    assert abs(turned - 0.4) < 0.02
    np.testing.assert_array_less(0.5 * 0.8 * np.abs(direction), 1.05 * added)
    assert math.hypot(*added) < 0.55


def test_a_softer_shock_may_be_motion_and_is_taken_whole() -> None:
    """An aeroplane touches down: 30 m/s2 and 2.9 rad/s; its attitude is as uncertain as it has turned."""
    values = readings(40.0)
    values[3000:3010, 2] += 30.0
    values[3000:3010, 5] += 2.9
    state, _ = run(values)
    clean, _ = run(readings(40.0))
    turned = (to_rotation(state["attitude"]) * to_rotation(clean["attitude"]).inv()).magnitude()
    assert abs(turned - 0.29) < 0.01
    assert math.sqrt(attitude_std(state)[2] ** 2 - attitude_std(clean)[2] ** 2) > 0.9 * 0.29


def test_vibration_that_sets_in_is_no_shock_for_long() -> None:
    """An engine is switched on: 15 m/s2 and 1.5 rad/s from sample to sample cost the first tenths of a second."""
    values = readings(60.0)
    rng = np.random.default_rng(3)
    values[3000:] += np.repeat([15.0, 1.5], 3) * rng.normal(size=(3000, 6))
    _, widened = run(values)
    assert np.flatnonzero(widened).max() < 3200


def test_a_swing_about_the_mean_is_no_shock_but_a_step_as_large_is() -> None:
    """A pothole swings the pitch rate by 1.1 rad/s from one sample to the next, 0.55 rad/s to each side of the mean."""
    swing, step = readings(40.0), readings(40.0)
    swing[3000:3006, 4] += np.array([0.55, -0.55, -0.3, 0.55, -0.4, 0.1])
    step[3000:3010, 4] += 1.1
    assert not run(swing)[1].any()
    assert run(step)[1][3000:3010].all()
