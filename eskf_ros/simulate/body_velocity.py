"""A simulated sensor of the velocity over ground in body axes: DVL, optical flow, radar, visual or lidar odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.episodes import Episode
from eskf_ros.simulate.motion import Vector, rotate
from eskf_ros.simulate.sampling import Interval, Section, Stamps, arrivals, check_rate, generators

Array = NDArray[np.float64]

_PHASE = 0.0059


@dataclass(frozen=True)
class BodyVelocity:
    """A sensor of body velocity.

    ``position`` (m): where it is in base_link. ``axes``: those it measures, such as "xyz", "xy" or "x". ``std`` (m/s):
    white noise of x, y, z. ``rate`` in Hz, ``latency``: shortest and longest seconds from stamp to arrival.
    """

    position: Vector = (0.0, 0.0, 0.0)
    axes: str = "xyz"
    std: Vector = (0.05, 0.05, 0.05)
    rate: float = 10.0
    latency: Interval = (0.03, 0.06)

    def __post_init__(self) -> None:
        """Raise ValueError for a rate or axes that are none."""
        check_rate("rate of the body velocity", self.rate)
        if not self.axes or not set(self.axes) <= set("xyz"):
            raise ValueError(f"axes of the body velocity must be some of xyz, not '{self.axes}'")

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which of x, y, z are measured, (3,)."""
        return np.array([axis in self.axes for axis in "xyz"])

    def measure(
        self, section: Section, _episodes: Sequence[Episode], seed: np.random.SeedSequence
    ) -> BodyVelocityMeasurements:
        """Return the measurements in ``section``; no kind of episode concerns this sensor."""
        noise_stream, arrival_stream = generators(seed, 2)
        stamp = section.stamps(self.rate, _PHASE)
        motion = section.motion(stamp)
        velocity = rotate(motion.rotation_body_to_map.transpose(0, 2, 1), motion.velocity_of(self.position))
        velocity += noise_stream.standard_normal(velocity.shape) * np.array(self.std)
        velocity[:, ~self.measured] = 0.0
        variance = np.where(self.measured, np.array(self.std) ** 2, -1.0)
        return BodyVelocityMeasurements(self, stamp, arrivals(stamp, self.latency, arrival_stream), velocity, variance)


@dataclass(frozen=True)
class BodyVelocityMeasurements:
    """The measured ``velocity`` (n, 3) in base_link axes, m/s, one row per message (int64 ns).

    ``variance`` (3,) in m2/s2; an axis that is not measured has the velocity 0 and the variance -1.
    """

    sensor: BodyVelocity
    stamp: Stamps
    arrival: Stamps
    velocity: Array
    variance: Array
