"""What the estimator itself finds: a replay of the recording with the topics that were found."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.doctor.sensors import Recording
from eskf_ros.filter.state.enums import Status
from eskf_ros.replay.run import Options, replay
from eskf_ros.replay.topics import InputError


def filter_findings(
    recording: Recording, known: Sequence[Finding], progress: Callable[[float], None]
) -> tuple[list[Finding], dict[str, Any]]:
    """Replay the recording; return the findings of the monitors, and what became of the measurements.

    What the monitors say rests on a model that the ``known`` findings contradict, if there are warnings among them:
    then it is told as a note.
    """
    with tempfile.TemporaryDirectory(prefix="eskf_check-") as folder:
        options = Options(Path(folder) / "results", output_rate=1.0)
        try:
            summary = replay(recording.path, recording.parameters, options, progress)
        except InputError as error:
            return [Finding(Severity.ERROR, "cannot_be_replayed", "", str(error))], {}
    is_explained = any(finding.severity >= Severity.WARNING for finding in known)
    said = [line for line in summary["warnings"] if str(recording.path) not in line and "no GNSS velocity" not in line]
    severity = Severity.NOTE if is_explained else Severity.WARNING
    # What is noted of streams, though nothing is wrong, stands among the warnings.
    facts = (" came without ", " has no messages; ")
    found = [_finding(line, Severity.NOTE if any(fact in line for fact in facts) else severity) for line in said]
    status = Status[summary["final"]["status"]]
    if summary["final"]["position"] is None:
        text = f"the estimator found no position; it ends in {status.name}"
        found.append(Finding(Severity.ERROR, "no_position", "", text, "see the findings on the IMU and the fixes"))
    elif status == Status.WAITING_HEADING:
        remedy = "speed up, brake and turn; or use a dual antenna, mag.use, or alignment.initial_heading_deg"
        found.append(Finding(Severity.WARNING, "heading_unknown", "", "the heading is unknown to the end", remedy))
    if summary["restarts"]:
        text = f"the alignment had to start again {summary['restarts']} times"
        found.append(Finding(Severity.ERROR, "restarts", "", text, "", {"restarts": summary["restarts"]}))
    return found, {"status": status.name, "aids": summary["aids"], "position_resets": summary["position_resets"]}


def _finding(sentence: str, severity: Severity) -> Finding:
    """Return a sentence of the monitors as a finding: what comes after the last colon is what to do."""
    text, _, remedy = sentence.rpartition(": ")
    return Finding(severity, "filter", "", text or sentence, remedy if text else "")
