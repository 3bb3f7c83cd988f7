"""What tests of simulated recordings have in common: their truth by way of other libraries, and their files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eskf_ros.bags import open_bag
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.simulate.gnss import GnssMeasurements
from eskf_ros.simulate.imu import ImuMount, ideal_samples
from eskf_ros.simulate.motion import Motion, Trajectory
from eskf_ros.simulate.scenario import DATUM, START_STAMP, trajectory
from support.inertial_oracle import integrate

Array = NDArray[np.float64]

FRAME = MapFrame(DATUM)

TOPICS = {
    "imu/data": "sensor_msgs/msg/Imu",
    "gps/fix": "sensor_msgs/msg/NavSatFix",
    "gps/vel": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "truth": "nav_msgs/msg/Odometry",
}


def attitude(motion: Motion) -> Rotation:
    return Rotation.from_quat(motion.attitude_body_to_map[:, [1, 2, 3, 0]])


def assert_chi_square(normalized_errors: Array) -> None:
    """Errors divided by their sigma have the variance 1, within what one run in 100 000 exceeds."""
    total, count = float(np.sum(normalized_errors**2)), normalized_errors.size
    assert chi2.ppf(5e-6, count) < total < chi2.ppf(1.0 - 5e-6, count), total / count


def seconds(stamps: NDArray[np.int64]) -> Array:
    return (stamps - START_STAMP) * 1e-9


def read(path: Path, topics: dict[str, str]) -> dict[str, tuple[NDArray[np.int64], NDArray[Any], list[list[str]]]]:
    """Return log times, messages and their frames by topic, of a file that has exactly ``topics`` (name -> type)."""
    with open_bag([path]) as bag:
        assert {name: info.type for name, info in bag.topics.items()} == topics
        parts: dict[str, list[Any]] = {topic: [] for topic in topics}
        for batch in bag.batches(topics):
            for topic, content in batch.items():
                parts[topic].append((content.log_time, content.messages))
        read_topics = {}
        for topic, pieces in parts.items():
            messages = np.concatenate([piece[1] for piece in pieces])
            names = [name for name in ("frame_id", "child_frame_id") if name in (messages.dtype.names or ())]
            frames = [sorted({bag.strings[index] for index in messages[name]}) for name in names]
            read_topics[topic] = (np.concatenate([piece[0] for piece in pieces]), messages, frames)
        assert not bag.warnings
        return read_topics


def antenna_errors(name: str, gnss: GnssMeasurements, lever_arm: tuple[float, float, float]) -> tuple[Array, Array]:
    """Errors of position and velocity in east, north, up at the antenna, from the truth by way of pymap3d."""
    truth = trajectory(name).motion(seconds(gnss.fix_stamp))
    antenna = truth.position_map + attitude(truth).apply(lever_arm)
    latitude, longitude, altitude = pymap3d.enu2geodetic(*antenna.T, *DATUM)
    position_error = np.stack(
        pymap3d.geodetic2enu(
            gnss.fix_latitude_deg,
            gnss.fix_longitude_deg,
            gnss.fix_altitude,
            latitude,
            longitude,
            altitude,
        ),
        axis=-1,
    )
    velocity_map = truth.velocity_map + attitude(truth).apply(np.cross(truth.angular_rate_body, lever_arm))
    velocity_ecef = np.stack(pymap3d.enu2ecefv(*velocity_map.T, DATUM[0], DATUM[1]), axis=-1)
    east, north, up = pymap3d.ecef2enuv(*velocity_ecef.T, latitude, longitude)
    return position_error, gnss.velocity_enu - np.stack([east, north, up], axis=-1)


def assert_imu_integrates_back(path: Trajectory, times: Sequence[float], mount: ImuMount) -> None:
    """The ideal IMU samples, integrated in the inertial frame by other means, give position, velocity and attitude."""
    at = np.array(times)
    truth = path.motion(at)
    imu_to_map = attitude(truth) * Rotation.from_euler("xyz", mount.rpy_deg, degrees=True)
    position, velocity = truth.position_of(mount.position), truth.velocity_of(mount.position)

    def inputs(t: float) -> tuple[Array, Array]:
        force, rate = ideal_samples(path, FRAME, np.array([t]), mount)
        return force[0], rate[0]

    start = (position[0], velocity[0], imu_to_map[0].as_quat()[[3, 0, 1, 2]])
    integrated = integrate(inputs, start, DATUM, at, path.breakpoints)
    np.testing.assert_allclose(integrated.position_map, position, atol=1e-7)
    np.testing.assert_allclose(integrated.velocity_map, velocity, atol=1e-8)
    difference = Rotation.from_quat(integrated.attitude_body_to_map[:, [1, 2, 3, 0]]).inv() * imu_to_map
    assert np.abs(difference.magnitude()).max() < 1e-11
