"""What pseudorange and range rate of a signal share: the payload, the antenna, the line of sight.

Payload of both: the measured value (m, m/s; satellite clock and group delay taken out), its standard deviation (NaN: by
model), satellite position and velocity (ECEF at transmission, m, m/s), flags of `gnss.ranges`, carrier (Hz), C/N0
(dB-Hz, NaN unknown), noise factor, and for the atmosphere GPS time (s since 6 January 1980) and the eight parameters of
Klobuchar (NaN: none). The source names the signal.
"""

from __future__ import annotations

from dataclasses import dataclass

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.geodesy.rotation import cross, rotate, rotate_back, to_matrix
from eskf_ros.gnss.geometry import line_of_sight
from eskf_ros.gnss.ranges import ALREADY_TURNED
from eskf_ros.gnss.signals import LETTERS, SIGNALS, time_group
from eskf_ros.parameters.schema import TIME_OFFSET, Aid, parameter

MEASURED = 0
STD = 1
SATELLITE = 2
SATELLITE_VELOCITY = 5
FLAGS = 8
CARRIER = 9
CN0 = 10
NOISE_FACTOR = 11
GPS_TIME = 12
KLOBUCHAR = 13
FIELD = 21

LETTER_OF = {int(gnss): letter for letter, gnss in LETTERS.items()}


@njit
def source_of(gnss_id, sv_id, signal):
    """Return the number that identifies a signal among the sources of a stream."""
    return (gnss_id * 256 + sv_id) * 256 + signal


@njit
def satellite_of(source):
    """Return ``gnss_id`` and ``sv_id`` of a source."""
    return source >> 16, (source >> 8) & 255


def name_of(source: int) -> str:
    """Return the RINEX name of a signal: constellation and satellite, band and attribute ("G07 1C")."""
    gnss_id, sv_id, signal = source >> 16, (source >> 8) & 255, source & 255
    letter = LETTER_OF.get(gnss_id, "?")
    code = SIGNALS[signal].code if signal < len(SIGNALS) else "?"
    return f"{letter}{sv_id:02d} {code}"


@njit
def system_of(source):
    """Return the group of satellites that share an offset in the receiver's clock (`gnss.signals.time_group`)."""
    gnss_id, sv_id = satellite_of(source)
    return time_group(gnss_id, sv_id)


@njit
def clock_bias(state, settings):
    """Return the bias of the receiver's clock (m)."""
    return state.optional[settings.clock_at - ERROR_SIZE]


@njit
def clock_drift(state, settings):
    """Return the drift of the receiver's clock (m/s)."""
    return state.optional[settings.clock_at + 1 - ERROR_SIZE]


@njit
def antenna_ecef(state, settings):
    """Return position (m) and velocity (m/s) of the antenna of the first receiver, ECEF."""
    rotation = to_matrix(state.attitude)
    arm = settings.lever_arms_body[0]
    p, v = state.position_map, state.velocity_map
    lever = rotate(rotation, arm)
    lever_velocity = rotate(rotation, cross(body_rate(state, rotation), arm))
    offset = rotate(state.frame.map_to_ecef, (p[0] + lever[0], p[1] + lever[1], p[2] + lever[2]))
    velocity = rotate(
        state.frame.map_to_ecef, (v[0] + lever_velocity[0], v[1] + lever_velocity[1], v[2] + lever_velocity[2])
    )
    origin = state.frame.origin_ecef
    return (origin[0] + offset[0], origin[1] + offset[1], origin[2] + offset[2]), velocity


@njit
def see(payload, position, velocity):
    """Return unit vector to the satellite (ECEF), range (m) and range rate (m/s).

    ``position`` (m) and ``velocity`` (m/s) are those of the antenna in ECEF.
    """
    p, v = SATELLITE, SATELLITE_VELOCITY
    return line_of_sight(
        (payload[p], payload[p + 1], payload[p + 2]),
        (payload[v], payload[v + 1], payload[v + 2]),
        position,
        velocity,
        int(payload[FLAGS]) & ALREADY_TURNED != 0,
    )


