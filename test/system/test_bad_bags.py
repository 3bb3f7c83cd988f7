"""Bad recordings, options and folders: exit code 2 and one line that says what is wrong, where, and what to do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.bags import BagWriter, open_bag
from eskf_ros.replay.main import main

CHECKOUT = Path(__file__).resolve().parents[2]
BAG = CHECKOUT / "bags" / "tunnel_drive.mcap"
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
VELOCITY, ODOMETRY = "geometry_msgs/msg/TwistWithCovarianceStamped", "nav_msgs/msg/Odometry"
TYPES = {"imu/data": IMU, "gps/fix": FIX, "gps/vel": VELOCITY, "truth": ODOMETRY}
STRINGS = ["imu_link", "gps", "earth", "base_link"]

Topics = dict[str, tuple[str, NDArray[np.int64], NDArray[Any]]]


@pytest.fixture(scope="module")
def minute() -> Topics:
    """The first minute of the bundled recording: topic -> type, log times, messages."""
    with open_bag([BAG]) as reader:
        batches = list(reader.batches(TYPES))
        end = reader.start_time + 60 * 10**9
    topics = {}
    for topic, type_name in TYPES.items():
        log_time = np.concatenate([batch[topic].log_time for batch in batches if topic in batch])
        messages = np.concatenate([batch[topic].messages for batch in batches if topic in batch])
        topics[topic] = (type_name, log_time[log_time < end], messages[log_time < end])
    return topics


def write_bag(path: Path, topics: Topics, strings: list[str] = STRINGS) -> Path:
    with BagWriter(path) as writer:
        for topic, (type_name, log_time, messages) in topics.items():
            writer.write(writer.add_topic(topic, type_name), log_time, messages, strings)
    return path


class Command:
    """Runs eskf_replay in the test's folder and checks how it fails."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capsys = capsys

    def __call__(self, *arguments: object) -> tuple[int, str, str]:
        code = main([*map(str, arguments), "--out", str(self.folder / "out")])
        captured = self._capsys.readouterr()
        # A first start says that it compiles: no part of what is wrong with the recording.
        lines = captured.err.splitlines(keepends=True)
        return code, captured.out, "".join(line for line in lines if ": compiling the estimator" not in line)

    def fails(self, *arguments: object) -> str:
        """Exit code 2, nothing on stdout, nothing in the folder of results; returns the one line on stderr."""
        code, out, error = self(*arguments)
        assert code == 2
        assert out == ""
        assert error.startswith("eskf_replay: error: ")
        assert error.endswith("\n")
        assert error.count("\n") == 1
        assert not list((self.folder / "out").glob("*"))
        return error


@pytest.fixture
def command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(tmp_path, capsys)


