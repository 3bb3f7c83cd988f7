"""One row of facts for each measurement: all that the rest of the package has to know of it.

The row stands in the file of the measurement, beside its equations. Settings, inputs, parameters, extrinsics,
diagnostics and the documentation read it; `fuse.MEASUREMENTS` lists the rows. `docs/add_a_measurement.md` shows how to
write a new one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from eskf_ros.filter.state.enums import Stream
from eskf_ros.geodesy.rotation import from_roll_pitch_yaw, to_matrix

Axes = tuple[float, float, float]
Deviation = float | tuple[float, ...]
FloatArray = npt.NDArray[np.float64]
Readings = tuple[FloatArray, FloatArray]
"""Values (n, 3) of n messages and their covariances (n, 9), row by row."""

HIGHEST_SPEED = 600.0
"""m/s; no sensor on a robot reports more."""

TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
BARE_TWIST = "geometry_msgs/msg/TwistStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
"""Types of messages that carry a velocity."""

UNMEASURED = -1.0
"""The variance of an axis that was not measured (REP-145 writes it for a quantity that is not there)."""

NEEDS_LEVEL, NEEDS_POSITION, NEEDS_HEADING, NEEDS_FIELD = 0, 1, 2, 4
"""What must be known, besides the level, before a measurement can be fused. A sum of them means all of them."""

NOTHING = np.dtype([])
"""Settings of a measurement that has none of its own."""


@dataclass(frozen=True)
class Intake:
    """How the messages of a stream are checked and conditioned before they enter the timeline.

    ``std_floor`` and ``unknown_std`` are per axis, in the unit of the values; ``unknown_std`` stands in for a missing
    covariance. A message with a value beyond ``largest``, or with a first value below ``lowest``, is refused.
    ``may_lack_axes``: a negative variance, or one above ``largest_variance``, says that the axis was not measured.
    """

    is_used: bool
    time_offset: float
    covariance_scale: float
    std_floor: Axes
    unknown_std: Axes
    largest: float
    may_lack_axes: bool = False
    largest_variance: float = math.inf
    lowest: float = -math.inf


class OptionalBlock(NamedTuple):
    """Augmented states of one kind (`OPTIONAL_SIZES`).

    ``std``: the initial one; ``correlation_time`` in s, 0 for a random walk; ``streams``: those that need the states.
    """

    name: str
    is_on: bool
    std: Deviation
    noise_density: Deviation = 0.0
    correlation_time: float = 0.0
    streams: tuple[Stream, ...] = ()


@dataclass(frozen=True)
class Place:
    """Where a sensor sits.

    ``position``, ``rotation``: names of the parameters; empty if the measurement does not depend on it. ``inputs``: the
    inputs whose messages name the frame of the sensor.
    """

    position: str = ""
    rotation: str = ""
    inputs: tuple[str, ...] = ()


def nothing(*_: Any) -> tuple[OptionalBlock, ...]:
    """Return nothing: no augmented states, no settings."""
    return ()


@dataclass(frozen=True)
class Row:
    """The facts of one measurement.

    ``label`` is its name in the diagnostics, ``group`` the class of its parameters, ``about`` their headline in the
    documentation. ``group_name`` is the name of the group; empty: that of the stream in lower case.

    For a measurement that a sensor sends: ``types`` are the message types (the usual one first), ``topic`` the default
    of the parameter ``topics.NAME`` and ``topic_about`` its description; ``read`` turns a structured array of messages
    into values and covariances; ``limits`` turns a group of parameters into fields of the `Intake`; ``depth``: messages
    that may wait in the node while the computer is busy elsewhere; ``is_gnss``: withheld in a simulated outage.

    ``needs``: what must be known before it is fused. ``gate_probability``: replaces the parameter of this name.
    ``augmented`` returns the augmented states that the parameters ask for. ``place``: where the sensor sits, if the
    measurement depends on it. ``settings``: record of what the kernels read as ``settings.NAME``; ``describe`` fills it
    from the parameters. ``is_enabled``: for a constraint, whether the parameters switch it on.

    For tables in memory (`eskf_ros.run`): ``columns`` of the values, one of which may be left out
    (``optional_column``); ``is_vector``: one column of three numbers; ``has_one_unit``: one variance may stand for all
    axes.
    """

    stream: Stream
    label: str
    group: type | None = None
    about: str = ""
    group_name: str = ""
    types: tuple[str, ...] = ()
    topic: str = ""
    topic_about: str = ""
    read: Callable[[npt.NDArray[Any]], Readings] | None = None
    limits: Callable[[Any], dict[str, Any]] | None = None
    depth: int = 1000
    is_gnss: bool = False
    needs: int = NEEDS_POSITION | NEEDS_HEADING
    gate_probability: float | None = None
    augmented: Callable[[Any], tuple[OptionalBlock, ...]] = nothing
    place: Place | None = None
    settings: np.dtype = NOTHING
    describe: Callable[[np.void, Any], Any] = nothing
    is_enabled: Callable[[Any], bool] | None = None
    columns: tuple[str, ...] = ()
    optional_column: str = ""
    is_vector: bool = False
    has_one_unit: bool = True

    @property
    def name(self) -> str:
        """Name of the stream, of its topic, and of its record in the settings."""
        return self.stream.name.lower()

    @property
    def parameters(self) -> str:
        """Name of the group of its parameters."""
        return self.group_name or self.name

    @property
    def is_sent(self) -> bool:
        """Whether a sensor sends it as values with a covariance.

        The solutions of a GNSS receiver have intakes of their own.
        """
        return self.read is not None and self.group is not None


def threefold(value: float) -> Axes:
    """Return the same value for three axes."""
    return (value, value, value)


def to_base(rpy_deg: tuple[float, ...]) -> FloatArray:
    """Return the rotation matrix (3, 3) to base_link from the axes of a sensor with this mounting (deg)."""
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    return np.array(to_matrix(from_roll_pitch_yaw(roll, pitch, yaw)))


def arm_body(position_base: tuple[float, ...], parameters: Any) -> FloatArray:
    """Return the lever arm (3,) (m, IMU axes) from the IMU to a point of base_link (m)."""
    imu = parameters.imu
    arm: FloatArray = np.subtract(position_base, imu.mount_position) @ to_base(imu.mount_rpy_deg)
    return arm


def twist_covariances(messages: npt.NDArray[Any]) -> FloatArray:
    """Return the covariances (n, 6, 6) of the twists of messages; all zero where their type has none."""
    names = messages.dtype.names or ()
    given = messages["twist_covariance"] if "twist_covariance" in names else np.zeros((len(messages), 36))
    return given.reshape(-1, 6, 6)


def linear_covariances(messages: npt.NDArray[Any]) -> FloatArray:
    """Return the covariances (n, 9) of the linear velocities of messages; all zero where their type has none."""
    return twist_covariances(messages)[:, :3, :3].reshape(-1, 9)
