"""Transition and noise of the error state against numerical differentiation and against dense matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.filter.inertial import covariance as kernel
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.predict import step
from eskf_ros.geodesy.earth import SEMI_MAJOR_AXIS
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
    run_samples,
    to_rotation,
    tuples,
    with_error,
)

Array = NDArray[np.float64]

WORK = make_work()
SETTINGS = make_settings()
QUIET = make_settings()
for _name in ("gyro_noise_density", "accel_noise_density", "gyro_bias_random_walk", "accel_bias_random_walk"):
    QUIET[_name] = 0.0

PERTURBATION = np.repeat([1000.0, 100.0, 1e-3, 1.0, 0.05], 3)
"""Steps of the numerical differentiation, which is of fourth order: large, so that rounding is small."""

GRAVITY_GRADIENT = 1.6e-6
"""Gravity over Earth radius, 1/s2."""

RATE, ANGULAR_ACCELERATION, FORCE, JERK = 3.0, 10.0, 15.0, 100.0
"""Length of the vectors of a robot that is shaken hard: rad/s, rad/s2, m/s2, m/s3."""


def readings(seed: int, dt: float) -> tuple[Any, Any, Any, Any]:
    """Return force and rate at both ends of an interval, in random directions."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(4, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    force, jerk, rate, acceleration = (
        directions * np.array([FORCE, JERK * dt, RATE, ANGULAR_ACCELERATION * dt])[:, None]
    )
    return tuples(force), tuples(rate), tuples(force + jerk), tuples(rate + acceleration)


def stepped(state: Any, samples: tuple[Any, Any, Any, Any], dt: float) -> Any:
    after = copy_of(state)
    step(after, *samples, dt, 0.0, QUIET, WORK)
    return after


def numerical_transition(state: Any, samples: tuple[Any, Any, Any, Any], dt: float) -> Array:
    """Differentiate the nominal model: errors after the step of true states that were off by one number before it."""
    nominal = stepped(state, samples, dt)
    transition = np.empty((15, 15))
    for j in range(15):
        error = PERTURBATION[j] * np.eye(15)[j]
        plus2, plus, minus, minus2 = (
            error_of(nominal, stepped(with_error(state, k * error), samples, dt)) for k in (2.0, 1.0, -1.0, -2.0)
        )
        transition[:, j] = (8.0 * (plus - minus) - (plus2 - minus2)) / (12.0 * PERTURBATION[j])
    return transition


def transition_of_step(state: Any, samples: tuple[Any, Any, Any, Any], dt: float) -> Array:
    """Return the transition that ``step`` applies to its covariance, column by column.

    Without noise P = e e' becomes (Phi e)(Phi e)'; the diagonal of Phi is positive, so the sign is known.
    """
    transition = np.empty((15, 15))
    for j in range(15):
        before = copy_of(state)
        core(before)[:] = 0.0
        core(before)[j, j] = 1.0
        after = core(stepped(before, samples, dt))
        transition[:, j] = after[:, j] / np.sqrt(after[j, j])
    return transition


def applied_to_identity(state: Any, samples: tuple[Any, Any, Any, Any], dt: float, coupling: float = 1.0) -> Array:
    """Apply the transition kernel to the identity, its arguments worked out here from what its docstring says.

    The six rows of the biases, which the kernel leaves out, are those of the identity.
    """
    force_0, rate_0, force_1, rate_1 = (np.array(part) for part in samples)
    turn = 0.5 * dt * (0.5 * (rate_0 + rate_1) - state["gyro_bias"])
    middle = to_rotation(state["attitude"]) * Rotation.from_rotvec(turn)
    force = middle.apply(0.5 * (force_0 + force_1) - state["accel_bias"])
    gravity = np.array(gravity_map(state, tuples(state["position_map"])))
    strength = float(np.linalg.norm(gravity))
    moving = np.empty((9, 15))
    rows = tuple(tuple(float(value) for value in row) for row in middle.as_matrix())
    earth_rate = tuples(state["frame"]["earth_rate_map"])
    up = tuples(-gravity / strength)
    kernel.apply_transition(
        np.eye(15), moving, 15, rows, tuples(force), up, strength / SEMI_MAJOR_AXIS, earth_rate, dt, coupling
    )
    return np.vstack([moving, np.eye(15)[9:]])


