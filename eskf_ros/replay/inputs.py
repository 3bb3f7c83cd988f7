"""What a recording is asked for: one row per kind of input, and how its messages become arguments of a push."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import Batch
from eskf_ros.filter.layout import Stream

Arguments = Iterable[tuple[Any, ...]]

UNMEASURED = -1.0


@dataclass(frozen=True)
class Input:
    """One kind of input: the parameter ``topics.NAME``, its stream, the message type.

    ``arguments`` turns a batch into those of the push of this stream, one tuple per message that begins with the stamp
    (ns). ``is_gnss``: withheld in an outage.
    """

    name: str
    stream: Stream
    type: str
    arguments: Callable[[Batch], Arguments]
    is_gnss: bool = False


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
    covariances = batch.messages["twist_covariance"].reshape(-1, 6, 6)[:, :3, :3].reshape(-1, 9)
    columns = _listed(batch.messages["stamp"]), _listed(batch.messages["linear_velocity"]), _listed(covariances)
    return zip(*columns, batch.log_time.tolist(), _frames(batch), strict=True)


def _vectors(batch: Batch, values: NDArray[Any], covariances: NDArray[Any]) -> Arguments:
    """Arguments of `Navigator.push` from values (n, 3) and covariances (n, 9)."""
    columns = _listed(batch.messages["stamp"]), _listed(values), _listed(covariances)
    return zip(*columns, batch.log_time.tolist(), strict=True)


def _headings(batch: Batch) -> Arguments:
    """Yaw (0 = east, counter-clockwise) and pitch (down is positive) of an orientation."""
    messages = batch.messages
    x, y, z, w = messages["orientation"].T
    values, covariances = np.zeros((len(messages), 3)), np.zeros((len(messages), 9))
    values[:, 0] = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    values[:, 1] = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    given = messages["orientation_covariance"]
    covariances[:, 0], covariances[:, 4] = given[:, 8], given[:, 4]
    covariances[given.any(axis=1), 8] = UNMEASURED
    return _vectors(batch, values, covariances)


def _body_velocities(batch: Batch) -> Arguments:
    covariances = batch.messages["twist_covariance"].reshape(-1, 6, 6)[:, :3, :3].reshape(-1, 9)
    return _vectors(batch, batch.messages["linear_velocity"], covariances)


def _wheels(batch: Batch) -> Arguments:
    """Speed along x and yaw rate."""
    messages = batch.messages
    values = np.zeros((len(messages), 3))
    values[:, 0] = messages["linear_velocity"][:, 0]
    values[:, 1] = messages["angular_velocity"][:, 2]
    covariance = messages["twist_covariance"].reshape(-1, 6, 6)[:, [0, 0, 5, 5], [0, 5, 0, 5]]
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


FIX = "sensor_msgs/msg/NavSatFix"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"

INPUTS = (
    Input("gnss_fix", Stream.GNSS_POSITION, FIX, _fixes, is_gnss=True),
    Input("gnss_velocity", Stream.GNSS_VELOCITY, TWIST, _gnss_velocities, is_gnss=True),
    Input("heading", Stream.HEADING, "sensor_msgs/msg/Imu", _headings, is_gnss=True),
    Input("mag", Stream.MAG, "sensor_msgs/msg/MagneticField", _mags),
    Input("wheel", Stream.WHEEL, "nav_msgs/msg/Odometry", _wheels),
    Input("body_velocity", Stream.BODY_VELOCITY, TWIST, _body_velocities),
    Input("baro", Stream.BARO, "sensor_msgs/msg/FluidPressure", _pressures),
)
"""All but the IMU. The order is that of messages with one log time."""
