"""First position: from the first fix, or from a pose that somebody sets.

The coarse alignment finds the level from gravity (`levelling`), then the position from the first fix, then the heading.
The heading comes from a parameter or the memory of the last run (`heading`), from a sensor that measures it
(`heading_sensors`), or from accelerations (`heading_search`), sharpened by the course.

While the heading is unknown, its error has the variance of a half turn and is not estimated: GNSS corrects position and
velocity only (`predict.step` cuts the coupling), and the gyros carry the attitude. Until the heading is known every
still window levels again; after the first fix only one in which a fix or the wheels confirm rest.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading import reset_heading
from eskf_ros.filter.alignment.heading_search import forget_search
from eskf_ros.filter.inertial.navigation_frame import local_up, reset_attitude, set_datum, shortest_turn
from eskf_ros.filter.measurements.gnss_position import position_of_fix
from eskf_ros.filter.state.error_state import ERROR_CAPACITY, POSITION, VELOCITY
from eskf_ros.geodesy.rotation import rotate, rotate_back, to_matrix

START_POSITION_STD = 1000.0
"""m per axis; prior of the position before the update by the first fix."""

START_VELOCITY_STD = 100.0
"""m/s per axis; prior of a velocity of which nothing is known."""


@njit
def reset_position_to_fix(state, payload):
    """Set the position to the first fix, with a wide prior that the update by this same fix narrows.

    ``payload`` starts with latitude, longitude (rad) and altitude (m) of the antenna. Without a datum the fix becomes
    the datum.
    """
    old_up = local_up(state)
    if state.frame.datum_known == 0:
        set_datum(state, payload[0], payload[1], payload[2])
    position = position_of_fix(state, payload)
    covariance = state.covariance
    for i in range(3):
        state.position_map[i] = position[i]
        state.velocity_map[i] = 0.0
        for j in range(ERROR_CAPACITY):
            covariance[POSITION + i, j] = 0.0
            covariance[j, POSITION + i] = 0.0
            covariance[VELOCITY + i, j] = 0.0
            covariance[j, VELOCITY + i] = 0.0
    for i in range(3):
        covariance[POSITION + i, POSITION + i] = START_POSITION_STD**2
        covariance[VELOCITY + i, VELOCITY + i] = START_VELOCITY_STD**2
    reset_attitude(state, shortest_turn(old_up, local_up(state)))
    state.position_known = 1


@njit
def reset_pose(state, position, position_covariance, heading, heading_std, settings):
    """Set base_link to a position (m, map) with a covariance (3, 3) and a heading (rad), whatever was known before."""
    covariance = state.covariance
    for i in range(3):
        for j in range(ERROR_CAPACITY):
            covariance[POSITION + i, j] = 0.0
            covariance[j, POSITION + i] = 0.0
    if state.position_known == 0:
        for i in range(3):
            for j in range(ERROR_CAPACITY):
                covariance[VELOCITY + i, j] = 0.0
                covariance[j, VELOCITY + i] = 0.0
            covariance[VELOCITY + i, VELOCITY + i] = START_VELOCITY_STD**2
    state.position_known = 0
    forget_search(state)
    reset_heading(state, heading, heading_std, settings)
    m = settings.imu_position_base
    offset = rotate(to_matrix(state.attitude), rotate_back(settings.imu_to_base, (m[0], m[1], m[2])))
    for i in range(3):
        state.position_map[i] = position[i] + offset[i]
        for j in range(3):
            covariance[POSITION + i, POSITION + j] = position_covariance[i, j]
    state.position_known = 1
    state.heading_known = 1
    state.heading.given_stamp = state.stamp
