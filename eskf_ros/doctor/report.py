"""The report of the bag doctor: as text, as JSON, and as a first parameter file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.doctor.sensors import Recording
from eskf_ros.doctor.stamps import timing_of
from eskf_ros.parameters.docs import yaml_value


@dataclass(frozen=True)
class Report:
    """All that was found of a recording.

    ``findings``: the gravest first. ``replay``: what became of the measurements in the estimator; empty if not run.
    """

    recording: Recording
    findings: tuple[Finding, ...]
    replay: dict[str, Any]

    @property
    def exit_code(self) -> int:
        """1 if there is a finding that breaks navigation, else 0."""
        return int(any(finding.severity == Severity.ERROR for finding in self.findings))

    def named(self, name: str) -> list[Finding]:
        """Return the findings of one kind."""
        return [finding for finding in self.findings if finding.name == name]

    def rate(self, topic: str) -> float | None:
        """Return the usual rate (Hz) of the stamps of a topic; None if it was not read or has no different stamps."""
        for sensor in self.recording.sensors.values():
            if sensor.topic == topic:
                stamps = sensor.by_stamp().stamp
                return 1.0 / timing_of(stamps).interval if len(stamps) > 1 else None
        return None

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        topics = [
            {"topic": topic, "type": type_name, "messages": count, "input": name, "rate_hz": self.rate(topic)}
            for topic, (type_name, count, name) in self.recording.topics.items()
        ]
        return {
            "bag": str(self.recording.path),
            "duration_s": self.recording.duration,
            "navigates": self.exit_code == 0,
            "topics": topics,
            "findings": [finding.as_dict() for finding in self.findings],
            "replay": self.replay,
        }

    def show(self, console: Console) -> None:
        """Print two tables: topics, and findings."""
        console.print(f"{self.recording.path}: {self.recording.duration:.1f} s", highlight=False, soft_wrap=True)
        topics = Table("topic", "type", "messages", "Hz", "used as", box=box.SIMPLE_HEAD, pad_edge=False)
        for topic, (type_name, count, name) in self.recording.topics.items():
            rate = self.rate(topic)
            topics.add_row(topic, type_name, str(count), "-" if rate is None else f"{rate:.4g}", name or "-")
        console.print(topics)
        findings = Table("", "topic", "finding", "what to do", box=box.SIMPLE_HEAD, pad_edge=False)
        for finding in self.findings:
            findings.add_row(finding.severity.name.lower(), finding.topic, finding.text, finding.remedy)
        console.print(findings, highlight=False)

    def parameter_file(self) -> str:
        """Return a ROS parameter file with the values that follow from the findings, each with its reason."""
        lines = [f"# A first configuration for {self.recording.path.name}, by eskf_check. Measure what it cannot know:"]
        lines += ["# gnss.lever_arm, imu.mount_position, imu.mount_rpy_deg.", "/**:", "  ros__parameters:"]
        values: dict[str, tuple[Any, str]] = {}
        for finding in reversed(self.findings):
            for name, value in finding.parameters.items():
                values[name] = value, finding.text
        for name, (value, reason) in sorted(values.items()):
            lines += [f"    # {reason}", f"    {name}: {yaml_value(value)}"]
        # Without any, the file still has a section with a parameter in it: that of the mode.
        if not values:
            lines.append(f"    mode: {yaml_value(self.recording.parameters.mode)}")
        return "\n".join(lines) + "\n"
