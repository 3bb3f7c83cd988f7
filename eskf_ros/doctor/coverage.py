"""Notes on what a recording covers: rest, turns, speed, silence of the receiver, and what will be observable."""

from __future__ import annotations

import numpy as np

from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.doctor.imu import Seconds
from eskf_ros.doctor.motion import ACCELERATING, TURNING, course_of
from eskf_ros.doctor.sensors import Recording
from eskf_ros.doctor.track import AT_REST, Track

FAST = 10.0
"""m/s; above it a robot is fast."""

FEWEST_ACCELERATING = 3.0
"""s of accelerations that tell an unknown heading."""


def coverage_findings(recording: Recording, track: Track | None) -> list[Finding]:
    """Return notes on the situations in a recording, and a warning if nothing in it tells the heading."""
    if track is None or "imu" not in recording.sensors:
        return []
    time, velocity = track.speeds()
    if len(time) < 2:
        return []
    steps = np.minimum(np.diff(time, prepend=time[0]), 2.0)
    speed = np.hypot(*velocity.T)
    course = course_of(track)
    turning = 0.1 * np.count_nonzero(np.abs(course.turn) > TURNING) if course else 0.0
    accelerating = 0.1 * np.count_nonzero(np.hypot(course.along, course.left) > ACCELERATING) if course else 0.0
    silent = np.diff(track.time)
    shares = {
        "rest_s": float(steps[speed < AT_REST].sum()),
        "fast_s": float(steps[speed > FAST].sum()),
        "turning_s": float(turning),
        "accelerating_s": float(accelerating),
        "without_fixes_s": float(silent[silent > 2.0].sum()),
        "fastest_m_per_s": float(np.percentile(speed, 99.0)),
    }
    text = (
        f"{recording.duration:.0f} s: at rest {shares['rest_s']:.0f} s, faster than {FAST:.0f} m/s "
        f"{shares['fast_s']:.0f} s, turning {turning:.0f} s, accelerating {accelerating:.0f} s, without fixes "
        f"{shares['without_fixes_s']:.0f} s; fastest {shares['fastest_m_per_s']:.1f} m/s"
    )
    found = [Finding(Severity.NOTE, "coverage", "", text, "", shares)]
    seconds = Seconds(recording.sensors["imu"].by_stamp())
    if not seconds.quiet[:10].any():
        text = "the robot moves or shakes from the first second on: levelling takes longer and is less exact"
        found.append(Finding(Severity.NOTE, "no_rest_at_start", "", text, "begin with a few seconds at rest"))
    return found + _heading_findings(recording, float(accelerating))


def _heading_findings(recording: Recording, accelerating: float) -> list[Finding]:
    parameters = recording.parameters
    is_told = (
        "heading" in recording.sensors
        or ("mag" in recording.sensors and parameters.mag.use)
        or not np.isnan(parameters.alignment.initial_heading_deg)
    )
    if is_told or accelerating >= FEWEST_ACCELERATING:
        return []
    remedy = "speed up, brake and turn; or use a dual antenna, mag.use, or alignment.initial_heading_deg"
    text = "nothing tells the heading: hardly any acceleration that the receiver has seen, no heading sensor"
    evidence = {"accelerating_s": accelerating}
    return [Finding(Severity.WARNING, "heading_not_observable", "", text, remedy, evidence)]
