"""A finding: what is wrong or odd with a topic, by how much, and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any


class Severity(IntEnum):
    """How much a finding matters: ERROR breaks navigation, WARNING makes it worse, NOTE is worth knowing."""

    NOTE = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True)
class Finding:
    """One finding. ``name`` is the same for every finding of its kind, ``topic`` empty for the whole recording.

    ``evidence``: the numbers it rests on, by a name with the unit. ``remedy``: what to do; empty for a mere fact.
    ``parameters``: values by dotted name that follow from it, for a first parameter file.
    """

    severity: Severity
    name: str
    topic: str
    text: str
    remedy: str = ""
    evidence: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "severity": self.severity.name.lower(),
            "name": self.name,
            "topic": self.topic,
            "text": self.text,
            "remedy": self.remedy,
            "evidence": dict(self.evidence),
            "parameters": {name: list(v) if isinstance(v, tuple) else v for name, v in self.parameters.items()},
        }
