"""Heading monitor: lasting differences of heading sensors, course and magnetic field from the estimate.

Faults are judged over many messages and never by a single one. `complaints` puts them into sentences, together with
those of the IMU (`imu_monitor`) and of velocities that are rejected for long.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, YY
from eskf_ros.filter.integrity.scatter import has_calm_errors
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, GYRO_BIAS, VELOCITY
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.geodesy.rotation import dot, wrapped

HEADING_MONITOR = np.dtype(
    [
        ("sensor_contrast", "f8", (2, 3)),
        ("course_contrast", "f8", (3,)),
        ("slip", "f8", (4,)),
        ("slip_stamp", "i8"),
        ("field_found", "f8", (2,)),
        ("disturbed_fields", "f8"),
        ("field_count", "f8"),
        ("given_stamp", "i8"),
        ("given_std", "f8"),
        ("given_off", "f8"),
        ("given_wrong", "f8"),
        ("given_bias_std", "f8"),
        ("given_moved", "i8"),
        ("explained", "i8", (2,)),
    ],
    align=True,
)
"""Differences of headings from the estimate, and disturbed fields; sums and counts forget exponentially (`MEMORY`).

``sensor_contrast``: sums of the cosine and the sine of the difference, and their number, for the dual antenna (0) and
the magnetometer (1); ``course_contrast``: the same for the course over ground. ``slip``, ``slip_stamp``: of the
direction of travel to x of base_link, by the estimate, the sums of the weights (1/rad2), of the weighed angles (1/rad)
and of their weighed squares, how many there were, and the last one (ns). ``field_found``: strength (T) and
inclination (rad) of the field last measured; ``disturbed_fields``, ``field_count``: disturbed readings, and all.

``given_stamp``, ``given_std``: when the heading was given that is watched (ns), and its standard deviation (rad).
``given_off``: by how much measurements have turned it since (rad); ``given_wrong``: from how much on it was wrong, and
has not only drifted with the bias of the gyro (rad), whose standard deviation was at the least ``given_bias_std``
(rad/s). ``given_moved``: when the robot first moved with it (ns). ``explained``: the takeovers of the humble lane and
the departures of the first receiver meanwhile.
"""


MEMORY = 0.99
"""Share of a sum that remains after each message: about 100 messages are remembered."""

LASTING_COUNT = 40.0
"""Messages from which on a difference is lasting, and rejections in a row that are worth a warning."""

ALIKE = 0.9
"""Mean resultant length (1: all equal) from which on angles agree, and share of disturbed fields that is reported."""

FAR_OFF_DEG = 30.0
"""deg; smaller mean differences of headings are not reported."""

FIRST_MOTION = 180 * SECOND
"""ns; of motion, within which a heading that was given and is wrong is corrected."""

SLIP_INTERVAL = SECOND
"""ns; the direction of travel is asked for so often."""

SLIP_TIME = 10.0
"""s; time for which an error of the direction of travel by the estimate lasts, so that ten of them are one."""

SLIP_MEMORY = 300.0
"""Directions of travel that are remembered, about."""

SLIP_SPEED, SLIP_RATE = 3.0, 0.05
"""m/s and rad/s; slower, or in a sharper turn, the direction of travel is not asked for."""

SLIP_STD = math.radians(1.0)
"""rad; by which a vehicle travels beside its axis for a while: camber, wind, tyres."""

FEWEST_SLIPS = 30
"""Directions of travel from which on they are judged."""

LARGEST_SPREAD = math.radians(5.0)
"""rad; standard deviation of the directions of travel of a robot that is made to travel in one."""

WRONG_SIGMAS, LEAST_WRONG = 4.0, math.radians(15.0)
"""Standard deviations and rad by which a heading that was given must have been corrected to be called wrong."""


@njit
def note_contrast(sums, angle):
    """Add an angle (rad) to sums of cosine, sine and count, which forget exponentially."""
    sums[0] = MEMORY * sums[0] + math.cos(angle)
    sums[1] = MEMORY * sums[1] + math.sin(angle)
    sums[2] = MEMORY * sums[2] + 1.0


@njit
def watch_heading(state, aid, work):
    """Compare a heading of the dual antenna or the magnetometer, described by ``work``, with the estimate."""
    if aid.source == 0 and state.heading_known == 1 and aid.payload[XX] > 0.0:
        kind = 1 if aid.stream == Stream.MAG else 0
        note_contrast(state.heading_monitor.sensor_contrast[kind], work.innovation[0])


@njit
def watch_field(state, is_disturbed):
    """Count the readings of the magnetometer, and those that cannot be the Earth's field (both counts forget)."""
    state.heading_monitor.field_count = MEMORY * state.heading_monitor.field_count + 1.0
    state.heading_monitor.disturbed_fields = MEMORY * state.heading_monitor.disturbed_fields + (
        1.0 if is_disturbed else 0.0
    )


