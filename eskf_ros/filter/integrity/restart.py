"""Restart of the alignment: after a long silence of the IMU, or when the estimate cannot be trusted any more."""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading_search import forget_search
from eskf_ros.filter.state.time import NEVER


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
    # The faults of the receivers were learnt with an attitude that is not trusted any more.
    state.installation.stamp = NEVER
    state.installation.information.fill(0.0)
    state.installation.evidence.fill(0.0)
    state.installation.misfit.fill(0.0)
    state.installation.found.fill(0.0)
    for i in range(2):
        state.tight.clock_known[i] = 0
    for i in range(3):
        state.position_map[i] = 0.0
        state.velocity_map[i] = 0.0
