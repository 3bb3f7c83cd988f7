"""Light time, Earth rotation during the flight, line of sight, elevation.

A signal travels in an inertial frame while the Earth turns: the satellite of transmission, seen in the ECEF frame of
reception, is turned back about z by Earth rate times light time (the Sagnac effect, up to 40 m in range). Vectors are
tuples of floats in ECEF of reception unless said otherwise.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.geodesy.earth import EARTH_RATE
from eskf_ros.geodesy.rotation import rotate_back
from eskf_ros.gnss.orbits import satellite_state
from eskf_ros.gnss.signals import SPEED_OF_LIGHT


@njit
def turned(vector, light_time):
    """Return a vector given in the ECEF frame of transmission in that of reception, ``light_time`` s later.

    For positions and for velocities relative to the Earth alike (Groves, section 8.5.2; IS-GPS-200N, 20.3.3.4.3.3.2).
    """
    angle = EARTH_RATE * light_time
    sin_angle, cos_angle = math.sin(angle), math.cos(angle)
    return (
        cos_angle * vector[0] + sin_angle * vector[1],
        cos_angle * vector[1] - sin_angle * vector[0],
        vector[2],
    )


@njit
def turned_at_arrival(satellite, receiver):
    """Return a satellite position at transmission (m) in the ECEF frame of its arrival at ``receiver`` (m).

    The light time is that of the distance in the turned frame: two rounds leave less than 1e-8 m.
    """
    arrived = satellite
    for _ in range(2):
        arrived = turned(satellite, distance(arrived, receiver) / SPEED_OF_LIGHT)
    return arrived


@njit
def distance(a, b):
    """Return |a - b|."""
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(x * x + y * y + z * z)


@njit
def line_of_sight(satellite, satellite_velocity, receiver, receiver_velocity, already_turned):
    """Return unit vector to the satellite, range (m) and range rate (m/s), as an antenna at ``receiver`` sees them.

    ``satellite`` and its velocity: ECEF of transmission, or of reception if ``already_turned``. The range rate is the
    derivative of the range by the time of reception: the light time changes, too, which divides it by 1 + u.v/c with
    the inertial velocity v of the satellite (up to 5 mm/s; Groves, section 8.5.3).
    """
    if not already_turned:
        position = turned_at_arrival(satellite, receiver)
        light_time = distance(position, receiver) / SPEED_OF_LIGHT
        velocity = turned(satellite_velocity, light_time)
    else:
        position = satellite
        velocity = satellite_velocity
    length = distance(position, receiver)
    ux = (position[0] - receiver[0]) / length
    uy = (position[1] - receiver[1]) / length
    uz = (position[2] - receiver[2]) / length
    closing = (
        ux * (velocity[0] - receiver_velocity[0])
        + uy * (velocity[1] - receiver_velocity[1])
        + uz * (velocity[2] - receiver_velocity[2])
    )
    inertial = (
        ux * (velocity[0] - EARTH_RATE * position[1]) + uy * (velocity[1] + EARTH_RATE * position[0]) + uz * velocity[2]
    )
    return (ux, uy, uz), length, closing / (1.0 + inertial / SPEED_OF_LIGHT)


@njit
def state_at_reception(ephemeris, week, seconds, receiver):
    """Return the satellite whose signal reaches ``receiver`` (m) at an instant of true GPS time, without a pseudorange.

    As `orbits.satellite_state` at the instant of transmission (ECEF of transmission), and the light time (s), iterated
    to 1e-13 s: for predictions and simulations.
    """
    light_time = 0.075
    for _ in range(6):
        position, velocity, clock, drift = satellite_state(ephemeris, week, seconds - light_time)
        previous = light_time
        light_time = distance(turned(position, light_time), receiver) / SPEED_OF_LIGHT
        if not abs(light_time - previous) > 1e-13:
            break
    return position, velocity, clock, drift, light_time


@njit
def elevation_azimuth(line_of_sight_ecef, local_to_ecef):
    """Return elevation and azimuth (rad, from north to east, 0 to 2 pi) of a unit vector in ECEF.

    ``local_to_ecef``: `earth.east_north_up_to_ecef` of the receiver.
    """
    east, north, up = rotate_back(local_to_ecef, line_of_sight_ecef)
    return math.asin(min(1.0, max(-1.0, up))), math.atan2(east, north) % (2.0 * math.pi)
