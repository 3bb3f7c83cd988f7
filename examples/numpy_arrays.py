"""The filter over arrays in memory: here those of the recording that comes with this package, in practice your own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import eskf_ros
from eskf_ros.bags import open_bag

CHECKOUT = Path(__file__).resolve().parent.parent


def topic(name: str, kind: str) -> np.ndarray:
    """Return all messages of a topic of the recording as one structured array."""
    with open_bag([CHECKOUT / "bags" / "tunnel_drive.mcap"]) as bag:
        return np.concatenate([batch[name].messages for batch in bag.batches({name: kind})])


def main() -> eskf_ros.Result:
    """Run the filter and print what it found."""
    imu, fix = topic("imu/data", "sensor_msgs/msg/Imu"), topic("gps/fix", "sensor_msgs/msg/NavSatFix")
    result = eskf_ros.run(
        imu={
            "stamp": imu["stamp"],  # int64 ns; float64 seconds and datetime64 do as well
            "specific_force": imu["linear_acceleration"],
            "angular_rate": imu["angular_velocity"],
        },
        gnss_position={
            "stamp": fix["stamp"],
            "latitude_deg": fix["latitude"],
            "longitude_deg": fix["longitude"],
            "altitude": fix["altitude"],
            "covariance": fix["position_covariance"],
            "status": fix["status"],
        },
        parameters=CHECKOUT / "config" / "tunnel_drive.yaml",
        output_rate=10.0,
    )
    aid, final = result.summary["aids"]["gnss_position"], result.summary["final"]
    print(f"{len(result.trajectory)} states, {aid['fused']} of {aid['offered']} fixes fused, NIS {aid['nis_mean']:.2f}")
    print(f"at the end {final['status']} at {final['lla']}")
    for warning in result.warnings:
        print(warning)
    return result


if __name__ == "__main__":
    main()
