"""The errors of fixes that last, concluded from their scatter (`scatter`).

Fixes that differ by more from one to the next than they claim are fused with more noise. Fixes that stay away from the
path together have an error that lasts and that the path shows: it becomes an augmented state
(`gnss_position.split_noise`). Fixes that differ by less from one to the next than they claim, or whose changes are not
taken back, have an error that lasts, too, which nothing shows: the position follows it. It is held as a consider state
(Schmidt, 1966; Jazwinski, Stochastic Processes and Filtering Theory, section 8.4): the estimate is what it would be
without, and the covariance of the position that is published has it in addition.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.integrity.fault_effects import FAULTS
from eskf_ros.filter.integrity.installation_monitor import LEAST_INTERVAL
from eskf_ros.filter.integrity.scatter import FEWEST_PAIRS, LARGEST_SPREAD, NOTABLE_SCATTER
from eskf_ros.filter.measurements.gnss_position import LEAST_WHITE, claimed_noise, noise_shares
from eskf_ros.filter.state.augmented_states import reset_augmented, update_error_size
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, NOWHERE, POSITION, SOURCES

NOTABLE_WALK = 0.5
"""Ratio of the part of the changes that is not taken back to the variance that fixes claim above which they walk."""

WALK_PAIRS = 300.0
"""Pairs of fixes from which on that ratio is three standard deviations of what white errors give; of fewer, more is."""

NOTABLE_CALM = 0.5
"""Ratio of the changes from fix to fix to the variance they claim below which the rest is an error that lasts."""

FEWEST_WILD_PAIRS = 3.0
"""Pairs of fixes before which even changes far beyond the claims say nothing."""

LEAST_LASTING = 1.0
"""Least variance of a lasting error, over that of the new errors, that is worth the augmented states."""

SHORT_SUPPORT = 5.0
"""s; a position that fixes have supported for less may be what is wrong when the next fixes are away from it."""

STEADY = 2.0
"""The lasting share follows what is found only when it is off by this factor: it is a scale of augmented states."""

LARGEST_VALUE = 2.0
"""Standard deviations of a lasting error; one that is found to be larger keeps its scale."""


@njit
def update_shares(state, lane, source, settings, work):
    """Draw the conclusions for the noise of the fixes: how much of it is new with each of them, how much lasts.

    ``work.noise`` is that of the fix in the humble ``lane``: the new share of what it claims. While the heading is
    unknown there is no such lane, and ``lane`` is the filter.
    """
    scatter = state.scatter
    is_learned = settings.position_error_at != NOWHERE and settings.correlated_share == 0.0
    if not is_learned or not is_enough(scatter.pairs[source], scatter.change[source]):
        return
    used, change = max(scatter.white[source], LEAST_WHITE), scatter.change[source]
    least = NOTABLE_WALK * math.sqrt(max(1.0, WALK_PAIRS / scatter.pairs[source]))
    walks = scatter.walk[source] > least * change
    scatter.walking[source] = scatter.walk[source] if walks else 0.0
    new = change - 0.5 * scatter.walking[source]
    scatter.white[source] = new if new > NOTABLE_SCATTER else 1.0
    calm = 1.0 - change if change < NOTABLE_CALM else 0.0
    if walks:
        interval = max(1e-9 * state.recovery.absolute_interval, LEAST_INTERVAL)
        # A Gauss-Markov error of variance v walks by 2 v / time in a second.
        steps = 1.0 / (settings.optional_decay[settings.position_error_at - ERROR_SIZE] * interval)
        calm = max(calm, min(0.5 * scatter.walk[source] * steps, LARGEST_SPREAD))
    update_lasting_share(state, lane, source, used, calm, settings, work)
    scatter.calm[source] = calm if scatter.lasting[source] == 0.0 else 0.0


@njit
def update_lasting_share(state, lane, source, used, calm, settings, work):
    """Update the share of the lasting error that is estimated; ``used`` is the new share in ``work.noise``.

    Fixes that walk are away from the path because it follows them late: no more of that is estimated than the position
    is held to be off with them, ``calm``.
    """
    scatter = state.scatter
    white, spread, lasting = scatter.white[source], scatter.spread[source], scatter.lasting[source]
    found = max(spread if spread > NOTABLE_SCATTER else 1.0, white) - white
    found = max(found, lasting * largest_square(state, settings.position_error_at) / LARGEST_VALUE**2)
    found = found if found > max(LEAST_LASTING * white, calm) else 0.0
    if found <= STEADY * lasting and found * STEADY >= lasting:
        return
    scatter.lasting[source] = found
    if found == 0.0:
        return
    factor = found / used * (followed_part(state, source) if lasting == 0.0 else 0.0)
    inflate_lasting_error(state, lasting, found, factor, settings, work)
    if state.heading_known == 1:
        inflate_lasting_error(lane, lasting, found, factor, settings, work)


@njit
def is_enough(pairs, change):
    """Say whether pairs of fixes show their scatter: a few are enough if it is far beyond the claims."""
    return pairs >= FEWEST_PAIRS or (pairs >= FEWEST_WILD_PAIRS and change * pairs > NOTABLE_SCATTER * FEWEST_PAIRS)


@njit
def followed_part(state, source):
    """Return the share of a lasting error that the position may have followed: few fixes have made it so far."""
    supported = state.stamp - state.streams.fused_since[Stream.GNSS_POSITION.value, source]
    return min(1.0, (SHORT_SUPPORT / max(supported * 1e-9, 1.0)) ** 2)


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

    Where it may be in the position, too, which has followed it, the position is widened by ``factor`` times the noise
    in ``work``: the two are the same with opposite signs. An error that is seen because the position has not followed
    it leaves the position as it is.
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
        for other in range(SOURCES):
            for fault in range(FAULTS):
                state.installation.absorbed[other, i, fault] *= ratio
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


@njit
def reset_scatter(state, lane, source, is_better, settings, work):
    """Reset what was learnt of the fixes of a receiver, and their lasting error: it has changed its kind of solution.

    The first fix of a better kind (``is_better``), in ``work``, shows the lasting error of the old ones: what of it is
    in the position is an error like any other now, as large as the innovation says (the estimate of greatest
    likelihood), up to what it was thought to be.
    """
    for i in range(3):
        if is_better and state.scatter.calm[source] > 0.0:
            shown = work.innovation[i] ** 2 - state.covariance[POSITION + i, POSITION + i] - work.noise[i, i]
            state.covariance[POSITION + i, POSITION + i] += min(max(shown, 0.0), held_variance(state, i))
        state.scatter.share[source, i] = 0.0
    state.scatter.lasting[source] = 0.0
    state.scatter.calm[source] = 0.0
    if settings.position_error_at < state.error_size:
        reset_augmented(state, settings.position_error_at, 3, settings)
    if settings.position_error_at < lane.error_size:
        reset_augmented(lane, settings.position_error_at, 3, settings)
    state.scatter.spread[source] = 1.0
    state.scatter.change[source] = 1.0
    state.scatter.white[source] = 1.0
    state.scatter.pairs[source] = 0.0
    state.scatter.recent[source] = 0.0
    state.scatter.walk[source] = 0.0
    state.scatter.walking[source] = 0.0


@njit
def forget_spread(state, lane, settings):
    """Forget how far fixes and velocities were from a path that was wrong, and the lasting errors concluded from it."""
    for source in range(SOURCES):
        state.scatter.spread[source] = 1.0
        state.scatter.velocity[source] = 1.0
        if state.scatter.lasting[source] > 0.0:
            state.scatter.lasting[source] = 0.0
            if settings.position_error_at < state.error_size:
                reset_augmented(state, settings.position_error_at, 3, settings)
                reset_augmented(lane, settings.position_error_at, 3, settings)


@njit
def note_claims(state, source, settings, work):
    """Note the variances that the fix in ``work`` claims."""
    white, _ = noise_shares(state, source, settings)
    for i in range(3):
        state.scatter.claimed[source, i] = claimed_noise(work, i) / white


@njit
def propagate_walk(state, lane, source):
    """Let the position of a lane walk with the errors of the fixes since the last one: it follows them."""
    for i in range(3):
        lane.covariance[POSITION + i, POSITION + i] += state.scatter.walking[source] * state.scatter.claimed[source, i]


@njit
def follow_calm_error(state, source, work):
    """Update how much of the position comes from the lasting errors of the fixes, after a fix has been fused.

    ``work`` holds its gain. A constant error of the fixes comes into the position as the fixes do, and the
    IMU knows nothing of it: a <- (1 - K) a + K.
    """
    scatter = state.scatter
    for i in range(3):
        gain = work.gain[POSITION + i, i]
        for other in range(SOURCES):
            scatter.share[other, i] *= 1.0 - gain
        scatter.share[source, i] += gain


@njit
def held_variance(state, axis):
    """Return the variance (m2) of the position on an axis of map that comes from lasting errors of fixes."""
    scatter, total = state.scatter, 0.0
    for source in range(SOURCES):
        total += scatter.share[source, axis] ** 2 * scatter.calm[source] * scatter.claimed[source, axis]
    return total
