"""What reading a recording costs: microseconds per Imu message, ours against the rosbags library.

    python benchmark/bag_reading.py [--minutes 10] [--runs 3]

The recording is an Imu stream at 200 Hz with sensor-like numbers. `ours` is typed batches, `raw` is rosbags handing out
serialised messages, `typed` is rosbags deserialising them (of which a part is measured and scaled up).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from eskf_ros.bags import BagWriter, encode, message_dtype, open_bag

IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
TOPIC = "/imu/data"
TYPED_MESSAGES = 20_000


def imu_messages(count: int) -> np.ndarray:
    """Imu messages with noise quantised as by a sensor, (count,)."""
    rng = np.random.default_rng(0)
    messages = np.zeros(count, message_dtype(IMU))
    messages["stamp"] = 1_700_000_000_000_000_000 + 5_000_000 * np.arange(count)
    messages["orientation_covariance"][:, 0] = -1.0
    messages["angular_velocity"] = np.round(rng.normal(0.0, 0.01, (count, 3)) / 1e-4) * 1e-4
    messages["linear_acceleration"] = np.round(rng.normal(0.0, 0.05, (count, 3)) / 1e-3) * 1e-3
    for name in ("angular_velocity_covariance", "linear_acceleration_covariance"):
        messages[name][:, ::4] = 1e-4
    return messages


def odometry_writing(path: Path, count: int = 180_000) -> float:
    """Seconds to write `count` Odometry messages, zstd."""
    rng = np.random.default_rng(0)
    messages = np.zeros(count, message_dtype(ODOMETRY))
    messages["stamp"] = 1_700_000_000_000_000_000 + 5_000_000 * np.arange(count)
    messages["child_frame_id"] = 1
    for name in ("position", "orientation", "linear_velocity", "angular_velocity"):
        messages[name] = rng.normal(size=messages[name].shape).cumsum(axis=0)
    for name in ("pose_covariance", "twist_covariance"):
        messages[name] = rng.normal(size=(1, 36)) * (1.0 + rng.random((count, 1)))
    begin = time.perf_counter()
    with BagWriter(path) as writer:
        handle = writer.add_topic("/odometry/global", ODOMETRY)
        for start in range(0, count, 8192):
            part = messages[start : start + 8192]
            writer.write(handle, part["stamp"], part, ("map", "base_link"))
    return time.perf_counter() - begin


def ours(path: Path) -> int:
    """Read everything as typed batches; the number of messages."""
    with open_bag([path]) as reader:
        return sum(len(batch[TOPIC].log_time) for batch in reader.batches({TOPIC: IMU}))


def rosbags_raw(path: Path) -> int:
    """The number of messages."""
    with Reader(path) as reader:
        return sum(1 for _ in reader.messages())


def rosbags_typed(path: Path) -> int:
    """The number of messages read, `TYPED_MESSAGES`."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(path) as reader:
        return sum(
            1
            for _, _, data in islice(reader.messages(), TYPED_MESSAGES)
            if store.deserialize_cdr(data, IMU).linear_acceleration is not None
        )


def cost(read: Callable[[Path], int], path: Path, runs: int) -> float:
    """Microseconds per message, the best of some runs."""
    best = float("inf")
    for _ in range(runs):
        begin = time.perf_counter()
        count = read(path)
        best = min(best, (time.perf_counter() - begin) / count * 1e6)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    messages = imu_messages(int(arguments.minutes * 60 * 200))
    with tempfile.TemporaryDirectory() as folder:
        paths = {}
        for compression in ("none", "lz4", "zstd"):
            paths[f"mcap {compression}"] = Path(folder) / f"{compression}.mcap"
            with BagWriter(paths[f"mcap {compression}"], compression) as writer:
                writer.write(writer.add_topic(TOPIC, IMU), messages["stamp"], messages, ("imu_link",))
        with Writer(Path(folder) / "sqlite3", version=9, storage_plugin=StoragePlugin.SQLITE3) as database:
            connection = database.add_connection(TOPIC, IMU, typestore=get_typestore(Stores.ROS2_JAZZY))
            for stamp, row in zip(messages["stamp"].tolist(), encode(IMU, messages, ("imu_link",))):
                database.write(connection, stamp, bytes(row))
        paths["sqlite3"] = Path(folder) / "sqlite3"
        print(f"us per Imu message ({len(messages)} messages, best of {arguments.runs})")
        print(f"{'':12}{'ours':>8}{'raw':>8}{'typed':>8}{'raw/ours':>10}{'typed/ours':>12}")
        for name, path in paths.items():
            own, raw, typed = (cost(read, path, arguments.runs) for read in (ours, rosbags_raw, rosbags_typed))
            print(f"{name:12}{own:8.2f}{raw:8.2f}{typed:8.2f}{raw / own:10.1f}{typed / own:12.1f}")
        seconds = min(odometry_writing(Path(folder) / "odometry.mcap") for _ in range(arguments.runs))
        print(f"writing 180000 Odometry messages (zstd): {seconds:.2f} s")


if __name__ == "__main__":
    main()
