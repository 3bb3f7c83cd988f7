"""Parameters from mappings of names and values and back; every mistake is reported as a sentence."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from eskf_ros.parameters.schema import ParameterError, Rule, Value
from eskf_ros.parameters.tree import Parameters


@dataclass(frozen=True)
class Leaf:
    """One parameter: its dotted name and its rule."""

    name: str
    rule: Rule

    @property
    def default(self) -> Value:
        return self.rule.default

    @property
    def kind(self) -> str:
        """One of float, integer, bool, string, float list."""
        kinds = {bool: "bool", int: "integer", str: "string", tuple: "float list"}
        return kinds.get(type(self.default), "float")

    def allowed(self) -> str:
        """Return the allowed values of this parameter in words, for errors and the documentation."""
        rule = self.rule
        if self.kind == "bool":
            return "true or false"
        if self.kind == "string":
            return rule.pattern_text
        if isinstance(rule.minimum, tuple) and isinstance(rule.maximum, tuple):
            bounds = ", ".join(f"{low:g} to {high:g}" for low, high in zip(rule.minimum, rule.maximum))
        elif rule.above is not None and rule.below is not None:
            bounds = f"above {rule.above:g} and below {rule.below:g}"
        elif rule.above is not None:
            bounds = f"above {rule.above:g}, at most {rule.maximum:g}"
        else:
            bounds = f"{rule.minimum:g} to {rule.maximum:g}"
        if self.kind == "float list":
            counts = " or ".join("no" if count == 0 else str(count) for count in rule.lengths)
            return f"{counts} numbers, {'in turn' if isinstance(rule.minimum, tuple) else 'each'} {bounds}"
        noun = "a whole number" if self.kind == "integer" else "a number"
        return f"{noun} {bounds}{' or .nan' if rule.nan_allowed else ''}"

    def convert(self, value: object) -> Value:
        """Return the checked value in the type of this parameter; integers become floats if a float is expected.

        Raises ValueError naming the key, the value and what is allowed.
        """
        converted = self._converted(value)
        if converted is None:
            unit = f" [{self.rule.unit}]" if self.rule.unit else ""
            shown = "an empty value" if value is None else repr(list(value) if isinstance(value, tuple) else value)
            raise ValueError(f"{self.name}: {shown} is not allowed here, it takes {self.allowed()}{unit}")
        return converted

    def _converted(self, value: object) -> Value | None:
        if self.kind == "bool":
            return value if isinstance(value, bool) else None
        if self.kind == "string":
            return value if isinstance(value, str) and re.fullmatch(self.rule.pattern, value) else None
        if self.kind == "integer":
            return value if isinstance(value, int) and self._number(value, 0) is not None else None
        if self.kind == "float":
            return self._number(value, 0)
        # numpy arrays and array.array (what rclpy hands out) are lists here too.
        elements = value.tolist() if hasattr(value, "tolist") else value
        if not isinstance(elements, (list, tuple)) or len(elements) not in self.rule.lengths:
            return None
        numbers = [self._number(element, index) for index, element in enumerate(elements)]
        return None if None in numbers else tuple(number for number in numbers if number is not None)

    def _number(self, value: object, index: int) -> float | None:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        if value != value:  # NaN; math.isnan fails for integers beyond the range of floats
            # Always the same NaN object, so that equal parameters have equal `to_mapping`.
            return math.nan if self.rule.nan_allowed else None
        rule = self.rule
        minimum = rule.minimum[index] if isinstance(rule.minimum, tuple) else rule.minimum
        maximum = rule.maximum[index] if isinstance(rule.maximum, tuple) else rule.maximum
        inside = (
            (minimum is None or value >= minimum)
            and (maximum is None or value <= maximum)
            and (rule.above is None or value > rule.above)
            and (rule.below is None or value < rule.below)
        )
        return float(value) if inside else None


def leaves() -> tuple[Leaf, ...]:
    """Return all parameters in the order of the file."""
    return tuple(_leaves(Parameters, ""))


def _leaves(group: type, prefix: str) -> Iterator[Leaf]:
    for item in dataclasses.fields(group):
        if "rule" in item.metadata:
            yield Leaf(prefix + item.name, item.metadata["rule"])
        else:
            yield from _leaves(item.metadata["group"], prefix + item.name + ".")


def to_mapping(parameters: Parameters) -> dict[str, Value]:
    """Return the value of every parameter by dotted name."""
    return {leaf.name: value_of(parameters, leaf.name) for leaf in leaves()}


def value_of(parameters: Parameters, name: str) -> Any:
    """Return the value of the parameter with a dotted name."""
    value: Any = parameters
    for part in name.split("."):
        value = getattr(value, part)
    return value


def from_mapping(mapping: Mapping[str, object], source: str = "parameters") -> Parameters:
    """Return the parameters of nested mappings or dotted keys (or both mixed); missing ones keep their defaults.

    `source` is named in errors, usually the file. Raises ParameterError listing every unknown key, wrong type and value
    outside its range.
    """
    known = {leaf.name: leaf for leaf in leaves()}
    problems: list[str] = []
    values: dict[str, Value] = {}
    for name, raw in flat(mapping, source).items():
        if name in known:
            try:
                values[name] = known[name].convert(raw)
            except ValueError as error:
                problems.append(str(error))
        elif not _belongs_to_every_node(name):
            problems.append(_unknown(name, raw, list(known)))
    if problems:
        raise ParameterError(source, problems)
    parameters: Parameters = _build(Parameters, "", values)
    return parameters


def flat(mapping: Mapping[str, object], source: str) -> dict[str, object]:
    """Return values by dotted name; raises ParameterError if one is given twice."""
    values: dict[str, object] = {}
    problems: list[str] = []
    for name, value in _flatten(mapping, ""):
        if name in values:
            problems.append(f"{name}: given twice, as {values[name]!r} and as {value!r}; keep one of them")
        values[name] = value
    if problems:
        raise ParameterError(source, problems)
    return values


def _flatten(mapping: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    for key, value in mapping.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _belongs_to_every_node(name: str) -> bool:
    return name in ("use_sim_time", "start_type_description_service") or name.startswith("qos_overrides.")


def _unknown(name: str, value: object, known: list[str]) -> str:
    members = [other for other in known if other.startswith(name + ".")]
    if members:
        return f"{name}: {value!r} given, but {name} is a group; its parameters are {', '.join(members)}"
    # A key in the wrong group is as frequent as a typing error.
    same_tail = [other for other in known if other.rpartition(".")[2] == name.rpartition(".")[2]]
    closest = difflib.get_close_matches(name, known, n=1) or same_tail
    hint = f"did you mean {closest[0]}?" if closest else "docs/parameters.md lists all parameters"
    return f"{name}: unknown parameter (value {value!r}); {hint}"


def _build(group: type, prefix: str, values: Mapping[str, Value]) -> Any:
    arguments: dict[str, Any] = {}
    for item in dataclasses.fields(group):
        name = prefix + item.name
        if "rule" not in item.metadata:
            arguments[item.name] = _build(item.metadata["group"], name + ".", values)
        elif name in values:
            arguments[item.name] = values[name]
    return group(**arguments)
