"""Positions of the sensors in base_link: from the parameters, or from /tf_static by the frames of their messages."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from eskf_ros.filter.measurements.row import Place
from eskf_ros.filter.rows import SENSORS
from eskf_ros.parameters.mapping import to_mapping
from eskf_ros.parameters.tree import Parameters

Pose = tuple[np.ndarray, np.ndarray]
"""Position (3,) m and rotation matrix (3, 3) of a frame in another."""

IMU, ANTENNA, SECOND_ANTENNA = "IMU", "GNSS antenna", "second GNSS antenna"

PLACES = {
    IMU: Place("imu.mount_position", "imu.mount_rpy_deg"),
    # The messages of velocities do not count: many drivers name the axes of the velocity, not the antenna.
    ANTENNA: Place("gnss.lever_arm", inputs=("gnss_fix", "ranges")),
    SECOND_ANTENNA: Place("second_gnss.lever_arm"),
    **{row.label: row.place for row in SENSORS if row.place},
}
"""The sensors whose place in base_link matters: the parameters of the place, and the inputs that name their frame."""


def place_of(name: str, receiver: int = 0) -> str:
    """Return the sensor of the input with this name; empty if its place does not matter."""
    if receiver:
        return SECOND_ANTENNA
    return next((sensor for sensor, place in PLACES.items() if name in place.inputs), "")


class Extrinsics:
    """Collects static transforms and the frames of the sensors, and completes the parameters with them.

    Only the first messages matter: once found, a place does not change and is not looked up again.
    """

    def __init__(self, parameters: Parameters) -> None:
        """Take `parameters` as the user gave them: places that are not zero there are not looked up."""
        self._base_link = parameters.frames.base_link
        values = to_mapping(parameters)
        self._wanted: set[str] = set()
        if parameters.frames.extrinsics == "auto":
            for sensor, place in PLACES.items():
                if not any(np.any(values[name]) for name in (place.position, place.rotation) if name):
                    self._wanted.add(sensor)
        self._parents: dict[str, tuple[str, Pose]] = {}
        self._frames: dict[str, list[str]] = {}
        self._found: dict[str, Pose] = {}

    def note_transform(self, message: Any) -> None:
        """Record one geometry_msgs/TransformStamped of /tf_static."""
        t, q = message.transform.translation, message.transform.rotation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        position = np.array([t.x, t.y, t.z])
        norm = np.linalg.norm(quaternion)
        if np.isfinite(position).all() and 0.5 < norm < 2.0:
            pose = position, matrix_of(*(quaternion / norm))
            self._parents[message.child_frame_id] = message.header.frame_id, pose

    @property
    def sensors(self) -> list[str]:
        """The sensors that every robot has, and those that have sent messages."""
        return [sensor for sensor in PLACES if sensor in (IMU, ANTENNA, *self._frames)]

    def note_frame(self, sensor: str, frame: str) -> bool:
        """Record a frame that the messages of a sensor name; return whether it is the first one of this sensor.

        Of several frames the first one with a known place counts.
        """
        frames = self._frames.setdefault(sensor, [])
        frames.append(frame)
        return len(frames) == 1

    def find(self) -> list[str]:
        """Look up the sensors not found yet; return one line for each that was found now."""
        lines = []
        for sensor in sorted(self._wanted - set(self._found)):
            for frame in self._frames.get(sensor, []):
                pose = self._in_base_link(frame)
                if pose is None or sensor in self._found:
                    continue
                self._found[sensor] = pose
                # Adding zero removes the sign of a negative zero.
                place = " ".join(f"{value:.3f}" for value in np.round(pose[0], 3) + 0.0)
                angles = " ".join(f"{value:.2f}" for value in np.round(roll_pitch_yaw_deg(pose[1]), 2) + 0.0)
                lines.append(
                    f"{sensor} in {self._base_link}, from /tf_static by its frame {frame}: "
                    f"position {place} m, roll pitch yaw {angles} deg"
                )
        return lines

    def completed(self, parameters: Parameters) -> Parameters:
        """Return the parameters with the places that were found."""
        for sensor, (position, rotation) in self._found.items():
            if PLACES[sensor].position:
                parameters = _changed(parameters, PLACES[sensor].position, position)
            if PLACES[sensor].rotation:
                parameters = _changed(parameters, PLACES[sensor].rotation, roll_pitch_yaw_deg(rotation))
        return parameters

    def source_of(self, sensor: str) -> str:
        """Return where the place of a sensor comes from, for the diagnostics."""
        if sensor in self._found:
            return "/tf_static"
        return f"taken to be {self._base_link}" if sensor in self._wanted else "parameters"

    def _in_base_link(self, frame: str) -> Pose | None:
        """Return the pose of a frame in base_link; None unless both belong to one tree."""
        of_base = self._ancestors(self._base_link)
        for name, (position, rotation) in self._ancestors(frame).items():
            if name in of_base:
                base_position, base_rotation = of_base[name]
                return base_rotation.T @ (position - base_position), base_rotation.T @ rotation
        return None

    def _ancestors(self, frame: str) -> dict[str, Pose]:
        """Return the pose of a frame in itself, in its parent, and so on upwards."""
        pose: Pose = np.zeros(3), np.eye(3)
        found = {frame: pose}
        while frame in self._parents:
            frame, (position, rotation) = self._parents[frame]
            if frame in found:
                break
            pose = position + rotation @ pose[0], rotation @ pose[1]
            found[frame] = pose
        return found


def _changed(parameters: Parameters, name: str, values: np.ndarray) -> Parameters:
    group, field = name.split(".")
    changed = dataclasses.replace(getattr(parameters, group), **{field: tuple(values.tolist())})
    return dataclasses.replace(parameters, **{group: changed})


def matrix_of(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion."""
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def roll_pitch_yaw_deg(matrix: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (3,) (deg, fixed axes) of a rotation matrix; pitch from -90 to 90 degrees."""
    pitch = math.atan2(-matrix[2, 0], math.hypot(matrix[2, 1], matrix[2, 2]))
    if math.hypot(matrix[2, 1], matrix[2, 2]) < 1e-9:
        # Straight up or down: roll and yaw turn about the same axis, and all of it is called yaw.
        return np.degrees([0.0, pitch, math.atan2(-matrix[0, 1], matrix[1, 1])])
    roll, yaw = math.atan2(matrix[2, 1], matrix[2, 2]), math.atan2(matrix[1, 0], matrix[0, 0])
    return np.degrees([roll, pitch, yaw])
