"""Delay of a signal in the ionosphere (Klobuchar) and in the troposphere (UNB3, mapped by Niell).

Scalars in, scalars out, so that a filter can call them per satellite. Angles in radians, lengths in metres. Both delays
lengthen a pseudorange.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.gnss.signals import L1, SPEED_OF_LIGHT
from eskf_ros.gnss.time import SECONDS_PER_DAY

LOWEST_ALTITUDE = -1000.0
"""m; lowest altitude at which the troposphere is evaluated; lower ones get its value."""

HIGHEST_ALTITUDE = 30e3
"""m; highest altitude at which the troposphere is evaluated; higher ones get its value."""

LOWEST_ELEVATION = math.radians(3.0)
"""rad; lower elevations get the delay of this one, because no mapping function holds there."""

# RTCA DO-229E, A.4.2.4, parameters of the troposphere: pressure (hPa), temperature (K), vapour pressure (hPa), lapse
# of temperature (K/m) and of vapour at sea level, yearly mean and amplitude, at latitudes 15, 30, 45, 60, 75 deg.
_CLIMATE_MEAN = np.array(
    [
        [1013.25, 1017.25, 1015.75, 1011.75, 1013.00],
        [299.65, 294.15, 283.15, 272.15, 263.65],
        [26.31, 21.79, 11.66, 6.78, 4.11],
        [6.30e-3, 6.05e-3, 5.58e-3, 5.39e-3, 4.53e-3],
        [2.77, 3.15, 2.57, 1.81, 1.55],
    ]
)
_CLIMATE_SEASON = np.array(
    [
        [0.0, -3.75, -2.25, -1.75, -0.50],
        [0.0, 7.00, 11.00, 15.00, 14.50],
        [0.0, 8.85, 7.24, 5.36, 3.39],
        [0.0, 0.25e-3, 0.32e-3, 0.81e-3, 0.62e-3],
        [0.0, 0.33, 0.46, 0.74, 0.30],
    ]
)
# Constants from there: refractivity (K/hPa, K2/hPa), gas constant of dry air (J/kg/K), gravity (m/s2).
_REFRACTIVITY_DRY = 77.604
_REFRACTIVITY_WET = 382000.0
_GAS_CONSTANT = 287.054
_GRAVITY_MEAN = 9.784
_GRAVITY = 9.80665

# Niell (1996), Global mapping functions for the atmosphere delay at radio wavelengths, J. Geophys. Res. 101(B2), tables
# 3 and 4: coefficients a, b, c at latitudes 15, 30, 45, 60, 75 deg.
_LATITUDE_STEP = math.radians(15.0)
_DRY_MEAN = np.array(
    [
        [1.2769934e-3, 1.2683230e-3, 1.2465397e-3, 1.2196049e-3, 1.2045996e-3],
        [2.9153695e-3, 2.9152299e-3, 2.9288445e-3, 2.9022565e-3, 2.9024912e-3],
        [62.610505e-3, 62.837393e-3, 63.721774e-3, 63.824265e-3, 64.258455e-3],
    ]
)
_DRY_SEASON = np.array(
    [
        [0.0, 1.2709626e-5, 2.6523662e-5, 3.4000452e-5, 4.1202191e-5],
        [0.0, 2.1414979e-5, 3.0160779e-5, 7.2562722e-5, 11.723375e-5],
        [0.0, 9.0128400e-5, 4.3497037e-5, 84.795348e-5, 170.37206e-5],
    ]
)
_WET = np.array(
    [
        [5.8021897e-4, 5.6794847e-4, 5.8118019e-4, 5.9727542e-4, 6.1641693e-4],
        [1.4275268e-3, 1.5138625e-3, 1.4572752e-3, 1.5007428e-3, 1.7599082e-3],
        [4.3472961e-2, 4.6729510e-2, 4.3908931e-2, 4.4626982e-2, 5.4736038e-2],
    ]
)
_HEIGHT = (2.53e-5, 5.49e-3, 1.14e-3)
_YEAR = 365.25
_COLDEST_DAY = 28.0
# 6 January 1980, the origin of GPS weeks, is day 6 of its year.
_FIRST_DAY_OF_YEAR = 6.0


@njit
def klobuchar(parameters, seconds, latitude, longitude, elevation, azimuth):
    """Return the ionospheric delay (m) at 1575.42 MHz; another carrier has (1575.42 MHz / carrier)^2 of it.

    ``parameters``: eight numbers, alpha 0 to 3 and beta 0 to 3 of GPS (or QZSS); ``seconds`` of GPS week; place and
    direction in rad. IS-GPS-200N, section 20.3.3.5.2.5; the model leaves about half of the delay uncorrected. NaN
    parameters give NaN.
    """
    elevation = max(0.0, elevation)
    # In semicircles, like the parameters.
    central_angle = 0.0137 / (elevation / math.pi + 0.11) - 0.022
    pierce_latitude = latitude / math.pi + central_angle * math.cos(azimuth)
    pierce_latitude = min(0.416, max(-0.416, pierce_latitude))
    pierce_longitude = longitude / math.pi + central_angle * math.sin(azimuth) / math.cos(pierce_latitude * math.pi)
    magnetic = pierce_latitude + 0.064 * math.cos((pierce_longitude - 1.617) * math.pi)
    local_time = (0.5 * SECONDS_PER_DAY * pierce_longitude + seconds) % SECONDS_PER_DAY
    amplitude, period = 0.0, 0.0
    for k in range(3, -1, -1):
        amplitude = amplitude * magnetic + parameters[k]
        period = period * magnetic + parameters[4 + k]
    if amplitude < 0.0:
        amplitude = 0.0
    if period < 72000.0:
        period = 72000.0
    slant = 1.0 + 16.0 * (0.53 - elevation / math.pi) ** 3
    phase = 2.0 * math.pi * (local_time - 50400.0) / period
    delay = 5e-9
    if abs(phase) < 1.57:
        delay += amplitude * (1.0 - phase**2 / 2.0 + phase**4 / 24.0)
    elif math.isnan(phase):
        delay = math.nan
    return SPEED_OF_LIGHT * slant * delay


@njit
def ionosphere_scale(carrier_hz):
    """Return the factor from the delay at 1575.42 MHz to that of another carrier (IS-GPS-200N, 20.3.3.3.3.2)."""
    return (L1 / carrier_hz) ** 2


@njit
def troposphere(week, seconds, latitude, altitude, elevation):
    """Return the tropospheric delay (m): zenith delays, each with Niell's mapping function."""
    dry, wet = zenith_delays(week, seconds, latitude, altitude)
    dry_mapping, wet_mapping = niell(week, seconds, latitude, altitude, elevation)
    return dry * dry_mapping + wet * wet_mapping


