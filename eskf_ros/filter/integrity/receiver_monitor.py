"""Monitors of the GNSS receivers: what their innovations say of faults that no single message shows.

- A lever arm or a time offset that is wrong: the antenna is R dl + v dt from where it is looked for. What such a fault
  does to the state is followed through every update, and the innovations are compared with what is left of it
  (Friedland, Treatment of bias in recursive filtering, 1969).
- A receiver that leaves the path that the IMU measures: cumulated sums of the innovations (Page,
  Continuous inspection schemes, 1954).
- Covariances that are too small or too large, and a filter that is too sure of itself after outages.
- A heading that does not become known although the robot moves.

All sums are of the state and rewound with it.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.integrity.fix_tracker import is_led
from eskf_ros.filter.measurements.gnss_position import noise_factor
from eskf_ros.filter.measurements.gnss_velocity import predict
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, GYRO_BIAS, POSITION, SOURCES, VELOCITY
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.rotation import cross, rotate, to_matrix

RECEIVER_MONITOR = np.dtype(
    [
        ("fault_stamp", "i8"),
        ("fault_force", "f8", (3,)),
        ("fault_absorbed", "f8", (SOURCES, ERROR_SIZE, 4)),
        ("fault_information", "f8", (SOURCES, 4, 4)),
        ("fault_evidence", "f8", (SOURCES, 4)),
        ("drift_sums", "f8", (SOURCES, 4)),
        ("departures", "i8", (SOURCES,)),
        ("departure_stamp", "i8", (SOURCES,)),
        ("seen_stamp", "i8", (SOURCES,)),
        ("fix_count", "i8", (SOURCES,)),
        ("scattered_fixes", "i8", (SOURCES,)),
        ("scatter_sum", "f8", (SOURCES,)),
        ("contradicted_fixes", "i8", (SOURCES,)),
        ("contradiction_rate", "f8", (SOURCES,)),
        ("velocity_nis", "f8", (SOURCES, 2)),
        ("coasts", "i8"),
        ("coast_nis", "f8"),
        ("heading_mark_stamp", "i8"),
        ("heading_mark_std", "f8"),
        ("heading_stuck", "i8"),
    ],
    align=True,
)
"""Monitors of the GNSS receivers.

