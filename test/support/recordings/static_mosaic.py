"""static_mosaic: a Septentrio mosaic-X5 at rest at a known place, all systems and bands, 301 s at solar maximum."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.earth import east_north_up_to_ecef, geodetic_to_ecef
from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.point_solution import PointSolution, SolutionStatus, solve
from eskf_ros.gnss.ranges import locate
from eskf_ros.gnss.rinex_nav import read_navigation
from eskf_ros.gnss.rinex_obs import read_observations
from eskf_ros.gnss.signals import Gnss

Pick = Callable[[NDArray[np.void]], NDArray[np.void]]


class StaticReceiver:
    """The recording and its truth: `position` (3,) in ECEF (m), `enu` (3, 3) the local axes there as rows."""

    def __init__(self, folder: Path) -> None:
        navigation = read_navigation(folder / "base.nav")
        self.ephemerides = Ephemerides(navigation.ephemerides)
        self.klobuchar = navigation.klobuchar[Gnss.GPS]
        self.observations = read_observations(folder / "rover.obs")
        latitude, longitude, altitude = map(float, (folder / "rover_position_llh.txt").read_text().split())
        self.position = np.array(geodetic_to_ecef(math.radians(latitude), math.radians(longitude), altitude))
        self.enu = np.array(east_north_up_to_ecef(math.radians(latitude), math.radians(longitude)))

    def solutions(self, systems: Sequence[Gnss], pick: Pick, step: int = 10) -> list[PointSolution]:
        """Point solutions of every `step`-th epoch, of the ranges of `systems` that `pick` leaves."""
        found = []
        for index in range(0, len(self.observations.epochs), step):
            epoch = self.observations.epochs[index]
            ranges = self.observations.ranges(index)
            ranges = ranges[np.isin(ranges["gnss_id"], systems)]
            instant = int(epoch["week"]), float(epoch["seconds"])
            locate(ranges, *instant, self.ephemerides)
            found.append(solve(pick(ranges), *instant, self.klobuchar))
            assert found[-1].status == found[-1].velocity_status == SolutionStatus.SOLVED
        return found

    def error(self, solutions: Sequence[PointSolution]) -> float:
        """3D rms, m."""
        return rms(np.array([solution.position_ecef - self.position for solution in solutions]))


def rms(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def medium_earth_orbit(ranges: NDArray[np.void]) -> NDArray[np.bool_]:
    """BeiDou's inclined and geostationary satellites have their own metre of delays."""
    beidou_3_meo = (ranges["sv_id"] >= 19) & (ranges["sv_id"] <= 37)
    return (ranges["gnss_id"] != Gnss.BEIDOU) | beidou_3_meo
