"""Pseudorange and range rate of a signal: Jacobian, prediction, noise, and the clock between epochs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.filter.history.records import PAYLOAD_SIZE
from eskf_ros.filter.state import augmented_states
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, INTER_SYSTEM, NOWHERE
from eskf_ros.filter.tight import pseudorange, range_rate
from eskf_ros.filter.tight import signal as signal_place
from eskf_ros.filter.tight.signal import FLAGS, MEASURED, SATELLITE, SATELLITE_VELOCITY, STD, source_of
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.gnss.measurements import MEASURED_SIGNAL, predict_measured
from eskf_ros.gnss.range_model import NO_KLOBUCHAR, PREDICTION
from eskf_ros.gnss.ranges import ALREADY_TURNED, IONOSPHERE_APPLIED, TROPOSPHERE_APPLIED
from eskf_ros.gnss.signals import BEIDOU_3, L1, Gnss
from eskf_ros.gnss.time import SECONDS_PER_WEEK
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING
from support.kernels import copy_of, make_settings, make_work, random_covariance, random_state, to_rotation, with_error

Array = NDArray[np.float64]

MOUNT = {"imu__mount_position": [0.3, 0.1, -0.2], "imu__mount_rpy_deg": [10.0, -20.0, 130.0]}
WHITE = {"mode": "tight", "ranges__correlation_time": 0.0}
SETTINGS = make_settings(**WHITE, gnss__lever_arm=[0.8, -0.2, 1.4], **MOUNT)
LASTING = make_settings(
    mode="tight",
    ranges__correlation_time=60.0,
    ranges__correlated_std=2.5,
    ranges__correlated_std_vertical=4.0,
    **MOUNT,
)
LONG_ARM = make_settings(**WHITE, gnss__lever_arm=[25.0, -12.0, 8.0], **MOUNT)
KLOBUCHAR = np.array([1.77e-8, 2.235e-8, -1.192e-7, -5.96e-8, 1.27e5, 1.475e5, -1.966e5, -1.966e5])

CLOCK = int(SETTINGS["clock_at"])
OFFSETS = int(SETTINGS["inter_system_at"])
SIZE = OFFSETS + len(INTER_SYSTEM)
PERTURBATION = np.concatenate([np.repeat([1.0, 1.0, 1e-5, 0.1, 1e-2], 3), [10.0, 0.1], np.ones(len(INTER_SYSTEM))])
WEEK, SECONDS = 2300, 205400.0
GALILEO = source_of(int(Gnss.GALILEO), 11, 0)
GPS = source_of(int(Gnss.GPS), 7, 0)
APPLIED = IONOSPHERE_APPLIED | TROPOSPHERE_APPLIED

places = pytest.mark.parametrize("far", [0.0, 50e3])
seeds = pytest.mark.parametrize("seed", range(5))
arms = pytest.mark.parametrize("settings", [SETTINGS, LONG_ARM], ids=["short", "long"])


def tight_state(seed: int, far: float = 3000.0) -> Any:
    """Return a running filter in which the clock and all offsets are in use."""
    state = random_state(seed, far)
    augmented_states.update_error_size(state, SIZE, SETTINGS)
    rng = np.random.default_rng(seed)
    state["optional"][CLOCK - ERROR_SIZE : SIZE - ERROR_SIZE] = rng.normal(0.0, 30.0, SIZE - CLOCK)
    return state


def signal_payload(state: Any, seed: int, elevation_deg: float = 40.0, flags: int = APPLIED) -> Array:
    """Return the payload of a satellite at this elevation, seen from the state."""
    rng = np.random.default_rng(seed)
    ecef = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ state["position_map"]
    latitude, longitude, _ = ecef_to_geodetic(*ecef)
    elevation, azimuth = math.radians(elevation_deg), rng.uniform(0.0, 2.0 * math.pi)
    local = [math.cos(elevation) * math.sin(azimuth), math.cos(elevation) * math.cos(azimuth), math.sin(elevation)]
    unit = np.array(east_north_up_to_ecef(latitude, longitude)) @ local
    payload = np.zeros(PAYLOAD_SIZE)
    payload[SATELLITE : SATELLITE + 3] = ecef + 22e6 * unit
    payload[SATELLITE_VELOCITY : SATELLITE_VELOCITY + 3] = rng.normal(0.0, 2000.0, 3)
    payload[MEASURED], payload[STD], payload[FLAGS] = 22e6, math.nan, flags
    payload[9:13] = L1, 42.0, 1.0, WEEK * SECONDS_PER_WEEK + SECONDS
    return payload


def with_all_errors(state: Any, error: Array) -> Any:
    true = with_error(state, error[:ERROR_SIZE])
    true["optional"] = state["optional"]
    true["optional"][CLOCK - ERROR_SIZE : SIZE - ERROR_SIZE] += error[ERROR_SIZE:]
    return true


def numerical_jacobian(predict: Any, state: Any) -> Array:
    """Differentiate a prediction by the errors of core, clock and offsets."""
    jacobian = np.empty(len(PERTURBATION))
    for j, step in enumerate(PERTURBATION):
        error = step * np.eye(len(PERTURBATION))[j]
        jacobian[j] = (predict(with_all_errors(state, error)) - predict(with_all_errors(state, -error))) / (2.0 * step)
    return jacobian


def columns(work: Any) -> Array:
    return np.concatenate([work["jacobian"][0, :ERROR_SIZE], work["jacobian"][0, CLOCK:SIZE]])


@places
@seeds
@arms
@pytest.mark.parametrize("flags", [APPLIED, APPLIED | ALREADY_TURNED])
def test_jacobian_of_pseudorange(seed: int, far: float, settings: Any, flags: int) -> None:
    state = tight_state(seed, far)
    payload, work = signal_payload(state, seed, flags=flags), make_work()
    assert pseudorange.linearize(state, payload, GALILEO, settings, work) == 1
    expected = numerical_jacobian(lambda s: pseudorange.predict(s, payload, GALILEO, settings)[0], state)
    # Per metre: the satellite turns with the Earth for 70 ms. Ranges of 2e7 m round at 4e-9 m.
    atol = np.concatenate([np.full(3, 2e-6), np.full(3, 1e-8), np.full(3, 1e-3), np.full(14, 1e-8)])
    np.testing.assert_array_less(np.abs(columns(work) - expected), atol)
    assert (work["jacobian"][0, ERROR_SIZE:CLOCK] == 0.0).all()


@places
@seeds
@arms
@pytest.mark.parametrize("flags", [APPLIED, APPLIED | ALREADY_TURNED])
def test_jacobian_of_range_rate(seed: int, far: float, settings: Any, flags: int) -> None:
    """Position through the turning line of sight, velocity, attitude, gyro bias, clock drift."""
    state = tight_state(seed, far)
    payload, work = signal_payload(state, seed, flags=flags), make_work()
    assert range_rate.linearize(state, payload, settings, work) == 1
    expected = numerical_jacobian(lambda s: range_rate.predict(s, payload, settings)[0], state)
    # The changing light time changes all by 1 + v/c.
    atol = np.concatenate([np.full(3, 3e-8), np.full(3, 3e-5), np.full(3, 1e-3), np.full(14, 1e-3)])
    np.testing.assert_array_less(np.abs(columns(work) - expected), atol)
    assert np.abs(expected[:3]).max() > 1e-6
    assert np.abs(expected[6:9]).max() > 0.1
    assert np.abs(expected[12:15]).max() > 0.1
    assert columns(work)[16] == 1.0


@seeds
@pytest.mark.parametrize("flags", [0, IONOSPHERE_APPLIED, TROPOSPHERE_APPLIED, ALREADY_TURNED])
@pytest.mark.parametrize("has_model", [True, False])
def test_prediction_and_noise_are_those_of_the_range_model(seed: int, flags: int, has_model: bool) -> None:
    """The innovation is what another implementation leaves of the measurement, less clock and offset."""
    settings = make_settings(**WHITE, gnss__lever_arm=[0.8, -0.2, 1.4], **MOUNT)
    klobuchar = KLOBUCHAR if has_model else NO_KLOBUCHAR
    state = tight_state(seed)
    payload, work = signal_payload(state, seed, 25.0, flags), make_work()
    payload[MEASURED] = 22.1e6
    payload[signal_place.KLOBUCHAR : signal_place.KLOBUCHAR + 8] = klobuchar
    turn = to_rotation(state["attitude"])
    arm = settings["lever_arms_body"][0]
    rate = state["angular_rate"] - state["gyro_bias"] - turn.inv().apply(state["frame"]["earth_rate_map"])
    antenna = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ (state["position_map"] + turn.apply(arm))
    motion = state["frame"]["map_to_ecef"] @ (state["velocity_map"] + turn.apply(np.cross(rate, arm)))
    signal = np.zeros(1, MEASURED_SIGNAL)[0]
    signal["gnss_id"], signal["sv_id"], signal["flags"] = Gnss.GALILEO, 11, flags
    signal["pseudorange"], signal["range_rate"] = 22.1e6, -300.0
    signal["code_std"] = signal["range_rate_std"] = math.nan
    signal["satellite"] = payload[SATELLITE : SATELLITE + 3]
    signal["satellite_velocity"] = payload[SATELLITE_VELOCITY : SATELLITE_VELOCITY + 3]
    signal["carrier_hz"], signal["cn0"], signal["noise_factor"] = L1, 42.0, 1.0
    expected = np.zeros(1, PREDICTION)[0]
    geodetic = ecef_to_geodetic(*antenna)
    local = east_north_up_to_ecef(geodetic[0], geodetic[1])
    place = (tuple(antenna.tolist()), tuple(motion.tolist()), *geodetic, local, WEEK, SECONDS)
    predict_measured(signal, *place, klobuchar, DEFAULT_WEIGHTING, expected)

    bias, drift = state["optional"][CLOCK - ERROR_SIZE : CLOCK - ERROR_SIZE + 2]
    offset = state["optional"][OFFSETS - ERROR_SIZE + INTER_SYSTEM.index(Gnss.GALILEO)]
    pseudorange.linearize(state, payload, GALILEO, settings, work)
    np.testing.assert_allclose(work["innovation"][0], expected["code_residual"] - bias - offset, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(work["noise"][0, 0], expected["code_std"] ** 2, rtol=1e-12)
    payload[MEASURED] = -300.0
    state["gyro_noise"]["density"] = shown = 3.0 * settings["gyro_noise_density"]
    range_rate.linearize(state, payload, settings, work)
    np.testing.assert_allclose(work["innovation"][0], expected["doppler_residual"] - drift, rtol=0.0, atol=1e-8)
    lever = turn.apply(arm)
    unit = state["frame"]["map_to_ecef"].T @ expected["line_of_sight"]
    gyro = shown**2 / state["imu"]["interval"] * np.sum(np.cross(unit, lever) ** 2)
    np.testing.assert_allclose(work["noise"][0, 0], expected["doppler_std"] ** 2 + gyro, rtol=1e-9)


def test_given_standard_deviations_are_scaled_and_floored() -> None:
    settings = make_settings(
        **WHITE, ranges__covariance_scale=4.0, ranges__code_std_floor=2.0, ranges__range_rate_std_floor=0.1
    )
    state, work = tight_state(0), make_work()
    payload = signal_payload(state, 0)
    for std, code, rate in ((3.0, 36.0, 36.0), (0.5, 4.0, 1.0), (0.01, 4.0, 0.01)):
        payload[STD] = std
        pseudorange.linearize(state, payload, GPS, settings, work)
        assert work["noise"][0, 0] == pytest.approx(code, rel=1e-12)
        range_rate.linearize(state, payload, settings, work)
        assert work["noise"][0, 0] == pytest.approx(rate, rel=1e-12)


def test_unknown_heading_leaves_the_lever_arm_to_the_noise() -> None:
    state, known, work = tight_state(2), make_work(), make_work()
    payload = signal_payload(state, 2)
    pseudorange.linearize(state, payload, GPS, SETTINGS, known)
    state["heading_known"] = 0
    pseudorange.linearize(state, payload, GPS, SETTINGS, work)
    lever = to_rotation(state["attitude"]).apply(SETTINGS["lever_arms_body"][0])
    horizontal = np.sum(known["jacobian"][0, :2] ** 2) * np.sum(lever[:2] ** 2)
    assert work["noise"][0, 0] - known["noise"][0, 0] == pytest.approx(horizontal, rel=1e-9)
    assert (work["jacobian"][0, 6:15] == 0.0).all()
    range_rate.linearize(state, payload, SETTINGS, work)
    assert (work["jacobian"][0, 6:15] == 0.0).all()


@pytest.mark.parametrize(("elevation_deg", "size"), [(9.0, 0), (11.0, 1), (-20.0, 0)])
def test_low_satellites_say_nothing(elevation_deg: float, size: int) -> None:
    state, work = tight_state(3), make_work()
    payload = signal_payload(state, 3, elevation_deg)
    assert pseudorange.linearize(state, payload, GPS, SETTINGS, work) == size
    assert range_rate.linearize(state, payload, SETTINGS, work) == size


def test_each_constellation_has_an_offset_of_its_own_and_gps_none() -> None:
    state, work = tight_state(4), make_work()
    payload = signal_payload(state, 4)
    seen = []
    for gnss, sv_id in ((0, 3), (1, 20), (2, 9), (3, 6), (3, 30), (5, 2), (6, 14)):
        pseudorange.linearize(state, payload, source_of(gnss, sv_id, 0), SETTINGS, work)
        seen.append(np.flatnonzero(work["jacobian"][0, OFFSETS:SIZE]).tolist())
    order = [[], *([INTER_SYSTEM.index(group)] for group in (1, 2, 3, BEIDOU_3, 5, 6))]
    assert seen == order
    # One that has not joined is not touched.
    state["error_size"] = OFFSETS
    pseudorange.linearize(state, payload, GALILEO, SETTINGS, work)
    assert (work["jacobian"][0, OFFSETS:] == 0.0).all()


@seeds
def test_what_lasts_moves_the_antenna_that_the_satellites_see(seed: int) -> None:
    """By its standard deviations times the state; its columns are those of the position times those."""
    state, work, plain = random_state(seed), make_work(), make_work()
    augmented_states.update_error_size(state, LASTING["reach"][Stream.PSEUDORANGE], LASTING)
    place = int(LASTING["position_error_at"])
    payload = signal_payload(state, seed)
    pseudorange.linearize(state, payload, GPS, LASTING, plain)
    stds = np.array([2.5, 2.5, 4.0])
    np.testing.assert_allclose(
        plain["jacobian"][0, place : place + 3], stds * plain["jacobian"][0, :3], rtol=1e-12, atol=0.0
    )
    lasting = np.random.default_rng(seed).normal(size=3)
    state["optional"][place - ERROR_SIZE : place - ERROR_SIZE + 3] = lasting
    pseudorange.linearize(state, payload, GPS, LASTING, work)
    change = work["innovation"][0] - plain["innovation"][0]
    assert change == pytest.approx(-plain["jacobian"][0, :3] @ (stds * lasting), abs=1e-7)
    assert SETTINGS["position_error_at"] == NOWHERE


def test_loose_has_neither_clock_nor_offsets() -> None:
    loose = make_settings()
    assert loose["clock_at"] == loose["inter_system_at"] == NOWHERE
    assert loose["reach"][Stream.PSEUDORANGE] == loose["reach"][Stream.RANGE_RATE] == ERROR_SIZE
    assert SETTINGS["reach"][Stream.PSEUDORANGE] == SETTINGS["reach"][Stream.RANGE_RATE] == CLOCK + 2


@pytest.mark.parametrize("steps", [1, 50])
def test_clock_between_epochs(steps: int) -> None:
    """Bias integrates drift, and the covariance is that of the continuous process, in steps of any length."""
    bias_noise, drift_noise, time = 0.1, 0.3, 2.0
    settings = make_settings(
        **WHITE,
        ranges__clock_bias_noise=bias_noise,
        ranges__clock_drift_noise=drift_noise,
        estimate__mounting_random_walk=0.0,
        estimate__wheel_scale_random_walk=0.0,
    )
    state = random_state(5)
    size = CLOCK + 2
    augmented_states.update_error_size(state, size, settings)
    stds = np.concatenate([np.repeat([2.0, 0.3, 0.02, 0.1, 0.003], 3), np.full(CLOCK - ERROR_SIZE, 1.0), [20.0, 0.5]])
    state["covariance"][:size, :size] = random_covariance(5, stds)
    state["optional"][CLOCK - ERROR_SIZE : size - ERROR_SIZE] = 100.0, -7.0
    before = copy_of(state)
    for _ in range(steps):
        augmented_states.propagate_augmented(state, time / steps, settings)
    transition = np.eye(size)
    transition[CLOCK, CLOCK + 1] = time
    expected = transition @ before["covariance"][:size, :size] @ transition.T
    q = drift_noise**2
    expected[CLOCK:, CLOCK:] += [
        [q * time**3 / 3.0 + bias_noise**2 * time, q * time**2 / 2.0],
        [q * time**2 / 2.0, q * time],
    ]
    np.testing.assert_allclose(state["covariance"][:size, :size], expected, rtol=1e-9, atol=1e-12)
    assert (state["covariance"] == state["covariance"].T).all()
    np.testing.assert_allclose(state["optional"][CLOCK - ERROR_SIZE : size - ERROR_SIZE], [86.0, -7.0], rtol=1e-12)
