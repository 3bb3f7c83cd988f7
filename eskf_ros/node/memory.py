"""The file that carries biases, place and heading from one run of the node to the next."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

from eskf_ros.filter.warm_start import Memory

VERSION = 1


def write_memory(path: Path, memory: Memory) -> None:
    """Write the file as a whole or not at all: a robot may lose its power at any moment. Raises OSError."""
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
    """Read the file; None when there is none. Raises ValueError saying what is wrong with it."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    try:
        return _checked(content)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not a warm start file of this version: {error!r}") from error


def _checked(content: dict[str, object]) -> Memory:
    if content.pop("version") != VERSION:
        raise ValueError("another version")
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in content.items()}
    memory = Memory(**values)  # type: ignore[arg-type]
    biases = (memory.accel_bias, memory.accel_bias_std, memory.gyro_bias, memory.gyro_bias_std)
    # What is no number at all makes isfinite raise the TypeError.
    single: list[Any] = [value for value in values.values() if not isinstance(value, tuple)]
    if any(len(bias) != 3 for bias in biases) or not all(math.isfinite(value) for value in [*single, *sum(biases, ())]):
        raise ValueError("not three finite numbers for each bias and one for all else")
    return memory
