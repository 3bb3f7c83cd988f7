"""What `eskf_check` says of recordings with a fault: the table of docs/check.md.

    python benchmark/check_faults.py [--seeds 5] [--only WORD] [--no-filter] [--out docs/check.md]

Faults of `benchmark/faults.py`, and those of messages as drivers send them, are put into simulated city drives of 286 s
that are written to a recording. Counted are the runs that name the fault by one of the expected findings, and all
other warnings and errors. The parameters are the defaults with mounting and lever arm of the drive.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from campaign.fault import BEGIN, RATE, STOP, Fault
from campaign.running import parameters_of, recording_of
from eskf_ros.bags import BagWriter
from eskf_ros.doctor.examine import check
from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.frames import STRINGS
from eskf_ros.simulate.messages import topics_of
from eskf_ros.simulate.scenario import Recording, simulate
from faults import all_faults
from markdown_table import table

Messages = NDArray[Any]
Change = Callable[[Messages, NDArray[np.int64], np.random.Generator], tuple[Messages, NDArray[np.int64]]]
"""Changes the messages of a topic and their log times (n,) ns."""

NAMES = {
    "clean": (),
    "gyro bias step 1 deg/s": ("gyro_wanders",),
    "accelerometer bias step 0.3 m/s2": ("filter: accelerometer",),
    "gyro bias ramp 0.5 deg/s in 400 s": ("gyro_wanders",),
    "scale 1.5 %": ("gravity_scale",),
    "10 times the noise": (),
    "rates clipped at 0.2 rad/s": ("clipped",),
    "shocks of 100 m/s2, 8 rad/s": ("shocks",),
    "vibration 1 m/s2, 0.05 rad/s": ("noise_told_small",),
    "one gyro stuck for 40 s": ("stuck_axis",),
    "holes of 1.6 s, dropped": ("imu_gaps",),
    "holes of 1.6 s, bridged by lines": ("bridged_samples",),
    "holes of 1.6 s, last sample repeated": ("repeated_samples",),
    "stamps jittered by 1 ms, late by 0 ms": ("stamp_jitter",),
    "stamps in bursts of 4": ("stamp_bursts",),
    "IMU yaw 5 deg off": ("mounting_yaw",),
    "IMU yaw 90 deg off": ("mounting_yaw",),
    "lever arm 1.5 m off in x": ("filter: antenna",),
    "heading given 120 deg wrong": ("filter: heading",),
    "positions stamped 0.25 s late": ("position_late",),
    "velocities stamped 0.13 s late": ("velocity_late",),
    "lasting errors 1.5 m, 60 s": ("lasting_errors",),
    "steps of 15 m, 20 s every minute": ("position_steps",),
    "drawn away by 0.5 m/s, velocity true": ("position_drawn_away", "position_steps"),
    "frozen coordinates for 40 s": ("frozen_fixes",),
}
"""Findings by which a fault of `faults.py` counts as named; "filter: WORD": a sentence of the monitors with it."""

FAULTS = tuple(fault for fault in all_faults() if fault.name in NAMES)
"""A part of the closed list of faults."""

SEVERITIES = {Severity.NOTE: "note", Severity.WARNING: "warning", Severity.ERROR: "error"}


@dataclass(frozen=True)
class MessageFault:
    """A fault of the messages of a topic, the findings that name it, and options of the simulation."""

    name: str
    names: tuple[str, ...]
    topic: str = ""
    change: Change | None = None
    options: dict[str, Any] = field(default_factory=dict)


def matrix(field_names: tuple[str, ...], rows: tuple[tuple[float, ...], ...]) -> Change:
    """Vectors of these fields are multiplied by a matrix."""

    def change(messages: Messages, log_time: NDArray[np.int64], _: np.random.Generator) -> Any:
        for name in field_names:
            messages[name] = messages[name] @ np.array(rows).T
        return messages, log_time

    return change


def filled(begin: float, end: float, **values: float) -> Change:
    """Fields take these values in a part of the drive (s)."""

    def change(messages: Messages, log_time: NDArray[np.int64], _: np.random.Generator) -> Any:
        seconds = (messages["stamp"] - messages["stamp"][0]) * 1e-9
        for name, value in values.items():
            messages[name][(seconds >= begin) & (seconds < end)] = value
        return messages, log_time

    return change


def later(seconds: float, begin: float = 0.0) -> Change:
    """Stamps are later by so much (s), from ``begin`` on; log times are not."""

    def change(messages: Messages, log_time: NDArray[np.int64], _: np.random.Generator) -> Any:
        after = (messages["stamp"] - messages["stamp"][0]) * 1e-9 >= begin
        messages["stamp"][after] += round(seconds * 1e9)
        return messages, log_time

    return change


def sent_again(messages: Messages, log_time: NDArray[np.int64], _: np.random.Generator) -> Any:
    """A receiver of 1 Hz whose driver sends at 5 Hz with fresh stamps."""
    source = np.arange(len(messages)) // 5 * 5
    for name in ("latitude", "longitude", "altitude"):
        messages[name] = messages[name][source]
    return messages, log_time


def whole_seconds(messages: Messages, log_time: NDArray[np.int64], _: np.random.Generator) -> Any:
    """Stamps are cut to whole seconds."""
    messages["stamp"] = messages["stamp"] // 10**9 * 10**9
    return messages, log_time


def thinned(messages: Messages, log_time: NDArray[np.int64], _: np.random.Generator) -> Any:
    """One sample in twenty."""
    return messages[::20], log_time[::20]


def scattered(messages: Messages, log_time: NDArray[np.int64], rng: np.random.Generator) -> Any:
    """Fixes scatter by 5 m more than they claim."""
    for name in ("latitude", "longitude"):
        messages[name] += 5.0 / 111e3 * rng.normal(size=len(messages))
    return messages, log_time


FORCE, TURN, BOTH = ("linear_acceleration",), ("angular_velocity",), ("linear_acceleration", "angular_velocity")
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
IMU, FIX, VELOCITY = "imu/data", "gps/fix", "gps/vel"


def times(factor: float) -> tuple[tuple[float, ...], ...]:
    """A multiple of the unit matrix."""
    return tuple(tuple(factor * value for value in row) for row in EYE)


MESSAGE_FAULTS = (
    MessageFault("gravity removed", ("gravity_removed",), options={"gravity_removed": True}),
    MessageFault("force in g", ("units_of_g",), IMU, matrix(FORCE, times(1.0 / STANDARD_GRAVITY))),
    MessageFault("rates in deg/s", ("degrees_per_second",), IMU, matrix(TURN, times(math.degrees(1.0)))),
    MessageFault("IMU upside down", ("not_upright",), IMU, matrix(BOTH, ((1, 0, 0), (0, -1, 0), (0, 0, -1)))),
    MessageFault("IMU on its side", ("not_upright",), IMU, matrix(BOTH, ((1, 0, 0), (0, 0, 1), (0, -1, 0)))),
    MessageFault("gyro z negated", ("gyro_axes",), IMU, matrix(TURN, ((1, 0, 0), (0, 1, 0), (0, 0, -1)))),
    MessageFault("gyro axes swapped y, z", ("gyro_axes",), IMU, matrix(TURN, ((1, 0, 0), (0, 0, 1), (0, 1, 0)))),
    MessageFault(
        "force x and y swapped", ("accelerometer_axes",), IMU, matrix(FORCE, ((0, 1, 0), (1, 0, 0), (0, 0, 1)))
    ),
    MessageFault("force y negated", ("accelerometer_axes",), IMU, matrix(FORCE, ((1, 0, 0), (0, -1, 0), (0, 0, 1)))),
    MessageFault("IMU of 5 Hz", ("imu_rate",), IMU, thinned),
    MessageFault("IMU clock set back by 2 s", ("clock_set_back", "clock_jump"), IMU, later(-2.0, BEGIN)),
    MessageFault("IMU clock set on by 2 s", ("clock_jump",), IMU, later(2.0, BEGIN)),
    MessageFault("IMU clock 1.2 s late", ("clocks_apart",), IMU, later(1.2)),
    MessageFault("GNSS stamps 4295 s ahead", ("clocks_apart",), FIX, later(4295.0)),
    MessageFault("fixes (0, 0) for 15 s", ("unfilled_fixes",), FIX, filled(0.0, 15.0, latitude=0.0, longitude=0.0)),
    MessageFault("never a fix", ("never_a_fix",), FIX, filled(0.0, math.inf, status=-1)),
    MessageFault("altitude NaN", ("no_altitude",), FIX, filled(0.0, math.inf, altitude=math.nan)),
    MessageFault("covariance zero", ("no_covariance",), FIX, filled(0.0, math.inf, position_covariance=0.0)),
    MessageFault("covariance negative", ("bad_covariance",), FIX, filled(0.0, math.inf, position_covariance=-2.0)),
    MessageFault("fixes sent again at 5 Hz", ("fixes_sent_again",), FIX, sent_again),
    MessageFault("fixes with whole seconds", ("equal_stamps",), FIX, whole_seconds),
    MessageFault("fixes scatter by 5 m, claim 1 m", ("claims_too_little",), FIX, scattered),
    MessageFault(
        "velocity North-East-Down",
        ("velocity_axes",),
        VELOCITY,
        matrix(("linear_velocity",), ((0, 1, 0), (1, 0, 0), (0, 0, -1))),
    ),
    MessageFault("velocity in knots", ("velocity_axes",), VELOCITY, matrix(("linear_velocity",), times(1.944))),
)


def write_bag(path: Path, recording: Recording, fault: MessageFault | None, seed: int) -> None:
    """Write a drive, its messages changed by a fault."""
    rng = np.random.default_rng(20_000 + seed)
    with BagWriter(path, "none") as writer:
        for topic in topics_of(recording):
            messages, log_time = topic.messages(slice(None)), topic.arrival
            if topic.name == "truth":
                continue
            if fault is not None and fault.topic == topic.name and fault.change is not None:
                messages, log_time = fault.change(messages.copy(), log_time.copy(), rng)
            order = np.argsort(log_time, kind="stable")
            writer.write(writer.add_topic(topic.name, topic.type_name), log_time[order], messages[order], STRINGS)


def examined(fault: Fault | MessageFault, seed: int, runs_filter: bool) -> list[Finding]:
    """The findings on one drive with a fault."""
    if isinstance(fault, Fault):
        recording, message_fault = recording_of(fault, seed), None
        parameters = parameters_of(fault, recording, is_told=False)
    else:
        recording, message_fault = simulate("drive", seed, imu_rate=RATE, stop=STOP, **fault.options), fault
        parameters = parameters_of(FAULTS[0], recording, is_told=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag.mcap"
        write_bag(path, recording, message_fault, seed)
        return list(check(path, from_mapping(parameters), runs_filter).findings)


def names(finding: Finding, expected: tuple[str, ...]) -> bool:
    """Whether a finding is one of the expected ones."""
    words = [name.removeprefix("filter: ") for name in expected if name.startswith("filter: ")]
    return finding.name in expected or (finding.name == "filter" and any(word in finding.text for word in words))


def row_of(fault: Fault | MessageFault, runs: list[list[Finding]]) -> list[str]:
    """One row of the table."""
    expected = NAMES.get(fault.name, ()) if isinstance(fault, Fault) else fault.names
    named, severities = 0, Counter[str]()
    others = Counter[str]()
    for findings in runs:
        right = [finding for finding in findings if names(finding, expected)]
        named += bool(right)
        severities.update({SEVERITIES[max(finding.severity for finding in right)]} if right else ())
        others.update({f.name for f in findings if f.severity >= Severity.WARNING and not names(f, expected)})
    told = ", ".join(f"{name} {count}" for name, count in others.most_common()) or "-"
    severity = severities.most_common(1)[0][0] if severities else "-"
    share = f"{named} of {len(runs)}" if expected else "-"
    return [fault.name, ", ".join(expected) or "nothing", share, severity, told]


HEADINGS = ("fault", "finding", "named in", "severity", "other warnings and errors, in how many runs")


def main() -> int:
    """Print the table, and write it where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", metavar="WORD", help="faults with this word in their name")
    parser.add_argument("--no-filter", action="store_true", help="without the replay")
    parser.add_argument("--verbose", action="store_true", help="print the warnings and errors of every run")
    parser.add_argument("--out", type=Path, metavar="FILE", help="put the table at the end of this document")
    options = parser.parse_args()
    rows = []
    for fault in track([f for f in (*FAULTS, *MESSAGE_FAULTS) if options.only in f.name], "faults"):
        runs = [examined(fault, seed, not options.no_filter) for seed in range(options.seeds)]
        rows.append(row_of(fault, runs))
        for findings in runs if options.verbose else ():
            for finding in findings:
                if finding.severity >= Severity.WARNING:
                    print(f"{fault.name}: {finding.severity.name} {finding.name}: {finding.text}: {finding.remedy}")
    text = table(HEADINGS, rows)
    print(text)
    if options.out is not None:
        head, _, _ = options.out.read_text(encoding="utf-8").partition("| fault |")
        options.out.write_text(head + text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