@njit
def watch_course(state, aid, heading, settings):
    """Compare the course of a GNSS velocity with the heading (rad) of a vehicle that travels along its x axis."""
    east, north = aid.payload[0], aid.payload[1]
    std = math.sqrt(max(aid.payload[XX], aid.payload[YY]))
    fast = math.hypot(east, north) > max(settings.course_min_speed, 10.0 * std)
    if settings.use_course == 1 and state.heading_known == 1 and fast:
        note_contrast(state.heading_monitor.course_contrast, wrapped(math.atan2(north, east) - heading))


@njit
def watch_slip(state, heading):
    """Add the direction in which the estimate travels to its ``heading`` (rad), at a fix, straight ahead."""
    monitor = state.heading_monitor
    if state.heading_known == 0 or state.stamp - monitor.slip_stamp < SLIP_INTERVAL:
        return
    east, north, covariance = state.velocity_map[0], state.velocity_map[1], state.covariance
    speed, rate, bias = math.hypot(east, north), state.imu.smooth_rate, state.gyro_bias
    turn = (rate[0] - bias[0], rate[1] - bias[1], rate[2] - bias[2])
    if speed < SLIP_SPEED or dot(turn, turn) > SLIP_RATE**2:
        return
    monitor.slip_stamp = state.stamp
    across = max(covariance[VELOCITY, VELOCITY], covariance[VELOCITY + 1, VELOCITY + 1]) / speed**2
    weight = 1.0 / (SLIP_TIME * (across + covariance[ATTITUDE + 2, ATTITUDE + 2] + SLIP_STD**2))
    remains = 1.0 - 1.0 / SLIP_MEMORY
    slip = wrapped(math.atan2(north, east) - heading)
    monitor.slip[0] = remains * monitor.slip[0] + weight
    monitor.slip[1] = remains * monitor.slip[1] + weight * slip
    monitor.slip[2] = remains * monitor.slip[2] + weight * slip * slip
    monitor.slip[3] += 1.0


@njit
def watch_given_heading(state, given_before, turned):
    """Add up by how much measurements turn a heading that was given, ``turned`` (rad) by the present one.

    ``given_before`` (ns): when it was given, as the state had it before this measurement. A heading that is wrong is
    corrected at once or bit by bit, and what receivers and lanes contradicted meanwhile says nothing else.
    """
    monitor = state.heading_monitor
    if given_before not in (NEVER, monitor.given_stamp):
        monitor.given_std = math.sqrt(state.covariance[ATTITUDE + 2, ATTITUDE + 2])
        monitor.given_off = 0.0
        monitor.given_wrong = wrong_by(monitor.given_std)
        monitor.given_bias_std = math.inf
        monitor.given_moved = NEVER
        monitor.given_stamp = given_before
    if monitor.given_stamp == NEVER:
        return
    bias_variance = 0.0
    for i in range(GYRO_BIAS, GYRO_BIAS + 3):
        bias_variance = max(bias_variance, state.covariance[i, i])
    # A takeover opens the biases, which have not been as uncertain all the time.
    monitor.given_bias_std = min(monitor.given_bias_std, math.sqrt(bias_variance))
    drift = monitor.given_bias_std * (state.stamp - monitor.given_stamp) * 1e-9
    monitor.given_wrong = max(monitor.given_wrong, wrong_by(math.hypot(monitor.given_std, drift)))
    if state.heading.given_stamp > monitor.given_stamp:
        # The course over ground has replaced it.
        monitor.given_stamp = state.heading.given_stamp
    if monitor.given_moved == NEVER:
        if state.window.motion_stamp > monitor.given_stamp:
            monitor.given_moved = state.stamp
    elif state.stamp - monitor.given_moved > FIRST_MOTION:
        return
    monitor.given_off += turned
    monitor.explained[0] = state.trust.takeovers
    monitor.explained[1] = state.receiver.departures[0]
    if abs(monitor.given_off) > monitor.given_wrong:
        state.installation.information.fill(0.0)
        state.installation.evidence.fill(0.0)
        state.installation.misfit.fill(0.0)


@njit
def wrong_by(std):
    """Return by how much (rad) a heading that is known to a standard deviation (rad) must be corrected to be wrong."""
    return max(WRONG_SIGMAS * std, LEAST_WRONG)


