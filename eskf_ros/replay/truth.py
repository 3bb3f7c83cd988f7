"""Comparison of the estimate with a reference trajectory: errors and consistency (NEES).

Truth arrives in blocks and is compared as soon as the estimate has passed it, so that memory holds a few seconds of
both and then a few numbers per truth epoch. The estimate is interpolated between the two rows around a truth stamp; if
these are further apart than `LARGEST_GAP`, nothing is compared.

Positions are subtracted in Earth-centred axes and errors are given in East-North-Up at the estimate, so the figures do
not depend on the distance to the datum.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy import earth
from eskf_ros.geodesy.map_frame import MapFrame, east_north_up_to_ecef, to_geodetic

Array = NDArray[np.float64]

LARGEST_GAP = 100_000_000
"""ns; the estimate is not interpolated over a longer interval."""
KEPT = 10_000_000_000
"""ns; rows are kept for this long, for truth that is recorded later than its stamp."""

EPOCH = np.dtype(
    [
        ("stamp", "i8"),
        ("position_ecef", "f8", (3,)),
        ("rotation_body_to_ecef", "f8", (3, 3)),
        ("speed", "f8"),
        ("covariance_enu", "f8", (3, 3)),
    ]
)
"""One truth epoch; missing values are NaN (rotation, speed) or zero (covariance)."""

COMPARED = np.dtype(
    [
        ("stamp", "i8"),
        ("horizontal", "f8"),
        ("vertical", "f8"),
        ("speed", "f8"),
        ("heading_deg", "f8"),
        ("nees_position", "f8"),
        ("nees_attitude", "f8"),
        ("error_enu", "f8", (3,)),
        ("std_enu", "f8", (3,)),
        ("attitude_error_deg", "f8", (3,)),
        ("attitude_std_deg", "f8", (3,)),
        ("truth_map", "f8", (3,)),
    ]
)
"""One compared epoch: absolute errors (m, m, m/s, deg) and NEES; NaN if truth or estimate has no such value.

