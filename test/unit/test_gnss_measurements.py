"""Signals as the filter takes them: what is left of an epoch when satellites, clocks and doubles are dealt with."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.measurements import (
    DEFAULT_MASKS,
    UNKNOWN_POSITION,
    Masks,
    measured_epoch,
    predict_measured,
)
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
from eskf_ros.gnss.signals import GNSS_COUNT, SIGNAL_BY_CODE, SIGNAL_CARRIER_HZ, SPEED_OF_LIGHT, Gnss, time_group
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING
from support.gnss_sky import KLOBUCHAR, SECONDS, WEEK, Receiver, all_constellations, measure, receiver_at

SKY = all_constellations()
SYSTEMS = (Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.GLONASS)
LOWER = {Gnss.GPS: "2L", Gnss.GALILEO: "7Q", Gnss.BEIDOU: "7I", Gnss.GLONASS: "2C"}
EVERYTHING = Masks(elevation=-math.pi, cn0=0.0, one_per_satellite=False)


def moving_receiver() -> Receiver:
    """A receiver whose clock is a third of a millisecond off."""
    receiver = receiver_at(48.1, 11.6, 565.0, clock_bias=1e5, clock_drift=64.0)
    receiver.offset = np.linspace(-20.0, 30.0, GNSS_COUNT)
    return receiver


def raw_epoch(receiver: Receiver) -> NDArray[np.void]:
    """Ranges as a receiver puts them out: no satellites."""
    ranges = measure(receiver, SKY, SYSTEMS)
    ranges["flags"] = CODE_VALID | DOPPLER_VALID
    ranges["status"] = Status.NOT_LOCATED
    for name in ("satellite", "satellite_velocity", "satellite_clock", "satellite_clock_drift"):
        ranges[name] = math.nan
    return ranges


def gives(measured: NDArray[np.void]) -> list[int]:
    """What signals say that they give."""
    return (measured["flags"] & (CODE_VALID | DOPPLER_VALID)).tolist()


def two_bands(receiver: Receiver) -> NDArray[np.void]:
    """Ranges of a receiver that delays the lower band by 8 m, of each satellite the lower band first."""
    upper = raw_epoch(receiver)
    lower = upper.copy()
    lower["signal"] = [SIGNAL_BY_CODE[Gnss(gnss), LOWER[Gnss(gnss)]] for gnss in upper["gnss_id"]]
    ratio = SIGNAL_CARRIER_HZ[lower["signal"]] / SIGNAL_CARRIER_HZ[upper["signal"]]
    lower["pseudorange"] += 8.0
    lower["doppler"] *= ratio
    lower["carrier_hz"] = math.nan
    # What their ephemerides do not tell of GLONASS.
    lower = lower[lower["gnss_id"] != Gnss.GLONASS]
    return np.concatenate([lower, upper])


def predicted(measured: NDArray[np.void], receiver: Receiver) -> NDArray[np.void]:
    position, velocity = tuple(receiver.position.tolist()), tuple(receiver.velocity.tolist())
    geodetic = ecef_to_geodetic(*position)
    axes = east_north_up_to_ecef(*geodetic[:2])
    predictions = np.zeros(len(measured), PREDICTION)
    for signal, prediction in zip(measured, predictions):
        predict_measured(
            signal,
            position,
            velocity,
            *geodetic,
            axes,
            WEEK,
            SECONDS,
            KLOBUCHAR,
            DEFAULT_WEIGHTING,
            prediction,
        )
    return predictions


@pytest.mark.parametrize("told", [False, True])
def test_what_is_left_is_the_clock_of_the_receiver(told: bool) -> None:
    """Told a position 50 m off or none at all, only bias, drift and the offset of the constellation remain."""
    receiver = moving_receiver()
    position = tuple((receiver.position + [30.0, -40.0, 0.0]).tolist()) if told else UNKNOWN_POSITION
    measured = measured_epoch(raw_epoch(receiver), WEEK, SECONDS, SKY, position, KLOBUCHAR)
    assert len(measured) > 25
    assert (measured["status"] == Status.USABLE).all()
    assert set(measured["system"]) == {0, 2, 3, 4, 6}
    residuals = predicted(measured, receiver)
    np.testing.assert_allclose(
        residuals["code_residual"], receiver.clock_bias + receiver.offset[measured["system"]], atol=2e-3
    )
    np.testing.assert_allclose(residuals["doppler_residual"], receiver.clock_drift, atol=1e-6)
    assert (measured["flags"] & ALREADY_TURNED != 0).all() == told
    assert np.isnan(measured["elevation"]).all() != told


def test_agrees_with_the_prediction_of_plain_ranges() -> None:
    """One model: what `predict` says of a range, `predict_measured` says of the signal made of it."""
    receiver = moving_receiver()
    ranges = raw_epoch(receiver)
    measured = measured_epoch(ranges, WEEK, SECONDS, SKY)
    residuals = predicted(measured, receiver)
    locate(ranges, WEEK, SECONDS, SKY)
    expected = np.zeros(len(ranges), PREDICTION)
    place, motion = tuple(receiver.position.tolist()), tuple(receiver.velocity.tolist())
    predict(ranges, place, motion, WEEK, SECONDS, KLOBUCHAR, DEFAULT_WEIGHTING, expected)
    for name in ("line_of_sight", "elevation", "azimuth", "ionosphere", "troposphere", "code_std", "doppler_std"):
        np.testing.assert_array_equal(residuals[name], expected[name])
    for name in ("code_residual", "doppler_residual"):
        np.testing.assert_allclose(residuals[name], expected[name], atol=1e-7)


def test_deviations_by_model_and_by_the_receiver() -> None:
    receiver = moving_receiver()
    ranges = raw_epoch(receiver)
    ranges["pseudorange_std"][0], ranges["doppler_std"][0] = 2.5, 0.5
    measured = measured_epoch(ranges, WEEK, SECONDS, SKY, tuple(receiver.position.tolist()), KLOBUCHAR)
    assert measured["code_std"][0] == 2.5
    assert measured["range_rate_std"][0] == pytest.approx(0.5 * SPEED_OF_LIGHT / measured["carrier_hz"][0])
    expected = predicted(measured_epoch(ranges, WEEK, SECONDS, SKY), receiver)
    np.testing.assert_allclose(measured["code_std"], expected["code_std"], rtol=1e-9)
    np.testing.assert_allclose(measured["range_rate_std"], expected["doppler_std"], rtol=1e-9)
    without = measured_epoch(ranges, WEEK, SECONDS, SKY)
    assert np.isfinite(without["code_std"]).tolist() == [True] + [False] * (len(ranges) - 1)


def test_a_sender_may_correct_the_satellite_clock_himself() -> None:
    """Flag 8: with our own orbit, or with the sender's, the clock is not taken out twice."""
    receiver = moving_receiver()
    ranges = raw_epoch(receiver)
    plain = measured_epoch(ranges, WEEK, SECONDS, SKY)
    located = ranges.copy()
    locate(located, WEEK, SECONDS, SKY)
    for corrected in (ranges.copy(), located.copy()):
        corrected["pseudorange"] += SPEED_OF_LIGHT * located["satellite_clock"]
        corrected["flags"] |= CLOCK_APPLIED
        corrected["status"] = Status.NOT_LOCATED
        measured = measured_epoch(corrected, WEEK, SECONDS, SKY)
        np.testing.assert_allclose(measured["pseudorange"], plain["pseudorange"], atol=1e-6)
        np.testing.assert_allclose(measured["satellite"], plain["satellite"], atol=2e-3)
        np.testing.assert_allclose(measured["range_rate"], plain["range_rate"], atol=1e-6)


