"""What goes wrong between a GNSS receiver and whoever reads its messages: contents, axes and stamps."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.episodes import ClockSet, Episode
from eskf_ros.simulate.sampling import START_STAMP, Stamps

if TYPE_CHECKING:
    from eskf_ros.simulate.gnss import GnssMeasurements

_SECOND = 1_000_000_000


@dataclass(frozen=True)
class GnssMessageEpisode(Episode):
    """An episode of the messages of one ``receiver``, 1 or 2, or of both: 0."""

    receiver: int = field(default=0, kw_only=True)

    def changed(self, said: GnssMeasurements, stream: np.random.Generator) -> GnssMeasurements:
        """Return other messages; ``stream`` is for what is random, and drawn from as often whatever the times."""
        raise NotImplementedError

    def covers_stamps(self, stamps: Stamps) -> NDArray[np.bool_]:
        """Return which of ``stamps`` (ns) lie in the episode."""
        return self.covers(_elapsed(stamps))


def _elapsed(stamps: Stamps) -> NDArray[np.float64]:
    """Return seconds from time zero."""
    return np.asarray((stamps - START_STAMP) * 1e-9, np.float64)


def changed_messages(said: GnssMeasurements, episode: Episode, stream: np.random.Generator) -> GnssMeasurements:
    """Return messages changed by an episode of messages or of the clock; one of anything else leaves them."""
    if isinstance(episode, GnssMessageEpisode):
        return episode.changed(said, stream)
    if isinstance(episode, ClockSet):
        return dataclasses.replace(
            said,
            fix_stamp=said.fix_stamp + episode.shifts(_elapsed(said.fix_stamp)),
            velocity_stamp=said.velocity_stamp + episode.shifts(_elapsed(said.velocity_stamp)),
        )
    return said


def _with_fixes_of(said: GnssMeasurements, source: NDArray[np.int64]) -> GnssMeasurements:
    """Return messages whose i-th fix has the coordinates of fix ``source`` [i]."""
    names = ("fix_latitude_deg", "fix_longitude_deg", "fix_altitude")
    return dataclasses.replace(said, **{name: getattr(said, name)[source] for name in names})


@dataclass(frozen=True)
class FrozenFixes(GnssMessageEpisode):
    """The coordinates of the first fix come again and again, with fresh stamps."""

    def changed(self, said: GnssMeasurements, stream: np.random.Generator) -> GnssMeasurements:
        """Return the messages with these coordinates."""
        inside = self.covers_stamps(said.fix_stamp)
        number = np.arange(len(inside))
        return _with_fixes_of(said, np.where(inside, int(np.argmax(inside)), number))


@dataclass(frozen=True)
class RepeatedFixes(GnssMessageEpisode):
    """Each position, and each velocity, comes ``times`` times, with fresh stamps: the receiver is slower than that."""

    times: int = 5

    def __post_init__(self) -> None:
        """Raise ValueError for no repetition at all."""
        if self.times < 1:
            raise ValueError(f"a fix comes at least once, not {self.times} times")

    def changed(self, said: GnssMeasurements, stream: np.random.Generator) -> GnssMeasurements:
        """Return the messages with repetitions."""
        number = np.arange(len(said.fix_stamp))
        said = _with_fixes_of(
            said, np.where(self.covers_stamps(said.fix_stamp), number // self.times * self.times, number)
        )
        number = np.arange(len(said.velocity_stamp))
        source = np.where(self.covers_stamps(said.velocity_stamp), number // self.times * self.times, number)
        return dataclasses.replace(said, velocity_enu=said.velocity_enu[source])


@dataclass(frozen=True)
class UnfilledFixes(GnssMessageEpisode):
    """Fixes are (0, 0, 0) though their status says that they are fixes."""

    def changed(self, said: GnssMeasurements, stream: np.random.Generator) -> GnssMeasurements:
        """Return the messages with these fixes."""
        filled = np.where(self.covers_stamps(said.fix_stamp), 0.0, 1.0)
        names = ("fix_latitude_deg", "fix_longitude_deg", "fix_altitude")
        return dataclasses.replace(said, **{name: filled * getattr(said, name) for name in names})


@dataclass(frozen=True)
class MissingAltitude(GnssMessageEpisode):
    """A ``share`` of the fixes, drawn at random, has no altitude: it is not a number."""

    share: float = 1.0

    def changed(self, said: GnssMeasurements, stream: np.random.Generator) -> GnssMeasurements:
        """Return the messages without these altitudes."""
        lacks = stream.random(len(said.fix_stamp)) < self.share
        lacks &= self.covers_stamps(said.fix_stamp)
        return dataclasses.replace(said, fix_altitude=np.where(lacks, np.nan, said.fix_altitude))


@dataclass(frozen=True)
class WholeSeconds(GnssMessageEpisode):
    """Stamps are cut to whole seconds, so that several messages share one."""

    def changed(self, said: GnssMeasurements, stream: np.random.Generator) -> GnssMeasurements:
        """Return the messages with such stamps."""
        stamps = {
            name: np.where(self.covers_stamps(stamp), stamp // _SECOND * _SECOND, stamp)
            for name, stamp in (("fix_stamp", said.fix_stamp), ("velocity_stamp", said.velocity_stamp))
        }
        return dataclasses.replace(said, **stamps)


@dataclass(frozen=True)
class GnssDelay(GnssMessageEpisode):
    """Positions and velocities are stamped ``position`` and ``velocity`` seconds late: below zero early.

    They arrive when they did. Stamps from a clock that is ahead are late ones.
    """

    position: float = 0.25
    velocity: float = 0.25

    def changed(self, said: GnssMeasurements, stream: np.random.Generator) -> GnssMeasurements:
        """Return the messages with such stamps."""
        changes = {}
        for name, late in (("fix", self.position), ("velocity", self.velocity)):
            stamp = getattr(said, f"{name}_stamp")
            changes[f"{name}_stamp"] = stamp + np.where(self.covers_stamps(stamp), round(late * _SECOND), 0)
        return dataclasses.replace(said, **changes)


@dataclass(frozen=True)
class VelocityInNed(GnssMessageEpisode):
    """The velocity is north, east, down where east, north, up is expected."""

    def changed(self, said: GnssMeasurements, stream: np.random.Generator) -> GnssMeasurements:
        """Return the messages with these velocities."""
        inside = self.covers_stamps(said.velocity_stamp)[:, None]
        in_ned = said.velocity_enu[:, [1, 0, 2]] * (1.0, 1.0, -1.0)
        return dataclasses.replace(said, velocity_enu=np.where(inside, in_ned, said.velocity_enu))


GNSS_MESSAGE_EPISODES = {
    "frozen_fixes": FrozenFixes,
    "repeated_fixes": RepeatedFixes,
    "unfilled_fixes": UnfilledFixes,
    "missing_altitude": MissingAltitude,
    "whole_seconds": WholeSeconds,
    "gnss_delay": GnssDelay,
    "velocity_in_ned": VelocityInNed,
}
"""The kinds of episodes as the command line names them."""
