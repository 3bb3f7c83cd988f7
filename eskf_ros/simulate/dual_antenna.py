"""A simulated dual-antenna receiver: yaw and pitch of the line from the first to the second antenna."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import east_north_up_to_ecef, to_geodetic
from eskf_ros.simulate.episodes import Episode, received
from eskf_ros.simulate.gnss import GNSS_PHASE
from eskf_ros.simulate.motion import Vector
from eskf_ros.simulate.sampling import Interval, Section, Stamps, arrivals, check_rate, generators

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DualAntenna:
    """Two antennas and the receiver that gives yaw and pitch of their baseline.

    ``baseline`` (m): from the first to the second antenna in base_link. ``yaw_std_deg``, ``pitch_std_deg``: white error
    of each message; infinite: not measured.
    ``rate`` in Hz, epochs like those of the GNSS receiver; ``latency``: shortest and longest seconds from an epoch to
    the arrival of its message.
    """

    baseline: Vector = (1.0, 0.0, 0.0)
    yaw_std_deg: float = 0.3
    pitch_std_deg: float = math.inf
    rate: float = 5.0
    latency: Interval = (0.08, 0.2)

    def __post_init__(self) -> None:
        """Raise ValueError for a rate that is none and for a baseline without direction in the plane."""
        check_rate("rate of the dual antenna", self.rate)
        if math.hypot(*self.baseline[:2]) == 0.0:
            raise ValueError(f"the baseline of the dual antenna must lead sideways, not {self.baseline}")

    def parameters(self) -> dict[str, Any]:
        """Return the estimator's parameters that describe this sensor, by dotted name."""
        x, y, z = self.baseline
        yaw, pitch = math.atan2(y, x), math.atan2(-z, math.hypot(x, y))
        return {
            "heading.mount_rpy_deg": [0.0, math.degrees(pitch), math.degrees(yaw)],
            "heading.offset_std_deg": 0.0,
        }

    def measure(
        self, section: Section, episodes: Sequence[Episode], seed: np.random.SeedSequence
    ) -> DualAntennaMeasurements:
        """Return the measurements in ``section``; of ``episodes`` the outages count."""
        noise_stream, arrival_stream, pitch_stream = generators(seed, 3)
        stamp = section.stamps(self.rate, GNSS_PHASE)
        motion = section.motion(stamp)
        baseline_ecef = motion.rotation_body_to_map @ np.array(self.baseline) @ section.frame.rotation_map_to_ecef.T
        enu_to_ecef = east_north_up_to_ecef(to_geodetic(section.frame.to_ecef(motion.position_map)))
        east, north, up = np.einsum("nji,nj->in", enu_to_ecef, baseline_ecef)
        yaw = np.arctan2(north, east) + math.radians(self.yaw_std_deg) * noise_stream.standard_normal(len(stamp))
        pitch = np.zeros(len(stamp))
        if math.isfinite(self.pitch_std_deg):
            noise = math.radians(self.pitch_std_deg) * pitch_stream.standard_normal(len(stamp))
            pitch = np.arctan2(-up, np.hypot(east, north)) + noise
        arrival = arrivals(stamp, self.latency, arrival_stream)
        kept = received(episodes, (1, 2), section.elapsed(stamp))
        wrapped = np.remainder(yaw + math.pi, 2.0 * math.pi) - math.pi
        return DualAntennaMeasurements(self, stamp[kept], arrival[kept], wrapped[kept], pitch[kept])


@dataclass(frozen=True)
class DualAntennaMeasurements:
    """The measured ``yaw`` (n,) of the baseline, rad counter-clockwise from east, one row per message (int64 ns).

    Its ``pitch`` (n,), rad, positive down, is zero where it is not measured.
    """

    sensor: DualAntenna
    stamp: Stamps
    arrival: Stamps
    yaw: Array
    pitch: Array
