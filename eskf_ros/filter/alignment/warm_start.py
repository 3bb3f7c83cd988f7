"""Warm start: what one run knew of biases, place and heading, offered to the next.

Nothing of it is believed unseen. The biases are a prior of the levelling, and are dropped where a robot at rest
contradicts them; the heading is taken when the first fix finds the robot where it was left (``alignment``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from eskf_ros.compiled import njit
from eskf_ros.geodesy.earth import EARTH_RATE, STANDARD_GRAVITY
from eskf_ros.geodesy.rotation import dot

CONTRADICTION = 5.0
"""Sigma beyond which a reading at rest contradicts a remembered bias."""


@dataclass(frozen=True)
class Memory:
    """What is worth knowing at the next start. Position and heading are those of base_link; biases in IMU axes."""

    stamp: int
    """ns, of the IMU sample it holds for."""
    latitude_deg: float
    longitude_deg: float
    altitude: float
    position_std: float
    heading_deg: float
    """Of the x axis: 0 = east at this place, counter-clockwise."""
    heading_std_deg: float
    accel_bias: tuple[float, ...]
    accel_bias_std: tuple[float, ...]
    gyro_bias: tuple[float, ...]
    gyro_bias_std: tuple[float, ...]


@njit
def do_biases_hold(state, mean_force, mean_rate, duration, still, settings):
    """Say whether the remembered biases are to be used for levelling: at rest they must not contradict the readings.

    Mean readings (m/s2, rad/s, IMU axes) over ``duration`` (s). After a restart the memory is too old.
    """
    if settings.has_memory == 0 or state.restarts > 0:
        return False
    if not still:
        return True
    rate_std = math.sqrt(settings.remembered_gyro_bias_std**2 + settings.gyro_noise_density**2 / duration)
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
