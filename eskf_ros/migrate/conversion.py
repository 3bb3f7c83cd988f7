"""What a migration gives: our parameters with where each comes from, and what has no counterpart."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from eskf_ros.parameters.docs import yaml_value
from eskf_ros.parameters.mapping import from_mapping, leaves
from eskf_ros.parameters.schema import Value

CONVERTED, BUILT_IN, NONE = "converted", "built in", "none"
"""What becomes of a parameter: it sets one of ours; what it asks for happens without one; there is no counterpart."""


@dataclass(frozen=True)
class Entry:
    """One parameter of the other package; N in its name is a number. ``ours`` names ours, or says what is instead."""

    name: str
    fate: str
    ours: str

    def matches(self, name: str) -> bool:
        """Whether this is the entry of a parameter."""
        return re.fullmatch(re.escape(self.name).replace("N", r"\d+"), name) is not None


Section = tuple[str, Mapping[str, object]]
"""Name of a node, and its parameters by dotted name."""


@dataclass
class Conversion:
    """Collects the parameters and what is to be said of them."""

    source: str
    table: Sequence[Entry]
    values: dict[str, tuple[Value, str]] = field(default_factory=dict)
    """Ours by dotted name: value, and where it comes from."""
    to_check: list[str] = field(default_factory=list)
    fates: dict[str, dict[str, Entry | None]] = field(default_factory=dict)
    """The parameters that were given, by fate; those that nobody knows are under the fate ``none``."""

    def set(self, name: str, value: object, origin: str) -> None:
        """Give one of our parameters a value; ``origin`` says where it is from. Raises ValueError for a bad value."""
        rule = next(leaf for leaf in leaves() if leaf.name == name)
        self.values[name] = rule.convert(value), origin

    def check(self, text: str) -> None:
        """Add a sentence on what a person has to look at; each is said once."""
        if text not in self.to_check:
            self.to_check.append(text)

    def account(self, names: Iterable[str]) -> None:
        """Note what becomes of the parameters of one section."""
        for name in names:
            entry = next((entry for entry in self.table if entry.matches(name)), None)
            self.fates.setdefault(NONE if entry is None else entry.fate, {})[name] = entry

    def report(self) -> list[str]:
        """Return what a person has to know, in lines without an end."""
        lines = ["To check:"] if self.to_check else []
        lines += [f"- {text}" for text in self.to_check]
        gone = self.fates.get(NONE, {})
        lines += ["Without counterpart:"] if gone else []
        said: dict[str, list[str]] = {}
        for name, entry in gone.items():
            said.setdefault("not known here" if entry is None else entry.ours, []).append(name)
        lines += [f"- {', '.join(names)}: {text}" for text, names in said.items()]
        needless = self.fates.get(BUILT_IN, {})
        lines += [f"Needs no parameter: {', '.join(needless)}"] if needless else []
        return lines

    def parameter_file(self) -> str:
        """Return our parameter file: the report as a comment, then each value with where it comes from."""
        from_mapping({name: value for name, (value, _) in self.values.items()}, self.source)
        lines = [f"# Written by eskf_migrate from {self.source}. config/eskf.yaml explains each parameter.", "#"]
        for text in self.report():
            indent = "#   " if text.startswith("- ") else "# "
            lines += textwrap.wrap(text, 116, initial_indent="# ", subsequent_indent=indent, break_on_hyphens=False)
        lines += ["/**:", "  ros__parameters:"]
        group = ""
        for leaf in leaves():
            if leaf.name not in self.values:
                continue
            value, origin = self.values[leaf.name]
            own_group, _, name = leaf.name.rpartition(".")
            if own_group and own_group != group:
                lines.append(f"    {own_group}:")
            group = own_group
            lines.append(f"{'      ' if group else '    '}{name}: {yaml_value(value)}  # {origin}")
        if not self.values:
            lines.append('    mode: "loose"')
        return "\n".join(lines) + "\n"


def markdown_table(table: Sequence[Entry]) -> str:
    """Return a table of docs/migrate.md."""
    words = {CONVERTED: "{}", BUILT_IN: "nothing to set: {}", NONE: "no counterpart: {}"}
    rows = ["| parameter | here |", "|---|---|"]
    rows += [f"| `{entry.name}` | {words[entry.fate].format(entry.ours)} |" for entry in table]
    return "\n".join(rows) + "\n"
