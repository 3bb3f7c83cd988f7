"""What the monitors have found, one sentence each with what to do."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.filter.integrity.heading_monitor import LASTING_COUNT, given_heading_complaints, heading_complaints
from eskf_ros.filter.integrity.imu_monitor import BIASED_WINDOWS, FASTEST_TURN, GRAVITY_TOLERANCE, MANY_GAPS
from eskf_ros.filter.state.enums import Stream
from eskf_ros.geodesy.earth import STANDARD_GRAVITY

FEWEST_GAPS = 5
"""Gaps of the IMU from which on their share is judged."""

FEWEST_HOLES = 2
"""Holes in the data of the IMU from which on they are told."""

LEAST_HOLES = 1.0
"""s; shorter ones, all together, are not worth a word."""

LONG_REFUSED = 30.0
"""s; velocities that are rejected for longer than this, while messages come, are reported."""

REFUSED_CAUSES = {
    Stream.WHEEL: "wheel.time_offset, wheel.position, the scale of the speed (estimate.wheel_scale), or slip",
    Stream.BODY_VELOCITY: "body_velocity.mount_rpy_deg, body_velocity.mount_position, body_velocity.time_offset, or "
    "covariances that claim too much",
}
"""What may be wrong with velocities that are rejected for `LONG_REFUSED`, by stream."""


def _refused_complaints(state: np.void) -> list[str]:
    """Return one sentence for each velocity stream that has been rejected for `LONG_REFUSED`."""
    found = []
    for stream, causes in REFUSED_CAUSES.items():
        count = int(state["streams"]["rejected"][stream, 0])
        since = (int(state["stamp"]) - int(state["streams"]["fused_stamp"][stream, 0])) * 1e-9
        last = (int(state["stamp"]) - int(state["streams"]["last_stamp"][stream, 0])) * 1e-9
        if count > LASTING_COUNT and since > LONG_REFUSED > last:
            found.append(f"{count} messages of {stream.name.lower()} in a row contradict the estimate: {causes}")
    return found


def _rate_complaints(state: np.void) -> list[str]:
    """Return a sentence if the IMU is too slow for imu.gap, with the value that would do: no interval is a gap then."""
    monitor = state["imu_monitor"]
    intervals, gaps = int(monitor["intervals"]), int(monitor["gaps"])
    if gaps < FEWEST_GAPS or gaps < MANY_GAPS * intervals:
        return []
    mean = float(monitor["gap_sum"]) / gaps
    spread = math.sqrt(max(0.0, float(monitor["gap_square_sum"]) / gaps - mean * mean))
    wanted = math.ceil(10.0 * (1.2 * mean + 4.0 * spread)) / 10.0
    return [
        f"{gaps} of {intervals} intervals between IMU samples are longer than imu.gap ({mean:.2f} s on average): the "
        f"IMU is too slow or irregular for it; set imu.gap to {wanted:.1f}, or raise the rate of the IMU"
    ]


def gap_complaints(state: np.void) -> list[str]:
    """Return a sentence if samples of the IMU are missing now and then."""
    monitor = state["imu_monitor"]
    gaps, length = int(monitor["gaps"]), float(monitor["gap_sum"])
    if gaps < FEWEST_HOLES or length < LEAST_HOLES or _rate_complaints(state):
        return []
    return [
        f"the data of the IMU have {gaps} holes, {length:.1f} s in all: samples get lost on their way; look at the "
        "bus, the driver and the load of the computer"
    ]


def other_complaints(state: np.void) -> list[str]:
    """Return one sentence for each fault of headings and rejected velocities, with what to do."""
    contradictions = heading_complaints(state)
    return (contradictions or given_heading_complaints(state)) + _refused_complaints(state)


def imu_faults(state: np.void) -> list[str]:
    """Return one sentence for each fault of gravity, mounting and rates that the IMU shows by itself."""
    found = []
    if state["imu_monitor"]["odd_gravity_windows"] > max(1, int(state["imu_monitor"]["windows"]) // 4):
        strength = float(state["imu_monitor"]["odd_gravity"])
        cause = "is its scale right?"
        if strength < 0.05 * STANDARD_GRAVITY:
            cause = "the driver removes gravity; publish the raw specific force (REP-145: +g up at rest)"
        elif abs(strength - 1.0) < GRAVITY_TOLERANCE:
            cause = "it is in units of g; REP-103 wants m/s2"
        found.append(f"the accelerometer reads {strength:.2f} m/s2 where gravity is {STANDARD_GRAVITY:.2f}: {cause}")
    if state["imu_monitor"]["biased_windows"] >= BIASED_WINDOWS:
        x, y, z = np.degrees(state["imu_monitor"]["biased_rate"])
        found.append(
            f"at rest the gyro reads ({x:.2f}, {y:.2f}, {z:.2f}) deg/s, more than imu.gyro_bias_std allows for: raise "
            "it, or calibrate the gyro"
        )
    if state["imu_monitor"]["tilted_windows"] > max(1, int(state["imu_monitor"]["rest_windows"]) // 4):
        x, y, z = (float(value) for value in state["imu_monitor"]["tilted_force"])
        found.append(
            f"at rest gravity is ({x:.1f}, {y:.1f}, {z:.1f}) m/s2 in base_link, not along +z: imu.mount_rpy_deg does "
            "not match the mounting, or the driver publishes North-East-Down axes"
        )
    if state["imu_monitor"]["fast_windows"] > 0:
        found.append(
            f"the gyro reads more than {FASTEST_TURN:.0f} rad/s for seconds: is it in deg/s? REP-103 wants rad/s"
        )
    return found + _rate_complaints(state)
