"""Observation equations of pseudorange and Doppler for a receiver at a given position.

    pseudorange = range + c (receiver clock - satellite clock) + ionosphere + troposphere
    range rate  = -doppler wavelength = d(range)/dt + c (receiver drift - satellite drift)

(Groves, section 9.4.1.) The receiver clock, and the offsets of constellations in it, are left to the caller: `predict`
gives everything else, and the line of sight, which is minus the Jacobian by position (pseudorange) and by velocity
(range rate).
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.gnss.atmosphere import ionosphere_scale, klobuchar, troposphere
from eskf_ros.gnss.geometry import elevation_azimuth, line_of_sight
from eskf_ros.gnss.ranges import ALREADY_TURNED, IONOSPHERE_APPLIED, TROPOSPHERE_APPLIED
from eskf_ros.gnss.signals import L1, SPEED_OF_LIGHT
from eskf_ros.gnss.weighting import code_std, doppler_std

PREDICTION = np.dtype(
    [
        ("line_of_sight", "f8", (3,)),
        ("elevation", "f8"),
        ("azimuth", "f8"),
        ("ionosphere", "f8"),
        ("troposphere", "f8"),
        ("pseudorange", "f8"),
        ("range_rate", "f8"),
        ("code_residual", "f8"),
        ("doppler_residual", "f8"),
        ("code_std", "f8"),
        ("doppler_std", "f8"),
    ],
    align=True,
)
"""Prediction of a range without the receiver clock.

``line_of_sight``: unit vector to the satellite, ECEF. ``elevation``, ``azimuth``: rad. ``pseudorange`` m,
``range_rate`` m/s: predicted, satellite clock and drift included. ``ionosphere`` (NaN without a model),
``troposphere``: delays m. ``code_residual``, ``doppler_residual``: measured minus predicted, m and m/s. ``code_std``,
``doppler_std``: those of the receiver, else by model, m and m/s.
"""

NO_KLOBUCHAR = np.full(8, math.nan)
"""Klobuchar parameters if there are none."""

UNMODELLED_IONOSPHERE = 7.0
"""m; standard deviation of the ionospheric delay at the zenith without a model."""


@njit
def predict(ranges, position, velocity, week, seconds, ionosphere, weighting, predictions):
    """Write a PREDICTION for each located range (RANGE) of an epoch.

    ``position``, ``velocity``: of the antenna, ECEF (m, m/s), tuples. ``week``, ``seconds``: GPS time to a minute, for
    the atmosphere. ``ionosphere``: eight Klobuchar parameters, or `NO_KLOBUCHAR`. ``weighting``:
    `weighting.Weighting`.
    """
    latitude, longitude, altitude = ecef_to_geodetic(position[0], position[1], position[2])
    local_to_ecef = east_north_up_to_ecef(latitude, longitude)
    for k in range(len(ranges)):
        predict_one(
            ranges[k],
            position,
            velocity,
            latitude,
            longitude,
            altitude,
            local_to_ecef,
            week,
            seconds,
            ionosphere,
            weighting,
            predictions[k],
        )


@njit
def predict_one(
    observed,
    position,
    velocity,
    latitude,
    longitude,
    altitude,
    local_to_ecef,
    week,
    seconds,
    ionosphere,
    weighting,
    prediction,
):
    """Write the PREDICTION of one range; latitude, longitude (rad), altitude (m), local axes: of ``position``."""
    wavelength = SPEED_OF_LIGHT / observed["carrier_hz"]
    sight(
        observed,
        observed["pseudorange_std"],
        observed["doppler_std"] * wavelength,
        position,
        velocity,
        latitude,
        longitude,
        altitude,
        local_to_ecef,
        week,
        seconds,
        ionosphere,
        weighting,
        prediction,
    )
    prediction["pseudorange"] -= SPEED_OF_LIGHT * observed["satellite_clock"]
    prediction["range_rate"] -= SPEED_OF_LIGHT * observed["satellite_clock_drift"]
    prediction["code_residual"] = observed["pseudorange"] - prediction["pseudorange"]
    prediction["doppler_residual"] = -observed["doppler"] * wavelength - prediction["range_rate"]


@njit
def sight(
    observed,
    given_code_std,
    given_doppler_std,
    position,
    velocity,
    latitude,
    longitude,
    altitude,
    local_to_ecef,
    week,
    seconds,
    ionosphere,
    weighting,
    prediction,
):
    """Write all of a PREDICTION but the residuals, for a satellite without clock errors.

    ``observed``: a RANGE, or a record with its fields ``satellite``, ``satellite_velocity``, ``flags``, ``carrier_hz``,
    ``gnss_id``, ``sv_id``, ``cn0`` and ``noise_factor``. ``given_code_std`` m, ``given_doppler_std`` m/s: of the
    receiver, NaN for the model's.

    Over 60 lines: the terms of one pseudorange in the order of the interface document.
    """
    satellite, satellite_velocity = observed["satellite"], observed["satellite_velocity"]
    unit, length, rate = line_of_sight(
        (satellite[0], satellite[1], satellite[2]),
        (satellite_velocity[0], satellite_velocity[1], satellite_velocity[2]),
        position,
        velocity,
        observed["flags"] & ALREADY_TURNED != 0,
    )
    elevation, azimuth = elevation_azimuth(unit, local_to_ecef)
    prediction["ionosphere"] = 0.0
    if not observed["flags"] & IONOSPHERE_APPLIED:
        carrier = L1 if math.isnan(observed["carrier_hz"]) else observed["carrier_hz"]
        delay = klobuchar(ionosphere, seconds, latitude, longitude, elevation, azimuth)
        prediction["ionosphere"] = delay * ionosphere_scale(carrier)
    prediction["troposphere"] = 0.0
    if not observed["flags"] & TROPOSPHERE_APPLIED:
        prediction["troposphere"] = troposphere(week, seconds, latitude, altitude, elevation)
    for axis in range(3):
        prediction["line_of_sight"][axis] = unit[axis]
    prediction["elevation"] = elevation
    prediction["azimuth"] = azimuth

    modelled = prediction["ionosphere"]
    unmodelled = 0.0
    if math.isnan(modelled):
        modelled, unmodelled = 0.0, UNMODELLED_IONOSPHERE / max(0.3, math.sin(elevation))
    prediction["pseudorange"] = length + modelled + prediction["troposphere"]
    prediction["range_rate"] = rate
    prediction["code_std"] = given_code_std
    if math.isnan(given_code_std):
        std = code_std(
            weighting,
            observed["gnss_id"],
            observed["sv_id"],
            elevation,
            observed["cn0"],
            modelled,
            observed["noise_factor"],
        )
        prediction["code_std"] = math.sqrt(std * std + unmodelled * unmodelled)
    prediction["doppler_std"] = given_doppler_std
    if math.isnan(given_doppler_std):
        prediction["doppler_std"] = doppler_std(weighting, observed["cn0"])
