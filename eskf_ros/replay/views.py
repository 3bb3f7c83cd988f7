"""What odometry.mcap carries besides the odometry, for the views of config/views: as the node publishes it, and more.

Once a second, but for transforms, fixes and truth. Of the verdicts those on accepted measurements are thinned to one a
second for each sensor; signals of satellites are in aids.csv only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.bags import BagWriter, Batch, message_dtype
from eskf_ros.bags.cdr_writer import (
    DIAGNOSTIC_ARRAY,
    DIAGNOSTIC_STATUS,
    OK,
    PATH,
    TRANSFORMS,
    WARN,
    Pose,
    Status,
    diagnostic_array,
    diagnostic_status,
    path,
    transforms,
)
from eskf_ros.filter.history.records import RECORD
from eskf_ros.filter.measurements.row import ODOMETRY, TWIST
from eskf_ros.filter.state.enums import STREAM_NAMES, Verdict
from eskf_ros.filter.state.enums import Status as State
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.inputs.table import FIX
from eskf_ros.parameters.tree import Frames
from eskf_ros.replay import words
from eskf_ros.replay.truth import EPOCH

SECOND = 1_000_000_000
TRANSFORM_INTERVAL = TRUTH_INTERVAL = 100_000_000
"""ns; time between two transforms, and between two poses of the truth."""

REPORT_LAG = 70 * SECOND
"""ns; records of measurements are final by then: history.window is 60 s at most."""

NODE = "/eskf_replay"
COUNT_NAMES = tuple(f"{stream} {verdict.name.lower()}" for stream in STREAM_NAMES for verdict in Verdict)
"""Names of the counts of verdicts, in the order of a table of streams and verdicts."""
IMU_FRAME = "imu"
"""Frame of the biases; the recording may have none."""


class Views:
    """Writes the further topics of odometry.mcap. ``has_truth``: there is a reference to show."""

    def __init__(self, bag: BagWriter, frames: Frames, has_truth: bool) -> None:
        self._bag, self._frames = bag, frames
        self._fixes = bag.add_topic("gps/fix", FIX)
        self._biases = bag.add_topic("imu/bias", TWIST)
        self._verdicts = bag.add_topic("eskf/aids", DIAGNOSTIC_ARRAY)
        self._qualities = bag.add_topic("eskf/quality", DIAGNOSTIC_STATUS)
        self._diagnostics = bag.add_topic("diagnostics", DIAGNOSTIC_ARRAY)
        self._transforms = bag.add_topic("tf", TRANSFORMS)
        self._path = bag.add_topic("path", PATH)
        if has_truth:
            self._truth = bag.add_topic("truth", ODOMETRY)
            self._true_path = bag.add_topic("path/truth", PATH)
        self._has_truth = has_truth
        self._waiting_truth = np.zeros(0, EPOCH)
        self._last = {"row": -1, "transform": -1, "truth": -1}
        self._last_verdict: dict[tuple[int, int, int], int] = {}
        self._counts = np.zeros((len(STREAM_NAMES), len(Verdict)), np.int64)
        self._uncounted = np.zeros(0, RECORD)
        self._unreported: list[np.void] = []
        self._poses: list[tuple[int, Pose]] = []
        self._true_poses: list[tuple[int, Pose]] = []

    def write_fixes(self, batch: Batch) -> None:
        """Write fixes as they came, at their own stamps."""
        self._bag.write(self._fixes, batch.messages["stamp"], batch.messages, batch.strings)

    def write(self, rows: NDArray[Any], records: NDArray[Any]) -> None:
        """Write what is to be shown of ODOMETRY rows (n,) and RECORD rows (m,)."""
        self._write_verdicts(records)
        known = rows[rows["position_known"]]
        chosen = known[first_in_each(known["stamp"], self._last["transform"], TRANSFORM_INTERVAL)]
        if len(chosen):
            poses = np.column_stack([chosen["position_map"], chosen["attitude_body_to_map"][:, [1, 2, 3, 0]]])
            messages = transforms(chosen["stamp"], self._frames.map, self._frames.base_link, poses)
            self._bag.write(self._transforms, chosen["stamp"], messages)
            self._last["transform"] = int(chosen["stamp"][-1])
        rows = rows[first_in_each(rows["stamp"], self._last["row"], SECOND)]
        if not len(rows):
            return
        self._last["row"] = int(rows["stamp"][-1])
        stamps = rows["stamp"]
        self._poses += [(int(row["stamp"]), _pose(row)) for row in rows if row["position_known"]]
        self._bag.write(self._biases, stamps, bias_messages(rows), (IMU_FRAME,))
        qualities = [diagnostic_status(words.quality(row, NODE)) for row in rows]
        self._bag.write(self._qualities, stamps, qualities)
        self._unreported += list(rows.copy())
        self._report(int(stamps[-1]) - REPORT_LAG)

    def _report(self, until: int) -> None:
        """Write /diagnostics as the node has them, as far as a replay knows it, of the rows up to a stamp (ns)."""
        done = [row for row in self._unreported if row["stamp"] <= until]
        if not done:
            return
        self._unreported = self._unreported[len(done) :]
        stamps = np.array([row["stamp"] for row in done], np.int64)
        place = np.searchsorted(
            np.maximum.accumulate(stamps), self._uncounted["stamp"]
        )  # the first row that counts the record
        counted = self._uncounted[place < len(done)]
        new = np.zeros((len(done), *self._counts.shape), np.int64)
        np.add.at(new, (place[place < len(done)], counted["stream"], counted["verdict"]), 1)
        self._uncounted = self._uncounted[place == len(done)]
        messages = []
        for row, stamp, more in zip(done, stamps.tolist(), new, strict=True):
            self._counts += more
            found = np.flatnonzero(self._counts)
            names = [COUNT_NAMES[number] for number in found.tolist()]
            counts = dict(zip(names, map(str, self._counts.ravel()[found].tolist()), strict=True))
            state, quality = State(int(row["status"])), words.quality(row, NODE)
            level = OK if state == State.GOOD and quality.level == OK else WARN
            message = "; ".join([state.name, *([] if quality.level == OK else [quality.message])])
            status = Status(level, f"{NODE}: navigation", message, {**words.figures(row), **counts})
            messages.append(diagnostic_array(stamp, [status]))
        self._bag.write(self._diagnostics, stamps, messages)

    def _write_verdicts(self, records: NDArray[Any]) -> None:
        self._uncounted = np.concatenate([self._uncounted, records])
        records = records[~np.isin(records["stream"], words.SIGNALS)]
        stamps = np.ascontiguousarray(records["stamp"])
        kinds = zip(*(records[name].tolist() for name in ("stream", "source", "verdict")), strict=True)
        is_good = np.isin(records["verdict"], words.GOOD_VERDICTS).tolist()
        chosen = []
        for place, (kind, second) in enumerate(zip(kinds, (stamps // SECOND).tolist(), strict=True)):
            if not is_good[place] or self._last_verdict.get(kind) != second:
                self._last_verdict[kind] = second
                chosen.append(place)
        messages = [diagnostic_array(int(stamps[place]), [words.verdict(records[place])]) for place in chosen]
        self._bag.write(self._verdicts, stamps[chosen], messages)

    def write_truth(self, epochs: NDArray[Any], map_frame: MapFrame | None) -> None:
        """Write truth epochs (n,) `EPOCH` in the map; without one they wait for it."""
        epochs = np.concatenate([self._waiting_truth, epochs[np.isfinite(epochs["position_ecef"]).all(axis=1)]])
        self._waiting_truth = epochs if map_frame is None else epochs[:0]
        if map_frame is None or not len(epochs):
            return
        epochs = epochs[first_in_each(epochs["stamp"], self._last["truth"], TRUTH_INTERVAL)]
        messages = truth_messages(epochs, map_frame)
        self._bag.write(self._truth, epochs["stamp"], messages, (self._frames.map, self._frames.base_link))
        for message in messages[first_in_each(messages["stamp"], self._last["truth"], SECOND)]:
            self._true_poses.append((int(message["stamp"]), (*message["position"], *message["orientation"])))
        self._last["truth"] = int(epochs["stamp"][-1]) if len(epochs) else self._last["truth"]

    def finish(self) -> None:
        """Write the last reports, and the paths at the stamps of their first poses: there from the beginning."""
        self._report(np.iinfo(np.int64).max)
        paths = [(self._path, self._poses)]
        paths += [(self._true_path, self._true_poses)] if self._has_truth else []
        for handle, poses in paths:
            if poses:
                self._bag.write(handle, np.array([poses[0][0]]), [path(self._frames.map, poses)])


def first_in_each(stamps: NDArray[np.int64], last: int, interval: int) -> NDArray[np.bool_]:
    """Return which of the increasing `stamps` is the first at or after a multiple of `interval` (ns; 0: all of them).

    `last` is the stamp before the first one.
    """
    if interval == 0:
        return np.ones(len(stamps), bool)
    return np.diff(stamps // interval, prepend=last // interval) > 0


def _pose(row: np.void) -> Pose:
    w, x, y, z = row["attitude_body_to_map"].tolist()
    return (*row["position_map"].tolist(), x, y, z, w)


def bias_messages(rows: NDArray[Any]) -> NDArray[Any]:
    """Return geometry_msgs/TwistWithCovarianceStamped (n,): accelerometer bias (linear), gyro bias (angular)."""
    messages = np.zeros(len(rows), message_dtype(TWIST))
    messages["stamp"] = rows["stamp"]
    messages["linear_velocity"], messages["angular_velocity"] = rows["accel_bias"], rows["gyro_bias"]
    variances = np.concatenate([rows["accel_bias_std"], rows["gyro_bias_std"]], axis=1) ** 2
    messages["twist_covariance"][:, ::7] = variances
    return messages


def truth_messages(epochs: NDArray[Any], map_frame: MapFrame) -> NDArray[Any]:
    """Return nav_msgs/Odometry (n,) of truth in the map; strings 0 and 1 are the map frame and base_link.

    Truth that is a position only (NavSatFix, of the antenna) has no turn; velocities are not given.
    """
    messages = np.zeros(len(epochs), message_dtype(ODOMETRY))
    messages["stamp"] = epochs["stamp"]
    messages["child_frame_id"] = 1
    to_map = map_frame.rotation_map_to_ecef.T
    messages["position"] = (epochs["position_ecef"] - map_frame.origin_ecef) @ to_map.T
    is_turned = np.isfinite(epochs["rotation_body_to_ecef"]).all(axis=(1, 2))
    messages["orientation"][:, 3] = 1.0
    if is_turned.any():
        attitudes = Rotation.from_matrix(to_map @ epochs["rotation_body_to_ecef"][is_turned])
        messages["orientation"][is_turned] = attitudes.as_quat()
    return messages
