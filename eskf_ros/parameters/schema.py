"""Definition of a parameter: default, unit, description, limits. Groups of parameters are dataclasses of these."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

Value = float | int | bool | str | tuple[float, ...]


class ParameterError(ValueError):
    """A parameter file or mapping cannot be used; `problems` holds one complete sentence per mistake."""

    def __init__(self, source: str, problems: list[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(f"{source}: {problem}" for problem in problems))


@dataclass(frozen=True)
class Rule:
    """Limits and description of one parameter; kept as the metadata of its dataclass field.

    `minimum` and `maximum` are inclusive, `above` and `below` are exclusive bounds. For lists a tuple gives one bound
    per element. `lengths` are the allowed numbers of elements. `pattern` is a regular expression for strings, explained
    by `pattern_text`. `live` parameters may change while the node runs, all others are read-only.
    """

    default: Value
    unit: str
    description: str
    minimum: float | tuple[float, ...] | None = None
    maximum: float | tuple[float, ...] | None = None
    above: float | None = None
    below: float | None = None
    lengths: tuple[int, ...] = ()
    pattern: str = ""
    pattern_text: str = ""
    nan_allowed: bool = False
    live: bool = False


def parameter(default: Value, unit: str, description: str, **limits: Any) -> Any:
    """Return a dataclass field with a `Rule`; a tuple must have the length of the default unless `lengths` is given."""
    if isinstance(default, tuple) and "lengths" not in limits:
        limits["lengths"] = (len(default),)
    return dataclasses.field(default=default, metadata={"rule": Rule(default, unit, description, **limits)})


def group_of(group: type, description: str) -> Any:
    """Return a dataclass field that holds a group of parameters."""
    return dataclasses.field(default_factory=group, metadata={"group": group, "description": description})


def choice(default: str, description: str, *others: str) -> Any:
    """Return a dataclass field for one of several words; the first is the default."""
    words = (default, *others)
    return parameter(default, "", description, pattern="|".join(words), pattern_text=" or ".join(words))


FRAME_NAME = {"pattern": r"[^/\s]\S*", "pattern_text": "a frame name without blanks and without a leading slash"}
"""Limits of a parameter that names a frame."""

TOPIC_NAME = {
    "pattern": r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*",
    "pattern_text": "a ROS topic name like imu/data or /robot/imu",
}
"""Limits of a parameter that names a topic."""

TIME_OFFSET = {"minimum": -1.0e7, "maximum": 1.0e7}
"""Limits of a time offset (s): a counter of milliseconds in 32 bits overflows after 4294967 s, and it may make up for
that.
"""

TYPE_OF_TOPIC = (
    "Message type of this topic, where the driver publishes another one. The replay takes what was recorded."
)
"""Description of the parameters ``topics.NAME_type``."""


@dataclass(frozen=True)
class Aid:
    """Parameters that every sensor has: the fields of its group begin with these."""

    use: bool = parameter(True, "", "Fuse the messages of this topic.", live=True)
    time_offset: float = parameter(0.0, "s", "Added to the stamps: true time = stamp + offset.", **TIME_OFFSET)
    covariance_scale: float = parameter(
        1.0,
        "",
        "Factor on the covariances (variances) that the messages carry; the floors apply after it.",
        above=0.0,
        maximum=1.0e6,
        live=True,
    )
    gate_probability: float = parameter(
        0.999, "", "Chi-square gate: the share of good measurements that passes.", above=0.0, below=1.0, live=True
    )
