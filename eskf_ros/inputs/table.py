"""The inputs of the estimator other than the IMU: one row each, for node and replay alike.

Both read serialised messages into batches (`eskf_ros.bags`), a recording by the thousand and the node one by one. From
there on they share this file, so that they give the estimator the same numbers, bit for bit.

A sensor that sends values with covariances needs no line here: its input is made of the row of its measurement
(`filter.measurements.row.Row`; see `docs/add_a_measurement.md`). Other inputs are rows of `INPUTS`, with a function
that turns messages into the arguments of a push. A message type that is not there yet is a row of
`bags.messages.MESSAGE_TYPES`. A second type for the same input is an entry in ``others`` and a choice of the parameter
``topics.NAME_type``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import POINT_CLOUD, Batch
from eskf_ros.filter.measurements import gnss_position, gnss_velocity
from eskf_ros.filter.measurements.row import TWIST, Row, linear_covariances
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.rows import SENSORS
from eskf_ros.filter.state.enums import Stream
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.parameters.tree import Parameters

Arguments = Iterable[tuple[Any, ...]]
Converter = Callable[[Batch], Arguments]


FIX = gnss_position.ROW.types[0]


@dataclass(frozen=True)
class Input:
    """One input: the parameter ``topics.NAME``, its stream, the message type.

    ``arguments`` turns a batch into the arguments of the push of this stream: one tuple per message, which begins with
    the stamp (ns). ``others``: further message types for the same input, each with its converter. ``push``: the method
    of `Navigator`, or of `RangeIntake`, that takes the arguments; empty: `Navigator.push`, with the stream.
    ``is_gnss``: withheld in a simulated outage. ``by_receiver``: two receivers may share the topic, told apart by the
    frame. ``depth``: messages that may wait in the node while the computer is busy elsewhere, a second of a fast
    sensor. ``is_timed``: its stamps are instants of measurements.
    """

    name: str
    stream: Stream
    type: str
    arguments: Converter
    others: tuple[tuple[str, Converter], ...] = ()
    push: str = ""
    is_gnss: bool = False
    by_receiver: bool = False
    depth: int = 1000
    is_timed: bool = True

    @property
    def types(self) -> tuple[str, ...]:
        """All its message types, the usual one first."""
        return (self.type, *(name for name, _ in self.others))

    def of_type(self, name: str) -> Input:
        """Return the same input, read from messages of another of its types."""
        converters = {self.type: self.arguments, **dict(self.others)}
        return dataclasses.replace(self, type=name, arguments=converters[name], others=())

    def push_of(self, navigator: Navigator, intake: RangeIntake | None = None) -> Callable[..., Any]:
        """Return what takes the arguments: a method of the navigator, or of the intake of ranges and ephemerides."""
        if not self.push:
            return partial(navigator.push, self.stream)
        taker: Callable[..., Any] = getattr(intake if self.name in RANGES else navigator, self.push)
        return taker


def _listed(column: NDArray[Any]) -> list[Any]:
    """Return numbers as Python numbers, vectors as arrays."""
    return column.tolist() if column.ndim == 1 else list(np.ascontiguousarray(column))


def _frames(batch: Batch) -> list[str]:
    return [batch.strings[index] for index in batch.messages["frame_id"].tolist()]


def _fixes(batch: Batch) -> Arguments:
    names = ("stamp", "latitude", "longitude", "altitude", "position_covariance", "position_covariance_type", "status")
    columns = [_listed(batch.messages[name]) for name in names]
    return zip(*columns, batch.log_time.tolist(), _frames(batch), strict=True)


def _gnss_velocities(batch: Batch) -> Arguments:
    columns = (
        _listed(batch.messages["stamp"]),
        _listed(batch.messages["linear_velocity"]),
        _listed(linear_covariances(batch.messages)),
    )
    return zip(*columns, batch.log_time.tolist(), _frames(batch), strict=True)


def _vectors(batch: Batch, values: NDArray[Any], covariances: NDArray[Any]) -> Arguments:
    """Return the arguments of `Navigator.push` for values (n, 3) and covariances (n, 9)."""
    columns = _listed(batch.messages["stamp"]), _listed(values), _listed(covariances)
    return zip(*columns, batch.log_time.tolist(), strict=True)


def _of_row(row: Row) -> Input:
    """Return the input of a sensor whose row says how its messages are read."""

    def arguments(batch: Batch) -> Arguments:
        assert row.read is not None
        return _vectors(batch, *row.read(batch.messages))

    others = tuple((name, arguments) for name in row.types[1:])
    return Input(row.name, row.stream, row.types[0], arguments, others, is_gnss=row.is_gnss, depth=row.depth)


def _clouds(batch: Batch) -> Arguments:
    messages = batch.messages
    return zip(messages["stamp"].tolist(), messages["points"], batch.log_time.tolist(), strict=True)


INPUTS = (
    Input(
        "gnss_fix",
        Stream.GNSS_POSITION,
        FIX,
        _fixes,
        push="push_gnss_position",
        is_gnss=True,
        by_receiver=True,
        depth=gnss_position.ROW.depth,
    ),
    Input(
        "gnss_velocity",
        Stream.GNSS_VELOCITY,
        TWIST,
        _gnss_velocities,
        tuple((name, _gnss_velocities) for name in gnss_velocity.ROW.types[1:]),
        push="push_gnss_velocity",
        is_gnss=True,
        by_receiver=True,
        depth=gnss_velocity.ROW.depth,
    ),
    *map(_of_row, SENSORS),
    Input("ephemerides", Stream.PSEUDORANGE, POINT_CLOUD, _clouds, push="take_ephemerides", depth=50, is_timed=False),
    Input("ranges", Stream.PSEUDORANGE, POINT_CLOUD, _clouds, push="take_ranges", is_gnss=True, depth=50),
)
"""All inputs but the IMU. Messages with the same log time come in this order."""

FIXES = ("gnss_fix", "gnss_velocity")
RANGES = ("ranges", "ephemerides")


def inputs_of(parameters: Parameters) -> tuple[Input, ...]:
    """Return the inputs in use: the solutions of a receiver, or its ranges and the solutions of a second receiver.

    The solutions of the first receiver come on the same topics as those of the second: the navigator refuses them.
    """
    unused: tuple[str, ...] = RANGES
    if uses_ranges(parameters):
        unused = () if parameters.second_gnss.frame_id else FIXES
    return tuple(kind for kind in INPUTS if kind.name not in unused)


def uses_ranges(parameters: Parameters) -> bool:
    """Return whether the ranges of the first receiver are used instead of its solutions."""
    return parameters.mode == "tight" or parameters.ranges.use_point_solution


def time_offset_of(kind: Input, parameters: Parameters, receiver: int = 0) -> float:
    """Return the time offset (s) that is added to the stamps of an input, if it is one of a ``receiver`` of this."""
    group = "gnss" if kind.name in FIXES else "ranges" if kind.name in RANGES else kind.name
    if receiver == 1 and kind.by_receiver:
        group = "second_gnss"
    offset: float = getattr(parameters, group).time_offset
    return offset + (parameters.gnss.velocity_time_offset if kind.stream == Stream.GNSS_VELOCITY else 0.0)
