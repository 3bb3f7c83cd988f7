"""Profiles: parameter files for kinds of robots, `config/profiles/NAME.yaml`."""

from __future__ import annotations

from pathlib import Path

from eskf_ros.parameters.schema import ParameterError

_PLACES = ("config/profiles", "share/eskf_ros/config/profiles")
"""In a checkout; below the prefix of an installation by pip, colcon or a Debian package."""


def profiles() -> dict[str, Path]:
    """Return the file of each profile by its name; empty where they are not installed."""
    package = Path(__file__).resolve().parents[1]
    folders = [parent / place for parent in package.parents for place in _PLACES]
    found = next((folder for folder in folders if folder.is_dir()), None)
    return {} if found is None else {path.stem: path for path in sorted(found.glob("*.yaml"))}


def profile_path(name: str) -> Path:
    """Return the parameter file of a profile; raises ParameterError that names those there are."""
    there = profiles()
    if name not in there:
        names = ", ".join(there) or "none is installed"
        raise ParameterError(f"profile {name}", [f"there is no such profile; there are {names}"])
    return there[name]
