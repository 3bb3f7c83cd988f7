"""Fingerprints: whether a result is still that of this recording, this configuration and this version."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from eskf_ros.compiled import Digests

_DIGITS = 16


def of_files(paths: Iterable[Path]) -> str:
    """Return the fingerprint of files: their names, sizes and times of change.

    Contents are not read: that would take as long as the work. A file that is missing counts as such.
    """
    digest = hashlib.sha256()
    for path in sorted(paths):
        try:
            status = path.stat()
        except OSError:
            digest.update(f"{path.name}\0missing\0".encode())
        else:
            digest.update(f"{path.name}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()[:_DIGITS]


def of_values(values: Mapping[str, Any]) -> str:
    """Return the fingerprint of a configuration: names and values that JSON, or else `str`, can write."""
    text = json.dumps(values, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


@lru_cache(maxsize=1)
def of_version() -> str:
    """Return version and digest of the sources of this package: an edited checkout is another version."""
    import eskf_ros

    return f"{eskf_ros.__version__}+{Digests(Path(eskf_ros.__file__).parent).of_all()}"
