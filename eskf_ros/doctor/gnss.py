"""Findings on the receiver alone: status, covariances, repeated fixes, steps, scatter, velocities against positions."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.doctor.imu import longest_runs
from eskf_ros.doctor.sensors import Array, Recording, Sensor
from eskf_ros.doctor.track import Track, interpolated, seconds_from, valid_fixes

FROZEN = 3.0
"""s; coordinates that stay the same bit for bit for longer while the robot moves are frozen."""

SENT_AGAIN = 0.3
"""Share of fixes equal to the one before from which on each seems to be sent several times."""

SCATTER_RATIO = 2.5
"""Ratio of the scatter from fix to fix to what the fixes claim from which on they claim too little."""

LASTING_RATIO = 0.3
"""The same below which their errors last: from fix to fix they hardly change."""

STEP_SIGMAS, LEAST_STEP = 10.0, 5.0
"""A fix that moves by so many standard deviations of the scatter, and metres, more than the velocity allows: a step."""

DRIFT_WINDOW, NOTABLE_DRIFT = 20.0, 0.25
"""s, m/s: positions that move against the velocities for so long and so fast are drawn away."""

NOTABLE_LAG, LAG_SIGMAS = 0.04, 6.0
"""s and standard deviations of a time between positions and velocities from which on it is told."""

AXIS_SHARE = 0.5
"""Share of the way that velocities may miss and still be East-North-Up."""


def fix_findings(fixes: Sensor) -> list[Finding]:
    """Return what the messages of a topic of fixes say of themselves."""
    found, count = [], len(fixes)

    def add(severity: Severity, name: str, bad: int, text: str, remedy: str = "") -> None:
        found.append(Finding(severity, name, fixes.topic, text, remedy, {"messages": bad, "share": bad / count}))

    is_fix = fixes.status >= 0
    none = int(np.count_nonzero(~is_fix))
    if none == count:
        add(Severity.ERROR, "never_a_fix", none, "no message says that it is a fix (status -1)", "look at the antenna")
        return found
    if none:
        add(Severity.WARNING if 4 * none > count else Severity.NOTE, "no_fix", none, f"{none} of {count} are no fix")
    latitude, longitude, altitude = fixes.values.T
    unfilled = int(np.count_nonzero(is_fix & (latitude == 0.0) & (longitude == 0.0)))
    if unfilled:
        remedy = "let the driver set status -1 until it has a position"
        add(Severity.ERROR, "unfilled_fixes", unfilled, f"{unfilled} of {count} fixes are (0, 0)", remedy)
    strange = int(np.count_nonzero(is_fix & ~((np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0))))
    if strange:
        severity = Severity.ERROR if 2 * strange > count else Severity.WARNING
        add(severity, "impossible_fixes", strange, f"{strange} of {count} fixes have no possible latitude or longitude")
    flat = int(np.count_nonzero(is_fix & np.isnan(altitude)))
    if flat:
        text = f"{flat} of {count} fixes have no altitude (NaN): they are used horizontally"
        add(Severity.NOTE, "no_altitude", flat, text, "record the altitude, or a barometer")
    return found + covariance_findings(fixes, is_fix) + _level_findings(fixes, is_fix)


def covariance_findings(sensor: Sensor, rows: np.ndarray | None = None) -> list[Finding]:
    """Return what is wrong with the covariances of a sensor (of the chosen rows)."""
    chosen = sensor if rows is None else sensor.at(np.flatnonzero(rows))
    if chosen.covariance.shape[1] != 9 or not len(chosen):
        return []
    variances = chosen.covariance[:, [0, 4, 8]]
    unknown = ~chosen.covariance.any(axis=1) | (variances[:, 0] == -1.0)
    if len(chosen.covariance_type):
        unknown |= chosen.covariance_type == 0
    horizontal = variances[:, :2] if sensor.name.startswith("gnss") else variances
    absent_is_allowed = not sensor.name.startswith("gnss")
    wrong = ~unknown & ~(np.isfinite(horizontal) & ((horizontal > 0.0) | absent_is_allowed)).all(axis=1)
    found, count = [], len(chosen)
    few, many = int(np.count_nonzero(unknown)), int(np.count_nonzero(wrong))
    if few:
        text = f"{few} of {count} messages have no covariance: that of the parameters stands in"
        group = "gnss.status_std_horizontal" if sensor.name == "gnss_fix" else "the unknown_..._std of the sensor"
        remedy = f"let the driver fill it, or set {group}"
        severity = Severity.WARNING if sensor.name == "gnss_fix" else Severity.NOTE
        found.append(Finding(severity, "no_covariance", sensor.topic, text, remedy, {"messages": few}))
    if many:
        text = f"{many} of {count} covariances are impossible: negative, zero on an axis, or not finite"
        severity = Severity.ERROR if 2 * many > count else Severity.WARNING
        remedy = "let the driver fill it, or set it to zero where it is unknown"
        found.append(Finding(severity, "bad_covariance", sensor.topic, text, remedy, {"messages": many}))
    return found


def _level_findings(fixes: Sensor, is_fix: np.ndarray) -> list[Finding]:
    """Return a note on the quality of the fixes over time: shares by status, and what they claim."""
    names = {0: "fix", 1: "SBAS", 2: "GBAS or RTK"}
    levels, counts = np.unique(fixes.status[is_fix], return_counts=True)
    told = ", ".join(
        f"{names.get(level, level)} {number / len(fixes):.0%}"
        for level, number in zip(levels.tolist(), counts.tolist())
    )
    claimed = np.sqrt(np.maximum(fixes.covariance[is_fix, 0], 0.0))
    claimed = claimed[np.isfinite(claimed)]
    if not len(claimed):
        claimed = np.zeros(1)
    low, middle, high = np.percentile(claimed, [5.0, 50.0, 95.0])
    text = f"status: {told}; claimed standard deviation (east) {low:.2g}, {middle:.2g}, {high:.2g} m (5, 50, 95 %)"
    return [Finding(Severity.NOTE, "fix_quality", fixes.topic, text, "", {"claimed_std_m": float(middle)})]


def repetition_findings(fixes: Sensor, track: Track) -> list[Finding]:
    """Return what is wrong with fixes that have the coordinates of the one before."""
    chosen = valid_fixes(fixes).by_stamp()
    same = (np.diff(chosen.values[:, :2], axis=0) == 0.0).all(axis=1)
    length, start, count = longest_runs(same)
    if not count:
        return []
    time = seconds_from(chosen.stamp, track.origin)
    moved = _distance_over(track, time[start], time[start + length])
    frozen = float(time[start + length] - time[start])
    if frozen > FROZEN and moved > max(3.0, 0.5 * frozen):
        text = (
            f"the coordinates stay the same for {frozen:.1f} s from {time[start]:.1f} s on, over {moved:.0f} m of way"
        )
        remedy = "let the driver send status -1, or nothing, while the receiver has no new position"
        evidence = {"seconds": frozen, "metres": moved}
        return [Finding(Severity.ERROR, "frozen_fixes", fixes.topic, text, remedy, evidence)]
    speed_time, speed = track.speeds()
    is_moving = (
        np.interp(time[1:], speed_time, np.hypot(*speed.T)) > 0.5 if len(speed_time) else np.ones(len(same), bool)
    )
    share = float(np.mean(same[is_moving])) if is_moving.sum() >= 20 else 0.0
    if share > SENT_AGAIN:
        times = 1.0 / max(1.0 - share, 1e-3)
        text = f"each fix seems to be sent {times:.0f} times with new stamps ({share:.0%} repeat the one before)"
        remedy = "let the driver send each position once, with its own time"
        return [Finding(Severity.WARNING, "fixes_sent_again", fixes.topic, text, remedy, {"share": share})]
    return []


def _distance_over(track: Track, begin: float, end: float) -> float:
    """Return how far the antenna went (m): by its velocities, else by the fixes on both sides."""
    if track.has_velocity:
        inside = (track.velocity_time >= begin) & (track.velocity_time <= end)
        speed = np.hypot(*track.velocity[inside, :2].T)
        return float(np.mean(speed) * (end - begin)) if len(speed) else 0.0
    after = int(np.searchsorted(track.time, end, "right"))
    before = max(0, int(np.searchsorted(track.time, begin, "right")) - 1)
    if after >= len(track.time):
        return 0.0
    return float(np.hypot(*(track.position[after, :2] - track.position[before, :2])))


def _robust_std(values: Array) -> float:
    """Return the standard deviation by the median of absolute values; NaN values are left out."""
    values = values[np.isfinite(values)]
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else math.nan


def path_findings(topic: str, velocity_topic: str, track: Track) -> list[Finding]:
    """Return what positions alone, or with the velocities of the same receiver, show of their errors."""
    if len(track.time) < 50:
        return []
    rest = track.position - track.way() if track.has_velocity else track.position
    found = []
    if track.has_velocity:
        found = velocity_findings(velocity_topic, track)
        if any(finding.name == "velocity_axes" for finding in found):
            return found
        late, std = lag_of_positions(track)
        if abs(late) > LAG_SIGMAS * std:
            rest[:, :2] += late * interpolated(track.time, track.velocity_time, track.velocity[:, :2])
        change, factor = np.diff(rest[:, :2], axis=0), math.sqrt(2.0)
    else:
        # Second differences: what the speed does is left out, not what the acceleration does.
        change, factor = np.diff(rest[:, :2], n=3, axis=0), math.sqrt(20.0)
    if np.isfinite(rest[:, 0]).sum() < 50:
        return found
    usual = np.median(np.diff(track.time))
    scatter = _robust_std(change - np.nanmedian(change, axis=0)) / factor
    claimed = float(np.nanmedian(track.claimed)) if np.isfinite(track.claimed).any() else math.nan
    ratio = scatter / claimed if claimed > 0.0 else math.nan
    # What a jerk of some m/s3, or an acceleration of some m/s2 between two velocities, hides (m).
    allowed = 2.0 * usual**2 if track.has_velocity else 2.0 * usual**3
    evidence = {"scatter_m": scatter, "claimed_m": claimed}
    says = f"from fix to fix the positions scatter by {scatter:.2g} m and claim {claimed:.2g} m"
    if ratio > SCATTER_RATIO and scatter > allowed:
        wanted = float(f"{ratio**2:.2g}")
        remedy, changes = f"set gnss.covariance_scale to {wanted:g}", {"gnss.covariance_scale": wanted}
        found.append(Finding(Severity.WARNING, "claims_too_little", topic, says, remedy, evidence, changes))
    elif ratio < LASTING_RATIO:
        remedy = "their errors last for many fixes: consider gnss.correlation_time"
        found.append(Finding(Severity.NOTE, "lasting_errors", topic, says, remedy, evidence))
    if track.has_velocity:
        found += _step_findings(topic, track, rest, scatter)
    return found


def _step_findings(topic: str, track: Track, rest: Array, scatter: float) -> list[Finding]:
    """Return steps and drifts of the positions that their velocities do not have; ``rest``: position minus way."""
    found = []
    change = np.hypot(*np.diff(rest[:, :2], axis=0).T)
    limit = max(LEAST_STEP, STEP_SIGMAS * scatter)
    steps = np.flatnonzero(change > limit)
    if len(steps):
        text = (
            f"{len(steps)} steps of the position, up to {np.nanmax(change):.0f} m, that the velocities do not have, "
            f"the first at {track.time[steps[0]]:.1f} s"
        )
        remedy = "multipath or wild fixes: the filter refuses most; look at the antenna's sky"
        evidence = {"steps": len(steps), "largest_m": float(np.nanmax(change))}
        found.append(Finding(Severity.WARNING, "position_steps", topic, text, remedy, evidence))
        return found
    window = np.floor(track.time / DRIFT_WINDOW)
    worst, at = 0.0, 0.0
    for number in np.unique(window):
        inside = (window == number) & np.isfinite(rest[:, 0])
        time = track.time[inside]
        if len(time) < 10 or np.ptp(time) < 0.7 * DRIFT_WINDOW:
            continue
        slope = np.polyfit(time - time.mean(), rest[inside, :2], 1)[0]
        size = float(np.hypot(*slope))
        noise = scatter * math.sqrt(12.0 / len(time)) / np.ptp(time)
        if size > worst and size > 5.0 * noise:
            worst, at = size, float(time[0])
    if worst > NOTABLE_DRIFT:
        text = (
            f"around {at:.0f} s the positions move against the velocities by {worst:.2f} m/s for {DRIFT_WINDOW:.0f} s"
        )
        remedy = "multipath or spoofing; or the velocities are wrong"
        evidence = {"metres_per_s": worst}
        found.append(Finding(Severity.WARNING, "position_drawn_away", topic, text, remedy, evidence))
    return found


def velocity_findings(topic: str, track: Track) -> list[Finding]:
    """Return what is wrong with axes, unit and time of the velocities, by the positions of the same receiver."""
    way = track.way()
    span = max(1, round(2.0 / max(float(np.median(np.diff(track.time))), 1e-3)))
    moved, went = (part[span:] - part[:-span] for part in (track.position, way))
    known = np.isfinite(went).all(axis=1)
    moved, went = moved[known], went[known]
    size = math.sqrt(float(np.mean(np.square(moved[:, :2])))) if len(moved) else 0.0
    noise = float(np.nanmedian(track.claimed)) if np.isfinite(track.claimed).any() else 1.0
    if len(moved) < 20 or size < max(1.0, 3.0 * noise):
        return []

    def missed(velocity: Array) -> float:
        return math.sqrt(float(np.mean(np.square(moved[:, :2] - velocity)))) / size

    as_given = missed(went[:, :2])
    scale = float(np.sum(moved[:, :2] * went[:, :2]) / max(np.sum(np.square(went[:, :2])), 1e-12))
    wrong = {
        "it is North-East-Down: publish East-North-Up (REP-103)": missed(went[:, [1, 0]]),
        "its sign is reversed": missed(-went[:, :2]),
        f"its unit is wrong by a factor of {scale:.2f} (0.51: knots, 0.28: km/h)": missed(scale * went[:, :2]),
    }
    cause, best = min(wrong.items(), key=lambda item: item[1])
    if as_given > AXIS_SHARE or (as_given > 4.0 * noise / size and abs(scale - 1.0) > 0.2 and best < 0.5 * as_given):
        along = np.hypot(*moved[:, :2].T)
        if best > AXIS_SHARE and np.std(along - went[:, 0]) < AXIS_SHARE * np.std(along):
            cause, best = "it is in the axes of the vehicle: publish East-North-Up, or use it as body_velocity", 0.0
        text = f"the velocity explains the way of the positions only up to {as_given:.0%} of it"
        remedy = (
            cause if best < AXIS_SHARE else "velocity and positions contradict each other: look at its axes and unit"
        )
        return [
            Finding(Severity.ERROR, "velocity_axes", topic, text, remedy, {"missed_share": as_given, "scale": scale})
        ]
    return []


def lag_of_positions(track: Track) -> tuple[float, float]:
    """Return by how much positions are late against velocities (s), and its standard deviation; NaN if not shown.

    A position that is late by d lags behind the integrated velocity by d times the velocity.
    """
    if not track.has_velocity or len(track.time) < 50:
        return math.nan, math.nan
    rest = (track.position - track.way())[:, :2]
    speed = np.stack([np.interp(track.time, track.velocity_time, track.velocity[:, axis]) for axis in (0, 1)], axis=1)
    window = np.floor(track.time / DRIFT_WINDOW)
    products = squares = misses = 0.0
    count = 0
    for number in np.unique(window):
        inside = (window == number) & np.isfinite(rest[:, 0])
        if inside.sum() < 10:
            continue
        time = track.time[inside] - track.time[inside].mean()
        basis = np.stack([np.ones_like(time), time], axis=1)

        def without_line(values: Array, basis: Array = basis) -> Array:
            return values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]

        a, b = without_line(speed[inside]), without_line(rest[inside])
        products, squares = products + float(np.sum(a * b)), squares + float(np.sum(a * a))
        misses, count = misses + float(np.sum(b * b)), count + 2 * int(inside.sum()) - 4
    if squares < 100.0 or count < 50:
        return math.nan, math.nan
    late = -products / squares
    # Errors of neighbouring fixes are alike: wider than the formal value.
    return late, 1.5 * math.sqrt(max(misses / count, 1e-8) / squares)


def receiver_findings(recording: Recording, track: Track | None) -> list[Finding]:
    """Return all findings on fixes and their velocities."""
    found = []
    fixes, velocities = recording.sensors.get("gnss_fix"), recording.sensors.get("gnss_velocity")
    if fixes is not None and len(fixes):
        found += fix_findings(fixes)
        if track is not None:
            found += repetition_findings(fixes, track)
            if not any(finding.name in ("frozen_fixes", "fixes_sent_again") for finding in found):
                found += path_findings(fixes.topic, velocities.topic if velocities else "", track)
    for name, sensor in recording.sensors.items():
        if name not in ("imu", "gnss_fix"):
            found += covariance_findings(sensor)
            bad = int(np.count_nonzero(~np.isfinite(sensor.values).all(axis=1))) if sensor.values.size else 0
            if bad:
                text = f"{bad} of {len(sensor)} messages carry numbers that are not finite"
                severity = Severity.ERROR if 2 * bad > len(sensor) else Severity.WARNING
                found.append(
                    Finding(severity, "not_finite", sensor.topic, text, "look at the driver", {"messages": bad})
                )
    return found