def test_a_truncated_recording_is_used_as_far_as_it_goes(command: Command, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    whole = BAG.read_bytes()
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    code, out, error = command(cut, "--config", CONFIG)
    assert code == 0
    assert error.startswith(f"eskf_replay: warning: {cut}: ")
    assert error.count("\n") == 1
    assert "Results: " in out
    summary = json.loads((tmp_path / "out" / "cut_eskf" / "summary.json").read_text())
    assert 100.0 < summary["duration_s"] < 180.0
    assert len(summary["warnings"]) == 1


def test_missing_file(command: Command, tmp_path: Path) -> None:
    error = command.fails(tmp_path / "nowhere.mcap")
    assert str(tmp_path / "nowhere.mcap") in error
    assert "no such file" in error.lower()


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("empty.mcap", b"", "empty"),
        ("text.mcap", b"this is no recording at all", "not a ROS 2 recording"),
        ("old.bag", b"#ROSBAG V2.0\n", "rosbags-convert"),
    ],
)
def test_a_file_that_is_no_recording(command: Command, tmp_path: Path, name: str, content: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(content)
    error = command.fails(tmp_path / name)
    assert str(tmp_path / name) in error
    assert said in error


def test_a_folder_that_is_no_recording(command: Command, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    assert "not a ROS 2 recording" in command.fails(tmp_path / "folder")


def test_a_recording_without_messages(command: Command, tmp_path: Path) -> None:
    assert "no messages" in command.fails(write_bag(tmp_path / "none.mcap", {}))


def test_a_recording_without_imu(command: Command, tmp_path: Path, minute: Topics) -> None:
    bag = write_bag(tmp_path / "b.mcap", {"gps/fix": minute["gps/fix"]})
    error = command.fails(bag)
    assert f"{bag}: no topic imu/data" in error
    assert f"nothing in it is {IMU}" in error
    assert f"gps/fix ({FIX}, {len(minute['gps/fix'][1])})" in error


def test_a_recording_without_fixes(command: Command, tmp_path: Path, minute: Topics) -> None:
    bag = write_bag(tmp_path / "b.mcap", {"imu/data": minute["imu/data"]})
    error = command.fails(bag)
    assert "no topic gps/fix" in error
    assert f"nothing in it is {FIX}" in error


def test_a_topic_without_messages(command: Command, tmp_path: Path, minute: Topics) -> None:
    nothing = (IMU, minute["imu/data"][1][:0], minute["imu/data"][2][:0])
    bag = write_bag(tmp_path / "b.mcap", {"imu/data": nothing, "gps/fix": minute["gps/fix"]})
    assert "topic imu/data has no messages" in command.fails(bag)


def test_an_optional_topic_without_messages_is_told_and_left_out(
    command: Command, tmp_path: Path, minute: Topics
) -> None:
    type_name, log_time, messages = minute["gps/vel"]
    bag = write_bag(tmp_path / "b.mcap", minute | {"gps/vel": (type_name, log_time[:0], messages[:0])})
    code, _, error = command(bag, "--quiet")
    assert code == 0
    assert "topic gps/vel has no messages; the recording is replayed without it" in error


def test_wrong_topic_names_list_what_is_there_and_the_key_to_set(
    command: Command, tmp_path: Path, minute: Topics
) -> None:
    bag = write_bag(tmp_path / "b.mcap", {"/xsens/imu": minute["imu/data"], "/ublox/fix": minute["gps/fix"]})
    error = command.fails(bag)
    assert "no topic imu/data in the recording; set topics.imu in --config FILE: /xsens/imu" in error
    assert "/ublox/fix (sensor_msgs/msg/NavSatFix, " in error
    config = tmp_path / "config.yaml"
    config.write_text("/**:\n  ros__parameters:\n    topics:\n      imu: /xsens/imu\n      gnss_fix: ublox/fix\n")
    code, _, error = command(bag, "--config", config, "--quiet")
    assert (code, error) == (0, "")


def test_a_topic_of_another_type(command: Command, tmp_path: Path, minute: Topics) -> None:
    bag = write_bag(tmp_path / "b.mcap", {"imu/data": minute["truth"], "gps/fix": minute["gps/fix"]})
    assert f"topic imu/data is {ODOMETRY}, not {IMU}" in command.fails(bag)


def test_topics_in_a_namespace_are_found(command: Command, tmp_path: Path, minute: Topics) -> None:
    bag = write_bag(tmp_path / "b.mcap", {f"/robot/{topic}": content for topic, content in minute.items()})
    code, _, error = command(bag, "--quiet", "--truth", "truth", "--json", tmp_path / "summary.json")
    assert (code, error) == (0, "")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["truth"]["topic"] == "/robot/truth"
    assert summary["aids"]["gnss_velocity"]["offered"] > 100


def test_without_velocity_another_topic_of_its_type_is_hinted_at(
    command: Command, tmp_path: Path, minute: Topics
) -> None:
    topics = {"imu/data": minute["imu/data"], "gps/fix": minute["gps/fix"], "/ublox/vel": minute["gps/vel"]}
    code, _, error = command(write_bag(tmp_path / "b.mcap", topics), "--quiet")
    assert code == 0
    assert error.count("\n") == 1
    assert "set topics.gnss_velocity" in error
    config = tmp_path / "config.yaml"
    config.write_text("/**:\n  ros__parameters:\n    topics:\n      gnss_velocity: /gnss/vel\n")
    (tmp_path / "out" / "b_eskf").rename(tmp_path / "elsewhere")
    error = command.fails(tmp_path / "b.mcap", "--config", config)
    assert "no topic /gnss/vel in the recording; set topics.gnss_velocity in --config FILE: /ublox/vel" in error


def test_fixes_without_a_position_are_told(command: Command, tmp_path: Path, minute: Topics) -> None:
    type_name, log_time, fixes = minute["gps/fix"]
    fixes = fixes.copy()
    fixes["status"] = -1
    bag = write_bag(tmp_path / "b.mcap", {"imu/data": minute["imu/data"], "gps/fix": (type_name, log_time, fixes)})
    code, _, error = command(bag, "--quiet")
    assert code == 0
    assert "no position was found" in error
    assert f"gps/fix: {len(fixes)} no_fix" in error
    folder = tmp_path / "out" / "b_eskf"
    assert (folder / "trajectory.tum").read_text() == ""
    assert json.loads((folder / "summary.json").read_text())["final"]["position"] is None


def test_too_late_messages_are_told_with_the_window_they_need(command: Command, tmp_path: Path, minute: Topics) -> None:
    type_name, log_time, fixes = minute["gps/fix"]
    topics = {"imu/data": minute["imu/data"], "gps/fix": (type_name, log_time + 3 * 10**9, fixes)}
    code, _, error = command(write_bag(tmp_path / "b.mcap", topics), "--quiet")
    assert code == 0
    (line,) = [line for line in error.splitlines() if "too late" in line]
    assert "history.window = 2 s" in line
    assert "of gps/fix" in line
    needed = float(line.split("a window of ")[1].split(" s")[0])
    assert 3.0 < needed < 3.3


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--outage", "10"], "START:LENGTH"),
        (["--outage", "10:-1"], "START:LENGTH"),
        (["--outage", "nan:5"], "START:LENGTH"),
        (["--output-rate", "-1"], "rate in Hz"),
        (["--output-rate", "fast"], "rate in Hz"),
        (["--mode", "tightly"], "loose"),
        (["--order", "time"], "stamp"),
        (["--smoothly"], "--smoothly"),
        (["--truth", "reference"], "no topic reference in the recording; name it with --truth TOPIC: "),
        (["--truth", "imu/data"], f"topic imu/data is {IMU}, not {ODOMETRY} or {FIX}"),
        (["--truth", "gps/fix"], "gps/fix is an input of the estimator"),
        (["--config", "nowhere.yaml"], "nowhere.yaml: cannot read the parameter file"),
    ],
)
def test_bad_options(command: Command, arguments: list[str], said: str) -> None:
    assert said in command.fails(BAG, *arguments)