def test_satellites_of_the_sender_need_no_ephemeris() -> None:
    receiver = moving_receiver()
    ranges = raw_epoch(receiver)
    plain = measured_epoch(ranges, WEEK, SECONDS, SKY)
    locate(ranges, WEEK, SECONDS, SKY)
    assert (ranges["flags"] & SATELLITE_KNOWN != 0).all()
    assert measured_epoch(ranges, WEEK, SECONDS, Ephemerides()).tobytes() == plain.tobytes()
    # Without a velocity the code is still good.
    ranges["satellite_velocity"][0] = math.nan
    measured = measured_epoch(ranges, WEEK, SECONDS, Ephemerides())
    assert measured["status"][0] == Status.USABLE
    assert measured["flags"][0] == CODE_VALID | SATELLITE_KNOWN
    assert measured["pseudorange"][0] == plain["pseudorange"][0]


def test_of_several_signals_of_a_satellite_one_is_used() -> None:
    """The first of the upper band, of doubles the first to come; nothing depends on the order of the others."""
    receiver = moving_receiver()
    ranges = raw_epoch(receiver)[[0, 0, 1, 1]]
    assert (ranges["gnss_id"] == Gnss.GPS).all()
    ranges["signal"][1] = SIGNAL_BY_CODE[Gnss.GPS, "2W"]
    ranges["pseudorange"][3] += 100.0
    expected = [Status.USABLE, Status.OTHER_SIGNAL, Status.USABLE, Status.DUPLICATE]
    assert measured_epoch(ranges, WEEK, SECONDS, SKY)["status"].tolist() == expected
    assert measured_epoch(ranges[[1, 0]], WEEK, SECONDS, SKY)["status"].tolist() == expected[1::-1]
    both = measured_epoch(ranges, WEEK, SECONDS, SKY, masks=DEFAULT_MASKS._replace(one_per_satellite=False))
    assert both["status"].tolist() == [Status.USABLE] * 3 + [Status.DUPLICATE]
    assert gives(both[:3]) == [CODE_VALID | DOPPLER_VALID, DOPPLER_VALID, CODE_VALID | DOPPLER_VALID]
    # Of the upper band any signal serves.
    ranges["signal"][1] = SIGNAL_BY_CODE[Gnss.GPS, "1W"]
    locate(ranges, WEEK, SECONDS, SKY)
    ranges["flags"][0] &= ~CODE_VALID
    measured = measured_epoch(ranges[:2], WEEK, SECONDS, SKY)
    assert measured["status"].tolist() == [Status.OTHER_SIGNAL, Status.USABLE]
    assert gives(measured[1:]) == [CODE_VALID | DOPPLER_VALID]


