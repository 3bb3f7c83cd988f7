"""Ranges without errors from a place on the Earth to the satellites above it."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.gnss.atmosphere import ionosphere_scale, klobuchar, niell, zenith_delays
from eskf_ros.gnss.ephemeris import NO_ISSUE
from eskf_ros.gnss.geometry import elevation_azimuth, line_of_sight, state_at_reception
from eskf_ros.gnss.ranges import choose
from eskf_ros.gnss.signals import SIGNAL_SLOT, SPEED_OF_LIGHT, carrier_hz
from eskf_ros.gnss.weighting import code_std, doppler_std

IDEAL_RANGE = np.dtype(
    [
        ("elevation", "f8"),
        ("azimuth", "f8"),
        ("pseudorange", "f8"),
        ("range_rate", "f8"),
        ("ionosphere", "f8"),
        ("troposphere", "f8"),
        ("wet_mapping", "f8"),
        ("carrier_hz", "f8"),
    ],
    align=True,
)
"""A signal at one epoch: rad, m, m/s, Hz; elevation NaN where the satellite has no ephemeris.

``pseudorange`` and ``range_rate`` hold the clock of the satellite, not that of the receiver, and no atmosphere.
"""


@njit
def ideal_ranges(weeks, seconds, positions, velocities, records, first, satellites, ionosphere, ideal):
    """Fill ``ideal`` (n, m; IDEAL_RANGE) for an antenna at n instants of true GPS time and m signals.

    ``positions``, ``velocities`` (n, 3): ECEF. ``records``, ``first``: of `ephemeris.Ephemerides`. ``satellites``
    (m, 3): constellation, number, index of the signal. ``ionosphere``: eight Klobuchar parameters.
    """
    for i in range(len(weeks)):
        week, second = weeks[i], seconds[i]
        receiver = (positions[i, 0], positions[i, 1], positions[i, 2])
        moving = (velocities[i, 0], velocities[i, 1], velocities[i, 2])
        latitude, longitude, altitude = ecef_to_geodetic(receiver[0], receiver[1], receiver[2])
        local_to_ecef = east_north_up_to_ecef(latitude, longitude)
        dry, wet = zenith_delays(week, second, latitude, altitude)
        for j in range(len(satellites)):
            row = ideal[i, j]
            slot = SIGNAL_SLOT[satellites[j, 2]]
            chosen, _ = choose(records, first, satellites[j, 0], satellites[j, 1], slot, week, second, NO_ISSUE)
            if chosen < 0:
                row["elevation"] = math.nan
                continue
            ephemeris = records[chosen]
            position, velocity, clock, drift, _ = state_at_reception(ephemeris, week, second, receiver)
            unit, length, rate = line_of_sight(position, velocity, receiver, moving, False)
            elevation, azimuth = elevation_azimuth(unit, local_to_ecef)
            row["elevation"], row["azimuth"] = elevation, azimuth
            row["pseudorange"] = length - SPEED_OF_LIGHT * (clock - ephemeris["group_delay"][slot])
            row["range_rate"] = rate - SPEED_OF_LIGHT * drift
            carrier = carrier_hz(satellites[j, 2], ephemeris["channel"])
            delay = klobuchar(ionosphere, second, latitude, longitude, elevation, azimuth)
            dry_mapping, wet_mapping = niell(week, second, latitude, altitude, elevation)
            row["ionosphere"] = delay * ionosphere_scale(carrier)
            row["troposphere"] = dry * dry_mapping + wet * wet_mapping
            row["wet_mapping"] = wet_mapping
            row["carrier_hz"] = carrier


@njit
def model_deviations(weighting, satellites, elevation, cn0, code, range_rate):
    """Fill ``code`` (m) and ``range_rate`` (m/s) with the standard deviations by model (n, m), without atmosphere."""
    for i in range(elevation.shape[0]):
        for j in range(elevation.shape[1]):
            gnss_id, sv_id = satellites[j, 0], satellites[j, 1]
            code[i, j] = code_std(weighting, gnss_id, sv_id, elevation[i, j], cn0[i, j], 0.0, 1.0)
            range_rate[i, j] = doppler_std(weighting, cn0[i, j])
