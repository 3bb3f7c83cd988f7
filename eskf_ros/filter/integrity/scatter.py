"""How much the messages of a receiver scatter, learned from their innovations in the humble lane.

Covariances of receivers are claims. Fixes that differ by more from one to the next than they claim are fused with more
noise. Fixes that differ by less, or that stay away from the path together, have an error that lasts: it becomes an
augmented state (`gnss_position.split_noise`), and the position, which has followed it, is widened by it once.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.integrity.installation_monitor import unmodelled_position
from eskf_ros.filter.measurements.gnss_position import LEAST_WHITE, noise_shares
from eskf_ros.filter.measurements.gnss_velocity import noise_factor
from eskf_ros.filter.state.augmented_states import reset_augmented, update_error_size
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, NOWHERE, POSITION, SOURCES
from eskf_ros.filter.state.streams import is_live

SCATTER = np.dtype(
    [
        ("spread", "f8", (SOURCES,)),
        ("change", "f8", (SOURCES,)),
        ("pairs", "f8", (SOURCES,)),
        ("velocity", "f8", (SOURCES,)),
        ("white", "f8", (SOURCES,)),
        ("lasting", "f8", (SOURCES,)),
        ("last_stamp", "i8", (SOURCES,)),
        ("last_innovation", "f8", (SOURCES, 3)),
    ],
    align=True,
)
"""Scatter of the messages of the receivers, by source: mean squares over what the covariances allow.

- ``spread``, ``velocity``: of the innovations of positions and velocities in the humble lane.
- ``change``, ``pairs``: of the differences of two consecutive innovations of positions, in which errors that last
  cancel, and the number of pairs.
