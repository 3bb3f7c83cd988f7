"""The sensors of a recording: which topic is which input, and the numbers of their messages.

No right configuration is needed: a topic that the parameters do not name is found by its type and, where several
sensors have the same type, by words in its name.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import Batch, open_bag
from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.filter.measurements.row import Row
from eskf_ros.filter.rows import ROWS
from eskf_ros.inputs.table import INPUTS, RANGES, Input
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.topics import IMU, find_topic

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

HINTS = {
    "gnss_velocity": ("vel", "gps", "gnss", "ublox", "fix"),
    "heading": ("heading", "yaw", "hdt", "dual"),
    "wheel": ("wheel", "odom", "speed"),
    "body_velocity": ("dvl", "flow", "radar", "body"),
}
"""Words of which one stands in the name of a topic, for inputs whose message type says too little."""

NOT_MEASURED = ("filter", "truth", "fused", "cmd", "global", "local", "setpoint")
"""Words in the names of topics that hold results, references or wishes, not measurements."""


@dataclass
class Sensor:
    """All messages of one input, in the order of log time.

    ``name``: "imu", or that of the `Input`. ``log_time``, ``stamp``: (n,) ns. ``frame``: (n,) which of ``frames``.
    ``values``: (n, 6) of an IMU, specific force (m/s2) and angular rate (rad/s); (n, 3) of a fix, degrees, degrees, m;
    else (n, 3), what the measurement's `Row.read` gives; (n, 0) of clouds. ``covariance``: (n, 9) or (n, 0).
    ``status``, ``covariance_type``: (n,) of a fix, else empty.
    """

    name: str
    topic: str
    type: str
    log_time: Stamps
    stamp: Stamps
    frame: NDArray[np.int32]
    values: Array
    covariance: Array
    status: NDArray[np.int64]
    covariance_type: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.stamp)

    def by_stamp(self) -> Sensor:
        """Return the messages of the commonest frame by stamp, the first of those with one stamp, none without one."""
        frames, counts = np.unique(self.frame, return_counts=True)
        chosen = np.flatnonzero((self.stamp > 0) & (self.frame == frames[np.argmax(counts)] if len(frames) else False))
        _, first = np.unique(self.stamp[chosen], return_index=True)
        return self.at(chosen[first])

    def at(self, rows: NDArray[Any]) -> Sensor:
        """Return some of the messages."""
        columns = ("log_time", "stamp", "frame", "values", "covariance", "status", "covariance_type")
        return dataclasses.replace(
            self, **{name: getattr(self, name)[rows] for name in columns if len(getattr(self, name)) == len(self)}
        )


@dataclass(frozen=True)
class Recording:
    """What is known of a recording: its topics (name -> type, count, input), its sensors, what was found on the way.

    ``parameters``: those given, with the names of the topics that were found.
    """

    path: Path
    topics: dict[str, tuple[str, int, str]]
    sensors: dict[str, Sensor]
    parameters: Parameters
    duration: float
    findings: list[Finding]


def read_recording(path: Path, parameters: Parameters, progress: Callable[[float], None]) -> Recording:
    """Read the sensors of a recording; memory is 100 bytes for each sample of the IMU.

    Raises BagError if it cannot be read.
    """
    findings: list[Finding] = []
    with open_bag([path]) as reader:
        found: dict[str, tuple[str, Input | None]] = {}
        for name, kind in [("imu", None), *((kind.name, kind) for kind in INPUTS)]:
            types = (IMU,) if kind is None else kind.types
            taken = [topic for topic, _ in found.values()]
            configured = find_topic(reader, getattr(parameters.topics, name))
            there = {topic: info for topic, info in reader.topics.items() if info.type in types and info.count}
            if configured in there:
                found[name] = configured, kind
                continue
            others = [topic for topic in there if topic not in taken and _may_be(name, topic)]
            if others:
                best = max(others, key=lambda topic: there[topic].count)
                found[name] = best, kind
                findings.append(_other_name(name, best, others, getattr(parameters.topics, name)))
        names = {name: topic for name, (topic, _) in found.items()}
        parameters = dataclasses.replace(parameters, topics=dataclasses.replace(parameters.topics, **names))
        parts: dict[str, list[Sensor]] = {name: [] for name in found}
        types_by_topic = {topic: reader.topics[topic].type for topic, _ in found.values()}
        for batch in reader.batches(types_by_topic):
            for name, (topic, kind) in found.items():
                if topic in batch:
                    parts[name].append(_sensor(name, topic, types_by_topic[topic], kind, batch[topic]))
            progress(reader.bytes_done / reader.bytes_total)
        inputs = {topic: name for name, topic in names.items()}
        topics = {t: (info.type, info.count, inputs.get(t, "")) for t, info in sorted(reader.topics.items())}
        findings += [
            Finding(Severity.WARNING, "damaged_file", "", warning, "copy the recording again, or record it anew")
            for warning in reader.warnings
        ]
        duration = (reader.end_time - reader.start_time) * 1e-9
    sensors = {name: _joined(found) for name, found in parts.items() if found}
    return Recording(path, topics, sensors, parameters, duration, findings + _missing(sensors, topics))


def _may_be(name: str, topic: str) -> bool:
    words = topic.lower()
    if any(word in words for word in NOT_MEASURED):
        return False
    if name == "imu" and any(word in words for word in HINTS["heading"]):
        return False
    return name not in HINTS or any(word in words for word in HINTS[name])


def _other_name(name: str, topic: str, others: list[str], configured: str) -> Finding:
    more = [other for other in others if other != topic]
    also = f" (others of its type: {', '.join(more)})" if more else ""
    return Finding(
        Severity.NOTE,
        "topic_name",
        topic,
        f"taken for the {name.replace('_', ' ')}, which the parameters call {configured}{also}",
        f"set topics.{name} to {topic}",
        {"others": len(more)},
        {f"topics.{name}": topic},
    )


def _missing(sensors: dict[str, Sensor], topics: dict[str, tuple[str, int, str]]) -> list[Finding]:
    there = ", ".join(f"{topic} ({kind}, {count})" for topic, (kind, count, _) in topics.items())
    found = []
    if "imu" not in sensors:
        text = f"no messages of an IMU ({IMU}); it holds {there}"
        found.append(Finding(Severity.ERROR, "no_imu", "", text, "record the IMU: nothing works without it"))
    if "gnss_fix" not in sensors and "ranges" not in sensors:
        text = f"no fixes ({INPUTS[0].type}) and no ranges of satellites; it holds {there}"
        found.append(Finding(Severity.ERROR, "no_fixes", "", text, "record the fixes of the receiver"))
    elif "gnss_fix" not in sensors:
        text = "no fixes, but ranges of satellites"
        found.append(Finding(Severity.NOTE, "ranges_only", "", text, "set mode to tight", {}, {"mode": "tight"}))
    if "gnss_fix" in sensors and "gnss_velocity" not in sensors:
        text = "no velocity of the receiver: heading and speed are found later and worse"
        remedy = "record it (geometry_msgs/TwistWithCovarianceStamped, East-North-Up), if the receiver has one"
        found.append(Finding(Severity.NOTE, "no_velocity", "", text, remedy))
    return found


_READ: dict[Any, Row] = {row.stream: row for row in ROWS}


def _sensor(name: str, topic: str, type_name: str, kind: Input | None, batch: Batch) -> Sensor:
    """Return the messages of a batch as a part of a sensor."""
    messages = batch.messages
    nothing = np.zeros(len(messages), np.int64)
    status, covariance_type = nothing[:0], nothing[:0]
    values, covariance = np.zeros((len(messages), 0)), np.zeros((len(messages), 0))
    if kind is None:
        values = np.concatenate([messages["linear_acceleration"], messages["angular_velocity"]], axis=1)
    elif name == "gnss_fix":
        values = np.stack([messages["latitude"], messages["longitude"], messages["altitude"]], axis=1)
        covariance = np.array(messages["position_covariance"])
        status, covariance_type = messages["status"].astype(np.int64), messages["position_covariance_type"].astype("i8")
    elif name not in RANGES and (read := _READ[kind.stream].read) is not None:
        values, covariance = (np.array(part, np.float64) for part in read(messages))
    stamp, frame = np.array(messages["stamp"]), np.array(messages["frame_id"])
    return Sensor(
        name, topic, type_name, batch.log_time, stamp, frame, values, covariance, status, covariance_type
    )  # fmt: skip


def _joined(parts: list[Sensor]) -> Sensor:
    columns = ("log_time", "stamp", "frame", "values", "covariance", "status", "covariance_type")
    return dataclasses.replace(
        parts[0],
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in columns},  # type: ignore[arg-type]
    )
