"""What the IMU did since the last point on the grid of the constraints: means and spread of its readings."""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.layout import CONSTRAINT_INTERVAL, Verdict

GATE = int(Verdict.GATE)

FEWEST_SAMPLES = 5
"""Of fewer samples the spread says nothing."""


@njit
def add_to_block(state, settings):
    """Add the newest IMU sample to the sums since the last grid point."""
    end = -(-state.stamp // CONSTRAINT_INTERVAL) * CONSTRAINT_INTERVAL
    if state.block_end != end:
        state.block_end = end
        state.block_broken = 0
        state.block_count = 0
        for i in range(6):
            state.block_sum[i] = 0.0
            state.block_square_sum[i] = 0.0
    if state.imu_interval > settings.imu_gap:
        state.block_broken = 1
    state.block_count += 1
    for i in range(3):
        force, rate = state.specific_force[i], state.angular_rate[i]
        state.block_sum[i] += force
        state.block_square_sum[i] += force * force
        state.block_sum[3 + i] += rate
        state.block_square_sum[3 + i] += rate * rate


@njit
def has_block(state):
    """Say whether the state stands at a grid point and has the readings before it without a gap."""
    return state.block_end == state.stamp and state.block_broken == 0 and state.block_count >= FEWEST_SAMPLES


@njit
def mean_force(state):
    """Return the mean specific force (m/s2, IMU axes, raw) since the last grid point."""
    n, total = state.block_count, state.block_sum
    return (total[0] / n, total[1] / n, total[2] / n)


@njit
def watch_wheels(state, aid):
    """Note when the wheels spoke, and when the gate refused to believe them: they slip."""
    state.wheel_stamp = aid.stamp
    if aid.verdict == GATE:
        state.slip_stamp = aid.stamp
