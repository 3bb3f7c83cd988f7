"""Intake of the signals of an epoch into the timeline."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.history.timeline import offer_aid
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.tight.signal import (
    CARRIER,
    CN0,
    FIELD,
    FLAGS,
    GPS_TIME,
    KLOBUCHAR,
    MEASURED,
    NOISE_FACTOR,
    SATELLITE,
    SATELLITE_VELOCITY,
    STD,
    source_of,
)
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, Status

LARGEST_NUMBER = 1e11
"""Larger than every range (m), satellite position (m) and GPS time (s)."""


@njit
def offer_signals(
    aids, timeline, offered, signals, stamp, arrival, gps_time, klobuchar, field, code_door, rate_door, refused
):
    """Sort the usable signals (MEASURED_SIGNAL) of one epoch into the timeline, which has room for two of each.

    ``gps_time``: s since 6 January 1980; ``klobuchar``: parameters of the ionosphere (8,); ``field``: the Earth's
    magnetic field there as `mag.note_field` wants it, zeros if unknown; ``code_door``, ``rate_door``: verdict with
    which pseudoranges and range rates are admitted. Returns how many never enter; ``refused`` (RECORD) tells which and
    why.
    """
    payload = offered[0].payload
    count = 0
    for k in range(len(signals)):
        signal = signals[k]
        if signal["status"] != Status.USABLE:
            continue
        for stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE):
            is_code = stream == Stream.PSEUDORANGE
            if not signal["flags"] & (CODE_VALID if is_code else DOPPLER_VALID):
                continue
            source = source_of(signal["gnss_id"], signal["sv_id"], signal["signal"])
            door = code_door if is_code else rate_door
            payload.fill(0.0)
            payload[MEASURED] = signal["pseudorange"] if is_code else signal["range_rate"]
            payload[STD] = signal["code_std"] if is_code else signal["range_rate_std"]
            for i in range(3):
                payload[SATELLITE + i] = signal["satellite"][i]
                payload[SATELLITE_VELOCITY + i] = signal["satellite_velocity"][i]
            payload[FLAGS] = signal["flags"]
            payload[CARRIER] = signal["carrier_hz"]
            payload[CN0] = signal["cn0"]
            payload[NOISE_FACTOR] = signal["noise_factor"]
            payload[GPS_TIME] = gps_time
            if door == Verdict.WAITING:
                door = judge_signal(payload)
            for i in range(8):
                payload[KLOBUCHAR + i] = klobuchar[i]
            for i in range(4):
                payload[FIELD + i] = field[i]
            verdict = offer_aid(aids, timeline, offered, stamp, arrival, stream, source, door)
            if verdict != Verdict.WAITING:
                record = refused[count]
                record["stamp"], record["arrival"], record["stream"] = stamp, arrival, stream
                record["source"], record["verdict"], record["dof"] = source, verdict, 0
                record["nis"] = math.nan
                for i in range(3):
                    record["innovation"][i] = math.nan
                count += 1
    return count


@njit
def judge_signal(payload):
    """Return the verdict on the admission of a signal: its numbers must be finite and not absurdly large."""
    largest = max(abs(payload[MEASURED]), abs(payload[GPS_TIME]))
    for i in range(SATELLITE, SATELLITE_VELOCITY + 3):
        if math.isnan(payload[i]):
            return Verdict.NON_FINITE
        largest = max(largest, abs(payload[i]))
    if not math.isfinite(payload[MEASURED] + payload[GPS_TIME] + largest):
        return Verdict.NON_FINITE
    return Verdict.WAITING if largest < LARGEST_NUMBER else Verdict.BAD_VALUE
