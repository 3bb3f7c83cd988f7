"""Transforms on /tf: map -> odom -> base_link, or map -> odom beside another node's odom -> base_link.

map -> odom carries x, y, z and yaw only: roll and pitch belong to odom -> base_link (REP-105 frames stay level).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from eskf_ros.filter.state.time import SECOND
from eskf_ros.parameters.tree import Frames

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None


Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""w x y z."""


def map_to_odom(row: np.void) -> tuple[Vector, Quaternion]:
    """Return the pose of odom in map from one ODOMETRY row, which has the pose of base_link in both."""
    w, x, y, z = row["attitude_body_to_map"].tolist()
    wo, xo, yo, zo = row["attitude_body_to_odom"].tolist()
    # The two attitudes differ by a turn about z only.
    yaw = 2.0 * math.atan2(z * wo + y * xo - x * yo - w * zo, w * wo + x * xo + y * yo + z * zo)
    return turned_by(yaw, row["position_map"].tolist(), row["position_odom"].tolist())


def turned_by(yaw: float, position_map: Vector, position_odom: Vector) -> tuple[Vector, Quaternion]:
    """Return the pose of odom in map, turned by `yaw` (rad), such that both positions (m) are the same point."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    x, y, z = position_odom
    translation = (
        position_map[0] - cosine * x + sine * y,
        position_map[1] - sine * x - cosine * y,
        position_map[2] - z,
    )
    return translation, (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))


def yaw_of(w: float, x: float, y: float, z: float) -> float:
    """Return the yaw (rad) of a quaternion."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


class Track:
    """The path of base_link in map over the last seconds: x, y, z and yaw at any stamp in between."""

    LENGTH = 4000
    """Points of the path that are kept, at most."""

    def __init__(self) -> None:
        self._points: deque[tuple[int, Vector, float]] = deque(maxlen=self.LENGTH)

    def note(self, row: np.void) -> None:
        """Add one ODOMETRY row, newer than all before; an older one begins a new path."""
        stamp = int(row["stamp"])
        if self._points and stamp <= self._points[-1][0]:
            self._points.clear()
        self._points.append((stamp, tuple(row["position_map"].tolist()), yaw_of(*row["attitude_body_to_map"].tolist())))

    @property
    def newest(self) -> int:
        """Stamp (ns) of the last row; 0 before the first."""
        return self._points[-1][0] if self._points else 0

    def at(self, stamp: int) -> tuple[Vector, float] | None:
        """Return position (m) and yaw (rad) at a stamp (ns) between the first and the last row, else None."""
        after = None
        for point in reversed(self._points):
            if point[0] <= stamp:
                return _between(point, after, stamp) if after else (point[1:] if point[0] == stamp else None)
            after = point
        return None


def _between(a: tuple[int, Vector, float], b: tuple[int, Vector, float], stamp: int) -> tuple[Vector, float]:
    share = (stamp - a[0]) / (b[0] - a[0])
    x, y, z = (p + share * (q - p) for p, q in zip(a[1], b[1]))
    return (x, y, z), a[2] + share * math.remainder(b[2] - a[2], math.tau)


