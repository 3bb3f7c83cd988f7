"""Result files of one replay: written under temporary names, renamed together at the end."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import BagWriter, Batch, message_dtype
from eskf_ros.filter.state.enums import STREAM_NAMES, Stream, Verdict
from eskf_ros.filter.tight.signal import name_of
from eskf_ros.geodesy.map_frame import MapFrame, to_geodetic
from eskf_ros.parameters.tree import Frames
from eskf_ros.replay.topics import FIX, ODOMETRY
from eskf_ros.replay.truth import EPOCH
from eskf_ros.replay.tum_writer import tum_text
from eskf_ros.replay.views import Views, first_in_each

NAMES = ("odometry.mcap", "trajectory.tum", "aids.csv", "details.npz", "summary.json")
SMOOTHED_NAME = "trajectory_smoothed.tum"
AIDS_HEADER = "stamp,arrival,aid,innovation_0,innovation_1,innovation_2,nis,dof,verdict,source\n"
FIX_INTERVAL = 1_000_000_000
"""ns; time between two NavSatFix messages in odometry.mcap."""

RANGE_STREAMS = (Stream.PSEUDORANGE, Stream.RANGE_RATE)
_signal_name = lru_cache(maxsize=1024)(name_of)

VERDICT_NAMES = tuple(verdict.name.lower() for verdict in Verdict)

_STATUS_FIX = 0
_COVARIANCE_KNOWN = 3


class ResultFiles:
    """Context manager: `write_summary` replaces the results of an earlier replay; without it no file is left.

    Only files with a name in `NAMES` are ever replaced, and the smoothed trajectory: without ``smooths`` there is none
    afterwards. With `output_rate` above 0 (Hz) the rows are thinned to it, as
    the navigator would: the first row at or after each multiple of the interval. Raises OSError or BagError if the
    folder cannot be written. `seconds` is the working time of the writing thread.
    """

    def __init__(
        self, folder: Path, frames: Frames, output_rate: float = 0.0, has_truth: bool = False, smooths: bool = False
    ) -> None:
        self.folder = folder
        self._frames, self._has_truth, self._smooths = frames, has_truth, smooths
        self._strings = (frames.map, frames.base_link)
        self._interval = round(1e9 / output_rate) if output_rate else 0
        self._last_stamp = self._last_fix = self._last_smoothed = -1
        self._writing: Future[None] | None = None
        self.seconds = 0.0
        self._all = ExitStack()
        self._files = ExitStack()

    def __enter__(self) -> ResultFiles:
        self._created = [place for place in (self.folder, *self.folder.parents) if not place.exists()]
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            # Temporary files have their final names, in a folder of their own: odometry.mcap contains its name.
            self._partial = Path(self._all.enter_context(TemporaryDirectory(prefix=".partial-", dir=self.folder)))
            self._all.enter_context(self._files)
            self._bag = self._files.enter_context(BagWriter(self._partial / "odometry.mcap", namespace="/"))
            self._odometry = self._bag.add_topic("odometry/global", ODOMETRY)
            self._fixes = self._bag.add_topic("gps/filtered", FIX)
            self._views = Views(self._bag, self._frames, self._has_truth)
            self._trajectory = self._files.enter_context((self._partial / "trajectory.tum").open("wb"))
            if self._smooths:
                self._smoothed = self._bag.add_topic("odometry/smoothed", ODOMETRY)
                self._smoothed_trajectory = self._files.enter_context((self._partial / SMOOTHED_NAME).open("wb"))
            self._aids = self._files.enter_context((self._partial / "aids.csv").open("w", encoding="ascii"))
            self._aids.write(AIDS_HEADER)
            self._writer = self._files.enter_context(ThreadPoolExecutor(1))
        except BaseException:
            self.__exit__(*sys.exc_info())
            raise
        return self

    def write(
        self,
        rows: NDArray[Any],
        records: NDArray[Any],
        datum: tuple[float, float, float] | None,
        fixes: Batch | None = None,
        truth: NDArray[Any] | None = None,
    ) -> None:
        """Append RECORD rows (m,) to aids.csv, and ODOMETRY rows (n,) with a known position to the other two files.

        ``fixes`` as they came and truth epochs (k,) go to odometry.mcap, beside the estimate.

        A thread does the work, mostly outside Python, while the estimator takes the next batch.
        """
        self._wait()
        self._writing = self._writer.submit(self._write, rows, records, datum, fixes, truth)

    def _write(
        self,
        rows: NDArray[Any],
        records: NDArray[Any],
        datum: tuple[float, float, float] | None,
        fixes: Batch | None,
        truth: NDArray[Any] | None,
    ) -> None:
        began = time.perf_counter()
        self._aids.write(aids_lines(records))
        if fixes is not None:
            self._views.write_fixes(fixes)
        if self._has_truth:
            epochs = np.zeros(0, EPOCH) if truth is None else truth
            self._views.write_truth(epochs, None if datum is None else MapFrame(datum))
        stamps = rows["stamp"]
        if self._last_stamp < 0 and len(rows):
            # As the navigator: the first row is one only if it begins an interval.
            self._last_stamp = int(stamps[0]) - 1
        thinned = selected(rows, first_in_each(stamps, self._last_stamp, self._interval))
        self._views.write(thinned, records)
        chosen = selected(thinned, thinned["position_known"])
        if datum is not None and len(chosen):
            self._trajectory.write(tum_lines(chosen))
            self._bag.write(self._odometry, chosen["stamp"], odometry_messages(chosen), self._strings)
            chosen = chosen[first_in_each(chosen["stamp"], self._last_fix, FIX_INTERVAL)]
            self._bag.write(self._fixes, chosen["stamp"], fix_messages(chosen, MapFrame(datum)), self._strings)
            self._last_fix = int(chosen["stamp"][-1]) if len(chosen) else self._last_fix
        if len(rows):
            self._last_stamp = int(stamps[-1])
        self.seconds += time.perf_counter() - began

    @property
    def scratch(self) -> Path:
        """Folder for temporary files; it goes with this object."""
        return self._partial

    def write_smoothed(self, rows: NDArray[Any]) -> None:
        """Append smoothed ODOMETRY rows (n,) to the smoothed trajectory and odometry."""
        self._wait()
        self._writing = self._writer.submit(self._write_smoothed, rows)

    def _write_smoothed(self, rows: NDArray[Any]) -> None:
        began = time.perf_counter()
        chosen = selected(rows, first_in_each(rows["stamp"], self._last_smoothed, self._interval))
        self._last_smoothed = int(rows["stamp"][-1])
        self._smoothed_trajectory.write(tum_lines(chosen))
        self._bag.write(self._smoothed, chosen["stamp"], odometry_messages(chosen), self._strings)
        self.seconds += time.perf_counter() - began

    def _wait(self) -> None:
        if self._writing is not None:
            self._writing.result()

    def finish(self) -> None:
        """Complete all files but summary.json; nothing can be appended afterwards."""
        self._wait()
        began = time.perf_counter()
        self._views.finish()
        self._files.close()
        self.seconds += time.perf_counter() - began

    @property
    def details(self) -> Path:
        """Where details.npz is written, before `write_summary`."""
        return self._partial / "details.npz"

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write summary.json, after `finish`, and rename all files; a NaN in it must have been replaced by None."""
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        (self._partial / "summary.json").write_text(text, encoding="utf-8")
        for name in (*NAMES, SMOOTHED_NAME) if self._smooths else NAMES:
            (self._partial / name).replace(self.folder / name)
        if not self._smooths:
            (self.folder / SMOOTHED_NAME).unlink(missing_ok=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._all.__exit__(kind, error, trace)
        for place in self._created:
            if not any(place.iterdir()):
                place.rmdir()


def selected(rows: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Return `rows[mask]`, without a copy if the mask is all true: a row has more than a kilobyte."""
    return rows if mask.all() else rows[mask]


def aids_lines(records: NDArray[Any]) -> str:
    """Return lines of aids.csv; stamps in seconds with nine decimals, numbers with all digits, nan for missing ones.

    The source is the signal of a range, else the number of the receiver.
    """
    stamp, arrival = np.divmod(records["stamp"], 1_000_000_000), np.divmod(records["arrival"], 1_000_000_000)
    columns = [column.tolist() for column in (*stamp, *arrival)]
    columns.append([STREAM_NAMES[stream] for stream in records["stream"].tolist()])
    columns += [column.tolist() for column in (*records["innovation"].T, records["nis"], records["dof"])]
    columns.append([VERDICT_NAMES[verdict] for verdict in records["verdict"].tolist()])
    is_range = np.isin(records["stream"], RANGE_STREAMS).tolist()
    columns.append(
        [_signal_name(source) if named else source for source, named in zip(records["source"].tolist(), is_range)]
    )
    line = "%d.%09d,%d.%09d,%s,%r,%r,%r,%r,%d,%s,%s\n"
    return "".join(map(line.__mod__, zip(*columns, strict=True)))


def tum_lines(rows: NDArray[Any]) -> bytes:
    """Return ODOMETRY rows (n,) as lines of a TUM trajectory."""
    return tum_text(
        rows["stamp"], np.column_stack([rows["position_map"], rows["attitude_body_to_map"][:, [1, 2, 3, 0]]])
    )


def odometry_messages(rows: NDArray[Any]) -> NDArray[Any]:
    """Return nav_msgs/Odometry (n,) of ODOMETRY rows; strings 0 and 1 are the map frame and base_link."""
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
    """Return sensor_msgs/NavSatFix (n,) of base_link; string 1 is base_link."""
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
