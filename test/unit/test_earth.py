"""Geodesy against pymap3d, normal gravity against the closed form of the level ellipsoid."""

from __future__ import annotations

import math

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray

from eskf_ros.geodesy import earth

Array = NDArray[np.float64]
ELLIPSOID = pymap3d.Ellipsoid.from_name("wgs84")


def points(count: int = 2000) -> Array:
    """Latitude, longitude (rad), altitude (m): everywhere, both poles and their neighbourhood, up to satellites."""
    rng = np.random.default_rng(3)
    latitude = np.arcsin(rng.uniform(-1.0, 1.0, count))
    close = np.array([0.0, 1e-14, 1e-9, 1e-6, 1e-3])
    latitude[: 2 * len(close)] = np.concatenate([0.5 * math.pi - close, close - 0.5 * math.pi])
    latitude[10:15] = close
    longitude = rng.uniform(-math.pi, math.pi, count)
    altitude = np.where(rng.random(count) < 0.7, rng.uniform(-500.0, 12e3, count), 10 ** rng.uniform(4, 7.4, count))
    altitude[:15] = 120.0
    return np.stack([latitude, longitude, altitude], axis=-1)


def test_geodetic_to_ecef_is_pymap3d() -> None:
    for latitude, longitude, altitude in points():
        expected = pymap3d.geodetic2ecef(latitude, longitude, altitude, ELLIPSOID, deg=False)
        np.testing.assert_allclose(
            earth.geodetic_to_ecef(latitude, longitude, altitude), expected, rtol=4e-16, atol=4e-9
        )


def test_ecef_to_geodetic_inverts_pymap3d() -> None:
    for latitude, longitude, altitude in points():
        ecef = pymap3d.geodetic2ecef(latitude, longitude, altitude, ELLIPSOID, deg=False)
        back = earth.ecef_to_geodetic(*(float(c) for c in ecef))
        # The rounding of the coordinates themselves is 1e-9 m on the ground: 1e-16 of the radius.
        assert abs(back[0] - latitude) < 1e-15
        off = (back[1] - longitude + math.pi) % (2.0 * math.pi) - math.pi
        assert abs(off) * math.cos(latitude) < 1e-15
        assert abs(back[2] - altitude) < 5e-9 + 5e-16 * altitude


def test_ecef_to_geodetic_agrees_with_pymap3d() -> None:
    # Where pymap3d's own inverse, one Newton step, is good to that: it is off by 4 m at satellites.
    for latitude, longitude, altitude in points(300):
        if altitude > 12e3:
            continue
        ecef = [float(c) for c in pymap3d.geodetic2ecef(latitude, longitude, altitude, ELLIPSOID, deg=False)]
        theirs = pymap3d.ecef2geodetic(*ecef, ELLIPSOID, deg=False)
        ours = earth.ecef_to_geodetic(*ecef)
        assert abs(ours[0] - theirs[0]) < 1e-9
        assert abs(math.remainder(ours[1] - theirs[1], 2.0 * math.pi)) * math.cos(latitude) < 1e-9
        assert abs(ours[2] - theirs[2]) < 1e-3


def test_poles_and_the_deep() -> None:
    for sign in (1.0, -1.0):
        latitude, _, altitude = earth.ecef_to_geodetic(0.0, 0.0, sign * (earth.SEMI_MINOR_AXIS + 7.0))
        assert latitude == sign * 0.5 * math.pi
        assert altitude == pytest.approx(7.0, abs=2e-9)
    # Ten kilometres below ground still inverts.
    for latitude in np.linspace(-1.57, 1.57, 21):
        back = earth.ecef_to_geodetic(*earth.geodetic_to_ecef(latitude, 2.0, -10e3))
        np.testing.assert_allclose(back, (latitude, 2.0, -10e3), rtol=0.0, atol=5e-9)


def test_east_north_up_is_pymap3d() -> None:
    rng = np.random.default_rng(4)
    for latitude, longitude, _ in points(200):
        enu = rng.normal(size=3)
        expected = pymap3d.enu2ecefv(*enu, latitude, longitude, deg=False)
        rotation = np.array(earth.east_north_up_to_ecef(latitude, longitude))
        np.testing.assert_allclose(rotation @ enu, expected, atol=1e-14)
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-15)


# ------------------------------------------------------------------------------------------------------ gravity


