"""When sensors measure and when their messages arrive; where their random numbers come from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum, unique
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.simulate.motion import Motion, Trajectory

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Interval = tuple[float, float]

START_STAMP = 1_748_764_800_000_000_000
"""Time zero of every scenario: 2025-06-01T08:00:00Z in ns since 1970."""


@unique
class RandomStream(IntEnum):
    """One random stream per sensor, by its number: a new sensor leaves the others' numbers as they were."""

    GYRO = 0
    ACCELEROMETER = 1
    GNSS = 2
    ARRIVAL = 3
    WHEEL = 4
    MAGNETOMETER = 5
    BAROMETER = 6
    DUAL_ANTENNA = 7
    BODY_VELOCITY = 8
    SECOND_GNSS = 9
    RANGES = 10
    VIBRATION = 11
    IMU_EPISODES = 12


@dataclass(frozen=True)
class Section:
    """The part of a trajectory that is recorded: from ``start`` to ``stop``, in seconds from its time zero."""

    path: Trajectory
    frame: MapFrame
    start: float
    stop: float

    def __post_init__(self) -> None:
        """Raise ValueError for a part that is not one."""
        if not 0.0 <= self.start < self.stop <= self.path.duration:
            raise ValueError(
                f"start {self.start:g} and stop {self.stop:g} must lie in order within 0 to {self.path.duration:.1f} s"
            )

    def stamps(self, rate: float, phase: float) -> Stamps:
        """Return the stamps of a sensor that measures ``phase`` seconds after time zero, then at ``rate`` Hz."""
        first = max(math.ceil((self.start - phase) * rate), 0)
        return START_STAMP + nanoseconds(phase + np.arange(first, math.floor((self.stop - phase) * rate) + 1) / rate)

    def elapsed(self, stamps: Stamps) -> Array:
        """Return seconds from time zero."""
        # Rounding to whole nanoseconds must not lead beyond the end.
        return np.minimum((stamps - START_STAMP) * 1e-9, self.path.duration)

    def motion(self, stamps: Stamps) -> Motion:
        """Return the truth at ``stamps``."""
        return self.path.motion(self.elapsed(stamps))


def nanoseconds(seconds: NDArray[np.floating[Any]]) -> Stamps:
    """Return seconds as whole nanoseconds."""
    return np.round(seconds * 1e9).astype(np.int64)


def arrivals(stamps: Stamps, delay: Interval, stream: np.random.Generator) -> Stamps:
    """Return stamps plus delays, uniform between the two (s), in order: what is held up holds up what comes after."""
    delays = nanoseconds(stream.uniform(delay[0], delay[1], len(stamps)))
    return np.maximum.accumulate(stamps + delays)


def seed_of(seed: int, sensor: RandomStream) -> np.random.SeedSequence:
    """Return the seed of one sensor in the recording with ``seed``."""
    return np.random.SeedSequence(entropy=seed, spawn_key=(int(sensor),))


def generators(seed: np.random.SeedSequence, count: int) -> list[np.random.Generator]:
    """Return generators that do not depend on each other, the same ones for the same seed."""
    return [np.random.Generator(np.random.PCG64(part)) for part in seed.spawn(count)]


def check_rate(name: str, value: float) -> None:
    """Raise ValueError unless ``value`` is a rate."""
    if not (value > 0.0 and math.isfinite(value)):
        raise ValueError(f"{name} must be a positive number of Hz, not {value}")
