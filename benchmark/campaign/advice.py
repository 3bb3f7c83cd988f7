"""What a sentence tells the user to do, done."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"

_SET = re.compile(rf"\b([a-z_]+\.[a-z_]+)\b to ({NUMBER})")
_SET_LIST = re.compile(rf"\b([a-z_]+\.[a-z_]+)\b to \[({NUMBER}), ({NUMBER}), ({NUMBER})\]")
_ARM = re.compile(rf"\(({NUMBER}), ({NUMBER}), ({NUMBER})\) m .*?from where ((?:second_)?gnss\.lever_arm) says")


def advice_of(sentences: Iterable[str], parameters: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters that sentences say to set, with their values; ``parameters`` are the present ones.

    Understood are "set GROUP.NAME to NUMBER", the same with three numbers in brackets, and a lever arm that is off by
    a vector.
    """
    found: dict[str, Any] = {}
    for sentence in sentences:
        for name, value in _SET.findall(sentence):
            found[name] = float(value)
        for name, *values in _SET_LIST.findall(sentence):
            found[name] = [float(value) for value in values]
        for *vector, name in _ARM.findall(sentence):
            before = parameters.get(name, (0.0, 0.0, 0.0))
            found[name] = [float(part) + float(off) for part, off in zip(before, vector)]
    return found
