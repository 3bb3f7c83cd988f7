"""Simulated wheel odometry: forward speed of a point of the body, and yaw rate.

The wheels turn as fast as the point ``position`` moves along the body's x axis over the ground, times whatever slips.
Speed and yaw rate are theirs times a scale factor, plus white noise; the speed may be quantised. Wheels that stand give
exactly zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.episodes import Episode, WheelSlip
from eskf_ros.simulate.motion import Vector, rotate
from eskf_ros.simulate.sampling import Interval, Section, Stamps, arrivals, check_rate, generators

Array = NDArray[np.float64]

_PHASE = 0.0031
_STANDING = 1e-9
"""Below this speed (m/s) and yaw rate (rad/s) wheels stand: what is left is rounding."""


@dataclass(frozen=True)
class WheelOdometer:
    """Wheel odometry.

    ``position`` (m, base_link): the point whose forward speed is given. The speed's scale factor is
    1 + ``scale_error`` + a Gaussian number of standard deviation ``scale_std``; that of the yaw rate is drawn with
    ``yaw_rate_scale_std``. ``speed_std`` (m/s), ``yaw_rate_std`` (rad/s): white noise of each message.
    ``speed_quantum`` (m/s): steps of the speed, 0 for none. ``rate`` in Hz, ``latency``: shortest and longest seconds
    from stamp to arrival.
    """

    position: Vector = (0.0, 0.0, 0.0)
    scale_error: float = 0.0
    scale_std: float = 0.01
    speed_std: float = 0.03
    speed_quantum: float = 0.0
    yaw_rate_scale_std: float = 0.01
    yaw_rate_std: float = 0.01
    rate: float = 50.0
    latency: Interval = (0.002, 0.01)

    def __post_init__(self) -> None:
        """Raise ValueError for a rate that is none."""
        check_rate("rate of the wheels", self.rate)

    def measure(self, section: Section, episodes: Sequence[Episode], seed: np.random.SeedSequence) -> WheelMeasurements:
        """Return the odometry of ``section``; of ``episodes`` those count that let wheels slip."""
        scale_stream, speed_stream, yaw_rate_stream, arrival_stream = generators(seed, 4)
        stamp = section.stamps(self.rate, _PHASE)
        motion = section.motion(stamp)
        to_body = motion.rotation_body_to_map.transpose(0, 2, 1)
        speed = rotate(to_body, motion.velocity_of(self.position))[:, 0]
        yaw_rate = motion.angular_rate_body[:, 2].copy()
        for episode in episodes:
            if isinstance(episode, WheelSlip):
                slipping = episode.covers(section.elapsed(stamp))
                speed[slipping] = episode.factor * speed[slipping] + episode.speed
                yaw_rate[slipping] *= episode.factor
        standing = (np.abs(speed) < _STANDING) & (np.abs(yaw_rate) < _STANDING)

        scale = 1.0 + self.scale_error + self.scale_std * scale_stream.standard_normal()
        yaw_rate_scale = 1.0 + self.yaw_rate_scale_std * scale_stream.standard_normal()
        speed = scale * speed + self.speed_std * speed_stream.standard_normal(len(stamp))
        yaw_rate = yaw_rate_scale * yaw_rate + self.yaw_rate_std * yaw_rate_stream.standard_normal(len(stamp))
        if self.speed_quantum:
            speed = np.round(speed / self.speed_quantum) * self.speed_quantum
        return WheelMeasurements(
            sensor=self,
            scale=scale,
            yaw_rate_scale=yaw_rate_scale,
            stamp=stamp,
            arrival=arrivals(stamp, self.latency, arrival_stream),
            speed=np.where(standing, 0.0, speed),
            yaw_rate=np.where(standing, 0.0, yaw_rate),
            speed_variance=self.speed_std**2 + self.speed_quantum**2 / 12.0,
            yaw_rate_variance=self.yaw_rate_std**2,
        )


@dataclass(frozen=True)
class WheelMeasurements:
    """Wheel odometry, one row per message: int64 ns, ``speed`` (n,) in m/s and ``yaw_rate`` (n,) in rad/s.

    ``scale`` and ``yaw_rate_scale``: the true scale factors. The variances are those of the noise alone.
    """

    sensor: WheelOdometer
    scale: float
    yaw_rate_scale: float
    stamp: Stamps
    arrival: Stamps
    speed: Array
    yaw_rate: Array
    speed_variance: float
    yaw_rate_variance: float
