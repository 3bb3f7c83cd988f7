"""How much the messages of a receiver scatter, learned from their innovations in the humble lane.

Covariances of receivers are claims. Fixes that differ by more from one to the next than they claim are fused with more
noise. Fixes that stay away from the path together have an error that lasts and that the path shows: it becomes an
augmented state (`gnss_position.split_noise`). Fixes that differ by less from one to the next than they claim have an
error that lasts, too, which nothing shows: the position follows it. It is held as a consider state (Schmidt, 1966;
Jazwinski, Stochastic Processes and Filtering Theory, section 8.4): the estimate is what it would be without, and the
covariance of the position that is published has it in addition.
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
from eskf_ros.filter.state.error_state import ERROR_SIZE, NOWHERE, POSITION, SOURCES, VELOCITY
from eskf_ros.filter.state.streams import is_live

SCATTER = np.dtype(
    [
        ("spread", "f8", (SOURCES,)),
        ("change", "f8", (SOURCES,)),
        ("pairs", "f8", (SOURCES,)),
        ("recent", "f8", (SOURCES, 2)),
        ("walk", "f8", (SOURCES,)),
        ("walk_stamp", "i8", (SOURCES,)),
        ("walk_residual", "f8", (SOURCES, 3)),
        ("last_change", "f8", (SOURCES, 3)),
        ("velocity", "f8", (SOURCES,)),
        ("white", "f8", (SOURCES,)),
        ("lasting", "f8", (SOURCES,)),
        ("calm", "f8", (SOURCES,)),
        ("walking", "f8", (SOURCES,)),
        ("share", "f8", (SOURCES, 3)),
        ("claimed", "f8", (SOURCES, 3)),
        ("last_stamp", "i8", (SOURCES,)),
        ("last_residual", "f8", (SOURCES, 3)),
    ],
    align=True,
)
"""Scatter of the messages of the receivers, by source: mean squares over what the covariances allow.

- ``spread``, ``velocity``: of the innovations of positions and velocities in the humble lane.
- ``change``, ``pairs``: of the differences of the errors of two consecutive fixes, in which those that last cancel, and
  the number of pairs; ``recent``: the last two of them, the older one first.
- ``walk``: the part of the squares of the changes that the next change does not take back, over the claimed variance,
  in the filter; ``walk_stamp``, ``walk_residual``, ``last_change``: of the last fix, as below, and its change (m, map).
- ``white``, ``lasting``: shares of the claimed variance that are new with each fix, and that last and are estimated.
- ``calm``: share that lasts and is followed by the position; ``walking``: share by which it grows from fix to fix.
- ``share``, ``claimed``: share of the position that comes from the fixes, and the variance they claim (m2), by axis of
  map.
- ``last_stamp``, ``last_residual``: of the last fix: its stamp (ns), and how far it was from the position of the humble
  lane once this was corrected (m, map).
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

FEWEST_WILD_PAIRS = 3.0
"""Pairs of fixes before which even changes far beyond the claims say nothing."""

LONGEST_PAIR = 2_500_000_000
"""ns; two fixes further apart than this do not show the scatter: the humble lane drifts between them."""

NOTABLE_SCATTER = 2.0
"""Ratio of the scatter of messages to the variance they claim above which it counts instead of the claim."""

NOTABLE_WALK = 0.5
"""Ratio of the part of the changes that is not taken back to the variance that fixes claim above which they walk."""

WALK_GAIN = 0.005
"""Least weight of the newest pair in that part: new errors alone give 0 +- 0.14 then."""

WALK_CLIP = 8.0
"""One pair counts in that part with at most this many times the present changes."""

NOTABLE_CALM = 0.5
"""Ratio of the changes from fix to fix to the variance they claim below which the rest is an error that lasts."""

LEAST_INTERVAL = 0.05
"""s; shortest interval of fixes."""

LEAST_LASTING = 1.0
"""Least variance of a lasting error, over that of the new errors, that is worth the augmented states."""

SHORT_SUPPORT = 5.0
"""s; a position that fixes have supported for less may be what is wrong when the next fixes are away from it."""

STEADY = 2.0
"""The lasting share follows what is found only when it is off by this factor: it is a scale of augmented states."""

LARGEST_VALUE = 2.0
"""Standard deviations of a lasting error; one that is found to be larger keeps its scale."""


@njit
def copy_scatter(state, lane, source):
    """Let a lane use what was learnt of a receiver."""
    lane.scatter.white[source] = state.scatter.white[source]
    lane.scatter.lasting[source] = state.scatter.lasting[source]
    lane.scatter.velocity[source] = state.scatter.velocity[source]


