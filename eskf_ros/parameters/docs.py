"""`config/eskf.yaml` and `docs/parameters.md`, generated from the parameters."""

from __future__ import annotations

import dataclasses
import math
import sys
import textwrap
from pathlib import Path

from eskf_ros.parameters.mapping import Leaf, leaves, value_of
from eskf_ros.parameters.schema import Value
from eskf_ros.parameters.tree import Parameters


def to_yaml(parameters: Parameters | None = None) -> str:
    """Return a commented ROS parameter file with the given values (default: the text of config/eskf.yaml)."""
    lines = [
        "# Parameters of eskf_ros with their defaults. Copy the file, keep the lines you change.",
        "# Written from eskf_ros/parameters by `python -m eskf_ros.parameters`.",
        "# Write all numbers of a list with a decimal point: ROS refuses [1, 2.5].",
        "/**:",
        "  ros__parameters:",
    ]
    _yaml_group(Parameters, "", parameters or Parameters(), lines)
    return "\n".join(lines) + "\n"


def _yaml_group(group: type, prefix: str, parameters: Parameters, lines: list[str]) -> None:
    indent = " " * (4 + 2 * prefix.count("."))
    for item in dataclasses.fields(group):
        name = prefix + item.name
        if "rule" not in item.metadata:
            lines += ["", f"{indent}# {item.metadata['description']}", f"{indent}{item.name}:"]
            _yaml_group(item.metadata["group"], name + ".", parameters, lines)
            continue
        leaf = Leaf(name, item.metadata["rule"])
        if not prefix:
            lines.append("")
        unit = f" {leaf.rule.unit}" if leaf.rule.unit else ""
        change = "can change while running" if leaf.rule.live else "read at start"
        limits = f"Default {yaml_value(leaf.default)}{unit}; {leaf.allowed()}; {change}."
        for text in (leaf.rule.description, limits):
            lines += textwrap.wrap(text, 116, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
        value = value_of(parameters, name)
        if value == ():
            # ROS makes an empty list a parameter without a type, which no node can declare: write it as a comment.
            lines.append(f"{indent}# {item.name}: {yaml_value((0.0,) * max(leaf.rule.lengths))}")
        else:
            lines.append(f"{indent}{item.name}: {yaml_value(value)}")


def yaml_value(value: Value) -> str:
    """Return a value as a ROS parameter file holds it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, tuple):
        return f"[{', '.join(yaml_value(element) for element in value)}]"
    if isinstance(value, int):
        return str(value)
    if math.isnan(value):
        return ".nan"
    mantissa, exponent_sign, exponent = repr(value).partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{exponent_sign}{exponent}"


def to_markdown() -> str:
    """Return the reference of all parameters, the text of docs/parameters.md."""
    lines = [
        "# Parameters",
        "",
        "Written from `eskf_ros/parameters` by `python -m eskf_ros.parameters`; `config/eskf.yaml` holds the same",
        "as a file to copy. `eskf_replay --config FILE` reads ROS 2 parameter files; an unknown key, a wrong type or a",
        "value outside its range is an error that names it. Live parameters may change while the node runs, the others",
        "are read at start.",
        "",
    ]
    top = [leaf for leaf in leaves() if "." not in leaf.name]
    lines += ["## Top level", "", *_markdown_table(top)]
    for item in dataclasses.fields(Parameters):
        if "rule" not in item.metadata:
            members = [leaf for leaf in leaves() if leaf.name.startswith(item.name + ".")]
            lines += ["", f"## {item.name}", "", item.metadata["description"], "", *_markdown_table(members)]
    return "\n".join(lines) + "\n"


def _markdown_table(members: list[Leaf]) -> list[str]:
    rows = ["| name | default | unit | allowed | live | meaning |", "|---|---|---|---|---|---|"]
    for leaf in members:
        rule = leaf.rule
        live = "yes" if rule.live else "no"
        cells = (f"`{leaf.name}`", f"`{yaml_value(leaf.default)}`", rule.unit, leaf.allowed(), live, rule.description)
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def main() -> int:
    """Write config/eskf.yaml and docs/parameters.md of the checkout with this module; return the exit code."""
    root = Path(__file__).resolve().parents[2]
    if not (root / "setup.py").is_file():
        print(f"{root} is no checkout of eskf_ros: run this where the sources are", file=sys.stderr)
        return 2
    for path, text in ((root / "config" / "eskf.yaml", to_yaml()), (root / "docs" / "parameters.md", to_markdown())):
        path.write_text(text, encoding="utf-8")
        print(f"written: {path}")
    return 0
