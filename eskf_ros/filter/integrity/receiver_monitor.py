"""Receiver monitor: faults of GNSS receivers that no single message shows, found from their innovations.

- Wrong lever arm or time offset: the antenna is R dl + v dt away from where the filter expects it. The effect of such a
  fault on the state is carried through every prediction and update, and the innovations are compared with what remains
  of it (Friedland, Treatment of bias in recursive filtering, 1969).
- A receiver that drifts away from the path that the IMU measures: CUSUM of the innovations (Page, Continuous inspection
  schemes, 1954).
- Covariances that are too small or too large, and a filter that is overconfident after outages.
- A heading that does not become more certain although the robot moves.

All sums are part of the state, so that a rewind restores them.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.integrity.scatter import NOTABLE_SCATTER
from eskf_ros.filter.measurements.gnss_velocity import predict
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, GYRO_BIAS, POSITION, SOURCES, VELOCITY
from eskf_ros.filter.state.streams import is_live
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
        ("velocity_nis", "f8", (SOURCES, 2)),
        ("coasts", "i8"),
        ("coast_nis", "f8"),
        ("heading_mark_stamp", "i8"),
        ("heading_mark_std", "f8"),
        ("heading_stuck", "i8"),
    ],
    align=True,
)
"""Sums and counts of the monitors, by receiver.

- ``fault_stamp``, ``fault_force``: stamp (ns) and specific force (m/s2, map) of the last step of the fault estimation.
- ``fault_absorbed``: derivative of the 15 errors of the core by the faults.
- ``fault_information``, ``fault_evidence``: normal equations of the faults.
- ``drift_sums``: CUSUM of the innovations, upwards and downwards, on two axes.
- ``departures``, ``departure_stamp``: how often a CUSUM reached its threshold, and when first (ns).
- ``seen_stamp``, ``fix_count``: the last fix (ns), and the number of fixes.
- ``scattered_fixes``, ``scatter_sum``: fixes with inflated noise, and the sum of their factors.
- ``velocity_nis``: running mean of the NIS of the velocities per degree of freedom, and their number.
- ``coasts``, ``coast_nis``: outages, and the sum of the NIS per degree of freedom of the first fixes after them.
- ``heading_mark_stamp``, ``heading_mark_std``: the last check of the heading (ns), and its standard deviation (rad).
- ``heading_stuck``: checks in a row without progress.
"""

FAULTS = 4
"""Faults that are estimated for each receiver: three axes of the lever arm (m, body), and the time offset (s)."""

TIME = 3
"""Index of the time offset among the faults."""

MEMORY = 600.0
"""s; time constant with which the normal equations of the faults forget."""

FAULT_PRIOR = (5.0, 5.0, 5.0, 1.0)
"""Prior standard deviations of the faults (m, m, m, s)."""

FAULT_SIGMAS = 6.0
"""Standard deviations from zero beyond which a fault is reported."""

LEVER_ARM_ERROR = 0.05
"""m; smaller errors of the lever arm are not reported."""

TIME_ERROR = 0.01
"""s; smaller time offsets are not reported."""

DRIFT_ALLOWANCE = 0.5
"""CUSUM allowance (sigma): the part of each innovation that the sum does not count."""

DRIFT_LIMIT = 16.0
"""CUSUM threshold (sigma): white innovations reach it by chance about once in hundreds of hours."""

FEW_DEPARTURES = 3
"""A drift is reported from this many threshold crossings on: correlated errors of fixes may cause fewer."""

LONG_COAST = 5_000_000_000
"""ns; shorter outages are not judged."""

MANY_FIXES = 50
"""Fixes that a receiver must have sent before anything of it is reported. Velocities need twice as many."""

MODEST_SCATTER = 0.12
"""Scatter of the fixes over the standard deviation they claim, below which the claim is reported as too large."""

HIGH_NIS = 2.0
"""Mean NIS of the velocities per degree of freedom above which their covariances are reported as too small."""

NIS_CLIP = 10.0
"""Largest NIS per degree of freedom that a velocity counts with; the first fix after an outage: its square."""

NIS_GAIN = 0.01
"""Weight of the newest velocity in the running mean of the NIS."""

UNLIKELY = 1e-4
"""Probability below which the innovations after outages contradict a consistent filter (chi-square test)."""

HEADING_INTERVAL = 60_000_000_000
"""ns; time between two checks whether the heading has become more certain."""

SHRINKING = 0.9
"""Share to which the standard deviation of the heading has to shrink from one check to the next, until it is good."""


@njit
def watch_aid(state, aid, size, gate, work, settings):
    """Update the monitors with a measurement after its update; ``gate`` and ``work`` as the update had them."""
    learn_faults(state, aid, size, gate, work, settings)
    if aid.stream == Stream.GNSS_POSITION:
        watch_fix(state, aid)
    elif aid.stream == Stream.GNSS_VELOCITY:
        watch_velocity(state, aid)
    if aid.stream == Stream.GNSS_VELOCITY or (aid.stream == Stream.GNSS_POSITION and not is_live(state, Stream.GNSS_VELOCITY.value, aid.source)):
        watch_departure(state, aid.source, work)
    if aid.stream == Stream.GNSS_POSITION:
        watch_heading_std(state, settings)


@njit
def write_effect(state, aid, work, settings):
    """Write the derivative of a measurement by the faults of its receiver to ``work.effect`` (3, 4).

    It is zero for all streams but GNSS position and velocity.
    """
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
    """Carry the effect of the faults on the state through one update, and learn from its innovation."""
    if state.heading_known == 0:
        state.receiver.fault_stamp = NEVER
        return
    if state.receiver.fault_stamp == NEVER:
        state.receiver.fault_absorbed.fill(0.0)
    dt = carry_absorbed(state)
    accepted = aid.verdict in (Verdict.FUSED, Verdict.WEIGHED_DOWN, Verdict.TAKEOVER)
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
        if is_own:
            weigh_faults(state, source, dt, min(1.0, gate / max(aid.nis, 1e-9)), work)
        if accepted:
            for i in range(ERROR_SIZE):
                for k in range(FAULTS):
                    for a in range(size):
                        absorbed[i, k] += work.gain[i, a] * effect[a, k]


@njit
def carry_absorbed(state):
    """Carry the effect of the faults on the state to the present; return the time (s) since the last measurement.

    One step of the trapezoidal rule: exact enough for a second of a car's motion, and the fault estimates tolerate
    more.
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
    """Add one innovation to the normal equations of the faults; ``work.innovation_covariance`` is inverted already.

    ``dt`` (s): the time since the last measurement; ``weight``: below 1 for an innovation outside the gate.
    """
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
    """Count fixes with inflated noise, and first fixes after an outage."""
    source = aid.source
    state.receiver.fix_count[source] += 1
    if NEVER < state.receiver.seen_stamp[source] < state.stamp - LONG_COAST and state.heading_known == 1:
        state.receiver.coasts += 1
        state.receiver.coast_nis += min(aid.nis / 3.0, NIS_CLIP**2)
    state.receiver.seen_stamp[source] = state.stamp
    factor = state.scatter.spread[source]
    if factor > NOTABLE_SCATTER:
        state.receiver.scattered_fixes[source] += 1
        state.receiver.scatter_sum[source] += factor


