"""Finds recordings in folders."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

SUFFIXES = (".mcap", ".db3")

RESULTS = "_eskf"
"""End of the name of a folder with results, which hold an .mcap file, too."""


@dataclass(frozen=True)
class Found:
    """A recording, and the folder that was given and in which it was found (None: it was given itself)."""

    path: Path
    inside: Path | None

    def _place(self) -> Path:
        """Return where it lies: a link that was found is there itself, one that was given is what it leads to."""
        return self.path.resolve() if self.inside is None else self.path

    @property
    def stem(self) -> str:
        """Name without the suffix of a file."""
        whole = self._place()
        return whole.stem if whole.suffix in SUFFIXES else whole.name

    @property
    def branch(self) -> Path:
        """Folders between the one that was given and this recording."""
        return Path() if self.inside is None else self.path.parent.relative_to(self.inside)

    def results(self, out: Path | None) -> Path:
        """Return the folder of its results: beside it, or below `out` as it lies in the folder that was given."""
        return (self._place().parent if out is None else out / self.branch) / f"{self.stem}{RESULTS}"


def files_of(recording: Path) -> list[Path]:
    """Return the files that a recording consists of."""
    if not recording.is_dir():
        return [recording]
    return sorted(file for file in recording.iterdir() if file.is_file() and not file.name.startswith("."))


def is_recording(path: Path) -> bool:
    """Return whether a path is one recording: a file, a rosbag2 directory, or a folder with nothing but one file.

    An empty folder counts as one, too: whoever reads it has the words for it.
    """
    if not path.is_dir() or _is_rosbag2(path):
        return True
    inside = [entry for entry in path.iterdir() if not _is_left_out(entry)]
    files = [entry for entry in inside if entry.suffix in SUFFIXES]
    return len(files) < 2 and not any(entry.is_dir() for entry in inside)


def _is_rosbag2(folder: Path) -> bool:
    """Return whether a folder is a rosbag2 directory, with or without its metadata.yaml.

    Without (the recorder was killed), its files must be called as the recorder calls them: FOLDER_0.mcap, FOLDER_1.mcap
    """
    if (folder / "metadata.yaml").exists():
        return True
    stems = [file.stem for file in folder.iterdir() if file.suffix in SUFFIXES]
    name = re.escape(folder.resolve().name)
    return bool(stems) and all(re.fullmatch(rf"{name}_\d+", stem) for stem in stems)


def find(paths: Sequence[Path], say: Callable[[str], None] = lambda text: None) -> list[Found]:
    """Return the recordings of all paths, in order of their names; folders are searched to any depth.

    Results of this package, hidden folders and links to folders are passed over. `say` gets a sentence on what was left
    out.
    """
    found: list[Found] = []
    for path in paths:
        if is_recording(path):
            found.append(Found(path, None))
            continue
        inside, old = _search(path)
        found += [Found(place, path) for place in inside]
        if old:
            say(f"{path}: {old} ROS 1 bags are left out (rosbags-convert makes ROS 2 bags of them)")
        if not inside:
            say(f"{path}: there is no recording in it (rosbag2 directory, .mcap or .db3 file)")
    return found


def _search(folder: Path) -> tuple[list[Path], int]:
    """Return the recordings in a folder, and the number of ROS 1 bags."""
    recordings: list[Path] = []
    old = 0
    for entry in sorted(folder.iterdir()):
        if _is_left_out(entry):
            continue
        if entry.is_dir():
            if _is_rosbag2(entry):
                recordings.append(entry)
            else:
                deeper, count = _search(entry)
                recordings += deeper
                old += count
        elif entry.suffix in SUFFIXES:
            recordings.append(entry)
        elif entry.suffix == ".bag":
            old += 1
    return recordings, old


def _is_left_out(entry: Path) -> bool:
    if entry.name.startswith("."):
        return True
    return entry.is_dir() and (entry.name.endswith(RESULTS) or entry.is_symlink())
