"""The inputs of `eskf_ros.inputs.table` as topics of the node: each reads serialised messages one by one."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from eskf_ros.bags import Batch, StringTable, decode
from eskf_ros.filter.state.time import SECOND
from eskf_ros.inputs.table import Arguments, Input, inputs_of, time_offset_of
from eskf_ros.parameters.schema import ParameterError
from eskf_ros.parameters.tree import Parameters
from eskf_ros.ros_node.clocks import StampMonitor


def message_class(type_name: str) -> Any:
    """Return the class of a type such as sensor_msgs/msg/Imu. Raises ImportError if its package is not installed."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


class AidInput:
    """One input: the messages of its topic, and a stamp monitor for each receiver that sends on it.

    Attributes:
        kind: the input.
        name: of the topic, as in the parameters.
        message_class: the chosen one, of rclpy.
        is_uncarried: whether the last message has a second or more of nanoseconds in its stamp.
        monitors: of the first receiver, and of the second where there is one and it sends on this topic; none if
            stamps are no instants of measurements.
    """

    def __init__(self, kind: Input, parameters: Parameters, topic: str) -> None:
        """Prepare the input; `topic`: the resolved name. Raises ParameterError if the message type is not installed."""
        self.kind = kind
        self.is_uncarried = False
        self._chosen = kind.of_type(getattr(parameters.topics, f"{kind.name}_type", kind.type))
        self.name: str = getattr(parameters.topics, kind.name)
        self._second_frame = parameters.second_gnss.frame_id if kind.by_receiver else ""
        try:
            self.message_class = message_class(self._chosen.type)
        except ImportError as error:
            problem = f"{self._chosen.type} is not installed here: {error}"
            raise ParameterError(f"topics.{kind.name}_type", [problem]) from error
        window = parameters.history.window
        self.monitors = [StampMonitor(topic, window)] if kind.is_timed else []
        if self._second_frame:
            self.monitors.append(StampMonitor(topic, window, self._second_frame))
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        """Use the time offsets of these parameters."""
        self._offsets = [round(time_offset_of(self.kind, parameters, receiver) * SECOND) for receiver in (0, 1)]

    def read(self, data: bytes, arrival: int) -> Batch:
        """Return one serialised message as a batch. Raises ValueError, or what rclpy raises, if it has another type."""
        batch = self._decoded(data, arrival)
        if batch is None:
            # It may have another encoding: the message library writes it again in its own.
            batch = self._decoded(serialize_message(deserialize_message(data, self.message_class)), arrival)
        if batch is None:
            raise ValueError(f"not a serialised {self._chosen.type}")
        return batch

    def arguments(self, batch: Batch) -> Arguments:
        """Return the arguments for the push of this input, one tuple per message of a batch."""
        return self._chosen.arguments(batch)

    def _decoded(self, data: bytes, arrival: int) -> Batch | None:
        # Each message has its own string table: names that never come again must not fill the memory.
        strings = StringTable()
        messages, valid = decode(self._chosen.type, np.frombuffer(data, np.uint8)[None], strings)
        self.is_uncarried = strings.uncarried > 0
        return Batch(np.array([arrival]), messages, strings.values) if valid is None else None

    def receiver(self, frame: str) -> int:
        """Return which receiver has sent a message with this frame: 0 the first, 1 the second."""
        return int(self._second_frame != "" and frame == self._second_frame)

    def offset(self, receiver: int) -> int:
        """Return the time offset (ns) that is added to the stamps of a receiver."""
        return self._offsets[receiver]


def open_inputs(parameters: Parameters, resolve: Callable[[str], str]) -> list[AidInput]:
    """Return every input in use, in the type that the parameters choose; `resolve` makes the full name of a topic."""
    return [
        AidInput(kind, parameters, resolve(getattr(parameters.topics, kind.name))) for kind in inputs_of(parameters)
    ]
