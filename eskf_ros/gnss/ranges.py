"""Observed ranges of one epoch: the measurements of a receiver, and the satellite of each.

A RANGE is one point of the topic `gnss/ranges`, or one signal of a RINEX file. `locate` completes it with the state of
the satellite from the ephemerides; `status` says why a range cannot be used.

Over 400 lines: the way of one signal from observation to satellite, which no other file needs in parts.
"""

from __future__ import annotations

import math
from collections import Counter
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from eskf_ros.compiled import njit
from eskf_ros.gnss.ephemeris import NO_ISSUE, SATELLITE_KEYS, Ephemerides
from eskf_ros.gnss.orbits import satellite_state, transmission
from eskf_ros.gnss.signals import (
    GNSS_COUNT,
    IS_CONSTELLATION,
    L1,
    SIGNAL_CARRIER_HZ,
    SIGNAL_GNSS,
    SIGNAL_SLOT,
    SIGNALS,
    SPEED_OF_LIGHT,
    UNKNOWN_SIGNAL,
    Gnss,
    carrier_hz,
    is_upper_band,
)
from eskf_ros.gnss.time import SECONDS_PER_WEEK, elapsed


class Status(IntEnum):
    """Why a range is not used (a closed list).

    ``NOT_LOCATED``: not examined yet. ``DUPLICATE``: the same satellite and signal came before in the same epoch.
    ``OTHER_SIGNAL``: another signal of the satellite is used. ``WRONG_TIME``: its time tag is not that of its epoch.
    ``WRONG_WEEK``: an ephemeris would fit if the week were another. ``TOO_MANY``: beyond the largest number of signals
    of an epoch. ``OTHER_BAND``: a code of another band than L1 without Doppler, and nothing else of the satellite is
    used.
    """

    USABLE = 0
    UNKNOWN_SIGNAL = 1
    BAD_VALUE = 2
    NO_EPHEMERIS = 3
    STALE = 4
    UNHEALTHY = 5
    NO_GROUP_DELAY = 6
    BAD_EPHEMERIS = 7
    NOT_LOCATED = 8
    LOW_ELEVATION = 9
    LOW_CN0 = 10
    OUTLIER = 11
    DUPLICATE = 12
    OTHER_SIGNAL = 13
    WRONG_TIME = 14
    WRONG_WEEK = 15
    TOO_MANY = 16
    OTHER_BAND = 17


CODE_VALID = 1
DOPPLER_VALID = 2
SATELLITE_KNOWN = 4
CLOCK_APPLIED = 8
IONOSPHERE_APPLIED = 16
TROPOSPHERE_APPLIED = 32
ALREADY_TURNED = 64

RANGE = np.dtype(
    [
        ("gnss_id", "i4"),
        ("sv_id", "i4"),
        ("signal", "i4"),
        ("status", "i4"),
        ("flags", "i4"),
        ("issue", "i4"),
        ("carrier_hz", "f8"),
        ("pseudorange", "f8"),
        ("pseudorange_std", "f8"),
        ("doppler", "f8"),
        ("doppler_std", "f8"),
        ("cn0", "f8"),
        ("noise_factor", "f8"),
        ("satellite", "f8", (3,)),
        ("satellite_velocity", "f8", (3,)),
        ("satellite_clock", "f8"),
        ("satellite_clock_drift", "f8"),
    ],
    align=True,
)
"""One measured signal.

- ``signal``: index into `signals.SIGNALS`.
- ``flags``: the bits above, as in the topic; those that end in APPLIED concern the pseudorange, `CLOCK_APPLIED`
  satellite clock and group delay together.
- ``issue``: of the ephemeris used.
- ``pseudorange`` m, ``doppler`` Hz (positive when approaching), their standard deviations (NaN: by model), ``cn0``
  dB-Hz (NaN unknown).
- ``noise_factor``: factor of a combination on the receiver's noise and multipath, 1 for a plain range.
- ``satellite``, ``satellite_velocity``: ECEF at transmission (m, m/s), of reception with `ALREADY_TURNED`.
- ``satellite_clock`` (s): with relativity, minus the group delay of this signal; ``satellite_clock_drift`` s/s.
"""

