"""Truth for the strapdown: an independent integration in the inertial frame, with scipy.

Nothing of the estimator is used but the normal gravity of `eskf_ros.geodesy.earth`. The state is integrated where
Newton's law holds without Coriolis or transport terms: in axes that coincide with ECEF at time zero and do not rotate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from eskf_ros.geodesy import earth

Array = NDArray[np.float64]
Inputs = Callable[[float], tuple[Array, Array]]


@dataclass(frozen=True)
class MapState:
    """State of a body in ``map`` at n times: position and velocity (n, 3) in m and m/s, attitude w x y z (n, 4)."""

    position_map: Array
    velocity_map: Array
    attitude_body_to_map: Array


def integrate(
    inputs: Inputs,
    start: tuple[Array, Array, Array],
    datum: tuple[float, float, float],
    times: Sequence[float] | Array,
    breakpoints: Sequence[float] | Array = (),
) -> MapState:
    """Integrate a body from ``times[0]`` and return its state at all of ``times`` (increasing, s).

    ``inputs(t)`` gives specific force (m/s2) and angular rate relative to inertial space (rad/s), (3,) in body axes.
    ``start``: position (m), velocity (m/s), attitude w x y z at ``times[0]``, in ``map``. ``datum``: latitude and
    longitude (deg), ellipsoidal altitude (m). ``breakpoints``: times at which a derivative of the inputs jumps; no
    step crosses one.
    """
    times = np.asarray(times, dtype=np.float64)
    origin = np.array(earth.geodetic_to_ecef(math.radians(datum[0]), math.radians(datum[1]), datum[2]))
    map_to_ecef = np.array(earth.east_north_up_to_ecef(math.radians(datum[0]), math.radians(datum[1])))
    spin = np.array([0.0, 0.0, earth.EARTH_RATE])
    begin = float(times[0])

    def ecef_to_inertial(t: float) -> Array:
        angle = earth.EARTH_RATE * (t - begin)
        c, s = math.cos(angle), math.sin(angle)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    position_map, velocity_map, attitude = (np.asarray(part, dtype=np.float64) for part in start)
    position_ecef = origin + map_to_ecef @ position_map
    velocity_inertial = map_to_ecef @ velocity_map + np.cross(spin, position_ecef)

    # What is integrated is the departure from uniform motion: a few kilometres keep the digits that 6400 km would cost.
    def uniform(t: float) -> Array:
        return position_ecef + velocity_inertial * (t - begin)

    def derivative(t: float, y: Array) -> Array:
        force_body, rate_body = inputs(t)
        to_inertial = ecef_to_inertial(t)
        ecef = to_inertial.T @ (uniform(t) + y[0:3])
        gravity = np.array(earth.normal_gravity_ecef(ecef[0], ecef[1], ecef[2]))
        # Normal gravity holds the centrifugal acceleration, which does not exist here: what is left is gravitation.
        gravitation = gravity - earth.EARTH_RATE**2 * np.array([ecef[0], ecef[1], 0.0])
        q = y[6:10]
        return np.concatenate(
            [y[3:6], _rotate(q, force_body) + to_inertial @ gravitation, 0.5 * _product(q, rate_body)]
        )

    y = np.concatenate([np.zeros(6), _product_quaternion(_from_matrix(map_to_ecef), attitude)])
    inner = [float(t) for t in breakpoints if times[0] < t < times[-1]]
    states = [y]
    wanted = {float(t) for t in times}
    previous = begin
    for t in sorted(wanted.union(inner) - {begin}):
        solution = solve_ivp(derivative, (previous, t), y, method="DOP853", rtol=1e-12, atol=1e-12)
        if not solution.success:
            raise RuntimeError(solution.message)
        y = solution.y[:, -1]
        y[6:10] /= np.linalg.norm(y[6:10])
        if t in wanted:
            states.append(y)
        previous = t

    positions, velocities, attitudes = [], [], []
    ecef_to_map = _conjugate(_from_matrix(map_to_ecef))
    for t, state in zip(times, states, strict=True):
        to_ecef = ecef_to_inertial(float(t)).T
        ecef = to_ecef @ (uniform(float(t)) + state[0:3])
        velocity_ecef = to_ecef @ (velocity_inertial + state[3:6]) - np.cross(spin, ecef)
        half = 0.5 * earth.EARTH_RATE * (t - begin)
        inertial_to_ecef = np.array([math.cos(half), 0.0, 0.0, -math.sin(half)])
        quaternion = _product_quaternion(ecef_to_map, _product_quaternion(inertial_to_ecef, state[6:10]))
        positions.append(map_to_ecef.T @ (ecef - origin))
        velocities.append(map_to_ecef.T @ velocity_ecef)
        attitudes.append(quaternion)
    return MapState(np.array(positions), np.array(velocities), np.array(attitudes))


def _rotate(q: Array, v: Array) -> Array:
    t = 2.0 * np.cross(q[1:], v)
    return v + q[0] * t + np.cross(q[1:], t)


def _product(q: Array, v: Array) -> Array:
    """Return the quaternion product of ``q`` and the pure vector ``v``."""
    return np.concatenate([[-q[1:] @ v], q[0] * v + np.cross(q[1:], v)])


def _product_quaternion(a: Array, b: Array) -> Array:
    return a[0] * b + np.concatenate([[-a[1:] @ b[1:]], b[0] * a[1:] + np.cross(a[1:], b[1:])])


def _conjugate(q: Array) -> Array:
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def _from_matrix(m: Array) -> Array:
    """Return the quaternion of a rotation matrix: the eigenvector of Bar-Itzhack's symmetric matrix (2000, eq. 23)."""
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    return np.linalg.eigh(k)[1][:, -1]
