"""How long the estimator takes per IMU sample and per late fix; part of benchmark/speed.py.

Each figure is the best of many short runs in this process: the machine's own noise only ever adds.
"""

from __future__ import annotations

import time

import numpy as np

from eskf_ros.compiled import COMPILED
from eskf_ros.filter.navigator import Navigator
from eskf_ros.gnss.ephemeris import EPHEMERIS, Ephemerides
from eskf_ros.gnss.measurements import measured_epoch
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.range_receiver import RangeReceiver
from eskf_ros.simulate.scenario import Recording, simulate

SECOND = 1_000_000_000
BLOCK = 1000


def aligned(recording: Recording, samples: int) -> Navigator:
    """Return a navigator that has fused all GNSS of the first ``samples`` IMU samples."""
    navigator = Navigator(from_mapping(recording.parameters()), output_rate=1.0)
    first = 0
    for epoch, stamp in enumerate(recording.fix_stamp):
        last = min(int(np.searchsorted(recording.imu_stamp, stamp, side="right")), samples)
        push_imu(navigator, recording, first, last)
        if last == samples:
            break
        first = last
        push_fix(navigator, recording, epoch)
    return navigator


def push_imu(navigator: Navigator, recording: Recording, first: int, last: int) -> None:
    """Push IMU samples ``first`` to ``last``."""
    part = slice(first, last)
    navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])


def push_fix(navigator: Navigator, recording: Recording, epoch: int) -> None:
    """Push the position of one epoch."""
    navigator.push_gnss_position(
        int(recording.fix_stamp[epoch]),
        float(recording.fix_latitude_deg[epoch]),
        float(recording.fix_longitude_deg[epoch]),
        float(recording.fix_altitude[epoch]),
        recording.fix_covariance[epoch],
        2,
        0,
    )


def sample_microseconds(recording: Recording, start: int) -> float:
    """Predict with history and checkpoints, in blocks as the replay pushes them: us per IMU sample."""
    navigator = aligned(recording, start)
    best = np.inf
    for first in range(start, len(recording.imu_stamp) - BLOCK, BLOCK):
        began = time.perf_counter()
        push_imu(navigator, recording, first, first + BLOCK)
        best = min(best, (time.perf_counter() - began) / BLOCK)
    return 1e6 * best


def call_microseconds(recording: Recording, start: int) -> float:
    """One sample per call, as the node pushes them: us per IMU sample."""
    navigator = aligned(recording, start)
    best = np.inf
    for first in range(start, start + 50 * 100, 100):
        began = time.perf_counter()
        for sample in range(first, first + 100):
            push_imu(navigator, recording, sample, sample + 1)
        best = min(best, (time.perf_counter() - began) / 100)
    return 1e6 * best


def late_fix_milliseconds(recording: Recording, start: int, lateness: float) -> float:
    """A fix that is ``lateness`` s late: ms for the rewind and for all that is applied again."""
    navigator = aligned(recording, start)
    best = np.inf
    sample = start
    for epoch in np.flatnonzero(recording.fix_stamp > recording.imu_stamp[start]):
        arrives = int(np.searchsorted(recording.imu_stamp, recording.fix_stamp[epoch] + round(lateness * SECOND)))
        if arrives >= len(recording.imu_stamp):
            break
        push_imu(navigator, recording, sample, arrives)
        sample = arrives
        began = time.perf_counter()
        push_fix(navigator, recording, int(epoch))
        navigator.update()
        best = min(best, time.perf_counter() - began)
    return 1e3 * best


def tight_microseconds(recording: Recording, start: int) -> tuple[float, float]:
    """With ranges: us per IMU sample while clock and offsets are in use, and us per signal of an epoch."""
    ranges = recording.ranges
    assert ranges is not None
    ephemerides = Ephemerides(np.array([broadcast.record() for broadcast in ranges.broadcasts], EPHEMERIS))
    navigator = Navigator(from_mapping({**recording.parameters(), "mode": "tight"}), output_rate=1.0)
    first, per_signal = 0, np.inf
    for epoch, stamp in enumerate(ranges.stamp):
        last = int(np.searchsorted(recording.imu_stamp, stamp, side="right"))
        push_imu(navigator, recording, first, last)
        first = last
        instant = int(ranges.week[epoch]), float(ranges.seconds[epoch])
        signals = measured_epoch(ranges.epoch(epoch), *instant, ephemerides)
        began = time.perf_counter()
        navigator.push_ranges(int(stamp), instant, signals)
        navigator.update()
        if navigator.state["heading_known"][0]:
            per_signal = min(per_signal, (time.perf_counter() - began) / len(signals))
        if last > start:
            break
    best = np.inf
    for first in range(last, len(recording.imu_stamp) - BLOCK, BLOCK):
        began = time.perf_counter()
        push_imu(navigator, recording, first, first + BLOCK)
        best = min(best, (time.perf_counter() - began) / BLOCK)
    return 1e6 * best, 1e6 * per_signal


def measure() -> list[tuple[str, str, str]]:
    """Return rows of (what, figure, target)."""
    slow = simulate("drive", imu_rate=200.0, stop=120.0)
    fast = simulate("drive", imu_rate=1000.0, stop=60.0)
    sky = simulate("drive", imu_rate=200.0, stop=80.0, ranges=RangeReceiver(systems="GERC"))
    tight, per_signal = tight_microseconds(sky, 40 * 200)
    target = "0.7 us" if COMPILED else ""
    return [
        ("estimator, per IMU sample in blocks", f"{sample_microseconds(slow, 40 * 200):.2f} us", target),
        ("estimator, per IMU sample in single calls", f"{call_microseconds(slow, 40 * 200):.1f} us", ""),
        ("the same in mode tight, four constellations", f"{tight:.2f} us", ""),
        ("a signal of an epoch: pseudorange and Doppler", f"{per_signal:.1f} us", ""),
        ("a fix 500 ms late at 1000 Hz", f"{late_fix_milliseconds(fast, 40 * 1000, 0.5):.2f} ms", "1 ms"),
    ]
