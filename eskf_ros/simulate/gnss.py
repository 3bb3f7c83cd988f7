"""A simulated GNSS receiver: position and velocity of the antenna at regular epochs, each with its covariance.

The errors are white and exactly as the covariances say. Position and velocity of an epoch share the stamp; both arrive
late by a latency that differs from epoch to epoch, the velocity shortly after the position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.map_frame import MapFrame, east_north_up_to_ecef, to_geodetic
from eskf_ros.simulate.trajectory import DriveTrajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class IdealEpochs:
    """The antenna at n epochs without error: ECEF position (m), velocity in ECEF axes (m/s), local ENU axes in ECEF."""

    position_ecef: Array
    velocity_ecef: Array
    rotation_enu_to_ecef: Array


@dataclass(frozen=True)
class Epochs:
    """The measured antenna at n epochs.

    ``geodetic``: latitude and longitude in degrees, ellipsoidal altitude in m; ``velocity_enu``: m/s, axes east, north,
    up at the antenna.
    """

    geodetic: Array
    velocity_enu: Array


def ideal_epochs(
    trajectory: DriveTrajectory,
    frame: MapFrame,
    times: NDArray[np.floating[Any]],
    lever_arm: tuple[float, float, float],
) -> IdealEpochs:
    """Return the error-free antenna, at ``lever_arm`` (m) in base_link, at ``times`` (n,) in seconds."""
    motion = trajectory.motion(times)
    position_ecef = frame.to_ecef(motion.position_of(lever_arm))
    return IdealEpochs(
        position_ecef=position_ecef,
        velocity_ecef=motion.velocity_of(lever_arm) @ frame.rotation_map_to_ecef.T,
        rotation_enu_to_ecef=east_north_up_to_ecef(to_geodetic(position_ecef)),
    )


def measure(
    ideal: IdealEpochs,
    position_std: tuple[float, float],
    velocity_std: tuple[float, float],
    seed: np.random.SeedSequence,
) -> Epochs:
    """Return the epochs with white errors of the given standard deviations (m, m/s), each horizontal and vertical."""
    position_stream, velocity_stream = (np.random.Generator(np.random.PCG64(s)) for s in seed.spawn(2))
    shape = ideal.position_ecef.shape
    position_error = position_stream.standard_normal(shape) * axis_stds(position_std)
    velocity_error = velocity_stream.standard_normal(shape) * axis_stds(velocity_std)
    shifted = ideal.position_ecef + np.einsum("nij,nj->ni", ideal.rotation_enu_to_ecef, position_error)
    geodetic = to_geodetic(shifted)
    geodetic[:, :2] *= 180.0 / math.pi
    velocity_enu = np.einsum("nji,nj->ni", ideal.rotation_enu_to_ecef, ideal.velocity_ecef) + velocity_error
    return Epochs(geodetic, velocity_enu)


def axis_stds(horizontal_vertical: tuple[float, float]) -> Array:
    """Return the standard deviations east, north, up (3,) of a horizontal and a vertical one."""
    return np.array([horizontal_vertical[0], horizontal_vertical[0], horizontal_vertical[1]])
