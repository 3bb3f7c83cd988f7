"""Static detector for ZUPT and ZARU: is the robot stationary at a grid point of the constraints?

At constant velocity an IMU reads what it reads at rest. Quiet readings are therefore necessary but not sufficient:

- Sensors that see motion decide if there are any: wheels, and velocities and fixes collected until they would show a
  creep (`seen_motion`). Motion seen by any of them is a veto (a change of the air pressure is motion, too), and rest
  seen by one of them is sufficient, unless a dual antenna cannot exclude a turn yet.
- If no such sensor has reported for `EVIDENCE_LASTS` (a tunnel), the readings must be as quiet as they were when a
  sensor saw rest. Unless the readings of this robot in motion were always plainly less quiet, the estimated velocity
  must be near zero, too. Without such sensors one motion remains undetectable: about a decimetre per second at constant
  velocity, of a robot that moves as smoothly as it stands.

Quietness is measured by the variance of raw readings, which a bias does not change. All of it is part of the state, so
that a rewind restores it.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, YY, ZZ
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.inertial.sample_quality import is_hidden
from eskf_ros.filter.state.enums import CONSTRAINT_INTERVAL, Stream, Verdict
from eskf_ros.filter.state.error_state import GYRO_BIAS, VELOCITY
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.quiet_run import (
    CHANGE_SIGMAS,
    LEAST_CHANGE,
    add_to_run,
    has_changed,
    is_complete,
    variance_of_mean,
)
from eskf_ros.filter.stationarity.seen_motion import (
    BODY_EYE,
    Seen,
    has_sight,
    open_motion,
    see_fix,
    see_velocity,
    see_yaw,
)
from eskf_ros.filter.stationarity.static_window import MEASURED_SPEED, update_motion
from eskf_ros.geodesy.earth import geodetic_to_ecef
from eskf_ros.geodesy.rotation import dot, rotate_back, to_matrix

REST = np.dtype(
    [
        ("block_end", "i8"),
        ("block_broken", "i8"),
        ("block_count", "i8"),
        ("block_sum", "f8", (6,)),
        ("block_square_sum", "f8", (6,)),
        ("block_half_count", "i8"),
        ("block_half_sum", "f8", (6,)),
        ("run_blocks", "i8"),
        ("run_mean", "f8", (6,)),
        ("run_scatter", "f8", (6,)),
        ("moving_stamp", "i8"),
        ("resting_stamp", "i8"),
        ("doubt_stamp", "i8"),
        ("changed_stamp", "i8"),
        ("moving_activity", "f8"),
        ("resting_activity", "f8"),
        ("quiet", "i8"),
        ("quiet_pressure_stamp", "i8"),
        ("quiet_pressure", "f8"),
        ("wheel_stamp", "i8"),
        ("slip_stamp", "i8"),
    ],
    align=True,
)
"""IMU samples since the last grid point of the constraints (a block), and evidence of rest and motion.

- ``block_end``, ``block_broken``: the grid point that ends the block (ns), and whether a sample is missing in it.
- ``block_count``, ``block_sum``, ``block_square_sum``: samples, sums and sums of squares (m/s2, rad/s).
- ``block_half_count``, ``block_half_sum``: the same for the first half of the block.
- ``run_blocks``, ``run_mean``, ``run_scatter``: quiet blocks in a row with the same mean readings, this mean, and the
  variance of the means of single blocks about it.
