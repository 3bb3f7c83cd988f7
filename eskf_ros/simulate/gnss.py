"""A simulated GNSS receiver: position and velocity of the antenna at regular epochs, each with its covariance.

The errors are white and exactly as the covariances say, unless episodes (`eskf_ros.simulate.gnss_episodes` and
`gnss_message_episodes`) change that. Position and velocity of an epoch share the stamp; both arrive late by a latency
that differs from epoch to epoch, the velocity shortly after the position.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import east_north_up_to_ecef, to_geodetic
from eskf_ros.simulate.episodes import Episode, received
from eskf_ros.simulate.gnss_episodes import GnssEpisode, GnssReport
from eskf_ros.simulate.gnss_message_episodes import GnssMessageEpisode, changed_messages
from eskf_ros.simulate.motion import Vector
from eskf_ros.simulate.sampling import Interval, Section, Stamps, arrivals, check_rate, generators

Array = NDArray[np.float64]

GNSS_PHASE = 0.0137
"""Seconds from time zero to the first GNSS epoch, so that epochs fall between IMU samples, as they do on a robot."""

VELOCITY_AFTER_POSITION = (0.0002, 0.002)
"""Seconds from the arrival of a position to that of its velocity, uniformly distributed."""


class GnssStreams(NamedTuple):
    """Where the random numbers of a receiver come from: errors, those of episodes, delays."""

    position: np.random.Generator
    velocity: np.random.Generator
    episodes: np.random.Generator
    fix_delay: np.random.Generator
    velocity_delay: np.random.Generator


@dataclass(frozen=True)
class GnssReceiver:
    """A receiver and its antenna.

    ``lever_arm`` (m): the antenna in base_link; ``rate`` in Hz. Standard deviations of the errors are (horizontal,
    vertical) in m and m/s. ``latency``: shortest and longest seconds from an epoch to the arrival of its position.
    """

    lever_arm: Vector = (-0.8, 0.2, 1.4)
    rate: float = 5.0
    position_std: tuple[float, float] = (1.0, 1.5)
    velocity_std: tuple[float, float] = (0.08, 0.12)
    latency: Interval = (0.08, 0.2)

    def __post_init__(self) -> None:
        """Raise ValueError for a rate that is none."""
        check_rate("rate of the GNSS receiver", self.rate)

    def measure(self, section: Section, episodes: Sequence[Episode], seed: np.random.SeedSequence) -> GnssMeasurements:
        """Return what the second receiver gives in ``section``; of ``episodes`` those of GNSS count."""
        return self.measure_as(2, section, episodes, GnssStreams(*generators(seed, 5)))

    def measure_as(
        self, receiver: int, section: Section, episodes: Sequence[Episode], streams: GnssStreams
    ) -> GnssMeasurements:
        """Return what this gives as the first or second ``receiver``, from given random streams."""
        stamp = section.stamps(self.rate, GNSS_PHASE)
        motion = section.motion(stamp)
        position_ecef = section.frame.to_ecef(motion.position_of(self.lever_arm))
        velocity_ecef = motion.velocity_of(self.lever_arm) @ section.frame.rotation_map_to_ecef.T
        enu_to_ecef = east_north_up_to_ecef(to_geodetic(position_ecef))

        elapsed = section.elapsed(stamp)
        report = GnssReport.faultless(elapsed, self.position_std, self.velocity_std)
        for episode in episodes:
            if isinstance(episode, GnssEpisode) and episode.receiver in (0, receiver):
                episode.apply(report, streams.episodes)
        position_error = streams.position.standard_normal(position_ecef.shape) * report.position_std
        velocity_error = streams.velocity.standard_normal(position_ecef.shape) * report.velocity_std
        position_error += report.position_offset
        velocity_error += report.velocity_offset
        geodetic = to_geodetic(position_ecef + np.einsum("nij,nj->ni", enu_to_ecef, position_error))
        geodetic[:, :2] *= 180.0 / math.pi
        velocity_enu = np.einsum("nji,nj->ni", enu_to_ecef, velocity_ecef) + velocity_error

        fix_arrival = arrivals(stamp, self.latency, streams.fix_delay)
        velocity_arrival = arrivals(fix_arrival, VELOCITY_AFTER_POSITION, streams.velocity_delay)
        # Outages only remove messages, so that what lies outside of them does not depend on them.
        kept = received(episodes, (receiver,), elapsed)
        said = GnssMeasurements(
            fix_stamp=stamp[kept],
            fix_arrival=fix_arrival[kept],
            fix_latitude_deg=geodetic[kept, 0],
            fix_longitude_deg=geodetic[kept, 1],
            fix_altitude=geodetic[kept, 2],
            fix_status=report.status[kept],
            fix_covariance=_diagonal(report.reported_position_std[kept]),
            fix_covariance_type=report.covariance_type[kept],
            velocity_stamp=stamp[kept],
            velocity_arrival=velocity_arrival[kept],
            velocity_enu=velocity_enu[kept],
            velocity_covariance=_diagonal(report.reported_velocity_std[kept]),
        )
        for episode in episodes:
            if not isinstance(episode, GnssMessageEpisode) or episode.receiver in (0, receiver):
                said = changed_messages(said, episode, streams.episodes)
        return said


@dataclass(frozen=True)
class GnssMeasurements:
    """What a receiver gave and when it arrived (``*_arrival``), one row per message.

    Stamps and arrivals are int64 ns. Position of the antenna: latitude and longitude in degrees, ellipsoidal altitude
    in m. ``fix_status`` and ``fix_covariance_type`` are as in NavSatFix. ``velocity_enu`` (n, 3) in m/s and both
    covariances, row-major (n, 9) in m2 and m2/s2, have the axes east, north, up at the antenna.
    """

    fix_stamp: Stamps
    fix_arrival: Stamps
    fix_latitude_deg: Array
    fix_longitude_deg: Array
    fix_altitude: Array
    fix_status: NDArray[np.int8]
    fix_covariance: Array
    fix_covariance_type: NDArray[np.uint8]
    velocity_stamp: Stamps
    velocity_arrival: Stamps
    velocity_enu: Array
    velocity_covariance: Array


def _diagonal(stds: Array) -> Array:
    """Return the covariances (n, 9) of independent axes with ``stds`` (n, 3)."""
    covariances = np.zeros((len(stds), 9))
    covariances[:, ::4] = stds**2
    return covariances
