"""What the monitors of the GNSS receivers have found, one sentence each with its size and what to do."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from eskf_ros.filter.integrity.receiver_monitor import (
    FAULT_PRIOR,
    FAULT_SIGMAS,
    FEW_DEPARTURES,
    HIGH_NIS,
    LEVER_ARM_ERROR,
    MANY_FIXES,
    MODEST_SCATTER,
    TIME,
    TIME_ERROR,
    UNLIKELY,
)
from eskf_ros.filter.state.error_state import SOURCES


def aid_complaints(state: np.void, settings: np.void) -> list[str]:
    """Return one sentence for each fault of the receivers, with what to do; empty without faults."""
    found = []
    for source in range(SOURCES):
        if state["receiver"]["fix_count"][source] < MANY_FIXES:
            continue
        faults = _fault_complaints(state, settings, source)
        lies = _covariance_complaints(state, source, float(settings["gnss_covariance_scale"]))
        # Those faults explain drifts, contradictions and a high NIS: no sentences of their own.
        found += faults + lies
        if not faults and not lies:
            found += _path_complaints(state, source)
            found += _velocity_complaints(state, source) + _departure_complaints(state, source)
    if state["recovery"]["resets"]:
        cause = "" if found else ": IMU noise parameters too small, or multipath for many seconds"
        found.append(
            f"{int(state['recovery']['resets'])} times fixes that agree with each other contradicted the filter for so "
            f"long that position and velocity were reset to them{cause}"
        )
    return found + _coast_complaints(state) + _heading_complaints(state)


def _of(source: int) -> str:
    return "" if source == 0 else " of the second receiver"


def estimated_faults(state: np.void, source: int) -> tuple[np.ndarray, np.ndarray]:
    """Return lever arm error (m, body) and time offset (s), true minus configured, and their sigmas: (4,) each.

    Innovations and a scatter that are larger than expected widen the sigmas.
    """
    scattered = max(1, int(state["receiver"]["scattered_fixes"][source]))
    excess = max(
        1.0,
        float(state["receiver"]["velocity_nis"][source, 0]),
        float(state["receiver"]["scatter_sum"][source]) / scattered,
    )
    information = state["receiver"]["fault_information"][source] + np.diag(1.0 / np.square(FAULT_PRIOR))
    covariance = np.linalg.inv(information) * excess
    estimate = np.linalg.solve(information, state["receiver"]["fault_evidence"][source])
    return estimate, np.sqrt(np.diagonal(covariance))


def _fault_complaints(state: np.void, settings: np.void, source: int) -> list[str]:
    estimate, sigma = estimated_faults(state, source)
    significance = np.abs(estimate) / sigma
    # A large fault leaks into the estimates of the others.
    certain = significance > max(FAULT_SIGMAS, 0.3 * significance.max())
    group = "gnss" if source == 0 else "second_gnss"
    clock = "ranges" if source == 0 and settings["solves_ranges"] else group
    found = []
    if certain[TIME] and abs(estimate[TIME]) > TIME_ERROR:
        right = float(settings["gnss_time_offset"][source]) + estimate[TIME]
        found.append(
            f"the fixes{_of(source)} are stamped {abs(estimate[TIME]):.3f} s (+- {sigma[TIME]:.3f}) "
            f"{'late' if estimate[TIME] < 0.0 else 'early'}: set {clock}.time_offset to {right:.3f}, or synchronise "
            "the clocks"
        )
    arm = estimate[:TIME] * certain[:TIME]
    if np.abs(arm).max() > LEVER_ARM_ERROR:
        x, y, z = (float(value) for value in settings["imu_to_base"] @ arm)
        found.append(
            f"the antenna{_of(source)} seems to be ({x:+.2f}, {y:+.2f}, {z:+.2f}) m "
            f"(+- {sigma[:TIME][certain[:TIME]].max():.2f}) in base_link from where {group}.lever_arm says: measure it "
            "again"
        )
    return found


def _covariance_complaints(state: np.void, source: int, scale: float) -> list[str]:
    count, scattered = int(state["receiver"]["fix_count"][source]), int(state["receiver"]["scattered_fixes"][source])
    if scattered > max(MANY_FIXES, count // 20):
        factor = float(state["receiver"]["scatter_sum"][source]) / scattered
        return [
            f"the fixes{_of(source)} scatter {math.sqrt(factor):.1f} times as much as they claim ({scattered} of "
            f"{count}): set gnss.covariance_scale to {factor * scale:.2g}, or gnss.position_std_floor"
        ]
    share = math.sqrt(float(state["scatter"]["change"][source]))
    if share < MODEST_SCATTER:
        return [
            f"the fixes{_of(source)} scatter {share:.2f} times as much as they claim: they are better than that "
            "(gnss.covariance_scale), or their errors are the same from fix to fix (gnss.correlation_time)"
        ]
    return []


def _velocity_complaints(state: np.void, source: int) -> list[str]:
    mean, count = (float(value) for value in state["receiver"]["velocity_nis"][source])
    if count < 2 * MANY_FIXES or mean < HIGH_NIS:
        return []
    return [
        f"the velocities{_of(source)} are {math.sqrt(mean):.1f} times as far from the estimate as the covariances "
        "allow: they claim too much, or the IMU noise parameters are too small"
    ]


def _path_complaints(state: np.void, source: int) -> list[str]:
    found = []
    jumps = int(state["trust"]["jumps"][0, source])
    if jumps:
        length = float(state["trust"]["jump"][0, source])
        found.append(
            f"the fixes{_of(source)} jumped {jumps} times, by up to {length:.0f} m, and their velocities did not: "
            "multipath or spoofing"
        )
    return found


def _departure_complaints(state: np.void, source: int) -> list[str]:
    departures = int(state["receiver"]["departures"][source])
    if departures < FEW_DEPARTURES:
        return []
    stamp = int(state["receiver"]["departure_stamp"][source]) * 1e-9
    return [
        f"the receiver{_of(source)} and the IMU went different ways {departures} times, first at the stamp "
        f"{stamp:.1f}: multipath, spoofing, or IMU noise parameters that are too small"
    ]


def _coast_complaints(state: np.void) -> list[str]:
    coasts, total = int(state["receiver"]["coasts"]), float(state["receiver"]["coast_nis"])
    if coasts < 2 or 3.0 * total < chdtri(3 * coasts, UNLIKELY):
        return []
    factor = math.sqrt(total / coasts)
    return [
        f"after {coasts} outages the first fixes were {factor:.1f} times as far off as the filter expected: the IMU is "
        "noisier than imu.*_noise_density and imu.*_bias_random_walk say"
    ]


def _heading_complaints(state: np.void) -> list[str]:
    if state["receiver"]["heading_stuck"] < 2:
        return []
    minutes = int(state["receiver"]["heading_stuck"])
    if state["heading_known"]:
        std = math.degrees(float(state["receiver"]["heading_mark_std"]))
        what = f"the heading is known to {std:.1f} deg only and becomes no better"
    else:
        what = "the heading is still unknown"
    return [
        f"{what} in {minutes} minutes of motion: speeding up, braking and turning would tell it, or a dual antenna, "
        "alignment.initial_heading_deg, or alignment.use_course for a vehicle that travels along its x axis"
    ]
