"""Output of a planar robot (``output.two_d``): height, roll and pitch are zero and known."""

from __future__ import annotations

import math

import numpy as np

PLANAR = (2, 3, 4)
"""Indices of z, roll and pitch in the covariances of messages."""

PLANAR_VARIANCE = 1e-6
"""m2 and rad2; variance of the suppressed axes: zero would make the matrix singular."""


def flatten(row: np.void) -> None:
    """Set height, roll and pitch, and their rates, of one ODOMETRY row to zero."""
    for position, attitude in (
        ("position_map", "attitude_body_to_map"),
        ("position_odom", "attitude_body_to_odom"),
    ):
        row[position][2] = 0.0
        w, x, y, z = row[attitude].tolist()
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        row[attitude] = math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)
    row["velocity_body"][2] = 0.0
    row["angular_rate_body"][:2] = 0.0
    for name in ("pose_covariance", "twist_covariance"):
        covariance = row[name]
        covariance[PLANAR, :] = 0.0
        covariance[:, PLANAR] = 0.0
        covariance[PLANAR, PLANAR] = PLANAR_VARIANCE
