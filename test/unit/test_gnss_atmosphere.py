"""Ionosphere, troposphere, weights: against RTKLIB, limits, and what nature does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eskf_ros.gnss import atmosphere
from eskf_ros.gnss.signals import L1, L2, Gnss
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING, Weighting, code_std, doppler_std
from support.gnss_oracle import rtklib

KLOBUCHAR = np.array([1.77e-8, 2.235e-8, -1.192e-7, -5.96e-8, 1.27e5, 1.475e5, -1.966e5, -1.966e5])
WEEK = 2323


def places(count: int, seed: int) -> np.ndarray:
    """Latitude, longitude, altitude, azimuth, elevation, seconds of week."""
    rng = np.random.default_rng(seed)
    low = (-1.5, -3.14, -100.0, 0.0, 0.06, 0.0)
    high = (1.5, 3.14, 9000.0, 6.28, 1.57, 604800.0)
    return rng.uniform(low, high, (count, 6))


def test_klobuchar_is_rtklibs() -> None:
    library = rtklib()
    parameters, position, direction = (library.Arr1Ddouble(size) for size in (8, 3, 2))
    for index, value in enumerate(KLOBUCHAR):
        parameters[index] = value
    for latitude, longitude, altitude, azimuth, elevation, seconds in places(500, 1):
        position[0], position[1], position[2] = latitude, longitude, altitude
        direction[0], direction[1] = azimuth, elevation
        expected = library.ionmodel(library.gpst2time(WEEK, seconds), parameters, position, direction)
        ours = atmosphere.klobuchar(KLOBUCHAR, seconds, latitude, longitude, elevation, azimuth)
        assert ours == pytest.approx(expected, abs=1e-10)


def test_klobuchar_between_night_and_the_early_afternoon() -> None:
    night, noon = (atmosphere.klobuchar(KLOBUCHAR, hour * 3600.0, 0.6, 0.0, 1.5, 0.0) for hour in (2.0, 14.0))
    # Five nanoseconds by night.
    assert night == pytest.approx(5e-9 * 299792458.0, rel=0.02)
    assert noon > 3.0 * night
    low = atmosphere.klobuchar(KLOBUCHAR, 2 * 3600.0, 0.6, 0.0, 0.1, 0.0)
    assert low == pytest.approx(night * (1.0 + 16.0 * (0.53 - 0.1 / math.pi) ** 3), rel=0.02)
    assert math.isnan(atmosphere.klobuchar(np.full(8, math.nan), 0.0, 0.6, 0.0, 1.0, 0.0))
    assert atmosphere.ionosphere_scale(L2) == pytest.approx((77 / 60) ** 2)
    assert atmosphere.ionosphere_scale(L1) == 1.0


def test_niell_is_rtklibs() -> None:
    """Ours takes the season from the week, RTKLIB from the calendar: a day apart at most."""
    library = rtklib()
    position, direction, wet = (library.Arr1Ddouble(size) for size in (3, 2, 1))
    for latitude, longitude, altitude, azimuth, elevation, seconds in places(500, 2):
        position[0], position[1], position[2] = latitude, longitude, altitude
        direction[0], direction[1] = azimuth, elevation
        for week in (2000, WEEK):
            dry = library.tropmapf(library.gpst2time(week, seconds), position, direction, wet)
            ours = atmosphere.niell(week, seconds, latitude, altitude, elevation)
            # The lowest elevation here is 3.4 deg, ours stops at 3.
            assert ours[0] == pytest.approx(dry, rel=5e-5)
            assert ours[1] == pytest.approx(wet[0], rel=1e-12)


def test_zenith_delays_are_those_of_satellite_based_augmentation() -> None:
    library = rtklib()
    position, zenith, variance = (library.Arr1Ddouble(size) for size in (3, 2, 1))
    zenith[1] = 0.5 * math.pi
    for latitude, _, altitude, _, _, seconds in places(300, 3):
        altitude = abs(altitude)
        position[0], position[1], position[2] = latitude, 0.0, altitude
        # RTKLIB's half-year of the south is 183 days from 28 January, ours half a year: 0.4 days apart.
        expected = library.sbstropcorr(library.gpst2time(WEEK, seconds), position, zenith, variance)
        assert sum(atmosphere.zenith_delays(WEEK, seconds, latitude, altitude)) == pytest.approx(expected, abs=2e-3)


def test_summer_is_wetter_than_winter_on_both_hemispheres() -> None:
    for latitude, summer, winter in ((0.6, 2324, 2350), (-0.6, 2350, 2324)):
        dry, wet = atmosphere.zenith_delays(summer, 0.0, latitude, 100.0)
        cold_dry, cold_wet = atmosphere.zenith_delays(winter, 0.0, latitude, 100.0)
        assert wet > 1.8 * cold_wet
        assert dry == pytest.approx(cold_dry, rel=0.01)
        assert dry == pytest.approx(2.28, abs=0.03)


@given(
    st.floats(-math.pi / 2, math.pi / 2),
    st.floats(-1e4, 1e7),
    st.floats(-math.pi / 2, math.pi / 2),
    st.integers(0, 5000),
)
def test_troposphere_is_finite_and_positive_everywhere(
    latitude: float, altitude: float, elevation: float, week: int
) -> None:
    delay = atmosphere.troposphere(week, 1e5, latitude, altitude, elevation)
    assert 0.0 < delay < 60.0
    assert atmosphere.troposphere(week, 1e5, latitude, min(altitude, 1e4) + 1e3, elevation) < delay + 1e-9 or (
        altitude > 9e3
    )


def test_troposphere_at_the_zenith_is_the_zenith_delay() -> None:
    dry, wet = atmosphere.zenith_delays(WEEK, 0.0, 0.6, 100.0)
    assert atmosphere.troposphere(WEEK, 0.0, 0.6, 100.0, 0.5 * math.pi) == pytest.approx(dry + wet, rel=1e-12)
    # Two and a half metres at the zenith are near fourteen at 10 deg.
    low = atmosphere.troposphere(WEEK, 0.0, 0.6, 100.0, math.radians(10.0))
    assert low == pytest.approx(5.6 * (dry + wet), rel=0.02)


def std(elevation_deg: float = 90.0, cn0: float = 45.0, ionosphere: float = 0.0, **which: float) -> float:
    return code_std(
        DEFAULT_WEIGHTING,
        int(which.get("gnss", Gnss.GPS)),
        int(which.get("sv", 7)),
        math.radians(elevation_deg),
        cn0,
        ionosphere,
        which.get("factor", 1.0),
    )


def test_weights_are_the_documented_ones() -> None:
    assert std() == pytest.approx(math.hypot(0.8, 1.5 * 10 ** (-5 / 20)))
    assert std(30.0, 40.0, 6.0) == pytest.approx(math.sqrt(1.6**2 + 1.5**2 + 3.0**2))
    assert std(30.0, 40.0, 6.0, factor=3.0) == pytest.approx(math.sqrt(9.0 * (1.6**2 + 1.5**2) + 3.0**2))
    assert std(gnss=Gnss.GLONASS) == pytest.approx(1.5 * std())
    assert std(gnss=Gnss.BEIDOU, sv=3) == std(gnss=Gnss.BEIDOU, sv=60) == pytest.approx(1.5 * std())
    assert std(gnss=Gnss.BEIDOU, sv=21) == std(gnss=Gnss.GPS, sv=3) == std()
    assert std(cn0=math.nan) == std(cn0=35.0)
    assert doppler_std(DEFAULT_WEIGHTING, 40.0) == pytest.approx(math.hypot(0.04, 0.065))
    assert doppler_std(DEFAULT_WEIGHTING, 25.0) == pytest.approx(math.hypot(0.04, 0.65))
    assert doppler_std(Weighting(unknown_cn0=40.0), math.nan) == doppler_std(DEFAULT_WEIGHTING, 40.0)
    # Below the horizon, where a satellite seems to be while the position is far off, weights stay finite.
    assert 1.0 < std(-20.0) < 20.0