@njit
def forget_scatter(state, lane, source, is_better, settings, work):
    """Forget what was learnt of the fixes of a receiver, and their lasting error: it has changed its kind of solution.

    The first fix of a better kind (``is_better``), in ``work``, shows the lasting error of the old ones: what of it is in
    the position is an error like any other now, as large as the innovation says (the estimate of greatest likelihood),
    up to what it was thought to be.
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
    """Forget how far fixes were from a path that was wrong, and the lasting errors that were concluded from it."""
    for source in range(SOURCES):
        state.scatter.spread[source] = 1.0
        if state.scatter.lasting[source] > 0.0:
            state.scatter.lasting[source] = 0.0
            if settings.position_error_at < state.error_size:
                reset_augmented(state, settings.position_error_at, 3, settings)
                reset_augmented(lane, settings.position_error_at, 3, settings)


@njit
def running_mean(mean, found, gain, least=1.0):
    """Return the running mean after a newest value, clipped at a multiple of the larger of the mean and ``least``."""
    found = min(found, SPREAD_CLIP * max(mean, least))
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
    is_next = state.stamp - state.scatter.last_stamp[source] <= LONGEST_PAIR
    if is_next and is_path_confirmed(state, source):
        away = distance_from_path(lane, source, settings, work)
        state.scatter.spread[source] = running_mean(state.scatter.spread[source], used * away, SPREAD_GAIN)
    learn_from_change(state, lane, source, True, settings, work)


@njit
def learn_from_change(state, lane, source, is_fused, settings, work):
    """Learn how the errors of fixes change from one to the next; fixes that are refused count, too.

    ``work`` holds a fix in the humble ``lane`` which, if ``is_fused``, has just been corrected by it. The difference of
    its innovation and of what the fix before has left after its correction is that of the errors of the two fixes, but
    for the error of the velocity in between; a lasting error cancels.
    """
    scatter = state.scatter
    used, _ = noise_shares(state, source, settings)
    dt = (state.stamp - scatter.last_stamp[source]) * 1e-9
    change, is_wide = 0.0, False
    for i in range(3):
        noise, drift = work.noise[i, i], lane.covariance[VELOCITY + i, VELOCITY + i] * dt * dt
        difference = error_change(lane, scatter.last_residual[source], i, is_fused, settings, work)
        change += difference * difference / (2.0 * noise + drift) / 3.0
        is_wide |= drift > noise / used
    is_next = state.stamp - scatter.last_stamp[source] <= LONGEST_PAIR
    scatter.last_stamp[source] = state.stamp
    if not is_next:
        return
    scatter.pairs[source] += 1.0
    least = SPREAD_GAIN if scatter.change[source] > NOTABLE_SCATTER else CHANGE_GAIN
    gain = max(1.0 / scatter.pairs[source], least)
    found = max(used * change, 1.0) if is_wide else used * change
    # A fix that is far off changes two pairs, a step one. Three in a row are the scatter.
    usual = max(1.0, min(found, scatter.recent[source, 0], scatter.recent[source, 1]))
    scatter.change[source] = running_mean(scatter.change[source], found, gain, usual)
    scatter.recent[source, 0] = scatter.recent[source, 1]
    scatter.recent[source, 1] = found


@njit
def error_change(lane, residual, i, is_fused, settings, work):
    """Return the change (m) on an axis of map from the error of the last fix to that of the fix in ``work``.

    ``residual`` (m, 3) is what the last fix had left; that of the new one replaces it on this axis.
    """
    place = settings.position_error_at
    left = work.innovation[i]
    if place < lane.error_size:
        correction = work.correction[place + i] if is_fused else 0.0
        left += work.jacobian[i, place + i] * (lane.optional[place - ERROR_SIZE + i] - correction)
    change = left - residual[i]
    if is_fused:
        for j in range(ERROR_SIZE):
            left -= work.jacobian[i, j] * work.correction[j]
    residual[i] = left
    return change


@njit
def learn_walk(state, source, settings, work):
    """Learn from a fix that the filter has just fused which part of the changes of the fixes is not taken back.

    Errors that are new with each fix are taken back by the next change: their changes d and d' have the mean product
    -w, w being their variance (as in the Allan variance). What remains of d d is an error that walks away.
    """
    scatter = state.scatter
    dt = (state.stamp - scatter.walk_stamp[source]) * 1e-9
    walk, is_wide = 0.0, False
    for i in range(3):
        noise, drift = scatter.claimed[source, i], state.covariance[VELOCITY + i, VELOCITY + i] * dt * dt
        change, last = error_change(state, scatter.walk_residual[source], i, True, settings, work), scatter.last_change
        walk += (change * change + 2.0 * change * last[source, i] - 3.0 * drift) / (3.0 * noise)
        last[source, i] = change
        is_wide |= drift > noise
    is_next = state.stamp - scatter.walk_stamp[source] <= LONGEST_PAIR
    scatter.walk_stamp[source] = state.stamp
    if not is_next:
        scatter.last_change[source] = 0.0
    elif not is_wide and state.doubt == 0.0:
        limit = WALK_CLIP * max(1.0, scatter.change[source])
        gain = max(1.0 / max(scatter.pairs[source], FEWEST_PAIRS), WALK_GAIN)
        scatter.walk[source] += gain * (min(max(walk, -limit), limit) - scatter.walk[source])


@njit
def is_path_confirmed(state, source):
    """Say whether the path is known well enough to say that fixes are off: velocities confirm it, and nothing doubts.

    Else the path may be wrong and not the fixes.
    """
    return state.doubt == 0.0 and is_live(state, Stream.GNSS_VELOCITY.value, source)


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

    ``work.noise`` is that of the fix in the humble ``lane``: the new share of what it claims. While the heading is
    unknown there is no such lane, and ``lane`` is the filter.
    """
    scatter = state.scatter
    is_learned = settings.position_error_at != NOWHERE and settings.correlated_share == 0.0
    if not is_learned or not is_enough(scatter.pairs[source], scatter.change[source]):
        return
    used = scatter.white[source]
    change, spread = scatter.change[source], scatter.spread[source]
    walks = scatter.walk[source] > NOTABLE_WALK * change
    new = max(change - 0.5 * scatter.walk[source], 1.0) if walks else change
    scatter.walking[source] = scatter.walk[source] if walks else 0.0
    scatter.white[source] = new if new > NOTABLE_SCATTER else 1.0
    found = max(spread if spread > NOTABLE_SCATTER else 1.0, scatter.white[source]) - scatter.white[source]
    off = unmodelled_position(state, source)
    claimed = (work.noise[0, 0] + work.noise[1, 1]) / (2.0 * max(used, LEAST_WHITE))
    found = max(found, min(off * off / claimed, LARGEST_SPREAD))
    lasting = scatter.lasting[source]
    found = max(found, lasting * largest_square(state, settings.position_error_at) / LARGEST_VALUE**2)
    found = found if found > LEAST_LASTING * scatter.white[source] else 0.0
    if found > STEADY * lasting or found * STEADY < lasting:
        scatter.lasting[source] = found
        if found > 0.0:
            factor = found / max(used, LEAST_WHITE)
            if off == 0.0:
                factor *= followed_part(state, source) if lasting == 0.0 else 0.0
            inflate_lasting_error(state, lasting, found, factor, settings, work)
            if state.heading_known == 1:
                inflate_lasting_error(lane, lasting, found, factor, settings, work)
    calm = 1.0 - change if change < NOTABLE_CALM else 0.0
    if walks:
        interval = max(1e-9 * state.recovery.absolute_interval, LEAST_INTERVAL)
        # A Gauss-Markov error of variance v walks by 2 v / time in a second.
        steps = 1.0 / (settings.optional_decay[settings.position_error_at - ERROR_SIZE] * interval)
        calm = min(0.5 * scatter.walk[source] * steps, LARGEST_SPREAD)
    scatter.calm[source] = calm if scatter.lasting[source] == 0.0 else 0.0