class TransformOutput:
    """Publishes the transforms of each row as `output.tf` demands.

    Made only if tf2_msgs is there (`TFMessage` is not None). `publish` sends a TFMessage on /tf.
    """

    def __init__(self, mode: str, frames: Frames, publish: Callable[[Any], None]) -> None:
        from geometry_msgs.msg import TransformStamped

        self._mode = mode
        self._frames = frames
        self._publish = publish
        pairs = [(frames.map, frames.odom), (frames.odom, frames.base_link)][: 2 if mode == "full" else 1]
        self._transforms = [TransformStamped() for _ in pairs]
        for transform, (parent, child) in zip(self._transforms, pairs):
            transform.header.frame_id, transform.child_frame_id = parent, child
        self._message = TFMessage(transforms=self._transforms)
        self._local_message = TFMessage(transforms=self._transforms[1:])
        self._track = Track()
        self._waiting: tuple[int, Vector, float] | None = None
        self.watch = TransformWatch({child: parent for parent, child in pairs})

    def send(self, row: np.void) -> None:
        """Publish the transforms of one ODOMETRY row."""
        if self._mode == "map_to_odom":
            if row["position_known"]:
                self._track.note(row)
                self._answer()
            return
        stamp = int(row["stamp"])
        self._fill(1, stamp, row["position_odom"].tolist(), row["attitude_body_to_odom"].tolist())
        if row["position_known"]:
            self._fill(0, stamp, *map_to_odom(row))
        self._publish(self._message if row["position_known"] else self._local_message)

    def receive(self, message: Any) -> None:
        """Take a TFMessage: another node's odom -> base_link, and evidence of a second publisher of our transforms."""
        for transform in message.transforms:
            stamp = transform.header.stamp.sec * SECOND + transform.header.stamp.nanosec
            t, q = transform.transform.translation, transform.transform.rotation
            self.watch.note_received(transform.header.frame_id, transform.child_frame_id, stamp, t.x)
            own = (transform.header.frame_id, transform.child_frame_id) == (self._frames.odom, self._frames.base_link)
            if own and self._mode == "map_to_odom":
                yaw = yaw_of(q.w, q.x, q.y, q.z)
                if math.isfinite(t.x + t.y + t.z + yaw):
                    self._waiting = stamp, (t.x, t.y, t.z), yaw
                    self._answer()

    def _answer(self) -> None:
        """Publish map -> odom for the odometry of another node, once the estimate has reached its stamp."""
        if self._waiting is None or self._waiting[0] > self._track.newest:
            return
        stamp, position_odom, yaw_odom = self._waiting
        self._waiting = None
        found = self._track.at(stamp)
        if found is not None:
            position_map, yaw = found
            self._fill(0, stamp, *turned_by(yaw - yaw_odom, position_map, position_odom))
            self._publish(self._message)

    def _fill(self, index: int, stamp: int, position: Vector, quaternion: Quaternion) -> None:
        message = self._transforms[index]
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
        t, q = message.transform.translation, message.transform.rotation
        t.x, t.y, t.z = position
        q.w, q.x, q.y, q.z = quaternion
        self.watch.note_sent(message.child_frame_id, stamp, t.x)


class TransformWatch:
    """Distinguishes our own transforms on /tf from those of a second publisher of the same frames."""

    ENOUGH = 300
    """Transforms that are examined in one watch, at most, to save processor time."""

    def __init__(self, parents: dict[str, str]) -> None:
        """Make a watch; `parents`: the parent of each frame whose transform we publish."""
        self._parents = parents
        self._sent: dict[tuple[str, int], float] = {}
        self._looked_at = self.ENOUGH
        self._strangers: set[str] = set()
        self.strangers: tuple[str, ...] = ()
        """Transforms of a second publisher in the last complete watch: `parent -> child`."""

    def begin(self) -> None:
        """Begin a watch; only transforms sent from now on are known as our own."""
        self._sent.clear()
        self._strangers = set()
        self._looked_at = 0

    def end(self) -> None:
        """End a watch and keep its result."""
        if self._looked_at:
            self.strangers = tuple(sorted(self._strangers))
        self._looked_at = self.ENOUGH

    def note_sent(self, child: str, stamp: int, x: float) -> None:
        """Record a transform of our own, identified by stamp (ns) and translation in x (m)."""
        if self._looked_at < self.ENOUGH:
            self._sent[child, stamp] = x

    def note_received(self, parent: str, child: str, stamp: int, x: float) -> None:
        """Record a transform that was seen on /tf."""
        if child not in self._parents or self._looked_at >= self.ENOUGH:
            return
        self._looked_at += 1
        if self._sent.get((child, stamp)) != x:
            self._strangers.add(f"{parent} -> {child}")
