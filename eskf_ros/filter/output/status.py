"""Status and quality: how far the alignment is, and whether the estimate may be used for navigation.

The quality is for whoever must stop the robot. It is not the covariance: it says what the filter has seen of its own
reliability (alignment, sensors that contradict it, resets), and asks of the covariance only whether the position is
known well enough for this robot (``quality.*``).
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.integrity.fix_errors import held_variance
from eskf_ros.filter.integrity.heading_monitor import has_lasting_difference
from eskf_ros.filter.integrity.motion_monitor import lag_of_receiver, offset_by_jumps
from eskf_ros.filter.state.enums import Quality, Status
from eskf_ros.filter.state.error_state import ATTITUDE, ERROR_SIZE, POSITION, SOURCES
from eskf_ros.filter.state.time import NEVER

SHORTEST_COAST = 1_000_000_000
"""ns; least time without an accepted position after which the status is COASTING (usually two of its intervals)."""

LONGEST_WAIT = 3_000_000_000
"""ns; largest time without an accepted position after which the status is COASTING."""

CONTRADICTIONS = 3
"""Absolute positions rejected in a row from which on the status is DEGRADED: fewer may be outliers."""


@njit
def status_of(state, settings):
    """Return the `Status` at the stamp of the state."""
    if state.imu.stamp == NEVER:
        return Status.WAITING_IMU
    if state.level_known == 0:
        return Status.LEVELLING
    if not is_sound(state):
        return Status.FAULT
    if state.position_known == 0:
        return Status.WAITING_FIX
    if state.heading_known == 0:
        return Status.WAITING_HEADING
    patience = max(SHORTEST_COAST, min(LONGEST_WAIT, 2 * state.recovery.absolute_interval))
    if state.stamp - state.recovery.absolute_stamp > patience:
        return Status.COASTING
    if state.recovery.rejected_fixes >= CONTRADICTIONS:
        return Status.DEGRADED
    if state.covariance[ATTITUDE + 2, ATTITUDE + 2] > settings.good_heading_std**2:
        return Status.ALIGNING
    return Status.GOOD


@njit
def is_sound(state):
    """Say whether position, velocity, attitude and all variances are numbers, and no variance is negative."""
    total = state.attitude[0] + state.attitude[1] + state.attitude[2] + state.attitude[3]
    for i in range(3):
        total += state.position_map[i] + state.velocity_map[i]
    for i in range(ERROR_SIZE):
        if not state.covariance[i, i] >= 0.0:
            return False
        total += state.covariance[i, i]
    return math.isfinite(total)


@njit
def quality_of(state, status, settings):
    """Return the `Quality` at the stamp of the state, whose `Status` is ``status``."""
    if status == Status.FAULT:
        return Quality.FAULT
    if status < Status.GOOD:
        return Quality.NOT_ALIGNED
    if status == Status.DEGRADED:
        return Quality.FIXES_CONTRADICT
    for sensor in range(len(state.heading_monitor.sensor_contrast)):
        if has_lasting_difference(state.heading_monitor.sensor_contrast[sensor]):
            return Quality.HEADING_CONTRADICTED
    settle_time, coast_time = settings.quality_settle_time * 1e9, settings.quality_coast_time * 1e9
    if state.recovery.reset_stamp != NEVER and state.stamp - state.recovery.reset_stamp < settle_time:
        return Quality.SETTLING
    if state.trust.doubt_stamp != NEVER and state.stamp - state.trust.doubt_stamp < settle_time:
        return Quality.IMU_CONTRADICTED
    if status == Status.COASTING and state.stamp - state.recovery.absolute_stamp > coast_time:
        return Quality.COASTED_TOO_LONG
    variance = 0.0
    offset, lag = offset_by_jumps(state), lag_of_receiver(state)
    for i in range(2):
        variance += offset[i] ** 2
        variance += state.covariance[POSITION + i, POSITION + i] + held_variance(state, i)
        variance += (lag * state.velocity_map[i]) ** 2
        for source in range(SOURCES):
            if state.installation.is_considered[source] == 1:
                variance += state.installation.considered[source, POSITION + i] ** 2
    if variance > settings.quality_position_std**2:
        return Quality.TOO_UNCERTAIN
    return Quality.COASTING if status == Status.COASTING else Quality.GOOD
