"""`eskf_watch`: what a person must see of a node is on the screen, of a replay's recording and of one of the robot."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from eskf_ros.bags import BagWriter
from eskf_ros.bags.cdr_writer import DIAGNOSTIC_ARRAY, Status, diagnostic_array
from eskf_ros.replay.main import main as replay
from eskf_ros.watch.main import main
from eskf_ros.watch.panels import dashboard, sparkline
from eskf_ros.watch.recording import reports
from eskf_ros.watch.seen import Report, Seen

CHECKOUT = Path(__file__).resolve().parents[2]
NODE = "/robot/eskf_node"


def report(stamp: float = 0.0, message: str = "GOOD", level: int = 0, node: str = NODE, **values: str) -> Report:
    named = {key.replace("__", " "): value for key, value in values.items()}
    return Report(stamp, f"{node}: navigation", level, message, named)


def text_of(seen: Seen, **options: Any) -> str:
    """The dashboard as it stands in a wide terminal."""
    screen = StringIO()
    Console(file=screen, width=200, force_terminal=False).print(dashboard(seen, **options))
    return screen.getvalue()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """odometry.mcap of the bundled drive, whose tunnel never ends."""
    out = tmp_path_factory.mktemp("watch")
    options = ["--config", str(CHECKOUT / "config" / "tunnel_drive.yaml"), "--outage", "125:1000", "--quiet"]
    assert replay([str(CHECKOUT / "bags" / "tunnel_drive.mcap"), "--out", str(out), *options]) == 0
    return out / "tunnel_drive_eskf" / "odometry.mcap"


def test_the_state_what_it_waits_for_and_the_warnings_are_shown() -> None:
    seen = Seen()
    message = "WAITING_FIX; no message on /gps/fix; 0 publishers; the IMU is noisier than its parameters"
    seen.note(report(message=message, level=1))
    text = text_of(seen)
    for words in ("WAITING_FIX", "no message on /gps/fix", "0 publishers", "the IMU is noisier", NODE, "WARN"):
        assert words in text
    assert "no report for 7 s" in text_of(seen, age=7.0)
    assert "waiting for /diagnostics" in text_of(Seen(), waiting_for="/diagnostics")


def test_rates_and_refusals_of_each_sensor_are_those_of_the_last_minute() -> None:
    seen = Seen()
    for second in range(0, 100, 10):
        fused, gated = str(5 * second), str(max(0, second - 40))
        seen.note(report(float(second), gnss_position__fused=fused, gnss_position__gate=gated, imu__fused="3"))
    ((name, counts, rates),) = seen.aids()
    assert (name, counts) == ("gnss_position", {"fused": 450, "gate": 50})
    assert rates == {"fused": pytest.approx(5.0), "gate": pytest.approx(50 / 90)}
    line = next(line for line in text_of(seen).splitlines() if "gnss_position" in line)
    assert line.split()[-7:] == ["gnss_position", "450", "5.0", "50", "0.6", "50", "gate"]


def test_inputs_have_their_rates_and_delays() -> None:
    seen = Seen()
    values = {"imu rate (Hz)": "199.8", "imu delay (s)": "0.002 +- 0.001", "position std (m)": "1.0 2.0 3.0"}
    seen.note(Report(0.0, f"{NODE}: navigation", 0, "GOOD", values))
    assert seen.inputs() == [("imu", "199.8", "0.002 +- 0.001")]
    assert seen.course("position std (m)") == [3.0]
    assert "199.8" in text_of(seen)


def test_one_node_of_several_is_shown() -> None:
    first, chosen = Seen(), Seen("/other/eskf_node")
    for seen in (first, chosen):
        seen.note(Report(0.0, "/driver: temperature", 2, "hot", {}))
        seen.note(report())
        seen.note(report(message="FAULT", level=2, node="/other/eskf_node"))
    assert (first.node, first.state) == (NODE, "GOOD")
    assert (chosen.node, chosen.state) == ("/other/eskf_node", "FAULT")


def test_the_course_of_a_value_grows_to_the_right() -> None:
    assert sparkline([0.0, 1.0, 4.0, 8.0]) == "▁▂▅█"
    assert sparkline([]) == sparkline([0.0]) == ""
    assert len(sparkline(list(range(100)))) == 24


def test_a_replay_that_ends_in_a_tunnel_ends_unusable(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--bag", str(recording), "--once"]) == 1
    text = capsys.readouterr().out
    assert "COASTING" in text
    assert "usable for navigation: no" in text
    seen = Seen()
    levels = []
    for each in reports(recording):
        seen.note(each)
        if each.name.endswith("quality"):
            levels.append(each.level)
    assert {0, 2} <= set(levels), "usable before the tunnel, and not after a while in it"
    course = seen.course("position std (m)")
    assert course[-1] > 1.5 * course[0] > 0.0, "the sigma grows without fixes"
    assert not [rates for name, _, rates in seen.aids() if name == "gnss_position" and rates["fused"] > 0.0]


def test_the_show_of_a_recording_ends_with_it(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--bag", str(recording), "--speed", "1e9"]) == 0
    assert "COASTING" in capsys.readouterr().out


def test_a_recording_of_the_robot_is_read_by_its_own_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "robot.mcap") as writer:
        topic = writer.add_topic("/diagnostics", DIAGNOSTIC_ARRAY)
        status = Status(2, f"{NODE}: navigation", "FAULT; a reset: call the service ~/reset", {"resets": "1"})
        writer.write(topic, np.array([10**18]), [diagnostic_array(10**18, [status])])
    assert main(["--bag", str(tmp_path / "robot.mcap"), "--once"]) == 1
    text = capsys.readouterr().out
    assert "FAULT" in text
    assert "a reset: call the service ~/reset" in text


def test_a_recording_without_diagnostics_is_a_mistake_of_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--bag", str(CHECKOUT / "bags" / "tunnel_drive.mcap"), "--once"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("eskf_watch: error: ")
    assert "imu/data" in error
    assert main(["--bag", str(tmp_path / "none.mcap")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
