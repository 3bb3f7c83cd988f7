"""Counts of the messages before they enter the timeline, by stream, and the warnings that follow from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from eskf_ros.filter.history.timeline import EARLY_AIDS
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.time import NEVER, SECOND

DOOR_REMEDIES = {
    Verdict.NON_FINITE: "carry numbers that are not finite: what does the driver write where it knows nothing?",
    Verdict.BAD_COVARIANCE: "have a covariance that is not positive definite: variances must be positive (all zero "
    "stands for unknown), covariances smaller",
    Verdict.UNFILLED: "have latitude and longitude zero: the driver publishes before the receiver has a fix; such a "
    "message must say so by its status (-1)",
    Verdict.BAD_VALUE: "carry values that cannot be true: look at units and fields",
}
"""Warnings for streams whose messages are mostly refused for their contents, by verdict."""

FEWEST_REFUSED = 10
"""Messages of a stream refused for their contents from which on the warning appears."""

NOTABLE_SHARE = 0.05
"""Share of the messages of a stream that may be dropped for equal stamps, or come too late, before it is a fault."""

LONGEST_WINDOW = 60.0
"""s; the largest history.window that the parameters allow (`parameters.tree.History`)."""

WRAPS = {
    2**32 / 1e6: "2^32 microseconds",
    2**32 / 1e3: "2^32 milliseconds",
    2**32 / 1e9: "2^32 nanoseconds",
}
"""Differences (s) of clocks that tell of a counter of 32 bits that overflowed in a driver."""

LARGEST_OFFSET = 1e7
"""s; the largest time_offset that the parameters allow (`parameters.schema.TIME_OFFSET`)."""


@dataclass
class Traffic:
    """Counts, by stream, of the messages that a filter was offered since its start."""

    offered: Counter[Stream] = field(default_factory=Counter)
    refused: Counter[Stream] = field(default_factory=Counter)
    """Messages that never entered the timeline because of their stamp."""
    shut_doors: Counter[tuple[Stream, Verdict]] = field(default_factory=Counter)
    """Messages refused for their contents, by stream and verdict."""
    early: Counter[Stream] = field(default_factory=Counter)
    """Messages dropped because too many were already waiting for the first IMU sample."""
    stamp_difference: dict[Stream, float] = field(default_factory=dict)
    """Stamp of the last refused message minus that of the newest IMU sample (s)."""
    stand_ins: int = 0
    """Messages that came without a covariance."""
    duplicates: Counter[Stream] = field(default_factory=Counter)
    """Measurements that were not used because an earlier one of the same source had the same stamp."""
    whole_seconds: Counter[Stream] = field(default_factory=Counter)
    """Those of them whose stamps are whole seconds."""
    lacking: Counter[tuple[Stream, int]] = field(default_factory=Counter)
    """Messages without a measured axis (negative or not a number as variance, or a huge one), by stream and axis."""
    without_altitude: int = 0
    """Fixes whose altitude is not a number."""
    field_problem: str = ""
    """Why the Earth's magnetic field is unknown; empty while it is not."""

    def note_refused(self, stream: Stream, stamp: int, frontier: int) -> None:
        """Count a message with a stamp (ns) that the timeline refused; ``frontier``: the newest IMU stamp."""
        if frontier != NEVER:
            self.refused[stream] += 1
            self.stamp_difference[stream] = (stamp - frontier) / SECOND

    def note_final(self, records: np.ndarray) -> None:
        """Count the duplicates among final records (RECORD)."""
        doubled = records[records["verdict"] == Verdict.DUPLICATE]
        for stream in map(Stream, np.unique(doubled["stream"]).tolist()):
            stamps = doubled["stamp"][doubled["stream"] == stream]
            self.duplicates[stream] += len(stamps)
            self.whole_seconds[stream] += int(np.count_nonzero(stamps % SECOND == 0))

    def complaints(self) -> list[str]:
        """Return one sentence for each faulty stream, with what to do; empty without faults."""
        found = [self.field_problem] if self.field_problem else []
        for (stream, verdict), count in self.shut_doors.items():
            offered = self.offered[stream]
            if verdict in DOOR_REMEDIES and count >= FEWEST_REFUSED and 2 * count > offered:
                found.append(f"{count} of {offered} messages of {stream.name.lower()} {DOOR_REMEDIES[verdict]}")
        for stream, count in self.duplicates.items():
            if is_notable(count, self.offered[stream]):
                found.append(self._of_duplicates(stream))
        for stream, count in self.early.items():
            found.append(
                f"{count} measurements of {stream.name.lower()} were dropped because more than {EARLY_AIDS} waited for "
                "the first IMU sample: push measurements and IMU samples in the order of their stamps, or "
                "look why the IMU is silent"
            )
        for stream, difference in self.stamp_difference.items():
            if 2 * self.refused[stream] > self.offered[stream]:
                found.append(clocks_apart(stream.name.lower(), difference))
        return found

    def _of_duplicates(self, stream: Stream) -> str:
        count, offered = self.duplicates[stream], self.offered[stream]
        cause = "header.stamp must be the instant of each measurement"
        if 2 * self.whole_seconds[stream] > count:
            cause = "the stamps are cut to whole seconds: header.stamp must be the instant of each measurement"
        return (
            f"{count} of {offered} messages of {stream.name.lower()} have the stamp of another one and were dropped: "
            f"{cause}"
        )

    def notes(self) -> list[str]:
        """Return one sentence for each fact worth knowing of the streams though nothing is wrong."""
        found = []
        for (stream, verdict), count in self.shut_doors.items():
            if verdict == Verdict.UNFILLED and 2 * count <= self.offered[stream]:
                found.append(
                    f"{count} of {self.offered[stream]} messages of {stream.name.lower()} were refused as unfilled: "
                    f"they {DOOR_REMEDIES[verdict]}"
                )
        for stream, count in self.duplicates.items():
            if not is_notable(count, self.offered[stream]):
                found.append(self._of_duplicates(stream))
        for (stream, axis), count in sorted(self.lacking.items()):
            found.append(
                f"{count} of {self.offered[stream]} messages of {stream.name.lower()} do not measure {'xyz'[axis]} "
                "(a variance that is negative, huge or not a number says so): that axis was not used"
            )
        if self.without_altitude:
            found.append(
                f"{self.without_altitude} fixes came without an altitude (NaN): they are used horizontally, and the "
                "height is that of the IMU and, if there is one, of the barometer"
            )
        if not self.stand_ins:
            return found
        return [
            *found,
            f"{self.stand_ins} messages came without a covariance (unknown type or all zero): "
            "gnss.status_std_horizontal, gnss.status_std_vertical and the unknown_..._std of the parameters stand in "
            "for it",
        ]


