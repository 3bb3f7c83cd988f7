"""Topics of a recording that are replayed, and the messages to the user if they are missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import BagReader, Batch
from eskf_ros.filter.measurements.row import ODOMETRY, TWIST
from eskf_ros.filter.state.enums import Stream
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.inputs.table import FIX, RANGES, Input, inputs_of, uses_ranges
from eskf_ros.parameters.tree import Parameters, Topics
from eskf_ros.replay.truth import epochs_from_fix, epochs_from_odometry

IMU = "sensor_msgs/msg/Imu"


class InputError(Exception):
    """A recording or an option cannot be used; the text is one line for the user."""


@dataclass(frozen=True)
class TopicNames:
    """Names of topics in the recording; empty if missing or not wanted."""

    imu: str
    inputs: Mapping[Input, str]
    truth: str = ""
    truth_type: str = ""
    beside: frozenset[str] = frozenset()
    """Topics that come from other files than the recording."""

    def wanted(self) -> dict[str, str]:
        """Return the topics to read: topic -> type."""
        types = {self.imu: IMU}
        types |= {topic: kind.type for kind, topic in self.inputs.items() if topic not in self.beside}
        return types | ({self.truth: self.truth_type} if self.truth else {})

    def of(self, stream: Stream) -> str:
        """Return the topic of a stream; empty if it has none."""
        return next((topic for kind, topic in self.inputs.items() if kind.stream == stream), "")


def find_topics(
    reader: BagReader, bag: Path, parameters: Parameters, truth: str, has_range_file: bool = False
) -> tuple[TopicNames, list[str]]:
    """Find the topics of the parameters, and the `truth` topic unless empty, in the recording.

    All but the IMU and the topic that GNSS is used by (fixes or ranges) may be missing as long as their names are the
    defaults; with `has_range_file` the ranges come from there. If an input can have several types, the recording
    decides. The returned hints name other topics that could be the GNSS velocity.

    Raises:
        InputError: another topic is missing, has no messages or the wrong type.
    """
    names = parameters.topics
    imu = _require(reader, bag, names.imu, (IMU,), "set topics.imu in --config FILE")
    needed = "ranges" if uses_ranges(parameters) else "gnss_fix"
    inputs = {}
    empty = []
    for kind in inputs_of(parameters):
        name, remedy = getattr(names, kind.name), f"set topics.{kind.name} in --config FILE"
        if kind.name in RANGES and has_range_file:
            inputs[kind] = name
            continue
        is_required = kind.name == needed or name != getattr(Topics(), kind.name)
        there = find_topic(reader, name)
        if there and not is_required and not reader.topics[there].count:
            empty.append(f"topic {there} has no messages; the recording is replayed without it")
        elif is_required or there:
            instead = " (a RINEX file can be given with --ranges FILE.obs)" if kind.name == "ranges" else ""
            topic = _require(reader, bag, name, kind.types, remedy, instead)
            inputs[kind.of_type(reader.topics[topic].type)] = topic
    has_velocity = uses_ranges(parameters) or any(kind.stream == Stream.GNSS_VELOCITY for kind in inputs)
    hints = empty + ([] if has_velocity else _velocity_hint(reader, names, inputs))
    beside = frozenset(inputs[kind] for kind in inputs if kind.name in RANGES) if has_range_file else frozenset()
    if not truth:
        return TopicNames(imu, inputs, beside=beside), hints
    topic = _require(reader, bag, truth, (ODOMETRY, FIX), "name it with --truth TOPIC")
    if topic in (imu, *inputs.values()):
        raise InputError(f"{bag}: --truth {truth} is an input of the estimator; truth has to be another topic")
    return TopicNames(imu, inputs, topic, reader.topics[topic].type, beside), hints


def _velocity_hint(reader: BagReader, names: Topics, inputs: Mapping[Input, str]) -> list[str]:
    taken = inputs.values()
    others = [
        topic
        for topic, info in sorted(reader.topics.items())
        if info.type == TWIST and info.count and topic not in taken
    ]
    if not others:
        return []
    return [f"no GNSS velocity on {names.gnss_velocity}; if {others[0]} is one, set topics.gnss_velocity to it"]


def find_topic(reader: BagReader, name: str) -> str:
    """Return the topic `name` as it stands, in the root namespace, or in the only namespace with it; or empty."""
    relative = name.removeprefix("~").strip("/")
    for candidate in (name, f"/{relative}", relative):
        if candidate in reader.topics:
            return candidate
    inside = [] if name.startswith("/") else [topic for topic in reader.topics if topic.endswith(f"/{relative}")]
    return inside[0] if len(inside) == 1 else ""


def _require(reader: BagReader, bag: Path, name: str, types: tuple[str, ...], remedy: str, instead: str = "") -> str:
    topic = find_topic(reader, name)
    if topic and reader.topics[topic].type in types and reader.topics[topic].count:
        return topic
    if not topic:
        problem = f"no topic {name} in the recording"
    elif reader.topics[topic].type not in types:
        problem = f"topic {topic} is {reader.topics[topic].type}, not {' or '.join(types)}"
    else:
        problem = f"topic {topic} has no messages"
    there = ", ".join(f"{topic} ({info.type}, {info.count})" for topic, info in sorted(reader.topics.items()))
    fitting = [topic for topic, info in sorted(reader.topics.items()) if info.type in types and info.count]
    advice = f"{remedy}: {' or '.join(fitting)}" if fitting else f"nothing in it is {' or '.join(types)}"
    raise InputError(f"{bag}: {problem}; {advice}{instead}. It holds: {there}")


def truth_converter(topics: TopicNames, bag: Path, parameters: Parameters) -> Callable[[Batch], NDArray[Any]]:
    """Return the function that turns a batch of the truth topic into truth epochs.

    The function raises InputError for Odometry whose frame is neither `earth` nor the map frame of a configured datum.
    """

    def from_odometry(batch: Batch) -> NDArray[Any]:
        frames = {batch.strings[index] for index in np.unique(batch.messages["frame_id"]).tolist()}
        if frames == {"earth"}:
            return epochs_from_odometry(batch.messages, None)
        if frames == {parameters.frames.map}:
            if parameters.datum:
                latitude, longitude, altitude = parameters.datum
                return epochs_from_odometry(batch.messages, MapFrame((latitude, longitude, altitude)))
            raise InputError(
                f"{bag}: truth {topics.truth} is given in frame {parameters.frames.map}: "
                "set datum in --config FILE to the origin it was made with"
            )
        raise InputError(
            f"{bag}: truth {topics.truth} is given in frame {', '.join(map(repr, sorted(frames)))}; "
            f"'earth' (ECEF) or '{parameters.frames.map}' (with the parameter datum) can be compared"
        )

    return from_odometry if topics.truth_type == ODOMETRY else lambda batch: epochs_from_fix(batch.messages)