@njit
def to_map(state, vector_ecef):
    """Return a vector of ECEF axes in map axes."""
    return rotate_back(state.frame.map_to_ecef, vector_ecef)


@dataclass(frozen=True)
class Ranges(Aid):
    use: bool = parameter(
        True,
        "",
        "Fuse the pseudoranges of topics.ranges in mode tight.",
        live=True,
    )
    use_doppler: bool = parameter(True, "", "Fuse the Doppler of topics.ranges in mode tight.", live=True)
    time_offset: float = parameter(
        0.0,
        "s",
        "Added to the stamps: true time = stamp + offset. RINEX files are stamped with UTC: -18 or 18 s may be missing "
        "where a recording is stamped with GPS time.",
        **TIME_OFFSET,
    )
    gate_probability: float = parameter(
        0.99994,
        "",
        "Gate of each signal: the share of good measurements that passes; 0.99994 is four standard deviations. From "
        "2.5 on they are weighed down.",
        above=0.0,
        below=1.0,
        live=True,
    )
    code_std_floor: float = parameter(
        0.3,
        "m",
        "The standard deviation of a pseudorange is never taken smaller than this.",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    range_rate_std_floor: float = parameter(
        0.03,
        "m/s",
        "The standard deviation of a range rate (Doppler) is never taken smaller than this.",
        above=0.0,
        maximum=100.0,
        live=True,
    )
    elevation_mask_deg: float = parameter(
        10.0, "deg", "Satellites below this elevation are not used.", minimum=-90.0, maximum=90.0, live=True
    )
    cn0_mask: float = parameter(
        28.0,
        "dB-Hz",
        "Signals whose carrier-to-noise density is below this are not used; an unknown one passes.",
        minimum=0.0,
        maximum=60.0,
        live=True,
    )
    clock_drift_noise: float = parameter(
        0.3,
        "m/s/rts",
        "How fast the drift of the receiver's clock wanders: by this value times the square root of the seconds "
        "passed. 0.1 geodetic receiver, 0.3 usual, 0.6 hand-held or shaken. Too small makes one or two satellites "
        "worse than none.",
        minimum=0.0,
        maximum=1.0e3,
        live=True,
    )
    clock_bias_noise: float = parameter(
        0.1,
        "m/rts",
        "How fast the bias of the receiver's clock wanders besides its drift.",
        minimum=0.0,
        maximum=1.0e3,
        live=True,
    )
    correlation_time: float = parameter(
        120.0,
        "s",
        "How long the common error of the pseudoranges lasts (e-folding time): reflections, orbits, what the models "
        "leave of the atmosphere. 0: not modelled, and the estimate then trusts the mean of many epochs too much.",
        minimum=0.0,
        maximum=1.0e5,
    )
    correlated_std: float = parameter(
        1.5,
        "m",
        "With a correlation_time: the standard deviation of a position by errors that last, per horizontal axis ...",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    correlated_std_vertical: float = parameter(
        3.0,
        "m",
        "... and vertically, where the atmosphere is not averaged out. More without parameters of the ionosphere for "
        "the day (5 m): the stand-in may be wrong by its own size.",
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    inter_system_std: float = parameter(
        10.0,
        "m",
        "Standard deviation of the offset between a constellation and GPS in the receiver at first.",
        above=0.0,
        maximum=1.0e4,
    )
    inter_system_std_glonass: float = parameter(30.0, "m", "The same for GLONASS.", above=0.0, maximum=1.0e4)
    inter_system_noise: float = parameter(
        0.02, "m/rts", "How fast these offsets wander.", minimum=0.0, maximum=100.0, live=True
    )
    use_point_solution: bool = parameter(
        False,
        "",
        "In mode loose: solve each epoch of topics.ranges for position and velocity, and fuse these instead of the "
        "receiver's own fixes.",
    )
    rinex_nav_files: str = parameter(
        "",
        "",
        "RINEX navigation files with the orbits and clocks of the satellites, separated by colons. Empty: they come "
        "by topics.ephemerides, or topics.ranges brings the satellites itself.",
        pattern=r"[^\0]*",
        pattern_text="paths separated by colons, or nothing",
    )
