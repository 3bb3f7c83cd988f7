"""What goes wrong with an IMU: its driver, its stamps, its sensors, the way it is mounted.

An episode changes samples and nothing else; the truth stays. Those that come back do so within their length: ``every``
seconds, from the start on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.simulate.episodes import ClockSet, Episode
from eskf_ros.simulate.motion import Vector, mounting
from eskf_ros.simulate.sampling import Stamps, nanoseconds

Array = NDArray[np.float64]

AXES = "xyz"


@dataclass
class ImuSamples:
    """What an IMU is going to give at n samples; episodes change it.

    ``elapsed`` (n,): when a sample is taken, s from time zero. ``stamp`` (n,) int64 ns: what its message says.
    ``specific_force`` and ``angular_rate`` (n, 3) in m/s2 and rad/s, IMU axes. ``kept`` (n,): its message is sent.
    """

    elapsed: Array
    stamp: Stamps
    specific_force: Array
    angular_rate: Array
    kept: NDArray[np.bool_]

    @classmethod
    def of(cls, elapsed: Array, stamp: Stamps, specific_force: Array, angular_rate: Array) -> ImuSamples:
        """Return samples that are all sent; the readings are changed in place, the stamps are not."""
        return cls(elapsed, stamp.copy(), specific_force, angular_rate, np.ones(len(stamp), bool))


@dataclass(frozen=True)
class ImuEpisode(Episode):
    """An episode of the IMU."""

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Change ``samples``; ``stream`` is for what is random."""
        raise NotImplementedError


IMU_CHANGES = (ImuEpisode, ClockSet)
"""The kinds of episodes that change samples."""


def change_samples(samples: ImuSamples, episode: Episode, stream: np.random.Generator) -> None:
    """Change ``samples`` by an episode of the IMU or of the clock; one of anything else leaves them as they are."""
    if isinstance(episode, ImuEpisode):
        episode.change(samples, stream)
    elif isinstance(episode, ClockSet):
        samples.stamp += episode.shifts(samples.elapsed)


def returns(episode: Episode, elapsed: Array, every: float, length: float) -> Iterator[tuple[int, int]]:
    """Return (first, behind the last) sample of what begins ``every`` s in an episode and lasts ``length`` s."""
    last = min(episode.start + episode.length, float(elapsed[-1]) + 1.0) if len(elapsed) else episode.start
    for begin in np.arange(episode.start, last, every):
        first, behind = np.searchsorted(elapsed, (begin, begin + length))
        if behind > first:
            yield int(first), int(behind)


@dataclass(frozen=True)
class ImuHoles(ImuEpisode):
    """For ``hole`` seconds, ``every`` seconds, the driver has no samples.

    ``filled``: "no" (they are missing), "lines" (from the last sample before to the first behind) or "repeats" (the
    last one again and again).
    """

    hole: float = 1.6
    every: float = 10.0
    filled: str = "no"

    def __post_init__(self) -> None:
        """Raise ValueError for a filling that is none, and for holes without an end."""
        if self.filled not in ("no", "lines", "repeats"):
            raise ValueError(f"holes of an IMU are filled by no, lines or repeats, not '{self.filled}'")
        if not 0.0 < self.hole < self.every:
            raise ValueError(f"a hole of {self.hole:g} s every {self.every:g} s is none, or has no end")

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Make the holes."""
        for first, behind in returns(self, samples.elapsed, self.every, self.hole):
            if self.filled == "no":
                samples.kept[first:behind] = False
                continue
            before, after = max(first - 1, 0), min(behind, len(samples.elapsed) - 1)
            share = (np.arange(first, behind) - before)[:, None] / (after - before)
            for readings in (samples.specific_force, samples.angular_rate):
                way = readings[after] - readings[before] if self.filled == "lines" else 0.0
                readings[first:behind] = readings[before] + share * way


@dataclass(frozen=True)
class ImuJitter(ImuEpisode):
    """Stamps scatter by ``std`` (s) and are late by an exponential time of mean ``lateness`` (s), but stay in order."""

    std: float = 0.001
    lateness: float = 0.0

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Move the stamps."""
        count = len(samples.stamp)
        error = self.std * stream.standard_normal(count) + self.lateness * stream.standard_exponential(count)
        inside = self.covers(samples.elapsed)
        samples.stamp[inside] += nanoseconds(error[inside])
        # Ordered, and a nanosecond apart where they were not.
        steps = np.arange(count)
        samples.stamp[:] = np.maximum.accumulate(samples.stamp - steps) + steps


