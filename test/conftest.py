"""Shared by all tests: where real recordings are found, and how hypothesis runs."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("developer", deadline=None)
# The same examples in every run: a red build says something about the change, not about luck.
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "developer")


def find_data_folder(name: str) -> Path:
    """The folder of the real recording `name`, below $ESKF_DATA or `shared/data` beside or above the checkout.

    Raises FileNotFoundError naming the places looked at.
    """
    configured = os.environ.get("ESKF_DATA")
    parents = Path(__file__).resolve().parents
    places = [Path(configured)] if configured else [parent / "shared" / "data" for parent in parents[1:]]
    for place in places:
        if (place / name).is_dir():
            return place / name
    looked_at = configured or "shared/data in the folders above the checkout"
    raise FileNotFoundError(f"recording {name} not found in {looked_at}; set ESKF_DATA to the folder that holds it")


@pytest.fixture
def data_folder() -> Callable[[str], Path]:
    """`data_folder("drive_0708")` is the folder of that real recording; the test is skipped where it is missing."""

    def find_or_skip(name: str) -> Path:
        try:
            return find_data_folder(name)
        except FileNotFoundError as missing:
            pytest.skip(str(missing))

    return find_or_skip
