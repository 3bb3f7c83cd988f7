"""Stepwise regression: the sweep operator against numpy, and the choice of causes against all regressions."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from eskf_ros.filter.integrity.stepwise import best_cause, explained, lost_by_exchange, sweep

Array = NDArray[np.float64]
CAUSES = 4


def problem(seed: int, measurements: int = 60) -> tuple[Array, Array, Array]:
    """Effects of the causes on measurements (n, 4), measurements (n,), and the matrix that `stepwise` works on."""
    rng = np.random.default_rng(seed)
    effects = rng.normal(size=(measurements, CAUSES)) @ rng.normal(size=(CAUSES, CAUSES))
    measured = effects @ rng.normal(size=CAUSES) + rng.normal(size=measurements)
    all_columns = np.column_stack([effects, measured])
    return effects, measured, all_columns.T @ all_columns


def left_by(effects: Array, measured: Array, causes: tuple[int, ...]) -> float:
    """Return the sum of squares that a regression on some of the causes leaves."""
    chosen = effects[:, causes]
    return float(np.sum((measured - chosen @ np.linalg.lstsq(chosen, measured, rcond=None)[0]) ** 2))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, CAUSES))
def test_causes_in_the_solution_have_the_estimates_of_a_regression_on_them(seed: int, count: int) -> None:
    effects, measured, matrix = problem(seed)
    chosen = effects[:, :count]
    for cause in range(count):
        sweep(matrix, cause)
    np.testing.assert_allclose(matrix[:count, :count], np.linalg.inv(chosen.T @ chosen), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(matrix[:count, -1], np.linalg.lstsq(chosen, measured, rcond=None)[0], rtol=1e-6)
    assert matrix[-1, -1] == pytest.approx(left_by(effects, measured, tuple(range(count))), rel=1e-6)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_a_second_sweep_takes_a_cause_out_again(seed: int) -> None:
    _, _, matrix = problem(seed)
    before = matrix.copy()
    for cause in (0, 2, 0, 2):
        sweep(matrix, cause)
    np.testing.assert_allclose(matrix, before, rtol=1e-7, atol=1e-7)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_best_cause_is_that_of_all_regressions_with_one_more(seed: int) -> None:
    effects, measured, matrix = problem(seed)
    is_chosen = np.array([0, 1, 0, 0])
    sweep(matrix, 1)
    gains = [left_by(effects, measured, (1,)) - left_by(effects, measured, (1, k)) for k in (0, 2, 3)]
    best, most = best_cause(matrix, is_chosen)
    assert (best, most) == ((0, 2, 3)[int(np.argmax(gains))], pytest.approx(max(gains), rel=1e-6))
    assert best_cause(matrix, np.ones(CAUSES, int)) == (-1, 0.0)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_an_exchange_loses_what_the_best_other_regression_leaves_more(seed: int) -> None:
    effects, measured, matrix = problem(seed)
    for cause in (0, 1):
        sweep(matrix, cause)
    before = matrix.copy()
    others = min(left_by(effects, measured, causes) for causes in ((1, 2), (1, 3)))
    expected = others - left_by(effects, measured, (0, 1))
    assert lost_by_exchange(matrix, np.array([1, 1, 0, 0]), 0) == pytest.approx(expected, rel=1e-5, abs=1e-6)
    np.testing.assert_allclose(matrix, before, rtol=1e-7, atol=1e-7)


def test_one_of_causes_that_look_alike_is_found_where_a_regression_on_all_leaves_all_uncertain() -> None:
    rng = np.random.default_rng(1)
    common = rng.normal(size=400)
    effects = np.column_stack([common + 0.06 * rng.normal(size=400) for _ in range(CAUSES)])
    measured = 3.0 * effects[:, 2] + rng.normal(size=400)
    columns = np.column_stack([effects, measured])
    matrix = columns.T @ columns
    covariance = np.linalg.inv(matrix[:CAUSES, :CAUSES])
    found = covariance @ matrix[:CAUSES, -1] / np.sqrt(np.diag(covariance))
    assert np.all(np.abs(found) < 6.0)
    best, most = best_cause(matrix, np.zeros(CAUSES, int))
    assert best == 2
    assert most > 1000.0
    runner_up = max(explained(matrix, k) for k in itertools.chain(range(2), [3]))
    assert most - runner_up == pytest.approx(3.0**2 * 400 * 0.06**2, rel=1.0)
