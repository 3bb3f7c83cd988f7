"""Signals as the filter takes them: what is left of an epoch when satellites, clocks and doubles are dealt with."""

from __future__ import annotations

import math

import numpy as np
import pytest
from gnss_sky import KLOBUCHAR, SECONDS, WEEK, Receiver, all_constellations, measure, receiver_at
from numpy.typing import NDArray

from eskf_ros.earth import east_north_up_to_ecef, ecef_to_geodetic
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
)
from eskf_ros.gnss.signals import GNSS_COUNT, SIGNAL_BY_CODE, SPEED_OF_LIGHT, Gnss, time_group
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING

SKY = all_constellations()
SYSTEMS = (Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.GLONASS)
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
    """The first in the list of signals, of doubles the first to come; nothing depends on the order of the others."""
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
    # Without its code the first is no better than the second; a weak one leaves the place to the other.
    ranges["cn0"][0] = 20.0
    assert measured_epoch(ranges[:2], WEEK, SECONDS, SKY)["status"].tolist() == [Status.LOW_CN0, Status.USABLE]
    locate(ranges, WEEK, SECONDS, SKY)
    ranges["flags"][2] &= ~CODE_VALID
    ranges["signal"][3] = SIGNAL_BY_CODE[Gnss.GPS, "2W"]
    measured = measured_epoch(ranges, WEEK, SECONDS, SKY)
    assert measured["status"].tolist()[2:] == [Status.OTHER_SIGNAL, Status.USABLE]


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
