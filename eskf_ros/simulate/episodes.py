"""What goes wrong for a while: a flat list of episodes in any combination, applied in their order.

Those that change what a GNSS receiver says are in `eskf_ros.simulate.gnss_episodes` and `gnss_message_episodes`, those
of the IMU in `eskf_ros.simulate.imu_episodes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.motion import Vector


@dataclass(frozen=True)
class Episode:
    """From ``start`` for ``length`` seconds, counted from time zero of the scenario; infinity is for good."""

    start: float
    length: float

    def covers(self, elapsed: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which of the times ``elapsed`` (s) lie in the episode: its start does, its end does not."""
        return (elapsed >= self.start) & (elapsed < self.start + self.length)


@dataclass(frozen=True)
class Outage(Episode):
    """No GNSS: a tunnel. Messages whose stamps lie in it are missing, all others are as they were.

    ``receiver``: 1 or 2 takes the satellites from this one only, 0 from all. A dual antenna needs both.
    """

    receiver: int = field(default=0, kw_only=True)


@dataclass(frozen=True)
class ClockSet(Episode):
    """The clock that stamps IMU and GNSS is set ahead by ``step`` (s; below zero back), and set right at the end.

    Messages are recorded in the order in which they came, by a clock that was left alone.
    """

    step: float = -0.5

    def shifts(self, elapsed: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return what is added (ns) to stamps of the times ``elapsed`` (s)."""
        return np.where(self.covers(elapsed), round(self.step * 1e9), 0).astype(np.int64)


@dataclass(frozen=True)
class WheelSlip(Episode):
    """Wheels turn ``factor`` times as fast as they roll, plus ``speed`` (m/s): factor 0 is locked, above 1 spinning."""

    factor: float = 1.0
    speed: float = 0.0


@dataclass(frozen=True)
class MagneticDisturbance(Episode):
    """Iron or a current nearby adds ``field`` (T; axes of ``map``: east, north, up at the datum) to the Earth's."""

    field: Vector = (10e-6, 0.0, 0.0)


def outages_of(episodes: Sequence[Episode], receivers: Sequence[int]) -> list[Outage]:
    """Return the outages among ``episodes`` that concern one of ``receivers``."""
    return [gap for gap in episodes if isinstance(gap, Outage) and gap.receiver in (0, *receivers)]


def received(episodes: Sequence[Episode], receivers: Sequence[int], elapsed: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return at which of the times ``elapsed`` (s) none of ``receivers`` has an outage."""
    missing = np.zeros(len(elapsed), dtype=bool)
    for gap in outages_of(episodes, receivers):
        missing |= gap.covers(elapsed)
    return ~missing