def tolerance(dt: float) -> Array:
    """Return what the block transition may be off by: its terms of third order in ``dt``, and gravity's gradient.

    The rotation of mid-interval stands for the mean over the interval, the mean force for the force that the changing
    attitude error meets: ``lost`` of them is neglected. Gravity's gradient is that of a sphere: flattening and
    centrifugal part, 1.5 % of it, are left out, and it acts on the position error of the start of the interval.
    """
    lost = (RATE * dt) ** 2 / 6.0 + ANGULAR_ACCELERATION * dt**2 / 6.0
    change = RATE * dt + JERK / FORCE * dt
    # Rounding: positions to 1e-14 m over the steps of differentiation.
    bound = np.full((15, 15), 2e-11)
    blocks = {
        (6, 12): dt * lost,
        (3, 9): dt * lost,
        (0, 9): dt**2 * lost,
        (3, 6): FORCE * dt * lost,
        (0, 6): FORCE * dt**2 * lost,
        (3, 12): FORCE * dt**2 * (change + lost) / 6.0,
        (0, 12): FORCE * dt**3 * (change + lost) / 6.0,
        (3, 0): 0.015 * GRAVITY_GRADIENT * dt,
        (0, 0): 0.015 * GRAVITY_GRADIENT * dt**2,
        # The Earth turns by 7e-5 rad/s: its square.
        (3, 3): GRAVITY_GRADIENT * dt**2 + 1e-8 * dt**2,
        (0, 3): GRAVITY_GRADIENT * dt**3 + 1e-8 * dt**3,
        (6, 6): 1e-8 * dt**2,
    }
    for (row, column), value in blocks.items():
        bound[row : row + 3, column : column + 3] += value
    return bound


def state_near_datum(seed: int) -> Any:
    """Return a running filter at small coordinates, so that differences of positions keep their digits.

    That it accelerates is beyond doubt: F has the whole force.
    """
    state = random_state(seed, far=10.0)
    state["excitation"]["left"] = kernel.EXCITED_TIME
    return state


@pytest.mark.parametrize("dt", [0.001, 0.005, 0.02])
@pytest.mark.parametrize("seed", range(8))
def test_transition_is_the_derivative_of_the_nominal_model(seed: int, dt: float) -> None:
    state, samples = state_near_datum(seed), readings(seed, dt)
    expected = numerical_transition(state, samples, dt)
    for transition in (applied_to_identity(state, samples, dt), transition_of_step(state, samples, dt)):
        excess = np.abs(transition - expected) / tolerance(dt)
        worst = np.unravel_index(np.argmax(excess), excess.shape)
        assert excess.max() < 1.0, (worst, transition[worst], expected[worst], excess.max())


@pytest.mark.parametrize("seed", range(3))
def test_transition_errs_in_third_order(seed: int) -> None:
    """Half the interval, an eighth of the error (a quarter would be a term of second order gone)."""
    state = state_near_datum(seed)
    errors = []
    for dt in (0.04, 0.02, 0.01):
        samples = readings(seed, dt)
        difference = applied_to_identity(state, samples, dt) - numerical_transition(state, samples, dt)
        # The columns of the position hold the gravity gradient, an approximation of first order on purpose.
        errors.append(np.abs(difference[:, 3:]).max())
    assert errors[0] / errors[1] > 6.5, errors
    assert errors[1] / errors[2] > 6.5, errors


def test_transition_far_from_the_datum() -> None:
    """Gravity's gradient follows the local vertical, which 900 km away is 8 degrees off the map's."""
    state = random_state(3, far=10.0)
    state["position_map"] = (900e3, 0.0, -63e3)
    samples = readings(3, 0.02)
    difference = applied_to_identity(state, samples, 0.02) - numerical_transition(state, samples, 0.02)
    assert np.abs(difference[3:6, 0:3]).max() < 0.015 * GRAVITY_GRADIENT * 0.02


