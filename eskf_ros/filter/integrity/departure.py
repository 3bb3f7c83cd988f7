"""Departures: by how much the receiver is stamped later than the IMU, as both see a robot set out from rest.

From a rest on, the level IMU knows speed and way without a heading, and the receiver measures them. The same curve over
time, shifted, is that of clocks that are apart: here it is seen seconds after the start, in turns a minute later
(`motion_sums.lag_of`).
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, YY
from eskf_ros.filter.inertial.covariance import ACCELERATION_TIME
from eskf_ros.filter.inertial.navigation_frame import local_up
from eskf_ros.filter.integrity.motion_sums import NOTABLE_LAG
from eskf_ros.filter.state.error_state import ATTITUDE
from eskf_ros.filter.state.time import NEVER
from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.geodesy.rotation import dot, rotate, to_matrix

BIN = 0.2
"""s; interval at which speed and way by the IMU are kept."""

BINS = 60
"""Their number: a departure is watched for 12 s."""

HEARD = 60
"""Messages of the receiver that are kept."""

HEARD_INTERVAL = 0.15
"""s; messages that follow sooner are left out."""

LARGEST_LAG = 3.0
"""s; lags up to here are tried, to both sides."""

LONGEST_TOLD = 2.2
"""s; longer ones are not believed: one near the end of the range may be any, or none that fits. A smooth start from a
creep that passed for rest looks like one of 3 s."""

LAG_STEP = 0.1
"""s; step between the lags that are tried."""

ACCELERATION_STD = 0.15
"""m/s2; standard deviation of a constant error of the acceleration, beside that of the covariance: the level may have
been found while the robot still braked, or had begun to move."""

FEWEST_AT_REST = 10.0
"""Fixes at rest, without which ways have no beginning."""

LEAST_UPRIGHT = 0.5
"""Cosine of the angle of base_link to the vertical, at least: an IMU that is mounted otherwise than is told turns the
other way."""

LEVEL_STD = 0.03
"""rad; of the tilt, up to which the level is known well enough."""

MOST_AT_REST = 50.0
"""Fixes at rest of which the mean is taken, at most."""

SET_OUT = 0.3
"""m; way by the IMU from which on fixes are no longer those of the rest."""

SHOWN = 64.0
"""Sum of squares that a lag must explain: eight standard deviations."""

LEAST_SHIFT = (1.5, 5.0)
"""m/s, m; difference of speed and of way that a lag must make: slow motion, walking, waves and turns look like one."""

LEAST_STD = (0.1, 0.5)
"""m/s, m; of the difference of the curves, however good the receiver is: lags are tried in steps, bodies lean."""

FITS = 4.0
"""Mean square that it may leave for each message in motion."""

MOVED = 3.0
"""Standard deviations that speed or way by the receiver must exceed for a message to be one in motion."""

DEPARTURE = np.dtype(
    [
        ("since", "i8"),
        ("integral", "f8", (2,)),
        ("acceleration", "f8", (2,)),
        ("velocity", "f8", (2,)),
        ("way", "f8", (2,)),
        ("variance", "f8"),
        ("bins", "i8"),
        ("by_imu", "f8", (BINS, 2)),
        ("count", "i8"),
        ("heard", "f8", (HEARD, 3)),
        ("has_speed", "i8"),
        ("rest_fix", "f8", (3,)),
        ("rest_fixes", "f8"),
        ("lag", "f8"),
    ],
    align=True,
)
"""The last departure from rest, by the IMU and by the first receiver.

- ``since``: the rest from which on it is watched (ns).
- ``acceleration``, ``integral``: by the IMU, low-passed (m/s2), and its integral (m/s), along x and y of map, however
  it is turned while the heading is unknown; ``velocity``, ``way``: what follows from them (m/s, m).
