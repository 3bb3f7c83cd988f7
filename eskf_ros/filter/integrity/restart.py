"""Restart of the alignment: after a long silence of the IMU, or when the estimate cannot be trusted any more."""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading_search import forget_search
from eskf_ros.filter.alignment.heading_sensors import reset_to_unknown_heading
from eskf_ros.filter.integrity.installation_monitor import forget_faults
from eskf_ros.filter.state.error_state import ATTITUDE, GYRO_BIAS
from eskf_ros.filter.state.time import NEVER

OPENED_TILT_STD = 0.1
"""rad per axis; of roll and pitch that are doubted."""

OPENED_GYRO_BIAS_STD = 0.01
"""rad/s; of a gyro bias that is doubted."""


@njit
def reset_alignment(state):
    """Restart the alignment: level, position and heading are unknown again; the datum stays."""
    state.restarts += 1
    forget_search(state)
    state.heading.candidate_count = 0
    state.heading.given_stamp = NEVER
    state.recovery.rejected_fixes = 0
    state.level_known = 0
    state.position_known = 0
    state.heading_known = 0
    state.first_stamp = NEVER
    state.window.start = NEVER
    state.window.still_stamp = NEVER
    state.window.still_samples = 0
    forget_faults(state)
    for i in range(2):
        state.tight.clock_known[i] = 0
    for i in range(3):
        state.position_map[i] = 0.0
        state.velocity_map[i] = 0.0


@njit
def reset_to_level(state):
    """Drop all but the level: it is doubted, and the next fix gives the position, the motion after it the heading."""
    reset_to_unknown_heading(state)
    state.position_known = 0
    inflate_level(state)
    forget_faults(state)


@njit
def inflate_level(state):
    """Doubt roll, pitch and gyro bias after a fault of the IMU, or of what has corrected them."""
    for i in range(3):
        if i < 2:
            state.covariance[ATTITUDE + i, ATTITUDE + i] += OPENED_TILT_STD**2
        state.covariance[GYRO_BIAS + i, GYRO_BIAS + i] += OPENED_GYRO_BIAS_STD**2
