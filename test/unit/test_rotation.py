"""Rotations against scipy; ``w x y z`` here, ``x y z w`` there."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.geodesy import rotation
from support.kernels import to_quaternion, to_rotation, tuples

Array = NDArray[np.float64]

numbers = st.floats(-1.0, 1.0, allow_subnormal=False)
vectors = st.tuples(numbers, numbers, numbers)
axes = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: np.array(v) / np.linalg.norm(v))
angles = st.one_of(
    st.floats(0.0, math.pi),
    # Around the switch to the series, and next to half a turn.
    st.floats(-14.0, -0.5).map(lambda exponent: 10.0**exponent),
    st.floats(-14.0, -0.5).map(lambda exponent: math.pi - 10.0**exponent),
)
rotation_vectors = st.builds(lambda axis, angle: axis * angle, axes, angles)
quaternions = st.builds(
    lambda v, sign: sign * to_quaternion(Rotation.from_rotvec(v)), rotation_vectors, st.sampled_from([1, -1])
)


def assert_same(ours: Any, theirs: Rotation, atol: float = 4e-15) -> None:
    assert abs(np.linalg.norm(ours) - 1.0) < 1e-15
    np.testing.assert_allclose(to_rotation(ours).as_matrix(), theirs.as_matrix(), rtol=0.0, atol=atol)


def matrix_of(rows: Any) -> Array:
    return np.array(rows)


@given(rotation_vectors)
def test_from_rotation_vector(v: Array) -> None:
    assert_same(rotation.from_rotation_vector(tuples(v)), Rotation.from_rotvec(v))


@given(rotation_vectors)
def test_rotation_vector_there_and_back(v: Array) -> None:
    back = rotation.to_rotation_vector(rotation.from_rotation_vector(tuples(v)))
    # Half a turn has two vectors.
    if np.linalg.norm(v) > math.pi - 1e-12 and np.dot(back, v) < 0.0:
        back = tuples(-np.array(back))
    np.testing.assert_allclose(back, v, rtol=1e-14, atol=3e-15)


@given(quaternions)
def test_to_rotation_vector(q: Array) -> None:
    v = rotation.to_rotation_vector(tuples(q))
    assert np.linalg.norm(v) <= math.pi + 1e-15
    np.testing.assert_allclose(Rotation.from_rotvec(v).as_matrix(), to_rotation(q).as_matrix(), rtol=0.0, atol=4e-15)


def test_to_rotation_vector_of_nothing_and_of_half_turns() -> None:
    for sign in (1.0, -1.0):
        assert rotation.to_rotation_vector((sign, 0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0)
        # Either sign of the quaternion is the same small turn.
        np.testing.assert_allclose(
            rotation.to_rotation_vector((sign, sign * 1e-13, 0.0, 0.0)), (2e-13, 0.0, 0.0), rtol=1e-15
        )
        assert np.linalg.norm(rotation.to_rotation_vector((0.0, 0.0, sign, 0.0))) == math.pi


@given(quaternions, quaternions)
def test_multiply(a: Array, b: Array) -> None:
    assert_same(rotation.multiply(tuples(a), tuples(b)), to_rotation(a) * to_rotation(b))


@given(quaternions, vectors)
def test_to_matrix_and_rotate(q: Array, v: tuple[float, float, float]) -> None:
    matrix = rotation.to_matrix(tuples(q))
    np.testing.assert_allclose(matrix_of(matrix), to_rotation(q).as_matrix(), rtol=0.0, atol=2e-15)
    np.testing.assert_allclose(rotation.rotate(matrix, v), to_rotation(q).apply(v), rtol=0.0, atol=4e-15)
    np.testing.assert_allclose(rotation.rotate_back(matrix, v), to_rotation(q).inv().apply(v), rtol=0.0, atol=4e-15)


@given(quaternions)
def test_from_matrix(q: Array) -> None:
    ours = rotation.from_matrix(rotation.to_matrix(tuples(q)))
    assert ours[0] >= 0.0
    assert_same(ours, to_rotation(q))


def test_from_matrix_takes_every_branch() -> None:
    """Each of the four components as the largest, both signs of the others, exact half turns."""
    rng = np.random.default_rng(1)
    for largest in range(4):
        for _ in range(50):
            q = rng.uniform(-0.5, 0.5, 4)
            q[largest] = rng.choice([-1.0, 1.0])
            q /= np.linalg.norm(q)
            ours = rotation.from_matrix(rotation.to_matrix(tuples(q)))
            assert ours[0] >= 0.0
            np.testing.assert_allclose(ours, q if q[0] >= 0.0 else -q, rtol=0.0, atol=4e-16)
        exact = np.eye(4)[largest]
        np.testing.assert_allclose(rotation.from_matrix(rotation.to_matrix(tuples(exact))), exact, rtol=0.0, atol=0.0)


@given(st.floats(-3.14, 3.14), st.floats(-1.57, 1.57), st.floats(-3.14, 3.14))
def test_roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> None:
    assert_same(rotation.from_roll_pitch_yaw(roll, pitch, yaw), Rotation.from_euler("xyz", [roll, pitch, yaw]))


@given(vectors, vectors)
def test_products(a: tuple[float, float, float], b: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(rotation.cross(a, b), np.cross(a, b), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(rotation.dot(a, b), np.dot(a, b), rtol=0.0, atol=1e-15)


@given(rotation_vectors)
def test_left_jacobian_is_the_mean_of_a_turn_on_its_way(v: Array) -> None:
    """By Gauss-Legendre quadrature, and without a step where the series takes over."""
    nodes, weights = np.polynomial.legendre.leggauss(16)
    shares = 0.5 * (nodes + 1.0)
    expected = np.einsum("n,nij->ij", 0.5 * weights, Rotation.from_rotvec(shares[:, None] * v).as_matrix())
    np.testing.assert_allclose(matrix_of(rotation.left_jacobian(tuples(v))), expected, rtol=0.0, atol=1e-12)
