"""The inputs of the estimator but for the IMU: one row each, for the node and for the replay alike.

Both read serialised messages into batches (`eskf_ros.bags`), a recording by the thousand and the node one by one; from
there on they share what is here, so that they give the estimator the same numbers, bit for bit.

A new input is a row of `INPUTS`, a function that makes arguments of its messages, and the parameter ``topics.NAME``; in
the estimator it is a `Stream`, its `Intake` (`filter.settings`), a file in `filter.aiding` and the line in
`filter.fusion.linearize` that calls it. A message type that is not there yet is a row of
`bags.messages.MESSAGE_TYPES`. A second type for the same thing is an entry in ``others`` and a choice of the parameter
``topics.NAME_type``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import POINT_CLOUD, Batch
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Stream
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.parameters.tree import Parameters

Arguments = Iterable[tuple[Any, ...]]
Converter = Callable[[Batch], Arguments]

UNMEASURED = -1.0


@dataclass(frozen=True)
class Input:
    """One kind of input: the parameter ``topics.NAME``, its stream, the message type.

    ``arguments`` turns a batch into those of the push of this stream, one tuple per message that begins with the stamp
    (ns). ``others``: further types that say the same, with what makes arguments of them. ``push``: the method of
    `Navigator`, or of `RangeIntake`, that takes the arguments; empty: `Navigator.push`, with the stream. ``is_gnss``:
    withheld in an outage.
    ``by_receiver``: two receivers may share the topic, told apart by the frame. ``depth``: messages that may wait in
    the node while the computer is busy elsewhere, a second of a fast sensor. ``is_timed``: its stamps are instants of
    measurements.
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
        """All message types it can be, the usual one first."""
        return (self.type, *(name for name, _ in self.others))

    def of_type(self, name: str) -> Input:
        """The same input, read from messages of another of its types."""
        converters = {self.type: self.arguments, **dict(self.others)}
        return dataclasses.replace(self, type=name, arguments=converters[name], others=())

    def push_of(self, navigator: Navigator, intake: RangeIntake | None = None) -> Callable[..., Any]:
        """What takes the arguments: the navigator, or for ranges and ephemerides their intake."""
        if not self.push:
            return partial(navigator.push, self.stream)
        taker: Callable[..., Any] = getattr(intake if self.name in RANGES else navigator, self.push)
        return taker


def _listed(column: NDArray[Any]) -> list[Any]:
    """Numbers as Python numbers, vectors as arrays."""
    return column.tolist() if column.ndim == 1 else list(np.ascontiguousarray(column))


def _frames(batch: Batch) -> list[str]:
    return [batch.strings[index] for index in batch.messages["frame_id"].tolist()]


def _fixes(batch: Batch) -> Arguments:
    names = ("stamp", "latitude", "longitude", "altitude", "position_covariance", "position_covariance_type", "status")
    columns = [_listed(batch.messages[name]) for name in names]
    return zip(*columns, batch.log_time.tolist(), _frames(batch), strict=True)


def _gnss_velocities(batch: Batch) -> Arguments:
    columns = _listed(batch.messages["stamp"]), _listed(batch.messages["linear_velocity"]), _listed(_linear(batch))
    return zip(*columns, batch.log_time.tolist(), _frames(batch), strict=True)


def _twist_covariances(batch: Batch) -> NDArray[np.float64]:
    """Covariances (n, 6, 6) of the twists; all zero where the type of the messages has none."""
    names = batch.messages.dtype.names or ()
    given = batch.messages["twist_covariance"] if "twist_covariance" in names else np.zeros((len(batch.messages), 36))
    return given.reshape(-1, 6, 6)


def _linear(batch: Batch) -> NDArray[np.float64]:
    """Covariances (n, 9) of the linear velocities."""
    return _twist_covariances(batch)[:, :3, :3].reshape(-1, 9)


def _vectors(batch: Batch, values: NDArray[Any], covariances: NDArray[Any]) -> Arguments:
    """Arguments of `Navigator.push` from values (n, 3) and covariances (n, 9)."""
    columns = _listed(batch.messages["stamp"]), _listed(values), _listed(covariances)
    return zip(*columns, batch.log_time.tolist(), strict=True)


def _headings(batch: Batch) -> Arguments:
    """Yaw (0 = east, counter-clockwise) and pitch (down is positive) of an orientation, if there is one (REP-145)."""
    messages = batch.messages
    x, y, z, w = messages["orientation"].T
    values, covariances = np.zeros((len(messages), 3)), np.zeros((len(messages), 9))
    values[:, 0] = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    values[:, 1] = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    given = messages["orientation_covariance"]
    covariances[:, 0], covariances[:, 4] = given[:, 8], given[:, 4]
    covariances[given.any(axis=1), 8] = UNMEASURED
    # Drivers that know the yaw only leave the pitch zero, and its variance.
    covariances[(given[:, 8] > 0.0) & (given[:, 4] == 0.0), 4] = UNMEASURED
    covariances[given[:, 0] == UNMEASURED] = UNMEASURED
    values[np.abs(x * x + y * y + z * z + w * w - 1.0) > 0.1] = math.nan
    return _vectors(batch, values, covariances)


