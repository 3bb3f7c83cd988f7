"""Where the real recordings are found."""

from __future__ import annotations

import os
from pathlib import Path


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
