"""What becomes of messages of ranges and ephemerides on their way into the navigator, and what is said of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.layout import Stream
from eskf_ros.filter.navigator import Navigator
from eskf_ros.gnss.cloud import write_epoch
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, SATELLITE_KNOWN, allocate_ranges
from eskf_ros.parameters import from_mapping
from eskf_ros.ranges.intake import RangeIntake

SECOND = 1_000_000_000
STAMP = 1_700_000_000_123_456_789
ANTENNA = np.array([6.378e6, 0.0, 0.0])
WEEK, TOW = 2300, 1000.0


def intake_of(**given: Any) -> RangeIntake:
    navigator = Navigator(from_mapping({name.replace("__", "."): value for name, value in given.items()}))
    return RangeIntake(navigator, navigator.parameters)


def records_of(intake: RangeIntake) -> NDArray[Any]:
    return intake._navigator.finish()


def epoch(count: int = 8, known: bool = True) -> NDArray[Any]:
    """Points of an epoch of GPS satellites all around an antenna at rest, with their states if ``known``."""
    ranges = allocate_ranges(count)
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    up = np.where(np.arange(count) % 2, 0.5, 1.5)
    ranges["sv_id"], ranges["signal"] = np.arange(1, count + 1), 0
    ranges["satellite"] = ANTENNA + 2e7 * np.stack([up, np.cos(turn), np.sin(turn)], axis=1)
    ranges["pseudorange"] = np.linalg.norm(ranges["satellite"] - ANTENNA, axis=1)
    for name in ("satellite_velocity", "satellite_clock", "satellite_clock_drift", "doppler"):
        ranges[name] = 0.0
    ranges["flags"] = CODE_VALID | DOPPLER_VALID | SATELLITE_KNOWN * known
    return write_epoch(ranges, WEEK, TOW, satellites=known)


def test_a_point_solution_gets_the_time_offset_of_the_ranges_and_no_other() -> None:
    offsets = {"ranges__time_offset": 0.25, "gnss__time_offset": -0.4, "second_gnss__time_offset": 3.0}
    intake = intake_of(ranges__use_point_solution=True, **offsets)
    intake.take_ranges(STAMP, epoch())
    records = records_of(intake)
    assert sorted(records["stream"]) == [Stream.GNSS_POSITION, Stream.GNSS_VELOCITY]
    assert records["stamp"].tolist() == [STAMP + SECOND // 4] * 2
