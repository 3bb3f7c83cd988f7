"""WGS84: geodetic and Earth-centred coordinates, the local frame, normal gravity.

``ecef`` is Earth-centred Earth-fixed (REP-105 ``earth``); ``map`` is East-North-Up at the datum, rigidly fixed to the
Earth. Vectors are tuples of floats inside compiled code, so that nothing is allocated. Lengths in metres, angles in
radians unless a name ends in ``_deg``.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit

SEMI_MAJOR_AXIS = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
SEMI_MINOR_AXIS = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
GRAVITATIONAL_CONSTANT = 3.986004418e14
EARTH_RATE = 7.292115e-5
STANDARD_GRAVITY = 9.80665

J2 = 1.082629821313e-3
# Heiskanen and Moritz, Physical Geodesy, eq. 2-92: the zonal harmonics of a level ellipsoid follow from J2.
J4 = -3.0 * ECCENTRICITY_SQUARED**2 / 35.0 * (-1.0 + 10.0 * J2 / ECCENTRICITY_SQUARED)
J6 = 3.0 * ECCENTRICITY_SQUARED**3 / 63.0 * (-2.0 + 15.0 * J2 / ECCENTRICITY_SQUARED)


@njit
def geodetic_to_ecef(latitude, longitude, altitude):
    """Return ECEF x, y, z (m) of geodetic latitude, longitude (rad) and ellipsoidal altitude (m).

    Groves, Principles of GNSS, Inertial and Multisensor Integrated Navigation Systems, 2nd ed., eq. 2.112.
    """
    sin_latitude = math.sin(latitude)
    cos_latitude = math.cos(latitude)
    transverse_radius = SEMI_MAJOR_AXIS / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sin_latitude * sin_latitude)
    return (
        (transverse_radius + altitude) * cos_latitude * math.cos(longitude),
        (transverse_radius + altitude) * cos_latitude * math.sin(longitude),
        (transverse_radius * (1.0 - ECCENTRICITY_SQUARED) + altitude) * sin_latitude,
    )


@njit
def ecef_to_geodetic(x, y, z):
    """Return latitude, longitude (rad) and ellipsoidal altitude (m) of an ECEF position (m).

    Bowring's iteration (Groves, appendix C.2) on the reduced latitude; two rounds leave less than 1e-9 m between
    10 km below and 10 000 km above the ellipsoid, four serve everything else but the centre of the Earth.
    """
    horizontal = math.sqrt(x * x + y * y)
    longitude = math.atan2(y, x)
    second_eccentricity_squared = ECCENTRICITY_SQUARED / (1.0 - ECCENTRICITY_SQUARED)
    reduced = math.atan2(z * SEMI_MAJOR_AXIS, horizontal * SEMI_MINOR_AXIS)
    latitude = 0.0
    for _ in range(4):
        sin_reduced = math.sin(reduced)
        cos_reduced = math.cos(reduced)
        latitude = math.atan2(
            z + second_eccentricity_squared * SEMI_MINOR_AXIS * sin_reduced**3,
            horizontal - ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS * cos_reduced**3,
        )
        reduced = math.atan2((1.0 - FLATTENING) * math.sin(latitude), math.cos(latitude))
    sin_latitude = math.sin(latitude)
    cos_latitude = math.cos(latitude)
    transverse_radius = SEMI_MAJOR_AXIS / math.sqrt(1.0 - ECCENTRICITY_SQUARED * sin_latitude * sin_latitude)
    # This form of the altitude is well conditioned at every latitude, the poles included.
    altitude = horizontal * cos_latitude + z * sin_latitude - SEMI_MAJOR_AXIS**2 / transverse_radius
    return latitude, longitude, altitude


@njit
def east_north_up_to_ecef(latitude, longitude):
    """Return the rotation from East-North-Up at latitude, longitude (rad) to ECEF, as three row tuples.

    The columns are the east, north and up directions in ECEF. Groves, eq. 2.150 (there for North-East-Down).
    """
    sin_latitude = math.sin(latitude)
    cos_latitude = math.cos(latitude)
    sin_longitude = math.sin(longitude)
    cos_longitude = math.cos(longitude)
    return (
        (-sin_longitude, -sin_latitude * cos_longitude, cos_latitude * cos_longitude),
        (cos_longitude, -sin_latitude * sin_longitude, cos_latitude * sin_longitude),
        (0.0, cos_latitude, sin_latitude),
    )


@njit
def normal_gravity_ecef(x, y, z):
    """Return the WGS84 normal gravity vector (m/s2, ECEF axes, centrifugal part included) at an ECEF position (m).

    Gradient of the normal potential in zonal harmonics to J6 (Heiskanen and Moritz, section 2-9), with
    (n+1) P_n + s P_n' = P_{n+1}' and (n+1) s P_n - (1 - s^2) P_n' = (n+1) P_{n+1}. What J8 would add is below
    2e-9 m/s2. Unlike gravity along the ellipsoid normal it has the right direction at altitude too, and it needs no
    latitude.
    """
    r2 = x * x + y * y + z * z
    r = math.sqrt(r2)
    s = z / r
    s2 = s * s
    ratio2 = SEMI_MAJOR_AXIS * SEMI_MAJOR_AXIS / r2
    c2 = J2 * ratio2
    c4 = J4 * ratio2 * ratio2
    c6 = J6 * ratio2 * ratio2 * ratio2
    radial = (
        c2 * (7.5 * s2 - 1.5)
        + c4 * (39.375 * s2 * s2 - 26.25 * s2 + 1.875)
        + c6 * (187.6875 * s2 * s2 * s2 - 216.5625 * s2 * s2 + 59.0625 * s2 - 2.1875)
    )
    axial = s * (
        c2 * (7.5 * s2 - 4.5)
        + c4 * (39.375 * s2 * s2 - 43.75 * s2 + 9.375)
        + c6 * (187.6875 * s2 * s2 * s2 - 303.1875 * s2 * s2 + 137.8125 * s2 - 15.3125)
    )
    scale = GRAVITATIONAL_CONSTANT / r2
    equatorial = scale / r * (radial - 1.0) + EARTH_RATE * EARTH_RATE
    return equatorial * x, equatorial * y, scale * (axial - s)
