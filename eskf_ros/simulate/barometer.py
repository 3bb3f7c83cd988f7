"""A simulated barometer: the pressure of the standard atmosphere at its height, with drift and white noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import to_geodetic
from eskf_ros.simulate.episodes import Episode
from eskf_ros.simulate.motion import Vector
from eskf_ros.simulate.sampling import Interval, Section, Stamps, arrivals, check_rate, generators

Array = NDArray[np.float64]

_PHASE = 0.0073

STANDARD_PRESSURE = 101325.0
"""Pressure (Pa) of the standard atmosphere at sea level."""
METRES_PER_PASCAL = 0.083
"""Near sea level."""
_TEMPERATURE = 288.15
_LAPSE_RATE = 0.0065
_EXPONENT = 9.80665 * 0.0289644 / (8.31432 * _LAPSE_RATE)


def standard_pressure(altitude: Array, qnh: float = STANDARD_PRESSURE) -> Array:
    """Return the pressure (Pa) at ``altitude`` (m, below 11 km) when it would be ``qnh`` (Pa) at sea level.

    ICAO standard atmosphere (Doc 7488), troposphere: T = 288.15 K - 6.5 K/km h.
    """
    return qnh * (1.0 - _LAPSE_RATE * altitude / _TEMPERATURE) ** _EXPONENT


@dataclass(frozen=True)
class Barometer:
    """A barometer.

    ``position`` (m): where it is in base_link. ``qnh`` (Pa): pressure at altitude zero at the start; altitude is the
    ellipsoidal one here, so the geoid's height is part of it. ``drift`` (Pa/sqrt(s)): random walk of that pressure, by
    weather and warming up. ``noise_std`` (Pa): white noise of each message. ``rate`` in Hz, ``latency``: shortest and
    longest seconds from stamp to arrival.
    """

    position: Vector = (0.0, 0.0, 0.0)
    qnh: float = 101800.0
    drift: float = 0.5
    noise_std: float = 3.0
    rate: float = 20.0
    latency: Interval = (0.005, 0.02)

    def __post_init__(self) -> None:
        """Raise ValueError for a rate that is none."""
        check_rate("rate of the barometer", self.rate)

    def parameters(self) -> dict[str, Any]:
        """Return the estimator's parameters that describe this sensor, by dotted name."""
        return {
            "baro.position": list(self.position),
            "baro.offset_random_walk": METRES_PER_PASCAL * self.drift,
            "baro.std_floor": max(self.noise_std, 0.1),
            "baro.scale_std": 0.002,
        }

    def measure(
        self, section: Section, _episodes: Sequence[Episode], seed: np.random.SeedSequence
    ) -> BarometerMeasurements:
        """Return the measurements in ``section``; no kind of episode concerns this sensor."""
        drift_stream, noise_stream, arrival_stream = generators(seed, 3)
        stamp = section.stamps(self.rate, _PHASE)
        position_ecef = section.frame.to_ecef(section.motion(stamp).position_of(self.position))
        drift = self.drift / math.sqrt(self.rate) * drift_stream.standard_normal(len(stamp))
        drift[:1] = 0.0
        drift = np.cumsum(drift)
        noise = self.noise_std * noise_stream.standard_normal(len(stamp))
        return BarometerMeasurements(
            sensor=self,
            stamp=stamp,
            arrival=arrivals(stamp, self.latency, arrival_stream),
            pressure=standard_pressure(to_geodetic(position_ecef)[:, 2], self.qnh) + drift + noise,
            drift=drift,
        )


@dataclass(frozen=True)
class BarometerMeasurements:
    """The measured ``pressure`` (n,) and its true ``drift`` since the start (n,) in Pa, one row per message (ns)."""

    sensor: Barometer
    stamp: Stamps
    arrival: Stamps
    pressure: Array
    drift: Array