- ``white``, ``lasting``: shares of the claimed variance that are new with each fix, and that last, as they are used.
- ``last_stamp``, ``last_innovation``: of the last fix (ns; m, map).
"""

SPREAD_GAIN = 0.08
"""Weight of the newest message in the running mean of the spread."""

SPREAD_CLIP = 4.0
"""One message counts with at most this many times the present spread."""

LARGEST_SPREAD = 1e6
"""Largest spread: receivers that claim millimetres for metres are used for what they are."""

CHANGE_GAIN = 0.02
"""Least weight of the newest pair of fixes in the running mean of their changes."""

FEWEST_PAIRS = 25.0
"""Pairs of fixes before which their changes say nothing."""

LONGEST_PAIR = 2_500_000_000
"""ns; two fixes further apart than this do not show the scatter: the humble lane drifts between them."""

NOTABLE_SCATTER = 2.0
"""Ratio of the scatter of messages to the variance they claim above which it counts instead of the claim."""

NOTABLE_CALM = 0.5
"""Ratio of the changes from fix to fix to the variance they claim below which the rest is an error that lasts."""

STEADY = 2.0
"""The lasting share follows what is found only when it is off by this factor: it is a scale of augmented states."""

LARGEST_VALUE = 2.0
"""Standard deviations of a lasting error; one that is found to be larger keeps its scale."""

LEAST_LASTING = 0.3
"""Least lasting share that is worth the augmented states."""


@njit
def copy_scatter(state, lane, source):
    """Let a lane use what was learnt of a receiver."""
    lane.scatter.white[source] = state.scatter.white[source]
    lane.scatter.lasting[source] = state.scatter.lasting[source]
    lane.scatter.velocity[source] = state.scatter.velocity[source]


@njit
def forget_scatter(state, source):
    """Forget what was learnt of the fixes of a receiver: it has changed its kind of solution."""
    state.scatter.spread[source] = 1.0
    state.scatter.change[source] = 1.0
    state.scatter.white[source] = 1.0
    state.scatter.pairs[source] = 0.0


@njit
def forget_spread(state, lane, settings):
    """Forget how far fixes were from a path that was wrong, and the lasting errors that were concluded from it."""
    for source in range(SOURCES):
        state.scatter.spread[source] = 1.0
        calm = 1.0 - state.scatter.change[source] if state.scatter.change[source] < NOTABLE_CALM else 0.0
        if state.scatter.lasting[source] > STEADY * calm:
            state.scatter.lasting[source] = calm
            if settings.position_error_at < state.error_size:
                reset_augmented(state, settings.position_error_at, 3, settings)
                reset_augmented(lane, settings.position_error_at, 3, settings)


@njit
def running_mean(mean, found, gain):
    """Return the running mean after a newest value, which is clipped."""
    found = min(found, SPREAD_CLIP * max(mean, 1.0))
    return min(mean + gain * (found - mean), LARGEST_SPREAD)


@njit
def learn_from_velocity(state, source, nis):
    """Learn from the NIS (3 axes) of a velocity in the humble lane how velocities scatter."""
    found = noise_factor(state, source) * nis / 3.0
    state.scatter.velocity[source] = running_mean(state.scatter.velocity[source], found, SPREAD_GAIN)


@njit
def learn_from_fix(state, lane, source, settings, work):
    """Learn from a fix in the humble ``lane`` how far fixes are from the path, and how they change."""
    used, _ = noise_shares(state, source, settings)
    # Without velocities that confirm the path, the path may be wrong and not the fixes; so it may in doubt, or when the
    # last fix is long ago.
    is_next = state.stamp - state.scatter.last_stamp[source] <= LONGEST_PAIR
    if is_next and state.doubt == 0.0 and is_live(state, Stream.GNSS_VELOCITY.value, source):
        away = distance_from_path(lane, source, settings, work)
        state.scatter.spread[source] = running_mean(state.scatter.spread[source], used * away, SPREAD_GAIN)
    learn_from_change(state, lane, source, settings, work)


@njit
def learn_from_change(state, lane, source, settings, work):
    """Learn how fixes change from one to the next; those that are refused count, too.

    ``work`` holds the innovation, and the inverse of the innovation covariance, which that of the fix before has, too:
    the innovations of a humble lane are nearly independent.
    """
    scatter = state.scatter
    used, _ = noise_shares(state, source, settings)
    change = 0.0
    for a in range(3):
        for b in range(3):
            change_a = work.innovation[a] - scatter.last_innovation[source, a]
            change_b = work.innovation[b] - scatter.last_innovation[source, b]
            change += 0.5 * change_a * work.innovation_covariance[a, b] * change_b
    if state.stamp - scatter.last_stamp[source] <= LONGEST_PAIR:
        scatter.pairs[source] += 1.0
        least = SPREAD_GAIN if scatter.change[source] > NOTABLE_SCATTER else CHANGE_GAIN
        gain = max(1.0 / scatter.pairs[source], least)
        found = used * change / 3.0
        if is_wide(lane, work):
            found = max(found, 1.0)
        scatter.change[source] = running_mean(scatter.change[source], found, gain)
    scatter.last_stamp[source] = state.stamp
    for a in range(3):
        scatter.last_innovation[source, a] = work.innovation[a]


@njit
def is_wide(lane, work):
    """Say whether the position of a lane is less certain than the fix in ``work``: then small changes say nothing."""
    for i in range(3):
        if lane.covariance[POSITION + i, POSITION + i] > work.noise[i, i]:
            return True
    return False


@njit
def distance_from_path(lane, source, settings, work):
    """Return the mean square distance of a fix from a lane, its lasting error included, over what is allowed for."""
    place, total = settings.position_error_at, 0.0
    for i in range(3):
        distance, noise = work.innovation[i], work.noise[i, i]
        if place < lane.error_size:
            distance += work.jacobian[i, place + i] * lane.optional[place - ERROR_SIZE + i]
        total += distance * distance / (lane.covariance[POSITION + i, POSITION + i] + noise)
    return total / 3.0


@njit
def update_shares(state, lane, source, settings, work):
    """Draw the conclusions for the noise of the fixes: how much of it is new with each of them, how much lasts.

    ``work.noise`` is that of the fix in the humble lane: the new share of what it claims.
    """
    scatter = state.scatter
    if scatter.pairs[source] < FEWEST_PAIRS or settings.position_error_at == NOWHERE or settings.correlated_share > 0.0:
        return
    used = scatter.white[source]
    change, spread = scatter.change[source], scatter.spread[source]
    scatter.white[source] = change if change > NOTABLE_SCATTER or change < NOTABLE_CALM else 1.0
    found = max(spread if spread > NOTABLE_SCATTER else 1.0, scatter.white[source]) - scatter.white[source]
    if found < LEAST_LASTING:
        found = 0.0
    off = unmodelled_position(state, source)
    claimed = (work.noise[0, 0] + work.noise[1, 1]) / (2.0 * max(used, LEAST_WHITE))
    found = max(found, min(off * off / claimed, LARGEST_SPREAD))
    lasting = scatter.lasting[source]
    found = max(found, lasting * largest_square(state, settings.position_error_at) / LARGEST_VALUE**2)
    if found > STEADY * lasting or found * STEADY < lasting:
        scatter.lasting[source] = found
        if found > 0.0:
            factor = found / max(used, LEAST_WHITE) if change < NOTABLE_CALM or off > 0.0 else 0.0
            inflate_lasting_error(state, lasting, found, factor, settings, work)
            inflate_lasting_error(lane, lasting, found, factor, settings, work)


@njit
def largest_square(state, place):
    """Return the largest square of the lasting errors (in standard deviations), 0 while they are not active."""
    if place >= state.error_size:
        return 0.0
    largest = 0.0
    for i in range(3):
        largest = max(largest, abs(state.optional[place - ERROR_SIZE + i]))
    return largest * largest


@njit
def inflate_lasting_error(state, before, now, factor, settings, work):
    """Change the scale of the lasting error from the share ``before`` to ``now``; the value stays.

    Where it grows because fixes change less than they claim, the position is widened, too, by ``factor`` times the
    noise in ``work``: it has followed an error that was not known of, so that the two are the same with opposite signs.
    An error that is seen because the position has not followed it leaves the position as it is.
    """
    place = settings.position_error_at
    update_error_size(state, place + 3, settings)
    ratio = math.sqrt(before / now)
    new = max(0.0, 1.0 - ratio * ratio)
    if before == 0.0:
        reset_augmented(state, place, 3, settings)
    for i in range(place, place + 3):
        # Another scale: for a smoother it is another error.
        state.forward.renewed |= 1 << (i - ERROR_SIZE)
        state.optional[i - ERROR_SIZE] *= ratio
        for j in range(state.error_size):
            state.covariance[i, j] *= ratio
            state.covariance[j, i] *= ratio
    for i in range(3):
        p, e = POSITION + i, place + i
        std = math.sqrt(factor * work.noise[i, i])
        state.covariance[e, e] += new
        state.covariance[p, p] += new * std * std
        state.covariance[p, e] -= new * std
        state.covariance[e, p] -= new * std
