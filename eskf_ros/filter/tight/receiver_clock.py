"""The receiver clock: its first value, jumps by whole milliseconds, and a clock that was set anew."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.state.augmented_states import reset_augmented, update_error_size
from eskf_ros.filter.state.enums import Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.filter.tight.epoch_least_squares import OUTLIER, gather, median
from eskf_ros.filter.tight.pseudorange import offset_place
from eskf_ros.filter.tight.signal import system_of
from eskf_ros.gnss.signals import SPEED_OF_LIGHT

TIGHT = np.dtype(
    [
        ("clock_known", "i8", (2,)),
        ("clock_jumps", "i8"),
        ("range_faults", "i8"),
    ],
    align=True,
)
"""Tight coupling: what is known of the clock, and counts.

``clock_known``: whether bias and drift have values yet. ``clock_jumps``: milliseconds by which the clock has jumped.
``range_faults``: how often most of the satellites contradicted the state.
"""

MILLISECOND = 1e-3 * SPEED_OF_LIGHT
"""m; receiver clocks jump by whole milliseconds."""

JUMP_TOLERANCE = 100.0
"""m; a jump of the clock may differ from whole milliseconds by this."""

LOST_CLOCK = (0.1 * MILLISECOND, 1000.0)
"""Standard deviation of bias (m) and drift (m/s) beyond which the clock is reset from the satellites."""


@njit
def reset_clock(state, which, shift, settings):
    """Reset the bias (``which`` 0, m) or the drift (1, m/s) of the clock to its value plus ``shift``."""
    place = settings.clock_at + which
    value = state.optional[place - ERROR_SIZE] + shift
    reset_augmented(state, place, 1, settings)
    state.optional[place - ERROR_SIZE] = value
    state.tight.clock_known[which] = 1


@njit
def reset_or_jump_clock(state, aids, first, end, which, settings, work):
    """Give bias or drift of the clock a first value, or let the bias jump by whole milliseconds."""
    if work.signal_count == 0:
        return
    common = median(work.signal_innovation, work.signal_count, work)
    place = settings.clock_at + which
    if state.tight.clock_known[which] == 0 or state.covariance[place, place] > LOST_CLOCK[which] ** 2:
        reset_clock(state, which, common, settings)
        gather(state, aids, first, end, settings, work)
        return
    jump = round(common / MILLISECOND)
    if which == 1 or jump == 0:
        return
    agreeing = 0
    for k in range(work.signal_count):
        off = abs(work.signal_innovation[k] - jump * MILLISECOND)
        if off < JUMP_TOLERANCE + OUTLIER * math.sqrt(work.signal_spread[k]):
            agreeing += 1
    if 2 * agreeing > work.signal_count:
        state.optional[place - ERROR_SIZE] += jump * MILLISECOND
        state.forward.renewed |= 1 << (place - ERROR_SIZE)
        state.tight.clock_jumps += abs(jump)
        gather(state, aids, first, end, settings, work)


@njit
def join_offsets(state, aids, first, end, settings):
    """Activate the clock states, and the offsets of the constellations in this epoch."""
    update_error_size(state, settings.clock_at + 2, settings)
    for i in range(first, end):
        place = offset_place(system_of(aids[i].source), settings)
        if aids[i].verdict == Verdict.WAITING and place < len(state.covariance):
            update_error_size(state, place + 1, settings)
