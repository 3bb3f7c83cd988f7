"""Two independent libraries as oracles: RTKLIB (pyrtklib5) and sidereon. Tests are skipped where they are missing."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.gnss.signals import Gnss

Array = NDArray[np.float64]

GPS_TO_UNIX = 315964800
WEEK_SECONDS = 604800


def rtklib() -> ModuleType:
    return _module("pyrtklib5")


def sidereon() -> ModuleType:
    return _module("sidereon")


def _module(name: str) -> ModuleType:
    try:
        return __import__(name)
    except ImportError as missing:
        pytest.skip(f"the oracle {name} cannot be imported ({missing}): pip install {name}")


class RtklibNavigation:
    """Ephemerides as RTKLIB read them from a file."""

    def __init__(self, *paths: Path) -> None:
        self.library = rtklib()
        self.observations, self.navigation, station = (
            self.library.obs_t(),
            self.library.nav_t(),
            self.library.sta_t(),
        )
        for path in paths:
            assert self.library.readrnx(str(path), 1, "", self.observations, self.navigation, station) >= 0

    def time(self, week: int, seconds: float) -> Any:
        return self.library.gpst2time(week, seconds)

    def ephemerides(self) -> list[tuple[Gnss, int, Any]]:
        """Constellation, satellite number and RTKLIB's record of each ephemeris."""
        number = self.library.Arr1Dint(1)
        systems = {
            self.library.SYS_GPS: Gnss.GPS,
            self.library.SYS_GAL: Gnss.GALILEO,
            self.library.SYS_CMP: Gnss.BEIDOU,
            self.library.SYS_QZS: Gnss.QZSS,
            self.library.SYS_GLO: Gnss.GLONASS,
        }
        found = []
        for count, records in (
            (self.navigation.n, self.navigation.eph),
            (self.navigation.ng, self.navigation.geph),
        ):
            for index in range(count):
                system = self.library.satsys(records[index].sat, number)
                if system in systems:
                    gnss = systems[system]
                    found.append((gnss, number[0] - (192 if gnss == Gnss.QZSS else 0), records[index]))
        return found

    def state(self, gnss: Gnss, record: Any, week: int, seconds: float) -> tuple[Array, float]:
        """Position (m) and clock (s) at an instant of GPS time."""
        position, clock, variance = (self.library.Arr1Ddouble(size) for size in (3, 1, 1))
        evaluate = self.library.geph2pos if gnss == Gnss.GLONASS else self.library.eph2pos
        evaluate(self.time(week, seconds), record, position, clock, variance)
        return np.array([position[axis] for axis in range(3)]), clock[0]


def week_and_seconds(time: Any) -> tuple[int, float]:
    """GPS week and seconds of RTKLIB's time."""
    week, seconds = divmod(time.time - GPS_TO_UNIX, WEEK_SECONDS)
    return week, seconds + time.sec
