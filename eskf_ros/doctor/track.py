"""The way of the antenna as the receiver gives it: positions and velocities in East-North-Up metres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from eskf_ros.doctor.sensors import Array, Recording, Sensor, Stamps
from eskf_ros.geodesy.earth import ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS

AT_REST = 0.3
"""m/s; slower is at rest as far as a receiver can tell."""

LONGEST_STEP = 2.0
"""s; over a longer silence of the velocities nothing is integrated."""


@dataclass(frozen=True)
class Track:
    """Positions, and velocities if there are any, on the clock of the IMU (with the offsets of the parameters).

    ``time``: (n,) s from ``origin`` (ns). ``position``: (n, 3) m. ``claimed``: (n,) standard deviation of a horizontal
    axis (m), NaN where unknown. ``velocity_time`` (m,) s, ``velocity`` (m, 3) m/s: none without velocities.
    """

    origin: int
    time: Array
    position: Array
    claimed: Array
    velocity_time: Array
    velocity: Array

    @property
    def has_velocity(self) -> bool:
        """Whether there are enough velocities to work with."""
        return len(self.velocity_time) >= 20

    def speeds(self) -> tuple[Array, Array]:
        """Return times (k,) s and horizontal velocities (k, 2) m/s, measured or by positions two seconds apart."""
        if self.has_velocity:
            return self.velocity_time, self.velocity[:, :2]
        if len(self.time) < 20:
            return np.zeros(0), np.zeros((0, 2))
        grid = np.arange(self.time[0] + 1.0, self.time[-1] - 1.0, 0.5)
        after, before = (interpolated(grid + step, self.time, self.position[:, :2]) for step in (1.0, -1.0))
        near = np.abs(self.time[np.searchsorted(self.time, grid).clip(0, len(self.time) - 1)] - grid) < LONGEST_STEP
        return grid[near], 0.5 * (after - before)[near]

    def way(self) -> Array:
        """Return the integral of the velocities at the fixes, (n, 3) m; NaN where velocities are missing."""
        steps = np.diff(self.velocity_time)
        middle = 0.5 * (self.velocity[1:] + self.velocity[:-1])
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(middle * steps[:, None], axis=0)])
        way = interpolated(self.time, self.velocity_time, total)
        after = np.searchsorted(self.velocity_time, self.time)
        inside = (after > 0) & (after < len(self.velocity_time))
        way[~inside] = np.nan
        after = after.clip(1, len(self.velocity_time) - 1)
        way[steps[after - 1] > LONGEST_STEP] = np.nan
        return way


def interpolated(at: Array, time: Array, values: Array) -> Array:
    """Return columns of ``values`` (n, k) at times ``at`` (m,)."""
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def track_of(recording: Recording) -> Track | None:
    """Return the track of the fixes with a position; None without two of them."""
    fixes = recording.sensors.get("gnss_fix")
    if fixes is None:
        return None
    fixes = valid_fixes(fixes).by_stamp()
    if len(fixes) < 2:
        return None
    gnss, imu = recording.parameters.gnss, recording.sensors.get("imu")
    origin = int(fixes.stamp[0] if imu is None or not (imu.stamp > 0).any() else imu.stamp[imu.stamp > 0].min())
    known = (fixes.covariance_type > 0) & (fixes.covariance[:, [0, 4]] > 0.0).all(axis=1)
    claimed = np.full(len(fixes), math.nan)
    claimed[known] = np.sqrt(0.5 * (fixes.covariance[known, 0] + fixes.covariance[known, 4]))
    velocities = recording.sensors.get("gnss_velocity")
    velocity_time, velocity = np.zeros(0), np.zeros((0, 3))
    if velocities is not None:
        velocities = velocities.at(np.flatnonzero(np.isfinite(velocities.values).all(axis=1))).by_stamp()
        velocity_time = seconds_from(velocities.stamp, origin) + gnss.time_offset + gnss.velocity_time_offset
        velocity = velocities.values
    time = seconds_from(fixes.stamp, origin) + gnss.time_offset
    return Track(origin, time, local(fixes.values), claimed, velocity_time, velocity)


def seconds_from(stamps: Stamps, origin: int) -> Array:
    """Return stamps (ns) as seconds from ``origin`` (ns)."""
    return np.asarray((stamps - origin) * 1e-9, np.float64)


def valid_fixes(fixes: Sensor) -> Sensor:
    """Return the fixes that say that they are one, with numbers that can be true."""
    latitude, longitude = fixes.values[:, 0], fixes.values[:, 1]
    finite = np.isfinite(latitude) & np.isfinite(longitude)
    possible = (np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0) & ((latitude != 0.0) | (longitude != 0.0))
    return fixes.at(np.flatnonzero((fixes.status >= 0) & finite & possible))


def local(geodetic: Array) -> Array:
    """Return east, north, up (n, 3) m from the median of ``geodetic`` (n, 3; degrees, degrees, m).

    By the radii of curvature there: a thousandth wrong after some ten kilometres, enough to judge a recording.
    """
    has_altitude = np.isfinite(geodetic[:, 2])
    altitude = np.median(geodetic[has_altitude, 2]) if has_altitude.any() else 0.0
    reference = np.array([*np.median(geodetic[:, :2], axis=0), altitude])
    latitude = math.radians(reference[0])
    root = math.sqrt(1.0 - ECCENTRICITY_SQUARED * math.sin(latitude) ** 2)
    across = SEMI_MAJOR_AXIS / root
    along = SEMI_MAJOR_AXIS * (1.0 - ECCENTRICITY_SQUARED) / root**3
    difference = geodetic - reference
    east = np.radians((difference[:, 1] + 180.0) % 360.0 - 180.0) * across * math.cos(latitude)
    up = np.where(np.isfinite(difference[:, 2]), difference[:, 2], 0.0)
    return np.stack([east, np.radians(difference[:, 0]) * along, up], axis=1)
