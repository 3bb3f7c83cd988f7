"""Warm start: biases, place and heading at the end of one run, offered to the next.

All of it is checked before use. The biases are a prior of the levelling and are dropped where a robot at rest
contradicts them. The heading is used when the first fix finds the robot where it was left (`heading`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.geodesy.earth import EARTH_RATE, STANDARD_GRAVITY
from eskf_ros.geodesy.rotation import dot

CONTRADICTION = 5.0
"""Standard deviations beyond which a reading at rest contradicts a remembered bias."""


@dataclass(frozen=True)
class Memory:
    """The state of one run that the next one can use: position and heading of base_link, biases in IMU axes.

    Units: position and its standard deviation in m, biases in m/s2 and rad/s.
    """

    stamp: int
    """ns; stamp of the IMU sample for which it holds."""
    latitude_deg: float
    longitude_deg: float
    altitude: float
    position_std: float
    heading_deg: float
    """Heading of the x axis of base_link: 0 = east at this place, counter-clockwise."""
    heading_std_deg: float
    accel_bias: tuple[float, ...]
    accel_bias_std: tuple[float, ...]
    gyro_bias: tuple[float, ...]
    gyro_bias_std: tuple[float, ...]


@njit
def do_biases_hold(state, mean_force, mean_rate, duration, still, settings):
    """Say whether the remembered biases may be used for levelling: at rest they must not contradict the readings.

    The mean readings (m/s2, rad/s, IMU axes) are over ``duration`` (s). After a restart the memory is too old.
    """
    if settings.has_memory == 0 or state.restarts > 0:
        return False
    if not still:
        return True
    rate_std = math.sqrt(settings.remembered_gyro_bias_std**2 + gyro_density(state, settings) ** 2 / duration)
    for i in range(3):
        if abs(mean_rate[i] - settings.remembered_gyro_bias[i]) > CONTRADICTION * rate_std + EARTH_RATE:
            return False
    force = (
        mean_force[0] - settings.remembered_accel_bias[0],
        mean_force[1] - settings.remembered_accel_bias[1],
        mean_force[2] - settings.remembered_accel_bias[2],
    )
    force_std = math.sqrt(settings.remembered_accel_bias_std**2 + settings.accel_noise_density**2 / duration)
    # Gravity on Earth is within 0.3 % of its standard value.
    return abs(math.sqrt(dot(force, force)) - STANDARD_GRAVITY) < CONTRADICTION * force_std + 0.003 * STANDARD_GRAVITY
