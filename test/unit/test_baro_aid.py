"""Air pressure: Jacobian, the standard atmosphere, and what it does for the height while there is no GNSS."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from test_aiding import geodetic_of

from eskf_ros.filter.measurements import baro
from eskf_ros.filter.state import augmented_states
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.simulate.barometer import Barometer, standard_pressure
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import simulate
from monte_carlo import Run, feed
from support.aided import AidedNavigator, offers, run_aided
from support.kernels import Array, make_settings, make_work, random_state, with_error

SETTINGS = make_settings(
    baro__position=[1.5, -2.0, 0.7], imu__mount_position=[0.3, 0.1, -0.2], imu__mount_rpy_deg=[10.0, -20.0, 130.0]
)
OFFSET, SCALE = int(SETTINGS["baro_offset_at"]), int(SETTINGS["baro_scale_at"])
SENSOR = Barometer(position=(0.2, 0.1, 0.3))

seeds = pytest.mark.parametrize("seed", range(5))
places = pytest.mark.parametrize("far", [0.0, 50e3, 500e3])


def running(seed: int, far: float) -> Any:
    """Return a running filter with the states of the barometer, in the troposphere however far from the datum."""
    state = random_state(seed, far)
    x, y, _ = state["position_map"]
    state["position_map"][2] = -(x**2 + y**2) / (2.0 * 6.37e6) + 50.0
    augmented_states.update_error_size(state, SETTINGS["reach"][Stream.BARO], SETTINGS)
    rng = np.random.default_rng(seed)
    state["optional"][OFFSET - ERROR_SIZE] = rng.normal(0.0, 100.0)
    state["optional"][SCALE - ERROR_SIZE] = rng.normal(0.0, 0.05)
    return state


def payload(pressure: float, variance: float = 9.0) -> Array:
    return np.array([pressure, 0.0, 0.0, variance, *np.zeros(12)])


@places
@seeds
def test_jacobian(seed: int, far: float) -> None:
    state, work = running(seed, far), make_work()
    assert baro.linearize(state, payload(9.0e4), 0, SETTINGS, work) == 1
    expected = np.zeros(work["jacobian"].shape[1])
    for j in range(15):
        step = 1e-3 if j in (6, 7, 8) else 0.5
        plus, minus = (baro.predict(with_error(state, k * step * np.eye(15)[j]), 0, SETTINGS) for k in (1.0, -1.0))
        expected[j] = (plus - minus) / (2.0 * step)
    for place, step in ((OFFSET, 1.0), (SCALE, 1e-3)):
        values = []
        for k in (1.0, -1.0):
            state["optional"][place - ERROR_SIZE] += k * step
            values.append(baro.predict(state, 0, SETTINGS))
            state["optional"][place - ERROR_SIZE] -= k * step
        expected[place] = (values[0] - values[1]) / (2.0 * step)
    np.testing.assert_allclose(work["jacobian"][0], expected, rtol=1e-6, atol=3e-6)
    assert np.abs(expected[6:9]).max() > 0.1


@places
@seeds
def test_innovation_is_the_difference_of_heights(seed: int, far: float) -> None:
    """Pressure by the atmosphere of the simulator, height of the barometer by pymap3d."""
    state, work = running(seed, far), make_work()
    state["optional"][:] = 0.0
    body = make_settings(imu__mount_position=[0.3, 0.1, -0.2], imu__mount_rpy_deg=[10.0, -20.0, 130.0])
    height = geodetic_of(state)[2]
    assert baro.predict(state, 0, make_settings()) == pytest.approx(height, abs=1e-6)
    arm = body["imu_to_base"].T @ (np.array([1.5, -2.0, 0.7]) - [0.3, 0.1, -0.2])
    np.testing.assert_allclose(SETTINGS["baro"]["arm_body"], arm, atol=1e-12)
    predicted = baro.predict(state, 0, SETTINGS)
    baro.linearize(state, payload(float(standard_pressure(np.array(predicted + 12.5)))), 0, SETTINGS, work)
    assert work["innovation"][0] == pytest.approx(12.5, abs=1e-6)
    # One pascal is this many metres.
    metres = -1.0 / np.gradient(standard_pressure(predicted + np.array([12.4, 12.5, 12.6])), 0.1)[1]
    assert math.sqrt(work["noise"][0, 0]) == pytest.approx(3.0 * metres, rel=1e-4)


def test_without_a_heading_it_says_nothing_of_the_attitude() -> None:
    state, work = running(1, 0.0), make_work()
    state["heading_known"] = 0
    baro.linearize(state, payload(9.0e4), 0, SETTINGS, work)
    assert (work["jacobian"][0, 6:9] == 0.0).all()
    assert np.linalg.norm(work["jacobian"][0, :3]) > 0.8


# ------------------------------------------------------------------------------------------------------- outages


def vertical(result: Run, begin: float, end: float) -> tuple[Array, Array]:
    """Vertical error (m) and its sigma between two times."""
    part = (result.seconds > begin) & (result.seconds < end)
    return result.error[part, 2], np.sqrt(result.covariance[part, 2, 2])


def flight(seed: int, sensor: Barometer | None = SENSOR) -> Recording:
    return simulate("multirotor", seed, imu_rate=50.0, stop=110.0, barometer=sensor, outages=((40.0, 105.0),))


HEADING = {"alignment__initial_heading_deg": 25.0, "alignment__initial_heading_std_deg": 1.0}


def test_height_holds_through_an_outage_and_the_covariance_is_honest() -> None:
    """A minute in the air, climbing and descending, without GNSS."""
    normalized, errors = [], {True: [], False: []}
    for seed in range(4):
        for aided in (True, False):
            result = run_aided(flight(seed, SENSOR if aided else None), **HEADING)
            error, sigma = vertical(result, 100.0, 105.0)
            errors[aided].append(np.abs(error).max())
            if aided:
                nis = result.records[(result.records["stream"] == Stream.BARO) & (result.records["dof"] > 0)]["nis"]
                assert 0.9 < nis.mean() < 1.1
                error, sigma = vertical(result, 40.0, 105.0)
                normalized.append(np.mean((error / sigma) ** 2))
    assert max(errors[True]) < 1.0
    assert np.mean(errors[True]) < 0.2 * np.mean(errors[False])
    assert 0.2 < np.mean(normalized) < 2.5, normalized


def with_scale(recording: Recording, scale: float) -> Recording:
    """Air in which pressure altitude grows faster than height."""
    assert recording.barometer is not None
    altitude = baro.TEMPERATURE_HEIGHT * (1.0 - (recording.barometer.pressure / 101325.0) ** baro.EXPONENT)
    pressure = standard_pressure(altitude + scale * (altitude - altitude[0]))
    return dataclasses.replace(recording, barometer=dataclasses.replace(recording.barometer, pressure=pressure))


def test_warm_air_is_part_of_the_sigma() -> None:
    """Six per cent of a climb of tens of metres: with the scale in the model the error stays within its sigma."""
    worst = {}
    for std in (0.06, 0.001):
        normalized = []
        for seed in range(2):
            result = run_aided(with_scale(flight(seed), 0.06), baro__scale_std=std, **HEADING)
            error, sigma = vertical(result, 60.0, 105.0)
            normalized.append(np.abs(error / sigma).max())
        worst[std] = max(normalized)
    assert worst[0.06] < 3.5, worst
    assert worst[0.001] > worst[0.06], worst


# ------------------------------------------------------------------------------------------------ what goes wrong


def run_through(recording: Recording, navigator: AidedNavigator) -> None:
    for _ in feed(recording, navigator, np.array([len(recording.imu_stamp) - 1])):
        pass


def test_a_lasting_step_of_the_pressure_is_found_out() -> None:
    """A door: 8 m at once, for good. Refused at first, then the offset begins anew; the height does not follow."""
    recording = simulate("drive", 2, imu_rate=50.0, stop=60.0, barometer=SENSOR)
    assert recording.barometer is not None
    pressure = recording.barometer.pressure.copy()
    stepped = recording.barometer.stamp > recording.imu_stamp[0] + 30 * 10**9
    pressure[stepped] += 100.0
    changed = dataclasses.replace(recording, barometer=dataclasses.replace(recording.barometer, pressure=pressure))
    result = run_aided(changed)
    error, sigma = vertical(result, 25.0, 60.0)
    assert (np.abs(error) < 4.0 * sigma).all()
    records = result.records[result.records["stream"] == Stream.BARO]
    seconds = (records["stamp"] - recording.imu_stamp[0]) * 1e-9
    assert np.count_nonzero(records["verdict"][(seconds > 30.0) & (seconds < 35.0)] == Verdict.GATE) > 90
    assert set(records["verdict"][seconds > 36.0]) == {Verdict.FUSED}


@pytest.mark.parametrize(
    ("pressure", "verdict"),
    [
        (1013.2, Verdict.BAD_VALUE),
        (2.0e5, Verdict.BAD_VALUE),
        (-9.0e4, Verdict.BAD_VALUE),
        (math.nan, Verdict.NON_FINITE),
    ],
)
def test_impossible_pressures_are_named(pressure: float, verdict: Verdict) -> None:
    recording = simulate("drive", 2, imu_rate=50.0, stop=10.0, barometer=SENSOR)
    navigator = AidedNavigator(recording)
    navigator.offers = [(*offer[:2], (pressure, 0.0, 0.0), *offer[3:]) for offer in offers(recording)]
    run_through(recording, navigator)
    records = navigator.finish()
    assert set(records["verdict"][records["stream"] == Stream.BARO]) == {verdict}
