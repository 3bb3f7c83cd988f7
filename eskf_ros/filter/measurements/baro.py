"""Air pressure: height along the local vertical, up to an offset that drifts.

Payload: pressure (Pa), its variance (Pa2). The pressure altitude of the standard atmosphere (ICAO Doc 7488,
troposphere) differs from the height over the ellipsoid by an offset, that of the weather and of the geoid, and, where
the air is warmer or colder than standard, grows with height at another rate:

    pressure altitude = height + offset + scale (height - height of the datum)

with offset and scale as optional states.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.jacobians import clear
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, POSITION
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.geodesy.rotation import cross, rotate, rotate_back, to_matrix

STANDARD_PRESSURE = 101325.0
TEMPERATURE_HEIGHT = 288.15 / 0.0065
"""The height (m) at which a temperature that falls on like in the troposphere would be zero."""

EXPONENT = 8.31432 * 0.0065 / (9.80665 * 0.0289644)


@njit
def pressure_altitude(pressure):
    """Return the height (m) at which the standard atmosphere has this pressure (Pa)."""
    return TEMPERATURE_HEIGHT * (1.0 - (pressure / STANDARD_PRESSURE) ** EXPONENT)


@njit
def place_of_sensor(state, settings):
    """Return latitude, longitude (rad) and height (m) of the barometer, and its place from the IMU in map axes."""
    p, arm = state.position_map, settings.baro_arm_body
    lever = rotate(to_matrix(state.attitude), (arm[0], arm[1], arm[2]))
    offset = rotate(state.frame.map_to_ecef, (p[0] + lever[0], p[1] + lever[1], p[2] + lever[2]))
    origin = state.frame.origin_ecef
    return ecef_to_geodetic(origin[0] + offset[0], origin[1] + offset[1], origin[2] + offset[2]), lever


@njit
def predict(state, source, settings):
    """Return the pressure altitude (m) of the barometer."""
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
    work.noise[0, 0] = slope**2 * payload[3]

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
