"""What goes wrong with a GNSS receiver: errors that its covariance does not tell of, and covariances that lie."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from eskf_ros.simulate.episodes import Episode
from eskf_ros.simulate.motion import Vector

Array = NDArray[np.float64]
Std = tuple[float, float]

COVARIANCE_UNKNOWN = 0
COVARIANCE_DIAGONAL_KNOWN = 2

RTK_SOLUTIONS: dict[str, tuple[int, Std]] = {
    "single": (0, (1.5, 2.5)),
    "float": (1, (0.3, 0.5)),
    "fixed": (2, (0.01, 0.02)),
}
"""Status in NavSatFix and (horizontal, vertical) standard deviation of position in m, by solution."""


def axis_stds(horizontal_vertical: Std) -> Array:
    """Return the standard deviations east, north, up (3,) of a horizontal and a vertical one."""
    return np.array([horizontal_vertical[0], horizontal_vertical[0], horizontal_vertical[1]])


@dataclass
class GnssReport:
    """What a receiver is going to say at n epochs; episodes change it.

    ``elapsed`` (n,) in s, at equal intervals; all else (n, 3) in east, north, up, in m and m/s: errors beside the white
    ones, the standard deviations of the white ones, and those that are reported. ``status`` and ``covariance_type``
    (n,) as in NavSatFix.
    """

    elapsed: Array
    position_offset: Array
    velocity_offset: Array
    position_std: Array
    velocity_std: Array
    reported_position_std: Array
    reported_velocity_std: Array
    status: NDArray[np.int8]
    covariance_type: NDArray[np.uint8]

    @classmethod
    def faultless(cls, elapsed: Array, position_std: Std, velocity_std: Std) -> GnssReport:
        """Return the report of a receiver whose errors are white and as it says."""
        count = len(elapsed)

        def stds(horizontal_vertical: Std) -> Array:
            return np.tile(axis_stds(horizontal_vertical), (count, 1))

        return cls(
            elapsed=elapsed,
            position_offset=np.zeros((count, 3)),
            velocity_offset=np.zeros((count, 3)),
            position_std=stds(position_std),
            velocity_std=stds(velocity_std),
            reported_position_std=stds(position_std),
            reported_velocity_std=stds(velocity_std),
            status=np.zeros(count, np.int8),
            covariance_type=np.full(count, COVARIANCE_DIAGONAL_KNOWN, np.uint8),
        )


@dataclass(frozen=True)
class GnssEpisode(Episode):
    """An episode of one ``receiver``, 1 or 2, or of both: 0."""

    receiver: int = field(default=0, kw_only=True)

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Change ``report``; ``stream`` is for what is random, and drawn from as often whatever the episode's times."""
        raise NotImplementedError


@dataclass(frozen=True)
class Multipath(GnssEpisode):
    """The position steps aside by ``offset`` (m; east, north, up) and back at the end."""

    offset: Vector = (8.0, -5.0, 4.0)

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Add the offset."""
        report.position_offset[self.covers(report.elapsed)] += self.offset


@dataclass(frozen=True)
class BadFixes(GnssEpisode):
    """The first fixes after an outage: off by ``offset`` (m; east, north, up), of which 5 % are left at the end."""

    offset: Vector = (30.0, -20.0, 15.0)

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Add the decaying offset."""
        inside = self.covers(report.elapsed)
        since = (report.elapsed[inside] - self.start) / self.length
        report.position_offset[inside] += 0.05 ** since[:, None] * np.array(self.offset)


