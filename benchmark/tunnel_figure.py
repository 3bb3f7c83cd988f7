"""Draw docs/tunnel_drive.png: the bundled drive through its tunnel, the error and what the filter says of it.

    python benchmark/tunnel_figure.py

Replays bags/tunnel_drive.mcap as `./run demo` does and compares odometry/global with the truth in the bag.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from eskf_ros.bags import open_bag
from eskf_ros.geodesy import earth
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.replay.run import Options, replay

ROOT = Path(__file__).resolve().parents[1]
BAG = ROOT / "bags" / "tunnel_drive.mcap"
ODOMETRY = "nav_msgs/msg/Odometry"
TUNNEL = (125.0, 170.0)


def read_odometry(bag: Path, topic: str) -> np.ndarray:
    """Return all messages of an Odometry topic."""
    with open_bag([bag]) as reader:
        return np.concatenate([batch[topic].messages for batch in reader.batches({topic: ODOMETRY}) if topic in batch])


def to_map(position_ecef: np.ndarray, datum: list[float]) -> np.ndarray:
    """Turn ECEF positions (n, 3) into the map at ``datum`` (deg, deg, m)."""
    latitude, longitude = math.radians(datum[0]), math.radians(datum[1])
    origin = np.array(earth.geodetic_to_ecef(latitude, longitude, datum[2]))
    return (position_ecef - origin) @ np.array(earth.east_north_up_to_ecef(latitude, longitude))


def main() -> None:
    """Replay, compare, draw."""
    with tempfile.TemporaryDirectory() as folder:
        summary = replay(BAG, load(ROOT / "config" / "tunnel_drive.yaml"), Options(Path(folder), truth="truth"))
        estimate = read_odometry(Path(folder) / "odometry.mcap", "/odometry/global")
    truth = read_odometry(BAG, "truth")
    truth_position = to_map(truth["position"], summary["datum"])
    seconds = (estimate["stamp"] - truth["stamp"][0]) * 1e-9
    at = np.column_stack([np.interp(estimate["stamp"], truth["stamp"], truth_position[:, axis]) for axis in range(2)])
    error = np.linalg.norm(estimate["position"][:, :2] - at, axis=1)
    covariance = estimate["pose_covariance"].reshape(-1, 6, 6)
    sigma = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    in_tunnel = (seconds > TUNNEL[0]) & (seconds < TUNNEL[1])

    figure, (track, errors) = plt.subplots(1, 2, figsize=(10, 3.6), constrained_layout=True)
    track.plot(*truth_position[:, :2].T, color="0.6", linewidth=4, label="truth")
    track.plot(*estimate["position"][:, :2].T, color="tab:blue", linewidth=1, label="estimate")
    track.plot(*estimate["position"][in_tunnel, :2].T, color="tab:red", linewidth=1.5, label="estimate, no GNSS")
    track.set(xlabel="east, m", ylabel="north, m", aspect="equal", title="bags/tunnel_drive.mcap")
    track.legend(fontsize=8)
    errors.axvspan(*TUNNEL, color="tab:red", alpha=0.12, label="tunnel, 45 s")
    errors.plot(seconds, 2.0 * sigma, color="0.5", linewidth=1, label="twice the published sigma")
    errors.plot(seconds, error, color="tab:blue", linewidth=1, label="horizontal error")
    errors.set(xlabel="time, s", ylabel="m", ylim=(0.01, 40.0), yscale="log", xlim=(0, seconds[-1]))
    errors.legend(fontsize=8, loc="upper left")
    figure.savefig(ROOT / "docs" / "tunnel_drive.png", dpi=110)


if __name__ == "__main__":
    main()
