"""Findings on the stamps of a topic: rate, gaps, jitter, bursts, repetitions, clocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.doctor.sensors import Recording, Sensor, Stamps

FEWEST = 20
"""Messages, at least, for statistics of stamps."""

LONG_GAP = 5.0
"""Usual intervals from which on an interval is a gap."""

NOTABLE_JITTER = 0.05
"""Scatter of the stamps as a share of the interval from which on integrating an IMU suffers."""

IN_A_BURST = 0.2
"""Share of the mean interval below which two stamps belong to one burst."""

CLOCKS_APART = 0.5
"""s; no driver delays a message by more than the IMU's by this in every case."""

SET_BACK = 0.05
"""s; stamps that go back by more are a clock that was set, not messages out of order."""

SLOW_IMU = 50.0
"""Hz; a slower IMU misses motion between its samples."""

CLOCK_JUMP = 0.2
"""s; a change of the shortest delay by more, from one moment to the next, is a clock that was set."""

NOTABLE_DRIFT = 100e-6
"""Rate of one clock against another (1) beyond what quartz does, from which on it is told."""


@dataclass(frozen=True)
class Timing:
    """Statistics of the stamps of a topic, in s; ``jitter``: standard deviation of a stamp."""

    interval: float
    mean_interval: float
    jitter: float
    burst_share: float
    gaps: NDArray[np.float64]
    gap_starts: Stamps


def timing_of(stamps: Stamps) -> Timing:
    """Return the statistics of increasing stamps (n,) ns; n must be 2 at least."""
    steps = np.diff(stamps) * 1e-9
    usual = float(np.median(steps))
    # In bursts the median is the short step between two of a burst: the mean tells the rate.
    inside = steps[steps < LONG_GAP * max(usual, float(np.mean(steps)))]
    mean = float(np.mean(inside)) if len(inside) else usual
    burst_share = float(np.mean(inside < IN_A_BURST * mean)) if len(inside) else 0.0
    interval = mean if burst_share > IN_A_BURST else usual
    is_gap = steps > LONG_GAP * interval
    regular = steps[~is_gap & (steps > 0.5 * interval) & (steps < 1.5 * interval)]
    # The difference of two stamps scatters by root two times a stamp.
    jitter = float(np.std(regular)) / np.sqrt(2.0) if len(regular) > 1 else 0.0
    return Timing(interval, mean, jitter, burst_share, steps[is_gap], stamps[:-1][is_gap])


def stamp_findings(sensor: Sensor, recording: Recording) -> list[Finding]:
    """Return what is wrong with the stamps of a sensor."""
    is_imu = sensor.name == "imu"
    unset = int(np.count_nonzero(sensor.stamp <= 0))
    found = []
    if unset:
        found.append(
            Finding(
                Severity.ERROR if 2 * unset > len(sensor) else Severity.WARNING,
                "no_stamp",
                sensor.topic,
                f"{unset} of {len(sensor)} messages have no stamp (zero)",
                "let the driver fill header.stamp with the time of the measurement",
                {"messages": unset},
            )
        )
    found += _order_findings(sensor, is_imu)
    stamps = sensor.by_stamp().stamp
    if len(stamps) < FEWEST:
        few = f"{len(stamps)} messages with different stamps only"
        return [*found, Finding(Severity.WARNING, "few_messages", sensor.topic, few, "", {"messages": len(stamps)})]
    timing = timing_of(stamps)
    gap = recording.parameters.imu.gap
    if is_imu:
        found += _rate_findings(sensor, timing, gap)
        found += _jitter_findings(sensor, timing)
    return found + _gap_findings(sensor, timing, gap if is_imu else 1.0, is_imu)


