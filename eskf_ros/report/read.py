"""Reading of results: the folder of a replay, or a trajectory of another program in a TUM file."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import BagError, open_bag
from eskf_ros.geodesy.map_frame import MapFrame

Array = NDArray[np.float64]

SUMMARY, ODOMETRY, AIDS, DETAILS = "summary.json", "odometry.mcap", "aids.csv", "details.npz"
TRAJECTORY = "trajectory.tum"
SMOOTHED = "trajectory_smoothed.tum"
ODOMETRY_TOPIC = "/odometry/global"
BLOCK = 1 << 23
"""Bytes of aids.csv that are parsed at once."""

AID = np.dtype(
    [
        ("stamp", "f8"),
        ("arrival", "f8"),
        ("aid", "S16"),
        ("innovation", "f8", (3,)),
        ("nis", "f8"),
        ("dof", "i4"),
        ("verdict", "S20"),
        ("source", "S12"),
    ]
)
"""One row of aids.csv; stamps in s, to a microsecond."""


class ReportError(Exception):
    """A result cannot be shown; the text is one line for the user."""


@dataclass
class Track:
    """A trajectory in a map frame: stamps (n,) s, position (n, 3) m, roll, pitch and yaw (n, 3) deg."""

    name: str
    stamp: Array
    position: Array
    angles_deg: Array


@dataclass
class Result(Track):
    """A replay: its trajectory with velocity (n, 3; map, m/s) and standard deviations, and its other files.

    `position_covariance` (n, 3): east-east, east-north, north-north, m2. `velocity_std` (n, 3) is that of the published
    twist, turned into map axes. `details`: arrays of details.npz, none for a result that has no such file.
    """

    folder: Path
    summary: dict[str, Any]
    velocity: Array
    position_std: Array
    position_covariance: Array
    velocity_std: Array
    angles_std_deg: Array
    aids: NDArray[Any]
    details: dict[str, NDArray[Any]]
    smoothed: Track | None

    def table(self, name: str) -> NDArray[Any]:
        """Return a table of details.npz; empty if there is none."""
        return self.details.get(name, np.zeros(0))


def read_result(path: Path) -> Result | Track:
    """Return the result in a folder, or the trajectory in a file. Raises ReportError."""
    try:
        if path.is_dir():
            return _folder(path)
        return read_tum(path, path.stem)
    except OSError as error:
        raise ReportError(f"{error.filename or path}: {error.strerror or error}") from error
    except BagError as error:
        raise ReportError(str(error)) from error


def read_tum(path: Path, name: str) -> Track:
    """Return the trajectory in a TUM file (t x y z qx qy qz qw, s and m). Raises ReportError, OSError."""
    try:
        text = b"\n".join(line for line in path.read_bytes().splitlines() if not line.lstrip().startswith(b"#"))
        numbers = np.array(text.split(), np.float64).reshape(-1, 8)
    except ValueError:
        raise ReportError(f"{path}: neither the folder of a replay nor a TUM file (t x y z qx qy qz qw)") from None
    if not len(numbers) or not np.isfinite(numbers).all():
        raise ReportError(f"{path}: no poses, or some that are not numbers")
    numbers = numbers[np.argsort(numbers[:, 0], kind="stable")]
    return Track(name, numbers[:, 0], numbers[:, 1:4], angles_deg(rotations(numbers[:, 4:])))


def _folder(path: Path) -> Result:
    missing = [name for name in (SUMMARY, ODOMETRY, AIDS, TRAJECTORY) if not (path / name).is_file()]
    if missing:
        raise ReportError(f"{path}: not the folder of a replay, {', '.join(missing)} missing")
    try:
        summary = json.loads((path / SUMMARY).read_text(encoding="utf-8"))
        details = dict(np.load(path / DETAILS)) if (path / DETAILS).is_file() else {}
    except ValueError as error:
        raise ReportError(f"{path}: {error}") from error
    return Result(
        path.resolve().name.removesuffix("_eskf"),
        folder=path,
        summary=summary,
        aids=read_aids(path / AIDS),
        details=details,
        smoothed=read_tum(path / SMOOTHED, "smoothed") if (path / SMOOTHED).is_file() else None,
        **_odometry(path / ODOMETRY),
    )


def _odometry(path: Path) -> dict[str, Any]:
    """Return the columns of a `Result` that come from odometry/global; empty ones if no position was ever known."""
    if not (path.parent / TRAJECTORY).stat().st_size:
        return _columns(None)
    parts: dict[str, list[Array]] = {}
    with open_bag([path]) as reader:
        for batch in reader.batches({ODOMETRY_TOPIC: "nav_msgs/msg/Odometry"}):
            for name, values in _columns(batch[ODOMETRY_TOPIC].messages).items():
                parts.setdefault(name, []).append(values)
    if not parts:
        return _columns(None)
    return {name: np.concatenate(values) for name, values in parts.items()}


def _columns(messages: NDArray[Any] | None) -> dict[str, Array]:
    if messages is None:
        empty = np.zeros((0, 3))
        names = ("position", "angles_deg", "velocity", "position_std", "position_covariance", "velocity_std")
        return {"stamp": np.zeros(0), **dict.fromkeys((*names, "angles_std_deg"), empty)}
    turn = rotations(messages["orientation"])
    pose = messages["pose_covariance"].reshape(-1, 6, 6)
    twist = messages["twist_covariance"].reshape(-1, 6, 6)[:, :3, :3]
    deviations = np.sqrt(np.maximum(np.diagonal(pose, axis1=1, axis2=2), 0.0))
    return {
        "stamp": messages["stamp"] * 1e-9,
        "position": messages["position"],
        "angles_deg": angles_deg(turn),
        "velocity": np.einsum("nij,nj->ni", turn, messages["linear_velocity"]),
        "position_std": deviations[:, :3],
        "position_covariance": np.stack([pose[:, 0, 0], pose[:, 0, 1], pose[:, 1, 1]], axis=1),
        "velocity_std": np.sqrt(np.maximum(np.einsum("nij,njk,nik->ni", turn, twist, turn), 0.0)),
        "angles_std_deg": np.degrees(deviations[:, 3:]),
    }


def read_aids(path: Path) -> NDArray[Any]:
    """Return the rows (n,) AID of aids.csv."""
    parts = [np.zeros(0, AID)]
    with path.open("rb") as file:
        width = len(file.readline().split(b","))
        while lines := file.readlines(BLOCK):
            cells = b",".join(line.rstrip(b"\n") for line in lines).split(b",")
            rows = np.zeros(len(cells) // width, AID)
            columns = [cells[place::width] for place in range(width)]
            rows["stamp"], rows["arrival"] = np.array(columns[0], float), np.array(columns[1], float)
            rows["aid"] = columns[2]
            for axis in range(3):
                rows["innovation"][:, axis] = np.array(columns[3 + axis], float)
            rows["nis"], rows["dof"] = np.array(columns[6], float), np.array(columns[7], int)
            rows["verdict"], rows["source"] = columns[8], columns[9]
            parts.append(rows)
    return np.concatenate(parts)


def rotations(quaternions: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of quaternions (n, 4; x y z w) of length one (Sola, eq. 115)."""
    x, y, z, w = quaternions.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def angles_deg(turn: Array) -> Array:
    """Return roll, pitch and yaw (n, 3), deg, of rotations from body to map; yaw 0 is east, without jumps of 360."""
    roll = np.arctan2(turn[:, 2, 1], turn[:, 2, 2])
    pitch = np.arcsin(np.clip(-turn[:, 2, 0], -1.0, 1.0))
    yaw = np.unwrap(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))
    return np.degrees(np.stack([roll, pitch, yaw], axis=1))


def in_map_of(track: Track, main: Result) -> Track:
    """Return the track in the map frame of `main`; a file without a datum is taken to be in that frame."""
    datum, wanted = getattr(track, "summary", {}).get("datum"), main.summary.get("datum")
    if datum is None or wanted is None or datum == wanted:
        return track
    there, here = MapFrame(tuple(datum)), MapFrame(tuple(wanted))
    ecef = there.to_ecef(track.position)
    return replace(track, position=(ecef - here.origin_ecef) @ here.rotation_map_to_ecef)
