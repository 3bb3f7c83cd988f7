"""Messages no sensor should send, made from good ones, and a drive in which they come between the good ones.

For test_node_hostile.py and benchmark/hostile_traffic.py. Everything comes from a seed: the same seed, the same bytes.
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from eskf_ros.bags import StringTable, decode, encode, message_dtype
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.simulate.frames import STRINGS
from eskf_ros.simulate.messages import topics_of
from eskf_ros.simulate.scenario import Recording
from support.robot import TYPES
from support.ros_process import Ros

SECOND = 1_000_000_000
OUTPUTS = {
    "odometry/global": "nav_msgs/msg/Odometry",
    "odometry/local": "nav_msgs/msg/Odometry",
    "gps/filtered": "sensor_msgs/msg/NavSatFix",
    "imu/bias": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
BURST_RATE = 2000
BURST_LENGTH = 0.5
BURST_EVERY = 3.0
"""Hz and s of the bursts of hostile messages."""

Message = tuple[int, str, bytes]
"""When to publish it (ns from the first one), topic, serialised message."""


def drive(recording: Recording, first_stamp: int) -> list[Message]:
    """The messages of a recording as they arrive, with stamps that begin at `first_stamp`."""
    begin = int(recording.imu_stamp[0])
    found = []
    for topic in topics_of(recording):
        if topic.name in TYPES:
            messages = topic.messages(slice(None))
            messages["stamp"] += first_stamp - begin
            data = encode(topic.type_name, messages, STRINGS)
            found += [(t - begin, topic.name, bytes(row)) for t, row in zip(topic.arrival.tolist(), data)]
    return sorted(found, key=lambda message: message[0])


class Hostile:
    """Makes one hostile message after the other; `kinds` are their names."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._earlier: list[tuple[str, bytes]] = []
        self.kinds: dict[str, Callable[[str, np.ndarray], bytes]] = {
            "noise": self._noise,
            "truncated": self._truncated,
            "too long": self._too_long,
            "flipped bits": self._flipped_bits,
            "wrong encapsulation": self._wrong_encapsulation,
            "not finite": self._not_finite,
            "huge": self._huge,
            "outlier": self._outlier,
            "covariance": self._covariance,
            "stamp": self._stamp,
            "invalid stamp": self._invalid_stamp,
            "frame": self._frame,
        }

    def message(self, stamp: int) -> tuple[str, bytes]:
        """Topic and bytes of the next one; `stamp` (ns) is the present on the clock of the good messages."""
        random = self._random
        if self._earlier and random.random() < 0.2:
            # A duplicate of one of the last, and so the last ones in another order.
            return self._earlier[random.integers(len(self._earlier))]
        topic = tuple(TYPES)[random.integers(len(TYPES))]
        kind = tuple(self.kinds)[random.integers(len(self.kinds))]
        made = topic, self.kinds[kind](topic, self._plausible(topic, stamp))
        self._earlier = [*self._earlier[-9:], made]
        return made

    def first_imu(self, stamp: int) -> bytes:
        """An IMU sample with nothing wrong but its stamp, far in the future."""
        return self._bytes("imu/data", self._plausible("imu/data", stamp + 10**7 * SECOND))

    def flood(self, stamp: int) -> bytes:
        """An IMU sample with nothing wrong at all, but that there is another IMU."""
        return self._bytes("imu/data", self._plausible("imu/data", stamp))

    def _plausible(self, topic: str, stamp: int) -> np.ndarray:
        """What a robot at rest would send."""
        message = np.zeros(1, message_dtype(TYPES[topic]))
        message["stamp"] = stamp
        if topic == "imu/data":
            message["orientation_covariance"][:, 0] = -1.0
            message["linear_acceleration"] = [0.0, 0.0, 9.81]
        elif topic == "gps/fix":
            message["latitude"], message["longitude"], message["altitude"] = 48.137, 11.575, 565.0
            message["position_covariance"] = np.eye(3).ravel()
            message["position_covariance_type"] = 2
        else:
            message["twist_covariance"] = np.eye(6).ravel()
        return message

    def _bytes(self, topic: str, message: np.ndarray, frame: str = "imu_link") -> bytes:
        return bytes(encode(TYPES[topic], message, [frame])[0])

    def _numbers(self, topic: str, message: np.ndarray, choices: Sequence[float]) -> bytes:
        """Put one of `choices` into some of the measured values, or the covariance."""
        names = {
            "imu/data": ("linear_acceleration", "angular_velocity"),
            "gps/fix": ("latitude", "longitude", "altitude", "position_covariance"),
            "gps/vel": ("linear_velocity", "twist_covariance"),
        }[topic]
        name = names[self._random.integers(len(names))]
        values = message[name].reshape(-1)
        values[self._random.random(len(values)) < 0.5] = self._random.choice(choices)
        message[name] = values.reshape(message[name].shape)
        return self._bytes(topic, message)

    def _noise(self, topic: str, message: np.ndarray) -> bytes:
        """Random bytes behind a good header, as many as in a message or any number."""
        good = self._bytes(topic, message)
        if self._random.random() < 0.5:
            return good[:4] + self._random.bytes(len(good) - 4)
        return self._random.bytes(int(self._random.integers(2000)))

    def _truncated(self, topic: str, message: np.ndarray) -> bytes:
        good = self._bytes(topic, message)
        return good[: self._random.integers(len(good))]

    def _too_long(self, topic: str, message: np.ndarray) -> bytes:
        return self._bytes(topic, message) + self._random.bytes(int(self._random.integers(1, 100)))

    def _flipped_bits(self, topic: str, message: np.ndarray) -> bytes:
        data = bytearray(self._bytes(topic, message))
        for place in self._random.integers(len(data), size=5):
            data[place] ^= 1 << int(self._random.integers(8))
        return bytes(data)

    def _wrong_encapsulation(self, topic: str, message: np.ndarray) -> bytes:
        """Big-endian by name, little-endian in truth; or an encapsulation there is not."""
        return self._random.choice([b"\0\0\0\0", b"\0\3\0\0", b"\xff\xff\xff\xff"]) + self._bytes(topic, message)[4:]

    def _not_finite(self, topic: str, message: np.ndarray) -> bytes:
        return self._numbers(topic, message, [np.nan, np.inf, -np.inf])

    def _huge(self, topic: str, message: np.ndarray) -> bytes:
        return self._numbers(topic, message, [1e308, -1e308, 1e30, -1e18, 1e9, 5e-324])

    def _outlier(self, topic: str, message: np.ndarray) -> bytes:
        """What a sensor could read, and this one does not."""
        return self._numbers(topic, message, [-90.0, -50.0, 30.0, 80.0])

    def _covariance(self, topic: str, message: np.ndarray) -> bytes:
        """Zero, negative, indefinite, not symmetric, tiny or huge; of no kind there is."""
        name = "twist_covariance" if topic == "gps/vel" else "position_covariance"
        if topic != "imu/data":
            size = 6 if topic == "gps/vel" else 3
            factor = self._random.normal(size=(size, size))
            matrices = (np.zeros((size, size)), -np.eye(size), factor, factor + factor.T, 1e-30 * factor @ factor.T)
            message[name] = matrices[self._random.integers(len(matrices))].ravel()
        if topic == "gps/fix":
            message["position_covariance_type"] = self._random.integers(256)
            message["status"] = self._random.integers(-128, 128)
        return self._bytes(topic, message)

    def _stamp(self, topic: str, message: np.ndarray) -> bytes:
        """In the past, the future, long ago, or never filled in."""
        shift = self._random.choice([-1e9, -3600.0, -30.0, -5.0, -1.0, 0.5, 1.5, 5.0, 30.0, 3600.0, 1e8])
        message["stamp"] += round(shift * (1.0 + self._random.random()) * SECOND)
        message["stamp"] *= self._random.random() < 0.9
        return self._bytes(topic, message)

    def _invalid_stamp(self, topic: str, message: np.ndarray) -> bytes:
        """Negative seconds; more nanoseconds than a second has."""
        data = bytearray(self._bytes(topic, message))
        struct.pack_into("<iI", data, 4, int(self._random.integers(-(2**31), 2**31)), int(self._random.integers(2**32)))
        return bytes(data)

    def _frame(self, topic: str, message: np.ndarray) -> bytes:
        """Empty, unknown, very long, or no text."""
        data = self._bytes(topic, message, ["", "no_such_frame", "f" * 10_000, "imu_link"][self._random.integers(4)])
        return data.replace(b"imu_link", b"\xff\xfe\0link\x80")


