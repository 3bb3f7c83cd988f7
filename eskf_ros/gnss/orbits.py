"""Satellite position, velocity and clock from one broadcast ephemeris.

Everything is evaluated at the instant of TRANSMISSION in GPS time. Positions and velocities are in the Earth-fixed
frame (ECEF) of that same instant. At reception the Earth has turned on by 5e-6 rad: `eskf_ros.gnss.geometry.turned`
gives them in the ECEF frame of reception, and `geometry.line_of_sight` does it by itself. Velocities are relative to
the rotating frame.

The clock is satellite time minus GPS time (s), relativity included, group delay not: that depends on the signal.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.gnss.signals import SPEED_OF_LIGHT, Gnss, is_beidou_geostationary
from eskf_ros.gnss.time import elapsed

# Gravitational parameter (m3/s2) and Earth rate (rad/s) are part of each broadcast model, hence not those of WGS84:
# IS-GPS-200N, table 20-IV; OS-SIS-ICD 2.1, section 5.1.1; BDS-SIS-ICD-B1I 3.0, section 5.2.4; GLONASS ICD 5.1, A.3.1.2.
GRAVITY_GPS = 3.986005e14
GRAVITY = 3.986004418e14
GRAVITY_GLONASS = 3.9860044e14
RATE = 7.2921151467e-5
RATE_BEIDOU = 7.292115e-5
RATE_GLONASS = 7.292115e-5
RADIUS_GLONASS = 6378136.0
J2_GLONASS = 1.0826257e-3
GLONASS_STEP = 60.0
"""s; longest step of the GLONASS integration: its error is below 0.5 mm after 15 min, 1 mm after half an hour."""

TILT_SIN = math.sin(math.radians(-5.0))
TILT_COS = math.cos(math.radians(-5.0))


@njit
def satellite_state(ephemeris, week, seconds):
    """Return position (m), velocity (m/s), clock (s) and clock drift (s/s) of a satellite at an instant of GPS time.

    Two tuples of three and two floats: ECEF of that instant, see above. ``ephemeris``: a record of EPHEMERIS.
    """
    time = elapsed(week, seconds, ephemeris["toe_week"], ephemeris["toe"])
    if ephemeris["gnss_id"] == Gnss.GLONASS:
        position, velocity = integrated_orbit(ephemeris, time)
        relativity, relativity_rate = 0.0, 0.0
    else:
        position, velocity, relativity, relativity_rate = kepler_orbit(ephemeris, time)
    clock, drift = clock_polynomial(ephemeris, week, seconds)
    return position, velocity, clock + relativity, drift + relativity_rate


@njit
def clock_polynomial(ephemeris, week, seconds):
    """Return clock (s) and drift (s/s) without relativity, which the GLONASS parameters contain.

    From the clock's own reference time, which need not be that of the orbit (IS-GPS-200N, section 20.3.3.3.3.1).
    """
    time = elapsed(week, seconds, ephemeris["toc_week"], ephemeris["toc"])
    af0, af1, af2 = ephemeris["af0"], ephemeris["af1"], ephemeris["af2"]
    return af0 + (af1 + af2 * time) * time, af1 + 2.0 * af2 * time


@njit
def transmission(ephemeris, week, seconds, pseudorange):
    """Return the seconds of ``week`` at which a signal left, for a pseudorange (m) tagged (week, seconds) on arrival.

    The tag is by the receiver clock and may have any error: tag minus pseudorange / c is the satellite clock at
    transmission (IS-GPS-200N, section 20.3.3.3.3.1), whatever the error is. Relativity and group delay, 0.1 us at most,
    move a satellite by less than 0.4 mm and are neglected.
    """
    sent = seconds - pseudorange / SPEED_OF_LIGHT
    instant = sent
    for _ in range(2):
        instant = sent - clock_polynomial(ephemeris, week, instant)[0]
    return instant


@njit
def kepler_orbit(ephemeris, time):
    """Return position, velocity (ECEF at ``time``), relativistic clock offset (s) and its rate, ``time`` s after toe.

    IS-GPS-200N, tables 20-IV and 30-II (the latter adds the rates of semi-major axis and mean motion, zero in LNAV);
    OS-SIS-ICD 2.1, section 5.1.1; BDS-SIS-ICD-B1I 3.0, section 5.2.4, with its own frame for geostationary satellites.
    The velocity is the analytic derivative, harmonics included.

    Over 60 lines: the algorithm of the interface document, line by line.
    """
    gnss = ephemeris["gnss_id"]
    gravity = GRAVITY_GPS if gnss in (Gnss.GPS, Gnss.QZSS) else GRAVITY
    earth_rate = RATE_BEIDOU if gnss == Gnss.BEIDOU else RATE
    eccentricity = ephemeris["e"]
    sqrt_axis = ephemeris["sqrt_a"]
    axis_at_toe = sqrt_axis * sqrt_axis
    axis_rate = ephemeris["a_rate"]
    axis = axis_at_toe + axis_rate * time

    motion = math.sqrt(gravity / axis_at_toe) / axis_at_toe + ephemeris["delta_n"]
    motion_rate = ephemeris["delta_n_rate"]
    anomaly = eccentric_anomaly(ephemeris["m0"] + (motion + 0.5 * motion_rate * time) * time, eccentricity)
    sin_anomaly, cos_anomaly = math.sin(anomaly), math.cos(anomaly)
    shape = 1.0 - eccentricity * cos_anomaly
    anomaly_rate = (motion + motion_rate * time) / shape

    flattening = math.sqrt(1.0 - eccentricity * eccentricity)
    latitude = math.atan2(flattening * sin_anomaly, cos_anomaly - eccentricity) + ephemeris["omega"]
    latitude_rate = flattening * anomaly_rate / shape
    sin_twice, cos_twice = math.sin(2.0 * latitude), math.cos(2.0 * latitude)
    twice_rate = 2.0 * latitude_rate
    cuc, cus, crc, crs, cic, cis = (
        ephemeris["cuc"],
        ephemeris["cus"],
        ephemeris["crc"],
        ephemeris["crs"],
        ephemeris["cic"],
        ephemeris["cis"],
    )
    argument = latitude + cus * sin_twice + cuc * cos_twice
    argument_rate = latitude_rate + twice_rate * (cus * cos_twice - cuc * sin_twice)
    radius = axis * shape + crs * sin_twice + crc * cos_twice
    radius_rate = (
        axis_rate * shape
        + axis * eccentricity * sin_anomaly * anomaly_rate
        + twice_rate * (crs * cos_twice - crc * sin_twice)
    )
    tilt = ephemeris["i0"] + ephemeris["idot"] * time + cis * sin_twice + cic * cos_twice
    tilt_rate = ephemeris["idot"] + twice_rate * (cis * cos_twice - cic * sin_twice)

    geostationary = is_beidou_geostationary(gnss, ephemeris["sv_id"])
    node_rate = ephemeris["omega_dot"]
    if not geostationary:
        node_rate -= earth_rate
    node = ephemeris["omega0"] + node_rate * time - earth_rate * ephemeris["toe_own"]

    sin_argument, cos_argument = math.sin(argument), math.cos(argument)
    sin_tilt, cos_tilt = math.sin(tilt), math.cos(tilt)
    sin_node, cos_node = math.sin(node), math.cos(node)
    along = radius * cos_argument
    across = radius * sin_argument
    along_rate = radius_rate * cos_argument - across * argument_rate
    across_rate = radius_rate * sin_argument + along * argument_rate
    level = across * cos_tilt
    level_rate = across_rate * cos_tilt - across * sin_tilt * tilt_rate
    x = along * cos_node - level * sin_node
    y = along * sin_node + level * cos_node
    z = across * sin_tilt
    vx = along_rate * cos_node - level_rate * sin_node - y * node_rate
    vy = along_rate * sin_node + level_rate * cos_node + x * node_rate
    vz = across_rate * sin_tilt + across * cos_tilt * tilt_rate

    if geostationary:
        # Rx(-5 deg), then Rz(earth_rate * time): out of the tilted frame that does not turn since toe.
        y, z = TILT_COS * y + TILT_SIN * z, TILT_COS * z - TILT_SIN * y
        vy, vz = TILT_COS * vy + TILT_SIN * vz, TILT_COS * vz - TILT_SIN * vy
        sin_turn, cos_turn = math.sin(earth_rate * time), math.cos(earth_rate * time)
        x, y = cos_turn * x + sin_turn * y, cos_turn * y - sin_turn * x
        vx, vy = (
            cos_turn * vx + sin_turn * vy + earth_rate * y,
            cos_turn * vy - sin_turn * vx - earth_rate * x,
        )

    scale = -2.0 * math.sqrt(gravity) * eccentricity * sqrt_axis / (SPEED_OF_LIGHT * SPEED_OF_LIGHT)
    return (x, y, z), (vx, vy, vz), scale * sin_anomaly, scale * cos_anomaly * anomaly_rate


@njit
def eccentric_anomaly(mean_anomaly, eccentricity):
    """Return E of Kepler's equation E - e sin E = M (rad): Newton's method, converged to rounding for e up to 0.5."""
    anomaly = mean_anomaly + eccentricity * math.sin(mean_anomaly)
    for _ in range(10):
        step = (anomaly - eccentricity * math.sin(anomaly) - mean_anomaly) / (1.0 - eccentricity * math.cos(anomaly))
        anomaly -= step
        if abs(step) < 1e-14:
            break
    return anomaly


@njit
def integrated_orbit(ephemeris, time):
    """Return position (m) and velocity (m/s) of a GLONASS satellite, ECEF (PZ-90.11), ``time`` s after its toe.

    Fourth-order Runge-Kutta (GLONASS ICD 5.1, A.3.1.2) in whole steps from toe and a last shorter one.
    """
    position, velocity = ephemeris["position"], ephemeris["velocity"]
    state = (position[0], position[1], position[2], velocity[0], velocity[1], velocity[2])
    pull = ephemeris["acceleration"]
    third_bodies = (pull[0], pull[1], pull[2])
    # Stale ephemerides are refused before; this only ensures that the loop ends.
    if not abs(time) < 1e6:
        return (math.nan, math.nan, math.nan), (math.nan, math.nan, math.nan)
    left = time
    while left != 0.0:
        step = min(GLONASS_STEP, max(-GLONASS_STEP, left))
        left -= step
        k1 = glonass_motion(state, third_bodies)
        k2 = glonass_motion(moved(state, k1, 0.5 * step), third_bodies)
        k3 = glonass_motion(moved(state, k2, 0.5 * step), third_bodies)
        k4 = glonass_motion(moved(state, k3, step), third_bodies)
        state = moved(moved(moved(moved(state, k1, step / 6.0), k2, step / 3.0), k3, step / 3.0), k4, step / 6.0)
    return (state[0], state[1], state[2]), (state[3], state[4], state[5])


@njit
def glonass_motion(state, third_bodies):
    """Return the derivative of (x, y, z, vx, vy, vz) in the rotating frame (GLONASS ICD 5.1, A.3.1.2)."""
    x, y, z, vx, vy, vz = state
    r2 = x * x + y * y + z * z
    central = GRAVITY_GLONASS / (r2 * math.sqrt(r2))
    flattening = 1.5 * J2_GLONASS * central * RADIUS_GLONASS * RADIUS_GLONASS / r2
    polar = 5.0 * z * z / r2
    equatorial = -central - flattening * (1.0 - polar) + RATE_GLONASS * RATE_GLONASS
    return (
        vx,
        vy,
        vz,
        equatorial * x + 2.0 * RATE_GLONASS * vy + third_bodies[0],
        equatorial * y - 2.0 * RATE_GLONASS * vx + third_bodies[1],
        (-central - flattening * (3.0 - polar)) * z + third_bodies[2],
    )


@njit
def moved(state, derivative, time):
    """Return state + derivative * time, six numbers each."""
    return (
        state[0] + derivative[0] * time,
        state[1] + derivative[1] * time,
        state[2] + derivative[2] * time,
        state[3] + derivative[3] * time,
        state[4] + derivative[4] * time,
        state[5] + derivative[5] * time,
    )
