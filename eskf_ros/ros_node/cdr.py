"""Imu and Odometry between their serialised form and numbers, without message objects in between.

At 1 kHz the message objects of rclpy cost more than the filter. The node therefore subscribes to and publishes
serialised messages (OMG CDR): 4 bytes of encapsulation, then the fields, each aligned to its own size counted from byte
4. A string is a uint32 length, which counts the closing NUL, and the bytes; the position of everything after the
strings therefore depends on their lengths only. Only little-endian CDR (00 01 00 00) is handled here, which is what
every ROS machine of today sends; the classes with `message` in their name handle the rest by message objects.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

ImuSample = tuple[int, tuple[float, ...], tuple[float, ...], bytes]
"""Stamp (ns), specific force (m/s2), angular rate (rad/s), both in IMU axes, and header.frame_id (UTF-8, no NUL)."""

_LITTLE_ENDIAN_CDR = 0x0100
_IMU_DOUBLES = 37
_ODOMETRY_DOUBLES = 85


class LayoutError(RuntimeError):
    """The message library does not read what was written: its Odometry has another layout than assumed here."""


def _aligned(position: int, size: int) -> int:
    return -(-position // size) * size


@lru_cache(maxsize=64)
def _imu_layout(frame_length: int) -> struct.Struct:
    """Return the layout: encapsulation, seconds, nanoseconds, string length, string with NUL, rates, accelerations."""
    padding = _aligned(12 + frame_length, 8) - (12 + frame_length)
    orientation_with_covariance, covariance = 13 * 8, 9 * 8
    return struct.Struct(f"<IiII{frame_length}s{padding + orientation_with_covariance}x3d{covariance}x3d{covariance}x")


class ImuReader:
    """Reads serialised sensor_msgs/Imu; each subscription needs its own: it remembers the frame name."""

    def __init__(self) -> None:
        self.is_uncarried = False
        """Whether the last message has a second or more of nanoseconds in its stamp."""
        self._set_frame_length(1)
        self._terminated = b""
        self._frame = b""

    def read(self, data: bytes) -> ImuSample | None:
        """Return the numbers of one message; None if its layout is not the expected one.

        Any bytes may be given, nothing is raised. The numbers are not checked: NaN and absurd values pass. After None,
        deserialise the message and call `imu_from_message`: it may still be good.
        """
        if len(data) != self._size and not self._adapt(data):
            return None
        values = self._layout.unpack_from(data)
        if values[3] != self._frame_length:  # names of eight different lengths give messages of one size
            if not self._adapt(data):
                return None
            values = self._layout.unpack_from(data)
        encapsulation, seconds, nanoseconds, _, terminated = values[:5]
        if encapsulation != _LITTLE_ENDIAN_CDR:
            return None
        if terminated != self._terminated:
            if terminated.find(0) != len(terminated) - 1:
                return None
            self._terminated, self._frame = terminated, terminated[:-1]
        self.is_uncarried = nanoseconds >= 1_000_000_000
        return seconds * 1_000_000_000 + nanoseconds, values[8:11], values[5:8], self._frame

    def _adapt(self, data: bytes) -> bool:
        """Adapt to the length of the frame name in `data`; return False if that is no Imu of this form."""
        if len(data) < 16:
            return False
        frame_length = int.from_bytes(data[12:16], "little")
        if frame_length < 1 or len(data) != 4 + _aligned(12 + frame_length, 8) + 8 * _IMU_DOUBLES:
            return False
        self._set_frame_length(frame_length)
        return True

    def _set_frame_length(self, frame_length: int) -> None:
        self._frame_length = frame_length
        self._layout = _imu_layout(frame_length)
        self._size = self._layout.size


def imu_from_message(message: Any) -> ImuSample:
    """Return the same numbers from a sensor_msgs/Imu object, as `deserialize_message` returns it."""
    stamp, force, rate = message.header.stamp, message.linear_acceleration, message.angular_velocity
    return (
        stamp.sec * 1_000_000_000 + stamp.nanosec,
        (force.x, force.y, force.z),
        (rate.x, rate.y, rate.z),
        message.header.frame_id.encode(),
    )


class AnyOdometryWriter(Protocol):
    """Makes what `publisher.publish` takes for one odometry: either of the two writers below."""

    def write(self, stamp: int, numbers: NDArray[np.float64]) -> Any: ...


class OdometryWriter:
    """Writes nav_msgs/Odometry for two fixed frame names into prepared bytes."""

    def __init__(self, frame_id: str, child_frame_id: str) -> None:
        """Prepare the bytes and let the message library read them back.

        Raises LayoutError if it reads anything else than was written; ImportError without rclpy and nav_msgs.
        """
        frames = b""
        for name in (frame_id, child_frame_id):
            terminated = name.encode() + b"\0"
            frames += b"\0" * (_aligned(len(frames), 4) - len(frames))
            frames += struct.pack("<I", len(terminated)) + terminated
        doubles = 4 + _aligned(8 + len(frames), 8)
        self._buffer = bytearray(doubles + 8 * _ODOMETRY_DOUBLES)
        struct.pack_into("<I8x", self._buffer, 0, _LITTLE_ENDIAN_CDR)
        self._buffer[12 : 12 + len(frames)] = frames
        self._pack_stamp = struct.Struct("<iI").pack_into
        self._numbers = memoryview(self._buffer)[doubles:]
        self._verify(frame_id, child_frame_id)

    def write(self, stamp: int, numbers: NDArray[np.float64]) -> bytes:
        """Return one serialised Odometry: `stamp` in ns, `numbers` (85,) contiguous, in the order of the message.

        That is position x y z (m), orientation x y z w of the child frame in the frame, covariance of the pose (36),
        linear (m/s) and angular velocity (rad/s) in the child frame, covariance of the twist (36).
        """
        self._pack_stamp(self._buffer, 4, *divmod(stamp, 1_000_000_000))
        self._numbers[:] = numbers.view(np.uint8).data
        return bytes(self._buffer)

    def _verify(self, frame_id: str, child_frame_id: str) -> None:
        """Write a different number to each field and compare what the message library reads with it."""
        from nav_msgs.msg import Odometry
        from rclpy.serialization import deserialize_message

        numbers = np.arange(1.0, 1.0 + _ODOMETRY_DOUBLES)
        data = self.write(1_000_000_002, numbers)
        try:
            message = deserialize_message(data, Odometry)
            stamp, pose, twist = message.header.stamp, message.pose, message.twist
            read = [
                *(getattr(pose.pose.position, axis) for axis in "xyz"),
                *(getattr(pose.pose.orientation, axis) for axis in "xyzw"),
                *pose.covariance,
                *(getattr(twist.twist.linear, axis) for axis in "xyz"),
                *(getattr(twist.twist.angular, axis) for axis in "xyz"),
                *twist.covariance,
            ]
            header = (stamp.sec, stamp.nanosec, message.header.frame_id, message.child_frame_id)
        except Exception as error:
            raise LayoutError(f"nav_msgs/Odometry: the message library cannot read prepared bytes: {error}") from error
        if header != (1, 2, frame_id, child_frame_id) or read != numbers.tolist():
            raise LayoutError("nav_msgs/Odometry is laid out differently by this message library")


class OdometryMessageWriter:
    """Makes message objects, more slowly; same use as `OdometryWriter`."""

    def __init__(self, frame_id: str, child_frame_id: str) -> None:
        """Prepare the writer for two frame names. Raises ImportError without nav_msgs."""
        from nav_msgs.msg import Odometry

        self._message_type = Odometry
        self._frame_id = frame_id
        self._child_frame_id = child_frame_id

    def write(self, stamp: int, numbers: NDArray[np.float64]) -> Any:
        """Return one nav_msgs/Odometry; arguments as in `OdometryWriter.write`.

        The setters of rclpy do not check: everything but a Python float, or a flat float64 array, becomes garbage.
        """
        message = self._message_type()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(stamp), 1_000_000_000)
        message.header.frame_id = self._frame_id
        message.child_frame_id = self._child_frame_id
        pose, twist = message.pose.pose, message.twist.twist
        pose.position.x, pose.position.y, pose.position.z = numbers[:3].tolist()
        orientation = pose.orientation
        orientation.x, orientation.y, orientation.z, orientation.w = numbers[3:7].tolist()
        message.pose.covariance = numbers[7:43].copy()
        twist.linear.x, twist.linear.y, twist.linear.z = numbers[43:46].tolist()
        twist.angular.x, twist.angular.y, twist.angular.z = numbers[46:49].tolist()
        message.twist.covariance = numbers[49:].copy()
        return message
