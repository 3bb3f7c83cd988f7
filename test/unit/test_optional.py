"""Optional error states: they move with the core as a dense filter says, and cost nothing before they are needed."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from eskf_ros.filter.history.records import AID
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.integrity.receiver import reset_for_new_solution
from eskf_ros.filter.measurements import gnss_position
from eskf_ros.filter.measurements.kalman_update import ITERATIONS, update
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.predict import step
from eskf_ros.filter.state import augmented_states
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE, NOWHERE
from eskf_ros.filter.state.memory import allocate
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate
from monte_carlo import NO_SIDE_SLIP, nees, run
from support.kernels import (
    USUAL_STDS,
    copy_of,
    core,
    make_settings,
    make_state,
    make_work,
    random_covariance,
    random_state,
    tuples,
)
from support.reference_filter import correction_by, reset_by

Array = NDArray[np.float64]

TIME = 50.0
LASTING = make_settings(gnss__correlation_time=TIME, gnss__correlated_share=0.7)
PLACE = int(LASTING["position_error_at"])
SIZE = PLACE + 3
STDS = np.concatenate([USUAL_STDS, [1.0, 1.0, 1.0]])


def joined(seed: int) -> Any:
    """Return a running filter with the lasting position error in use, all of it correlated."""
    state = random_state(seed)
    augmented_states.update_error_size(state, LASTING["reach"][Stream.GNSS_POSITION], LASTING)
    state["covariance"][:SIZE, :SIZE] = random_covariance(seed, STDS)
    state["optional"][:3] = np.random.default_rng(seed).normal(size=3)
    # That it accelerates is beyond doubt: F has the whole force.
    state["excitation"]["left"] = 60.0
    return state


def test_nothing_is_in_use_by_default() -> None:
    """But for what wheels need, once there are any, and the lasting error of fixes, once they show one."""
    plain = make_settings()
    assert make_settings(gnss__correlation_time=0.0)["position_error_at"] == NOWHERE
    assert (plain["reach"][[Stream.GNSS_POSITION, Stream.GNSS_VELOCITY]] == ERROR_SIZE).all()


def test_joining_gives_the_first_variance_and_no_correlation() -> None:
    state = random_state(1)
    core(state)[:] = random_covariance(1, USUAL_STDS)
    state["covariance"][15:] = state["covariance"][:, 15:] = 7.0
    before = copy_of(state)
    augmented_states.update_error_size(state, SIZE, LASTING)
    assert state["error_size"] == SIZE
    np.testing.assert_array_equal(core(state), core(before))
    np.testing.assert_array_equal(state["covariance"][15:SIZE, :SIZE], np.eye(3, SIZE, 15))
    # Once more is nothing.
    core(state)[0, 0] = 5.0
    state["covariance"][15, 0] = state["covariance"][0, 15] = 0.3
    again = copy_of(state)
    augmented_states.update_error_size(state, SIZE, LASTING)
    assert state.tobytes() == again.tobytes()


@pytest.mark.parametrize("dt", [0.005, 0.02])
@pytest.mark.parametrize("seed", range(4))
def test_propagation_is_the_dense_product(seed: int, dt: float) -> None:
    """The core as without optional states; the common columns turn with it and fade; what lasts fades and is driven."""
    rng = np.random.default_rng(seed)
    state = joined(seed)
    before = copy_of(state)
    samples = [rng.normal(0.0, 3.0, 3) for _ in range(4)]
    work = make_work()
    step(state, *samples, dt, 0.0, LASTING, work)

    transition = np.empty((15, 15))
    quiet = LASTING.copy()
    for name in ("gyro_noise_density", "accel_noise_density", "gyro_bias_random_walk", "accel_bias_random_walk"):
        quiet[name] = 0.0
    for j in range(15):
        one = copy_of(before)
        one["error_size"] = 15
        core(one)[:] = 0.0
        core(one)[j, j] = 1.0
        step(one, *samples, dt, 0.0, quiet, work)
        transition[:, j] = core(one)[:, j] / math.sqrt(core(one)[j, j])
    fade = 1.0 - dt / TIME
    alone = copy_of(before)
    alone["error_size"] = 15
    step(alone, *samples, dt, 0.0, LASTING, work)

    np.testing.assert_array_equal(core(state), core(alone))
    old = before["covariance"]
    expected = transition @ old[:15, 15:SIZE] * fade
    scale = np.outer(STDS[:15], STDS[15:])
    np.testing.assert_allclose(state["covariance"][:15, 15:SIZE] / scale, expected / scale, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        state["covariance"][15:SIZE, 15:SIZE], old[15:SIZE, 15:SIZE] * fade**2 + 2.0 * dt / TIME * np.eye(3), rtol=1e-12
    )
    assert (state["covariance"] == state["covariance"].T).all()
    np.testing.assert_allclose(state["optional"][:3], before["optional"][:3] * fade, rtol=1e-12)


def test_what_lasts_keeps_its_variance_and_forgets_in_its_time() -> None:
    state = make_state()
    augmented_states.update_error_size(state, SIZE, LASTING)
    # How it starts shows in what it has in common with the position.
    state["covariance"][0, 15] = state["covariance"][15, 0] = 0.5
    for _ in range(round(TIME / 0.02)):
        augmented_states.propagate_augmented(state, 0.02, LASTING)
    np.testing.assert_allclose(np.diag(state["covariance"])[15:18], 1.0, rtol=1e-3)
    assert state["covariance"][0, 15] == pytest.approx(0.5 * math.exp(-1.0), rel=1e-3)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**31), size=st.integers(1, 3))
def test_update_is_the_dense_kalman_update(seed: int, size: int) -> None:
    state = joined(seed % 1000)
    rng = np.random.default_rng(seed)
    before = copy_of(state)
    work = make_work()
    work["jacobian"][:, :SIZE] = rng.normal(size=(3, SIZE))
    work["jacobian"][:, SIZE:] = np.nan
    work["innovation"] = rng.normal(0.0, 0.1, 3)
    work["noise"] = random_covariance(seed + 1, [0.5] * 3)
    h, r = work["jacobian"][:size, :SIZE].copy(), work["noise"][:size, :size].copy()
    p = before["covariance"][:SIZE, :SIZE]
    gain = np.linalg.solve(h @ p @ h.T + r, h @ p).T
    assert update(state, size, 1e300, work)[0] == Verdict.FUSED
    correction = correction_by(gain, h, work["innovation"][:size], ITERATIONS)
    np.testing.assert_allclose(state["optional"][:3], before["optional"][:3] + correction[15:], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(state["position_map"], before["position_map"] + correction[:3], rtol=0.0, atol=1e-9)
    after = (p - gain @ h @ p)[15:, 15:]
    np.testing.assert_allclose(state["covariance"][15:SIZE, 15:SIZE], after, rtol=0.0, atol=1e-8)
    up = -np.array(gravity_map(before, tuples(before["position_map"])))
    up /= np.linalg.norm(up)
    turned = reset_by((up @ correction[6:9]) * up, SIZE)
    expected = turned @ (p - gain @ h @ p) @ turned.T
    scale = np.outer(STDS[:SIZE], STDS[:SIZE])
    np.testing.assert_allclose(state["covariance"][:SIZE, :SIZE] / scale, expected / scale, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_a_fix_errs_by_what_lasts_and_what_is_new(seed: int) -> None:
    """Together they have the variance of the message; the part that lasts is seen in the innovation."""
    state = joined(seed)
    covariance = random_covariance(seed, [1.0, 0.7, 2.0])
    payload = np.array([0.8, 0.2, 500.0, *covariance[np.triu_indices(3)]])
    work, without = make_work(), make_work()
    gnss_position.linearize(state, payload, 0, LASTING, work)
    gnss_position.linearize(state, payload, 0, make_settings(), without)
    part = work["jacobian"][:, PLACE:SIZE]
    np.testing.assert_allclose(
        np.diag(part @ part.T + work["noise"]), np.diag(without["noise"]), rtol=1e-12, err_msg="variance of the fix"
    )
    np.testing.assert_allclose(work["noise"], 0.3 * without["noise"], rtol=1e-12)
    lasting = part @ state["optional"][:3]
    np.testing.assert_allclose(work["innovation"], without["innovation"] - lasting, rtol=0.0, atol=1e-9)
    assert np.abs(lasting).min() > 0.0


def fix_with_std(std: float) -> Any:
    aid = allocate(AID)[0]
    aid["stream"] = Stream.GNSS_POSITION
    aid["payload"][[3, 6, 8]] = std**2
    return aid


@pytest.mark.parametrize(("std", "renewed"), [(1.0, False), (1.9, False), (0.6, False), (0.02, True), (5.0, True)])
def test_another_kind_of_solution_has_another_error(std: float, renewed: bool) -> None:
    states = np.repeat(np.atleast_1d(joined(3)), 2)
    state = states[0]
    state["window"]["last_fix_variance"] = 2.0
    reset_for_new_solution(states, fix_with_std(std), LASTING, make_work())
    assert (state["covariance"][PLACE, :3] == 0.0).all() == renewed
    assert (state["optional"][:3] == 0.0).all() == renewed
    if renewed:
        np.testing.assert_array_equal(state["covariance"][PLACE:SIZE, :SIZE], np.eye(3, SIZE, PLACE))
    # From now on that is its kind.
    after = states.copy()
    reset_for_new_solution(states, fix_with_std(std), LASTING, make_work())
    assert states.tobytes() == after.tobytes()


def with_lasting_errors(recording: Recording, std: float, share: float, seed: int) -> Recording:
    """Give the fixes an error of ``std`` m per axis whose lasting share is a first-order Gauss-Markov process."""
    rng = np.random.default_rng(seed)
    interval = np.diff(recording.fix_stamp * 1e-9, prepend=0.0)
    lasting = np.empty((len(interval), 3))
    value = rng.normal(size=3)
    for k, seconds in enumerate(interval):
        remaining = math.exp(-seconds / TIME)
        value = remaining * value + math.sqrt(1.0 - remaining**2) * rng.normal(size=3)
        lasting[k] = value
    error = std * (math.sqrt(share) * lasting + math.sqrt(1.0 - share) * rng.normal(size=lasting.shape))
    latitude = np.radians(recording.fix_latitude_deg)
    return dataclasses.replace(
        recording,
        # Good to a per cent of the error.
        fix_latitude_deg=recording.fix_latitude_deg + np.degrees(error[:, 1] / 6.37e6),
        fix_longitude_deg=recording.fix_longitude_deg + np.degrees(error[:, 0] / (6.39e6 * np.cos(latitude))),
        fix_altitude=recording.fix_altitude + error[:, 2],
        fix_covariance=np.tile(std**2 * np.eye(3).ravel(), (len(error), 1)),
    )


def test_the_covariance_stays_honest_when_errors_of_the_fixes_last() -> None:
    """Ten fixes per second that err alike for a minute: without the model the filter is far too sure of itself.

    By default it learns the share that lasts.
    """
    means = {}
    for name, changes in (
        ("model", {"gnss.correlation_time": TIME, "gnss.correlated_share": 0.7}),
        ("learned", {}),
        ("none", {"gnss.correlation_time": 0.0}),
    ):
        values = []
        for seed in range(4):
            drive = simulate("drive", seed, imu_rate=50.0, gnss_rate=10.0, position_std=(1e-4, 1e-4), stop=120.0)
            recording = with_lasting_errors(drive, 2.0, 0.7, seed)
            parameters = {**recording.parameters(), **NO_SIDE_SLIP, **changes, "gnss.use_velocity": False}
            result = run(recording, Navigator(from_mapping(parameters)), 1.0)
            settled = result.aligned & (result.seconds > 60.0)
            values.append(nees(result.error[settled], result.covariance[settled], slice(0, 3)).mean())
        means[name] = np.mean(values)
    assert 1.5 < means["model"] < 5.0, means
    assert 1.5 < means["learned"] < 5.0, means
    assert means["none"] > 12.0, means


SECOND_ARM = (-1.1, 0.6, 1.2)


def two_receivers(recording: Recording, other: Recording, second_arm: tuple[float, ...]) -> Navigator:
    """Feed the fixes of two antennas, stamped alike, by turns."""
    mapping = {
        **recording.parameters(),
        **NO_SIDE_SLIP,
        "second_gnss.frame_id": "rear",
        "second_gnss.lever_arm": list(second_arm),
    }
    navigator = Navigator(from_mapping(mapping))
    last = 0
    for k, stamp in enumerate(recording.fix_stamp):
        end = int(np.searchsorted(recording.imu_stamp, stamp))
        part = slice(last, end)
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        last = end
        for frame, source in (("front", recording), ("rear", other)):
            position = (source.fix_latitude_deg[k], source.fix_longitude_deg[k], source.fix_altitude[k])
            navigator.push_gnss_position(int(stamp), *map(float, position), source.fix_covariance[k], 3, 2, 0, frame)
            velocity, covariance = source.velocity_enu[k], source.velocity_covariance[k]
            navigator.push_gnss_velocity(int(stamp), velocity, covariance, 0, frame)
    return navigator


def test_two_receivers_have_antennas_of_their_own() -> None:
    options: dict[str, Any] = {"imu_rate": 50.0, "gnss_rate": 2.0, "position_std": (0.02, 0.02), "stop": 60.0}
    recording = simulate("drive", 5, **options)
    other = simulate("drive", 6, lever_arm=SECOND_ARM, **options)
    good, bad = (two_receivers(recording, other, arm) for arm in (SECOND_ARM, (0.0, 0.0, 0.0)))
    records = good.finish()
    assert set(records["source"][records["stream"] == Stream.GNSS_VELOCITY]) == {0, 1}
    assert np.count_nonzero(records["verdict"] == Verdict.DUPLICATE) == 0
    # From the moment on at which the heading is known.
    tested = np.isfinite(records["nis"]) & (records["stamp"] > recording.imu_stamp[0] + 30 * 10**9)
    for source in (0, 1):
        assert 2.5 < records["nis"][tested & (records["source"] == source)].mean() < 3.5
    nis = bad.finish()
    # An antenna in the wrong place makes both contradict each other.
    assert np.nanmean(nis["nis"][nis["source"] == 1]) > 10.0
