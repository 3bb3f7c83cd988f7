"""A simulated magnetometer: the field of the Earth in its axes, with hard iron, disturbances and white noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import east_north_up_to_ecef, to_geodetic
from eskf_ros.simulate.episodes import Episode, MagneticDisturbance
from eskf_ros.simulate.motion import Vector, mounting
from eskf_ros.simulate.sampling import Interval, Section, Stamps, arrivals, check_rate, generators

Array = NDArray[np.float64]

_PHASE = 0.0047


@dataclass(frozen=True)
class Magnetometer:
    """A three-axis magnetometer in the field of the Earth, which is the same in east, north, up wherever it is.

    The field: ``declination_deg`` (east of true north positive), ``inclination_deg`` (below the horizon positive),
    ``strength`` in T; the defaults are those of Munich in 2025, rounded. ``rpy_deg``: fixed-axis mounting in
    base_link. Hard iron (T, in the sensor's axes) is ``hard_iron`` plus a Gaussian vector of standard deviation
    ``hard_iron_std`` per axis. ``noise_std`` (T): white noise per axis of each message. ``rate`` in Hz, ``latency``:
    shortest and longest seconds from stamp to arrival.
    """

    declination_deg: float = 4.3
    inclination_deg: float = 64.4
    strength: float = 48.7e-6
    rpy_deg: Vector = (0.0, 0.0, 0.0)
    hard_iron: Vector = (0.0, 0.0, 0.0)
    hard_iron_std: float = 0.0
    noise_std: float = 0.3e-6
    rate: float = 50.0
    latency: Interval = (0.001, 0.005)

    def __post_init__(self) -> None:
        """Raise ValueError for a rate that is none."""
        check_rate("rate of the magnetometer", self.rate)

    @property
    def field_enu(self) -> Array:
        """The field of the Earth (3,) in T, axes east, north, up."""
        declination, inclination = math.radians(self.declination_deg), math.radians(self.inclination_deg)
        level = math.cos(inclination)
        direction = (level * math.sin(declination), level * math.cos(declination), -math.sin(inclination))
        return self.strength * np.array(direction)

    def parameters(self) -> dict[str, Any]:
        """Return the estimator's parameters that describe this sensor, by dotted name; its use is not asked for."""
        return {
            "mag.mount_rpy_deg": list(self.rpy_deg),
            "mag.std_floor": max(self.noise_std, 1e-9),
        }

    def measure(
        self, section: Section, episodes: Sequence[Episode], seed: np.random.SeedSequence
    ) -> MagnetometerMeasurements:
        """Return the measurements in ``section``; of ``episodes`` those count that disturb the field."""
        iron_stream, noise_stream, arrival_stream = generators(seed, 3)
        stamp = section.stamps(self.rate, _PHASE)
        motion = section.motion(stamp)
        enu_to_ecef = east_north_up_to_ecef(to_geodetic(section.frame.to_ecef(motion.position_map)))
        field_map = enu_to_ecef @ self.field_enu @ section.frame.rotation_map_to_ecef
        for episode in episodes:
            if isinstance(episode, MagneticDisturbance):
                field_map[episode.covers(section.elapsed(stamp))] += episode.field
        hard_iron = np.array(self.hard_iron) + self.hard_iron_std * iron_stream.standard_normal(3)
        field_body = np.einsum("nji,nj->ni", motion.rotation_body_to_map, field_map)
        noise = self.noise_std * noise_stream.standard_normal(field_body.shape)
        return MagnetometerMeasurements(
            sensor=self,
            hard_iron=hard_iron,
            stamp=stamp,
            arrival=arrivals(stamp, self.latency, arrival_stream),
            # Row vectors times the rotation to the body are the transposed rotation: body to sensor.
            field=field_body @ mounting(self.rpy_deg) + hard_iron + noise,
        )


@dataclass(frozen=True)
class MagnetometerMeasurements:
    """The measured ``field`` (n, 3) in T and in the sensor's axes, one row per message (int64 ns).

    ``hard_iron`` (3,): the true one, in T and in the sensor's axes.
    """

    sensor: Magnetometer
    hard_iron: Array
    stamp: Stamps
    arrival: Stamps
    field: Array