``fault_*``: effect of faults on the state so far, and normal equations; ``drift_sums``: innovations up and down on two
axes; ``departures`` and the rest: counts, means and sums.
"""

FAULTS = 4
TIME = 3
"""Three axes of the lever arm (m, body), and the time offset (s)."""

MEMORY = 600.0
"""Faults are learnt from about so many seconds."""

FAULT_PRIOR = (5.0, 5.0, 5.0, 1.0)
FAULT_SIGMAS = 6.0
LEVER_ARM_ERROR = 0.05
TIME_ERROR = 0.01
"""What a fault may be at the most (m, m, m, s), and when it is named: beyond so many sigma and so much."""

DRIFT_ALLOWANCE = 0.5
DRIFT_LIMIT = 16.0
"""A sum of innovations, in sigma, less so much each, that reaches this happens by chance once in hundreds of hours."""

FEW_DEPARTURES = 3
"""So often it may be reached by errors of fixes that last."""

LONG_COAST = 5_000_000_000
MANY_FIXES = 50
"""An outage that counts (ns); so few fixes or velocities prove nothing."""

FEW_FIXES = 5
"""So many that move otherwise than the velocities are an accident."""

MODEST_SCATTER = 0.12
HIGH_NIS = 2.0
NIS_CLIP = 10.0
NIS_GAIN = 0.01
"""Sigma by which fixes scatter, as a share of what they claim; mean NIS of velocities and the most that one counts, per
degree of freedom."""

UNLIKELY = 1e-4
"""Chance that outages end as badly with a filter that is honest."""

HEADING_INTERVAL = 60_000_000_000
SHRINKING = 0.9
"""While a robot moves the sigma of its heading shrinks at least to this share in this time (ns), until it is good."""


@njit
def watch_aid(state, aid, size, gate, work, settings):
    """Learn from a measurement that went through the update; ``gate`` and ``work`` as they were for it."""
    learn_faults(state, aid, size, gate, work, settings)
    if aid.stream == Stream.GNSS_POSITION:
        watch_fix(state, aid)
    elif aid.stream == Stream.GNSS_VELOCITY:
        watch_velocity(state, aid)
    if aid.stream == Stream.GNSS_VELOCITY or (aid.stream == Stream.GNSS_POSITION and not is_led(state, aid.source)):
        watch_departure(state, aid.source, work)
    if aid.stream == Stream.GNSS_POSITION:
        watch_heading_std(state, settings)


@njit
def write_effect(state, aid, work, settings):
    """Write what the faults of a receiver add to its measurement to ``work.effect`` (3, 4); zero for all other aids."""
    effect = work.effect
    for i in range(3):
        for k in range(FAULTS):
            effect[i, k] = 0.0
    rotation = to_matrix(state.attitude)
    if aid.stream == Stream.GNSS_POSITION:
        velocity = predict(state, aid.source, settings)
        for i in range(3):
            for k in range(3):
                effect[i, k] = rotation[i][k]
            effect[i, TIME] = velocity[i]
    elif aid.stream == Stream.GNSS_VELOCITY:
        rate = body_rate(state, rotation)
        force, bias = state.specific_force, state.accel_bias
        felt = rotate(rotation, (force[0] - bias[0], force[1] - bias[1], force[2] - bias[2]))
        gravity = gravity_map(state, (state.position_map[0], state.position_map[1], state.position_map[2]))
        x = rotate(rotation, cross(rate, (1.0, 0.0, 0.0)))
        y = rotate(rotation, cross(rate, (0.0, 1.0, 0.0)))
        z = rotate(rotation, cross(rate, (0.0, 0.0, 1.0)))
        for i in range(3):
            effect[i, 0], effect[i, 1], effect[i, 2] = x[i], y[i], z[i]
            effect[i, TIME] = felt[i] + gravity[i]


@njit
def learn_faults(state, aid, size, gate, work, settings):
    """Follow what faults have done to the state, and compare the innovation with what is left of them."""
    if state.heading_known == 0:
        state.receiver.fault_stamp = NEVER
        return
    if state.receiver.fault_stamp == NEVER:
        state.receiver.fault_absorbed[:] = 0.0
    dt = carry_absorbed(state)
    accepted = aid.verdict in (Verdict.FUSED, Verdict.WEIGHED_DOWN)
    for source in range(SOURCES):
        absorbed = state.receiver.fault_absorbed[source]
        write_effect(state, aid, work, settings)
        effect = work.effect
        is_own = source == aid.source and aid.stream in (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY)
        if is_own and aid.verdict == Verdict.RESET:
            for i in range(3):
                for k in range(FAULTS):
                    absorbed[i, k] = effect[i, k]
            continue
        for a in range(size):
            for k in range(FAULTS):
                if not is_own:
                    effect[a, k] = 0.0
                for i in range(ERROR_SIZE):
                    effect[a, k] -= work.jacobian[a, i] * absorbed[i, k]
        if is_own and aid.verdict != Verdict.CONTRADICTED:
            weigh_faults(state, source, dt, min(1.0, gate / max(aid.nis, 1e-9)), work)
        if accepted:
            for i in range(ERROR_SIZE):
                for k in range(FAULTS):
                    for a in range(size):
                        absorbed[i, k] += work.gain[i, a] * effect[a, k]


@njit
def carry_absorbed(state):
    """Let what the state has absorbed of the faults act until now; return the time (s) since the last measurement.

    In one step of trapezoids: exact enough for a second of a car, and the sums are forgiving.
    """
    rotation = to_matrix(state.attitude)
    f, b = state.specific_force, state.accel_bias
    force = rotate(rotation, (f[0] - b[0], f[1] - b[1], f[2] - b[2]))
    dt = 0.0 if state.receiver.fault_stamp == NEVER else (state.stamp - state.receiver.fault_stamp) * 1e-9
    last = state.receiver.fault_force
    mean = (0.5 * (force[0] + last[0]), 0.5 * (force[1] + last[1]), 0.5 * (force[2] + last[2]))
    for source in range(SOURCES):
        a = state.receiver.fault_absorbed[source]
        for k in range(FAULTS):
            turning = rotate(rotation, (a[GYRO_BIAS, k], a[GYRO_BIAS + 1, k], a[GYRO_BIAS + 2, k]))
            pulling = rotate(rotation, (a[ACCEL_BIAS, k], a[ACCEL_BIAS + 1, k], a[ACCEL_BIAS + 2, k]))
            tilt = (
                a[ATTITUDE, k] - 0.5 * dt * turning[0],
                a[ATTITUDE + 1, k] - 0.5 * dt * turning[1],
                a[ATTITUDE + 2, k] - 0.5 * dt * turning[2],
            )
            pushing = cross(tilt, mean)
            for i in range(3):
                gain = dt * (pushing[i] - pulling[i])
                a[POSITION + i, k] += dt * (a[VELOCITY + i, k] + 0.5 * gain)
                a[VELOCITY + i, k] += gain
                a[ATTITUDE + i, k] -= dt * turning[i]
    state.receiver.fault_stamp = state.stamp
    for i in range(3):
        state.receiver.fault_force[i] = force[i]
    return dt


@njit
def weigh_faults(state, source, dt, weight, work):
    """Add one innovation to the normal equations of the faults; ``work.innovation_covariance`` is inverted already."""
    inverse, effect = work.innovation_covariance, work.effect
    remains = max(0.0, 1.0 - dt / MEMORY)
    for k in range(FAULTS):
        state.receiver.fault_evidence[source, k] *= remains
        for m in range(FAULTS):
            state.receiver.fault_information[source, k, m] *= remains
        for a in range(3):
            spread = 0.0
            for b in range(3):
                spread += effect[b, k] * inverse[b, a]
            state.receiver.fault_evidence[source, k] += weight * spread * work.innovation[a]
            for m in range(FAULTS):
                state.receiver.fault_information[source, k, m] += weight * spread * effect[a, m]


@njit
def watch_fix(state, aid):
    """Count fixes that claim too much, contradict the velocities, or come after an outage."""
    source = aid.source
    state.receiver.fix_count[source] += 1
    if NEVER < state.receiver.seen_stamp[source] < state.stamp - LONG_COAST and state.heading_known == 1:
        state.receiver.coasts += 1
        state.receiver.coast_nis += min(aid.nis / 3.0, NIS_CLIP**2)
    state.receiver.seen_stamp[source] = state.stamp
    factor = noise_factor(state, source)
    if factor > 1.0:
        state.receiver.scattered_fixes[source] += 1
        state.receiver.scatter_sum[source] += factor
    if aid.verdict == Verdict.CONTRADICTED:
        rate = state.tracker.rate[source]
        state.receiver.contradicted_fixes[source] += 1
        speed = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
        state.receiver.contradiction_rate[source] = max(state.receiver.contradiction_rate[source], speed)


@njit
def watch_velocity(state, aid):
    """Keep the mean of the normalised innovations squared of the velocities."""
    nis = min(aid.nis / 3.0, NIS_CLIP)
    sums = state.receiver.velocity_nis[aid.source]
    sums[0] += NIS_GAIN * (nis - sums[0])
    sums[1] += 1.0


@njit
def watch_departure(state, source, work):
    """Add the innovation to the sums for both directions of the horizontal axes; count those that reach the limit.

    Of the velocities, where there are any: errors of fixes are alike for seconds.
    """
    sums = state.receiver.drift_sums[source]
    for i in range(2):
        # The diagonal of the inverse is at most the inverse of the diagonal.
        sigmas = work.innovation[i] * math.sqrt(work.innovation_covariance[i, i])
        sigmas = max(-3.0, min(3.0, sigmas))
        sums[2 * i] = max(0.0, sums[2 * i] + sigmas - DRIFT_ALLOWANCE)
        sums[2 * i + 1] = max(0.0, sums[2 * i + 1] - sigmas - DRIFT_ALLOWANCE)
    if max(max(sums[0], sums[1]), max(sums[2], sums[3])) >= DRIFT_LIMIT:
        sums[:] = 0.0
        if state.receiver.departures[source] == 0:
            state.receiver.departure_stamp[source] = state.stamp
        state.receiver.departures[source] += 1


@njit
def watch_heading_std(state, settings):
    """Look every minute whether the heading has become better while the robot moved."""
    if state.stamp - state.receiver.heading_mark_stamp < HEADING_INTERVAL:
        return
    std = math.sqrt(state.covariance[ATTITUDE + 2, ATTITUDE + 2]) if state.heading_known == 1 else math.pi
    is_moving = state.window.motion_stamp > state.stamp - HEADING_INTERVAL // 2
    stuck = is_moving and std > settings.good_heading_std and std > SHRINKING * state.receiver.heading_mark_std
    if state.receiver.heading_mark_stamp != NEVER:
        state.receiver.heading_stuck = state.receiver.heading_stuck + 1 if stuck else 0
    state.receiver.heading_mark_stamp = state.stamp
    state.receiver.heading_mark_std = std


def aid_complaints(state: np.void, settings: np.void) -> list[str]:
    """Say in one sentence each what is wrong with the receivers, and what to do; empty when nothing is."""
    found = []
    for source in range(SOURCES):
        if state["receiver"]["fix_count"][source] < MANY_FIXES:
            continue
        faults = _fault_complaints(state, settings, source)
        lies = _covariance_complaints(state, source, float(settings["gnss_covariance_scale"]))
        # What follows from those needs no sentence of its own.
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

    Innovations that are larger than expected make them less certain.
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
    # A large fault leaves something of itself in the estimates of the others.
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
    share = math.sqrt(float(state["tracker"]["scatter"][source]))
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
    contradicted, jumps = int(state["receiver"]["contradicted_fixes"][source]), int(state["tracker"]["jumps"][source])
    if contradicted > FEW_FIXES:
        found.append(
            f"{contradicted} fixes{_of(source)} moved otherwise than the velocities of the same receiver, by up to "
            f"{float(state['receiver']['contradiction_rate'][source]):.1f} m/s: multipath or spoofing; they "
            "were not fused"
        )
    if jumps:
        length = float(state["tracker"]["jump"][source])
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
