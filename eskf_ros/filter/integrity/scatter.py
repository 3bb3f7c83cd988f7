"""How much the messages of a receiver scatter, learned from their innovations.

Covariances of receivers are claims. What is learned here says whether they hold: how fixes change from one to the next,
whether they stay away from the path together, how velocities scatter. What follows for the noise of fixes is in
`fix_errors`.
"""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.gnss_position import claimed_noise, noise_shares
from eskf_ros.filter.measurements.gnss_velocity import noise_factor
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, POSITION, SOURCES, VELOCITY
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
        ("cut_stamps", "i8", (SOURCES,)),
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
- ``cut_stamps``: other messages with the stamp of an earlier one, a whole second: see `measurements.stamp_noise`.
- ``share``, ``claimed``: share of the position that comes from the fixes, and the variance they claim (m2), by axis of
  map.
- ``last_stamp``, ``last_residual``: of the last fix: its stamp (ns), and how far it was from the position of the humble
  lane once this was corrected (m, map).
"""

VELOCITIES = 1
"""Kind of message that velocities are (`refusal.kind_of`)."""

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

WALK_GAIN = 0.005
"""Least weight of the newest pair in that part: new errors alone give 0 +- 0.14 then."""

MANY_PAIRS = 100.0
"""Pairs of fixes from which on it is told that they err together."""

TOLD_CALM = 0.6
"""Share of the claims that must last for it to be told."""

WALK_CLIP = 8.0
"""One pair counts in that part with at most this many times the present changes."""


@njit
def copy_scatter(state, lane, source):
    """Let a lane use what was learnt of a receiver."""
    lane.scatter.white[source] = state.scatter.white[source]
    lane.scatter.lasting[source] = state.scatter.lasting[source]
    lane.scatter.velocity[source] = state.scatter.velocity[source]
    lane.scatter.cut_stamps[source] = state.scatter.cut_stamps[source]


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
        noise, drift = claimed_noise(work, i), lane.covariance[VELOCITY + i, VELOCITY + i] * dt * dt
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
    elif not is_wide:
        limit = WALK_CLIP * max(1.0, scatter.change[source])
        gain = max(1.0 / max(scatter.pairs[source], FEWEST_PAIRS), WALK_GAIN)
        scatter.walk[source] += gain * (min(max(walk, -limit), limit) - scatter.walk[source])


@njit
def is_path_confirmed(state, source):
    """Say whether the path is known well enough to say that fixes are off: velocities confirm it, and nothing doubts.

    Else the path may be wrong and not the fixes.
    """
    is_agreeing = is_live(state, Stream.GNSS_VELOCITY.value, source) and state.trust.refused[VELOCITIES, source] == 0
    return state.doubt == 0.0 and is_agreeing


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


def has_calm_errors(state: np.void, source: int) -> bool:
    """Say whether the fixes of a receiver err together for long: they look like wrong installations and headings."""
    scatter = state["scatter"]
    return bool(scatter["pairs"][source] > MANY_PAIRS and scatter["calm"][source] > TOLD_CALM)
