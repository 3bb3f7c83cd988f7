"""Measured signals of an epoch for a filter: all corrections that do not depend on the receiver are applied.

    pseudorange + c satellite clock = range      + c receiver clock + ionosphere + troposphere
    range rate  + c satellite drift = range rate + c receiver drift

The left sides are ``pseudorange`` and ``range_rate`` of a MEASURED_SIGNAL, the right sides are predicted by the filter:
`predict_measured` gives them (without the receiver clock) with line of sight and standard deviations.

Three things depend on the position of the receiver: the rotation of the Earth during the flight of the signal, the
elevation, and the standard deviation by model. `measure` settles them if it is given a position, for which 100 m are
accurate enough; `predict_measured` computes them for any position. A filter whose result must not depend on the order
of arrival calls `measure` without a position when a message comes, and `predict_measured` when it is applied.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.compiled import njit
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.geometry import distance, turned, turned_at_arrival
from eskf_ros.gnss.range_model import NO_KLOBUCHAR, PREDICTION, sight
from eskf_ros.gnss.ranges import (
    ALREADY_TURNED,
    CODE_VALID,
    DEFAULT_CN0_MASK,
    DOPPLER_VALID,
    Status,
    choose_per_satellite,
    leave_out_weak,
    locate_one,
)
from eskf_ros.gnss.signals import GNSS_COUNT, SPEED_OF_LIGHT, time_group
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING, Weighting

MEASURED_SIGNAL = np.dtype(
    [
        ("gnss_id", "i4"),
        ("sv_id", "i4"),
        ("signal", "i4"),
        ("system", "i4"),
        ("status", "i4"),
        ("flags", "i4"),
        ("pseudorange", "f8"),
        ("range_rate", "f8"),
        ("code_std", "f8"),
        ("range_rate_std", "f8"),
        ("satellite", "f8", (3,)),
        ("satellite_velocity", "f8", (3,)),
        ("carrier_hz", "f8"),
        ("cn0", "f8"),
        ("noise_factor", "f8"),
        ("elevation", "f8"),
        ("azimuth", "f8"),
    ],
    align=True,
)
"""One signal as the filter takes it; there are no gaps between the fields, so equal content means equal bytes.

- ``gnss_id``, ``sv_id``: u-blox constellation and satellite number.
- ``signal``: index into `signals.SIGNALS` (255 unknown).
- ``system``: `signals.time_group`, 0 to 7, the satellites that share an offset in the receiver clock.
- ``status``: `ranges.Status`; anything but USABLE (0) says why the signal must not be used.
- ``flags``: bits of `ranges`. Of a usable signal `CODE_VALID` says that ``pseudorange`` is valid, `DOPPLER_VALID` that
  ``range_rate`` is (at least one is), `IONOSPHERE_APPLIED` and `TROPOSPHERE_APPLIED` that the delay has been taken out,
  `ALREADY_TURNED` that ``satellite`` and ``satellite_velocity`` are in the ECEF frame of reception.
- ``pseudorange``: m, satellite clock with relativity and group delay taken out.
- ``range_rate``: m/s, -doppler c / carrier, satellite drift taken out; positive if the satellite recedes.
- ``code_std`` m, ``range_rate_std`` m/s: those of the receiver, else by model if the position was known, else NaN.
- ``satellite`` m, ``satellite_velocity`` m/s: ECEF at transmission.
- ``carrier_hz`` (NaN unknown: then no Doppler), ``cn0`` dB-Hz (NaN unknown).
- ``noise_factor``: of a combination of signals, 1 for a plain one.
- ``elevation``, ``azimuth``: rad, NaN if the position was not known.
"""

UNKNOWN_POSITION = (math.nan, math.nan, math.nan)


class Masks(NamedTuple):
    """Signals to leave out: elevation below (rad), C/N0 below (dB-Hz; an unknown one passes).

    ``one_per_satellite``: keep one code and one Doppler of each satellite, see `ranges.choose_per_satellite`.
    """

    elevation: float = math.radians(10.0)
    cn0: float = DEFAULT_CN0_MASK
    one_per_satellite: bool = True


DEFAULT_MASKS = Masks()


def measured_epoch(
    ranges: NDArray[np.void],
    week: int,
    seconds: float,
    ephemerides: Ephemerides,
    receiver: tuple[float, float, float] = UNKNOWN_POSITION,
    klobuchar: NDArray[np.float64] = NO_KLOBUCHAR,
    weighting: Weighting = DEFAULT_WEIGHTING,
    masks: Masks = DEFAULT_MASKS,
) -> NDArray[np.void]:
    """Return the signals (MEASURED_SIGNAL, one for each range in the same order) of one epoch.

    ``ranges``: RANGE as `cloud.read_epoch` or `rinex_obs.Observations.ranges` give them, not changed. ``week``,
    ``seconds``: GPS time tag of the epoch by the receiver's clock. ``receiver``: ECEF of the antenna to 100 m, or
    unknown. ``klobuchar``: eight parameters, for the standard deviations only.
    """
    measured = np.zeros(len(ranges), MEASURED_SIGNAL)
    measure(
        ranges.copy(),
        week,
        seconds,
        receiver,
        ephemerides.records,
        ephemerides.first,
        klobuchar,
        weighting,
        masks,
        measured,
    )
    return measured


@njit
def measure(ranges, week, seconds, receiver, records, first, ionosphere, weighting, masks, measured):
    """Do the work of `measured_epoch` for the arrays of an `Ephemerides`; return how many signals are usable.

    ``ranges`` (RANGE) are located on the way, as by `ranges.locate`; one that was refused before (its status is neither
    USABLE nor NOT_LOCATED) stays refused. ``receiver``: tuple of three, NaN for unknown. The result goes to
    ``measured``.
    """
    known = not math.isnan(receiver[0] + receiver[1] + receiver[2])
    for k in range(len(ranges)):
        observed = ranges[k]
        if observed["status"] == Status.NOT_LOCATED or observed["status"] == Status.USABLE:
            locate_one(observed, week, seconds, records, first)
        clear(observed, measured[k])
    if known:
        at_receiver(measured, receiver, week, seconds, ionosphere, weighting)
    return choose_signals(measured, masks)


@njit
def clear(observed, signal):
    """Fill a MEASURED_SIGNAL from a located RANGE with all that does not depend on the receiver's position."""
    signal["gnss_id"], signal["sv_id"], signal["signal"] = observed["gnss_id"], observed["sv_id"], observed["signal"]
    # It is used as an index into tables, even if the signal is not usable.
    known = 0 <= observed["gnss_id"] < GNSS_COUNT
    signal["system"] = time_group(observed["gnss_id"], observed["sv_id"]) if known else 0
    signal["carrier_hz"], signal["cn0"] = observed["carrier_hz"], observed["cn0"]
    signal["noise_factor"] = observed["noise_factor"]
    wavelength = SPEED_OF_LIGHT / observed["carrier_hz"]
    signal["pseudorange"] = observed["pseudorange"] + SPEED_OF_LIGHT * observed["satellite_clock"]
    signal["range_rate"] = SPEED_OF_LIGHT * observed["satellite_clock_drift"] - observed["doppler"] * wavelength
    signal["code_std"] = observed["pseudorange_std"]
    signal["range_rate_std"] = observed["doppler_std"] * wavelength
    for axis in range(3):
        signal["satellite"][axis] = observed["satellite"][axis]
        signal["satellite_velocity"][axis] = observed["satellite_velocity"][axis]
    signal["elevation"], signal["azimuth"] = math.nan, math.nan
    flags = observed["flags"]
    if not math.isfinite(signal["pseudorange"]):
        flags &= ~CODE_VALID
    if not math.isfinite(signal["range_rate"]):
        flags &= ~DOPPLER_VALID
    signal["flags"] = flags
    signal["status"] = observed["status"]
    if signal["status"] == Status.USABLE and not flags & (CODE_VALID | DOPPLER_VALID):
        signal["status"] = Status.BAD_VALUE


