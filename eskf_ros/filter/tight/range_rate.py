"""Range rate of one signal, from its Doppler (payload: see `signal`).

    range rate = u . (satellite velocity - antenna velocity) + clock drift

(Groves, section 9.4.1, satellite drift taken out), u the line of sight, the antenna velocity = velocity + R (omega x
lever_arm), omega the body rate relative to the Earth, free of the gyro bias. The Jacobian has the velocity, the
position (which turns the line of sight), attitude and gyro bias as for a GNSS velocity, and the clock drift.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.gyro_noise import gyro_noise_variance
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.measurements.jacobians import clear, let_heading_be_held
from eskf_ros.filter.measurements.row import Row
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, GYRO_BIAS, POSITION, VELOCITY
from eskf_ros.filter.tight.signal import (
    CN0,
    FLAGS,
    MEASURED,
    SATELLITE_VELOCITY,
    STD,
    antenna_ecef,
    clock_drift,
    see,
    to_map,
)
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix
from eskf_ros.gnss.geometry import elevation_azimuth, turned
from eskf_ros.gnss.ranges import ALREADY_TURNED
from eskf_ros.gnss.signals import SPEED_OF_LIGHT
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING, doppler_std

SIZE = 1


@njit
def predict(state, payload, settings):
    """Return range rate (m/s), unit vector to the satellite (map), elevation (rad), turning of that vector (1/s, map).

    The turning is minus the derivative of the range rate by the position of the antenna.
    """
    antenna, velocity = antenna_ecef(state, settings)
    unit, length, rate = see(payload, antenna, velocity)
    latitude, longitude, _ = ecef_to_geodetic(antenna[0], antenna[1], antenna[2])
    elevation, _ = elevation_azimuth(unit, east_north_up_to_ecef(latitude, longitude))
    v = SATELLITE_VELOCITY
    satellite = (payload[v], payload[v + 1], payload[v + 2])
    if int(payload[FLAGS]) & ALREADY_TURNED == 0:
        satellite = turned(satellite, length / SPEED_OF_LIGHT)
    relative = (satellite[0] - velocity[0], satellite[1] - velocity[1], satellite[2] - velocity[2])
    along = dot(unit, relative)
    turning = (
        (relative[0] - along * unit[0]) / length,
        (relative[1] - along * unit[1]) / length,
        (relative[2] - along * unit[2]) / length,
    )
    return rate + clock_drift(state, settings), to_map(state, unit), elevation, to_map(state, turning)


@njit
def variance(payload, settings):
    """Return the variance (m2/s2): that of the receiver, else by C/N0; scaled and floored."""
    std = payload[STD]
    if math.isnan(std):
        std = doppler_std(DEFAULT_WEIGHTING, payload[CN0])
    return max(settings.pseudorange.covariance_scale * std * std, settings.pseudorange.range_rate_std_floor**2)


@njit
def linearize(state, payload, settings, work):
    """Write innovation, Jacobian and noise of one range rate to ``work``; return 1, or 0 below the elevation mask."""
    predicted, unit, elevation, turning = predict(state, payload, settings)
    if not elevation >= settings.pseudorange.elevation_mask:
        return 0
    clear(work)
    let_heading_be_held(work, settings)
    work.innovation[0] = payload[MEASURED] - predicted
    rotation = to_matrix(state.attitude)
    arm = settings.lever_arms_body[0]
    lever = rotate(rotation, arm)
    lever_velocity = rotate(rotation, cross(body_rate(state, rotation), arm))
    across = cross(unit, lever)
    # The gyro reading of this instant carries the white noise of one sample.
    gyro_variance = gyro_noise_variance(state, settings) * dot(across, across)
    work.noise[0, 0] = variance(payload, settings) + gyro_variance
    for i in range(3):
        work.jacobian[0, POSITION + i] = -turning[i]
        work.jacobian[0, VELOCITY + i] = -unit[i]
    work.jacobian[0, settings.clock_at + 1] = 1.0
    if state.heading_known == 0:
        work.noise[0, 0] += dot(lever_velocity, lever_velocity)
        return SIZE
    # An attitude error turns the velocity of the lever arm, and the Earth rate: [lever]x [Earth rate]x theta.
    earth = state.frame.earth_rate_map
    swayed = cross(unit, lever_velocity)
    # It moves the antenna too, and so turns the line of sight.
    moved = cross(turning, lever)
    along, aligned = dot(unit, earth), dot(lever, earth)
    # u R [lever_arm]x for the gyro bias.
    by_bias = cross(rotate_back(rotation, unit), arm)
    for i in range(3):
        work.jacobian[0, ATTITUDE + i] = swayed[i] + moved[i] - along * lever[i] + aligned * unit[i]
        work.jacobian[0, GYRO_BIAS + i] = -by_bias[i]
    return SIZE


ROW = Row(Stream.RANGE_RATE, "range rates", group_name="ranges", is_gnss=True)
"""The facts of this measurement; its parameters and settings are those of the pseudoranges."""
