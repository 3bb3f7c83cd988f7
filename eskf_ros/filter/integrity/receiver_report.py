"""What the monitors of the GNSS receivers have found, one sentence each with its size and what to do."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from eskf_ros.filter.integrity.fault_effects import FAULTS, GYRO_DRIFT, GYRO_SCALE, POSITION_TIME, VELOCITY_TIME
from eskf_ros.filter.integrity.heading_monitor import given_heading_complaints
from eskf_ros.filter.integrity.installation_monitor import FAULT_PRIOR, LASTING_LOOKS, LEAST_FAULT, TIME_ERROR
from eskf_ros.filter.integrity.motion_report import LONGEST_COMPARISON, has_compared
from eskf_ros.filter.integrity.receiver_monitor import (
    FEW_DEPARTURES,
    HIGH_NIS,
    MANY_FIXES,
    UNLIKELY,
)
from eskf_ros.filter.integrity.sample_report import stamp_complaints
from eskf_ros.filter.integrity.scatter import has_calm_errors
from eskf_ros.filter.measurements.stamp_noise import FEWEST_CUT
from eskf_ros.filter.state.error_state import SOURCES

SCATTERED_VELOCITY = 3.0
"""Mean square of the velocities about the humble lane, over their variance, from which on they claim too much."""

DOUBTFUL_SIGMAS = 25.0
"""Standard deviations beyond which a fault of the installation is reported although IMU or fixes are at fault, too."""

IMPLAUSIBLE, IMPLAUSIBLE_SIGMAS = 2.0, 7.0
"""Prior and present standard deviations beyond which a fault of the installation is none, however certain it seems."""

LARGE_MISFIT = 0.2
"""Share by which the sum of the NIS exceeds its degrees of freedom from which on innovations are too large."""

MANY_DEPARTURES = 3
"""Drifts off the path of the IMU from which on they may be why a fault of the installation seems certain."""

VERTICAL_SIGMAS = 30.0
"""The same for a vertical lever arm: it shows by roll and pitch alone, and many other errors go with those."""

LARGEST_TIME_STD = 0.05
"""s; a time offset that is less certain is not told: at one speed it is an offset of the position, which may last."""

OPEN_SIGMAS = 3.0
"""Standard deviations of a time offset from which on it may be why: no other cause is told meanwhile."""

CERTAIN_TIME_STD = 0.02
"""s; standard deviation of the time offset of positions above which takeovers may come from one, or fixes that move
otherwise than velocities: for `LONGEST_COMPARISON` at most."""

NOISY_IMU = (
    "imu.*_noise_density or imu.*_bias_random_walk is too small for it, its bias changes, or its axes or its scale are "
    "wrong"
)


def aid_complaints(state: np.void, settings: np.void, is_explained: bool, is_imu_doubtful: bool) -> list[str]:
    """Return one sentence for each fault of the receivers, with what to do; empty without faults.

    ``is_explained``: clocks or the axes of the IMU are at fault, which would let the receivers look faulty.
    ``is_imu_doubtful``: samples of the IMU are, which may be taken for a wrong installation.
    """
    found: list[str] = []
    is_certain = has_compared(state) and not is_explained
    own, exchanged, _ = state["motion"]["axes"]
    # Velocities that seem to be in other axes contradict all fixes; whether they are takes a while.
    is_explained = is_explained or own > exchanged
    for source in range(SOURCES):
        if is_explained or state["receiver"]["fix_count"][source] < MANY_FIXES:
            continue
        scale = float(settings["gnss_covariance_scale"])
        lies = _covariance_complaints(state, source, scale, _may_be_late(state, source))
        # Fixes that scatter seem to jump.
        paths = [] if lies else _path_complaints(state, source)
        is_doubtful = is_imu_doubtful or bool(paths) or _departures(state, source) >= MANY_DEPARTURES
        is_doubtful = is_doubtful or _is_unexplained(state, source)
        faults = _fault_complaints(state, settings, source, is_doubtful)
        # Those faults explain drifts, contradictions and a high NIS: no sentences of their own.
        found += paths + faults + lies
        # One that is not certain for long may do so, too; or axes of the IMU, which take their time.
        is_open = _may_be_installation(state, source) and not _is_implausible(state, source)
        if is_certain and not is_open and not paths and not faults and not lies:
            # Velocities are judged by the estimate, and by what the IMU says from one to the next.
            if not is_imu_doubtful and not state["recovery"]["resets"]:
                found += _velocity_complaints(state, source)
            found += _departure_complaints(state, source)
    if state["recovery"]["resets"]:
        is_explained = bool(found or given_heading_complaints(state))
        cause = "" if is_explained or not is_certain else f": multipath for many seconds; or {NOISY_IMU}"
        found.append(
            f"{int(state['recovery']['resets'])} times fixes that agree with each other contradicted the filter for so "
            f"long that position and velocity were reset to them{cause}"
        )
    return found + _coast_complaints(state) + _heading_complaints(state)


def _of(source: int) -> str:
    return "" if source == 0 else " of the second receiver"


def _is_implausible(state: np.void, source: int) -> bool:
    """Say whether a fault seems certain that no installation has: something else is wrong, and looks like several."""
    estimate, sigma = (np.abs(state["installation"][name][source]) for name in ("estimate", "sigma"))
    return bool(np.any((estimate > IMPLAUSIBLE * np.array(FAULT_PRIOR)) & (estimate > IMPLAUSIBLE_SIGMAS * sigma)))


def _is_unexplained(state: np.void, source: int) -> bool:
    """Say whether innovations are too large, and the estimated faults leave most of it: something else is wrong."""
    total, degrees = (float(value) for value in state["installation"]["misfit"][source])
    excess, left = total - degrees, float(state["installation"]["unexplained"][source]) - degrees
    return excess > LARGE_MISFIT * degrees and left > 0.5 * excess


def _certain_faults(state: np.void, settings: np.void, source: int, is_doubtful: bool) -> np.ndarray:
    """Return the faults of the installation that are worth a sentence, the others zero."""
    if _is_implausible(state, source):
        return np.zeros(FAULTS)
    found, sigma = state["installation"]["found"][source].copy(), state["installation"]["sigma"][source]
    found[state["installation"]["held"][source] < LASTING_LOOKS] = 0.0
    vertical = int(np.argmax(np.abs(settings["imu_to_base"][2])))
    if abs(found[vertical]) < VERTICAL_SIGMAS * sigma[vertical]:
        found[vertical] = 0.0
    for time in (POSITION_TIME, VELOCITY_TIME):
        if sigma[time] > LARGEST_TIME_STD:
            found[time] = 0.0
    is_uncertain = np.abs(found) < DOUBTFUL_SIGMAS * sigma
    if is_doubtful:
        found[is_uncertain] = 0.0
    if is_uncertain[VELOCITY_TIME] and has_calm_errors(state, source):
        # The velocity of the estimate follows the errors of the fixes, and is late or early with them.
        found[VELOCITY_TIME] = 0.0
    return np.asarray(found)


def _fault_complaints(state: np.void, settings: np.void, source: int, is_doubtful: bool) -> list[str]:
    found, sigma = _certain_faults(state, settings, source, is_doubtful), state["installation"]["sigma"][source]
    group = "gnss" if source == 0 else "second_gnss"
    clock = "ranges" if source == 0 and settings["solves_ranges"] else group
    texts = []
    at_position, at_velocity = float(found[POSITION_TIME]), float(found[VELOCITY_TIME])
    likely = float(state["installation"]["estimate"][source, POSITION_TIME])
    both = at_velocity and abs(likely - at_velocity) < 0.5 * abs(likely)
    if both:
        # Late positions seem to wander, and are less certain than late velocities.
        at_position = likely
    if at_position:
        has_velocity = state["receiver"]["velocity_nis"][source][1] > 0.0
        what = "fixes" if both or not has_velocity else "positions"
        right = float(settings["gnss_time_offset"][source]) + at_position
        # The offset is that of positions and velocities: where velocities are right, theirs takes it back.
        only_positions = source == 0 and not both and not at_velocity and has_velocity
        back = float(settings["velocity_time_offset"]) - at_position
        with_it = f" and gnss.velocity_time_offset to {back:.3f}" if only_positions else ""
        texts.append(
            f"the {what}{_of(source)} are stamped {abs(at_position):.3f} s (+- {sigma[POSITION_TIME]:.3f}) "
            f"{'late' if at_position < 0.0 else 'early'}: set {clock}.time_offset to {right:.3f}{with_it}, or "
            "synchronise the clocks"
        )
    if at_velocity and not both:
        right = float(settings["velocity_time_offset"]) + at_velocity - at_position
        texts.append(
            f"the velocities{_of(source)} are stamped {abs(at_velocity):.3f} s (+- {sigma[VELOCITY_TIME]:.3f}) "
            f"{'late' if at_velocity < 0.0 else 'early'}: set gnss.velocity_time_offset to {right:.3f}"
        )
    arm = found[:POSITION_TIME]
    if np.any(arm):
        x, y, z = (float(value) for value in settings["imu_to_base"] @ arm)
        texts.append(
            f"the antenna{_of(source)} seems to be ({x:+.2f}, {y:+.2f}, {z:+.2f}) m "
            f"(+- {sigma[:POSITION_TIME][arm != 0.0].max():.2f}) in base_link from where {group}.lever_arm says: "
            "measure it again"
        )
    scale = float(found[GYRO_SCALE])
    if scale and source == 0:
        texts.append(
            f"in turns the gyros read {abs(scale) * 100.0:.2f} % (+- {sigma[GYRO_SCALE] * 100.0:.2f}) too "
            f"{'much' if scale > 0.0 else 'little'}: calibrate imu.gyro_scale, or let estimate.imu_scale find it"
        )
    drift = float(found[GYRO_DRIFT])
    if drift and source == 0:
        texts.append(
            f"the gyro bias about the vertical drifts by {math.degrees(abs(drift)) * 60.0:.3f} deg/s a minute "
            f"(+- {math.degrees(sigma[GYRO_DRIFT]) * 60.0:.3f}): let the IMU warm up, or raise "
            "imu.gyro_bias_random_walk"
        )
    return texts


def _covariance_complaints(state: np.void, source: int, scale: float, may_be_late: bool) -> list[str]:
    """Return a sentence if fixes scatter, or move otherwise than velocities, but if they ``may_be_late``."""
    count, scattered = int(state["receiver"]["fix_count"][source]), int(state["receiver"]["scattered_fixes"][source])
    if scattered > max(MANY_FIXES, count // 10):
        factor = float(state["receiver"]["scatter_sum"][source]) / scattered
        if float(state["scatter"]["change"][source]) < 0.5 * factor:
            if may_be_late:
                return []
            return [
                f"{scattered} of {count} fixes{_of(source)} moved otherwise than the velocities of the same receiver, "
                f"by {math.sqrt(factor):.1f} times what they claim: multipath or spoofing, or errors that last for "
                "other reasons; this is allowed for (gnss.correlation_time)"
            ]
        return [
            f"the fixes{_of(source)} scatter {math.sqrt(factor):.1f} times as much as they claim ({scattered} of "
            f"{count}): set gnss.covariance_scale to {factor * scale:.2g}, or gnss.position_std_floor"
        ]
    return []


def aid_notes(state: np.void) -> list[str]:
    """Return one sentence for each receiver whose fixes err together for long: it is allowed for."""
    found = []
    for source in range(SOURCES):
        if state["scatter"]["cut_stamps"][source] >= FEWEST_CUT:
            continue
        change = float(state["scatter"]["change"][source])
        if has_calm_errors(state, source):
            found.append(
                f"the fixes{_of(source)} change by {math.sqrt(change):.2f} times what they claim from one to the next: "
                "their errors last. This is allowed for (gnss.correlation_time, gnss.correlated_share)"
            )
    return found


def _velocity_complaints(state: np.void, source: int) -> list[str]:
    mean, count = (float(value) for value in state["receiver"]["velocity_nis"][source])
    scatter = float(state["scatter"]["velocity"][source])
    if count >= 2 * MANY_FIXES and scatter > SCATTERED_VELOCITY:
        return [
            f"the velocities{_of(source)} scatter {math.sqrt(scatter):.1f} times as much as they claim, and are used "
            "so; set gnss.velocity_std_floor"
        ]
    if count < 2 * MANY_FIXES or mean < HIGH_NIS:
        return []
    return [
        f"the velocities{_of(source)} are {math.sqrt(mean):.1f} times as far from the estimate as the covariances "
        f"allow: they claim too much; or {NOISY_IMU}"
    ]


def _may_be_late(state: np.void, source: int) -> bool:
    """Say whether positions or velocities are likely to be stamped late or early, or whether it is too early to say."""
    estimate, sigma = (state["installation"][name][source] for name in ("estimate", "sigma"))
    if any(abs(estimate[time]) > max(TIME_ERROR, OPEN_SIGMAS * sigma[time]) for time in (POSITION_TIME, VELOCITY_TIME)):
        return True
    is_early = int(state["stamp"]) - int(state["first_stamp"]) < LONGEST_COMPARISON
    return is_early and not 0.0 < sigma[POSITION_TIME] < CERTAIN_TIME_STD


def _may_be_installation(state: np.void, source: int) -> bool:
    """Say whether a fault of the installation is certain or, early on, likely to become so."""
    installation = state["installation"]
    found, estimate, sigma = (installation[name][source] for name in ("found", "estimate", "sigma"))
    is_early = int(state["stamp"]) - int(state["first_stamp"]) < LONGEST_COMPARISON
    likely = (np.abs(estimate) > OPEN_SIGMAS * sigma) & (np.abs(estimate) > LEAST_FAULT)
    return bool(found.any() or (is_early and likely.any()))


def _path_complaints(state: np.void, source: int) -> list[str]:
    found = []
    jumps = int(state["trust"]["jumps"][0, source])
    # What the filter takes for a jump may be its own error: the fixes of the first receiver must have jumped, too.
    if jumps and (source > 0 or state["motion"]["jumps"]):
        length = float(state["trust"]["jump"][0, source])
        found.append(f"the fixes{_of(source)} jumped {jumps} times, by up to {length:.0f} m: multipath or spoofing")
    return found


def _departures(state: np.void, source: int) -> int:
    """Return how often a receiver drifted off the path of the IMU, which no wrong given heading explains."""
    departures = int(state["receiver"]["departures"][source])
    if source == 0 and given_heading_complaints(state):
        departures -= int(state["heading_monitor"]["explained"][1])
    return departures


def _departure_complaints(state: np.void, source: int) -> list[str]:
    """Return a sentence if a receiver drifted off the path of the IMU, or the humble lane had to take over."""
    departures, takeovers = _departures(state, source), int(state["trust"]["takeovers"]) if source == 0 else 0
    if source == 0 and given_heading_complaints(state):
        takeovers -= int(state["heading_monitor"]["explained"][0])
    is_early = int(state["stamp"]) - int(state["first_stamp"]) < LONGEST_COMPARISON
    may_be_late = is_early and float(state["installation"]["sigma"][source, POSITION_TIME]) > CERTAIN_TIME_STD
    if departures < FEW_DEPARTURES and (may_be_late or not takeovers):
        return []
    stamps = []
    if departures:
        stamps.append(int(state["receiver"]["departure_stamp"][source]))
    if takeovers:
        stamps.append(int(state["trust"]["doubt_stamp"]))
    of_stamps = "; or the stamps of the IMU, which jitter, are why" if stamp_complaints(state) else ""
    return [
        f"the receiver{_of(source)} and the IMU went different ways {departures + takeovers} times, once at the stamp "
        f"{min(stamps) * 1e-9:.1f}: multipath or spoofing; or {NOISY_IMU}{of_stamps}"
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
