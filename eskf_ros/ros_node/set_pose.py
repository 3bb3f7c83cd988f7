"""A pose given from outside: by the topic of RViz's tool, or by the service of robot_localization."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from eskf_ros.filter.navigator import Navigator
from eskf_ros.ros_node.transforms import yaw_of


def set_pose(navigator: Navigator, pose: Any) -> str:
    """Set the estimate to a geometry_msgs/PoseWithCovariance in map; return why not, or an empty string.

    x, y, z and yaw are used, roll and pitch stay. A height without variance, as tools with a view from above send it,
    is ignored: the present height stays.
    """
    p, q = pose.pose.position, pose.pose.orientation
    covariance = np.reshape(pose.covariance, (6, 6))
    if not np.isfinite([p.x, p.y, p.z, q.w, q.x, q.y, q.z]).all() or not np.isfinite(covariance).all():
        return "the pose or its covariance is not finite"
    if abs(q.w**2 + q.x**2 + q.y**2 + q.z**2 - 1.0) > 0.1:
        return "the orientation is no unit quaternion"
    position, position_covariance = [p.x, p.y, p.z], 0.5 * (covariance[:3, :3] + covariance[:3, :3].T)
    if position_covariance[2, 2] == 0.0:
        row = navigator.odometry[0]
        if not row["position_known"]:
            return "its height has no variance, and the present height is not known"
        position[2] = float(row["position_map"][2])
        position_covariance[2, :] = position_covariance[:, 2] = 0.0
        position_covariance[2, 2] = row["pose_covariance"][2, 2]
    if (np.linalg.eigvalsh(0.5 * (position_covariance + position_covariance.T)) <= 0.0).any() or covariance[
        5, 5
    ] <= 0.0:
        return "its covariance is not positive for x, y, z and yaw"
    heading, heading_std = yaw_of(q.w, q.x, q.y, q.z), math.sqrt(covariance[5, 5])
    if navigator.set_pose(position, position_covariance, heading, heading_std):
        return ""
    return "the robot is not levelled yet, or the origin of the map is not known"