# Limits of pseudoranges (m) that hold even with a large error of the receiver clock, and of Doppler (Hz).
SHORTEST_PSEUDORANGE = 1e6
LONGEST_PSEUDORANGE = 1e8
LARGEST_DOPPLER = 1e5
# Limits of a navigation satellite: distance from the centre of the Earth (m), speed (m/s), clock (s), drift (s/s).
NEAREST_SATELLITE = 6.5e6
FARTHEST_SATELLITE = 1e8
FASTEST_SATELLITE = 1e4
LARGEST_CLOCK = 0.1
LARGEST_CLOCK_DRIFT = 1e-6
LOWEST_CARRIER_HZ = 1.1e9
HIGHEST_CARRIER_HZ = 1.7e9
HIGHEST_CN0 = 100.0

DEFAULT_CN0_MASK = 28.0
"""dB-Hz; a receiver hardly tracks signals below it."""

_LOW_CN0 = int(Status.LOW_CN0)
_SIGNAL_COUNT = len(SIGNALS)


def _blank() -> bytes:
    """Return the bytes of an unknown range."""
    row = np.zeros(1, RANGE)
    for name in RANGE.names or ():
        if RANGE[name].base.kind == "f":
            row[name] = math.nan
    row["signal"] = UNKNOWN_SIGNAL
    row["status"] = Status.NOT_LOCATED
    row["issue"] = NO_ISSUE
    row["noise_factor"] = 1.0
    return row.tobytes()


_BLANK = _blank()


def allocate_ranges(count: int) -> NDArray[np.void]:
    """Return ``count`` unknown ranges (RANGE)."""
    return np.frombuffer(bytearray(_BLANK * count), RANGE)


def locate(ranges: NDArray[np.void], week: int, seconds: float, ephemerides: Ephemerides) -> None:
    """Complete the ranges (RANGE, in place) of one epoch with satellite state, carrier and status.

    ``week``, ``seconds``: time tag of the epoch by the receiver's clock in GPS time. Ranges that bring their satellite
    (`SATELLITE_KNOWN`) keep it. This is where ranges are checked: an impossible number becomes NaN or leads to a
    status.
    """
    locate_all(ranges, week, seconds, ephemerides.records, ephemerides.first)


def status_counts(ranges: NDArray[np.void]) -> Counter[Status]:
    """Return the number of ranges by status."""
    values, counts = np.unique(ranges["status"], return_counts=True)
    return Counter({Status(value): int(count) for value, count in zip(values, counts)})


def one_per_satellite(ranges: NDArray[np.void], cn0_mask: float = DEFAULT_CN0_MASK) -> NDArray[np.void]:
    """Return one code and one Doppler of each satellite, as by `choose_per_satellite`, in the order of satellites.

    They are one range if the same signal gives both, else two, each with the flag of its own measurement. Signals with
    a C/N0 below ``cn0_mask`` (dB-Hz) are left out before, as in tight coupling.
    """
    chosen = ranges.copy()
    leave_out_weak(chosen, cn0_mask)
    choose_per_satellite(chosen, True)
    chosen = chosen[chosen["status"] == Status.USABLE]
    return chosen[np.lexsort([chosen["signal"], chosen["sv_id"], chosen["gnss_id"]])]


def ionosphere_free(ranges: NDArray[np.void]) -> NDArray[np.void]:
    """Return one range per satellite with usable code on two frequencies, combined so that the ionosphere cancels.

    Of each satellite the first signal in `signals.SIGNALS` and the one whose frequency is farthest from it. First-order
    ionosphere only (a few centimetres remain); noise and multipath grow by ``noise_factor``, three for L1 and L2
    (Kaplan and Hegarty, Understanding GPS, 3rd ed., section 10.2.4.1). Doppler and C/N0 are those of the first signal:
    the C/N0 of L2 P(Y) tracked without its code says little about the code noise.
    """
    usable = ranges[(ranges["status"] == Status.USABLE) & (ranges["flags"] & CODE_VALID != 0)]
    usable = usable[np.lexsort([usable["signal"], usable["sv_id"], usable["gnss_id"]])]
    satellite = SATELLITE_KEYS * usable["gnss_id"] + usable["sv_id"]
    combined = []
    for key in np.unique(satellite):
        signals = usable[satellite == key]
        first = signals[0].copy()
        second = signals[np.argmax(np.abs(signals["carrier_hz"] - first["carrier_hz"]))]
        if abs(second["carrier_hz"] - first["carrier_hz"]) < 0.1 * L1:
            continue
        f1, f2 = first["carrier_hz"] ** 2, second["carrier_hz"] ** 2
        near, far = f1 / (f1 - f2), f2 / (f1 - f2)
        first["pseudorange"] = near * first["pseudorange"] - far * second["pseudorange"]
        first["satellite_clock"] = near * first["satellite_clock"] - far * second["satellite_clock"]
        first["pseudorange_std"] = math.hypot(near * first["pseudorange_std"], far * second["pseudorange_std"])
        first["noise_factor"] = math.hypot(near * first["noise_factor"], far * second["noise_factor"])
        first["flags"] |= IONOSPHERE_APPLIED
        combined.append(first)
    return np.array(combined, RANGE)