@njit
def watch_velocity(state, aid):
    """Update the running mean of the NIS of the velocities, per degree of freedom."""
    nis = min(aid.nis / 3.0, NIS_CLIP)
    sums = state.receiver.velocity_nis[aid.source]
    sums[0] += NIS_GAIN * (nis - sums[0])
    sums[1] += 1.0


@njit
def watch_departure(state, source, work):
    """Update the CUSUM of the innovations in both directions of the horizontal axes; count threshold crossings.

    It sums the innovations of the velocities where there are any, because errors of fixes are correlated for seconds.
    """
    sums = state.receiver.drift_sums[source]
    for i in range(2):
        # The matrix is inverted already; its diagonal is at least the inverse of the variance.
        sigmas = work.innovation[i] * math.sqrt(work.innovation_covariance[i, i])
        sigmas = max(-3.0, min(3.0, sigmas))
        sums[2 * i] = max(0.0, sums[2 * i] + sigmas - DRIFT_ALLOWANCE)
        sums[2 * i + 1] = max(0.0, sums[2 * i + 1] - sigmas - DRIFT_ALLOWANCE)
    if max(max(sums[0], sums[1]), max(sums[2], sums[3])) >= DRIFT_LIMIT:
        sums.fill(0.0)
        if state.receiver.departures[source] == 0:
            state.receiver.departure_stamp[source] = state.stamp
        state.receiver.departures[source] += 1


@njit
def watch_heading_std(state, settings):
    """Check every minute whether the standard deviation of the heading has shrunk while the robot moved."""
    if state.stamp - state.receiver.heading_mark_stamp < HEADING_INTERVAL:
        return
    std = math.sqrt(state.covariance[ATTITUDE + 2, ATTITUDE + 2]) if state.heading_known == 1 else math.pi
    is_moving = state.window.motion_stamp > state.stamp - HEADING_INTERVAL // 2
    stuck = is_moving and std > settings.good_heading_std and std > SHRINKING * state.receiver.heading_mark_std
    if state.receiver.heading_mark_stamp != NEVER:
        state.receiver.heading_stuck = state.receiver.heading_stuck + 1 if stuck else 0
    state.receiver.heading_mark_stamp = state.stamp
    state.receiver.heading_mark_std = std
