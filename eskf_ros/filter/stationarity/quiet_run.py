"""Quiet run: IMU blocks in a row that are quiet and have the same mean readings.

At rest and at constant velocity the means stay; a start, a stop and a bend change them, however gently. The change is
felt a second later, seconds to minutes before other sensors have seen it.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.state.time import NEVER

FEWEST_SAMPLES = 3
"""Samples, at least, in each half of a block: fewer do not show the spread."""

CHANGE_SIGMAS = 4.0
"""Standard deviations by which the mean of a quiet block must differ from those before it to show a start or a stop."""

LEAST_CHANGE = (5e-3, 2e-4)
"""m/s2, rad/s; such means scatter by this much, at least: settling springs, wind, drifting biases."""

FEWEST_BLOCKS = 3
"""Quiet blocks, at least, that tell how much their means scatter."""

CHANGE_LASTS = 3_000_000_000
"""ns; a change of the readings counts for this long: those of a robot that moves, however slowly, change again."""

RUN_MEMORY = 10
"""Blocks over which their mean and its scatter are taken."""


@njit
def is_complete(state):
    """Say whether both halves of the block have enough samples and no gap is among them."""
    count = state.rest.block_half_count
    return state.rest.block_broken == 0 and count >= FEWEST_SAMPLES and state.rest.block_count - count >= FEWEST_SAMPLES


@njit
def variance_of_mean(state, i):
    """Return the variance of the mean of the block if its noise is white; axis ``i``: 0 to 2 force, 3 to 5 rate."""
    n, mean = state.rest.block_count, state.rest.block_sum[i] / state.rest.block_count
    return max(state.rest.block_square_sum[i] / n - mean * mean, 0.0) / n


@njit
def has_changed(state):
    """Say whether the mean readings of the block differ from those of the quiet blocks before it: a start, or a stop.

    How much they scatter is learnt, so that neither the noise nor the sway that the parameters allow hides a creep;
    until then it is what white noise, of which the readings would consist, leaves in a mean.
    """
    blocks = state.rest.run_blocks
    if blocks == 0:
        return False
    for i in range(6):
        change = state.rest.block_sum[i] / state.rest.block_count - state.rest.run_mean[i]
        least = LEAST_CHANGE[0] if i < 3 else LEAST_CHANGE[1]
        scatter = state.rest.run_scatter[i] if blocks >= FEWEST_BLOCKS else 2.0 * variance_of_mean(state, i)
        if change * change > CHANGE_SIGMAS**2 * (scatter + least * least):
            return True
    return False


@njit
def has_changed_lately(state):
    """Say whether the mean readings of a quiet IMU change: between the last blocks, or in the one being filled."""
    if state.rest.changed_stamp != NEVER and state.stamp - state.rest.changed_stamp <= CHANGE_LASTS:
        return True
    return is_complete(state) and has_changed(state)


@njit
def add_to_run(state, is_quiet):
    """Add the block to the run of quiet blocks; one that is loud, or changed, begins another."""
    if not is_quiet:
        state.rest.run_blocks = 0
        return
    if has_changed(state):
        state.rest.changed_stamp = state.rest.block_end
        state.rest.run_blocks = 0
    state.rest.run_blocks += 1
    share = 1.0 / min(state.rest.run_blocks, RUN_MEMORY)
    for i in range(6):
        change = state.rest.block_sum[i] / state.rest.block_count - state.rest.run_mean[i]
        if state.rest.run_blocks == 1:
            state.rest.run_mean[i] += change
            state.rest.run_scatter[i] = 0.0
        else:
            state.rest.run_mean[i] += share * change
            state.rest.run_scatter[i] += share * ((1.0 - share) * change * change - state.rest.run_scatter[i])