@njit
def leave_out_weak(signals, cn0_mask):
    """Set the status of usable signals (RANGE, MEASURED_SIGNAL) with a C/N0 below the mask; an unknown one passes."""
    for k in range(len(signals)):
        if signals[k]["status"] == Status.USABLE and signals[k]["cn0"] < cn0_mask:
            signals[k]["status"] = _LOW_CN0


@njit
def choose_per_satellite(signals, one_of_each):
    """Choose the code and the Doppler of each satellite (RANGE, MEASURED_SIGNAL); return how many signals are left.

    Code is taken from the upper band only (`signals.is_upper_band`): the receiver delays other bands differently, and
    its clock would absorb the difference. With ``one_of_each`` a satellite gives one code, from the first of its
    signals in `signals.SIGNALS`, and one Doppler, from the same signal if it has one, else from the first of any band:
    several signals share the errors of orbit, clock and atmosphere and are not independent. The flags tell what a
    remaining signal gives. Of equal signals the first in the epoch counts.
    """
    for k in range(len(signals)):
        if signals[k]["status"] == Status.USABLE and is_double(signals, k):
            signals[k]["status"] = Status.DUPLICATE
    given = np.zeros(len(signals), np.int64)
    unused = np.full(len(signals), Status.OTHER_SIGNAL)
    for k in range(len(signals)):
        if signals[k]["status"] != Status.USABLE:
            continue
        code, doppler = first_of_satellite(signals, k, CODE_VALID), first_of_satellite(signals, k, DOPPLER_VALID)
        if code >= 0 and gives(signals[code], DOPPLER_VALID):
            doppler = code
        for flag, chosen in ((CODE_VALID, code), (DOPPLER_VALID, doppler)):
            if k == chosen or (not one_of_each and gives(signals[k], flag)):
                given[k] |= flag
        if code < 0 and doppler < 0:
            unused[k] = Status.OTHER_BAND
    count = 0
    for k in range(len(signals)):
        if signals[k]["status"] != Status.USABLE:
            continue
        if given[k]:
            signals[k]["flags"] &= ~(CODE_VALID | DOPPLER_VALID) | given[k]
            count += 1
        else:
            signals[k]["status"] = unused[k]
    return count


@njit
def is_double(signals, k):
    """Return whether an earlier usable signal is of the same satellite and kind."""
    signal = signals[k]
    for earlier in range(k):
        other = signals[earlier]
        if (
            other["status"] == Status.USABLE
            and of_one_satellite(other, signal)
            and other["signal"] == signal["signal"]
            and not abs(other["carrier_hz"] - signal["carrier_hz"]) > 1.0
        ):
            return True
    return False


@njit
def of_one_satellite(first, second):
    """Return whether two signals are of the same satellite."""
    return first["gnss_id"] == second["gnss_id"] and first["sv_id"] == second["sv_id"]


@njit
def gives(signal, flag):
    """Return whether a signal has a code (`CODE_VALID`) of the band in use, or a Doppler (`DOPPLER_VALID`) in m/s."""
    if not signal["flags"] & flag:
        return False
    if flag == CODE_VALID:
        return is_upper_band(signal["signal"], signal["carrier_hz"])
    return not math.isnan(signal["carrier_hz"])


@njit
def first_of_satellite(signals, k, flag):
    """Return the first usable signal of the satellite of ``signals[k]`` that gives ``flag``; -1 if there is none.

    The order is that of `signals.SIGNALS`; of unlisted signals the one with the higher carrier comes first.
    """
    first = -1
    for other in range(len(signals)):
        rival = signals[other]
        if rival["status"] != Status.USABLE or not of_one_satellite(rival, signals[k]) or not gives(rival, flag):
            continue
        if first < 0 or precedes(rival, signals[first]):
            first = other
    return first


