"""Position as the integral of a velocity that is known as a function of time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_KNOT_INTERVAL = 0.1
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(5)


class PositionIntegral:
    """The way from the start by Gauss quadrature between knots, exact to rounding for the motion of a vehicle."""

    def __init__(self, velocity: Callable[[Array], Sequence[Array]], breakpoints: Array) -> None:
        """Integrate ``velocity`` from time 0 on.

        It gives its three components, each (n, m), at times (n, m) in s, and is smooth between those of
        ``breakpoints``, which begin at 0.
        """
        self._velocity = velocity
        counts = np.ceil(np.diff(breakpoints) / _KNOT_INTERVAL).astype(int)
        starts = [
            np.linspace(begin, end, count, endpoint=False)
            for begin, end, count in zip(breakpoints[:-1], breakpoints[1:], counts, strict=True)
        ]
        self._knots = np.concatenate([*starts, breakpoints[-1:]])
        increments = self._displacement(self._knots[:-1], self._knots[1:])
        self._knot_positions = np.vstack([np.zeros(3), np.cumsum(increments, axis=0)])

    def __call__(self, times: Array) -> Array:
        """Return the position (n, 3) in m at ``times`` (n,), which lie between the first and the last breakpoint."""
        before = np.clip(np.searchsorted(self._knots, times, side="right") - 1, 0, len(self._knots) - 2)
        return self._knot_positions[before] + self._displacement(self._knots[before], times)

    def _displacement(self, begin: Array, end: Array) -> Array:
        """Return the way (n, 3) from ``begin`` to ``end`` (n,); none may cross a knot."""
        half = 0.5 * (end - begin)
        velocities = self._velocity(begin[:, None] + half[:, None] * (1.0 + _GAUSS_NODES))
        return np.stack([half * (velocity @ _GAUSS_WEIGHTS) for velocity in velocities], axis=-1)