def test_unknown_heading_cuts_velocity_from_attitude_and_accelerometer_bias() -> None:
    state, samples = random_state(1), readings(1, 0.01)
    full, cut = (applied_to_identity(state, samples, 0.01, coupling) for coupling in (1.0, 0.0))
    assert (cut[0:6, 6:15] == 0.0).all()
    np.testing.assert_array_equal(cut[6:], full[6:])
    np.testing.assert_array_equal(cut[:, 0:6], full[:, 0:6])


def dense_noise(dt: float, gap: float = 0.0) -> Array:
    """Process noise of ``dt`` s: white acceleration integrated twice, white rate, random walks."""
    eye = np.eye(3)
    acceleration = SETTINGS["accel_noise_density"] ** 2 + SETTINGS["gap_accel_std"] ** 2 * gap
    rate = SETTINGS["gyro_noise_density"] ** 2 + SETTINGS["gap_gyro_std"] ** 2 * gap
    noise = np.zeros((15, 15))
    noise[0:3, 0:3] = acceleration * dt**3 / 3.0 * eye
    noise[0:3, 3:6] = noise[3:6, 0:3] = acceleration * dt**2 / 2.0 * eye
    noise[3:6, 3:6] = acceleration * dt * eye
    noise[6:9, 6:9] = rate * dt * eye
    noise[9:12, 9:12] = SETTINGS["accel_bias_random_walk"] ** 2 * dt * eye
    noise[12:15, 12:15] = SETTINGS["gyro_bias_random_walk"] ** 2 * dt * eye
    return noise


@pytest.mark.parametrize(("dt", "gap"), [(0.005, 0.0), (0.02, 0.0), (0.02, 0.7)])
@pytest.mark.parametrize("seed", range(4))
def test_propagation_is_the_dense_product(seed: int, dt: float, gap: float) -> None:
    state, samples = random_state(seed), readings(seed, dt)
    state["excitation"]["left"] = kernel.EXCITED_TIME
    before = random_covariance(seed, USUAL_STDS)
    transition = transition_of_step(state, samples, dt)
    core(state)[:] = before
    step(state, *samples, dt, gap, SETTINGS, WORK)
    after = core(state)
    expected = transition @ before @ transition.T + dense_noise(dt, gap)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(after / scale, expected / scale, rtol=0.0, atol=1e-13)
    assert (after == after.T).all()


