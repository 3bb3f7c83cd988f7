"""The first position from the pseudoranges of one epoch, and proof of motion before it."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.first_fix import reset_position_to_fix
from eskf_ros.filter.alignment.heading import reset_heading_from_memory
from eskf_ros.filter.alignment.levelling import reset_level_to_moving
from eskf_ros.filter.state.enums import Verdict
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.static_window import (
    MEASURED_SPEED,
    VELOCITY_SIGMAS,
    update_evidence_from_place,
    update_motion,
)
from eskf_ros.filter.tight.epoch_least_squares import LARGEST_EPOCH, gather, solve_epoch, spread_of
from eskf_ros.filter.tight.receiver_clock import join_offsets, reset_or_jump_clock
from eskf_ros.filter.tight.signal import MEASURED, SATELLITE, antenna_ecef, see
from eskf_ros.geodesy.earth import SEMI_MAJOR_AXIS, ecef_to_geodetic
from eskf_ros.geodesy.rotation import dot, rotate

COARSE_STD = (30.0, 0.3)
"""Standard deviation of a pseudorange (m) and a range rate (m/s) without atmosphere and weights."""

POOREST_STD = 500.0
"""m; a solution with a larger formal standard deviation is no position."""

LOWEST_ALTITUDE = -10e3
"""m; a solution below it is no position."""

HIGHEST_ALTITUDE = 100e3
"""m; a solution above it is no position."""

UNWEIGHTED = 1e9
"""m; standard deviation of a signal while the position is far off: so large that no signal is an outlier."""

NEAR = 1e4
"""m; after a step shorter than this the position is near enough to tell outliers."""

ITERATIONS = 15
"""Steps of the first position from below the satellites, at most."""


@njit
def gather_coarsely(aids, first, end, position, which, std, work):
    """Write signals to ``work.signal_*`` like `gather`, for an antenna at rest at ``position`` (m), in ECEF axes.

    Neither state nor atmosphere is used, and all signals have the noise ``std`` (m or m/s).
    """
    count = 0
    for i in range(first, end):
        if aids[i].verdict != Verdict.WAITING or count == LARGEST_EPOCH:
            continue
        payload = aids[i].payload
        unit, length, rate = see(payload, position, (0.0, 0.0, 0.0))
        work.signal_index[count] = i
        work.signal_innovation[count] = payload[MEASURED] - (length if which == 0 else rate)
        work.signal_noise[count] = std * std
        for k in range(3):
            work.signal_direction[count, k] = -unit[k]
        count += 1
    work.signal_count = count


@njit
def locate_coarsely(aids, first, end, work):
    """Return whether the pseudoranges of an epoch give a position, and the position (m, ECEF, good to some ten m)."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(first, end):
        if aids[i].verdict == Verdict.WAITING:
            x += aids[i].payload[SATELLITE]
            y += aids[i].payload[SATELLITE + 1]
            z += aids[i].payload[SATELLITE + 2]
    length = math.sqrt(x * x + y * y + z * z)
    if not length > 0.0:
        return False, (0.0, 0.0, 0.0)
    # Begin at the point of the Earth below the mean of the satellites.
    scale = SEMI_MAJOR_AXIS / length
    position = (x * scale, y * scale, z * scale)
    # Far off, the residuals of the curved problem say nothing about the ranges: no weights.
    std = UNWEIGHTED
    for _ in range(ITERATIONS):
        gather_coarsely(aids, first, end, position, 0, std, work)
        if not solve_epoch(work):
            return False, position
        step = (work.step[0], work.step[1], work.step[2])
        position = (position[0] + step[0], position[1] + step[1], position[2] + step[2])
        length = math.sqrt(dot(step, step))
        if std == COARSE_STD[0] and length < 1.0:
            altitude = ecef_to_geodetic(position[0], position[1], position[2])[2]
            is_place = LOWEST_ALTITUDE < altitude < HIGHEST_ALTITUDE and spread_of(work) < POOREST_STD
            return is_place, position
        if length < NEAR:
            std = COARSE_STD[0]
    return False, position


@njit
def note_coarsely(state, aids, first, end, which, settings, work):
    """Look for motion in an epoch before the attitude is level, so that the robot is not levelled while it moves."""
    stamp = aids[first].stamp
    if which == 0:
        found, position = locate_coarsely(aids, first, end, work)
        if found:
            std = math.sqrt(max(work.normal[0, 0], work.normal[1, 1], work.normal[2, 2]))
            if update_evidence_from_place(state, position, std, stamp, 0):
                reset_level_to_moving(state, settings)
    elif state.window.last_fix_stamp[0] != NEVER:
        fix = state.window.last_fix_ecef[0]
        gather_coarsely(aids, first, end, (fix[0], fix[1], fix[2]), 1, COARSE_STD[1], work)
        if solve_epoch(work):
            step = (work.step[0], work.step[1], work.step[2])
            std = math.sqrt(max(work.normal[0, 0], work.normal[1, 1], work.normal[2, 2]))
            if update_motion(state, math.sqrt(dot(step, step)) - VELOCITY_SIGMAS * std, stamp, stamp, MEASURED_SPEED):
                reset_level_to_moving(state, settings)


@njit
def start(state, aids, first, end, settings, work):
    """Set the first position from the pseudoranges of one epoch, whose updates then narrow its wide prior."""
    found, ecef = locate_coarsely(aids, first, end, work)
    if not found:
        return
    had_datum = state.frame.datum_known
    # Now with atmosphere, weights and the elevation mask.
    for _ in range(2):
        state.frame.datum_known = had_datum
        reset_position_to_fix(state, ecef_to_geodetic(ecef[0], ecef[1], ecef[2]))
        state.tight.clock_known[0] = 0
        join_offsets(state, aids, first, end, settings)
        gather(state, aids, first, end, settings, work)
        reset_or_jump_clock(state, aids, first, end, 0, settings, work)
        if not solve_epoch(work) or spread_of(work) > POOREST_STD:
            state.position_known = 0
            state.frame.datum_known = had_datum
            return
        antenna, _ = antenna_ecef(state, settings)
        step = rotate(state.frame.map_to_ecef, work.step)
        ecef = (antenna[0] + step[0], antenna[1] + step[1], antenna[2] + step[2])
    geodetic = ecef_to_geodetic(ecef[0], ecef[1], ecef[2])
    state.frame.datum_known = had_datum
    reset_position_to_fix(state, geodetic)
    state.tight.clock_known[0] = 0
    variance = max(work.normal[0, 0], work.normal[1, 1], work.normal[2, 2])
    fix = (geodetic[0], geodetic[1], geodetic[2], variance, 0.0, 0.0, variance, 0.0, variance)
    reset_heading_from_memory(state, fix, settings)