@njit
def precedes(first, second):
    """Return whether the first of two different signals of a satellite is preferred."""
    if first["signal"] != second["signal"]:
        return first["signal"] < second["signal"]
    return first["carrier_hz"] > second["carrier_hz"]


@njit
def locate_all(ranges, week, seconds, records, first):
    """Do the work of `locate` for the arrays of an `Ephemerides`."""
    for k in range(len(ranges)):
        locate_one(ranges[k], week, seconds, records, first)


@njit
def locate_one(observed, week, seconds, records, first):
    """Complete one range in place.

    Over 60 lines: every reason for which a signal is not used, in order.
    """
    gnss, sv_id, signal = observed["gnss_id"], observed["sv_id"], observed["signal"]
    known_signal = 0 <= signal < _SIGNAL_COUNT and SIGNAL_GNSS[signal] == gnss
    pseudorange = observed["pseudorange"]
    if not (SHORTEST_PSEUDORANGE < pseudorange < LONGEST_PSEUDORANGE):
        observed["flags"] &= ~CODE_VALID
    if not (abs(observed["doppler"]) < LARGEST_DOPPLER):
        observed["flags"] &= ~DOPPLER_VALID
    if not 0.0 <= observed["cn0"] < HIGHEST_CN0:
        observed["cn0"] = math.nan
    if not 0.0 < observed["pseudorange_std"] < math.inf:
        observed["pseudorange_std"] = math.nan
    if not 0.0 < observed["doppler_std"] < math.inf:
        observed["doppler_std"] = math.nan
    if not LOWEST_CARRIER_HZ < observed["carrier_hz"] < HIGHEST_CARRIER_HZ:
        # An unknown GLONASS channel would change the range rate by metres per second: no Doppler without it.
        observed["carrier_hz"] = SIGNAL_CARRIER_HZ[signal] if known_signal and gnss != Gnss.GLONASS else math.nan
    if observed["flags"] & CLOCK_APPLIED:
        observed["satellite_clock"] = 0.0
    if not 0 <= gnss < GNSS_COUNT or not IS_CONSTELLATION[gnss]:
        # The number is an index into tables of constellations, and the time of other systems is unknown.
        observed["status"] = Status.UNKNOWN_SIGNAL
        return
    if math.isnan(observed["satellite_clock"]):
        # A position alone is no satellite state: without its clock a range is 100 km off. The ephemerides have both.
        observed["flags"] &= ~(SATELLITE_KNOWN | ALREADY_TURNED)
    if observed["flags"] & SATELLITE_KNOWN:
        if math.isnan(observed["satellite_clock_drift"]):
            observed["satellite_clock_drift"] = 0.0
        velocity = observed["satellite_velocity"]
        if math.isnan(velocity[0] + velocity[1] + velocity[2]):
            observed["flags"] &= ~DOPPLER_VALID
            for axis in range(3):
                velocity[axis] = 0.0
        observed["status"] = Status.USABLE if satellite_is_possible(observed) else Status.BAD_VALUE
        return
    if not known_signal:
        observed["status"] = Status.UNKNOWN_SIGNAL
        return
    if not observed["flags"] & CODE_VALID or not 0.0 <= seconds < SECONDS_PER_WEEK:
        observed["status"] = Status.BAD_VALUE
        return
    slot = SIGNAL_SLOT[signal]
    chosen, reason = choose(records, first, gnss, sv_id, slot, week, seconds, NO_ISSUE)
    if chosen < 0:
        if reason == Status.STALE and fits_another_week(records, first, gnss, sv_id, week, seconds):
            reason = Status.WRONG_WEEK
        observed["status"] = reason
        return
    ephemeris = records[chosen]
    if observed["flags"] & CLOCK_APPLIED:
        instant = seconds - pseudorange / SPEED_OF_LIGHT
    else:
        instant = transmission(ephemeris, week, seconds, pseudorange)
    position, velocity, clock, drift = satellite_state(ephemeris, week, instant)
    for axis in range(3):
        observed["satellite"][axis] = position[axis]
        observed["satellite_velocity"][axis] = velocity[axis]
    if not observed["flags"] & CLOCK_APPLIED:
        observed["satellite_clock"] = clock - ephemeris["group_delay"][slot]
    observed["satellite_clock_drift"] = drift
    observed["issue"] = ephemeris["issue"]
    if gnss == Gnss.GLONASS:
        carrier = carrier_hz(signal, ephemeris["channel"])
        observed["carrier_hz"] = carrier if LOWEST_CARRIER_HZ < carrier < HIGHEST_CARRIER_HZ else math.nan
    if not satellite_is_possible(observed):
        observed["status"] = Status.BAD_EPHEMERIS
        return
    observed["flags"] |= SATELLITE_KNOWN
    observed["status"] = Status.USABLE