def is_notable(count: int, offered: int) -> bool:
    """Say whether a number of dropped messages is a fault of the stream rather than an exception."""
    return count >= FEWEST_REFUSED and count > NOTABLE_SHARE * offered


def clocks_apart(name: str, difference: float) -> str:
    """Return a sentence on stamps that are ``difference`` (s) ahead of the IMU's, with a remedy that is accepted."""
    size = abs(difference)
    said = f"the stamps of {name} are {size:.1f} s {'ahead of' if difference > 0.0 else 'behind'} the IMU's"
    for wrap, unit in WRAPS.items():
        if abs(size - wrap) < max(0.5, 1e-4 * wrap) and wrap > 10.0:
            sign = "-" if difference > 0.0 else ""
            return (
                f"{said}, which is {unit}: a counter of 32 bits overflows in the driver; mend the driver, or set the "
                f"time_offset of the stream to {sign}{wrap:.6f}"
            )
    if size > LARGEST_OFFSET:
        return f"{said}: they are not on the same clock; set the clocks or mend the driver"
    return f"{said}: synchronise the clocks, or set the time_offset of the stream"


def imu_complaints(counts: Mapping[str, int], window_needed: float) -> list[str]:
    """Return one sentence for each reason for which many IMU samples were dropped; ``counts`` as `imu_counts`."""
    found = []
    offered = counts["offered"]
    if is_notable(counts["duplicate"], offered):
        found.append(
            f"{counts['duplicate']} of {offered} IMU samples have the stamp of another one and were dropped: the "
            "driver must stamp each sample with its own instant, also those that it reads in one go"
        )
    if is_notable(counts["late"], offered):
        remedy = late_remedy(window_needed)
        found.append(f"{counts['late']} of {offered} IMU samples came too late for history.window: {remedy}")
    if is_notable(counts["bad_value"], offered):
        found.append(
            f"{counts['bad_value']} of {offered} IMU samples are not finite, or larger than a strapdown IMU can read"
        )
    if is_notable(counts["bad_stamp"], offered):
        found.append(f"{counts['bad_stamp']} of {offered} IMU samples have stamps that are zero or far from the others")
    return found


def late_remedy(needed: float) -> str:
    """Return what helps against messages that came too late; a history window of ``needed`` (s) would have done."""
    if needed > LONGEST_WINDOW:
        return f"they are up to {needed:.0f} s old, for which no window is meant: look at their stamps"
    return f"a window of {needed:.3f} s would have taken them"
