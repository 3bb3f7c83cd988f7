"""A sky of our own making: GPS, Galileo and BeiDou satellites on orbits like the real ones, none of them real.

Planes, slots, heights and inclinations are nominal (IS-GPS-200, OS-SIS-ICD, BDS-SIS-ICD: 6, 3 and 3 planes); what is
irregular in real ephemerides (eccentricity, harmonics, clocks, group delays) is drawn once and for all. All messages
have one reference time, which serves from half an hour before the time zero of the scenarios to two hours after.

    python -m eskf_ros.simulate.constellation > bags/sky.nav
"""

from __future__ import annotations

import math
import sys
from functools import lru_cache

import numpy as np

from eskf_ros.geodesy.earth import SEMI_MAJOR_AXIS
from eskf_ros.gnss.ephemeris import Broadcast, Message
from eskf_ros.gnss.orbits import GRAVITY, J2_GLONASS, RATE
from eskf_ros.gnss.rinex_nav_writer import navigation_text, rounded
from eskf_ros.gnss.signals import Gnss

WEEK, TOE = 2369, 28800.0
"""Reference time of all messages: 1 June 2025, 8:00, on each constellation's own time scale."""

LEAP_SECONDS = 18

KLOBUCHAR = {
    Gnss.GPS: np.array([1.8626e-8, 1.4901e-8, -1.1921e-7, -5.9605e-8, 1.2288e5, 8.1920e4, -1.9661e5, -3.2768e5])
}

_COMMENTS = (
    "SYNTHETIC: made by eskf_ros.simulate.constellation.",
    "NONE OF THESE SATELLITES EXISTS. For simulations only.",
)

# Numbers of the satellites, planes, semi-major axis (m), inclination (deg), largest eccentricity, node of the first
# plane (deg), phase from plane to plane as a share of the distance of slots.
_NOMINAL = {
    Gnss.GPS: (range(1, 32), 6, 26_559_800.0, 55.0, 0.018, 32.0, 0.43),
    Gnss.GALILEO: (range(1, 25), 3, 29_600_300.0, 56.0, 0.0006, 77.0, 1.0 / 3.0),
    Gnss.BEIDOU: (range(19, 43), 3, 27_906_100.0, 55.0, 0.0012, 105.0, 1.0 / 3.0),
}


@lru_cache(maxsize=1)
def messages() -> tuple[Broadcast, ...]:
    """Return the navigation messages of all satellites, with numbers as they come back from a file."""
    rng = np.random.Generator(np.random.PCG64(20250601))
    sent = []
    for gnss, (numbers, planes, *_) in _NOMINAL.items():
        for place, sv_id in enumerate(numbers):
            plane, slot = place % planes, place // planes
            slots = math.ceil((len(numbers) - plane) / planes)
            sent.append(_message(gnss, sv_id, plane, slot / slots, 1.0 / slots, rng))
    return tuple(sent)


def _message(gnss: Gnss, sv_id: int, plane: int, along: float, spacing: float, rng: np.random.Generator) -> Broadcast:
    """Return one message; ``along`` and ``spacing``: place and distance of slots in the plane, in revolutions."""
    _, planes, axis, inclination_deg, largest_eccentricity, node_deg, phase = _NOMINAL[gnss]
    eccentricity = largest_eccentricity * rng.uniform(0.1, 1.0)
    perigee = rng.uniform(-math.pi, math.pi)
    argument = 2.0 * math.pi * (along + phase * plane * spacing + 0.05 * spacing * rng.uniform(-1.0, 1.0))
    node = math.radians(node_deg) + 2.0 * math.pi * plane / planes + 0.03 * rng.uniform(-1.0, 1.0)
    # By the flattening of the Earth (Groves, section 8.5.2).
    regression = 1.5 * J2_GLONASS * (SEMI_MAJOR_AXIS / axis) ** 2 * math.sqrt(GRAVITY / axis**3)
    values = {
        "af0": rng.uniform(-4e-4, 4e-4),
        "af1": 4e-12 * rng.uniform(-1.0, 1.0),
        "af2": 0.0,
        "sqrt_a": math.sqrt(axis + 2e3 * rng.uniform(-1.0, 1.0)),
        "e": eccentricity,
        "omega": perigee,
        "m0": math.remainder(argument - perigee, 2.0 * math.pi),
        # The node is given as it would be at the start of the week.
        "omega0": math.remainder(node + RATE * TOE, 2.0 * math.pi),
        "omega_dot": -regression * math.cos(math.radians(inclination_deg)),
        "i0": math.radians(inclination_deg + 0.6 * rng.uniform(-1.0, 1.0)),
        "idot": 4e-10 * rng.uniform(-1.0, 1.0),
        "delta_n": 4.5e-9 * (26.56e6 / axis) ** 3.5 + 3e-10 * rng.uniform(-1.0, 1.0),
        "cuc": 4e-6 * rng.uniform(-1.0, 1.0),
        "cus": 9e-6 * rng.uniform(0.5, 1.0),
        "crc": 230.0 + 120.0 * rng.uniform(-1.0, 1.0),
        "crs": 90.0 * rng.uniform(-1.0, 1.0),
        "cic": 1.5e-7 * rng.uniform(-1.0, 1.0),
        "cis": 1.5e-7 * rng.uniform(-1.0, 1.0),
        "toe": TOE,
        "issue": float(rng.integers(1, 100)),
        "health": 0.0,
        "sent": TOE - 3600.0,
    }
    delay = 8e-9 * rng.uniform(-1.0, 1.0)
    if gnss == Gnss.GALILEO:
        # Data sources (RINEX 3.04, table A8): I/NAV on E1, clock of E5b.
        values |= {"source": 513.0, "accuracy": 3.12, "bgd_e5a": delay, "bgd_e5b": 1.1 * delay}
        message = Message.INAV
    elif gnss == Gnss.BEIDOU:
        values |= {"accuracy": 2.0, "tgd": delay, "tgd2": 0.4 * delay}
        message = Message.D1
    else:
        values |= {"accuracy": 2.0, "fit": 4.0, "tgd": delay}
        message = Message.LNAV
    return Broadcast(gnss, sv_id, message, WEEK, TOE, {name: rounded(value) for name, value in values.items()})


def text() -> str:
    """Return the file."""
    return navigation_text(messages(), KLOBUCHAR, LEAP_SECONDS, _COMMENTS)


if __name__ == "__main__":
    sys.stdout.write(text())