@dataclass(frozen=True)
class Spoofing(GnssEpisode):
    """False signals draw the position away with ``velocity`` (m/s; east, north, up), true ones return at the end.

    The velocity sets in with ``acceleration`` (m/s2). With ``consistent`` the velocity that is reported is false by as
    much, else it stays true.
    """

    velocity: Vector = (1.5, 0.0, 0.0)
    acceleration: float = 0.1
    consistent: bool = True

    def __post_init__(self) -> None:
        """Raise ValueError for an acceleration that never leads to the velocity."""
        if not 0.0 < self.acceleration < math.inf:
            raise ValueError(f"the acceleration of spoofing must be a positive number of m/s2, not {self.acceleration}")

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Add the ramp."""
        inside = self.covers(report.elapsed)
        final = np.array(self.velocity)
        onset = float(np.linalg.norm(final)) / self.acceleration
        since = (report.elapsed[inside] - self.start)[:, None]
        accelerating = np.minimum(since, onset)
        share = accelerating / onset if onset else np.zeros_like(since)
        report.position_offset[inside] += final * (0.5 * share * accelerating + since - accelerating)
        if self.consistent:
            report.velocity_offset[inside] += final * share


@dataclass(frozen=True)
class CorrelatedErrors(GnssEpisode):
    """Errors of position that change slowly: first-order Gauss-Markov processes, one per axis.

    ``position_std``: (horizontal, vertical) standard deviation in m; ``correlation_time`` in s. The covariance that is
    reported holds them, but it cannot say that they are the same from fix to fix.
    """

    position_std: Std = (1.0, 1.5)
    correlation_time: float = 60.0

    def __post_init__(self) -> None:
        """Raise ValueError for a correlation time that is none."""
        if not self.correlation_time > 0.0:
            raise ValueError(f"the correlation time must be a positive number of s, not {self.correlation_time}")

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Add the errors; they are stationary from the first epoch on."""
        white = stream.standard_normal(report.position_offset.shape)
        interval = report.elapsed[1] - report.elapsed[0] if len(report.elapsed) > 1 else 0.0
        remains = math.exp(-interval / self.correlation_time)
        white[1:] *= math.sqrt(1.0 - remains * remains)
        stds = axis_stds(self.position_std)
        inside = self.covers(report.elapsed)
        report.position_offset[inside] += (lfilter([1.0], [1.0, -remains], white, axis=0) * stds)[inside]
        report.reported_position_std[inside] = np.hypot(report.reported_position_std[inside], stds)


@dataclass(frozen=True)
class RtkSolution(GnssEpisode):
    """The receiver has a ``solution``, single, float or fixed, with the status and the errors of `RTK_SOLUTIONS`."""

    solution: str = "fixed"

    def __post_init__(self) -> None:
        """Raise ValueError for a solution that is none."""
        if self.solution not in RTK_SOLUTIONS:
            raise ValueError(f"unknown RTK solution '{self.solution}'; there are {', '.join(RTK_SOLUTIONS)}")

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Set status and standard deviations."""
        inside = self.covers(report.elapsed)
        status, stds = RTK_SOLUTIONS[self.solution]
        report.status[inside] = status
        report.position_std[inside] = report.reported_position_std[inside] = axis_stds(stds)


@dataclass(frozen=True)
class Overconfidence(GnssEpisode):
    """The receiver says that it is ``factor`` times as good as it is, in position and velocity."""

    factor: float = 10.0

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Divide the standard deviations that are reported."""
        inside = self.covers(report.elapsed)
        report.reported_position_std[inside] /= self.factor
        report.reported_velocity_std[inside] /= self.factor


@dataclass(frozen=True)
class ClaimedStd(GnssEpisode):
    """The receiver reports ``position_std`` (horizontal, vertical; m) whatever its errors are."""

    position_std: Std = (0.003, 0.003)

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Set the standard deviation that is reported."""
        report.reported_position_std[self.covers(report.elapsed)] = axis_stds(self.position_std)


@dataclass(frozen=True)
class ZeroCovariance(GnssEpisode):
    """The receiver leaves its covariances zero and their type unknown."""

    def apply(self, report: GnssReport, stream: np.random.Generator) -> None:
        """Set them."""
        inside = self.covers(report.elapsed)
        report.reported_position_std[inside] = report.reported_velocity_std[inside] = 0.0
        report.covariance_type[inside] = COVARIANCE_UNKNOWN