- ``moving_stamp``, ``resting_stamp``: when another sensor last saw motion and rest (ns).
- ``doubt_stamp``: when the dual antenna could last not exclude a turn (ns).
- ``changed_stamp``: the end of the last quiet block whose mean readings were not those before it (ns).
- ``moving_activity``, ``resting_activity``: learnt activity of the IMU (see `unrest`) in motion and at rest.
- ``quiet``: whether the IMU was quiet in the last block.
- ``quiet_pressure*``: pressure at the time when the IMU became quiet.
- ``wheel_stamp``, ``slip_stamp``: the last message of the wheels, and the last one that the gate rejected (ns).
"""

STEADY_SIGMAS = 4.0
"""Standard deviations by which the means of the two halves of a block may differ at rest."""

EVIDENCE_LASTS = 1_500_000_000
"""ns; what a sensor saw, rest or motion, counts for this long."""

MOTION_SIGMAS = 4.0
"""Standard deviations that a velocity must exceed to prove motion."""

LEAST_MOTION = 0.1
"""m/s; a smaller velocity does not prove motion."""

PRESSURE_SIGMAS = 5.0
"""Standard deviations that a change of pressure must exceed to prove motion."""

STANDING_SPEED = 0.01
"""m/s; wheels stand below this speed: they do not scatter around zero."""

STANDING_YAW_RATE = 0.01
"""rad/s; wheels stand below this yaw rate."""

PRESSURE_LASTS = 30_000_000_000
"""ns; within this time the weather changes the pressure by less than a storey of height does."""

AS_QUIET = 4.0
"""Ratio of the activity (a variance) to that learnt at rest up to which the readings are as quiet as at rest."""

LEARNING = 0.1
"""Weight of a new block in the running mean of the activity at rest."""

FORGETTING = 0.002
"""Weight of a new block with which the lowest activity in motion rises again."""

LOUDEST = 2.0
"""A block counts with at most this many times the activity learnt at rest: the robot may be about to start."""

PLAINLY_LESS_QUIET = 9.0
"""Ratio of the activities (variances) in motion and at rest above which the two cannot be confused."""

UNSEEN_SPEED = 0.3
"""m/s; largest estimated speed at which rest is accepted that no sensor sees and the activity alone does not show."""

UNSEEN_SPEED_STD = 0.2
"""m/s per axis; largest standard deviation of the estimated velocity in the same case."""


@njit
def add_to_block(state, settings):
    """Add the newest IMU sample to the sums of the block; at the end of a block learn from it and begin the next."""
    end = -(-state.stamp // CONSTRAINT_INTERVAL) * CONSTRAINT_INTERVAL
    if state.rest.block_end != end:
        learn_from_block(state, settings)
        state.rest.block_end = end
        state.rest.block_broken = 0
        state.rest.block_count = 0
        state.rest.block_half_count = 0
        for i in range(6):
            state.rest.block_sum[i] = 0.0
            state.rest.block_square_sum[i] = 0.0
    if is_hidden(state, settings):
        state.rest.block_broken = 1
    if state.rest.block_half_count == 0 and 2 * (end - state.stamp) < CONSTRAINT_INTERVAL:
        state.rest.block_half_count = state.rest.block_count
        for i in range(6):
            state.rest.block_half_sum[i] = state.rest.block_sum[i]
    state.rest.block_count += 1
    for i in range(3):
        force, rate = state.specific_force[i], state.angular_rate[i]
        state.rest.block_sum[i] += force
        state.rest.block_square_sum[i] += force * force
        state.rest.block_sum[3 + i] += rate
        state.rest.block_square_sum[3 + i] += rate * rate


@njit
def has_block(state):
    """Say whether the state is at a grid point and has a complete block of readings before it."""
    return state.rest.block_end == state.stamp and is_complete(state)


@njit
def mean_force(state):
    """Return the mean specific force (m/s2, IMU axes, raw) of the block."""
    n, total = state.rest.block_count, state.rest.block_sum
    return (total[0] / n, total[1] / n, total[2] / n)


@njit
def mean_rate(state):
    """Return the mean angular rate (rad/s, IMU axes, raw) of the block."""
    n, total = state.rest.block_count, state.rest.block_sum
    return (total[3] / n, total[4] / n, total[5] / n)


@njit
def unrest(state, settings):
    """Return the activity: the sum of the six variances over their limits at rest; -1 if one is above its limit."""
    total = 0.0
    for i in range(6):
        mean = state.rest.block_sum[i] / state.rest.block_count
        variance = max(state.rest.block_square_sum[i] / state.rest.block_count - mean * mean, 0.0)
        limit = settings.still_accel_std if i < 3 else settings.still_gyro_std
        if variance > limit * limit:
            return -1.0
        total += variance / (limit * limit)
    return total


@njit
def is_steady(state, settings):
    """Say whether the means of both halves of the block agree within noise and swaying: no push, no turn, no hand.

    Vibration averages out over half a block, motion does not. The difference of two mean accelerations comes from three
    velocities, at both ends and in the middle, each of which sways by the standard deviation of the ZUPT.
    """
    half = 0.5e-9 * CONSTRAINT_INTERVAL
    sway = 6.0 * (settings.zupt.velocity_std / half) ** 2
    first, second = state.rest.block_half_count, state.rest.block_count - state.rest.block_half_count
    for i in range(6):
        change = (state.rest.block_sum[i] - state.rest.block_half_sum[i]) / second - state.rest.block_half_sum[
            i
        ] / first
        if i < 3:
            variance = 2.0 * settings.accel_noise_density**2 / half + sway
        else:
            variance = 2.0 * gyro_density(state, settings) ** 2 / half + 4.0 * settings.zupt.rate_std**2
        if change * change > STEADY_SIGMAS**2 * variance:
            return False
    return True


@njit
def is_turning(state):
    """Say whether the mean rate of the block cannot be the gyro bias as it is known: a turn, however slow.

    The noise of the mean is that of these readings, which may be far below the one that the parameters allow.
    """
    earth = rotate_back(to_matrix(state.attitude), state.frame.earth_rate_map)
    rate = mean_rate(state)
    for i in range(3):
        variance = variance_of_mean(state, 3 + i) + LEAST_CHANGE[1] ** 2
        excess = rate[i] - state.gyro_bias[i] - earth[i]
        if excess * excess > CHANGE_SIGMAS**2 * (variance + state.covariance[GYRO_BIAS + i, GYRO_BIAS + i]):
            return True
    return False


@njit
def learn_from_block(state, settings):
    """Learn at the end of a block how quiet seen rest and motion are, and note where the robot became quiet."""
    is_quiet = is_complete(state) and is_steady(state, settings)
    level = unrest(state, settings) if is_quiet else -1.0
    if level < 0.0 or has_changed(state):
        # Starts and stops are felt before they are seen.
        state.rest.resting_stamp = NEVER
        open_motion(state)
    add_to_run(state, level >= 0.0)
    moved = state.rest.moving_stamp > state.rest.block_end - CONSTRAINT_INTERVAL
    rested = state.rest.resting_stamp > state.rest.block_end - CONSTRAINT_INTERVAL
    was_quiet = state.rest.quiet
    state.rest.quiet = 1 if level >= 0.0 and not moved else 0
    if state.rest.quiet != was_quiet:
        state.rest.quiet_pressure_stamp = NEVER
    if level < 0.0:
        return
    if moved and (state.rest.moving_activity == 0.0 or level < state.rest.moving_activity):
        state.rest.moving_activity = level
    elif moved:
        state.rest.moving_activity += FORGETTING * (level - state.rest.moving_activity)
    elif rested and state.rest.resting_activity == 0.0:
        state.rest.resting_activity = level
    elif rested:
        state.rest.resting_activity += LEARNING * (
            min(level, LOUDEST * state.rest.resting_activity) - state.rest.resting_activity
        )


@njit
def is_resting(state, settings):
    """Say whether the robot has been stationary since the last grid point; the state is at a grid point."""
    if not (has_block(state) and is_steady(state, settings)) or (has_sight(state) and has_changed(state)):
        return False
    level = unrest(state, settings)
    if level < 0.0 or state.stamp - max(state.rest.moving_stamp, state.rest.doubt_stamp) <= EVIDENCE_LASTS:
        return False
    if state.stamp - state.rest.resting_stamp <= EVIDENCE_LASTS:
        return True
    if has_sight(state):
        return False
    rest, motion = state.rest.resting_activity, state.rest.moving_activity
    if rest == 0.0 or level > AS_QUIET * rest:
        return False
    if motion > PLAINLY_LESS_QUIET * rest and level < math.sqrt(rest * motion):
        return True
    variance = 0.0
    for i in range(3):
        variance = max(variance, state.covariance[VELOCITY + i, VELOCITY + i])
    return dot(state.velocity_map, state.velocity_map) < UNSEEN_SPEED**2 and variance < UNSEEN_SPEED_STD**2


@njit
def update_rest_evidence(state, aid):
    """Look for rest or motion in a measurement of any sensor, whatever the filter will make of it.

    Returns whether it disproves the last level (`static_window.update_motion`). What comes before the first IMU sample
    says nothing of a robot whose IMU is quiet.
    """
    if state.imu.stamp == NEVER:
        return False
    p = aid.payload
    if aid.stream == Stream.GNSS_POSITION:
        fix = geodetic_to_ecef(p[0], p[1], p[2])
        note_seen(state, aid.stamp, see_fix(state, aid.source, aid.stamp, fix, p[0], p[1], (p[XX], p[YY], p[ZZ])))
    elif aid.stream == Stream.GNSS_VELOCITY:
        velocity = (p[0], p[1], p[2])
        note_seen(state, aid.stamp, see_velocity(state, aid.source, aid.stamp, velocity, (p[XX], p[YY], p[ZZ])))
    elif aid.stream == Stream.HEADING:
        if aid.source == 0 and p[XX] > 0.0:
            seen = see_yaw(state, aid.stamp, p[0], p[XX])
            if seen == Seen.MOTION:
                state.rest.moving_stamp = aid.stamp
            elif seen == Seen.NOTHING:
                state.rest.doubt_stamp = aid.stamp
    elif aid.stream == Stream.BODY_VELOCITY:
        speed, std = math.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2), math.sqrt(max(p[XX], p[YY], p[ZZ]))
        if min(p[XX], p[YY], p[ZZ]) > 0.0:
            velocity = (p[0], p[1], p[2])
            note_seen(state, aid.stamp, see_velocity(state, BODY_EYE, aid.stamp, velocity, (p[XX], p[YY], p[ZZ])))
        elif speed > max(MOTION_SIGMAS * std, LEAST_MOTION):
            state.rest.moving_stamp = aid.stamp
        return update_motion(state, speed - MOTION_SIGMAS * std, aid.stamp, aid.stamp, MEASURED_SPEED)
    elif aid.stream == Stream.WHEEL:
        if abs(p[0]) < STANDING_SPEED and abs(p[1]) < STANDING_YAW_RATE:
            if p[XX] > 0.0:
                state.rest.resting_stamp = aid.stamp
        else:
            state.rest.moving_stamp = aid.stamp
            speed = abs(p[0]) - MOTION_SIGMAS * math.sqrt(max(p[XX], 0.0))
            return update_motion(state, speed, aid.stamp, aid.stamp, MEASURED_SPEED)
    elif aid.stream == Stream.BARO:
        note_pressure(state, aid)
    return False


@njit
def note_seen(state, stamp, seen):
    """Take what a sensor sees (`Seen`) as evidence of motion or of rest."""
    if seen == Seen.MOTION:
        state.rest.moving_stamp = stamp
    elif seen == Seen.REST:
        state.rest.resting_stamp = stamp


@njit
def note_pressure(state, aid):
    """Compare the air pressure (Pa) with that at which the IMU became quiet: up and down is motion, too."""
    if state.rest.quiet == 0 or aid.stamp - state.rest.quiet_pressure_stamp > PRESSURE_LASTS:
        state.rest.quiet_pressure_stamp = aid.stamp
        state.rest.quiet_pressure = aid.payload[0]
    elif abs(aid.payload[0] - state.rest.quiet_pressure) > PRESSURE_SIGMAS * math.sqrt(2.0 * aid.payload[XX]):
        state.rest.moving_stamp = aid.stamp


@njit
def watch_rest(state, verdict):
    """Forget that rest was seen if the gate rejects it: the IMU has felt a start that others cannot see so soon."""
    if verdict == Verdict.GATE:
        state.rest.resting_stamp = NEVER
        open_motion(state)


@njit
def watch_wheels(state, aid):
    """Note when the wheels reported last, and when the gate last rejected them, which means that they slip."""
    state.rest.wheel_stamp = aid.stamp
    if aid.verdict == Verdict.GATE:
        state.rest.slip_stamp = aid.stamp
