"""The map frame on the Earth, for whole arrays of positions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.compiled import njit
from eskf_ros.geodesy import earth

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MapFrame:
    """East-North-Up at the datum, rigidly fixed to the Earth.

    ``datum`` is latitude and longitude in degrees and ellipsoidal altitude in m.
    """

    datum: tuple[float, float, float]

    @property
    def origin_ecef(self) -> Array:
        """Position of the datum in ECEF (3,), m."""
        latitude, longitude, altitude = self.datum
        return np.array(earth.geodetic_to_ecef(math.radians(latitude), math.radians(longitude), altitude))

    @property
    def rotation_map_to_ecef(self) -> Array:
        """Rotation matrix (3, 3) from ``map`` to ECEF axes."""
        return np.array(earth.east_north_up_to_ecef(math.radians(self.datum[0]), math.radians(self.datum[1])))

    @property
    def earth_rate_map(self) -> Array:
        """Rotation vector of the Earth in ``map`` axes (3,), rad/s."""
        return earth.EARTH_RATE * self.rotation_map_to_ecef[2]

    def to_ecef(self, position_map: Array) -> Array:
        """Return ECEF positions (n, 3) of positions in ``map`` (n, 3), m."""
        return self.origin_ecef + position_map @ self.rotation_map_to_ecef.T

    def gravity_map(self, position_map: Array) -> Array:
        """Return the normal gravity vector in ``map`` axes (n, 3), m/s2, at positions in ``map`` (n, 3), m."""
        return _gravity_ecef(self.to_ecef(position_map)) @ self.rotation_map_to_ecef

    def to_geodetic_deg(self, position_map: Array) -> tuple[float, float, float]:
        """Return latitude and longitude (deg) and ellipsoidal altitude (m) of one position (3,) in ``map``, m."""
        x, y, z = (self.origin_ecef + self.rotation_map_to_ecef @ position_map).tolist()
        latitude, longitude, altitude = earth.ecef_to_geodetic(x, y, z)
        return math.degrees(latitude), math.degrees(longitude), altitude

    def from_geodetic_deg(self, latitude_deg: float, longitude_deg: float, altitude: float) -> Array:
        """Return the position (3,) in ``map``, m, of one place: degrees and ellipsoidal altitude in m."""
        ecef = earth.geodetic_to_ecef(math.radians(latitude_deg), math.radians(longitude_deg), altitude)
        return self.rotation_map_to_ecef.T @ (ecef - self.origin_ecef)


def to_geodetic(position_ecef: Array) -> Array:
    """Return latitude, longitude (rad), ellipsoidal altitude (m) as (n, 3) of ECEF positions (n, 3), m."""
    return _to_geodetic(position_ecef)


def east_north_up_to_ecef(geodetic: Array) -> Array:
    """Return the rotations (n, 3, 3) from East-North-Up at ``geodetic`` (n, 3; latitude, longitude in rad) to ECEF."""
    latitude, longitude = geodetic[:, 0], geodetic[:, 1]
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(sin_lon)], axis=-1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=-1)
    return np.stack([east, north, up], axis=-1)


@njit
def _gravity_ecef(position_ecef: Array) -> Array:
    gravity = np.empty_like(position_ecef)
    for i in range(position_ecef.shape[0]):
        x, y, z = earth.normal_gravity_ecef(position_ecef[i, 0], position_ecef[i, 1], position_ecef[i, 2])
        gravity[i, 0] = x
        gravity[i, 1] = y
        gravity[i, 2] = z
    return gravity


@njit
def _to_geodetic(position_ecef: Array) -> Array:
    geodetic = np.empty_like(position_ecef)
    for i in range(position_ecef.shape[0]):
        latitude, longitude, altitude = earth.ecef_to_geodetic(
            position_ecef[i, 0], position_ecef[i, 1], position_ecef[i, 2]
        )
        geodetic[i, 0] = latitude
        geodetic[i, 1] = longitude
        geodetic[i, 2] = altitude
    return geodetic