def _order_findings(sensor: Sensor, is_imu: bool) -> list[Finding]:
    found = []
    one_frame = sensor.frame == np.bincount(sensor.frame).argmax() if len(sensor) else sensor.frame == 0
    stamps = sensor.stamp[one_frame & (sensor.stamp > 0)]
    steps = np.diff(stamps) * 1e-9
    same = int(np.count_nonzero(np.diff(np.sort(stamps)) == 0))
    if same > max(2, len(stamps) // 1000):
        found.append(
            Finding(
                Severity.ERROR if 4 * same > len(stamps) else Severity.WARNING,
                "equal_stamps",
                sensor.topic,
                f"{same} of {len(stamps)} messages have the stamp of another one; of these only one is used",
                "let the driver stamp each measurement with its own time",
                {"messages": same},
            )
        )
    back = steps[steps < 0.0]
    if len(back) and back.min() < -SET_BACK:
        at = float((stamps[int(np.argmin(steps))] - stamps[0]) * 1e-9)
        found.append(
            Finding(
                Severity.ERROR if is_imu else Severity.WARNING,
                "clock_set_back",
                sensor.topic,
                f"stamps go back {len(back)} times, by up to {-back.min():.3f} s at {at:.1f} s",
                "stamp with a clock that is never set (CLOCK_MONOTONIC, PTP), or start after it has been set",
                {"times": len(back), "seconds": float(-back.min())},
            )
        )
    elif len(back) > max(2, len(stamps) // 1000):
        text = f"{len(back)} messages come out of order, by up to {-1e3 * back.min():.1f} ms"
        evidence = {"messages": len(back), "milliseconds": float(-1e3 * back.min())}
        found.append(Finding(Severity.NOTE, "out_of_order", sensor.topic, text, "", evidence))
    return found


def _rate_findings(sensor: Sensor, timing: Timing, gap: float) -> list[Finding]:
    rate, evidence = 1.0 / timing.interval, {"rate_hz": 1.0 / timing.interval}
    if timing.interval > 0.9 * gap:
        wanted = min(10.0, round(3.0 * timing.interval, 2))
        text = f"the IMU has {rate:.3g} Hz: every interval counts as a gap (imu.gap = {gap:g} s)"
        remedy = f"record it faster (100 Hz and more), or set imu.gap to {wanted:g}"
        return [Finding(Severity.ERROR, "imu_rate", sensor.topic, text, remedy, evidence, {"imu.gap": wanted})]
    if rate < SLOW_IMU:
        text, remedy = f"the IMU has {rate:.3g} Hz: motion between its samples is lost", "record it at 100 Hz and more"
        return [Finding(Severity.WARNING, "imu_rate", sensor.topic, text, remedy, evidence)]
    return []


def _jitter_findings(sensor: Sensor, timing: Timing) -> list[Finding]:
    remedy = "stamp with the sensor's own clock, or when its interrupt comes (USB: latency timer of 1 ms)"
    if timing.burst_share > IN_A_BURST:
        size = 1.0 / (1.0 - timing.burst_share)
        text = (
            f"stamps come in bursts of about {size:.0f}: {timing.burst_share:.0%} of them are close to the one before"
        )
        evidence = {"share": timing.burst_share, "burst": size}
        return [Finding(Severity.WARNING, "stamp_bursts", sensor.topic, text, remedy, evidence)]
    share = timing.jitter / timing.interval
    if share > NOTABLE_JITTER:
        text = f"stamps scatter by {1e3 * timing.jitter:.2f} ms, {share:.0%} of the interval"
        evidence = {"milliseconds": 1e3 * timing.jitter, "share": share}
        return [Finding(Severity.WARNING, "stamp_jitter", sensor.topic, text, remedy, evidence)]
    return []


def _gap_findings(sensor: Sensor, timing: Timing, shortest: float, is_imu: bool) -> list[Finding]:
    long = timing.gaps > shortest
    if not long.any():
        return []
    gaps = timing.gaps[long]
    first = float((timing.gap_starts[long][0] - sensor.stamp[sensor.stamp > 0].min()) * 1e-9)
    plural = "s" if len(gaps) > 1 else ""
    text = (
        f"{len(gaps)} gap{plural} of more than {shortest:g} s, {gaps.sum():.1f} s in all, "
        f"the longest {gaps.max():.2f} s; the first at {first:.1f} s"
    )
    evidence = {"gaps": len(gaps), "longest_s": float(gaps.max()), "total_s": float(gaps.sum())}
    if not is_imu:
        return [Finding(Severity.NOTE, "gaps", sensor.topic, text, "", evidence)]
    remedy = "look for a full queue or disk, a loose plug, or a recorder without priority"
    return [Finding(Severity.WARNING, "imu_gaps", sensor.topic, text, remedy, evidence)]


def clock_findings(recording: Recording) -> list[Finding]:
    """Return what is wrong between the clocks of the sensors, by the time at which the messages were recorded."""
    imu = recording.sensors.get("imu")
    if imu is None or len(imu) < FEWEST:
        return []
    found = []
    own = _delays(imu)
    jumps = {name: _jump_findings(sensor) for name, sensor in recording.sensors.items() if len(sensor) >= FEWEST}
    for sensor in recording.sensors.values():
        if len(sensor) < FEWEST:
            continue
        delays = _delays(sensor)
        if jumps["imu"] or jumps[sensor.name]:
            found += jumps[sensor.name]
            continue
        # The shortest delays are those of transport alone.
        apart = float(np.percentile(delays, 2.0) - np.percentile(own, 2.0))
        if sensor is not imu and abs(apart) > CLOCKS_APART:
            found.append(_clocks_apart(sensor, apart, recording))
        found += _drift_findings(sensor)
        late = float(np.percentile(delays - np.percentile(own, 2.0), 98.0))
        window = recording.parameters.history.window
        if sensor is not imu and abs(apart) <= CLOCKS_APART and late > window:
            text = f"messages come up to {late:.2f} s after the IMU's, later than history.window = {window:g} s"
            remedy, wanted = f"set history.window to {min(30.0, late * 1.2):.1f}", round(min(30.0, late * 1.2), 1)
            evidence, changes = {"seconds": late}, {"history.window": wanted}
            found.append(Finding(Severity.ERROR, "too_late", sensor.topic, text, remedy, evidence, changes))
    return found


def _delays(sensor: Sensor) -> NDArray[np.float64]:
    """Return log time minus stamp (s) of the messages that have a stamp."""
    stamped = sensor.stamp > 0
    delays = np.asarray((sensor.log_time[stamped] - sensor.stamp[stamped]) * 1e-9, np.float64)
    return delays if len(delays) else np.zeros(1)


def _clocks_apart(sensor: Sensor, apart: float, recording: Recording) -> Finding:
    group = "gnss" if sensor.name.startswith("gnss") else sensor.name
    wanted = round(apart, 3)
    remedy, parameters = "synchronise the clocks (chrony, PTP, PPS)", {}
    limit = 10.0
    if abs(wanted) <= limit and hasattr(recording.parameters, group):
        remedy += f", or set {group}.time_offset to {wanted:g}"
        parameters = {f"{group}.time_offset": wanted}
    return Finding(
        Severity.ERROR,
        "clocks_apart",
        sensor.topic,
        f"its stamps are {abs(apart):.3f} s {'behind' if apart > 0.0 else 'ahead of'} those of the IMU, as recorded",
        remedy,
        {"seconds": apart},
        parameters,
    )


def _shortest_delays(sensor: Sensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower envelope of the delays: times (s of log time) and the shortest delay of twenty stretches."""
    stamped = sensor.stamp > 0
    delays, seconds = _delays(sensor), (sensor.log_time[stamped] - sensor.log_time.min()) * 1e-9
    span = float(seconds.max(initial=0.0))
    if span < 60.0:
        return np.zeros(0), np.zeros(0)
    stretch = np.minimum((20.0 * seconds / span).astype(int), 19)
    places = [number for number in range(20) if (stretch == number).any()]
    shortest = np.array([delays[stretch == number].min() for number in places])
    return (np.array(places) + 0.5) * span / 20.0, shortest


def _jump_findings(sensor: Sensor) -> list[Finding]:
    """Return a finding if the clock of the stamps was set during the recording."""
    times, shortest = _shortest_delays(sensor)
    if len(times) < 5:
        return []
    jumps = np.diff(shortest)
    largest = int(np.argmax(np.abs(jumps)))
    jump = float(jumps[largest])
    # A step between two levels, neither a drift nor a single delayed stretch.
    levels = float(np.median(shortest[largest + 1 :]) - np.median(shortest[: largest + 1]))
    if abs(levels) < CLOCK_JUMP or abs(jump) < 0.5 * abs(levels) or abs(jump) > 2.0 * abs(levels):
        return []
    text = f"its clock was set {'back' if levels > 0.0 else 'on'} by {abs(levels):.2f} s around {times[largest]:.0f} s"
    remedy = "stamp with a clock that is never set (CLOCK_MONOTONIC, PTP), or start after it has been set"
    return [Finding(Severity.ERROR, "clock_jump", sensor.topic, text, remedy, {"seconds": -levels})]


def _drift_findings(sensor: Sensor) -> list[Finding]:
    """Return a finding if the clock of the stamps runs away from that of the recorder."""
    times, shortest = _shortest_delays(sensor)
    if len(times) < 5 or not np.ptp(shortest):
        return []
    slope, start = np.polyfit(times, shortest, 1)
    rest, span = shortest - start - slope * times, float(np.ptp(times))
    if abs(slope) < NOTABLE_DRIFT or abs(slope) * span < max(0.02, 6.0 * float(np.std(rest))):
        return []
    text = f"its clock runs {1e6 * abs(slope):.0f} ppm {'slower' if slope > 0.0 else 'faster'} than the recorder's"
    remedy = "synchronise the clocks (chrony, PTP, PPS)"
    return [Finding(Severity.WARNING, "clock_drift", sensor.topic, text, remedy, {"ppm": 1e6 * float(slope)})]
