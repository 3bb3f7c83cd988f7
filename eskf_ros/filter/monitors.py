"""Monitors: what is wrong with a whole stream, judged over windows and never by a single message."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.earth import STANDARD_GRAVITY
from eskf_ros.rotation import dot, rotate

NO_GRAVITY = 0.5
"""Below this part of gravity on average the accelerometer cannot be a strapdown one in m/s2, at rest or not."""

GRAVITY_TOLERANCE = 0.2
UPRIGHT_COSINE = 0.7
FASTEST_TURN = 15.0
"""At rest gravity is within this part of its value and within 45 degrees of the z axis of base_link; nothing that
navigates turns this fast (rad/s) for seconds."""


@njit
def watch_input(state, still, settings):
    """Judge the full stillness window: strength of gravity, its direction in base_link, size of the rates."""
    n = state.window_count
    force = (state.window_sum[0] / n, state.window_sum[1] / n, state.window_sum[2] / n)
    rate = (state.window_sum[3] / n, state.window_sum[4] / n, state.window_sum[5] / n)
    strength = math.sqrt(dot(force, force))
    state.windows += 1
    odd = strength < NO_GRAVITY * STANDARD_GRAVITY
    if still and abs(strength / STANDARD_GRAVITY - 1.0) > GRAVITY_TOLERANCE:
        odd = True
    if odd:
        state.odd_gravity_windows += 1
        state.odd_gravity = strength
    elif still:
        state.rest_windows += 1
        force_base = rotate(settings.imu_to_base, force)
        if force_base[2] < UPRIGHT_COSINE * strength:
            state.tilted_windows += 1
            for i in range(3):
                state.tilted_force[i] = force_base[i]
    if math.sqrt(dot(rate, rate)) > FASTEST_TURN:
        state.fast_windows += 1


def complaints(state: np.void) -> list[str]:
    """Say in one sentence each what is wrong with the IMU stream, and what to do; empty when nothing is."""
    found = []
    if state["odd_gravity_windows"] > max(1, int(state["windows"]) // 4):
        strength = float(state["odd_gravity"])
        cause = "is its scale right?"
        if strength < 0.05 * STANDARD_GRAVITY:
            cause = "the driver removes gravity; publish the raw specific force (REP-145: +g up at rest)"
        elif abs(strength - 1.0) < GRAVITY_TOLERANCE:
            cause = "it is in units of g; REP-103 wants m/s2"
        found.append(f"the accelerometer reads {strength:.2f} m/s2 where gravity is {STANDARD_GRAVITY:.2f}: {cause}")
    if state["tilted_windows"] > max(1, int(state["rest_windows"]) // 4):
        x, y, z = (float(value) for value in state["tilted_force"])
        found.append(
            f"at rest gravity is ({x:.1f}, {y:.1f}, {z:.1f}) m/s2 in base_link, not along +z: imu.mount_rpy_deg does "
            "not match the mounting, or the driver publishes North-East-Down axes"
        )
    if state["fast_windows"] > 0:
        found.append(
            f"the gyro reads more than {FASTEST_TURN:.0f} rad/s for seconds: is it in deg/s? REP-103 wants rad/s"
        )
    resets = int(state["resets"])
    if resets:
        found.append(
            f"{resets} times fixes that agree with each other contradicted the filter for so long that position and "
            "velocity were reset to them: IMU noise parameters too small, or multipath for many seconds"
        )
    return found
