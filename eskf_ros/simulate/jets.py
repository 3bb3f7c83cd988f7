"""Functions of time with their derivatives: arithmetic on Taylor polynomials.

Griewank and Walther, Evaluating Derivatives, 2nd ed., chapter 13. A motion written as a formula of such functions
has exact velocities, accelerations and angular rates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.motion import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Taylor:
    """A function of time around n times: ``c`` (order + 1, n), its k-th derivative divided by k!.

    Operations on functions of different order have the lower one.
    """

    c: Array

    @classmethod
    def of_derivatives(cls, derivatives: Sequence[Array] | Array) -> Taylor:
        """Return the function with the given value, first, second, ... derivative, each (n,)."""
        factorials = np.cumprod([1.0, *range(1, len(derivatives))])
        return cls(np.asarray(derivatives, dtype=np.float64) / factorials[:, None])

    @property
    def order(self) -> int:
        """The highest derivative that is known."""
        return len(self.c) - 1

    def derivative(self) -> Taylor:
        """Return the derivative by time, of an order less by one."""
        return Taylor(self.c[1:] * np.arange(1.0, len(self.c))[:, None])

    def integral(self, value: Array) -> Taylor:
        """Return the function with this derivative and the ``value`` (n,), of an order more by one."""
        return Taylor(np.concatenate([value[None], self.c / np.arange(1.0, len(self.c) + 1.0)[:, None]]))

    def __neg__(self) -> Taylor:
        """Return the negative."""
        return Taylor(-self.c)

    def __add__(self, other: Taylor | float) -> Taylor:
        """Return the sum."""
        if not isinstance(other, Taylor):
            return Taylor(np.concatenate([self.c[:1] + other, self.c[1:]]))
        rows = min(len(self.c), len(other.c))
        return Taylor(self.c[:rows] + other.c[:rows])

    __radd__ = __add__

    def __sub__(self, other: Taylor | float) -> Taylor:
        """Return the difference."""
        return self + -other

    def __rsub__(self, other: float) -> Taylor:
        """Return the difference."""
        return -self + other

    def __mul__(self, other: Taylor | float) -> Taylor:
        """Return the product."""
        if not isinstance(other, Taylor):
            return Taylor(self.c * other)
        rows = min(len(self.c), len(other.c))
        return Taylor(np.stack([(self.c[: k + 1] * other.c[k::-1]).sum(axis=0) for k in range(rows)]))

    __rmul__ = __mul__

    def __truediv__(self, other: Taylor) -> Taylor:
        """Return the quotient."""
        rows = min(len(self.c), len(other.c))
        q = np.empty((rows, self.c.shape[1]))
        for k in range(rows):
            q[k] = (self.c[k] - (other.c[1 : k + 1] * q[:k][::-1]).sum(axis=0)) / other.c[0]
        return Taylor(q)


def sqrt(x: Taylor) -> Taylor:
    """Return the square root of what is positive."""
    r = np.empty_like(x.c)
    r[0] = np.sqrt(x.c[0])
    for k in range(1, len(r)):
        r[k] = (x.c[k] - (r[1:k] * r[1:k][::-1]).sum(axis=0)) / (2.0 * r[0])
    return Taylor(r)


def sin_cos(x: Taylor) -> tuple[Taylor, Taylor]:
    """Return sine and cosine."""
    s, c = np.empty_like(x.c), np.empty_like(x.c)
    s[0], c[0] = np.sin(x.c[0]), np.cos(x.c[0])
    slope = x.c * np.arange(len(x.c))[:, None]
    for k in range(1, len(s)):
        s[k] = (slope[1 : k + 1] * c[:k][::-1]).sum(axis=0) / k
        c[k] = -(slope[1 : k + 1] * s[:k][::-1]).sum(axis=0) / k
    return Taylor(s), Taylor(c)


def sin(x: Taylor) -> Taylor:
    """Return the sine."""
    return sin_cos(x)[0]


def arctan2(y: Taylor, x: Taylor) -> Taylor:
    """Return the angle of (x, y), which is not the origin."""
    slope = (x * y.derivative() - y * x.derivative()) / (x * x + y * y)
    return slope.integral(np.arctan2(y.c[0], x.c[0]))


_AXES = {"x": 1, "y": 2, "z": 3}


def moving_body(position: Sequence[Taylor], turns: Sequence[tuple[str, Taylor]]) -> Motion:
    """Return the truth of a body from functions of time, of order 2 at least.

    ``position``: x, y, z in ``map``, m. ``turns``: what turns the axes of ``map`` into those of the body, one after the
    other, each about an axis ("x", "y" or "z") of those reached before, by an angle in rad.
    """
    attitude: list[Taylor] | None = None
    for axis, angle in turns:
        half_sine, half_cosine = sin_cos(0.5 * angle)
        zero = 0.0 * half_sine
        turn = [half_cosine, zero, zero, zero]
        turn[_AXES[axis]] = half_sine
        attitude = turn if attitude is None else _product(attitude, turn)
    assert attitude is not None
    # q' = q w / 2 (Sola, eq. 199): w = 2 q* q', and its derivative 2 q* q'' but for the scalar part.
    w, x, y, z = attitude
    conjugate = [w, -x, -y, -z]
    first = [component.derivative() for component in attitude]
    rate = _product(conjugate, first)[1:]
    acceleration = _product(conjugate, [component.derivative() for component in first])[1:]

    def rows(components: Sequence[Taylor], factor: float = 1.0) -> Array:
        return factor * np.stack([component.c[0] for component in components], axis=-1)

    velocity = [component.derivative() for component in position]
    return Motion(
        position_map=rows(position),
        velocity_map=rows(velocity),
        acceleration_map=rows([component.derivative() for component in velocity]),
        attitude_body_to_map=rows(attitude),
        angular_rate_body=rows(rate, 2.0),
        angular_acceleration_body=rows(acceleration, 2.0),
    )


def _product(a: Sequence[Taylor], b: Sequence[Taylor]) -> list[Taylor]:
    """Return the Hamilton product of two quaternions w x y z."""
    return [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