@dataclass(frozen=True)
class ImuBursts(ImuEpisode):
    """Samples are handed over ``count`` at a time, stamped with the time of the last one, ``spacing`` (s) apart.

    Without spacing they share one stamp.
    """

    count: int = 4
    spacing: float = 1e-6

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Move the stamps."""
        number = np.arange(len(samples.stamp))
        last = np.minimum(number // self.count * self.count + self.count - 1, len(samples.stamp) - 1)
        inside = self.covers(samples.elapsed) & self.covers(samples.elapsed[last])
        moved = samples.stamp[last] - nanoseconds((last - number) * self.spacing)
        samples.stamp[inside] = moved[inside]


@dataclass(frozen=True)
class ImuBias(ImuEpisode):
    """The biases change by ``gyro_deg`` (deg/s) and ``accel`` (m/s2), in IMU axes, within the first ``rise`` seconds.

    They change back at the end. ``rise`` 0 is a step.
    """

    gyro_deg: Vector = (0.0, 0.0, 1.0)
    accel: Vector = (0.0, 0.0, 0.0)
    rise: float = 0.0

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Add the biases."""
        inside = self.covers(samples.elapsed)
        since = (samples.elapsed[inside] - self.start)[:, None]
        share = np.minimum(since / self.rise, 1.0) if self.rise > 0.0 else np.ones_like(since)
        samples.angular_rate[inside] += share * np.radians(self.gyro_deg)
        samples.specific_force[inside] += share * np.array(self.accel)


@dataclass(frozen=True)
class ImuDeformation(ImuEpisode):
    """What a calibration would take out.

    ``gyro_scale``, ``accel_scale``: factors less one. ``gyro_rpy_deg``: the axes of the gyro, turned against those of
    the accelerometer (deg). ``g_sensitivity``: rate (deg/s) per g of specific force, in each axis.
    """

    gyro_scale: float = 0.0
    accel_scale: float = 0.0
    gyro_rpy_deg: Vector = (0.0, 0.0, 0.0)
    g_sensitivity: float = 0.0

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Deform the readings."""
        inside = self.covers(samples.elapsed)
        rate, force = samples.angular_rate[inside], samples.specific_force[inside]
        rate = (1.0 + self.gyro_scale) * rate @ mounting(self.gyro_rpy_deg)
        samples.angular_rate[inside] = rate + math.radians(self.g_sensitivity) / STANDARD_GRAVITY * force
        samples.specific_force[inside] = (1.0 + self.accel_scale) * force


@dataclass(frozen=True)
class ImuClipping(ImuEpisode):
    """Readings end at ``rate`` (rad/s) and ``force`` (m/s2), either sign."""

    rate: float = math.inf
    force: float = math.inf

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Clip the readings."""
        inside = self.covers(samples.elapsed)
        samples.angular_rate[inside] = np.clip(samples.angular_rate[inside], -self.rate, self.rate)
        samples.specific_force[inside] = np.clip(samples.specific_force[inside], -self.force, self.force)


