"""Counts of the messages before they enter the timeline, by stream, and the warnings that follow from them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from eskf_ros.filter.history.timeline import EARLY_AIDS
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.time import NEVER, SECOND

DOOR_REMEDIES = {
    Verdict.NON_FINITE: "carry numbers that are not finite: what does the driver write where it knows nothing?",
    Verdict.BAD_COVARIANCE: "have a covariance that is not positive definite: variances must be positive (all zero "
    "stands for unknown), covariances smaller",
    Verdict.BAD_VALUE: "carry values that cannot be true: look at units and fields",
}
"""Warnings for streams whose messages are mostly refused for their contents, by verdict."""

FEWEST_REFUSED = 10
"""Messages of a stream refused for their contents from which on the warning appears."""


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
    without_altitude: int = 0
    """Fixes whose altitude is not a number."""
    field_problem: str = ""
    """Why the Earth's magnetic field is unknown; empty while it is not."""

    def note_refused(self, stream: Stream, stamp: int, frontier: int) -> None:
        """Count a message with a stamp (ns) that the timeline refused; ``frontier``: the newest IMU stamp."""
        if frontier != NEVER:
            self.refused[stream] += 1
            self.stamp_difference[stream] = (stamp - frontier) / SECOND

    def complaints(self) -> list[str]:
        """Return one sentence for each faulty stream, with what to do; empty without faults."""
        found = [self.field_problem] if self.field_problem else []
        for (stream, verdict), count in self.shut_doors.items():
            offered = self.offered[stream]
            if verdict in DOOR_REMEDIES and count >= FEWEST_REFUSED and 2 * count > offered:
                found.append(f"{count} of {offered} messages of {stream.name.lower()} {DOOR_REMEDIES[verdict]}")
        for stream, count in self.early.items():
            found.append(
                f"{count} measurements of {stream.name.lower()} were dropped because more than {EARLY_AIDS} waited for "
                "the first IMU sample: push measurements and IMU samples in the order of their stamps, or "
                "look why the IMU is silent"
            )
        for stream, difference in self.stamp_difference.items():
            if 2 * self.refused[stream] > self.offered[stream]:
                found.append(
                    f"the stamps of {stream.name.lower()} are {abs(difference):.1f} s "
                    f"{'ahead of' if difference > 0.0 else 'behind'} the IMU's: synchronise the clocks, or set the "
                    "time_offset of the stream"
                )
        return found

    def notes(self) -> list[str]:
        """Return one sentence for each fact worth knowing of the streams though nothing is wrong."""
        found = []
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