With signs, estimate minus truth, and the standard deviations they are judged by: ``error_enu`` (m) East-North-Up,
``attitude_error_deg`` about the map axes. ``truth_map``: the truth in `map` (m), of base_link or of the antenna.
"""


def epochs_from_odometry(messages: NDArray[Any], map_frame: MapFrame | None) -> NDArray[Any]:
    """Return truth epochs of base_link from nav_msgs/Odometry (n,) in `map_frame` or, if that is None, in ECEF."""
    epochs = np.zeros(len(messages), EPOCH)
    epochs["stamp"] = messages["stamp"]
    epochs["position_ecef"] = messages["position"]
    epochs["rotation_body_to_ecef"] = rotation_matrices(messages["orientation"][:, [3, 0, 1, 2]])
    epochs["speed"] = np.linalg.norm(messages["linear_velocity"], axis=1)
    if map_frame is not None:
        epochs["position_ecef"] = map_frame.to_ecef(messages["position"])
        epochs["rotation_body_to_ecef"] = map_frame.rotation_map_to_ecef @ epochs["rotation_body_to_ecef"]
    return epochs


def epochs_from_fix(messages: NDArray[Any]) -> NDArray[Any]:
    """Return truth epochs of the antenna (position, covariance) from sensor_msgs/NavSatFix (n,) with a status >= 0."""
    messages = messages[messages["status"] >= 0]
    epochs = np.zeros(len(messages), EPOCH)
    geodetic = zip(
        np.radians(messages["latitude"]).tolist(),
        np.radians(messages["longitude"]).tolist(),
        messages["altitude"].tolist(),
        strict=True,
    )
    epochs["stamp"] = messages["stamp"]
    epochs["position_ecef"] = np.array([earth.geodetic_to_ecef(*point) for point in geodetic]).reshape(-1, 3)
    epochs["rotation_body_to_ecef"] = np.nan
    epochs["speed"] = np.nan
    known = messages["position_covariance_type"] > 0
    epochs["covariance_enu"][known] = messages["position_covariance"][known].reshape(-1, 3, 3)
    return epochs


class TruthComparison:
    """Compares rows of the estimate with truth epochs; both come in blocks, rows by increasing stamp.

    `point_body` is the point in base_link (m) whose position the truth is: zero, or the antenna for NavSatFix truth.
    """

    def __init__(self, point_body: tuple[float, ...] = (0.0, 0.0, 0.0)) -> None:
        self._point_body = np.array(point_body)
        self._rows: NDArray[Any] | None = None
        self._waiting = np.zeros(0, EPOCH)
        self._compared: list[NDArray[Any]] = []
        self.offered = 0

    def add_truth(self, epochs: NDArray[Any]) -> None:
        """Add truth epochs (n,) `EPOCH`, in any order; those that are not finite are left out."""
        epochs = epochs[np.isfinite(epochs["position_ecef"]).all(axis=1)]
        self.offered += len(epochs)
        self._waiting = np.concatenate([self._waiting, epochs])

    def add_rows(self, rows: NDArray[Any], datum: tuple[float, float, float]) -> None:
        """Add ODOMETRY rows (n,) with a known position, and compare the truth epochs that they have reached.

        Where the clock was set back, the rows before and after are no neighbours.
        """
        last = rows["stamp"][:1] if self._rows is None else self._rows["stamp"][-1:]
        cuts = np.flatnonzero(np.diff(np.concatenate([last, rows["stamp"]])) < 0)
        if len(cuts):
            for number, part in enumerate(np.split(rows, cuts)):
                self._rows = None if number else self._rows
                if len(part):
                    self.add_rows(part, datum)
            return
        self._rows = rows if self._rows is None else np.concatenate([self._rows, rows])
        stamps = self._rows["stamp"]
        reached = self._waiting["stamp"] <= stamps[-1]
        epochs = self._waiting[reached]
        self._waiting = self._waiting[~reached]
        epochs = epochs[np.argsort(epochs["stamp"], kind="stable")]
        after = np.searchsorted(stamps, epochs["stamp"])
        before = np.where(stamps[after] == epochs["stamp"], after, after - 1)
        inside = (before >= 0) & (stamps[after] - stamps[before] <= LARGEST_GAP)
        epochs, before, after = epochs[inside], before[inside], after[inside]
        if len(epochs):
            self._compared.append(
                compare(self._rows[before], self._rows[after], epochs, MapFrame(datum), self._point_body)
            )
        self._rows = self._rows[np.searchsorted(stamps, stamps[-1] - KEPT) :].copy()

    def compared(self) -> NDArray[Any]:
        """Return all epochs compared so far, (n,) `COMPARED`, by stamp."""
        compared = np.concatenate([np.zeros(0, COMPARED), *self._compared])
        return compared[np.argsort(compared["stamp"], kind="stable")]


def compare(
    before: NDArray[Any], after: NDArray[Any], epochs: NDArray[Any], map_frame: MapFrame, point_body: Array
) -> NDArray[Any]:
    """Return the errors of the estimate, interpolated between the ODOMETRY rows `before` and `after` (n,), at `epochs`.

    NEES is e' P^-1 e with three degrees of freedom. The attitude error is the rotation vector in map axes that turns
    the estimate into the truth, as in the filter; the covariance of the truth is added to that of the estimate.
    """
    interval = after["stamp"] - before["stamp"]
    share = np.where(interval > 0, (epochs["stamp"] - before["stamp"]) / np.maximum(interval, 1), 0.0)

    def between(name: str) -> Array:
        weight = share.reshape(-1, *(1,) * (before[name].ndim - 1))
        return (1.0 - weight) * before[name] + weight * after[name]  # type: ignore[no-any-return]

    rotation_map_to_ecef = map_frame.rotation_map_to_ecef
    rotation_body_to_map = _between_attitudes(before["attitude_body_to_map"], after["attitude_body_to_map"], share)
    covariance = between("pose_covariance")
    heading_known = before["heading_known"] & after["heading_known"]

    point_map = rotation_body_to_map @ point_body
    position_ecef = map_frame.to_ecef(between("position_map") + point_map)
    local_to_ecef = east_north_up_to_ecef(to_geodetic(position_ecef))
    error_ecef = position_ecef - epochs["position_ecef"]
    error_local = _turn_back(local_to_ecef, error_ecef)
    lever = np.concatenate([np.broadcast_to(np.eye(3), (len(epochs), 3, 3)), -_cross_matrices(point_map)], axis=2)
    local_to_map = rotation_map_to_ecef.T @ local_to_ecef
    position_covariance = lever @ covariance @ lever.transpose(0, 2, 1)
    position_covariance += local_to_map @ epochs["covariance_enu"] @ local_to_map.transpose(0, 2, 1)

    truth_body_to_map = rotation_map_to_ecef.T @ epochs["rotation_body_to_ecef"]
    attitude_error = rotation_vectors(truth_body_to_map @ rotation_body_to_map.transpose(0, 2, 1))
    forward = _turn_back(local_to_map, rotation_body_to_map[:, :, 0])
    truth_forward = _turn_back(local_to_map, truth_body_to_map[:, :, 0])
    heading_error = np.arctan2(forward[:, 1], forward[:, 0]) - np.arctan2(truth_forward[:, 1], truth_forward[:, 0])

    compared = np.zeros(len(epochs), COMPARED)
    compared["stamp"] = epochs["stamp"]
    compared["horizontal"] = np.hypot(error_local[:, 0], error_local[:, 1])
    compared["vertical"] = np.abs(error_local[:, 2])
    compared["speed"] = np.abs(np.linalg.norm(between("velocity_map"), axis=1) - epochs["speed"])
    compared["heading_deg"] = np.abs(np.degrees(np.arctan2(np.sin(heading_error), np.cos(heading_error))))
    compared["nees_position"] = _normalised_squares(error_ecef @ rotation_map_to_ecef, position_covariance)
    compared["nees_attitude"] = _normalised_squares(attitude_error, covariance[:, 3:, 3:])
    local_covariance = local_to_map.transpose(0, 2, 1) @ position_covariance @ local_to_map
    compared["error_enu"] = error_local
    compared["std_enu"] = np.sqrt(np.diagonal(local_covariance, axis1=1, axis2=2))
    compared["attitude_error_deg"] = -np.degrees(attitude_error)
    compared["attitude_std_deg"] = np.degrees(np.sqrt(np.diagonal(covariance[:, 3:, 3:], axis1=1, axis2=2)))
    compared["truth_map"] = (epochs["position_ecef"] - map_frame.origin_ecef) @ rotation_map_to_ecef
    compared["heading_deg"][~heading_known] = np.nan
    compared["attitude_error_deg"][~heading_known, 2] = np.nan
    compared["nees_attitude"][~heading_known] = np.nan
    return compared


def rotation_matrices(quaternions: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of quaternions (n, 4; w x y z) of any length (Sola, eq. 115).

    The matrix of a quaternion of length zero is NaN.
    """
    with np.errstate(invalid="ignore"):
        w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def rotation_vectors(rotations: Array) -> Array:
    """Return rotation vectors (n, 3), rad, of rotation matrices (n, 3, 3) that turn by less than pi."""
    sines = 0.5 * np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=1,
    )
    sine = np.linalg.norm(sines, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0))
    return sines * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)[:, None]


def _between_attitudes(before: Array, after: Array, share: Array) -> Array:
    """Return rotation matrices between nearby attitudes (n, 4): chord for arc, good to 1e-6 rad at 1 rad/s."""
    after = np.where((np.sum(before * after, axis=1) < 0.0)[:, None], -after, after)
    return rotation_matrices((1.0 - share)[:, None] * before + share[:, None] * after)


def _turn_back(rotations: Array, vectors: Array) -> Array:
    return np.einsum("nji,nj->ni", rotations, vectors)


def _cross_matrices(vectors: Array) -> Array:
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, 2, 1], matrices[:, 0, 2], matrices[:, 1, 0] = vectors.T
    return matrices - matrices.transpose(0, 2, 1)


def _normalised_squares(errors: Array, covariances: Array) -> Array:
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
