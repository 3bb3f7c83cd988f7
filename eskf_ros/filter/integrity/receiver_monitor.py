"""Receiver monitor: faults of GNSS receivers that no single message shows, found from their innovations.

- A receiver that drifts away from the path that the IMU measures: CUSUM of the innovations (Page, Continuous inspection
  schemes, 1954).
- Covariances that are too small or too large, and a filter that is overconfident after outages.
- A heading that does not become more certain although the robot moves.

All sums are part of the state, so that a rewind restores them.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.integrity.scatter import NOTABLE_SCATTER
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ATTITUDE, SOURCES
from eskf_ros.filter.state.streams import is_live
from eskf_ros.filter.state.time import NEVER

RECEIVER_MONITOR = np.dtype(
    [
        ("drift_sums", "f8", (SOURCES, 4)),
        ("departures", "i8", (SOURCES,)),
        ("departure_stamp", "i8", (SOURCES,)),
        ("seen_stamp", "i8", (SOURCES,)),
        ("fix_count", "i8", (SOURCES,)),
        ("scattered_fixes", "i8", (SOURCES,)),
        ("scatter_sum", "f8", (SOURCES,)),
        ("velocity_nis", "f8", (SOURCES, 2)),
        ("coasts", "i8"),
        ("coast_nis", "f8"),
        ("heading_mark_stamp", "i8"),
        ("heading_mark_std", "f8"),
        ("heading_stuck", "i8"),
    ],
    align=True,
)
"""Sums and counts of the monitors, by receiver.

- ``drift_sums``: CUSUM of the innovations, upwards and downwards, on two axes.
- ``departures``, ``departure_stamp``: how often a CUSUM reached its threshold, and when first (ns).
- ``seen_stamp``, ``fix_count``: the last fix (ns), and the number of fixes.
- ``scattered_fixes``, ``scatter_sum``: fixes with inflated noise, and the sum of their factors.
- ``velocity_nis``: running mean of the NIS of the velocities per degree of freedom, and their number.
- ``coasts``, ``coast_nis``: outages, and the sum of the NIS per degree of freedom of the first fixes after them.
- ``heading_mark_stamp``, ``heading_mark_std``: the last check of the heading (ns), and its standard deviation (rad).
- ``heading_stuck``: checks in a row without progress.
"""

DRIFT_ALLOWANCE = 0.5
"""CUSUM allowance (sigma): the part of each innovation that the sum does not count."""

DRIFT_LIMIT = 16.0
"""CUSUM threshold (sigma): white innovations reach it by chance about once in hundreds of hours."""

FEW_DEPARTURES = 2
"""A drift is reported from this many threshold crossings on: an error of fixes that lasts may cause one."""

LONG_COAST = 5_000_000_000
"""ns; shorter outages are not judged."""

MANY_FIXES = 50
"""Fixes that a receiver must have sent before anything of it is reported. Velocities need twice as many."""

HIGH_NIS = 2.0
"""Mean NIS of the velocities per degree of freedom above which their covariances are reported as too small."""

NIS_CLIP = 10.0
"""Largest NIS per degree of freedom that a velocity counts with; the first fix after an outage: its square."""

NIS_GAIN = 0.01
"""Weight of the newest velocity in the running mean of the NIS."""

UNLIKELY = 1e-4
"""Probability below which the innovations after outages contradict a consistent filter (chi-square test)."""

HEADING_INTERVAL = 60_000_000_000
"""ns; time between two checks whether the heading has become more certain."""

SHRINKING = 0.9
"""Share to which the standard deviation of the heading has to shrink from one check to the next, until it is good."""


@njit
def watch_receiver(state, aid, work, settings):
    """Update the monitors with a measurement after its update; ``work`` as the update had it."""
    if aid.stream == Stream.GNSS_POSITION:
        watch_fix(state, aid)
    elif aid.stream == Stream.GNSS_VELOCITY:
        watch_velocity(state, aid)
    is_alone = aid.stream == Stream.GNSS_POSITION and not is_live(state, Stream.GNSS_VELOCITY.value, aid.source)
    # Of a filter that has just been replaced the innovation says nothing, and a fault that is certain explains it.
    is_telling = aid.verdict != Verdict.TAKEOVER and not has_found_fault(state, aid.source)
    if (aid.stream == Stream.GNSS_VELOCITY or is_alone) and is_telling:
        watch_departure(state, aid.source, work)
    if aid.stream == Stream.GNSS_POSITION:
        watch_heading_std(state, settings)


@njit
def watch_fix(state, aid):
    """Count fixes with inflated noise, and first fixes after an outage."""
    source = aid.source
    state.receiver.fix_count[source] += 1
    if NEVER < state.receiver.seen_stamp[source] < state.stamp - LONG_COAST and state.heading_known == 1:
        state.receiver.coasts += 1
        state.receiver.coast_nis += min(aid.nis / 3.0, NIS_CLIP**2)
    state.receiver.seen_stamp[source] = state.stamp
    factor = max(state.scatter.spread[source], state.scatter.change[source])
    if factor > NOTABLE_SCATTER:
        state.receiver.scattered_fixes[source] += 1
        state.receiver.scatter_sum[source] += factor


@njit
def watch_velocity(state, aid):
    """Update the running mean of the NIS of the velocities, per degree of freedom."""
    nis = min(aid.nis / 3.0, NIS_CLIP)
    sums = state.receiver.velocity_nis[aid.source]
    sums[0] += NIS_GAIN * (nis - sums[0])
    sums[1] += 1.0


@njit
def has_found_fault(state, source):
    """Say whether a fault of the installation is certain at present."""
    for found in state.installation.found[source]:
        if found != 0.0:
            return True
    return False


@njit
def watch_departure(state, source, work):
    """Update the CUSUM of the innovations in both directions of the horizontal axes; count threshold crossings.

    It sums the innovations of the velocities where there are any, because errors of fixes are correlated for seconds.
    """
    sums = state.receiver.drift_sums[source]
    for i in range(2):
        # The matrix is inverted already; its diagonal is at least the inverse of the variance.
        sigmas = work.innovation[i] * math.sqrt(work.innovation_covariance[i, i])
        sigmas = max(-3.0, min(3.0, sigmas))
        sums[2 * i] = max(0.0, sums[2 * i] + sigmas - DRIFT_ALLOWANCE)
        sums[2 * i + 1] = max(0.0, sums[2 * i + 1] - sigmas - DRIFT_ALLOWANCE)
    if max(max(sums[0], sums[1]), max(sums[2], sums[3])) >= DRIFT_LIMIT:
        sums.fill(0.0)
        if state.receiver.departures[source] == 0:
            state.receiver.departure_stamp[source] = state.stamp
        state.receiver.departures[source] += 1


@njit
def watch_heading_std(state, settings):
    """Check every minute whether the standard deviation of the heading has shrunk while the robot moved."""
    if state.stamp - state.receiver.heading_mark_stamp < HEADING_INTERVAL:
        return
    std = math.sqrt(state.covariance[ATTITUDE + 2, ATTITUDE + 2]) if state.heading_known == 1 else math.pi
    is_moving = state.window.motion_stamp > state.stamp - HEADING_INTERVAL // 2
    stuck = is_moving and std > settings.good_heading_std and std > SHRINKING * state.receiver.heading_mark_std
    if state.receiver.heading_mark_stamp != NEVER:
        state.receiver.heading_stuck = state.receiver.heading_stuck + 1 if stuck else 0
    state.receiver.heading_mark_stamp = state.stamp
    state.receiver.heading_mark_std = std