def test_a_satellite_keeps_its_meaning_when_its_upper_band_drops() -> None:
    """No code of another band takes the place, in tight coupling nor in loose; the Doppler of the satellite stays."""
    receiver = moving_receiver()
    ranges = two_bands(receiver)
    upper = SIGNAL_CARRIER_HZ[ranges["signal"]] > 1.5e9
    whole = measured_epoch(ranges, WEEK, SECONDS, SKY)
    assert ((whole["status"] == Status.USABLE) == upper).all()
    assert (whole["status"][~upper] == Status.OTHER_SIGNAL).all()
    for k in np.flatnonzero(upper):
        dropped = ranges.copy()
        dropped["cn0"][k] = 27.9
        tight = measured_epoch(dropped, WEEK, SECONDS, SKY)
        others = upper & (np.arange(len(ranges)) != k)
        assert tight[others].tobytes() == whole[others].tobytes()
        used = np.flatnonzero((tight["status"] == Status.USABLE) & ~others)
        same = (ranges["gnss_id"] == ranges["gnss_id"][k]) & (ranges["sv_id"] == ranges["sv_id"][k]) & ~upper
        assert used.tolist() == np.flatnonzero(same).tolist()
        assert gives(tight[used]) == [DOPPLER_VALID] * len(used)
        # The two bands are transmitted 8 m apart: less than 0.1 mm/s.
        np.testing.assert_allclose(tight["range_rate"][used], whole["range_rate"][k], atol=1e-4)
        locate(dropped, WEEK, SECONDS, SKY)
        assert couplings_agree(one_per_satellite(dropped), tight)


def couplings_agree(loose: NDArray[np.void], tight: NDArray[np.void]) -> bool:
    tight = tight[tight["status"] == Status.USABLE]
    names = ["gnss_id", "sv_id", "signal", "flags"]
    return sorted(loose[names].tolist()) == sorted(tight[names].tolist())


def located_two_bands() -> NDArray[np.void]:
    ranges = two_bands(moving_receiver())
    ranges = ranges[ranges["sv_id"] % 4 == 0]
    locate(ranges, WEEK, SECONDS, SKY)
    return ranges


LOCATED_TWO_BANDS = located_two_bands()


