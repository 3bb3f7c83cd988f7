"""Numbers of both odometry messages from a row of the estimator, in the order of the message."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.ros_node.two_d import PLANAR_VARIANCE

GLOBAL, LOCAL = 0, 1
NUMBERS = 85
"""Numbers of an odometry: position x y z, orientation x y z w, pose covariance (36), linear and angular velocity, twist
covariance (36).
"""

ORIENTATION, POSE_COVARIANCE, LINEAR, TWIST_COVARIANCE = 3, 7, 43, 49


@njit
def fill_odometry(rows, index, is_planar, numbers):
    """Fill ``numbers`` (2, 85) from one row (ODOMETRY): pose in map and pose in odom; return whether all are finite.

    The pose covariance in odom is what has been gathered since its start; roll and pitch are those of the estimate.
    ``is_planar``: the height has no uncertainty.
    """
    row = rows[index]
    for k in range(3):
        numbers[GLOBAL, k] = row.position_map[k]
        numbers[LOCAL, k] = row.position_odom[k]
        numbers[GLOBAL, ORIENTATION + k] = row.attitude_body_to_map[k + 1]
        numbers[LOCAL, ORIENTATION + k] = row.attitude_body_to_odom[k + 1]
        numbers[GLOBAL, LINEAR + k] = row.velocity_body[k]
        numbers[GLOBAL, LINEAR + 3 + k] = row.angular_rate_body[k]
    numbers[GLOBAL, ORIENTATION + 3] = row.attitude_body_to_map[0]
    numbers[LOCAL, ORIENTATION + 3] = row.attitude_body_to_odom[0]
    for i in range(6):
        for j in range(6):
            k = 6 * i + j
            numbers[GLOBAL, POSE_COVARIANCE + k] = row.pose_covariance[i, j]
            numbers[GLOBAL, TWIST_COVARIANCE + k] = row.twist_covariance[i, j]
            is_tilt = 3 <= i < 5 and 3 <= j < 5
            numbers[LOCAL, POSE_COVARIANCE + k] = row.pose_covariance[i, j] if is_tilt else 0.0
    for i in range(3):
        numbers[LOCAL, POSE_COVARIANCE + 7 * i] = row.local_position_variance
    if is_planar:
        numbers[LOCAL, POSE_COVARIANCE + 7 * 2] = PLANAR_VARIANCE
    numbers[LOCAL, POSE_COVARIANCE + 7 * 5] = row.local_heading_variance
    for k in range(LINEAR, NUMBERS):
        numbers[LOCAL, k] = numbers[GLOBAL, k]
    total = 0.0
    for k in range(NUMBERS):
        total += numbers[GLOBAL, k] + numbers[LOCAL, k]
    return math.isfinite(total)