@njit
def followed_part(state, source):
    """Return the share of a lasting error that the position may have followed, because few fixes have made it so far."""
    supported = state.stamp - state.streams.fused_since[Stream.GNSS_POSITION.value, source]
    return min(1.0, (SHORT_SUPPORT / max(supported * 1e-9, 1.0)) ** 2)


@njit
def note_claims(state, source, settings, work):
    """Note the variances that the fix in ``work`` claims."""
    white, _ = noise_shares(state, source, settings)
    for i in range(3):
        state.scatter.claimed[source, i] = work.noise[i, i] / white


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


@njit
def is_enough(pairs, change):
    """Say whether pairs of fixes show their scatter: a few are enough if it is far beyond the claims."""
    return pairs >= FEWEST_PAIRS or (pairs >= FEWEST_WILD_PAIRS and change * pairs > NOTABLE_SCATTER * FEWEST_PAIRS)


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

    Where it may be in the position, too, which has followed it (a wrong lever arm), the position is widened by ``factor``
    times the noise in ``work``: the two are the same with opposite signs. An error that is seen because the position has
    not followed it leaves the position as it is.
    """
    place = settings.position_error_at
    update_error_size(state, place + 3, settings)
    ratio = math.sqrt(before / now)
    new = max(0.0, 1.0 - ratio * ratio)
    if before == 0.0:
        reset_augmented(state, place, 3, settings)
    for i in range(place, place + 3):
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