def test_a_gap_adds_the_variance_of_a_constant_hidden_motion() -> None:
    """An unmeasured acceleration, constant over the gap: velocity sigma is std times gap at its end."""
    gap, dt = 0.4, 0.02
    variances = []
    for hole in (0.0, gap):
        state = make_state()
        for _ in range(round(gap / dt)):
            still = ((0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
            step(state, *still, *still, dt, hole, SETTINGS, WORK)
        variances.append(np.diag(core(state)).copy())
    extra = variances[1] - variances[0]
    # Without what the tilt, itself more uncertain, adds to the horizontal velocity: the vertical one.
    assert np.sqrt(extra[5]) == pytest.approx(SETTINGS["gap_accel_std"] * gap, rel=1e-3)
    np.testing.assert_allclose(np.sqrt(extra[6:9]), SETTINGS["gap_gyro_std"] * gap, rtol=1e-3)


def test_covariance_stays_symmetric_and_positive_definite_for_an_hour() -> None:
    """An hour without any aid, from a very certain start with all biases: uncertainty grows by seven decades."""
    rng = np.random.default_rng(4)
    stamps = np.arange(0, 3600 * 10**9 + 1, 20_000_000, dtype=np.int64)
    seconds = stamps * 1e-9
    force = np.stack([np.sin(0.5 * seconds), np.cos(0.3 * seconds), 9.8 + 0.0 * seconds], axis=-1)
    rate = np.stack([0.02 * np.cos(seconds), 0.02 * np.sin(seconds), 0.1 * np.sin(0.05 * seconds)], axis=-1)
    state = make_state()
    stds = np.repeat([1e-3, 1e-3, 1e-5, 0.1, 1e-2], 3)
    core(state)[:] = np.diag((stds * rng.uniform(0.5, 2.0, 15)) ** 2)
    run_samples(state, stamps, force, rate, SETTINGS, WORK)
    after = core(state)
    assert (after == after.T).all()
    assert np.isfinite(after).all()
    assert conditioned_eigenvalues(after).min() > 1e-13, conditioned_eigenvalues(after)


@pytest.mark.parametrize("seed", range(3))
def test_transformed_attitude_error(seed: int) -> None:
    before = random_covariance(seed, USUAL_STDS)
    matrix = np.random.default_rng(seed).normal(size=(3, 3))
    after = before.copy()
    kernel.update_error_axes(after, 6, tuple(tuples(row) for row in matrix))
    full = np.eye(15)
    full[6:9, 6:9] = matrix
    np.testing.assert_allclose(after, full @ before @ full.T, rtol=1e-12, atol=1e-18)


def still_for(seconds: float, settings: Any, state: Any, seed: int) -> Any:
    """Propagate ``state`` through the noise of an accelerometer at rest, told in ``settings``; 100 Hz."""
    rng = np.random.default_rng(seed)
    std = float(settings["accel_noise_density"]) / np.sqrt(0.01)
    for force in rng.normal((0.0, 0.0, 9.81), std, (round(100.0 * seconds), 3)):
        step(state, tuples(force), (0.0, 0.0, 0.0), tuples(force), (0.0, 0.0, 0.0), 0.01, 0.0, settings, WORK)
    return state


def velocity_by_heading(state: Any) -> float:
    """How far (m/s) a heading error of a radian moves the horizontal velocity, by the covariance."""
    covariance = core(state)
    return float(np.linalg.norm(covariance[3:5, 8]) / covariance[8, 8])


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_the_accelerometer_does_not_show_the_heading(seed: int) -> None:
    """A minute at rest ties the velocity, which GNSS will measure, to no unknown heading; an acceleration does."""
    # Without a datum the Earth does not turn, which would show the heading too, a little.
    state = make_state(datum=None)
    core(state)[8, 8] = 0.03
    assert velocity_by_heading(still_for(60.0, SETTINGS, state, seed)) < 0.01
    for _ in range(200):
        step(state, (1.0, 0.0, 9.81), (0.0, 0.0, 0.0), (1.0, 0.0, 9.81), (0.0, 0.0, 0.0), 0.01, 0.0, SETTINGS, WORK)
    assert velocity_by_heading(state) > 1.0


@pytest.mark.parametrize("known", [True, False])
def test_an_acceleration_that_may_be_tilt_does_not_show_the_heading(known: bool) -> None:
    """0.3 m/s2 for two seconds, 0.6 m/s: not with a tilt uncertain by 3 degrees, nearly all of it with one of 0.05."""
    state = make_state(datum=None)
    core(state)[6:9, 6:9] = np.diag([0.001**2, 0.001**2, 0.03] if known else [0.05**2, 0.05**2, 0.03])
    for _ in range(200):
        step(state, (0.3, 0.0, 9.81), (0.0, 0.0, 0.0), (0.3, 0.0, 9.81), (0.0, 0.0, 0.0), 0.01, 0.0, SETTINGS, WORK)
    shown = abs(core(state)[4, 8]) / core(state)[8, 8]
    assert shown == pytest.approx(0.6, abs=0.04) if known else shown == 0.0


def test_accelerations_are_believed_for_a_while_after_one_that_stands_out() -> None:
    """Beyond five standard deviations of the noise, and a minute from then on."""
    noise, level = 0.03, (1.0, 0.0, 0.0)
    edge = 5.0 * noise / np.sqrt(2.0)
    for factor, seconds in ((0.99, 0.0), (1.05, kernel.EXCITED_TIME)):
        excitation = make_state()["excitation"]
        excitation["acceleration"] = (factor * edge, 0.0, 0.0)
        believed = 0
        for _ in range(7000):
            if believed == 0:
                excitation["acceleration"] = (factor * edge, 0.0, 0.0)
            axes = (level, (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
            force = kernel.credible_force(
                excitation, np.zeros((15, 15)), axes, (1e-3, 0.0, 9.81), (0.0, 0.0, -9.81), 0.01, noise
            )
            assert force[2] == pytest.approx(9.81)
            believed += force[0] != 0.0
        assert believed * 0.01 == pytest.approx(seconds, abs=0.1)
