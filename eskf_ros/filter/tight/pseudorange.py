"""Pseudorange of one signal (payload: see `signal`).

    pseudorange = |satellite - antenna| + clock bias + offset of the constellation + ionosphere + troposphere

(Groves, section 9.4.1, satellite clock taken out). Jacobian: minus the line of sight u for the position, u x lever for
the attitude on the map side, one for clock bias and offset. The atmosphere is that at the present position.

The correlated error that all ranges have in common (reflections, orbits, atmosphere) may be an augmented state: it
moves the antenna that the satellites see by a standard deviation times a state of unit variance per axis (first-order
Gauss-Markov). It is larger vertically, because all satellites are above: the unmodelled atmosphere does not average
out.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.jacobians import clear, let_heading_be_held
from eskf_ros.filter.measurements.row import OptionalBlock, Row
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, INTER_SYSTEM, NOWHERE, POSITION
from eskf_ros.filter.tight.signal import (
    CARRIER,
    CN0,
    FLAGS,
    GPS_TIME,
    KLOBUCHAR,
    MEASURED,
    NOISE_FACTOR,
    STD,
    Ranges,
    antenna_ecef,
    clock_bias,
    satellite_of,
    see,
    system_of,
    to_map,
)
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.geodesy.rotation import cross, rotate, to_matrix
from eskf_ros.gnss.atmosphere import ionosphere_scale, klobuchar, troposphere
from eskf_ros.gnss.geometry import elevation_azimuth
from eskf_ros.gnss.range_model import UNMODELLED_IONOSPHERE
from eskf_ros.gnss.ranges import IONOSPHERE_APPLIED, TROPOSPHERE_APPLIED
from eskf_ros.gnss.signals import GNSS_COUNT, L1, Gnss
from eskf_ros.gnss.time import SECONDS_PER_WEEK
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING, code_std

SIZE = 1

# Index of a constellation among the offsets; -1 for GPS, the reference of all offsets.
_ORDER = np.array([INTER_SYSTEM.index(group) if group in INTER_SYSTEM else -1 for group in range(GNSS_COUNT)])


@njit
def offset_place(system, settings):
    """Return the index of the offset of a constellation in the error state; `NOWHERE` for GPS."""
    if _ORDER[system] < 0 or settings.inter_system_at == NOWHERE:
        return NOWHERE
    return settings.inter_system_at + _ORDER[system]


@njit
def delays(payload, geodetic, elevation, azimuth):
    """Return the delays (m) by ionosphere (NaN without a model) and troposphere at a position (rad, rad, m)."""
    week = math.floor(payload[GPS_TIME] / SECONDS_PER_WEEK)
    seconds = payload[GPS_TIME] - week * SECONDS_PER_WEEK
    flags = int(payload[FLAGS])
    ionosphere = 0.0
    if not flags & IONOSPHERE_APPLIED:
        carrier = L1 if math.isnan(payload[CARRIER]) else payload[CARRIER]
        zenith = klobuchar(payload[KLOBUCHAR:], seconds, geodetic[0], geodetic[1], elevation, azimuth)
        ionosphere = zenith * ionosphere_scale(carrier)
    tropospheric = 0.0
    if not flags & TROPOSPHERE_APPLIED:
        tropospheric = troposphere(week, seconds, geodetic[0], geodetic[2], elevation)
    return ionosphere, tropospheric


@njit
def predict(state, payload, source, settings):
    """Return pseudorange (m), unit vector to the satellite (map), elevation (rad), ionospheric delay (m, or NaN)."""
    antenna, velocity = antenna_ecef(state, settings)
    unit, length, _ = see(payload, antenna, velocity)
    geodetic = ecef_to_geodetic(antenna[0], antenna[1], antenna[2])
    elevation, azimuth = elevation_azimuth(unit, east_north_up_to_ecef(geodetic[0], geodetic[1]))
    ionosphere, tropospheric = delays(payload, geodetic, elevation, azimuth)
    pseudorange = length + clock_bias(state, settings) + tropospheric
    if not math.isnan(ionosphere):
        pseudorange += ionosphere
    place = offset_place(system_of(source), settings)
    if place < state.error_size:
        pseudorange += state.optional[place - ERROR_SIZE]
    unit = to_map(state, unit)
    place = settings.position_error_at
    if place < state.error_size:
        for i in range(3):
            pseudorange -= unit[i] * settings.pseudorange.error_std[i] * state.optional[place - ERROR_SIZE + i]
    return pseudorange, unit, elevation, ionosphere


@njit
def variance(payload, source, elevation, ionosphere, settings):
    """Return the variance (m2): that of the receiver, else by elevation and C/N0; scaled and floored."""
    square = payload[STD] ** 2
    if math.isnan(square):
        gnss_id, sv_id = satellite_of(source)
        modelled, unmodelled = ionosphere, 0.0
        if math.isnan(ionosphere):
            modelled, unmodelled = 0.0, UNMODELLED_IONOSPHERE / max(0.3, math.sin(elevation))
        std = code_std(DEFAULT_WEIGHTING, gnss_id, sv_id, elevation, payload[CN0], modelled, payload[NOISE_FACTOR])
        square = std * std + unmodelled * unmodelled
    return max(settings.pseudorange.covariance_scale * square, settings.pseudorange.code_std_floor**2)


@njit
def linearize(state, payload, source, settings, work):
    """Write innovation, Jacobian and noise of one pseudorange to ``work``; return 1, or 0 below the elevation mask."""
    predicted, unit, elevation, ionosphere = predict(state, payload, source, settings)
    if not elevation >= settings.pseudorange.elevation_mask:
        return 0
    clear(work)
    let_heading_be_held(work, settings)
    work.innovation[0] = payload[MEASURED] - predicted
    work.noise[0, 0] = variance(payload, source, elevation, ionosphere, settings)
    lever = rotate(to_matrix(state.attitude), settings.lever_arms_body[0])
    across = cross(unit, lever)
    for i in range(3):
        work.jacobian[0, POSITION + i] = -unit[i]
        if state.heading_known == 1:
            work.jacobian[0, ATTITUDE + i] = across[i]
    if state.heading_known == 0:
        # The lever arm points anywhere around the vertical: its horizontal length is an error of the prediction.
        work.noise[0, 0] += (lever[0] ** 2 + lever[1] ** 2) * (unit[0] ** 2 + unit[1] ** 2)
    work.jacobian[0, settings.clock_at] = 1.0
    place = offset_place(system_of(source), settings)
    if place < state.error_size:
        work.jacobian[0, place] = 1.0
    place = settings.position_error_at
    if place < state.error_size:
        for i in range(3):
            work.jacobian[0, place + i] = -unit[i] * settings.pseudorange.error_std[i]
    return SIZE


SETTINGS = np.dtype(
    [
        ("elevation_mask", "f8"),
        ("covariance_scale", "f8"),
        ("code_std_floor", "f8"),
        ("range_rate_std_floor", "f8"),
        ("error_std", "f8", (3,)),
    ],
    align=True,
)
"""Elevation mask (rad), factor on variances, floors (m, m/s), standard deviation of the common error (m, map)."""

START_CLOCK_STD = (1000.0, 1000.0)
"""Standard deviation of bias (m) and drift (m/s) of a receiver clock that is set to the median of the satellites."""


def describe(settings: np.void, parameters: Any) -> None:
    """Fill `SETTINGS` from the parameters."""
    ranges: Ranges = parameters.ranges
    settings["elevation_mask"] = math.radians(ranges.elevation_mask_deg)
    settings["covariance_scale"] = ranges.covariance_scale
    settings["code_std_floor"] = ranges.code_std_floor
    settings["range_rate_std_floor"] = ranges.range_rate_std_floor
    horizontal, vertical = ranges.correlated_std, ranges.correlated_std_vertical
    settings["error_std"] = (horizontal, horizontal, vertical)


def augmented(parameters: Any) -> tuple[OptionalBlock, ...]:
    """Return the receiver clock, and the offsets of the constellations, which the first signal of each activates."""
    ranges: Ranges = parameters.ranges
    is_tight = parameters.mode == "tight"
    return (
        OptionalBlock(
            "clock",
            is_on=is_tight,
            std=START_CLOCK_STD,
            noise_density=(ranges.clock_bias_noise, ranges.clock_drift_noise),
            streams=(Stream.PSEUDORANGE, Stream.RANGE_RATE),
        ),
        OptionalBlock(
            "inter_system",
            is_on=is_tight,
            std=tuple(
                ranges.inter_system_std_glonass if system == Gnss.GLONASS else ranges.inter_system_std
                for system in INTER_SYSTEM
            ),
            noise_density=ranges.inter_system_noise,
        ),
    )


ROW = Row(
    Stream.PSEUDORANGE,
    "pseudoranges",
    Ranges,
    "What a GNSS receiver measures of each satellite: pseudorange and Doppler.",
    group_name="ranges",
    is_gnss=True,
    augmented=augmented,
    settings=SETTINGS,
    describe=describe,
)
"""The facts of this measurement."""
