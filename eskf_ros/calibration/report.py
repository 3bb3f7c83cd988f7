"""The calibration as a parameter file, as JSON, and as tables."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from eskf_ros.calibration.findings import LEFT_TO_THE_NODE, Calibration, Finding
from eskf_ros.parameters.docs import yaml_value
from eskf_ros.parameters.mapping import leaves, to_mapping
from eskf_ros.parameters.schema import Value
from eskf_ros.parameters.tree import Parameters

DIGITS = 7
"""Significant digits of a value in the file: a rounding far below every standard deviation."""

COMMENT_WIDTH = 112


def parameter_file(calibration: Calibration) -> str:
    """Return a ROS parameter file: what was configured, and what was found, each with its sigma and evidence."""
    values, defaults = to_mapping(calibration.parameters), to_mapping(Parameters())
    because = {name: f.name for f in calibration.findings if f.is_shown for name in LEFT_TO_THE_NODE.get(f.name, ())}
    by_parameter: dict[str, list[Finding]] = {}
    for finding in calibration.findings:
        by_parameter.setdefault(finding.parameter, []).append(finding)
    lines = [
        f"# By eskf_calibrate from {', '.join(calibration.recordings)}, in {calibration.passes} passes.",
        "/**:",
        "  ros__parameters:",
        f"    mode: {yaml_value(calibration.parameters.mode)}",
    ]
    for leaf in leaves():
        name = leaf.name
        found = by_parameter.get(name, [])
        # As text: a default that is not a number differs from itself.
        is_default = yaml_value(values[name]) == yaml_value(defaults[name])
        if name == "mode" or (is_default and not found):
            continue
        for finding in found:
            lines += _comment(finding)
        if values[name] == () or (is_default and not any(finding.is_shown for finding in found)):
            continue
        if name in because:
            lines.append(f"    # because {because[name]} was found")
        lines.append(f"    {name}: {yaml_value(rounded(values[name]))}")
    return "\n".join(lines) + "\n"


def _comment(finding: Finding) -> list[str]:
    text = f"{finding.name}: {finding.text}"
    return textwrap.wrap(text, COMMENT_WIDTH, initial_indent="    # ", subsequent_indent="    #   ")


def rounded(value: Value) -> Value:
    """Return a number, or a list of numbers, with `DIGITS` significant digits."""
    if isinstance(value, tuple):
        return tuple(float(f"{element:.{DIGITS}g}") for element in value)
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def as_dict(calibration: Calibration) -> dict[str, Any]:
    """Return the content of the JSON file."""
    return {
        "recordings": calibration.recordings,
        "passes": calibration.passes,
        "findings": [finding.as_dict() for finding in calibration.findings],
        "figures": calibration.figures,
        "warnings": calibration.warnings,
    }


def show(calibration: Calibration, console: Console, is_compared: bool = True) -> None:
    """Print the values, why others stay open, and the comparison of before and after."""
    table = Table("", box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("before", "found", "sigma"):
        table.add_column(heading, justify="right")
    table.add_column("unit")
    for finding in calibration.findings:
        shown = (_to_sigma(finding), f"{finding.std:.2g}") if finding.is_shown else ("-", "-")
        table.add_row(finding.name, f"{finding.before:.5g}", *shown, finding.unit)
    console.print(table, highlight=False)
    for finding in calibration.findings:
        if not finding.is_shown:
            console.print(f"{finding.name} {finding.text}", highlight=False)
    if calibration.figures and is_compared:
        console.print(comparison(calibration), highlight=False)


def _to_sigma(finding: Finding) -> str:
    """Return a value with two digits of its standard deviation, and at most five of its own."""
    if not (finding.value and finding.std > 0.0):
        return f"{finding.value:.5g}"
    digits = math.floor(math.log10(abs(finding.value))) - math.floor(math.log10(finding.std)) + 2
    return f"{finding.value:.{min(max(digits, 1), 5)}g}"


def comparison(calibration: Calibration) -> Table:
    """Return the table of NIS, outage ends and NEES before and after."""
    table = Table("recording", "", "before", "after", box=box.SIMPLE_HEAD, pad_edge=False)
    pairs = zip(calibration.recordings, calibration.figures["before"], calibration.figures["after"], strict=True)
    for name, before, after in pairs:
        for label, *cells in comparison_rows(before, after):
            table.add_row(name, label, *cells)
            name = ""
    return table


def comparison_rows(before: dict[str, Any], after: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return label and both values of each figure."""
    rows = [
        (f"NIS of {stream} (1 is right)", _number(before["nis"].get(stream)), _number(after["nis"].get(stream)))
        for stream in {**before["nis"], **after["nis"]}
    ]
    ends = before["outage_ends"], after["outage_ends"]
    if any(ends):
        rows.append((f"ends of {len(ends[1])} outages, m: p50 / p95", _ends(ends[0]), _ends(ends[1])))
    for block in before.get("nees", {}):
        means = [_number(figures["nees"][block]["mean"]) for figures in (before, after)]
        rows.append((f"NEES of {block} (3 is right)", means[0], means[1]))
    return rows


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _ends(errors: Sequence[float]) -> str:
    return " / ".join(f"{value:.2f}" for value in np.percentile(errors, [50, 95])) if errors else "-"
