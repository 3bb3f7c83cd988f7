"""What tests of simulated recordings have in common: their truth by way of other libraries, and their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eskf_ros.bags import open_bag
from eskf_ros.simulate.gnss import GnssMeasurements
from eskf_ros.simulate.motion import Motion
from eskf_ros.simulate.scenario import DATUM, START_STAMP, trajectory

Array = NDArray[np.float64]

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
