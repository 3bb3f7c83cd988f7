"""Motion monitor: what the receiver says of the motion, compared with the raw readings of the IMU, without the filter.

A filter that is led by wrong axes is wrong itself, and so is what its innovations blame. The receiver alone measures
course and accelerations, the IMU alone turns and specific force; both over windows of a second or two. So axes that are
negated or swapped, a mounting that is turned, and a gyro with a wrong scale show, whatever the filter believes; and so
does a receiver that contradicts itself: velocities in other axes than positions, fixes that jump, stamps that run ahead
of the motion. `motion_report` draws the conclusions.

Over 400 lines: one record, whose windows begin and end together, and a third of the lines says what its fields are.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, YY
from eskf_ros.filter.integrity.departure import hear_fix, hear_speed
from eskf_ros.filter.integrity.motion_sums import (
    FEWEST_TURNS,
    MANY_TURNS,
    MEMORY,
    PUSHES,
    SLOW,
    TURNS,
    add_push,
    add_turn,
    has_turned,
)
from eskf_ros.filter.integrity.refusal import rival_offset
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.geodesy.earth import east_north_up_to_ecef, geodetic_to_ecef
from eskf_ros.geodesy.rotation import cross, rotate, rotate_back

MOTION = np.dtype(
    [
        ("turned", "f8", (3,)),
        ("pushed", "f8", (3,)),
        ("longest_interval", "f8"),
        ("fix_stamp", "i8"),
        ("fix", "f8", (3,)),
        ("heard_stamp", "i8"),
        ("velocity_stamp", "i8"),
        ("velocity", "f8", (2,)),
        ("way", "f8", (2,)),
        ("jumps", "i8"),
        ("jump", "f8"),
        ("offset", "f8", (2,)),
        ("offset_stamp", "i8"),
        ("start_stamp", "i8"),
        ("start_fix", "f8", (3,)),
        ("start_way", "f8", (2,)),
        ("axes", "f8", (3,)),
        ("has_other_axes", "i8"),
        ("last_stamp", "i8"),
        ("last_velocity", "f8", (2,)),
        ("last_turned", "f8", (3,)),
        ("last_pushed", "f8", (3,)),
        ("turns", TURNS),
        ("pushes", PUSHES),
        ("pause", "f8"),
        ("pause_stamp", "i8"),
        ("pause_change", "f8", (2,)),
        ("pause_velocity", "f8", (2,)),
        ("pause_fix", "f8", (3,)),
        ("clock_steps", "i8"),
        ("clock_step", "f8"),
        ("clock_stamp", "i8"),
    ],
    align=True,
)
"""The motion by the first receiver and by the IMU. Velocities, ways and changes are local, east and north.

- ``turned``, ``pushed``: integral of rates (rad) and specific force (m/s) since the window began, IMU axes;
  ``longest_interval``: between two samples since the last fix (s).
- ``fix_stamp``, ``fix``: the last fix (ns; m, Earth-centred). ``heard_stamp``: when the last velocity came (ns).
  ``velocity``, ``velocity_stamp``: that velocity (m/s), and up to when its integral ``way`` (m) since the last fix is.
- ``jumps``, ``jump``: how often fixes jumped, and the furthest (m). ``offset``, ``offset_stamp``: the sum of the jumps
  (m), which fades with `OFFSET_TIME`, up to the last of them (ns): fixes that have jumped back are where they were.
- ``start_stamp``, ``start_fix``, ``start_way``: a window of positions, and the integral of the velocities over it.
- ``axes``: sums of the squares (m2) by which velocities differ from the changes of positions, as they are and with east
  and north exchanged, and the number of windows in motion. ``has_other_axes``: they are exchanged.
- ``last_*``: velocity at the end of the window before (positions alone: in its middle), and the integrals over it.
  Where velocities come, windows begin and end with them.
