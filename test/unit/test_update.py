"""The one measurement update against a dense Kalman update; gates; what a rejected measurement leaves behind."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eskf_ros.filter.fuse import fuse
from eskf_ros.filter.history.records import AID
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.layout import blank_state
from eskf_ros.filter.measurements.kalman_update import (
    ITERATIONS,
    invert_positive,
    update,
    update_nominal_state,
)
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.memory import allocate
from support.kernels import (
    USUAL_STDS,
    conditioned_eigenvalues,
    copy_of,
    core,
    error_of,
    make_settings,
    make_state,
    make_work,
    random_covariance,
    random_state,
    to_rotation,
    tuples,
    with_error,
)
from support.reference_filter import correction_by, reset_by

Array = NDArray[np.float64]

OPEN_GATE = 1e300


def measurement(seed: int, size: int, noise_std: float = 0.5) -> Any:
    """Return WORK with a random Jacobian (whole and sparse rows), innovation and correlated noise."""
    rng = np.random.default_rng(seed)
    work = make_work()
    jacobian = rng.normal(size=(3, 15)) * (rng.random((3, 15)) < rng.choice([0.2, 1.0]))
    jacobian[:, 0:3] += np.eye(3)
    work["jacobian"][:, :15] = jacobian
    work["innovation"] = rng.normal(0.0, noise_std, 3)
    work["noise"] = random_covariance(seed + 1, [noise_std] * 3)
    if size < 3:
        # What lies beyond the size must not count.
        work["noise"][size:], work["noise"][:, size:] = np.nan, np.nan
        work["jacobian"][size:], work["innovation"][size:] = np.nan, np.nan
    return work


def dense_update(covariance: Array, work: Any, size: int) -> tuple[Array, Array, float]:
    """Return correction, Joseph covariance before the reset, normalised innovation squared; all by matrices.

    Position and velocity are corrected in axes that turn with the attitude: what they change less counts again.
    """
    h, z = work["jacobian"][:size, :15].copy(), work["innovation"][:size].copy()
    r = work["noise"][:size, :size].copy()
    s = h @ covariance @ h.T + r
    gain = np.linalg.solve(s, h @ covariance).T
    keep = np.eye(15) - gain @ h
    return (
        correction_by(gain, h, z, ITERATIONS),
        keep @ covariance @ keep.T + gain @ r @ gain.T,
        float(z @ np.linalg.solve(s, z)),
    )


def reset(state: Any, correction: Array) -> Array:
    """All but biases turns about the vertical with the heading: R_true = exp(heading) exp(tilt) R."""
    up = -np.array(gravity_map(state, tuples(state["position_map"])))
    up /= np.linalg.norm(up)
    return reset_by((up @ correction[6:9]) * up, 15)


@settings(max_examples=150)
@given(
    seed=st.integers(0, 2**31),
    size=st.integers(1, 3),
    spread=st.floats(-2.0, 2.0),
    noise_std=st.floats(-2.0, 1.0).map(lambda exponent: 10.0**exponent),
)
def test_update_is_the_dense_kalman_update(seed: int, size: int, spread: float, noise_std: float) -> None:
    state = random_state(seed % 1000)
    covariance = random_covariance(seed, USUAL_STDS * 10.0**spread)
    core(state)[:] = covariance
    before = copy_of(state)
    work = measurement(seed, size, noise_std)
    correction, joseph, nis = dense_update(covariance, work, size)
    verdict, our_nis = update(state, size, OPEN_GATE, work)
    assert verdict == Verdict.FUSED
    assert our_nis == pytest.approx(nis, rel=1e-7)
    # The state moved by the correction, the attitude by a rotation on the map side.
    moved = error_of(before, state)
    turn = Rotation.from_rotvec(correction[6:9]).as_rotvec()
    expected = np.concatenate([correction[:6], turn, correction[9:]])
    np.testing.assert_allclose(moved / USUAL_STDS, expected / USUAL_STDS, rtol=1e-6, atol=1e-7)
    turned = reset(state, correction)
    after = turned @ joseph @ turned.T
    scale = np.sqrt(np.outer(np.diag(after), np.diag(after)))
    np.testing.assert_allclose(core(state) / scale, after / scale, rtol=0.0, atol=1e-6)


def test_reset_of_a_large_correction_of_the_heading() -> None:
    """A turn of 0.8 rad at once: a tilt error of the old attitude is that of the new one, turned with the body.

    R_true = exp(heading) exp(tilt) R, exactly: the deviation of the tilt, before, is turned by the correction.
    """
    state = random_state(5)
    up = -np.array(gravity_map(state, tuples(state["position_map"])))
    up /= np.linalg.norm(up)
    across = np.cross(up, [1.0, 0.0, 0.0])
    tilt = 0.02 * across / np.linalg.norm(across)
    core(state)[6:9, 6:9] = np.outer(tilt, tilt) + 0.64 * np.outer(up, up)
    before = copy_of(state)
    work = make_work()
    work["jacobian"][0, 6:9] = up
    work["noise"][0, 0] = 1e-12
    work["innovation"][0] = 0.8
    assert update(state, 1, OPEN_GATE, work)[0] == Verdict.FUSED
    true = Rotation.from_rotvec(0.8 * up) * Rotation.from_rotvec(tilt) * to_rotation(before["attitude"])
    left = (true * to_rotation(state["attitude"]).inv()).as_rotvec()
    np.testing.assert_allclose(core(state)[6:9, 6:9], np.outer(left, left), rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("turn_deg", [-60.0, 5.0, 40.0])
def test_a_velocity_tells_the_heading_of_an_acceleration_along_the_arc(turn_deg: float) -> None:
    """A robot has sped up from rest by 10 m/s in an unknown direction: one velocity tells which, exactly.

    A filter whose errors are on the tangent finds the sine of the turn, 50 degrees of 60, and is sure of it to 0.1.
    """
    speed, turn, heading_std, velocity_std = 10.0, math.radians(turn_deg), math.radians(40.0), 0.02
    state = make_state(velocity=(speed, 0.0, 0.0))
    p = core(state)
    p[:] = 1e-8 * np.eye(15)
    root = np.zeros(15)
    root[4], root[8] = speed * heading_std, heading_std
    p += np.outer(root, root)
    work = make_work()
    true = speed * np.array([math.cos(turn), math.sin(turn)])
    work["jacobian"][:2, 3:5] = np.eye(2)
    work["innovation"][:2] = true - (speed, 0.0)
    work["noise"][:2, :2] = velocity_std**2 * np.eye(2)
    assert update(state, 2, OPEN_GATE, work)[0] == Verdict.FUSED
    found = to_rotation(state["attitude"]).as_rotvec()[2]
    assert abs(found - turn) < math.radians(1.5)
    np.testing.assert_allclose(state["velocity_map"][:2], true, atol=0.3)
    # What is left of the error of the heading is one across the velocity as it is now.
    left = core(state)[3:5, 8] / core(state)[8, 8]
    np.testing.assert_allclose(left, speed * np.array([-math.sin(turn), math.cos(turn)]), atol=0.3)


def test_corrections_of_the_tilt_say_nothing_of_the_heading() -> None:
    """The gyro's noise tilts the attitude a thousand times, gravity corrects it: an unknown heading stays unknown.

    Would fail with the Jacobian of the one rotation vector, which tips the axis of the unknown heading each time.
    """
    rng = np.random.default_rng(3)
    state, work = make_state(), make_work()
    core(state)[6:9, 6:9] = np.diag([1e-6, 1e-6, 0.04])
    for _ in range(1000):
        core(state)[[6, 7], [6, 7]] += 1e-6
        work["jacobian"][:2, 6:8] = np.eye(2)
        work["noise"][:2, :2] = 1e-8 * np.eye(2)
        work["innovation"][:2] = rng.normal(0.0, 1e-3, 2)
        assert update(state, 2, OPEN_GATE, work)[0] == Verdict.FUSED
    assert core(state)[8, 8] == pytest.approx(0.04, rel=1e-9)


@pytest.mark.parametrize("believed", [False, True])
def test_gnss_corrects_the_heading_only_while_an_acceleration_is_believed(believed: bool) -> None:
    """Else the heading and the gyro bias about the vertical stay, however the IMU is mounted, and nothing else does.

    Would fail with the gain of the update, or with the axes of the IMU taken for those of the map.
    """
    state = random_state(5)
    covariance = random_covariance(6, USUAL_STDS)
    core(state)[:] = covariance
    state["excitation"]["left"] = 10.0 if believed else 0.0
    up = -np.array(gravity_map(state, tuples(state["position_map"])))
    up /= np.linalg.norm(up)
    before, rotation, work = copy_of(state), to_rotation(state["attitude"]), measurement(7, 3)
    work["holds_heading"] = 1
    assert update(state, 3, OPEN_GATE, work)[0] == Verdict.FUSED
    turned = work["correction"][6:9].copy()
    body_up = rotation.inv().apply(up)
    drifted = state["gyro_bias"] - before["gyro_bias"]
    is_held = max(abs(up @ turned) / np.linalg.norm(turned), abs(body_up @ drifted) / np.linalg.norm(drifted)) < 1e-9
    assert is_held is not believed
    variance = up @ covariance[6:9, 6:9] @ up
    left = up @ core(state)[6:9, 6:9] @ up
    assert left < 0.99 * variance if believed else left == pytest.approx(variance, rel=1e-9)
    assert np.linalg.norm(turned - (up @ turned) * up) > 0.0


@given(st.integers(0, 2**31))
def test_injection_is_the_error_definition(seed: int) -> None:
    state = random_state(seed % 1000)
    correction = np.random.default_rng(seed).normal(size=15) * np.repeat([5.0, 1.0, 0.5, 0.1, 0.01], 3)
    expected = with_error(state, correction)
    update_nominal_state(state, correction)
    for name in ("position_map", "velocity_map", "accel_bias", "gyro_bias"):
        np.testing.assert_allclose(state[name], expected[name], rtol=0.0, atol=1e-12)
    assert (to_rotation(state["attitude"]) * to_rotation(expected["attitude"]).inv()).magnitude() < 1e-14
    assert np.linalg.norm(state["attitude"]) == pytest.approx(1.0, abs=4e-16)


def test_certain_measurements_of_an_uncertain_state() -> None:
    """Position 1000 m uncertain, fixes of a millimetre, again and again with everything correlated."""
    state = random_state(3)
    core(state)[:] = random_covariance(2, np.repeat([1000.0, 100.0, 3.0, 0.2, 0.01], 3))
    rng = np.random.default_rng(1)
    for turn in range(300):
        work = measurement(turn, 3)
        work["jacobian"][:, :15] = rng.normal(0.0, 0.3, (3, 15)) * (rng.random((3, 15)) < 0.3)
        column = 3 * (turn % 2)
        work["jacobian"][:, column : column + 3] += np.eye(3)
        work["innovation"] = 0.0
        work["noise"] = 1e-6 * np.eye(3)
        assert update(state, 3, OPEN_GATE, work)[0] == Verdict.FUSED
        covariance = core(state)
        assert (covariance == covariance.T).all()
        assert conditioned_eigenvalues(covariance).min() > 0.0, (turn, conditioned_eigenvalues(covariance))


def test_the_same_certain_fix_a_thousand_times() -> None:
    state = random_state(3)
    core(state)[:] = np.diag(np.repeat([1000.0, 100.0, 3.0, 0.2, 0.01], 3) ** 2)
    work = measurement(1, 3)
    for count in range(1, 1001):
        work["jacobian"][:, :15] = np.eye(3, 15)
        work["innovation"] = 0.0
        work["noise"] = 1e-8 * np.eye(3)
        assert update(state, 3, OPEN_GATE, work)[0] == Verdict.FUSED
        np.testing.assert_allclose(np.diag(core(state))[:3], 1e-8 / count, rtol=1e-3)
    assert conditioned_eigenvalues(core(state)).min() > 0.0


@pytest.mark.parametrize("probability", [0.95, 0.999, 0.9999])
def test_gates_are_chi_square_quantiles(probability: float) -> None:
    gates = make_settings(gnss__gate_probability=probability)["gate"][Stream.GNSS_POSITION]
    for dof in (1, 2, 3):
        assert chi2.cdf(gates[dof], dof) == pytest.approx(probability, abs=1e-12)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_rejected_leaves_every_bit_as_it_was(size: int) -> None:
    state = random_state(8)
    core(state)[:] = random_covariance(9, USUAL_STDS)
    work = measurement(10, size)
    _, _, nis = dense_update(core(state), work, size)
    bits = state.tobytes()
    for gate, wanted in ((nis * (1.0 - 1e-9), Verdict.GATE), (0.0, Verdict.GATE)):
        verdict, our_nis = update(state, size, gate, work)
        assert (verdict, state.tobytes() == bits) == (wanted, True)
        assert our_nis == pytest.approx(nis, rel=1e-9)
    assert update(state, size, nis * (1.0 + 1e-9), work)[0] == Verdict.FUSED
    assert state.tobytes() != bits


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_innovation_that_is_no_number_is_rejected(bad: float) -> None:
    state = random_state(8)
    core(state)[:] = random_covariance(9, USUAL_STDS)
    work = measurement(10, 3)
    work["innovation"][1] = bad
    bits = state.tobytes()
    assert update(state, 3, OPEN_GATE, work)[0] == Verdict.GATE
    assert state.tobytes() == bits


@pytest.mark.parametrize(
    "noise", [-10.0 * np.eye(3), np.full((3, 3), np.nan), np.diag([1.0, 1.0, -500.0]), np.full((3, 3), np.inf)]
)
def test_noise_that_is_no_covariance_is_refused(noise: Array) -> None:
    state = random_state(8)
    core(state)[:] = random_covariance(9, USUAL_STDS)
    work = measurement(10, 3)
    work["noise"] = noise
    bits = state.tobytes()
    verdict, nis = update(state, 3, OPEN_GATE, work)
    assert verdict == Verdict.BAD_COVARIANCE
    assert np.isnan(nis)
    assert state.tobytes() == bits


@given(seed=st.integers(0, 2**31), size=st.integers(1, 3), decades=st.integers(0, 5))
def test_inverse(seed: int, size: int, decades: int) -> None:
    matrix = random_covariance(seed, 10.0 ** np.linspace(0, -decades, size))
    inverse = matrix.copy()
    assert invert_positive(inverse, size)
    assert (inverse == inverse.T).all()
    condition = np.linalg.cond(matrix)
    np.testing.assert_allclose(inverse @ matrix, np.eye(size), rtol=0.0, atol=1e-14 * condition)


def test_without_an_innovation_covariance_the_monitors_learn_nothing() -> None:
    """A negative variance makes it indefinite; half inverted it must not enter the sums of the receiver's faults."""
    settings, state, aids = make_settings(), random_state(1, 0.0), allocate(AID)
    state["covariance"][:15, :15] = np.diag(np.repeat([-1e6, 1.0, 1e-4, 1e-2, 1e-6], 3))
    aid = aids[0]
    aid["stream"], aid["stamp"], aid["verdict"] = Stream.GNSS_POSITION, state["stamp"], Verdict.WAITING
    aid["payload"][:3] = (0.84, 0.2, 565.0)
    aid["payload"][[3, 6, 8]] = 1.0
    states = blank_state()
    states[0] = state
    fuse(states, aids, 0, settings, make_work())
    state = states[0]
    assert aid["verdict"] == Verdict.BAD_COVARIANCE
    assert np.isfinite(state["installation"]["information"]).all()
    assert np.isfinite(state["installation"]["evidence"]).all()
    assert np.isfinite(state["receiver"]["drift_sums"]).all()
    assert not state["installation"]["information"].any()