@njit
def satellite_is_possible(observed):
    """Return whether position, velocity and clock can be those of a navigation satellite."""
    distance2, speed2 = 0.0, 0.0
    for axis in range(3):
        distance2 += observed["satellite"][axis] ** 2
        speed2 += observed["satellite_velocity"][axis] ** 2
    return (
        NEAREST_SATELLITE**2 < distance2 < FARTHEST_SATELLITE**2
        and speed2 < FASTEST_SATELLITE**2
        and abs(observed["satellite_clock"]) < LARGEST_CLOCK
        and abs(observed["satellite_clock_drift"]) < LARGEST_CLOCK_DRIFT
    )


@njit
def choose(records, first, gnss_id, sv_id, slot, week, seconds, issue):
    """Return the index of the ephemeris for a signal at an instant of GPS time, and a `Status`; index -1 for none.

    Of the valid messages (``max_lead``, ``max_age``) that give the group delay of ``slot`` the first in
    `ephemeris.Message` is chosen, and of its issues the one whose reference time is closest, as a share of the time
    allowed; with ``issue`` (not `NO_ISSUE`) only that issue. An ephemeris sent after the instant serves only if there
    is no other. The satellite is unhealthy if this ephemeris says so, or the one sent last before the instant: an older
    good one does not override a new warning.
    """
    if not (0 <= gnss_id < GNSS_COUNT and 0 <= sv_id < SATELLITE_KEYS):
        return -1, Status.NO_EPHEMERIS
    key = SATELLITE_KEYS * gnss_id + sv_id
    chosen, message, closest, ahead = -1, 0, math.inf, False
    newest, warned = -math.inf, False
    reason = Status.NO_EPHEMERIS
    for k in range(first[key], first[key + 1]):
        ephemeris = records[k]
        if issue != NO_ISSUE and ephemeris["issue"] != issue:
            continue
        since_toe = elapsed(week, seconds, ephemeris["toe_week"], ephemeris["toe"])
        age = since_toe / ephemeris["max_age"] if since_toe > 0.0 else -since_toe / ephemeris["max_lead"]
        if not age <= 1.0:
            if reason < Status.STALE:
                reason = Status.STALE
            continue
        if slot < 0 or math.isnan(ephemeris["group_delay"][slot]):
            if reason < Status.NO_GROUP_DELAY:
                reason = Status.NO_GROUP_DELAY
            continue
        # NaN if unknown: then it counts as sent, because the receiver has it.
        until_sent = elapsed(ephemeris["sent_week"], ephemeris["sent"], week, seconds)
        unsent = until_sent > 0.0
        later_message = chosen >= 0 and ephemeris["message"] > message
        if later_message and not ahead:
            break
        if newest < until_sent <= 0.0:
            newest = until_sent
            warned = (ephemeris["unhealthy"] >> slot) & 1 != 0
        replaces = age <= closest and not later_message
        if chosen < 0 or (ahead and not unsent) or (ahead == unsent and replaces):
            chosen, message, closest, ahead = k, ephemeris["message"], age, unsent
    if chosen < 0:
        return -1, reason
    if warned or (records[chosen]["unhealthy"] >> slot) & 1:
        return -1, Status.UNHEALTHY
    return chosen, Status.USABLE


@njit
def fits_another_week(records, first, gnss_id, sv_id, week, seconds):
    """Return whether an ephemeris of the satellite is valid at these seconds of another week.

    So it is with a receiver that counts weeks modulo 1024, or starts with the week of its firmware. With a file of
    another day only a few satellites look like this.
    """
    key = SATELLITE_KEYS * gnss_id + sv_id
    for k in range(first[key], first[key + 1]):
        ephemeris = records[k]
        since_toe = elapsed(week, seconds, ephemeris["toe_week"], ephemeris["toe"])
        since_toe -= SECONDS_PER_WEEK * math.floor(since_toe / SECONDS_PER_WEEK + 0.5)
        if -ephemeris["max_lead"] <= since_toe <= ephemeris["max_age"]:
            return True
    return False
