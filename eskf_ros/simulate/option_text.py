"""Sensors and episodes as they are spelled on the command line: ``wheel:scale_std=0.02,position=0/0.4/0``."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any


def read(text: str, kinds: Mapping[str, type]) -> tuple[str, Any]:
    """Return the kind that ``text`` names and an instance of its dataclass.

    ``text`` is KIND or KIND:KEY=VALUE,...; ``kinds`` are the dataclasses by name. Raises ValueError that says what is
    wrong and what there is.
    """
    kind, _, rest = text.partition(":")
    if kind not in kinds:
        raise ValueError(f"unknown '{kind}' in '{text}'; there are {', '.join(kinds)}")
    values = dict(read_value(part, kinds[kind]) for part in rest.split(",") if part)
    missing = [
        field.name
        for field in dataclasses.fields(kinds[kind])
        if field.default is dataclasses.MISSING and field.name not in values
    ]
    if missing:
        raise ValueError(f"'{text}' lacks {', '.join(missing)}; {kind} is {spelled(kind, kinds[kind])}")
    return kind, kinds[kind](**values)


def read_value(text: str, kind: type) -> tuple[str, Any]:
    """Return the field of dataclass ``kind`` that ``text``, KEY=VALUE, names, and the value in its type.

    Numbers of a list are divided by slashes. Raises ValueError that says what is wrong.
    """
    key, equals, value = text.partition("=")
    fields = _fields(kind)
    if not equals or key not in fields:
        raise ValueError(f"'{text}' must be one of {', '.join(fields)}, then '=' and a value")
    hint = fields[key][1]
    try:
        if hint is bool:
            return key, {"true": True, "false": False}[value]
        if hint in (str, float, int):
            return key, hint(value)
        numbers = tuple(float(number) for number in value.split("/"))
        if len(numbers) != len(typing.get_args(hint)):
            raise ValueError
        return key, numbers
    except (KeyError, ValueError):
        raise ValueError(f"'{text}': {key} takes {_form(hint)}") from None


def values(kind: type) -> list[str]:
    """Return KEY=DEFAULT for the fields of dataclass ``kind`` that can be spelled; what has no default in capitals."""
    return [f"{name}={_shown(field)}" for name, (field, _) in _fields(kind).items()]


def spelled(name: str, kind: type) -> str:
    """Return how an instance of dataclass ``kind`` is spelled with its defaults."""
    return f"{name}:{','.join(values(kind))}"


def _shown(field: dataclasses.Field[Any]) -> str:
    value = field.default
    if value is dataclasses.MISSING or value is None:
        return field.name.upper()
    if isinstance(value, tuple):
        return "/".join(f"{number:g}" for number in value)
    return f"{value:g}" if isinstance(value, float) else str(value).lower()


def _fields(kind: type) -> dict[str, tuple[dataclasses.Field[Any], Any]]:
    """Return the fields that can be spelled, by name, and their types; of a type or None the type counts."""
    hints = typing.get_type_hints(kind)
    fields = {}
    for field in dataclasses.fields(kind):
        others = [hint for hint in typing.get_args(hints[field.name]) if hint is not type(None)]
        hint = others[0] if len(others) == 1 else hints[field.name]
        if hint in (bool, str, float, int) or (typing.get_origin(hint) is tuple and set(others) == {float}):
            fields[field.name] = (field, hint)
    return fields


def _form(hint: Any) -> str:
    if hint is bool:
        return "true or false"
    if hint in (float, int):
        return "a number"
    return f"{len(typing.get_args(hint))} numbers with slashes between them"
