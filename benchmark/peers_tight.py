"""The ranges of a recording as our filter and the tightly coupled one of sidereon (PyPI) are given them: those of GPS.

sidereon has one receiver clock and no offsets of other constellations in it, so both get the satellites of GPS alone.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.gnss.cloud import Epoch, read_epoch
from eskf_ros.gnss.ephemeris import EPHEMERIS, Broadcast, Ephemerides
from eskf_ros.gnss.ephemeris_cloud import read_ephemerides
from eskf_ros.gnss.point_solution import PointSolution
from eskf_ros.gnss.range_model import PREDICTION, predict
from eskf_ros.gnss.ranges import (
    ALREADY_TURNED,
    CLOCK_APPLIED,
    CODE_VALID,
    DOPPLER_VALID,
    SATELLITE_KNOWN,
    Status,
    locate,
    one_per_satellite,
)
from eskf_ros.gnss.rinex_nav_writer import navigation_text
from eskf_ros.gnss.signals import SPEED_OF_LIGHT, Gnss
from eskf_ros.gnss.time import SECONDS_PER_WEEK
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.parameters.tree import Parameters
from peers_sidereon import SECOND, Inputs, Run, driven, new_filter

Array = NDArray[np.float64]

J2000 = 630_763_200
"""s of GPS time at 2000-01-01 12:00."""

LEAP_SECONDS = 18
"""s; GPS time ahead of UTC since 2017."""


@dataclass(frozen=True)
class HeardEpoch:
    """Ranges of one epoch, its corrected stamp (ns), and the parameters of the ionosphere that served it."""

    stamp: int
    epoch: Epoch
    klobuchar: NDArray[np.float64]

    @property
    def seconds(self) -> float:
        """GPS time since J2000 (s), by the receiver's clock."""
        return self.epoch.week * SECONDS_PER_WEEK + self.epoch.seconds - J2000


class GpsIntake(RangeIntake):
    """Gives a navigator the ranges of GPS alone, and keeps them and the ephemerides in ``heard`` and ``broadcasts``."""

    def __init__(self, navigator: Navigator, parameters: Parameters) -> None:
        """Prepare the intake."""
        super().__init__(navigator, parameters)
        self.heard: list[HeardEpoch] = []
        self.broadcasts: list[Broadcast] = []

    def take_ephemerides(self, stamp: int, points: NDArray[Any], arrival: int = 0) -> None:
        """Keep the navigation messages of GPS, and give all of them to the navigator."""
        self.broadcasts += [found for found in read_ephemerides(points).broadcasts if found.gnss == Gnss.GPS]
        super().take_ephemerides(stamp, points, arrival)

    def take_ranges(self, stamp: int, points: NDArray[Any], arrival: int = 0) -> PointSolution | None:
        """Keep an epoch and give it to the navigator."""
        points = points[points["gnss_id"] == Gnss.GPS]
        if not len(points):
            return None
        epoch = read_epoch(points)
        corrected = stamp + self._time_offset
        _, klobuchar = self._serving(corrected, (epoch.week, epoch.seconds))
        self.heard.append(HeardEpoch(corrected, epoch, klobuchar))
        return super().take_ranges(stamp, points, arrival)


def run_tight(
    inputs: Inputs,
    intake: GpsIntake,
    rows: NDArray[Any],
    start: NDArray[Any],
    frame: MapFrame,
    parameters: Parameters,
    holds_gyro_bias: bool,
) -> Run:
    """Run the tightly coupled filter of sidereon from the row `start` of our estimate on.

    `rows`: our estimate, which is where elevations, the atmosphere and standard deviations are computed.
    """
    import sidereon

    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "gps.nav"
        path.write_text(navigation_text(intake.broadcasts, {}, LEAP_SECONDS), encoding="ascii")
        source = sidereon.load_rinex_nav(str(path))
    ephemerides = Ephemerides(np.array([broadcast.record() for broadcast in intake.broadcasts], EPHEMERIS))
    begin = int(start["stamp"])
    first = intake.heard[0]
    seconds = first.seconds + (begin - first.stamp) / SECOND
    engine = new_filter("EKF", start, frame, parameters, holds_gyro_bias, seconds)
    updates = {}
    for heard in intake.heard:
        near = min(int(np.searchsorted(rows["stamp"], heard.stamp)), len(rows) - 1)
        observed = _observations(
            sidereon, heard, ephemerides, frame.to_ecef(rows["position_map"][near][None])[0], parameters
        )
        if observed:
            at = seconds + (heard.stamp - begin) / SECOND
            updates[heard.stamp] = partial(engine.update_tight, source, sidereon.TightGnssEpoch(at, observed))
    return driven(engine, inputs, begin, seconds, updates, frame, parameters)


def _observations(
    sidereon: Any, heard: HeardEpoch, ephemerides: Ephemerides, place: Array, parameters: Parameters
) -> list[Any]:
    """The signals of an epoch above our masks, with delays and standard deviations of our models at `place` (ECEF)."""
    week, seconds, options = heard.epoch.week, heard.epoch.seconds, parameters.ranges
    ranges = heard.epoch.ranges.copy()
    locate(ranges, week, seconds, ephemerides)
    ranges = one_per_satellite(ranges, options.cn0_mask)
    predicted = np.zeros(len(ranges), PREDICTION)
    predict(ranges, tuple(place), (0.0, 0.0, 0.0), week, seconds, heard.klobuchar, DEFAULT_WEIGHTING, predicted)
    of_broadcast = ranges.copy()
    of_broadcast["flags"] &= ~(SATELLITE_KNOWN | CLOCK_APPLIED | ALREADY_TURNED)
    locate(of_broadcast, week, seconds, ephemerides)
    observed = []
    for row, model, broadcast in zip(ranges, predicted, of_broadcast, strict=True):
        both = CODE_VALID | DOPPLER_VALID
        known = np.isfinite(broadcast["satellite_clock"]) and broadcast["status"] == Status.USABLE
        if row["flags"] & both != both or not known or model["elevation"] < np.radians(options.elevation_mask_deg):
            continue
        # sidereon takes the clock of the satellite out itself.
        applied = SPEED_OF_LIGHT * float(broadcast["satellite_clock"]) if row["flags"] & CLOCK_APPLIED else 0.0
        rate = sidereon.TightRangeRateObservation(
            float(-row["doppler"] * SPEED_OF_LIGHT / row["carrier_hz"]),
            max(float(model["doppler_std"]), options.range_rate_std_floor),
            float(SPEED_OF_LIGHT * row["satellite_clock_drift"]),
        )
        observed.append(
            sidereon.TightGnssObservation(
                f"G{int(row['sv_id']):02d}",
                float(row["pseudorange"]) - applied,
                max(float(model["code_std"]), options.code_std_floor),
                range_rate=rate,
                ionosphere_delay_m=float(model["ionosphere"]),
                troposphere_delay_m=float(model["troposphere"]),
            )
        )
    return observed
