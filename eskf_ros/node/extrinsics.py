"""Where the sensors sit in base_link: from the parameters, or from /tf_static by the frame names in the messages."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from eskf_ros.parameters import Parameters, to_mapping

Pose = tuple[np.ndarray, Rotation]
"""Position (3,) m and orientation of a frame in another."""

IMU = "imu"
ANTENNA = "GNSS antenna"
PARAMETERS = {IMU: ("imu.mount_position", "imu.mount_rpy_deg"), ANTENNA: ("gnss.lever_arm",)}
"""What tells the place of each sensor."""


class Extrinsics:
    """Collects static transforms and the frames of the sensors, and completes the parameters with what they tell.

    Reading is a matter of the first messages: afterwards nothing changes, and nothing is looked up any more.
    """

    def __init__(self, parameters: Parameters) -> None:
        """`parameters` as somebody gave them: what is not zero there is not looked up."""
        self._base_link = parameters.frames.base_link
        values = to_mapping(parameters)
        use_tf = parameters.frames.extrinsics == "auto"
        self._wanted = {s for s, names in PARAMETERS.items() if use_tf and not np.any([values[n] for n in names])}
        self._parents: dict[str, tuple[str, Pose]] = {}
        self._frames: dict[str, list[str]] = {}
        self._found: dict[str, Pose] = {}

    def note_transform(self, message: Any) -> None:
        """Take note of one geometry_msgs/TransformStamped of /tf_static."""
        t, q = message.transform.translation, message.transform.rotation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        position = np.array([t.x, t.y, t.z])
        norm = np.linalg.norm(quaternion)
        if np.isfinite(position).all() and 0.5 < norm < 2.0:
            pose = position, Rotation.from_quat(quaternion / norm)
            self._parents[message.child_frame_id] = message.header.frame_id, pose

    def note_frame(self, sensor: str, frame: str) -> None:
        """Take note of a frame that a sensor's messages name; the first one that is known counts."""
        self._frames.setdefault(sensor, []).append(frame)

    def find(self) -> list[str]:
        """Look for the sensors not found so far; return a line for each that was found now."""
        lines = []
        for sensor in sorted(self._wanted - set(self._found)):
            for frame in self._frames.get(sensor, []):
                pose = self._in_base_link(frame)
                if pose is None or sensor in self._found:
                    continue
                self._found[sensor] = pose
                place = " ".join(f"{value:.3f}" for value in pose[0])
                angles = " ".join(f"{value:.2f}" for value in pose[1].as_euler("xyz", degrees=True))
                lines.append(
                    f"{sensor} in {self._base_link}, from /tf_static by its frame {frame}: "
                    f"position {place} m, roll pitch yaw {angles} deg"
                )
        return lines

    def completed(self, parameters: Parameters) -> Parameters:
        """The parameters with the places that were found."""
        if IMU in self._found:
            position, rotation = self._found[IMU]
            angles = rotation.as_euler("xyz", degrees=True)
            imu = dataclasses.replace(
                parameters.imu, mount_position=tuple(position.tolist()), mount_rpy_deg=tuple(angles.tolist())
            )
            parameters = dataclasses.replace(parameters, imu=imu)
        if ANTENNA in self._found:
            gnss = dataclasses.replace(parameters.gnss, lever_arm=tuple(self._found[ANTENNA][0].tolist()))
            parameters = dataclasses.replace(parameters, gnss=gnss)
        return parameters

    def source_of(self, sensor: str) -> str:
        """Where the place of a sensor comes from, for the diagnostics."""
        if sensor in self._found:
            return "/tf_static"
        return f"taken to be {self._base_link}" if sensor in self._wanted else "parameters"

    def _in_base_link(self, frame: str) -> Pose | None:
        """The pose of a frame in base_link, where both hang on one tree."""
        of_base = self._ancestors(self._base_link)
        for name, (position, rotation) in self._ancestors(frame).items():
            if name in of_base:
                base_position, base_rotation = of_base[name]
                return base_rotation.inv().apply(position - base_position), base_rotation.inv() * rotation
        return None

    def _ancestors(self, frame: str) -> dict[str, Pose]:
        """The pose of a frame in itself, its parent, and so on upwards."""
        pose: Pose = np.zeros(3), Rotation.identity()
        found = {frame: pose}
        while frame in self._parents:
            frame, (position, rotation) = self._parents[frame]
            if frame in found:
                break
            pose = position + rotation.apply(pose[0]), rotation * pose[1]
            found[frame] = pose
        return found
