"""The files of one replay. They are written under temporary names and take their final names together at the end."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import BagWriter, message_dtype
from eskf_ros.filter.layout import STREAM_NAMES, Verdict
from eskf_ros.parameters import Frames
from eskf_ros.replay.topics import FIX, ODOMETRY
from eskf_ros.simulate.map_frame import MapFrame, to_geodetic

NAMES = ("odometry.mcap", "trajectory.tum", "aids.csv", "summary.json")
AIDS_HEADER = "stamp,arrival,aid,innovation_0,innovation_1,innovation_2,nis,dof,verdict\n"
FIX_INTERVAL = 1_000_000_000
"""ns between two NavSatFix messages in odometry.mcap."""

_STATUS_FIX = 0
_COVARIANCE_KNOWN = 3


class ResultFiles:
    """Context manager: on a clean exit the results replace those of an earlier replay, after an error none is left.

    Only files called as in `NAMES` are ever replaced. With `output_rate` above 0 (Hz) the rows are thinned to it, as
    the navigator would: the first row at or after each multiple of the interval. Raises OSError or BagError when the
    folder cannot be written.
    """

    def __init__(self, folder: Path, frames: Frames, output_rate: float = 0.0) -> None:
        self.folder = folder
        self._strings = (frames.map, frames.base_link)
        self._interval = round(1e9 / output_rate) if output_rate else 0
        self._last_stamp = -1
        self._open = ExitStack()

    def __enter__(self) -> ResultFiles:
        self._is_new = not self.folder.exists()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._partial = {name: self.folder / f".{name}.{os.getpid()}" for name in NAMES}
        try:
            self._bag = self._open.enter_context(BagWriter(self._partial["odometry.mcap"]))
            self._odometry = self._bag.add_topic("odometry/global", ODOMETRY)
            self._fixes = self._bag.add_topic("gps/filtered", FIX)
            self._trajectory = self._open.enter_context(self._partial["trajectory.tum"].open("w", encoding="ascii"))
            self._aids = self._open.enter_context(self._partial["aids.csv"].open("w", encoding="ascii"))
            self._aids.write(AIDS_HEADER)
        except BaseException:
            self.__exit__(*sys.exc_info())
            raise
        return self

    def write_rows(self, rows: NDArray[Any], datum: tuple[float, float, float] | None) -> None:
        """Append those of the ODOMETRY rows (n,) whose position is known to trajectory.tum and odometry.mcap."""
        stamps, known = rows["stamp"], rows["position_known"]
        if datum is None or not known.any():
            self._last_stamp = int(stamps[-1]) if len(stamps) else self._last_stamp
            return
        chosen = rows[known & _first_in_each(stamps, self._last_stamp, self._interval)]
        self._trajectory.write(tum_lines(chosen))
        self._bag.write(self._odometry, chosen["stamp"], odometry_messages(chosen), self._strings)
        chosen = rows[known & _first_in_each(stamps, self._last_stamp, FIX_INTERVAL)]
        self._bag.write(self._fixes, chosen["stamp"], fix_messages(chosen, MapFrame(datum)), self._strings)
        self._last_stamp = int(stamps[-1])

    def write_records(self, records: NDArray[Any]) -> None:
        """Append RECORD rows (n,) to aids.csv."""
        self._aids.write(aids_lines(records))

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json; what is NaN must have become None before."""
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        self._partial["summary.json"].write_text(text, encoding="utf-8")

    def close(self) -> None:
        """Finish all files but summary.json; nothing can be appended any more."""
        self._open.close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._open.__exit__(kind, error, trace)
            if kind is None:
                for name, partial in self._partial.items():
                    partial.replace(self.folder / name)
        finally:
            for partial in self._partial.values():
                partial.unlink(missing_ok=True)
            if self._is_new and not any(self.folder.iterdir()):
                self.folder.rmdir()


def _first_in_each(stamps: NDArray[np.int64], last: int, interval: int) -> NDArray[np.bool_]:
    """Which of the increasing `stamps` is the first at or after a multiple of `interval` (ns; 0: all of them).

    `last` is the stamp before the first one.
    """
    if interval == 0:
        return np.ones(len(stamps), bool)
    return np.diff(stamps // interval, prepend=last // interval) > 0


def tum_lines(rows: NDArray[Any]) -> str:
    """Lines of a TUM trajectory: `t x y z qx qy qz qw`, t in seconds with all nine decimals of the stamp."""
    seconds, nanoseconds = np.divmod(rows["stamp"], 1_000_000_000)
    columns = [seconds, nanoseconds, *rows["position_map"].T, *rows["attitude_body_to_map"][:, [1, 2, 3, 0]].T]
    line = "%d.%09d %.6f %.6f %.6f %.9f %.9f %.9f %.9f\n"
    return "".join(map(line.__mod__, zip(*(column.tolist() for column in columns), strict=True)))


def aids_lines(records: NDArray[Any]) -> str:
    """Lines of aids.csv; stamps in seconds with nine decimals, numbers with all digits, nan where there is none."""
    stamp, arrival = np.divmod(records["stamp"], 1_000_000_000), np.divmod(records["arrival"], 1_000_000_000)
    columns = [column.tolist() for column in (*stamp, *arrival)]
    columns.append([STREAM_NAMES[stream] for stream in records["stream"].tolist()])
    columns += [column.tolist() for column in (*records["innovation"].T, records["nis"], records["dof"])]
    columns.append([Verdict(verdict).name.lower() for verdict in records["verdict"].tolist()])
    line = "%d.%09d,%d.%09d,%s,%r,%r,%r,%r,%d,%s\n"
    return "".join(map(line.__mod__, zip(*columns, strict=True)))


def odometry_messages(rows: NDArray[Any]) -> NDArray[Any]:
    """nav_msgs/Odometry (n,) of ODOMETRY rows; strings 0 and 1 are the map frame and base_link."""
    messages = np.zeros(len(rows), message_dtype(ODOMETRY))
    messages["stamp"] = rows["stamp"]
    messages["child_frame_id"] = 1
    messages["position"] = rows["position_map"]
    messages["orientation"] = rows["attitude_body_to_map"][:, [1, 2, 3, 0]]
    messages["pose_covariance"] = rows["pose_covariance"].reshape(-1, 36)
    messages["linear_velocity"] = rows["velocity_body"]
    messages["angular_velocity"] = rows["angular_rate_body"]
    messages["twist_covariance"] = rows["twist_covariance"].reshape(-1, 36)
    return messages


def fix_messages(rows: NDArray[Any], map_frame: MapFrame) -> NDArray[Any]:
    """sensor_msgs/NavSatFix (n,) of base_link; string 1 is base_link."""
    messages = np.zeros(len(rows), message_dtype(FIX))
    geodetic = to_geodetic(map_frame.to_ecef(rows["position_map"]))
    messages["stamp"] = rows["stamp"]
    messages["frame_id"] = 1
    messages["status"] = _STATUS_FIX
    messages["latitude"] = np.degrees(geodetic[:, 0])
    messages["longitude"] = np.degrees(geodetic[:, 1])
    messages["altitude"] = geodetic[:, 2]
    messages["position_covariance"] = rows["pose_covariance"][:, :3, :3].reshape(-1, 9)
    messages["position_covariance_type"] = _COVARIANCE_KNOWN
    return messages
