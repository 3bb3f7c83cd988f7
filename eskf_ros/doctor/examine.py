"""`check`: read a recording, look at it topic by topic, run the estimator over it, and return what was found."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

from eskf_ros.doctor.coverage import coverage_findings
from eskf_ros.doctor.filter_run import filter_findings
from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.doctor.gnss import receiver_findings
from eskf_ros.doctor.imu import imu_findings
from eskf_ros.doctor.motion import motion_findings
from eskf_ros.doctor.report import Report
from eskf_ros.doctor.sensors import Recording, read_recording
from eskf_ros.doctor.stamps import clock_findings, stamp_findings
from eskf_ros.doctor.track import track_of
from eskf_ros.filter.state.enums import Status
from eskf_ros.inputs.table import FIXES
from eskf_ros.parameters.tree import Parameters

NOT_COMPARABLE = {
    "bridged_samples",
    "clipped",
    "clock_jump",
    "clock_set_back",
    "degrees_per_second",
    "equal_stamps",
    "fixes_sent_again",
    "frozen_fixes",
    "gravity_removed",
    "shocks",
    "stuck_axis",
    "units_of_g",
    "velocity_axes",
}
"""Findings after which turns and accelerations of IMU and receiver are not compared: they would blame another cause."""


def check(
    path: str | PathLike[str],
    parameters: Parameters | None = None,
    runs_filter: bool = True,
    progress: Callable[[float], None] = lambda share: None,
) -> Report:
    """Return what is wrong or odd with a recording: a rosbag2 folder, an .mcap or a .db3 file.

    ``parameters``: what is known of the robot (default: the defaults); topics with other names are found by their type.
    ``runs_filter``: replay it, too, and ask the monitors of the estimator. ``progress`` gets the share done.

    Raises:
        BagError: the recording cannot be read.
    """
    share = 0.3 if runs_filter else 1.0
    recording = read_recording(Path(path), parameters or Parameters(), lambda done: progress(share * done))
    findings = [*recording.findings, *sensor_findings(recording)]
    replayed: dict[str, Any] = {}
    if runs_filter and not any(finding.name in ("no_imu", "no_fixes") for finding in findings):
        found, replayed = filter_findings(recording, findings, lambda done: progress(share + (1.0 - share) * done))
        findings += found
        if Status[replayed.get("status", "WAITING_IMU")] >= Status.ALIGNING:
            findings = [finding for finding in findings if finding.name != "heading_not_observable"]
    findings.sort(key=lambda finding: -finding.severity)
    return Report(recording, tuple(findings), replayed)


def sensor_findings(recording: Recording) -> list[Finding]:
    """Return what the messages themselves show, without the estimator."""
    track = track_of(recording)
    findings = []
    for sensor in recording.sensors.values():
        findings += stamp_findings(sensor, recording) if sensor.name != "ephemerides" else []
    findings += clock_findings(recording)
    if "imu" in recording.sensors:
        findings += imu_findings(recording.sensors["imu"], recording, track)
    findings += receiver_findings(recording, track)
    if not {finding.name for finding in findings if finding.severity > Severity.NOTE} & NOT_COMPARABLE:
        by_motion = motion_findings(recording, track)
        if any(finding.name == "clocks_apart" for finding in by_motion):
            # Times of arrival know the clocks to the delay of a driver only, turns know them better.
            receiver = [sensor.topic for name, sensor in recording.sensors.items() if name in FIXES]
            findings = [f for f in findings if f.name != "clocks_apart" or f.topic not in receiver]
        findings += by_motion
    findings += coverage_findings(recording, track)
    if not any(recording.parameters.gnss.lever_arm):
        text = "gnss.lever_arm is zero: a metre that is not told is a metre in the result"
        findings.append(Finding(Severity.NOTE, "no_lever_arm", "", text, "measure the antenna in base_link"))
    return findings
