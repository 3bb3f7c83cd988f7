"""Shared by all tests: where real recordings are found, and how hypothesis runs."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

from support.data import find_data_folder

settings.register_profile("developer", deadline=None)
# The same examples in every run: a red build says something about the change, not about luck.
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "developer")


@pytest.fixture(scope="session")
def data_folder() -> Callable[[str], Path]:
    """`data_folder("drive_0708")` is the folder of that real recording; the test is skipped where it is missing."""

    def find_or_skip(name: str) -> Path:
        try:
            return find_data_folder(name)
        except FileNotFoundError as missing:
            pytest.skip(str(missing))

    return find_or_skip
