"""What the dashboard knows: the last diagnostics of a node, and what it makes of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from eskf_ros.filter.state.enums import STREAM_NAMES

DIAGNOSTICS = "/diagnostics"
QUALITY = "eskf/quality"
"""Its name ends so, in whatever namespace the node is."""

HISTORY = 60
"""Reports that are kept, for the course of the sigmas and the rates of the verdicts: a minute."""

SENSORS = frozenset(STREAM_NAMES) - {"imu"}
"""What has verdicts; the samples of the IMU are counted otherwise."""

LEVELS = ("OK", "WARN", "ERROR", "STALE")


@dataclass(frozen=True)
class Report:
    """One status: ``stamp`` in s, level (index of `LEVELS`), message and values."""

    stamp: float
    name: str
    level: int
    message: str
    values: Mapping[str, str]

    @property
    def node(self) -> str:
        """Name of the node that it is of."""
        return self.name.partition(":")[0]


@dataclass
class Seen:
    """Collects reports of one node: the first that was heard, or the one of this name."""

    node: str = ""
    reports: deque[Report] = field(default_factory=lambda: deque(maxlen=HISTORY))
    quality: Report | None = None

    def note(self, report: Report) -> None:
        """Take a status of /diagnostics or eskf/quality; others are left."""
        if not report.name.endswith((": navigation", ": quality")) or (self.node and report.node != self.node):
            return
        self.node = report.node
        if report.name.endswith(": quality"):
            self.quality = report
        else:
            self.reports.append(report)

    @property
    def state(self) -> str:
        """Name of the state; empty before the first report."""
        return self.reports[-1].message.partition("; ")[0] if self.reports else ""

    @property
    def sentences(self) -> list[str]:
        """What the state waits for, and what is wrong."""
        return self.reports[-1].message.split("; ")[1:] if self.reports else []

    def value(self, key: str) -> str:
        """One value of the last report; empty if it has none."""
        return self.reports[-1].values.get(key, "") if self.reports else ""

    def course(self, key: str) -> list[float]:
        """Return a number of each report, the largest where a value has several; those without it are left out."""
        found = []
        for report in self.reports:
            numbers = [float(word) for word in report.values.get(key, "").split()]
            found += [max(numbers)] if numbers else []
        return found

    def inputs(self) -> list[tuple[str, str, str]]:
        """Return topic, rate (Hz) and delay (s) of each input that had a message."""
        ending = " rate (Hz)"
        names = [key.removesuffix(ending) for key in (self.reports[-1].values if self.reports else {}) if ending in key]
        return [(name, self.value(name + ending), self.value(f"{name} delay (s)")) for name in names]

    def aids(self) -> list[tuple[str, dict[str, int], dict[str, float]]]:
        """Return sensor, counts of its verdicts, and verdicts a second over the reports that are kept."""
        found: dict[str, dict[str, int]] = {}
        for key, value in (self.reports[-1].values if self.reports else {}).items():
            name, _, verdict = key.partition(" ")
            if name in SENSORS and value.isdigit():
                found.setdefault(name, {})[verdict] = int(value)
        return [(name, counts, self._rates(name, counts)) for name, counts in sorted(found.items())]

    def _rates(self, name: str, counts: Mapping[str, int]) -> dict[str, float]:
        first, last = self.reports[0], self.reports[-1]
        elapsed = last.stamp - first.stamp
        if elapsed <= 0.0:
            return {}
        return {
            verdict: (n - int(first.values.get(f"{name} {verdict}", "0"))) / elapsed for verdict, n in counts.items()
        }
