"""Findings on IMU and receiver together: axes, units and clocks, by turns and accelerations that both have seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.doctor.gnss import LAG_SIGMAS, NOTABLE_LAG, lag_of_positions
from eskf_ros.doctor.imu import Seconds, rotation_imu_to_base, up_in_imu
from eskf_ros.doctor.sensors import Array, Recording, Sensor
from eskf_ros.doctor.track import LONGEST_STEP, Track, interpolated, seconds_from

HALF = 0.5
"""s; turns and accelerations are means over twice as long."""

SLOW = 2.0
"""m/s; at less the course is not judged."""

TURNING = 0.05
"""rad/s; the course turns by more where turns are compared."""

FEWEST_TURNING = 10.0
"""s of turns, or of accelerations, at least, for a comparison."""

LARGEST_LAG = 3.0
"""s; clocks are compared up to this."""

CLOCK_LAG = 0.2
"""s; a time between receiver and IMU from which on it is told."""

WELL_EXPLAINED = 0.7
"""Correlation from which on the turns of course and gyro are the same ones."""

ACCELERATING = 0.3
"""m/s2; by more the robot speeds up, brakes or is in a bend."""

NOTABLE_YAW, YAW_SIGMAS = math.radians(3.0), 4.0
"""rad and standard deviations of a mounting yaw from which on it is told."""

LEVEL_SHARE = 0.5
"""Rates about horizontal axes as a share of the turns, at most; what banks, as aircraft do, is not judged."""

EXPLAINED_FORCE = 0.5
"""Share of the accelerations that may be missed where axes are judged by them."""

DEGREES = math.degrees(1.0)
"""What a gyro in deg/s reads for 1 rad/s."""


@dataclass(frozen=True)
class Course:
    """Means over a second by the receiver.

    ``time`` (n,) s, ``speed`` m/s, ``turn`` rad/s counter-clockwise, and ``along``, ``left``: acceleration (m/s2) along
    the course and to its left.
    """

    time: Array
    speed: Array
    turn: Array
    along: Array
    left: Array


def course_of(track: Track) -> Course | None:
    """Return the course where the robot is not slow; None without enough of it."""
    time, velocity = track.speeds()
    if len(time) < 50:
        return None
    grid = np.arange(time[0] + HALF, time[-1] - HALF, 0.1)
    after, before = interpolated(grid + HALF, time, velocity), interpolated(grid - HALF, time, velocity)
    middle = interpolated(grid, time, velocity)
    speed = np.hypot(*middle.T)
    place = np.searchsorted(time, grid).clip(1, len(time) - 1)
    known = (time[place] - time[place - 1] < LONGEST_STEP) & (speed > SLOW)
    known &= (np.hypot(*after.T) > SLOW) & (np.hypot(*before.T) > SLOW)
    if known.sum() < 50:
        return None
    angle = np.arctan2(after[:, 1], after[:, 0]) - np.arctan2(before[:, 1], before[:, 0])
    turn = (angle + math.pi) % (2.0 * math.pi) - math.pi
    acceleration = (after - before) / (2.0 * HALF)
    forward = middle / np.maximum(speed, 1e-9)[:, None]
    along = np.sum(acceleration * forward, axis=1)
    left = acceleration[:, 1] * forward[:, 0] - acceleration[:, 0] * forward[:, 1]
    return Course(*(column[known] for column in (grid, speed, turn / (2.0 * HALF), along, left)))


class Means:
    """Means of the readings of an IMU over the second around any time."""

    def __init__(self, samples: Sensor, origin: int) -> None:
        """Take samples by stamp."""
        self._time = seconds_from(samples.stamp, origin)
        steps = np.diff(self._time)
        middle = 0.5 * (samples.values[1:] + samples.values[:-1])
        self._total = np.concatenate([np.zeros((1, 6)), np.cumsum(middle * steps[:, None], axis=0)])

    def at(self, time: Array) -> Array:
        """Return the means (n, 6) around times (n,) s."""
        last, first = (interpolated(time + half, self._time, self._total) for half in (HALF, -HALF))
        means: Array = (last - first) / (2.0 * HALF)
        return means

    def inside(self, time: Array) -> NDArray[np.bool_]:
        """Return which of the times the samples cover."""
        reach = LARGEST_LAG + HALF
        return (time - reach > self._time[0]) & (time + reach < self._time[-1])


def motion_findings(recording: Recording, track: Track | None) -> list[Finding]:
    """Return what turns and accelerations show of axes, units and clocks."""
    imu = recording.sensors.get("imu")
    if imu is None or track is None:
        return []
    samples = imu.at(np.flatnonzero(np.isfinite(imu.values).all(axis=1))).by_stamp()
    lag, lag_std = lag_of_positions(track)
    late = lag if abs(lag) > max(NOTABLE_LAG, LAG_SIGMAS * lag_std) else 0.0
    course = course_of(track)
    if course is None or len(samples) < 100:
        return _late_findings(recording, late, None)
    means = Means(samples, track.origin)
    kept = means.inside(course.time)
    course = Course(*(column[kept] for column in vars(course).values()))
    up = up_in_imu(Seconds(samples))
    found, offset = _turn_findings(imu, course, means, up)
    rates = means.at(course.time)[:, 3:]
    turns = rates @ up
    if not found and float(np.std(rates - turns[:, None] * up)) * math.sqrt(3.0) > LEVEL_SHARE * float(np.std(turns)):
        return _late_findings(recording, late, None)
    if not found:
        found += _axis_findings(imu, course, means, up, recording, offset or 0.0)
    return (
        found
        + _late_findings(recording, late, offset if track.has_velocity else None)
        + ([] if offset is None or track.has_velocity else _offset_findings(recording, offset))
    )


def _lagged(course: Course, means: Means, up: Array) -> tuple[float, float, float]:
    """Return lag (s), correlation there and slope of the gyro's turn against that of the course.

    An antenna ahead of the point that does not slip sideways (the rear axle) by l has a course that leads the heading
    by rate times l over speed. That l is estimated with the slope; else it would look like a lag of l over speed.
    """
    lags = np.arange(-LARGEST_LAG, LARGEST_LAG + 0.01, 0.05)
    turn = course.turn - course.turn.mean()
    explained, slopes = [], []
    for lag in lags:
        rate, after, before = (means.at(course.time + lag + half)[:, 3:] @ up for half in (0.0, HALF, -HALF))
        lead = (after - before) / (2.0 * HALF) / course.speed
        columns = np.stack([rate - rate.mean(), lead - lead.mean()], axis=1)
        factors = np.linalg.lstsq(columns, turn, rcond=None)[0]
        fitted = columns @ factors
        explained.append(float(fitted @ turn / max(np.linalg.norm(fitted) * np.linalg.norm(turn), 1e-12)))
        slopes.append(float(factors[0]))
    best = int(np.argmax(explained))
    lag = float(lags[best])
    if 0 < best < len(lags) - 1:
        low, middle, high = explained[best - 1 : best + 2]
        lag += 0.05 * 0.5 * (low - high) / min(low - 2.0 * middle + high, -1e-12)
    # The factors are those from gyro to course.
    return lag, explained[best], 1.0 / slopes[best] if abs(slopes[best]) > 1e-3 else 1e3


def _turn_findings(imu: Sensor, course: Course, means: Means, up: Array) -> tuple[list[Finding], float | None]:
    """Compare the turns of the course with the gyro about the vertical; return also the lag of the stamps (s)."""
    turning = np.abs(course.turn) > TURNING
    if 0.1 * turning.sum() < FEWEST_TURNING:
        return [], None
    lag, correlation, slope = _lagged(course, means, up)
    evidence = {"correlation": correlation, "slope": slope, "lag_s": lag}

    def error(name: str, text: str, remedy: str) -> tuple[list[Finding], None]:
        return [Finding(Severity.ERROR, name, imu.topic, text, remedy, evidence)], None

    if abs(correlation) > WELL_EXPLAINED and (0.3 < abs(slope) < 3.0 or abs(abs(slope) / DEGREES - 1.0) < 0.3):
        if abs(abs(slope) / DEGREES - 1.0) < 0.3:
            remedy = "it is in deg/s: multiply by pi / 180 (REP-103 wants rad/s)"
            return error("degrees_per_second", f"the gyro reads {abs(slope):.1f} times the turns of the course", remedy)
        if slope < 0.0:
            remedy = "gyro and accelerometer disagree about what is up: axes are negated, or left-handed"
            return error("gyro_axes", "about the vertical the gyro turns the other way than the course", remedy)
        if abs(slope - 1.0) > 0.15:
            return error("gyro_scale", f"the gyro reads {slope:.2f} times the turns of the course", "look at its unit")
        return [], lag
    # Does another axis, or the three without the accelerometer, show the turns?
    rates = means.at(course.time)[:, 3:]
    rates = rates - rates.mean(axis=0)
    turn = course.turn - course.turn.mean()
    direction = np.linalg.lstsq(rates, turn, rcond=None)[0]
    explained = rates @ direction
    share = float(explained @ turn / max(np.linalg.norm(explained) * np.linalg.norm(turn), 1e-12))
    if share > WELL_EXPLAINED:
        axis = direction / np.linalg.norm(direction)
        told = ", ".join(f"{value:+.2f}" for value in axis)
        text = (
            f"the gyro turns about ({told}) of the IMU, while gravity is along ({', '.join(f'{v:+.2f}' for v in up)})"
        )
        remedy = "gyro and accelerometer have different axes: swapped or negated in the driver"
        return error("gyro_axes", text, remedy)
    text = f"turns of course and gyro do not agree (correlation {correlation:.2f})"
    remedy = f"clocks more than {LARGEST_LAG:.0f} s apart, a gyro that does not turn, or fixes of another vehicle"
    return [Finding(Severity.NOTE, "turns_disagree", imu.topic, text, remedy, evidence)], None


def _axis_findings(
    imu: Sensor, course: Course, means: Means, up: Array, recording: Recording, lag: float
) -> list[Finding]:
    """Compare accelerations along and across the course with the horizontal specific force in base_link."""
    to_base = rotation_imu_to_base(recording.parameters)
    up_base = to_base @ up
    # Level what the parameters leave tilted, so that only the yaw is judged; not for an IMU that is upside down.
    if up_base[2] < 0.1:
        return []
    force = means.at(course.time + lag)[:, :3] @ to_base.T
    force = force - (force @ up_base)[:, None] * up_base
    slow = np.floor(course.time / 20.0)
    columns = np.stack([force[:, 0], force[:, 1], course.along, course.left], axis=1)
    for number in np.unique(slow):
        inside = slow == number
        columns[inside] -= columns[inside].mean(axis=0)
    measured, expected = columns[:, :2], columns[:, 2:]
    strong = 0.1 * np.count_nonzero(np.hypot(*expected.T) > ACCELERATING)
    if strong < FEWEST_TURNING or (np.std(expected, axis=0) < 0.1).any():
        return []
    matrix = np.linalg.lstsq(expected, measured, rcond=None)[0].T
    missed = float(np.std(measured - expected @ matrix.T))
    size = float(np.std(expected))
    evidence = {"missed_share": missed / size, "determinant": float(np.linalg.det(matrix))}
    scale = math.sqrt(abs(float(np.linalg.det(matrix))))
    if missed > EXPLAINED_FORCE * size or not 0.6 < scale < 1.6:
        return []
    if np.linalg.det(matrix) < -0.25:
        text = "accelerations along and across the course appear mirrored in the horizontal axes of the IMU"
        remedy = "its axes are left-handed: one is negated, or two are swapped"
        return [Finding(Severity.ERROR, "accelerometer_axes", imu.topic, text, remedy, evidence)]
    # Seen from an IMU that is turned by the yaw, the course is turned back by it.
    yaw = -math.atan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
    independent = max(2.0, strong / 2.0)
    std = missed / (size * math.sqrt(independent))
    if abs(yaw) < max(NOTABLE_YAW, YAW_SIGMAS * std):
        return []
    roll, pitch, told = recording.parameters.imu.mount_rpy_deg
    wanted = round((told + math.degrees(yaw) + 180.0) % 360.0 - 180.0, 1)
    off, sigma = math.degrees(yaw), math.degrees(std)
    text = f"along the course the robot accelerates {off:+.1f} deg (+- {sigma:.1f}) off its x axis"
    remedy = f"if it travels along its x axis, set imu.mount_rpy_deg to [{roll:g}, {pitch:g}, {wanted:g}]"
    changes = {"imu.mount_rpy_deg": (roll, pitch, wanted)}
    evidence |= {"yaw_deg": math.degrees(yaw), "std_deg": math.degrees(std)}
    return [Finding(Severity.WARNING, "mounting_yaw", imu.topic, text, remedy, evidence, changes)]


def _late_findings(recording: Recording, late: float, offset: float | None) -> list[Finding]:
    """Return what is wrong with the times of positions and velocities.

    ``late``: by how much positions are behind velocities (s). ``offset``: what is to be added to the stamps of the
    velocities by the IMU (s), None if not known.
    """
    if not late:
        return [] if offset is None else _offset_findings(recording, offset)
    topic = recording.sensors["gnss_velocity"].topic
    gnss = recording.parameters.gnss
    of_velocity = 0.0 if offset is None or abs(offset) < CLOCK_LAG else offset
    position = gnss.time_offset + of_velocity - late
    evidence = {"seconds": late}
    if late > 0.0 and offset is not None:
        text = f"positions are stamped {late:.2f} s later than the velocities of the same receiver, which fit the IMU"
        position, velocity = round(position, 2), round(gnss.velocity_time_offset + late, 2)
        remedy = f"set gnss.time_offset to {position:g} and gnss.velocity_time_offset to {velocity:g}"
        changes = {"gnss.time_offset": position, "gnss.velocity_time_offset": velocity}
        return [Finding(Severity.WARNING, "position_late", topic, text, remedy, evidence, changes)]
    velocity = round(gnss.velocity_time_offset + late, 2)
    text = f"velocities are {abs(late):.2f} s {'older' if late < 0.0 else 'newer'} than positions with the same stamps"
    remedy, changes = f"set gnss.velocity_time_offset to {velocity:g}", {"gnss.velocity_time_offset": velocity}
    return [Finding(Severity.WARNING, "velocity_late", topic, text, remedy, evidence, changes)]


def _offset_findings(recording: Recording, offset: float) -> list[Finding]:
    if abs(offset) < CLOCK_LAG:
        return []
    sensor = recording.sensors["gnss_velocity" if "gnss_velocity" in recording.sensors else "gnss_fix"]
    wanted = round(recording.parameters.gnss.time_offset + offset, 2)
    severity = Severity.ERROR if abs(offset) > 0.5 else Severity.WARNING
    order = "later" if offset < 0.0 else "earlier"
    text = f"turns are stamped {abs(offset):.2f} s {order} by the receiver than by the IMU"
    remedy = f"set gnss.time_offset to {wanted:g}, or synchronise the clocks"
    changes = {"gnss.time_offset": wanted}
    return [Finding(severity, "clocks_apart", sensor.topic, text, remedy, {"seconds": offset}, changes)]