def test_no_recording_named(command: Command) -> None:
    assert "BAG" in command.fails()


def test_every_mistake_in_the_config_is_named_in_one_line(command: Command, tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(
        "/**:\n  ros__parameters:\n    gnss:\n      leverarm: [0.0, 0.0, 0.0]\n      time_offset: 9.9e7\n"
    )
    error = command.fails(BAG, "--config", config)
    assert "gnss.leverarm" in error
    assert "gnss.lever_arm" in error
    assert "gnss.time_offset" in error


def test_truth_in_a_frame_that_means_nothing(command: Command, tmp_path: Path, minute: Topics) -> None:
    bag = write_bag(tmp_path / "b.mcap", minute, ["imu_link", "gps", "odom", "base_link"])
    assert "'odom'" in command.fails(bag, "--truth", "truth")


def test_truth_in_the_map_needs_the_datum(command: Command, tmp_path: Path, minute: Topics) -> None:
    bag = write_bag(tmp_path / "b.mcap", minute, ["imu_link", "gps", "map", "base_link"])
    assert "set datum" in command.fails(bag, "--truth", "truth")


def test_results_that_cannot_be_written(command: Command, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file where the folder should be")
    code, out, error = command(BAG)
    assert (code, out) == (2, "")
    assert error.count("\n") == 1
    assert str(tmp_path / "out") in error


def test_json_that_cannot_be_written(command: Command, tmp_path: Path) -> None:
    code, _, error = command(BAG, "--config", CONFIG, "--quiet", "--json", tmp_path / "nowhere" / "summary.json")
    assert code == 2
    assert "--json" in error
    assert error.count("\n") == 1


def test_two_recordings_of_one_name(command: Command, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    copy = tmp_path / "other" / BAG.name
    copy.write_bytes(BAG.read_bytes())
    assert "tunnel_drive_eskf" in command.fails(BAG, copy)


def test_one_bad_recording_does_not_stop_the_others(command: Command, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    code, _, error = command(tmp_path / "bad.mcap", BAG, "--config", CONFIG, "--quiet")
    assert code == 2
    assert error.count("\n") == 1
    assert (tmp_path / "out" / "tunnel_drive_eskf" / "summary.json").exists()