@njit
def has_lasting_difference(sums):
    """Say whether the angles of such sums are many, alike and far from zero."""
    cosine, sine, count = sums[0], sums[1], sums[2]
    if count < LASTING_COUNT or math.hypot(cosine, sine) < ALIKE * count:
        return False
    return abs(math.degrees(math.atan2(sine, cosine))) > FAR_OFF_DEG


def _lasting_difference(sums: np.ndarray) -> float | None:
    """Return the mean angle (deg) of such sums, or None unless the angles are many, alike and far from zero."""
    return math.degrees(math.atan2(sums[1], sums[0])) if has_lasting_difference(sums) else None


def is_heading_contradicted(state: np.void) -> bool:
    """Say whether the dual antenna or the magnetometer has a lasting difference from the estimated heading."""
    return any(has_lasting_difference(sums) for sums in state["heading_monitor"]["sensor_contrast"])


def slip_of(state: np.void) -> tuple[float, float] | None:
    """Return the direction of travel to x of base_link by the estimate, and its standard deviation (rad).

    None where it is not known, or changes: not every robot is made to travel in one direction.
    """
    weight, total, square, count = (float(value) for value in state["heading_monitor"]["slip"])
    # Errors of fixes that last turn the velocity of the estimate, and its heading.
    if count < FEWEST_SLIPS or not state["heading_known"] or has_calm_errors(state, 0):
        return None
    mean = total / weight
    if square / weight - mean * mean > LARGEST_SPREAD**2:
        return None
    # The error of the heading is the same all the time.
    return mean, math.sqrt(1.0 / weight + float(state["covariance"][ATTITUDE + 2, ATTITUDE + 2]))


def given_heading_complaints(state: np.void) -> list[str]:
    """Return a sentence if the heading that was given was wrong."""
    monitor = state["heading_monitor"]
    off, std = abs(float(monitor["given_off"])), math.sqrt(float(state["covariance"][ATTITUDE + 2, ATTITUDE + 2]))
    is_known = state["heading_known"] and WRONG_SIGMAS * std < off
    if monitor["given_stamp"] == NEVER or off < monitor["given_wrong"] or not is_known:
        return []
    return [
        "the heading that was given (alignment.initial_heading_deg, warm start, initialpose) was off by "
        f"{math.degrees(off):.0f} deg, and has been corrected"
    ]


def heading_complaints(state: np.void) -> list[str]:
    """Return one sentence for each fault of headings, course and magnetic field."""
    found = []
    if state["heading_monitor"]["disturbed_fields"] > max(
        LASTING_COUNT, ALIKE * float(state["heading_monitor"]["field_count"])
    ):
        strength, inclination = (float(value) for value in state["heading_monitor"]["field_found"])
        found.append(
            f"the magnetic field is {strength * 1e6:.0f} uT and dips by {math.degrees(inclination):.0f} deg, that of "
            f"the Earth is {float(state['mag']['strength']) * 1e6:.0f} uT and dips by "
            f"{math.degrees(state['mag']['inclination']):.0f} deg: does mag.mount_rpy_deg match its axes (a driver may "
            "give north-east-down), is it in T, and is it calibrated?"
        )
    if state["heading"]["disputed"] and not state["heading_known"]:
        found.append(
            "the dual antenna and the heading that was given (alignment.initial_heading_deg, warm start, initialpose) "
            "contradict each other: which one is right is known when the robot speeds up or turns"
        )
    dual_antenna, magnetometer = state["heading_monitor"]["sensor_contrast"]
    given = ""
    if state["heading"]["given_stamp"] != NEVER:
        given = " Or is the heading wrong that was given (alignment.initial_heading_deg, warm start, initialpose)?"
    difference = _lasting_difference(magnetometer)
    if difference is not None:
        found.append(
            f"the headings of the magnetometer differ from the estimate by {difference:.0f} deg: does "
            "mag.mount_rpy_deg match its axes (a driver may give north-east-down), and is it calibrated?" + given
        )
    difference = _lasting_difference(dual_antenna)
    if difference is not None:
        found.append(
            f"the headings of the dual antenna differ from the estimate by {difference:.0f} deg: are the antennas "
            "swapped, does heading.mount_rpy_deg match the baseline, and is yaw 0 = east, counter-clockwise?" + given
        )
    difference = _lasting_difference(state["heading_monitor"]["course_contrast"])
    if difference is not None and dual_antenna[2] > 0.0:
        found.append(
            f"the vehicle travels at {difference:.0f} deg to the heading of the dual antenna: are the antennas "
            "swapped, does heading.mount_rpy_deg match the baseline, and is yaw 0 = east, counter-clockwise? "
            "(If it is made to move like this: alignment.use_course false.)"
        )
    return found