@dataclass(frozen=True)
class Phase:
    """A part of the traffic: how long (s), whether the good messages come, how many hostile ones a second come evenly.

    With hostile ones come bursts.
    """

    seconds: float
    good: bool
    hostile: float


def mixed(good: Iterable[Message], first_stamp: int, phases: Sequence[Phase], seed: int) -> Iterator[Message]:
    """The messages of a drive, and hostile ones between them, in the order of publishing.

    The first message of all, if its phase is hostile, is an IMU sample from the far future.
    """
    hostile, waiting = Hostile(seed), iter(good)
    held = next(waiting, None)
    start = 0
    for phase in phases:
        end = start + round(phase.seconds * SECOND)
        found: list[Message] = []
        while held is not None and held[0] < end:
            found += [held] if phase.good else []
            held = next(waiting, None)
        if phase.hostile:
            due = np.arange(start, end, round(SECOND / phase.hostile)).tolist()
            for begin in range(start, end, round(BURST_EVERY * SECOND)):
                due += np.arange(
                    begin, min(end, begin + BURST_LENGTH * SECOND), SECOND // BURST_RATE, np.int64
                ).tolist()
            found += [(t, *hostile.message(first_stamp + t)) for t in sorted(due)]
        found.sort(key=lambda message: message[0])
        if start == 0 and phase.hostile:
            yield 0, "imu/data", hostile.first_imu(first_stamp)
        yield from found
        start = end


