"""The estimate and the verdicts as keys and values of diagnostics: the same in the node and in odometry.mcap."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.bags.cdr_writer import ERROR, OK, WARN, Status
from eskf_ros.filter.state.enums import IS_USABLE, QUALITY_REASONS, STREAM_NAMES, Quality, Stream, Verdict
from eskf_ros.filter.state.enums import Status as State
from eskf_ros.filter.state.time import SECOND
from eskf_ros.filter.tight.signal import name_of

GOOD_VERDICTS = (Verdict.FUSED, Verdict.WEIGHED_DOWN, Verdict.DUPLICATE, Verdict.DISABLED)
"""Verdicts that are no fault of the measurement."""

SIGNALS = (Stream.PSEUDORANGE, Stream.RANGE_RATE)
"""Streams whose sources are signals of satellites."""


def seconds(stamp: int) -> str:
    """Return a stamp (ns) in seconds with all nine decimals."""
    return f"{stamp // SECOND}.{stamp % SECOND:09d}"


def figures(row: np.void) -> dict[str, str]:
    """Return the uncertainty and the biases of an ODOMETRY row."""
    sigma = [math.sqrt(max(0.0, row["pose_covariance"][i, i])) for i in range(6)]
    return {
        "position std (m)": " ".join(f"{value:.3f}" for value in sigma[:3]),
        "velocity std (m/s)": " ".join(f"{math.sqrt(max(0.0, row['twist_covariance'][i, i])):.3f}" for i in range(3)),
        "heading std (deg)": f"{math.degrees(sigma[5]):.2f}",
        "accelerometer bias (m/s2)": " ".join(f"{value:.4f}" for value in row["accel_bias"]),
        "gyro bias (rad/s)": " ".join(f"{value:.6f}" for value in row["gyro_bias"]),
    }


def quality(row: np.void, node: str) -> Status:
    """Return whether an ODOMETRY row may be used for navigation: OK, WARN (usable, dead reckoning) or ERROR (not)."""
    judged = Quality(int(row["quality"]))
    is_usable = judged in IS_USABLE
    covariance = row["pose_covariance"]
    return Status(
        (OK if judged == Quality.GOOD else WARN) if is_usable else ERROR,
        f"{node}: quality",
        QUALITY_REASONS[judged],
        {
            "usable": "yes" if is_usable else "no",
            "quality": judged.name,
            "state": State(int(row["status"])).name,
            "stamp": seconds(int(row["stamp"])),
            "horizontal std (m)": f"{math.sqrt(max(0.0, covariance[0, 0] + covariance[1, 1])):.3f}",
            "heading std (deg)": f"{math.degrees(math.sqrt(max(0.0, covariance[5, 5]))):.2f}",
        },
    )


def verdict(record: np.void) -> Status:
    """Return the verdict on one measurement, and its receiver (0: the first) or signal."""
    judged = Verdict(int(record["verdict"]))
    stream, source = int(record["stream"]), int(record["source"])
    return Status(
        OK if judged in GOOD_VERDICTS else WARN,
        STREAM_NAMES[stream],
        judged.name.lower(),
        {
            **({"signal": name_of(source)} if stream in SIGNALS else {"receiver": str(source)}),
            "stamp": seconds(int(record["stamp"])),
            "nis": str(float(record["nis"])),
            "dof": str(int(record["dof"])),
            "innovation": " ".join(f"{value:.4f}" for value in record["innovation"]),
        },
    )
