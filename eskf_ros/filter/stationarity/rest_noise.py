"""Noise at rest: the white noise of the gyros, measured in static windows.

The means of the parts of a window scatter by it, while vibration averages out within a part; so do the changes from
sample to sample, in which a slow sway does not show. The smaller of both is noise.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.stationarity.residual_motion import FEWEST_PARTS, PART, scatter_of_parts

FEWEST_WINDOWS = 5
"""Still windows, at least, that show the noise: some 35 parts, which scatter by a quarter of their variance."""

MEMORY = 50
"""Still windows over which the density is averaged."""


@njit
def measure_gyro_noise(state):
    """Measure the noise of the gyros in a static window that is full and as quiet as at rest."""
    noise = state.gyro_noise
    if state.residual.parts < FEWEST_PARTS:
        return
    interval = (state.stamp - state.window.start) * 1e-9 / (state.window.samples - 1)
    noise.windows += 1
    share = 1.0 / min(noise.windows, MEMORY)
    largest = 0.0
    for i in range(3):
        by_parts = scatter_of_parts(state, 3 + i) * PART * 1e-9
        by_changes = 0.5 * state.quality.change[3 + i] * interval
        noise.square[i] += share * (min(by_parts, by_changes) - noise.square[i])
        largest = max(largest, noise.square[i])
    noise.density = math.sqrt(largest) if noise.windows >= FEWEST_WINDOWS else 0.0
