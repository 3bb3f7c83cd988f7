"""Air pressure: height along the local vertical, up to an offset that drifts.

Payload: pressure (Pa), its variance (Pa2). The pressure altitude of the standard atmosphere (ICAO Doc 7488,
troposphere) differs from the height over the ellipsoid by an offset, that of the weather and of the geoid, and, where
the air is warmer or colder than standard, grows with height at another rate:

    pressure altitude = height + offset + scale (height - height of the datum)

with offset and scale as optional states.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX
from eskf_ros.filter.measurements.jacobians import clear
from eskf_ros.filter.measurements.row import (
    NEEDS_POSITION,
    UNMEASURED,
    OptionalBlock,
    Place,
    Readings,
    Row,
    arm_body,
    threefold,
)
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, POSITION
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.geodesy.rotation import cross, rotate, rotate_back, to_matrix
from eskf_ros.parameters.schema import Aid, parameter

STANDARD_PRESSURE = 101325.0
"""Pa; pressure of the standard atmosphere at sea level."""

TEMPERATURE_HEIGHT = 288.15 / 0.0065
"""m; height at which the temperature would be zero with the tropospheric lapse rate of the standard atmosphere."""

EXPONENT = 8.31432 * 0.0065 / (9.80665 * 0.0289644)
"""Exponent of the pressure in the standard atmosphere: gas constant times lapse rate over gravity times molar mass."""


@njit
def pressure_altitude(pressure):
    """Return the height (m) at which the standard atmosphere has this pressure (Pa)."""
    return TEMPERATURE_HEIGHT * (1.0 - (pressure / STANDARD_PRESSURE) ** EXPONENT)


@njit
def place_of_sensor(state, settings):
    """Return latitude, longitude (rad) and height (m) of the barometer, and its lever arm (m, map axes)."""
    p, arm = state.position_map, settings.baro.arm_body
    lever = rotate(to_matrix(state.attitude), (arm[0], arm[1], arm[2]))
    offset = rotate(state.frame.map_to_ecef, (p[0] + lever[0], p[1] + lever[1], p[2] + lever[2]))
    origin = state.frame.origin_ecef
    return ecef_to_geodetic(origin[0] + offset[0], origin[1] + offset[1], origin[2] + offset[2]), lever


@njit
def predict(state, source, settings):
    """Return the pressure altitude (m) that the barometer should measure."""
    (_, _, height), _ = place_of_sensor(state, settings)
    offset = state.optional[settings.baro_offset_at - ERROR_SIZE]
    scale = state.optional[settings.baro_scale_at - ERROR_SIZE]
    return height + offset + scale * (height - state.frame.datum[2])


@njit
def linearize(state, payload, source, settings, work):
    """Write innovation, Jacobian and noise of one pressure to ``work``; return the number of scalars."""
    clear(work)
    (latitude, longitude, height), lever = place_of_sensor(state, settings)
    work.innovation[0] = pressure_altitude(payload[0]) - predict(state, source, settings)
    # Height falls with pressure at the rate (T0 / L - altitude) EXPONENT / pressure.
    slope = (TEMPERATURE_HEIGHT - pressure_altitude(payload[0])) * EXPONENT / payload[0]
    work.noise[0, 0] = slope**2 * payload[XX]

    axes = east_north_up_to_ecef(latitude, longitude)
    up = rotate_back(state.frame.map_to_ecef, (axes[0][2], axes[1][2], axes[2][2]))
    growth = 1.0 + state.optional[settings.baro_scale_at - ERROR_SIZE]
    # up . (theta x lever) = theta . (lever x up)
    tilt = cross(lever, up)
    for i in range(3):
        work.jacobian[0, POSITION + i] = growth * up[i]
        if state.heading_known == 1:
            work.jacobian[0, ATTITUDE + i] = growth * tilt[i]
    work.jacobian[0, settings.baro_offset_at] = 1.0
    work.jacobian[0, settings.baro_scale_at] = height - state.frame.datum[2]
    return 1


@dataclass(frozen=True)
class Baro(Aid):
    position: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "m",
        "Position of the barometer in base_link, x forward, y left, z up.",
        minimum=-1000.0,
        maximum=1000.0,
    )
    offset_std: float = parameter(
        300.0,
        "m",
        "Standard deviation at first of the difference between pressure altitude and height: weather and geoid. "
        "It is estimated.",
        above=0.0,
        maximum=1.0e4,
    )
    offset_random_walk: float = parameter(
        0.1,
        "m/s/rtHz",
        "How fast that difference wanders, by weather, wind and warming up: by this value times the square root of the "
        "seconds passed. The default is 6 m in one hour; more where air is blown about, as in a vehicle.",
        minimum=0.0,
        maximum=100.0,
    )
    scale_std: float = parameter(
        0.03,
        "",
        "Standard deviation of the factor by which pressure altitude grows faster or slower than height: 0.03 where "
        "the air is 9 K warmer or colder than in the standard atmosphere. It is estimated.",
        minimum=0.0,
        maximum=1.0,
    )
    std_floor: float = parameter(
        3.0, "Pa", "The standard deviation is never taken smaller than this.", above=0.0, maximum=1.0e4, live=True
    )
    unknown_std: float = parameter(
        10.0, "Pa", "Standard deviation where the message gives none.", above=0.0, maximum=1.0e4, live=True
    )


SETTINGS = np.dtype([("arm_body", "f8", (3,))], align=True)
"""Lever arm of the barometer (m, IMU axes)."""

HIGHEST_PRESSURE = 1.2e5
"""Pa; no barometer on a robot reports more."""

LOWEST_PRESSURE = 1.0e4
"""Pa, at a height of 16 km; drivers that report hectopascal send less."""


def read(messages: npt.NDArray[Any]) -> Readings:
    """Return pressures (Pa) with their variances; the other two axes are absent."""
    values, covariances = np.zeros((len(messages), 3)), np.zeros((len(messages), 9))
    values[:, 0] = messages["fluid_pressure"]
    covariances[:, 0] = messages["variance"]
    covariances[messages["variance"] != 0.0, 4::4] = UNMEASURED
    return values, covariances


def limits(baro: Baro) -> dict[str, Any]:
    """Return the fields of the `Intake` that the parameters of this measurement determine."""
    return {
        "std_floor": threefold(baro.std_floor),
        "unknown_std": threefold(baro.unknown_std),
        "largest": HIGHEST_PRESSURE,
        "may_lack_axes": True,
        "lowest": LOWEST_PRESSURE,
    }


def describe(settings: np.void, parameters: Any) -> None:
    """Fill `SETTINGS` from the parameters."""
    settings["arm_body"] = arm_body(parameters.baro.position, parameters)


def augmented(parameters: Any) -> tuple[OptionalBlock, ...]:
    """Return offset (weather, geoid) and scale (temperature of the air) of the pressure altitude.

    They are there whether or not the sensor is used, because use may change while running and indices may not.
    """
    baro: Baro = parameters.baro
    return (
        OptionalBlock(
            "baro_offset",
            is_on=True,
            std=baro.offset_std,
            noise_density=baro.offset_random_walk,
            streams=(Stream.BARO,),
        ),
        OptionalBlock("baro_scale", is_on=True, std=baro.scale_std, streams=(Stream.BARO,)),
    )


ROW = Row(
    Stream.BARO,
    "barometer",
    Baro,
    "Barometer.",
    types=("sensor_msgs/msg/FluidPressure",),
    topic="baro",
    topic_about="sensor_msgs/FluidPressure: air pressure.",
    read=read,
    limits=limits,
    needs=NEEDS_POSITION,
    augmented=augmented,
    place=Place("baro.position", inputs=("baro",)),
    settings=SETTINGS,
    describe=describe,
    columns=("pressure",),
)
"""The facts of this measurement."""