@dataclass(frozen=True)
class ImuShocks(ImuEpisode):
    """Blows of ``rate`` (rad/s) and ``force`` (m/s2) for ``blow`` seconds, ``every`` seconds, in random directions.

    The body does not move by them: a pulse of the readings, which the sensor's resonance makes of a short blow.
    """

    rate: float = 8.0
    force: float = 100.0
    blow: float = 0.1
    every: float = 10.0

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Add the blows."""
        for first, behind in returns(self, samples.elapsed, self.every, self.blow):
            direction = stream.standard_normal(3)
            direction /= np.linalg.norm(direction)
            samples.specific_force[first:behind] += self.force * direction
            samples.angular_rate[first:behind] += self.rate * direction


@dataclass(frozen=True)
class ImuVibration(ImuEpisode):
    """An engine: sines of amplitude ``rate`` (rad/s), ``force`` (m/s2) and ``frequency`` (Hz), each axis its phase."""

    rate: float = 0.05
    force: float = 1.0
    frequency: float = 23.0

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Add the sines."""
        inside = self.covers(samples.elapsed)
        phase = stream.random(6)
        wave = np.sin(2.0 * math.pi * (self.frequency * samples.elapsed[inside, None] + phase))
        samples.specific_force[inside] += self.force * wave[:, :3]
        samples.angular_rate[inside] += self.rate * wave[:, 3:]


@dataclass(frozen=True)
class ImuNoise(ImuEpisode):
    """White noise of these densities on top: ``rate`` in rad/s/rtHz, ``force`` in m/s2/rtHz."""

    rate: float = 5.0e-4
    force: float = 6.0e-3

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Add the noise."""
        inside = self.covers(samples.elapsed)
        bandwidth = 1.0 / np.median(np.diff(samples.elapsed)) if len(samples.elapsed) > 1 else 0.0
        for readings, density in ((samples.angular_rate, self.rate), (samples.specific_force, self.force)):
            readings[inside] += density * math.sqrt(bandwidth) * stream.standard_normal(readings.shape)[inside]


@dataclass(frozen=True)
class ImuStuck(ImuEpisode):
    """One axis of one sensor repeats what it read at the start: ``sensor`` gyro or accel, ``axis`` x, y or z."""

    sensor: str = "gyro"
    axis: str = "z"

    def __post_init__(self) -> None:
        """Raise ValueError for a sensor or an axis that is none."""
        if self.sensor not in ("gyro", "accel") or self.axis not in tuple(AXES):
            raise ValueError(f"stuck is axis x, y or z of gyro or accel, not {self.axis} of {self.sensor}")

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Repeat the first reading."""
        inside = self.covers(samples.elapsed)
        readings = samples.angular_rate if self.sensor == "gyro" else samples.specific_force
        axis = AXES.index(self.axis)
        readings[inside, axis] = readings[inside, axis][:1]


@dataclass(frozen=True)
class ImuAxes(ImuEpisode):
    """The driver gives other axes: ``gyro`` and ``accel`` say which of its own, with sign, stand for x, y and z.

    "+x+y+z" is right, "+x-y-z" an IMU upside down, "+y+x+z" has two of them swapped.
    """

    gyro: str = "+x+y+z"
    accel: str = "+x+y+z"

    def __post_init__(self) -> None:
        """Raise ValueError for axes that are none."""
        for text in (self.gyro, self.accel):
            if len(text) != 6 or set(text[::2]) - {"+", "-"} or set(text[1::2]) - set(AXES):
                raise ValueError(f"axes are three of x, y and z with their signs, like +x-y-z, not '{text}'")

    def change(self, samples: ImuSamples, stream: np.random.Generator) -> None:
        """Exchange the axes."""
        inside = self.covers(samples.elapsed)
        for text, readings in ((self.gyro, samples.angular_rate), (self.accel, samples.specific_force)):
            signs = np.array([1.0 if sign == "+" else -1.0 for sign in text[::2]])
            readings[inside] = signs * readings[inside][:, [AXES.index(axis) for axis in text[1::2]]]


IMU_EPISODES = {
    "imu_holes": ImuHoles,
    "imu_jitter": ImuJitter,
    "imu_bursts": ImuBursts,
    "imu_bias": ImuBias,
    "imu_deformation": ImuDeformation,
    "imu_clipping": ImuClipping,
    "imu_shocks": ImuShocks,
    "imu_vibration": ImuVibration,
    "imu_noise": ImuNoise,
    "imu_stuck": ImuStuck,
    "imu_axes": ImuAxes,
}
"""The kinds of episodes as the command line names them."""