def _body_velocities(batch: Batch) -> Arguments:
    return _vectors(batch, batch.messages["linear_velocity"], _linear(batch))


def _wheels(batch: Batch) -> Arguments:
    """Speed along x and yaw rate."""
    messages = batch.messages
    values = np.zeros((len(messages), 3))
    values[:, 0] = messages["linear_velocity"][:, 0]
    values[:, 1] = messages["angular_velocity"][:, 2]
    covariance = _twist_covariances(batch)[:, [0, 0, 5, 5], [0, 5, 0, 5]]
    return _vectors(batch, values, _padded(covariance))


def _padded(two_by_two: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariances (n, 4) as (n, 9) with an axis that was not measured; all zero stays all zero."""
    padded = np.zeros((len(two_by_two), 9))
    padded[:, [0, 1, 3, 4]] = two_by_two
    padded[two_by_two.any(axis=1), 8] = UNMEASURED
    return padded


def _mags(batch: Batch) -> Arguments:
    return _vectors(batch, batch.messages["magnetic_field"], batch.messages["magnetic_field_covariance"])


def _pressures(batch: Batch) -> Arguments:
    messages = batch.messages
    values, covariances = np.zeros((len(messages), 3)), np.zeros((len(messages), 9))
    values[:, 0] = messages["fluid_pressure"]
    covariances[:, 0] = messages["variance"]
    covariances[messages["variance"] != 0.0, 4::4] = UNMEASURED
    return _vectors(batch, values, covariances)


def _clouds(batch: Batch) -> Arguments:
    messages = batch.messages
    return zip(messages["stamp"].tolist(), messages["points"], batch.log_time.tolist(), strict=True)


FIX = "sensor_msgs/msg/NavSatFix"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
BARE_TWIST = "geometry_msgs/msg/TwistStamped"

INPUTS = (
    Input(
        "gnss_fix",
        Stream.GNSS_POSITION,
        FIX,
        _fixes,
        push="push_gnss_position",
        is_gnss=True,
        by_receiver=True,
        depth=50,
    ),
    Input(
        "gnss_velocity",
        Stream.GNSS_VELOCITY,
        TWIST,
        _gnss_velocities,
        ((BARE_TWIST, _gnss_velocities),),
        push="push_gnss_velocity",
        is_gnss=True,
        by_receiver=True,
        depth=50,
    ),
    Input("heading", Stream.HEADING, "sensor_msgs/msg/Imu", _headings, is_gnss=True, depth=50),
    Input("mag", Stream.MAG, "sensor_msgs/msg/MagneticField", _mags),
    Input("wheel", Stream.WHEEL, ODOMETRY, _wheels, ((TWIST, _wheels), (BARE_TWIST, _wheels))),
    Input(
        "body_velocity",
        Stream.BODY_VELOCITY,
        TWIST,
        _body_velocities,
        ((BARE_TWIST, _body_velocities), (ODOMETRY, _body_velocities)),
    ),
    Input("ephemerides", Stream.PSEUDORANGE, POINT_CLOUD, _clouds, push="take_ephemerides", depth=50, is_timed=False),
    Input("ranges", Stream.PSEUDORANGE, POINT_CLOUD, _clouds, push="take_ranges", is_gnss=True, depth=50),
    Input("baro", Stream.BARO, "sensor_msgs/msg/FluidPressure", _pressures),
)
"""All but the IMU. The order is that of messages with one log time."""

FIXES = ("gnss_fix", "gnss_velocity")
RANGES = ("ranges", "ephemerides")


def inputs_of(parameters: Parameters) -> tuple[Input, ...]:
    """The rows in use: what a receiver solved or its ranges; beside ranges the fixes of a second receiver, if any.

    What the first receiver solved comes on the same topics as that of the second: the navigator refuses it.
    """
    unused: tuple[str, ...] = RANGES
    if uses_ranges(parameters):
        unused = () if parameters.second_gnss.frame_id else FIXES
    return tuple(kind for kind in INPUTS if kind.name not in unused)


def uses_ranges(parameters: Parameters) -> bool:
    """Whether the first receiver is used by its ranges."""
    return parameters.mode == "tight" or parameters.ranges.use_point_solution


def time_offset_of(kind: Input, parameters: Parameters) -> float:
    """What is added to the stamps of an input (s)."""
    group = "gnss" if kind.name in FIXES else "ranges" if kind.name in RANGES else kind.name
    offset: float = getattr(parameters, group).time_offset
    return offset
