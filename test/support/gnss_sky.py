"""A sky of invented satellites, and what a receiver under it would measure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic, geodetic_to_ecef
from eskf_ros.gnss.ephemeris import EPHEMERIS, Ephemerides, Message, glonass_record, kepler_record
from eskf_ros.gnss.geometry import elevation_azimuth, line_of_sight, state_at_reception
from eskf_ros.gnss.range_model import PREDICTION, predict
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, allocate_ranges, locate
from eskf_ros.gnss.signals import GNSS_COUNT, SIGNAL_BY_CODE, SPEED_OF_LIGHT, Gnss, time_group
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING
from support import gnss_texts as texts

Array = NDArray[np.float64]

WEEK, SECONDS = texts.WEEK, texts.TOE
KLOBUCHAR = np.array([1.77e-8, 2.235e-8, -1.192e-7, -5.96e-8, 1.27e5, 1.475e5, -1.966e5, -1.966e5])
CODES = {Gnss.GPS: "1C", Gnss.GALILEO: "1C", Gnss.BEIDOU: "2I", Gnss.QZSS: "1C", Gnss.GLONASS: "1C"}


def constellation(gnss: Gnss, planes: int, per_plane: int, first: int = 1) -> list[np.void]:
    """Satellites evenly spread over ``planes`` orbital planes."""
    records = []
    for number in range(planes * per_plane):
        plane, place = divmod(number, per_plane)
        fields = {
            **texts.MEO,
            "e": 0.002 + 0.0003 * number,
            "omega0": 2.0 * math.pi * plane / planes + 0.3 * gnss,
            "m0": 2.0 * math.pi * (place / per_plane + 0.37 * plane / planes),
            "omega": 0.0,
            "af0": 1e-5 * (number - 7),
            "af1": 1e-12 * (number - 7),
            "toe": SECONDS,
            "tgd": 1e-9 * (number - 5),
            "tgd2": 0.0,
            "bgd_e5a": 1e-9,
            "bgd_e5b": 2e-9,
        }
        message = {Gnss.GALILEO: Message.INAV, Gnss.BEIDOU: Message.D1}.get(gnss, Message.LNAV)
        records.append(kepler_record(gnss, first + number, message, (WEEK, SECONDS), fields))
    return records


def glonass_constellation() -> list[np.void]:
    """Satellites on three planes, 25 500 km from the centre of the Earth."""
    records = []
    for number in range(24):
        plane, place = divmod(number, 8)
        along = 2.0 * math.pi * (place + plane / 3.0) / 8.0
        node, tilt = 2.0 * math.pi * plane / 3.0, math.radians(64.8)
        start = np.array([math.cos(node), math.sin(node), 0.0])
        side = np.array([-math.sin(node) * math.cos(tilt), math.cos(node) * math.cos(tilt), math.sin(tilt)])
        position = 25.5e3 * (math.cos(along) * start + math.sin(along) * side)
        velocity = 3.953 * (math.cos(along) * side - math.sin(along) * start)
        velocity -= np.cross([0.0, 0.0, 7.292115e-5], position)
        names = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")
        fields = dict(zip(names, (*position, *velocity, 0.0, 0.0, 0.0)))
        fields |= {"af0": 2e-5 * (number - 9), "af1": 0.0, "channel": float(number % 14 - 7)}
        records.append(glonass_record(number + 1, (WEEK, SECONDS), 18, fields))
    return records


def all_constellations() -> Ephemerides:
    records = constellation(Gnss.GPS, 6, 5) + constellation(Gnss.GALILEO, 3, 8)
    records += constellation(Gnss.BEIDOU, 2, 5, 6) + constellation(Gnss.BEIDOU, 3, 6, 19) + glonass_constellation()
    return Ephemerides(np.array(records, EPHEMERIS))


@dataclass
class Receiver:
    """Where a receiver is, how it moves (ECEF), and its clock: bias and drift of GPS ranges (m, m/s), offsets (m)."""

    position: Array
    velocity: Array
    clock_bias: float = 0.0
    clock_drift: float = 0.0
    offset: Array = field(default_factory=lambda: np.zeros(GNSS_COUNT))

    @property
    def enu_to_ecef(self) -> Array:
        latitude, longitude, _ = ecef_to_geodetic(*self.position.tolist())
        return np.array(east_north_up_to_ecef(latitude, longitude))


def receiver_at(latitude_deg: float, longitude_deg: float, altitude: float, **clock: float) -> Receiver:
    position = geodetic_to_ecef(math.radians(latitude_deg), math.radians(longitude_deg), altitude)
    return Receiver(np.array(position), np.array([12.0, -7.0, 3.0]), **clock)  # type: ignore[arg-type]


def measure(
    receiver: Receiver,
    ephemerides: Ephemerides,
    systems: tuple[Gnss, ...] = (Gnss.GPS,),
    rng: np.random.Generator | None = None,
    lowest_deg: float = 10.5,
    scale: float = 1.0,
) -> NDArray[np.void]:
    """Located ranges of all satellites above ``lowest_deg``.

    Their errors are ``scale`` times as large as `weighting` says; none without ``rng``.
    """
    place, motion = tuple(receiver.position.tolist()), tuple(receiver.velocity.tolist())
    local = tuple(map(tuple, receiver.enu_to_ecef.tolist()))
    visible = []
    for record in ephemerides.records:
        if record["gnss_id"] not in systems:
            continue
        position, velocity, *_ = state_at_reception(record, WEEK, SECONDS, place)
        unit, length, _ = line_of_sight(position, velocity, place, motion, False)
        elevation, _ = elevation_azimuth(unit, local)
        if elevation > math.radians(lowest_deg):
            visible.append((int(record["gnss_id"]), int(record["sv_id"]), length, math.degrees(elevation)))
    ranges = allocate_ranges(len(visible))
    for row, (gnss, sv_id, length, elevation_deg) in zip(ranges, visible):
        row["gnss_id"], row["sv_id"], row["signal"] = gnss, sv_id, SIGNAL_BY_CODE[Gnss(gnss), CODES[Gnss(gnss)]]
        row["cn0"] = 30.0 + 20.0 * math.sin(math.radians(elevation_deg))
        row["pseudorange"], row["doppler"] = length, 0.0
    ranges["flags"] = CODE_VALID | DOPPLER_VALID
    predictions = np.zeros(len(ranges), PREDICTION)
    # The pseudorange tells when the signal left, to be found from itself: a few rounds.
    for _ in range(4):
        ranges["flags"] = CODE_VALID | DOPPLER_VALID
        locate(ranges, WEEK, SECONDS, ephemerides)
        predict(ranges, place, motion, WEEK, SECONDS, KLOBUCHAR, DEFAULT_WEIGHTING, predictions)
        groups = [time_group(int(row["gnss_id"]), int(row["sv_id"])) for row in ranges]
        ranges["pseudorange"] = predictions["pseudorange"] + receiver.clock_bias + receiver.offset[groups]
    wavelength = SPEED_OF_LIGHT / ranges["carrier_hz"]
    ranges["doppler"] = -(predictions["range_rate"] + receiver.clock_drift) / wavelength
    if rng is not None:
        ranges["pseudorange"] += scale * rng.normal(size=len(ranges)) * predictions["code_std"]
        ranges["doppler"] += rng.normal(size=len(ranges)) * predictions["doppler_std"] / wavelength
    return ranges