- ``variance``: of a constant error of the acceleration (m2/s4).
- ``bins``, ``by_imu``: how many intervals (`BIN`) have passed, speed and way at their ends.
- ``count``, ``heard``: messages of the receiver: time since the rest (s), speed or way (m/s or m) and its variance.
- ``has_speed``: they are speeds.
- ``rest_fix``, ``rest_fixes``: mean of the fixes at rest (m, Earth-centred), and how many.
- ``lag``: by how much the receiver is stamped later (s); 0 where it is less than notable, or not known.
"""


@njit
def begin_departure(state, settings):
    """Begin to watch: the robot is at rest, and level."""
    departure = state.departure
    if departure.since == NEVER or math.hypot(departure.way[0], departure.way[1]) > SET_OUT:
        departure.rest_fixes = 0.0
    tilt_variance = 0.5 * (state.covariance[ATTITUDE, ATTITUDE] + state.covariance[ATTITUDE + 1, ATTITUDE + 1])
    # While a heading that was given is corrected, the axes of map turn below the motion.
    m = settings.imu_to_base
    upright = rotate(to_matrix(state.attitude), (m[2, 0], m[2, 1], m[2, 2]))
    is_fit = tilt_variance < LEVEL_STD**2 and dot(upright, local_up(state)) > LEAST_UPRIGHT
    is_fit = is_fit and (state.heading_known == 0 or state.heading.given_stamp == NEVER)
    departure.since = state.stamp if is_fit else NEVER
    departure.variance = ACCELERATION_STD**2 + tilt_variance * STANDARD_GRAVITY**2
    departure.bins = departure.count = departure.has_speed = 0
    for i in range(2):
        departure.velocity[i] = departure.way[i] = 0.0
        departure.acceleration[i] = state.excitation.acceleration[i]
        departure.integral[i] = -ACCELERATION_TIME * departure.acceleration[i]


@njit
def extend_departure(state):
    """Extend speed and way by the IMU to the newest sample, where another interval has passed.

    The acceleration a is there low-passed with the time T: T da'/dt = a - a', so that its integral is that of a' plus
    the change of T a'.
    """
    departure = state.departure
    if departure.since == NEVER:
        return
    passed = (state.stamp - departure.since) * 1e-9 - departure.bins * BIN
    if passed < BIN:
        return
    is_reset = max(state.recovery.reset_stamp, state.trust.doubt_stamp) > departure.since
    if departure.bins >= BINS or passed > 2.0 * BIN or is_reset:
        # It has been watched for long enough, there is a hole in the data, or the axes of map have turned below it.
        departure.since = NEVER
        return
    for i in range(2):
        now, velocity = state.excitation.acceleration[i], departure.velocity[i]
        departure.integral[i] += 0.5 * BIN * (departure.acceleration[i] + now)
        departure.acceleration[i] = now
        departure.velocity[i] = departure.integral[i] + ACCELERATION_TIME * now
        departure.way[i] += 0.5 * BIN * (velocity + departure.velocity[i])
    departure.by_imu[departure.bins, 0] = math.hypot(departure.velocity[0], departure.velocity[1])
    departure.by_imu[departure.bins, 1] = math.hypot(departure.way[0], departure.way[1])
    departure.bins += 1


@njit
def hear_speed(departure, aid):
    """Add a velocity of the receiver to the departure."""
    if departure.since == NEVER:
        return
    if departure.has_speed == 0:
        departure.has_speed, departure.count = 1, 0
    variance = 0.5 * (aid.payload[XX] + aid.payload[YY])
    add_heard(departure, aid.stamp, math.hypot(aid.payload[0], aid.payload[1]), variance)


@njit
def hear_fix(departure, aid, fix, away):
    """Add a ``fix`` (m, Earth-centred) to the departure, ``away`` (m; east, north) from the place of the rest."""
    if departure.since == NEVER or departure.has_speed == 1:
        return
    if departure.count == 0 and math.hypot(departure.way[0], departure.way[1]) < SET_OUT:
        departure.rest_fixes = min(departure.rest_fixes + 1.0, MOST_AT_REST)
        for i in range(3):
            departure.rest_fix[i] += (fix[i] - departure.rest_fix[i]) / departure.rest_fixes
    elif departure.rest_fixes >= FEWEST_AT_REST:
        variance = 0.5 * (aid.payload[XX] + aid.payload[YY]) * (1.0 + 1.0 / departure.rest_fixes)
        add_heard(departure, aid.stamp, math.hypot(away[0], away[1]), variance)


@njit
def add_heard(departure, stamp, length, variance):
    """Add the ``length`` of a velocity or way (``variance`` per axis), and compare the curves.

    Noise makes a length longer: its square by twice the variance.
    """
    passed, count = (stamp - departure.since) * 1e-9, departure.count
    is_soon = count > 0 and passed < departure.heard[count - 1, 0] + HEARD_INTERVAL
    if passed < 0.0 or is_soon or count >= HEARD:
        return
    departure.heard[count, 0] = passed
    departure.heard[count, 1] = math.sqrt(max(length * length - 2.0 * variance, 0.0))
    departure.heard[count, 2] = variance
    departure.count += 1
    update_lag(departure)


@njit
def update_lag(departure):
    """Find the lag that leaves least of the difference of the two curves unexplained, and whether it is one.

    The receiver may be early as well: then only what was heard `LARGEST_LAG` ago can be compared. A departure that
    fits without a lag, and would not with a notable one, takes back what an earlier one has shown.
    """
    now = departure.bins * BIN
    lag, most, left_most, count_most, shift = 0.0, 0.0, 0.0, 0.0, 0.0
    column = 1 - departure.has_speed
    for side in (1.0, -1.0):
        last = now if side > 0.0 else now - LARGEST_LAG
        none, count = left_with(departure, 0.0, last)
        if none < SHOWN:
            with_notable, _ = left_with(departure, side * NOTABLE_LAG, last)
            if side < 0.0 and none < FITS * count and with_notable - none > SHOWN:
                departure.lag = 0.0
            continue
        for k in range(1, round(LARGEST_LAG / LAG_STEP) + 1):
            left, _ = left_with(departure, side * k * LAG_STEP, last)
            if none - left > most:
                lag, most, left_most, count_most = side * k * LAG_STEP, none - left, left, count
                shift = length_by_imu(departure, last, column)
                shift -= length_by_imu(departure, last - abs(lag), column)
    is_credible = abs(lag) < LONGEST_TOLD and left_most < FITS * count_most
    if is_credible and most > SHOWN and shift > LEAST_SHIFT[column]:
        departure.lag = lag if abs(lag) > NOTABLE_LAG else 0.0


@njit
def left_with(departure, lag, last):
    """Return the sum of squares that a lag (s) leaves of messages up to ``last`` (s), and how many are in motion.

    What a constant error of the acceleration explains, as likely as it is, is taken out (it is marginalised).
    """
    column = 1 - departure.has_speed
    square, product, information, count = 0.0, 0.0, 1.0 / departure.variance, 0.0
    for j in range(departure.count):
        passed, length = departure.heard[j, 0], departure.heard[j, 1]
        variance = max(departure.heard[j, 2], LEAST_STD[column] ** 2)
        if passed > last:
            break
        difference = length - length_by_imu(departure, passed - lag, column)
        effect = passed if column == 0 else 0.5 * passed * passed
        square += difference * difference / variance
        product += difference * effect / variance
        information += effect * effect / variance
        count += 1.0 if length * length > MOVED**2 * variance else 0.0
    return square - product * product / information, count


@njit
def length_by_imu(departure, passed, column):
    """Return speed or way (``column`` 0 or 1) by the IMU at a time (s) since the rest, linear between those kept."""
    place = passed / BIN - 1.0
    if place <= -1.0 or departure.bins == 0:
        return 0.0
    if place >= departure.bins - 1.0:
        return departure.by_imu[departure.bins - 1, column]
    first = math.floor(place)
    before = departure.by_imu[first, column] if first >= 0 else 0.0
    return before + (place - first) * (departure.by_imu[first + 1, column] - before)
