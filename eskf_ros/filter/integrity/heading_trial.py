"""A heading that was given is on trial until motion has shown the heading.

A parameter, the memory or a pose may be wrong, and a filter that believes them bends everything else to fit. Meanwhile
the humble lane is therefore the filter as it would be if no heading had been given: it searches for the heading
(`alignment.heading_search`). When it has found one, the two are compared, and the filter continues from the lane where
they contradict each other.
"""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading import search_heading
from eskf_ros.filter.alignment.heading_search import note_level
from eskf_ros.filter.alignment.heading_sensors import reset_to_unknown_heading
from eskf_ros.filter.inertial.navigation_frame import heading_of
from eskf_ros.filter.integrity.heading_corrections import HEADING
from eskf_ros.filter.integrity.humble_lane import linearize, reset_to_lane
from eskf_ros.filter.integrity.installation_monitor import forget_faults
from eskf_ros.filter.measurements.kalman_update import update
from eskf_ros.filter.state.enums import Verdict
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE
from eskf_ros.filter.state.lanes import FILTER, HUMBLE
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.geodesy.rotation import to_matrix, wrapped

TRIAL = np.dtype([("is_on", "i8"), ("given_stamp", "i8"), ("moved", "i8"), ("found", "i8")], align=True)
"""Trial of a heading: whether it is on; when the heading was given, when the robot first moved with it, and when the
lane without it has found one (ns)."""

LONGEST_TRIAL = 180 * SECOND
"""ns; of motion, after which a heading that nothing has shown is believed."""

COMPARED_TIME = 30 * SECOND
"""ns; for which the headings are compared once the lane has found one: its own becomes better all the time."""

REFUTING_SIGMAS = 4.0
"""Standard deviations by which a heading that was given must differ from the one found for it to be wrong."""


@njit
def update_trial(states, settings):
    """Begin and end the trial of the heading."""
    state, trial = states[FILTER], states[FILTER].trial
    if state.heading.given_stamp == NEVER or state.heading_known == 0 or settings.has_humble_lane == 0:
        end_trial(states)
        return
    if trial.given_stamp != state.heading.given_stamp:
        trial.is_on = 1
        trial.given_stamp = state.heading.given_stamp
        trial.moved = trial.found = NEVER
        start_without_heading(states, settings)
    if trial.is_on == 0:
        return
    if trial.moved == NEVER and state.window.motion_stamp > trial.given_stamp:
        trial.moved = state.stamp
    is_over = trial.moved != NEVER and state.stamp - trial.moved > LONGEST_TRIAL
    if is_over or (trial.found != NEVER and state.stamp - trial.found > COMPARED_TIME):
        if trial.found != NEVER:
            state.heading.given_stamp = NEVER
        end_trial(states)


@njit
def restart_trial(states, settings):
    """Start the lane anew from what the filter knows at rest; in motion it is what the heading has made of it."""
    trial = states[FILTER].trial
    if trial.is_on == 1 and trial.moved == NEVER:
        start_without_heading(states, settings)


@njit
def end_trial(states):
    """End the trial: the humble lane starts anew from the filter, to judge it."""
    if states[FILTER].trial.is_on == 1:
        states[FILTER].trial.is_on = 0
        states[HUMBLE].heading_known = 0


@njit
def start_without_heading(states, settings):
    """Start the lane from the filter, without its heading; what is unknown of the tilt is what it hides in it."""
    states[HUMBLE] = states[FILTER]
    lane = states[HUMBLE]
    reset_to_unknown_heading(lane)
    p = lane.covariance
    bias = 0.5 * (p[ACCEL_BIAS, ACCEL_BIAS] + p[ACCEL_BIAS + 1, ACCEL_BIAS + 1])
    tilt = 0.5 * (p[ATTITUDE, ATTITUDE] + p[ATTITUDE + 1, ATTITUDE + 1])
    beside = max(tilt - bias / STANDARD_GRAVITY**2, 0.0)
    note_level(lane, beside, bias, to_matrix(lane.attitude), settings)


@njit
def refute_heading(states, aid, gate, settings, work):
    """Let the lane without the heading hear a message of GNSS; say whether it has found quite another one."""
    state, lane = states[FILTER], states[HUMBLE]
    if state.trial.is_on == 0:
        return False
    size = linearize(lane, aid, settings, work)
    verdict, _ = update(lane, size, gate, work)
    if verdict == Verdict.FUSED and lane.heading_known == 0:
        search_heading(lane, aid, gate, settings, work)
    if lane.heading_known == 0:
        return False
    if state.trial.found == NEVER:
        state.trial.found = state.stamp
    apart = wrapped(heading_of(state, settings) - heading_of(lane, settings))
    variance = state.covariance[HEADING, HEADING] + lane.covariance[HEADING, HEADING]
    return apart * apart > REFUTING_SIGMAS**2 * variance


@njit
def reset_to_found_heading(states):
    """Continue the filter from the lane without the heading that was given."""
    reset_to_lane(states[FILTER], states[HUMBLE])
    states[FILTER].heading.given_stamp = NEVER
    states[FILTER].trust.refused.fill(0)
    states[FILTER].trust.takeovers += 1
    forget_faults(states[FILTER])
    end_trial(states)