@njit
def zenith_delays(week, seconds, latitude, altitude):
    """Return the hydrostatic and the wet zenith delay (m), good to 0.05 m.

    Saastamoinen's integrals of the refractivity over an atmosphere in equilibrium, whose state at sea level comes from
    latitude and season instead of one standard day: RTCA DO-229E, A.4.2.4 (model UNB3: Collins and Langley 1997). On a
    humid summer day the standard atmosphere lacks half of the wet delay, 0.3 m in the altitude of a fix. An ellipsoidal
    ``altitude`` (m) instead of one above sea level costs 1 %.
    """
    altitude = min(HIGHEST_ALTITUDE, max(LOWEST_ALTITUDE, altitude))
    season, row, part = season_and_place(week, seconds, latitude)
    pressure = between(_CLIMATE_MEAN[0], row, part) - season * between(_CLIMATE_SEASON[0], row, part)
    temperature = between(_CLIMATE_MEAN[1], row, part) - season * between(_CLIMATE_SEASON[1], row, part)
    vapour = between(_CLIMATE_MEAN[2], row, part) - season * between(_CLIMATE_SEASON[2], row, part)
    lapse = between(_CLIMATE_MEAN[3], row, part) - season * between(_CLIMATE_SEASON[3], row, part)
    vapour_lapse = between(_CLIMATE_MEAN[4], row, part) - season * between(_CLIMATE_SEASON[4], row, part)
    scale = 1e-6 * _GAS_CONSTANT
    dry = scale * _REFRACTIVITY_DRY * pressure / _GRAVITY_MEAN
    wet = scale * _REFRACTIVITY_WET * vapour / temperature
    wet /= (vapour_lapse + 1.0) * _GRAVITY_MEAN - lapse * _GAS_CONSTANT
    cooling = 1.0 - lapse * altitude / temperature
    exponent = _GRAVITY / (_GAS_CONSTANT * lapse)
    return dry * cooling**exponent, wet * cooling ** ((vapour_lapse + 1.0) * exponent - 1.0)


@njit
def niell(week, seconds, latitude, altitude, elevation):
    """Return the hydrostatic and the wet mapping function: slant by zenith delay (Niell 1996, eq. 4 to 6)."""
    elevation = max(LOWEST_ELEVATION, elevation)
    altitude = min(HIGHEST_ALTITUDE, max(LOWEST_ALTITUDE, altitude))
    season, row, part = season_and_place(week, seconds, latitude)
    sine = math.sin(elevation)
    dry = continued_fraction(
        sine,
        between(_DRY_MEAN[0], row, part) - season * between(_DRY_SEASON[0], row, part),
        between(_DRY_MEAN[1], row, part) - season * between(_DRY_SEASON[1], row, part),
        between(_DRY_MEAN[2], row, part) - season * between(_DRY_SEASON[2], row, part),
    )
    dry += (1.0 / sine - continued_fraction(sine, _HEIGHT[0], _HEIGHT[1], _HEIGHT[2])) * 1e-3 * altitude
    wet = continued_fraction(
        sine, between(_WET[0], row, part), between(_WET[1], row, part), between(_WET[2], row, part)
    )
    return dry, wet


@njit
def season_and_place(week, seconds, latitude):
    """Return the cosine of the season (1 on the coldest day) and the place of a latitude in the tables (row, part)."""
    # Days since 1 January 1980 have the phase of the year within a day for a century.
    day = week * 7.0 + seconds / SECONDS_PER_DAY + _FIRST_DAY_OF_YEAR
    if latitude < 0.0:
        day += 0.5 * _YEAR
    season = math.cos(2.0 * math.pi * (day - _COLDEST_DAY) / _YEAR)
    place = abs(latitude) / _LATITUDE_STEP - 1.0
    row = min(3, max(0, int(place)))
    return season, row, min(1.0, max(0.0, place - row))


@njit
def between(values, row, part):
    """Return the linear interpolation between two neighbours."""
    return (1.0 - part) * values[row] + part * values[row + 1]


@njit
def continued_fraction(sine, a, b, c):
    """Return Marini's fraction, normalised to one at the zenith (Niell 1996, eq. 4)."""
    return (1.0 + a / (1.0 + b / (1.0 + c))) / (sine + a / (sine + b / (sine + c)))
