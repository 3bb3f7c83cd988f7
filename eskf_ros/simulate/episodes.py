"""What goes wrong for a while: one flat list of episodes, each with its start and length in seconds from time zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.motion import Vector


@dataclass(frozen=True)
class Outage:
    """No GNSS: a tunnel. Messages whose stamps lie in it are missing, all others are as they were."""

    start: float
    length: float


@dataclass(frozen=True)
class WheelSlip:
    """Wheels turn ``factor`` times as fast as they roll, plus ``speed`` (m/s): factor 0 is locked, above 1 spinning."""

    start: float
    length: float
    factor: float = 1.0
    speed: float = 0.0


@dataclass(frozen=True)
class MagneticDisturbance:
    """Iron or a current nearby adds ``field`` (T; axes of ``map``: east, north, up at the datum) to the Earth's."""

    start: float
    length: float
    field: Vector = (10e-6, 0.0, 0.0)


Episode = Outage | WheelSlip | MagneticDisturbance

EPISODES: dict[str, type] = {
    "outage": Outage,
    "wheel_slip": WheelSlip,
    "magnetic_disturbance": MagneticDisturbance,
}
"""The kinds of episodes as the command line names them."""


def covers(episode: Episode, elapsed: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of the times ``elapsed`` (s) lie in the episode: its start does, its end does not."""
    return (elapsed >= episode.start) & (elapsed < episode.start + episode.length)


def received(episodes: Sequence[Episode], elapsed: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of the times ``elapsed`` (s) lie in no outage."""
    missing = [covers(episode, elapsed) for episode in episodes if isinstance(episode, Outage)]
    return ~np.any([np.zeros(len(elapsed), dtype=bool), *missing], axis=0)