def play(ros: Ros, publishers: dict[str, Any], messages: Iterable[Message], begin: float) -> None:
    """Publish each message when it is due, counted from `begin` (time.monotonic); serve the observer in between."""
    for due, topic, data in messages:
        while (pause := begin + due * 1e-9 - time.monotonic()) > 0.0:
            # Serving takes longer than the pauses of a burst.
            ros.spin_once(0.001) if pause > 0.002 else time.sleep(pause)
        publishers[topic].publish(data)


class Listener:
    """Publishers for the inputs of the node, and all it publishes, as bytes."""

    def __init__(self, ros: Ros) -> None:
        from rclpy.qos import QoSProfile

        qos = QoSProfile(depth=10_000)
        self.publishers = {
            topic: ros.node.create_publisher(_class_of(kind), topic, qos) for topic, kind in TYPES.items()
        }
        self._received: dict[str, list[bytes]] = {topic: [] for topic in OUTPUTS}
        self._subscriptions = [
            ros.node.create_subscription(_class_of(kind), topic, self._received[topic].append, qos, raw=True)
            for topic, kind in OUTPUTS.items()
        ]

    def take(self) -> dict[str, np.ndarray]:
        """What came since the last call, by topic: structured arrays as of `eskf_ros.bags.message_dtype`."""
        taken = {}
        for topic, data in self._received.items():
            kind = OUTPUTS[topic]
            parts = []
            # The length of a message changes when the frame of the IMU becomes known.
            for length, group in groupby(data or [b""], len):
                rows = np.frombuffer(b"".join(group), np.uint8).reshape(-1 if length else 0, length)
                messages, valid = decode(kind, rows, StringTable())
                assert valid is None, f"{topic}: the node published what is no {kind}"
                parts.append(messages)
            taken[topic] = np.concatenate(parts)
            data.clear()
        return taken


def _class_of(kind: str) -> Any:
    package, _, name = kind.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def not_finite(messages: np.ndarray) -> int:
    """How many of the messages have a number that is not finite."""
    bad = np.zeros(len(messages), bool)
    for name in messages.dtype.names or ():
        numbers = messages[name]
        if numbers.dtype.kind == "f":
            bad |= ~np.isfinite(numbers).all(axis=tuple(range(1, numbers.ndim)))
    return int(bad.sum())


def position_errors(fixes: np.ndarray, recording: Recording, first_stamp: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance (m) of `gps/filtered` from the truth, and what the node says of it: the square root of the trace.

    The recording must have truth for every IMU sample.
    """
    row = np.searchsorted(recording.truth_stamp, fixes["stamp"] - first_stamp + int(recording.imu_stamp[0]))
    frame = MapFrame(recording.datum)
    places = zip(fixes["latitude"].tolist(), fixes["longitude"].tolist(), fixes["altitude"].tolist())
    positions = np.array([frame.from_geodetic_deg(*place) for place in places]).reshape(-1, 3)
    error = np.linalg.norm(positions - recording.truth_position_map[row], axis=1)
    return error, np.sqrt(fixes["position_covariance"][:, ::4].sum(axis=1))


def resident_megabytes(pid: int) -> float:
    """Memory of a process that is in RAM (Linux)."""
    found = re.search(r"VmRSS:\s*(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) / 1024.0
