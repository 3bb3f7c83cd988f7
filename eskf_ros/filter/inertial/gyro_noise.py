"""Gyro noise: as the parameters say, or as the gyros show it at rest (`rest_noise`), if that is clearly more.

A gyro that is noisier than `imu.gyro_noise_density` would make the filter certain of a heading that has wandered off.
"""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import njit

GYRO_NOISE = np.dtype([("windows", "i8"), ("square", "f8", (3,)), ("density", "f8")], align=True)
"""What the gyros have shown at rest.

- ``windows``: still windows that were measured. ``square``: the mean square of the density of each axis (rad2/s).
- ``density``: that of the noisiest axis (rad/s/rtHz); 0 until enough windows were measured.
"""

CLEARLY_MORE = 1.5
"""Ratio of the measured to the told density above which the measured one counts."""


@njit
def gyro_density(state, settings):
    """Return the density of the white noise of the gyros (rad/s/rtHz)."""
    told, measured = settings.gyro_noise_density, state.gyro_noise.density
    return measured if measured > CLEARLY_MORE * told else told


@njit
def gyro_noise_variance(state, settings):
    """Return the variance (rad2/s2 per axis) of the white noise of a single gyro reading."""
    return gyro_density(state, settings) ** 2 / state.imu.interval