- ``turns``, ``pushes``: the comparisons.
- ``pause*``: a pause (s) of fixes and IMU that may be a clock that was set forward, when it ended, the change of the
  fixes over it, the velocity before, and the fix after it. ``clock_*``: those that were: how many, size (s) and stamp
  (ns) of the last one.
"""

WINDOW = 1.0
"""s; length of a window where velocities come."""

LONG_WINDOW = 2.0
"""s; length of a window of positions alone."""

LONGEST_WINDOW = 3.5
"""s; a window that an outage has made longer is not judged."""

LONGEST_HOLE = 0.5
"""s; a window in which no sample of the IMU comes for longer is not judged."""

RECENT = SECOND
"""ns; velocities count as coming if one has come for so short a time before the last fix, or later."""

JUMP_SIGMAS = 5.5
"""Standard deviations per axis of the difference of two fixes by which it must be off for a jump."""

LEAST_JUMP = 3.0
"""m; smaller steps of fixes are no jumps."""

OFFSET_TIME = 60.0
"""s; time in which it is forgotten that fixes have jumped. Reflections last for as long."""

STRONGEST = 6.0
"""m/s2; acceleration that positions alone cannot tell from a jump."""

LEAST_PAUSE = 0.3
"""s; a clock that was set forward by less is not looked for."""

PAUSE_SIGMAS = 4.0
"""Standard deviations of the difference of two fixes by which the way during a pause must be too short."""

FEWEST_WAYS = 1
"""Windows in motion after which the ways by positions and by velocities are compared."""

LEAST_WAY = 5.0
"""m; in a window in which the robot has moved less the ways are those of noise."""

OTHER_WAY = 20.0
"""m2; mean square of their difference from which on the axes of the velocities are asked for."""

BETTER = 5.0
"""Ratio of the squares by which exchanged axes must fit better."""

SAME_VELOCITY = 0.3
"""Share by which the velocity may have changed over a pause that was none."""


@njit
def add_sample(state):
    """Add the newest IMU reading to the integrals of the window, unless an axis does not measure (`sample_doubt`)."""
    motion, interval = state.motion, state.imu.interval
    motion.longest_interval = max(motion.longest_interval, interval)
    if interval > LONGEST_HOLE or state.quality.is_doubted == 1:
        forget_window(motion)
        return
    for i in range(3):
        motion.turned[i] += interval * state.imu.rate[i]
        motion.pushed[i] += interval * state.imu.force[i]


@njit
def forget_window(motion):
    """Begin anew with the next fix: the window has a hole, or readings that do not measure."""
    motion.start_stamp = NEVER
    motion.last_stamp = NEVER


@njit
def watch_motion(state, aid, settings):
    """Compare a position or velocity of the first receiver with those before it and with the IMU.

    Returns whether it shows that the velocities so far have had other axes than the positions.
    """
    if aid.source != 0:
        return False
    if (aid.stamp - state.imu.stamp) * 1e-9 > LONGEST_HOLE:
        forget_window(state.motion)
    knew = state.motion.has_other_axes == 1
    if aid.stream == Stream.GNSS_VELOCITY:
        watch_velocity(state, aid, settings)
    elif aid.stream == Stream.GNSS_POSITION:
        watch_position(state, aid, settings)
    return state.motion.has_other_axes == 1 and not knew


@njit
def watch_velocity(state, aid, settings):
    """Add a velocity to the way; compare it with the IMU a window after the one before."""
    motion = state.motion
    hear_speed(state.departure, aid)
    extend_way(motion, aid.stamp)
    since = (aid.stamp - motion.heard_stamp) * 1e-9 if motion.heard_stamp != NEVER else math.inf
    if since <= WINDOW:
        # The last velocity was held up to here; the trapezoidal rule is not late.
        for i in range(2):
            motion.way[i] += 0.5 * since * (aid.payload[i] - motion.velocity[i])
    motion.heard_stamp = motion.velocity_stamp = aid.stamp
    motion.velocity[0], motion.velocity[1] = aid.payload[0], aid.payload[1]
    passed = (aid.stamp - motion.last_stamp) * 1e-9 if motion.last_stamp != NEVER else math.inf
    if passed < WINDOW - 0.01:
        return
    velocity = velocity_of_imu(state, settings)
    if passed <= LONGEST_WINDOW:
        turn, push = integrals(motion, settings)
        compare(motion, velocity, 0.5 * (aid.payload[XX] + aid.payload[YY]), turn, push, passed)
    end_window(motion, aid.stamp, velocity)


@njit
def extend_way(motion, stamp):
    """Extend the way since the last fix with the last velocity up to a stamp (ns)."""
    dt = (stamp - motion.velocity_stamp) * 1e-9
    if motion.velocity_stamp == NEVER or dt <= 0.0:
        return
    motion.velocity_stamp = stamp
    for i in range(2):
        motion.way[i] += dt * motion.velocity[i]


@njit
def watch_position(state, aid, settings):
    """Judge a fix by the one before, and close the window if it is long enough."""
    motion = state.motion
    has_velocity = motion.heard_stamp != NEVER and motion.heard_stamp > motion.fix_stamp - RECENT
    fix = geodetic_to_ecef(aid.payload[0], aid.payload[1], aid.payload[2])
    axes = east_north_up_to_ecef(aid.payload[0], aid.payload[1])
    if has_velocity:
        extend_way(motion, aid.stamp)
    else:
        hear_fix(state.departure, aid, fix, change_between(state.departure.rest_fix, fix, axes))
    if motion.fix_stamp != NEVER:
        # A fix may come within a pause of the IMU, of which no sample has told yet.
        motion.longest_interval = max(motion.longest_interval, (aid.stamp - state.imu.stamp) * 1e-9)
        watch_step(motion, aid, fix, axes, has_velocity)
    watch_pause(motion, aid, fix, axes, has_velocity)
    passed = (aid.stamp - motion.start_stamp) * 1e-9 if motion.start_stamp != NEVER else math.inf
    if passed >= LONG_WINDOW - 0.01:
        if passed <= LONGEST_WINDOW:
            change = change_between(motion.start_fix, fix, axes)
            if has_velocity:
                compare_axes(motion, change)
            else:
                close_window(motion, aid, change, passed, settings)
        elif not has_velocity:
            motion.last_stamp = NEVER
        motion.start_stamp = aid.stamp
        motion.start_way[0], motion.start_way[1] = 0.0, 0.0
        for i in range(3):
            motion.start_fix[i] = fix[i]
            if not has_velocity:
                motion.turned[i] = motion.pushed[i] = 0.0
    motion.fix_stamp = aid.stamp
    motion.longest_interval = 0.0
    motion.way[0], motion.way[1] = 0.0, 0.0
    for i in range(3):
        motion.fix[i] = fix[i]


@njit
def change_between(before, fix, axes):
    """Return the change (m; east, north) from one Earth-centred position to another."""
    change = rotate_back(axes, (fix[0] - before[0], fix[1] - before[1], fix[2] - before[2]))
    return change[0], change[1]


@njit
def watch_step(motion, aid, fix, axes, has_velocity):
    """Look whether a fix has jumped from the one before, or comes after a pause that the IMU has made, too.

    Positions alone: the velocity is that of the window before.
    """
    passed = (aid.stamp - motion.fix_stamp) * 1e-9
    change = change_between(motion.fix, fix, axes)
    way = (motion.way[0], motion.way[1])
    before = (motion.velocity[0], motion.velocity[1])
    if not has_velocity:
        if motion.last_stamp == NEVER:
            return
        before = (motion.last_velocity[0], motion.last_velocity[1])
        way = (passed * before[0], passed * before[1])
    motion.start_way[0] += way[0]
    motion.start_way[1] += way[1]
    if motion.longest_interval > LEAST_PAUSE and passed > LEAST_PAUSE:
        motion.pause, motion.pause_stamp = passed, aid.stamp
        motion.pause_change[0], motion.pause_change[1] = change
        motion.pause_velocity[0], motion.pause_velocity[1] = before
        for i in range(3):
            motion.pause_fix[i] = fix[i]
        forget_window(motion)
        return
    slack = 0.0 if has_velocity else STRONGEST * passed * (LONG_WINDOW + passed)
    variance = aid.payload[XX] + aid.payload[YY]
    off = math.hypot(change[0] - way[0], change[1] - way[1])
    if passed < LONGEST_WINDOW and off > max(LEAST_JUMP + slack, JUMP_SIGMAS * math.sqrt(variance)):
        motion.jumps += 1
        motion.jump = max(motion.jump, off)
        fades = math.exp(-(aid.stamp - motion.offset_stamp) * 1e-9 / OFFSET_TIME) if motion.jumps > 1 else 0.0
        motion.offset[0] = fades * motion.offset[0] + change[0] - way[0]
        motion.offset[1] = fades * motion.offset[1] + change[1] - way[1]
        motion.offset_stamp = aid.stamp
        forget_window(motion)


@njit
def offset_by_jumps(state):
    """Return by how much (m; x and y of map) the estimate may be off since the fixes jumped.

    The fixes may be off by the sum of their jumps: one may have been to the truth; that is not known, and fades. The
    estimate is off by as much, less by how far refused fixes are away. Once these have agreed for long enough, they may
    be right (`rival_offset`).
    """
    motion = state.motion
    east, north = rival_offset(state)
    passed = (state.stamp - motion.offset_stamp) * 1e-9
    if east != 0.0 or north != 0.0 or motion.jumps == 0 or passed > 4.0 * OFFSET_TIME:
        return east, north
    fades = math.exp(-passed / OFFSET_TIME)
    east, north = fades * motion.offset[0], fades * motion.offset[1]
    if state.trust.refused[0, 0] > 0:
        east -= state.trust.refused_innovation[0, 0, 0]
        north -= state.trust.refused_innovation[0, 0, 1]
    return (east, north) if math.hypot(east, north) > LEAST_JUMP else (0.0, 0.0)


@njit
def lag_of_receiver(state):
    """Return by how much (s) the receiver is stamped later than the IMU; 0 where it is not notable, or not known.

    Turns tell, once there are enough, and departures from rest before.
    """
    turns = state.motion.turns
    fewest = FEWEST_TURNS if state.motion.heard_stamp != NEVER else MANY_TURNS
    return turns.lag if has_turned(turns, fewest) or turns.lag != 0.0 else state.departure.lag


@njit
def watch_pause(motion, aid, fix, axes, has_velocity):
    """Decide a window after a pause whether the robot had stopped moving, or only the stamps have moved on.

    A robot that is as fast after the pause as before, and has not covered the way, has not been under way for so long.
    """
    passed = (aid.stamp - motion.pause_stamp) * 1e-9 if motion.pause_stamp != NEVER else 0.0
    if passed < WINDOW - 0.01:
        return
    motion.pause_stamp = NEVER
    before = (motion.pause_velocity[0], motion.pause_velocity[1])
    after = (motion.velocity[0], motion.velocity[1])
    if not has_velocity:
        change = change_between(motion.pause_fix, fix, axes)
        after = (change[0] / passed, change[1] / passed)
    speed = math.hypot(before[0], before[1])
    if speed < SLOW or math.hypot(after[0] - before[0], after[1] - before[1]) > max(1.5, SAME_VELOCITY * speed):
        return
    along = (motion.pause_change[0] * before[0] + motion.pause_change[1] * before[1]) / speed
    lacking = motion.pause * speed - along
    step = lacking / speed
    std = math.sqrt(aid.payload[XX] + aid.payload[YY])
    if lacking > PAUSE_SIGMAS * std and step > LEAST_PAUSE and step > 0.5 * motion.pause:
        motion.clock_steps += 1
        motion.clock_step = step
        motion.clock_stamp = aid.stamp


@njit
def close_window(motion, aid, change, passed, settings):
    """Compare a window of positions alone with the IMU: its velocity (``change`` over ``passed`` s) is in its middle.

    Between two middles lie half of this window and of the last one.
    """
    velocity = (change[0] / passed, change[1] / passed)
    turned, pushed = integrals(motion, settings)
    if motion.last_stamp != NEVER:
        turn, push = middle(turned, motion.last_turned), middle(pushed, motion.last_pushed)
        compare(motion, velocity, (aid.payload[XX] + aid.payload[YY]) / (passed * passed), turn, push, passed)
    end_window(motion, aid.stamp, velocity)
    for i in range(3):
        motion.last_turned[i] = turned[i]
        motion.last_pushed[i] = pushed[i]


@njit
def middle(a, b):
    """Return the mean of two vectors."""
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])


@njit
def integrals(motion, settings):
    """Return the integrals of rates (rad) and specific force (m/s) over the window, in the axes of base_link."""
    turned, pushed = motion.turned, motion.pushed
    return (
        rotate(settings.imu_to_base, (turned[0], turned[1], turned[2])),
        rotate(settings.imu_to_base, (pushed[0], pushed[1], pushed[2])),
    )


@njit
def end_window(motion, stamp, velocity):
    """Keep the velocity that ends a window, and begin the next one."""
    motion.last_stamp = stamp
    motion.last_velocity[0], motion.last_velocity[1] = velocity
    for i in range(3):
        motion.turned[i] = motion.pushed[i] = 0.0


@njit
def compare(motion, velocity, variance, turn, push, passed):
    """Compare the change of velocity (m/s, ``variance`` per axis) over ``passed`` s with the integrals of the IMU."""
    before = (motion.last_velocity[0], motion.last_velocity[1])
    slowest = min(math.hypot(before[0], before[1]), math.hypot(velocity[0], velocity[1]))
    if slowest > max(SLOW, 5.0 * math.sqrt(variance)):
        add_turn(motion.turns, before, velocity, turn, 2.0 * variance / (slowest * slowest), motion.last_stamp, passed)
        add_push(motion.pushes, before, velocity, push, passed)


@njit
def velocity_of_imu(state, settings):
    """Return the last velocity (m/s; east, north) without what the turn adds at the antenna.

    For the direction of the lever arm the course is good enough.
    """
    east, north = state.motion.velocity[0], state.motion.velocity[1]
    speed = max(math.hypot(east, north), SLOW)
    smooth, arm = state.imu.smooth_rate, settings.lever_arms_body[0]
    added = rotate(settings.imu_to_base, cross((smooth[0], smooth[1], smooth[2]), (arm[0], arm[1], arm[2])))
    return (
        east - (added[0] * east - added[1] * north) / speed,
        north - (added[0] * north + added[1] * east) / speed,
    )


@njit
def compare_axes(motion, change):
    """Add how far the way by the velocities is from that by the positions, as it is and with its axes exchanged."""
    way = motion.start_way
    if max(math.hypot(way[0], way[1]), math.hypot(change[0], change[1])) < LEAST_WAY:
        return
    for i in range(3):
        motion.axes[i] *= 1.0 - 1.0 / MEMORY
    motion.axes[0] += (change[0] - way[0]) ** 2 + (change[1] - way[1]) ** 2
    motion.axes[1] += (change[0] - way[1]) ** 2 + (change[1] - way[0]) ** 2
    motion.axes[2] += 1.0
    own, exchanged, ways = motion.axes[0], motion.axes[1], motion.axes[2]
    is_other = ways > FEWEST_WAYS and own > OTHER_WAY * ways and own > BETTER * exchanged
    motion.has_other_axes = 1 if is_other else 0
