"""What happens between the satellites and the antenna: signals that are blocked, reflected, or few."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.episodes import Episode

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass
class SkyView:
    """What an antenna sees of m satellites at n epochs; episodes change it.

    ``elapsed`` (n,) s; ``heading`` (n,) of the body, rad clockwise from north; ``elevation`` and ``azimuth`` (n, m) rad
    (azimuth clockwise from north). ``tracked`` (n, m): the receiver has the signal. ``reflected`` (n, m): by a
    reflection only. ``code_error`` m, ``range_rate_error`` m/s, ``cn0`` dB-Hz (n, m). ``clock_step`` (n,) s: added to
    the receiver's clock.
    """

    elapsed: Array
    heading: Array
    elevation: Array
    azimuth: Array
    tracked: Flags
    reflected: Flags
    code_error: Array
    range_rate_error: Array
    cn0: Array
    clock_step: Array

    def block(self, blocked: Flags) -> None:
        """Take satellites away."""
        self.tracked &= ~blocked
        self.reflected &= ~blocked

    def reflect(self, reflected: Flags, detour: Array, cn0_loss: float) -> None:
        """Let satellites be heard by a reflection only, with a ``detour`` (m)."""
        reflected = reflected & self.tracked
        self.reflected |= reflected
        self.code_error[reflected] += detour[reflected]
        self.cn0[reflected] -= cn0_loss


@dataclass(frozen=True)
class RangeEpisode(Episode):
    """An episode of the signals that `gnss/ranges` are measured on."""

    def apply(self, sky: SkyView, stream: np.random.Generator) -> None:
        """Change ``sky``; ``stream`` is for what is random, and drawn from as often whatever the episode's times."""
        raise NotImplementedError


CHOICES = ("random", "highest", "lowest")


@dataclass(frozen=True)
class KeepSatellites(RangeEpisode):
    """All but ``keep`` satellites are blocked: the same ones throughout, out of those in view at the start.

    ``choice``: which ones stay, random, highest or lowest, of those above ``lowest_deg`` (so that a filter's mask does
    not take them away again). One that sets in the meantime is not replaced.
    """

    keep: int = 3
    choice: str = "random"
    lowest_deg: float = 15.0

    def __post_init__(self) -> None:
        """Raise ValueError for a choice or a number that is none."""
        if self.choice not in CHOICES:
            raise ValueError(f"unknown choice of satellites '{self.choice}'; there are {', '.join(CHOICES)}")
        if self.keep < 0:
            raise ValueError(f"the number of satellites to keep is not negative: {self.keep}")

    def apply(self, sky: SkyView, stream: np.random.Generator) -> None:
        """Block the others."""
        lot = stream.random(sky.tracked.shape[1])
        inside = self.covers(sky.elapsed)
        if not inside.any():
            return
        first = int(np.argmax(inside))
        elevation = sky.elevation[first]
        rank = {"random": lot, "highest": -elevation, "lowest": elevation}[self.choice]
        possible = sky.tracked[first] & (elevation > math.radians(self.lowest_deg))
        kept = np.argsort(np.where(possible, rank, math.inf), kind="stable")[: min(self.keep, possible.sum())]
        blocked = np.zeros_like(sky.tracked)
        blocked[inside] = True
        blocked[:, kept] = False
        sky.block(blocked)


@dataclass(frozen=True)
class StreetCanyon(RangeEpisode):
    """Rows of houses on both sides of the street, which leads where the body heads.

    ``height`` (m) of the houses above the antenna, ``width`` (m) of the street, the antenna in its middle. A satellite
    at azimuth a from the street is behind a house below the elevation atan(height |sin a| / (width / 2)). Of those
    behind a house a share ``nlos`` is heard by a reflection from the other side, whose detour is width |sin a| cos(el),
    ``cn0_loss`` (dB) weaker; which ones is drawn once.
    """

    height: float = 20.0
    width: float = 20.0
    nlos: float = 0.3
    cn0_loss: float = 10.0

    def __post_init__(self) -> None:
        """Raise ValueError for a street that is none."""
        if not (self.width > 0.0 and self.height >= 0.0 and 0.0 <= self.nlos <= 1.0):
            raise ValueError(f"a street has a width, houses have a height, nlos is a share of 0 to 1: {self}")

    def apply(self, sky: SkyView, stream: np.random.Generator) -> None:
        """Block and reflect."""
        echoes = stream.random(sky.tracked.shape[1]) < self.nlos
        across = np.abs(np.sin(sky.azimuth - sky.heading[:, None]))
        behind: Flags = np.tan(sky.elevation) < self.height * across / (0.5 * self.width)
        behind = behind & self.covers(sky.elapsed)[:, None]
        sky.block(behind & np.logical_not(echoes))
        sky.reflect(behind & echoes, self.width * across * np.cos(sky.elevation), self.cn0_loss)


@dataclass(frozen=True)
class Reflections(RangeEpisode):
    """``count`` satellites in view at the start are heard by a reflection: ``detour`` (m) longer, ``cn0_loss`` weaker.

    Their range rates are off by ``range_rate`` (m/s, standard deviation from satellite to satellite).
    """

    count: int = 3
    detour: float = 25.0
    range_rate: float = 0.3
    cn0_loss: float = 8.0

    def apply(self, sky: SkyView, stream: np.random.Generator) -> None:
        """Add the errors."""
        lot, rates = stream.random(sky.tracked.shape[1]), stream.standard_normal(sky.tracked.shape[1])
        inside = self.covers(sky.elapsed)
        if not inside.any():
            return
        first = int(np.argmax(inside))
        chosen = np.argsort(np.where(sky.tracked[first], lot, math.inf), kind="stable")[: max(0, self.count)]
        reflected = np.zeros_like(sky.tracked)
        reflected[np.ix_(inside, chosen)] = True
        sky.reflect(reflected, np.full(sky.tracked.shape, self.detour), self.cn0_loss)
        sky.range_rate_error += np.where(reflected, self.range_rate * rates, 0.0)


@dataclass(frozen=True)
class ClockStep(RangeEpisode):
    """The receiver's clock is ``step`` (s) ahead meanwhile: a reset at the start, another one at the end."""

    step: float = 1e-3

    def apply(self, sky: SkyView, stream: np.random.Generator) -> None:
        """Add the step."""
        sky.clock_step[self.covers(sky.elapsed)] += self.step


RANGE_EPISODES = {
    "satellites": KeepSatellites,
    "street_canyon": StreetCanyon,
    "reflections": Reflections,
    "clock_step": ClockStep,
}
"""The kinds of episodes as the command line names them."""
