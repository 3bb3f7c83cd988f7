"""The warm start file: biases, place and heading from one run of the node to the next."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from eskf_ros.filter.alignment.warm_start import Memory
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.time import SECOND
from eskf_ros.parameters.tree import WarmStart as WarmStartParameters

VERSION = 1
VECTORS = ("accel_bias", "accel_bias_std", "gyro_bias", "gyro_bias_std")
LARGEST_FLOAT = sys.float_info.max


def write_memory(path: Path, memory: Memory) -> None:
    """Write the file completely or not at all: a robot may lose its power at any moment. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump({"version": VERSION, **dataclasses.asdict(memory)}, file, indent=2)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


def read_memory(path: Path) -> Memory | None:
    """Read the file; return None if there is none. Raises ValueError, which says what is wrong with it."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    # JSON with thousands of nested brackets raises RecursionError.
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    try:
        return _checked(content)
    except ValueError as error:
        raise ValueError(f"{path} is not a warm start file of this version: {error}") from error


def _checked(content: object) -> Memory:
    if not isinstance(content, dict):
        raise ValueError("not a JSON object")
    if content.get("version") != VERSION:
        raise ValueError(f"version is {content.get('version')!r}, not {VERSION}")
    wanted = [field.name for field in dataclasses.fields(Memory)]
    missing, unknown = set(wanted) - content.keys(), content.keys() - {"version", *wanted}
    if missing or unknown:
        raise ValueError(f"missing: {sorted(missing)}, unknown: {sorted(unknown)}")
    return Memory(**{name: _value(name, content[name]) for name in wanted})


def _value(name: str, given: object) -> Any:
    if name in VECTORS:
        if not isinstance(given, list) or len(given) != 3 or not all(map(_is_finite, given)):
            raise ValueError(f"{name} is not three finite numbers")
        return tuple(given)
    if not _is_finite(given):
        raise ValueError(f"{name} is not a finite number")
    if name == "stamp" and not isinstance(given, int):
        raise ValueError("stamp is not a whole number")
    return given


def _is_finite(value: object) -> bool:
    """Return whether it is a number that a float can hold: an integer of JSON may be larger, and True is an int."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST_FLOAT <= value <= LARGEST_FLOAT


class WarmStart:
    """The memory of the last run: read at the start, offered at the first IMU sample, written at the end."""

    def __init__(self, parameters: WarmStartParameters, logger: Any) -> None:
        self._parameters, self._logger = parameters, logger
        self._memory: Memory | None = None
        if parameters.file:
            try:
                self._memory = read_memory(Path(parameters.file).expanduser())
            except ValueError as error:
                logger.warn(f"warm_start.file: {error}; starting without it")

    @property
    def is_waiting(self) -> bool:
        """Whether there is a memory that has not been offered yet."""
        return self._memory is not None

    def offer(self, navigator: Navigator, stamp: int) -> None:
        """Offer the memory to the estimator, unless it is too old at the first IMU sample (``stamp``, ns)."""
        assert self._memory is not None
        age = (stamp - self._memory.stamp) / SECOND
        if 0.0 <= age <= self._parameters.max_age:
            navigator.warm_start(self._memory, age)
            self._logger.info(f"warm start from what was known {age:.0f} s ago")
        else:
            self._logger.info(f"the warm start file is {age:.0f} s old and is not used (warm_start.max_age)")
        self._memory = None

    def write(self, navigator: Navigator) -> None:
        """Write the present memory to the file, if there is one."""
        if self._parameters.file and navigator.memory is not None:
            write_memory(Path(self._parameters.file).expanduser(), navigator.memory)
