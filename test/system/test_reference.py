"""The kernels against plain numpy: prediction, updates and reset agree with the equations of docs/theory.md.

Ten minutes of the same are `benchmark/reference.py`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from support.reference_filter import Array, ReferenceFilter
from support.reference_run import Comparison, compare_loose, compare_tight, largest

AGREED = 1e-9
"""Largest relative difference. Rounding makes 1e-11 of it; an equation that is off by a millionth makes more."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("compare", "stop"), [pytest.param(compare_loose, 80.0, id="loose"), pytest.param(compare_tight, 60.0, id="tight")]
)
def test_kernels_agree_with_the_equations(compare: Callable[[float], list[Comparison]], stop: float) -> None:
    found = compare(stop)
    assert found[-1].seconds > 25.0
    for name, difference in largest(found).items():
        assert difference < AGREED, name


def test_a_wrong_equation_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of what gravity changes with the position, 4e-7 /s2, is left out."""
    transition = ReferenceFilter.transition

    def wrong(self: ReferenceFilter, rotation: Array, force: Array, g: Array, dt: float) -> Array:
        return transition(self, rotation, force, np.asarray(0.5 * g), dt)

    monkeypatch.setattr(ReferenceFilter, "transition", wrong)
    assert largest(compare_loose(50.0))["covariance"] > AGREED
