"""A day without a break: does the covariance stay one, does memory stay, does the time per sample stay?

    python benchmark/soak.py [--hours 24] [--mode tight]

A car drives laps around blocks for a day, IMU at 400 Hz. Every ten minutes come a tunnel of a minute and one of the
`FAULTS`. The drive is simulated in parts of ten minutes and handed over second by second, as a node gets it; nothing of
it is kept. After every second the covariances of both lanes are looked at: equal to their transpose to the bit, and
positive definite, by the smallest eigenvalue of the correlation matrix. Writes its table to docs/results.md.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from campaign.document import replace_section
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.lanes import FILTER, HUMBLE, is_running
from eskf_ros.gnss.ephemeris import EPHEMERIS, Ephemerides
from eskf_ros.gnss.measurements import measured_epoch
from eskf_ros.gnss.signals import Gnss
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate import gnss_episodes, imu_episodes
from eskf_ros.simulate import gnss_message_episodes as message_episodes
from eskf_ros.simulate.episodes import ClockSet, Episode, Outage
from eskf_ros.simulate.profile import Hold, SpeedTo, Turn
from eskf_ros.simulate.range_episodes import ClockStep, KeepSatellites, Reflections, StreetCanyon
from eskf_ros.simulate.range_receiver import RangeReceiver
from eskf_ros.simulate.scenario import SCENARIOS, Recording, Scenario, simulate
from eskf_ros.simulate.scenario_families import driven
from eskf_ros.tables.feeding import push_row
from markdown_table import table
from monte_carlo import Array, messages_of, state_error

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results.md"

RATE = 400
PART = 600
"""s of the drive that are in memory at a time."""

TUNNEL = (100.0, 60.0)
FAULT = (250.0, 120.0)
"""Start and length (s) of tunnel and fault in every part; the rest of it is for getting over them."""

LAP = (
    SpeedTo(13.0),
    Hold(12.0),
    SpeedTo(6.0),
    Turn(90.0, 2.5),
    SpeedTo(11.0),
    Hold(8.0),
    Turn(-25.0),
    Turn(25.0),
    SpeedTo(0.0, 2.5),
    Hold(10.0),
    SpeedTo(6.0),
    Turn(90.0, 2.5),
)
LAPS_PER_HOUR = 55
"""A few more than fit into an hour."""

FAULTS: tuple[Callable[[float, float], Episode], ...] = (
    gnss_episodes.Multipath,
    imu_episodes.ImuHoles,
    gnss_episodes.Spoofing,
    imu_episodes.ImuBias,
    gnss_episodes.CorrelatedErrors,
    partial(imu_episodes.ImuHoles, filled="lines"),
    gnss_episodes.Overconfidence,
    imu_episodes.ImuJitter,
    message_episodes.FrozenFixes,
    partial(imu_episodes.ImuClipping, rate=0.15, force=10.0),
    gnss_episodes.ClaimedStd,
    imu_episodes.ImuShocks,
    gnss_episodes.BadFixes,
    imu_episodes.ImuNoise,
    message_episodes.MissingAltitude,
    imu_episodes.ImuBursts,
    gnss_episodes.ZeroCovariance,
    imu_episodes.ImuVibration,
    message_episodes.UnfilledFixes,
    partial(ClockSet, step=-0.5),
    message_episodes.VelocityInNed,
    message_episodes.GnssDelay,
    partial(ClockSet, step=2.0),
    message_episodes.RepeatedFixes,
)
"""What goes wrong, one in each part, in turn."""

RANGE_FAULTS: tuple[Callable[[float, float], Episode], ...] = (KeepSatellites, StreetCanyon, Reflections, ClockStep)
"""In mode tight every second fault is one of these, and the others are those of the IMU."""

SYSTEMS = "GE"


@dataclass
class Hour:
    """What one hour has shown: seconds on both lanes, smallest eigenvalues, times, memory, errors."""

    seconds: int = 0
    humble_seconds: int = 0
    asymmetric: int = 0
    smallest: float = np.inf
    humble_smallest: float = np.inf
    times: list[float] = field(default_factory=list)
    megabytes: float = 0.0
    errors: list[float] = field(default_factory=list)
    sigmas: list[float] = field(default_factory=list)

    def look(self, navigator: Navigator) -> None:
        """Look at the covariances of the lanes."""
        states = navigator._states
        if not states[FILTER]["level_known"]:
            return
        self.seconds += 1
        self.smallest = min(self.smallest, self._smallest_of(states[FILTER]))
        if is_running(states):
            self.humble_seconds += 1
            self.humble_smallest = min(self.humble_smallest, self._smallest_of(states[HUMBLE]))

    def _smallest_of(self, lane: Any) -> float:
        """Return the smallest eigenvalue of the correlation matrix of a lane; count a matrix that is not symmetric."""
        size = int(lane["error_size"])
        covariance = lane["covariance"][:size, :size]
        self.asymmetric += not np.array_equal(covariance, covariance.T)
        std = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(std, std)
        # A variance that is not positive, or not a number, makes eigenvalues that are not numbers: they count as wrong.
        return float(np.linalg.eigvalsh(correlation)[0]) if np.isfinite(correlation).all() else -np.inf


def faults_of(part: int, is_tight: bool) -> tuple[Episode, ...]:
    """Return the tunnel and the fault of a part."""
    start = float(part * PART)
    kind = FAULTS[part % len(FAULTS)]
    if is_tight and part % 2 == 0:
        kind = RANGE_FAULTS[part // 2 % len(RANGE_FAULTS)]
    return Outage(start + TUNNEL[0], TUNNEL[1]), kind(start + FAULT[0], FAULT[1])


class Drive:
    """The parts of the day, one after the other; the biases of the IMU go on where the part before has left them."""

    def __init__(self, hours: float, is_tight: bool) -> None:
        self.parts, self.is_tight = round(hours * 3600 / PART), is_tight
        laps = int(hours * LAPS_PER_HOUR) + 10
        SCENARIOS["soak"] = Scenario("a day of laps", driven((Hold(20.0), *(LAP * laps), Hold(60.0))), heading_deg=35.0)
        self._accel_bias, self._gyro_bias = np.zeros(3), np.zeros(3)

    def __iter__(self) -> Iterator[tuple[Recording, Array, Array]]:
        """Yield recordings with the readings that take their place (force, rate)."""
        for part in range(self.parts):
            # Ephemerides hold for hours: each part has the sky of the first.
            receiver = RangeReceiver(systems=SYSTEMS, rate=1.0, clock_offset=float(part * PART))
            recording = simulate(
                "soak",
                part,
                start=float(part * PART),
                stop=float((part + 1) * PART),
                imu_rate=float(RATE),
                truth_rate=1.0,
                ranges=receiver if self.is_tight else None,
                episodes=faults_of(part, self.is_tight),
            )
            if part == 0:
                self._accel_bias, self._gyro_bias = recording.accel_bias[0], recording.gyro_bias[0]
            force = recording.specific_force + (self._accel_bias - recording.accel_bias[0])
            rate = recording.angular_rate + (self._gyro_bias - recording.gyro_bias[0])
            self._accel_bias = self._accel_bias + recording.accel_bias[-1] - recording.accel_bias[0]
            self._gyro_bias = self._gyro_bias + recording.gyro_bias[-1] - recording.gyro_bias[0]
            yield recording, force, rate


Push = tuple[int, Callable[[Navigator], None]]
"""When a message comes (ns), and what gives it to the filter."""


def pushes_of(recording: Recording) -> list[Push]:
    """Return all messages but those of the IMU, as they come."""
    ranges = recording.ranges
    if ranges is None:
        return [
            (m[0], partial(push_row, name=m[1], stamp=m[2], row=m[3], arrival=m[0])) for m in messages_of(recording)
        ]
    ephemerides = Ephemerides(np.array([broadcast.record() for broadcast in ranges.broadcasts], EPHEMERIS))
    klobuchar = ranges.klobuchar[Gnss.GPS]

    def push(navigator: Navigator, k: int) -> None:
        instant = int(ranges.week[k]), float(ranges.seconds[k])
        signals = measured_epoch(ranges.epoch(k), *instant, ephemerides)
        navigator.push_ranges(int(ranges.stamp[k]), instant, signals, klobuchar, int(ranges.arrival[k]))

    return [(int(arrival), partial(push, k=k)) for k, arrival in enumerate(ranges.arrival)]


def resident_megabytes() -> float:
    """Return the memory of this process that is not swapped out (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def push_second(
    navigator: Navigator, recording: Recording, force: Array, rate: Array, waiting: list[Push], given: int, part: slice
) -> int:
    """Push the IMU samples of ``part`` and the messages from ``given`` on that come meanwhile, in order of arrival.

    Returns the number of messages given so far.
    """
    arrival, first = recording.imu_arrival, part.start
    while first < part.stop:
        behind = part.stop
        if given < len(waiting):
            behind = min(behind, int(np.searchsorted(arrival, waiting[given][0], side="right")))
        if behind > first:
            samples = slice(first, behind)
            navigator.push_imu(recording.imu_stamp[samples], force[samples], rate[samples], arrival[samples])
            first = behind
        if first < part.stop:
            waiting[given][1](navigator)
            given += 1
    return given


def soak(hours: float, is_tight: bool) -> list[Hour]:
    """Drive for so many hours; return what each of them has shown."""
    found: list[Hour] = []
    waiting: list[Push] = []
    navigator = None
    for part, (recording, force, rate) in enumerate(Drive(hours, is_tight)):
        if navigator is None:
            mode = {"mode": "tight"} if is_tight else {}
            navigator = Navigator(from_mapping({**recording.parameters(), **mode}), output_rate=10.0)
        if part * PART % 3600 == 0:
            found.append(Hour())
        hour = found[-1]
        waiting += pushes_of(recording)
        given = 0
        for first in range(0, len(force), RATE):
            behind = min(first + RATE, len(force))
            began = time.process_time()
            given = push_second(navigator, recording, force, rate, waiting, given, slice(first, behind))
            navigator.take_records()
            hour.times.append((time.process_time() - began) / (behind - first))
            hour.look(navigator)
        waiting = waiting[given:]
        error = state_error(recording, len(force) - 1, len(recording.truth_stamp) - 1, navigator.state[0])
        hour.errors.append(float(np.hypot(*error[:2])))
        hour.sigmas.append(float(np.sqrt(np.trace(navigator.state[0]["covariance"][:2, :2]))))
        del recording, force, rate
        gc.collect()
        hour.megabytes = resident_megabytes()
        print(f"{(part + 1) * PART / 3600:.2f} h {line_of(hour)}", flush=True)
    return found


def line_of(hour: Hour) -> str:
    """Return the figures of an hour in one line."""
    return " ".join(row_of(hour))


def row_of(hour: Hour) -> list[str]:
    """Return the figures of an hour as they stand in the table."""
    times = 1e6 * np.array(hour.times)
    return [
        f"{hour.asymmetric}",
        f"{hour.smallest:.1e}",
        f"{hour.humble_smallest:.1e}",
        f"{np.median(times):.2f}",
        f"{np.quantile(times, 0.99):.2f}",
        f"{hour.megabytes:.0f}",
        f"{max(hour.errors):.1f}",
        f"{max(np.array(hour.errors) / hour.sigmas):.1f}",
    ]


HEADINGS = (
    "hours",
    "asymmetric",
    "smallest eigenvalue",
    "of the humble lane",
    "us per sample, median",
    "99 %",
    "MB",
    "error at the end of a part, m",
    "over its sigma",
)


def section(mode: str, found: list[Hour]) -> str:
    """Return the table of a day, six hours to a row."""
    rows = []
    for first in range(0, len(found), 6):
        hours = found[first : first + 6]
        several = Hour(
            asymmetric=sum(hour.asymmetric for hour in hours),
            smallest=min(hour.smallest for hour in hours),
            humble_smallest=min(hour.humble_smallest for hour in hours),
            times=[value for hour in hours for value in hour.times],
            megabytes=hours[-1].megabytes,
            errors=[value for hour in hours for value in hour.errors],
            sigmas=[value for hour in hours for value in hour.sigmas],
        )
        rows.append([f"{first} to {first + len(hours)}", *row_of(several)])
    seconds = sum(hour.seconds for hour in found)
    humble = sum(hour.humble_seconds for hour in found)
    return (
        f"Mode {mode}: covariances looked at {seconds} times in the filter, {humble} times in the humble lane.\n\n"
        + table(HEADINGS, rows)
    )


INTRODUCTION = """`python benchmark/soak.py --hours 24` writes this section.

A car at 400 Hz drives laps; every ten minutes come a tunnel of a minute and, for two minutes, one of {count} faults of
receiver, IMU and clock in turn (`FAULTS`). After every second both lanes are looked at: "asymmetric" counts covariances
that differ from their transpose in any bit, "smallest eigenvalue" is that of the correlation matrix (above zero:
positive definite, below some 1e-15 it could not be told). Times are those of the processor for blocks of a second, all
messages included, on a machine that was shared with others. MB is what the process holds at the end, simulation
included. The errors are those after four minutes of recovery.
"""

TIGHT = """`python benchmark/soak.py --mode tight --hours 6` writes this section.

The same with ranges of two constellations, once a second, instead of fixes; every second fault is one of the
satellites (`RANGE_FAULTS`). The receiver's clock is new in every part, the sky begins anew.
"""


def main() -> int:
    """Drive, print, write the section; return 1 if a covariance was none, or memory or times grew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0, help="length of the drive (default 24)")
    parser.add_argument("--mode", choices=("loose", "tight"), default="loose")
    chosen = parser.parse_args()
    found = soak(chosen.hours, chosen.mode == "tight")
    text = section(chosen.mode, found)
    print(text)
    if chosen.mode == "loose":
        replace_section(RESULTS, "A day without a break", INTRODUCTION.format(count=len(FAULTS)) + "\n" + text)
    else:
        replace_section(RESULTS, "Hours without a break in mode tight", TIGHT + "\n" + text)
    is_sound = all(
        hour.asymmetric == 0 and hour.smallest > 0.0 and (hour.humble_smallest > 0.0 or not hour.humble_seconds)
        for hour in found
    )
    first, last = found[min(1, len(found) - 1)], found[-1]
    has_grown = last.megabytes > 1.05 * first.megabytes or min(last.times) > 1.2 * min(first.times)
    return 0 if is_sound and not has_grown else 1


if __name__ == "__main__":
    sys.exit(main())