def closed_form_gravity(x: float, y: float, z: float) -> Array:
    """Normal gravity in ellipsoidal-harmonic coordinates (Heiskanen and Moritz, sections 2-7, 2-8; NIMA TR8350.2)."""
    a, b, rate = earth.SEMI_MAJOR_AXIS, earth.SEMI_MINOR_AXIS, earth.EARTH_RATE
    linear = math.sqrt(a * a - b * b)
    spread = x * x + y * y + z * z - linear**2
    u = math.sqrt(0.5 * spread * (1.0 + math.sqrt(1.0 + 4.0 * linear**2 * z * z / spread**2)))
    v = math.hypot(u, linear)
    reduced = math.atan2(z * v, u * math.hypot(x, y))
    sine, cosine = math.sin(reduced), math.cos(reduced)
    w = math.sqrt((u * u + linear**2 * sine**2) / (u * u + linear**2))

    def q(at: float) -> float:
        return 0.5 * ((1.0 + 3.0 * at**2 / linear**2) * math.atan(linear / at) - 3.0 * at / linear)

    q_prime = 3.0 * (1.0 + u * u / linear**2) * (1.0 - u / linear * math.atan(linear / u)) - 1.0
    centrifugal = rate**2 * a * a
    gravity_u = (
        -(
            earth.GRAVITATIONAL_CONSTANT / v**2
            + centrifugal * linear / v**2 * q_prime / q(b) * (0.5 * sine**2 - 1.0 / 6.0)
            - rate**2 * u * cosine**2
        )
        / w
    )
    gravity_reduced = (centrifugal / v * q(u) / q(b) - rate**2 * v) * sine * cosine / w
    longitude = math.atan2(y, x)
    horizontal = u * cosine / (w * v) * gravity_u - sine / w * gravity_reduced
    vertical = sine / w * gravity_u + u * cosine / (w * v) * gravity_reduced
    return np.array([horizontal * math.cos(longitude), horizontal * math.sin(longitude), vertical])


@pytest.mark.parametrize(("altitude", "tolerance"), [(-400.0, 3e-9), (0.0, 3e-9), (10e3, 3e-9), (400e3, 3e-9)])
def test_gravity_is_that_of_the_level_ellipsoid(altitude: float, tolerance: float) -> None:
    for latitude in np.linspace(-0.5 * math.pi, 0.5 * math.pi, 181):
        ecef = earth.geodetic_to_ecef(latitude, 0.7, altitude)
        np.testing.assert_allclose(
            earth.normal_gravity_ecef(*ecef), closed_form_gravity(*ecef), rtol=0.0, atol=tolerance
        )


def test_gravity_on_the_ellipsoid_is_somigliana() -> None:
    """Magnitude by Somigliana's formula with the published constants, direction along the ellipsoid normal."""
    equator, pole = 9.7803253359, 9.8321849378
    ratio = earth.SEMI_MINOR_AXIS * pole / (earth.SEMI_MAJOR_AXIS * equator) - 1.0
    for latitude in np.linspace(-0.5 * math.pi, 0.5 * math.pi, 91):
        square = math.sin(latitude) ** 2
        expected = equator * (1.0 + ratio * square) / math.sqrt(1.0 - earth.ECCENTRICITY_SQUARED * square)
        gravity = np.array(earth.normal_gravity_ecef(*earth.geodetic_to_ecef(latitude, -2.0, 0.0)))
        up = np.array(earth.east_north_up_to_ecef(latitude, -2.0))[:, 2]
        np.testing.assert_allclose(gravity, -expected * up, rtol=0.0, atol=3e-9)


def test_gravity_is_the_gradient_of_a_potential() -> None:
    """No curl, and the divergence is that of the centrifugal acceleration alone: mass is elsewhere."""
    rng = np.random.default_rng(5)
    h = 200.0
    for _ in range(200):
        altitude = 10 ** rng.uniform(0, 6)
        ecef = np.array(earth.geodetic_to_ecef(math.asin(rng.uniform(-1, 1)), rng.uniform(-3, 3), altitude))
        gradient = np.empty((3, 3))
        for axis in range(3):
            step = h * np.eye(3)[axis]
            after, before = (np.array(earth.normal_gravity_ecef(*(ecef + k * step))) for k in (1.0, -1.0))
            gradient[:, axis] = (after - before) / (2.0 * h)
        np.testing.assert_allclose(gradient, gradient.T, rtol=0.0, atol=1e-13)
        assert np.trace(gradient) == pytest.approx(2.0 * earth.EARTH_RATE**2, abs=1e-13)