@given(st.data())
def test_each_satellite_gives_at_most_one_code_and_one_doppler(data: st.DataObject) -> None:
    """Whatever is weak or missing: a code is of the upper band, a Doppler is there where any signal had one."""
    ranges = LOCATED_TWO_BANDS.copy()
    flags = st.sampled_from([0, CODE_VALID, DOPPLER_VALID, CODE_VALID | DOPPLER_VALID])
    weak = st.sampled_from([20.0, 45.0, math.nan])
    ranges["flags"] = SATELLITE_KNOWN | np.array(data.draw(st.lists(flags, min_size=len(ranges), max_size=len(ranges))))
    ranges["cn0"] = data.draw(st.lists(weak, min_size=len(ranges), max_size=len(ranges)))
    order = data.draw(st.permutations(range(len(ranges))))
    ranges = ranges[order]
    tight = measured_epoch(ranges, WEEK, SECONDS, SKY)
    used = tight[tight["status"] == Status.USABLE]
    strong = ranges[~(ranges["cn0"] < 28.0)]
    for flag in (CODE_VALID, DOPPLER_VALID):
        counts = strong["flags"] & flag != 0
        if flag == CODE_VALID:
            counts &= SIGNAL_CARRIER_HZ[strong["signal"]] > 1.5e9
        expected = {(row["gnss_id"], row["sv_id"]) for row in strong[counts]}
        found = [(row["gnss_id"], row["sv_id"]) for row in used[used["flags"] & flag != 0]]
        assert sorted(found) == sorted(expected)
    assert (SIGNAL_CARRIER_HZ[used["signal"][used["flags"] & CODE_VALID != 0]] > 1.5e9).all()
    assert couplings_agree(one_per_satellite(ranges), tight)


def test_a_receiver_without_the_upper_band_gives_doppler_only() -> None:
    """And where it has none the reason is named."""
    ranges = two_bands(moving_receiver())
    ranges = ranges[SIGNAL_CARRIER_HZ[ranges["signal"]] < 1.5e9]
    ranges["doppler"][0] = math.nan
    measured = measured_epoch(ranges, WEEK, SECONDS, SKY)
    assert measured["status"].tolist() == [Status.OTHER_BAND] + [Status.USABLE] * (len(ranges) - 1)
    assert gives(measured[1:]) == [DOPPLER_VALID] * (len(ranges) - 1)


def test_every_signal_that_is_left_out_has_its_reason() -> None:
    receiver = moving_receiver()
    position = tuple(receiver.position.tolist())
    ranges = raw_epoch(receiver)[:8]
    ranges["pseudorange"][0] = math.nan
    ranges["sv_id"][1] = 99
    ranges["signal"][2] = 255
    ranges["status"][3] = Status.WRONG_TIME
    ranges["cn0"][4] = 12.0
    ranges["cn0"][5], ranges["doppler"][5] = math.nan, math.nan
    measured = measured_epoch(ranges, WEEK, SECONDS, SKY, position, masks=Masks(elevation=0.0))
    assert [Status(value).name for value in measured["status"]] == [
        "BAD_VALUE",
        "NO_EPHEMERIS",
        "UNKNOWN_SIGNAL",
        "WRONG_TIME",
        "LOW_CN0",
        "USABLE",
        "USABLE",
        "USABLE",
    ]
    assert measured["flags"][5] & (CODE_VALID | DOPPLER_VALID) == CODE_VALID
    low = measured_epoch(ranges, WEEK, SECONDS, SKY, position, masks=Masks(elevation=math.radians(89.0)))
    assert (low["status"][5:] == Status.LOW_ELEVATION).all()
    assert (measured_epoch(ranges, WEEK + 1, SECONDS, SKY)["status"][5:] == Status.WRONG_WEEK).all()
    assert (measured_epoch(ranges, WEEK, SECONDS + 40000.0, SKY)["status"][5:] == Status.STALE).all()


def test_systems_are_those_of_the_clock_offsets() -> None:
    receiver = moving_receiver()
    measured = measured_epoch(raw_epoch(receiver), WEEK, SECONDS, SKY, masks=EVERYTHING)
    for signal in measured:
        assert signal["system"] == time_group(int(signal["gnss_id"]), int(signal["sv_id"]))
