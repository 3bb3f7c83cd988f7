"""`eskf_check`: each fault of a recording is named, a clean recording is left in peace, and the exit code says so."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import eskf_ros
from campaign.fault import Fault
from campaign.running import recording_of
from check_faults import FAULTS, MESSAGE_FAULTS, MessageFault, write_bag
from eskf_ros.bags import BagWriter, message_dtype
from eskf_ros.doctor.finding import Severity
from eskf_ros.doctor.main import main
from eskf_ros.doctor.report import Report
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.simulate.frames import STRINGS
from eskf_ros.simulate.messages import topics_of
from eskf_ros.simulate.scenario import Recording, simulate

CHECKOUT = Path(__file__).resolve().parents[2]
BAG = CHECKOUT / "bags" / "tunnel_drive.mcap"
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
LEVER_ARM = {"gnss.lever_arm": [0.8, -0.2, 1.4]}

Examine = Callable[[Recording, MessageFault | None], Report]


@pytest.fixture
def examine(tmp_path: Path) -> Examine:
    """Writes a drive, its messages changed by a fault, and looks at it without the estimator."""

    def look(recording: Recording, fault: MessageFault | None) -> Report:
        write_bag(tmp_path / "bag.mcap", recording, fault, seed=0)
        return eskf_ros.check(tmp_path / "bag.mcap", from_mapping(LEVER_ARM), runs_filter=False)

    return look


def named(report: Report, severity: Severity = Severity.WARNING) -> set[str]:
    return {finding.name for finding in report.findings if finding.severity >= severity}


def test_a_clean_recording_is_left_in_peace() -> None:
    report = eskf_ros.check(BAG, eskf_ros.load_parameters(CONFIG))
    assert named(report) == set()
    assert report.exit_code == 0
    assert report.replay["status"] in ("GOOD", "ALIGNING")
    rates = {topic: report.rate(topic) for topic in report.recording.topics}
    assert rates == {"imu/data": pytest.approx(200.0), "gps/fix": 5.0, "gps/vel": 5.0, "truth": None}
    (coverage,) = report.named("coverage")
    assert coverage.evidence["without_fixes_s"] == pytest.approx(45.2, abs=0.1)


@pytest.mark.parametrize("scenario", ["field_robot", "walk", "multirotor", "boat", "motorway", "aeroplane"])
def test_no_cause_is_named_where_nothing_is_wrong(examine: Examine, scenario: str) -> None:
    recording = simulate(scenario, 3, imu_rate=100.0)
    assert named(examine(recording, None)) <= {"heading_not_observable"}


@pytest.mark.parametrize("fault", MESSAGE_FAULTS, ids=lambda fault: fault.name)
def test_faults_of_messages_are_named(examine: Examine, fault: MessageFault) -> None:
    recording = simulate("drive", 1, imu_rate=100.0, stop=286.0, **fault.options)
    report = examine(recording, fault)
    assert named(report, Severity.NOTE) & set(fault.names)
    consequences = {"equal_stamps", "imu_gaps"} if "clock" in fault.name else set()
    assert named(report) <= set(fault.names) | consequences


EXPECTED = {  # the stamps are wrong on a rough road, whose noise is told, too
    "rates clipped at 0.2 rad/s": {"clipped"},
    "shocks of 100 m/s2, 8 rad/s": {"shocks"},
    "one gyro stuck for 40 s": {"stuck_axis"},
    "holes of 1.6 s, dropped": {"imu_gaps"},
    "holes of 1.6 s, bridged by lines": {"bridged_samples"},
    "holes of 1.6 s, last sample repeated": {"repeated_samples"},
    "stamps jittered by 1 ms, late by 0 ms": {"stamp_jitter", "noise_told_small"},
    "stamps in bursts of 4": {"stamp_bursts", "noise_told_small"},
    "positions stamped 0.25 s late": {"position_late"},
    "velocities stamped 0.13 s late": {"velocity_late"},
    "steps of 15 m, 20 s every minute": {"position_steps"},
    "frozen coordinates for 40 s": {"frozen_fixes"},
}


@pytest.mark.parametrize("fault", [f for f in FAULTS if f.name in EXPECTED], ids=lambda fault: fault.name)
def test_faults_of_the_campaign_are_named_and_nothing_else(examine: Examine, fault: Fault) -> None:
    assert named(examine(recording_of(fault, 2), None)) == EXPECTED[fault.name]


def test_a_remedy_that_is_followed_is_right(examine: Examine, tmp_path: Path) -> None:
    late = next(fault for fault in FAULTS if fault.name == "positions stamped 0.25 s late")
    parameters = examine(recording_of(late, 2), None).named("position_late")[0].parameters
    assert parameters["gnss.time_offset"] == pytest.approx(-0.25, abs=0.03)
    again = eskf_ros.check(tmp_path / "bag.mcap", from_mapping({**LEVER_ARM, **parameters}), runs_filter=False)
    assert named(again) == set()


@pytest.mark.parametrize("yaw", [-90.0, 8.0, 150.0])
def test_the_yaw_of_the_imu_is_found(examine: Examine, tmp_path: Path, yaw: float) -> None:
    recording = simulate("drive", 1, imu_rate=100.0, stop=286.0, imu_rpy_deg=(0.0, 0.0, yaw))
    (finding,) = examine(recording, None).named("mounting_yaw")
    assert finding.parameters["imu.mount_rpy_deg"] == (0.0, 0.0, pytest.approx(yaw, abs=2.0))
    told = from_mapping({**LEVER_ARM, "imu.mount_rpy_deg": [0.0, 0.0, yaw]})
    assert named(eskf_ros.check(tmp_path / "bag.mcap", told, runs_filter=False)) == set()


def test_the_clock_of_the_receiver_is_found_by_turns(examine: Examine) -> None:
    (late,) = (fault for fault in MESSAGE_FAULTS if fault.name == "IMU clock 1.2 s late")
    (finding,) = examine(simulate("drive", 1, imu_rate=100.0, stop=286.0), late).named("clocks_apart")
    assert finding.parameters["gnss.time_offset"] == pytest.approx(1.2, abs=0.06)


def test_topics_with_other_names_are_found(tmp_path: Path) -> None:
    names = {"imu/data": "/xsens/imu", "gps/fix": "/ublox/fix", "gps/vel": "/ublox/fix_velocity"}
    with BagWriter(tmp_path / "bag.mcap") as writer:
        for topic in topics_of(simulate("drive", 1, imu_rate=100.0, stop=60.0)):
            if topic.name in names:
                handle = writer.add_topic(names[topic.name], topic.type_name)
                writer.write(handle, topic.arrival, topic.messages(slice(None)), STRINGS)
    report = eskf_ros.check(tmp_path / "bag.mcap", runs_filter=False)
    inputs = {topic: name for topic, (_, _, name) in report.recording.topics.items()}
    assert inputs == {"/xsens/imu": "imu", "/ublox/fix": "gnss_fix", "/ublox/fix_velocity": "gnss_velocity"}
    path = tmp_path / "first.yaml"
    path.write_text(report.parameter_file())
    topics = load(path).topics
    assert (topics.imu, topics.gnss_fix, topics.gnss_velocity) == ("/xsens/imu", "/ublox/fix", "/ublox/fix_velocity")


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(BAG), "--config", str(CONFIG), "--no-filter", "--json", str(tmp_path / "report.json")]) == 0
    assert "imu/data" in capsys.readouterr().out
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["navigates"]
    assert {entry["input"] for entry in report["topics"]} == {"imu", "gnss_fix", "gnss_velocity", ""}
    assert all({"severity", "name", "text", "remedy", "evidence"} <= set(finding) for finding in report["findings"])


def test_a_recording_that_breaks_navigation_has_exit_code_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = simulate("drive", 1, imu_rate=100.0, stop=60.0, gravity_removed=True)
    write_bag(tmp_path / "bag.mcap", recording, None, 0)
    assert main([str(tmp_path / "bag.mcap"), "--no-filter", "--json", "-"]) == 1
    captured = capsys.readouterr()
    findings = json.loads(captured.out)["findings"]
    assert findings[0]["name"] == "gravity_removed"
    assert "raw specific force" in findings[0]["remedy"]


def test_an_unreadable_recording_has_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bag.mcap").write_bytes(b"nothing")
    assert main([str(tmp_path / "bag.mcap")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("eskf_check: error: ")
    assert error.count("\n") == 1


def test_a_recording_without_imu_says_so(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag.mcap") as writer:
        fixes = np.zeros(3, message_dtype("sensor_msgs/msg/NavSatFix"))
        fixes["stamp"] = 10**9 * np.arange(1, 4)
        writer.write(writer.add_topic("gps/fix", "sensor_msgs/msg/NavSatFix"), fixes["stamp"], fixes, ["gps"])
    report = eskf_ros.check(tmp_path / "bag.mcap")
    assert report.exit_code == 1
    assert report.named("no_imu")


def test_numbers_that_are_not_finite_do_not_stop_it(tmp_path: Path) -> None:
    recording = simulate("drive", 1, imu_rate=100.0, stop=60.0)
    recording.specific_force[1000:1100] = math.nan
    recording.fix_latitude_deg[100:150] = math.inf
    recording.velocity_enu[50:60] = math.nan
    write_bag(tmp_path / "bag.mcap", recording, None, 0)
    report = eskf_ros.check(tmp_path / "bag.mcap", runs_filter=False)
    assert {"not_finite", "impossible_fixes"} <= named(report)
    json.dumps(report.as_dict(), allow_nan=False)