@njit
def at_receiver(measured, receiver, week, seconds, ionosphere, weighting):
    """Add what depends on the receiver's position (tuple, ECEF, m): satellites turned, elevation, model deviations."""
    latitude, longitude, altitude = ecef_to_geodetic(receiver[0], receiver[1], receiver[2])
    local_to_ecef = east_north_up_to_ecef(latitude, longitude)
    prediction = np.zeros(1, PREDICTION)[0]
    for k in range(len(measured)):
        signal = measured[k]
        if signal["status"] != Status.USABLE:
            continue
        if not signal["flags"] & ALREADY_TURNED:
            turn(signal, receiver)
        predict_measured(
            signal,
            receiver,
            (0.0, 0.0, 0.0),
            latitude,
            longitude,
            altitude,
            local_to_ecef,
            week,
            seconds,
            ionosphere,
            weighting,
            prediction,
        )
        signal["code_std"], signal["range_rate_std"] = prediction["code_std"], prediction["doppler_std"]
        signal["elevation"], signal["azimuth"] = prediction["elevation"], prediction["azimuth"]


@njit
def turn(signal, receiver):
    """Bring the satellite of a MEASURED_SIGNAL into the ECEF frame of its arrival at ``receiver`` (tuple, m)."""
    satellite, velocity = signal["satellite"], signal["satellite_velocity"]
    arrived = turned_at_arrival((satellite[0], satellite[1], satellite[2]), receiver)
    light_time = distance(arrived, receiver) / SPEED_OF_LIGHT
    moving = turned((velocity[0], velocity[1], velocity[2]), light_time)
    for axis in range(3):
        satellite[axis] = arrived[axis]
        velocity[axis] = moving[axis]
    signal["flags"] |= ALREADY_TURNED


@njit
def choose_signals(measured, masks):
    """Set the status of signals that the masks or `ranges.choose_per_satellite` leave out; return how many remain.

    The elevation mask applies to signals with a known elevation.
    """
    leave_out_weak(measured, masks.cn0)
    for k in range(len(measured)):
        if measured[k]["status"] == Status.USABLE and measured[k]["elevation"] < masks.elevation:
            measured[k]["status"] = Status.LOW_ELEVATION
    return choose_per_satellite(measured, masks.one_per_satellite)


@njit
def predict_measured(
    signal,
    position,
    velocity,
    latitude,
    longitude,
    altitude,
    local_to_ecef,
    week,
    seconds,
    ionosphere,
    weighting,
    prediction,
):
    """Write the PREDICTION of a usable MEASURED_SIGNAL for an antenna at ``position`` with ``velocity`` (ECEF, tuples).

    As `range_model.predict_one`: latitude, longitude (rad), altitude (m) and the local axes are those of ``position``;
    ``week``, ``seconds`` are GPS time to a minute. ``pseudorange`` and ``range_rate`` of the prediction lack the clock
    of the receiver only.
    """
    sight(
        signal,
        signal["code_std"],
        signal["range_rate_std"],
        position,
        velocity,
        latitude,
        longitude,
        altitude,
        local_to_ecef,
        week,
        seconds,
        ionosphere,
        weighting,
        prediction,
    )
    prediction["code_residual"] = signal["pseudorange"] - prediction["pseudorange"]
    prediction["doppler_residual"] = signal["range_rate"] - prediction["range_rate"]
