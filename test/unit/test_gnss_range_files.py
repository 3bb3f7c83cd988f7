"""RINEX files beside a recording: the same ranges as recorded ones, at the right time, whatever way they come in."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from eskf_ros.bags import POINT_CLOUD, BagReader, Batch, cloud_messages, open_bag
from eskf_ros.gnss.cloud import read_epoch, write_epoch
from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.ephemeris_cloud import read_ephemerides
from eskf_ros.gnss.measurements import measured_epoch
from eskf_ros.gnss.range_files import read_navigation_files, read_range_file
from eskf_ros.gnss.ranges import Status
from eskf_ros.gnss.rinex import RinexError
from eskf_ros.gnss.signals import SPEED_OF_LIGHT, Gnss
from eskf_ros.inputs.ranges_command import main
from eskf_ros.inputs.rinex_as_messages import EPHEMERIDES_PER_MESSAGE, RangesError, merged, read_beside
from eskf_ros.simulate import constellation
from eskf_ros.simulate.main import main as simulate_main
from eskf_ros.simulate.range_receiver import RangeMeasurements, RangeReceiver
from eskf_ros.simulate.scenario import START_STAMP, simulate
from support.gnss_observation_text import observation_text

SKY_FILE = Path(__file__).resolve().parents[2] / "bags" / "sky.nav"
CLOCK = {"clock_bias": 1e-4, "clock_drift": 0.0, "clock_drift_noise": 0.0, "clock_noise": 0.0}
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 30 s without ranges, and beside it those of 20 s before to 10 s after its end."""
    folder = tmp_path_factory.mktemp("beside")
    command = ["tunnel_drive", "--set", "start=60", "--set", "stop=90", "--quiet"]
    assert simulate_main([*command, "--out", str(folder / "plain.mcap")]) == 0
    measured = measurements()
    epochs = [
        (int(week), float(second), measured.epoch(k))
        for k, (week, second) in enumerate(zip(measured.week, measured.seconds))
    ]
    (folder / "rover.obs").write_text(observation_text(epochs, (4.2e6, 8.5e5, 4.7e6)), encoding="ascii")
    return folder


def measurements() -> RangeMeasurements:
    recording = simulate("tunnel_drive", 2, start=40.0, stop=100.0, outages=(), ranges=RangeReceiver(**CLOCK))
    assert recording.ranges is not None
    return recording.ranges


def test_epochs_are_on_the_clock_of_the_recording(folder: Path) -> None:
    measured = measurements()
    for offset in (0.0, 18.0, -3.25):
        file = read_range_file(folder / "rover.obs", offset)
        assert len(file.stamps) == len(measured.stamp)
        # The file knows the receiver's clock only, and that to 0.1 us.
        ahead = file.stamps - measured.stamp - round(offset * 1e9)
        np.testing.assert_allclose(ahead, 1e9 * measured.clock_bias / SPEED_OF_LIGHT, atol=100.0)
    for k in (0, 17, len(measured.stamp) - 1):
        epoch, expected = file.epoch(k), measured.epoch(k)
        assert (epoch.week, epoch.left_out) == (measured.week[k], 0)
        assert epoch.seconds == pytest.approx(measured.seconds[k], abs=1e-7)
        order = np.lexsort([expected["signal"], expected["sv_id"], expected["gnss_id"]])
        for name in ("gnss_id", "sv_id", "signal", "flags"):
            np.testing.assert_array_equal(epoch.ranges[name], expected[name][order])
        for name in ("pseudorange", "doppler", "cn0"):
            np.testing.assert_allclose(epoch.ranges[name], expected[name][order], atol=6e-4)


def test_messages_that_serve_the_time_are_kept(folder: Path) -> None:
    files = read_navigation_files([SKY_FILE, SKY_FILE])
    assert len(files.broadcasts) == 2 * len(constellation.messages())
    assert list(files.klobuchar) == [Gnss.GPS]
    week, toe = constellation.WEEK, constellation.TOE
    assert len(files.serving((week, toe), (week, toe + 60.0))) == len(files.broadcasts)
    # Two hours and a half before, BeiDou and Galileo do not serve yet, nor does GPS; three hours after, GPS no more.
    assert {sent.gnss for sent in files.serving((week, toe - 7000.0), (week, toe - 6000.0))} == {Gnss.GPS}
    assert Gnss.GPS not in {sent.gnss for sent in files.serving((week, toe + 9000.0), (week, toe + 9100.0))}
    assert files.serving((week + 1, 0.0), (week + 1, 60.0)) == []


def ranges_in(reader: BagReader, topics: dict[str, str]) -> tuple[NDArray[np.int64], list[NDArray[np.void]]]:
    """Log times, and the measured signals of each epoch with the ephemerides of the recording."""
    ephemerides, times, epochs = Ephemerides(), [], []
    for batch in reader.batches(topics):
        for topic, part in sorted(batch.items()):
            for time, message in zip(part.log_time.tolist(), part.messages):
                if topic.endswith("ephemerides"):
                    ephemerides.add(read_ephemerides(message["points"]).records)
                    continue
                epoch = read_epoch(message["points"])
                assert time == message["stamp"]
                times.append(time)
                epochs.append(measured_epoch(epoch.ranges, epoch.week, epoch.seconds, ephemerides))
    return np.array(times), epochs


@pytest.mark.parametrize("satellites", [False, True])
def test_a_copy_with_ranges(folder: Path, tmp_path: Path, satellites: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """All that was there is there to the byte; the ranges of its time have come in, and their satellites are found."""
    out = tmp_path / "with.mcap"
    command = [str(folder / "plain.mcap"), "--ranges", str(folder / "rover.obs"), "--nav", str(SKY_FILE)]
    command += ["--out", str(out), "--frame", "antenna"]
    assert main([*command, *(["--satellites"] if satellites else [])]) == 0
    output = capsys.readouterr().out
    assert "epochs outside of the recording left out" in output
    expected = {}
    with open_bag([folder / "plain.mcap"]) as reader:
        for topic, payloads in reader.serialised(reader.topics):
            expected.setdefault(topic, []).append(payloads)
        first, last = reader.start_time, reader.end_time
    with open_bag([out]) as reader:
        copied = {}
        added = {"gnss/ranges"} | (set() if satellites else {"gnss/ephemerides"})
        assert set(reader.topics) == set(expected) | added
        for topic, payloads in reader.serialised(expected):
            copied.setdefault(topic, []).append(payloads)
        for topic, parts in expected.items():
            for name in range(2):
                before, after = (everything(pieces)[name] for pieces in (parts, copied[topic]))
                np.testing.assert_array_equal(before, after)
        times, epochs = ranges_in(reader, dict.fromkeys(added, POINT_CLOUD))
        assert reader.strings[-1] == "antenna"
        assert not reader.warnings
    measured = measurements()
    inside = (measured.stamp >= first - SECOND) & (measured.stamp <= last + SECOND)
    assert len(times) == np.count_nonzero(inside) > 150
    for k, epoch in zip(np.flatnonzero(inside).tolist(), epochs):
        assert len(epoch) == len(measured.epoch(k))
        assert np.isin(epoch["status"], (Status.USABLE, Status.LOW_CN0)).all()


def everything(parts: list) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Times and bytes of messages of equal length, by time."""
    times = np.concatenate([part.log_time for part in parts])
    rows = np.concatenate([rows for part in parts for _, rows in part.groups])
    order = np.argsort(times, kind="stable")
    return times[order], rows[order]


def test_a_copy_of_an_sqlite_recording_with_a_type_nobody_knows(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("float64 x", "my_msgs/msg/Own"))
    sent = []
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        string = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        own = writer.add_connection("/own", "my_msgs/msg/Own", typestore=store)
        for k in range(200):
            time = START_STAMP + (60 + k // 10) * SECOND + k
            text = store.types["std_msgs/msg/String"]("x" * (k % 7))
            sent.append((time, bytes(store.serialize_cdr(text, "std_msgs/msg/String"))))
            writer.write(string, *sent[-1])
            writer.write(own, time, bytes(store.serialize_cdr(store.types["my_msgs/msg/Own"](1.0), "my_msgs/msg/Own")))
    out = tmp_path / "with.mcap"
    command = [str(tmp_path / "bag"), "--ranges", str(folder / "rover.obs"), "--nav", str(SKY_FILE), "--out", str(out)]
    assert main(command) == 0
    assert "topic /own is of type my_msgs/msg/Own, which cannot be copied; left out" in capsys.readouterr().err
    with open_bag([out]) as reader:
        assert set(reader.topics) == {"/chatter", "/gnss/ranges", "/gnss/ephemerides"}
        copied = []
        for _, payloads in reader.serialised(["/chatter"]):
            for positions, rows in payloads.groups:
                times = payloads.log_time if positions is None else payloads.log_time[positions]
                copied += [(time, bytes(row)) for time, row in zip(times.tolist(), rows)]
    assert sorted(copied) == sent


def test_merged_while_reading_as_if_recorded(folder: Path, tmp_path: Path) -> None:
    """The messages beside a recording come in the batches, and in the order, in which those of its copy come."""
    out = tmp_path / "with.mcap"
    files = ["--ranges", str(folder / "rover.obs"), "--nav", str(SKY_FILE)]
    assert main([str(folder / "plain.mcap"), *files, "--out", str(out), "--quiet"]) == 0
    with open_bag([folder / "plain.mcap"]) as reader:
        beside = read_beside(folder / "rover.obs", [SKY_FILE], reader.start_time, reader.end_time)
        extra = {"gnss/ranges": beside.ranges, "gnss/ephemerides": beside.ephemerides}
        found = list(merged(reader.batches({"imu/data": "sensor_msgs/msg/Imu"}), extra))
    previous = -1
    for batch in found:
        assert min(int(part.log_time[0]) for part in batch.values()) > previous
        previous = max(int(part.log_time[-1]) for part in batch.values())
    with open_bag([out]) as reader:
        topics = {"imu/data": "sensor_msgs/msg/Imu", "gnss/ranges": POINT_CLOUD, "gnss/ephemerides": POINT_CLOUD}
        expected = list(reader.batches(topics))
    for topic in topics:
        ours, recorded = ([batch[topic] for batch in batches if topic in batch] for batches in (found, expected))
        for name in ("stamp", "linear_acceleration") if topic == "imu/data" else ("stamp", "points"):
            columns = [[row for part in parts for row in part.messages[name]] for parts in (ours, recorded)]
            assert len(columns[0]) == len(columns[1]) > 0
            assert all(first.tobytes() == second.tobytes() for first, second in zip(*columns))
        times = [np.concatenate([part.log_time for part in parts]).tolist() for parts in (ours, recorded)]
        assert times[0] == times[1]


def test_batches_take_what_is_beside_them_and_the_last_the_rest() -> None:
    def batch(times: list[int]) -> Batch:
        return Batch(np.array(times), cloud_messages(np.array(times), [np.zeros(0, "u1")] * len(times)), ["x"])

    found = list(merged([{"a": batch([5, 9])}, {"a": batch([12])}], {"b": batch([1, 9, 10, 12, 13, 99])}))
    assert [{topic: part.log_time.tolist() for topic, part in one.items()} for one in found] == [
        {"a": [5, 9], "b": [1, 9]},
        {"a": [12], "b": [10, 12]},
        {"b": [13, 99]},
    ]
    assert [list(one) for one in merged([{"a": batch([5])}], {"b": batch([2])})] == [["a", "b"]]


def test_many_ephemerides_are_sent_in_parts(folder: Path) -> None:
    first = START_STAMP + 60 * SECOND
    beside = read_beside(folder / "rover.obs", [SKY_FILE] * 14, first, first + 20 * SECOND)
    counts = [len(points) for points in beside.ephemerides.messages["points"]]
    assert counts == [EPHEMERIDES_PER_MESSAGE] * 2 + [14 * 79 - 2 * EPHEMERIDES_PER_MESSAGE]
    assert (beside.ephemerides.log_time < beside.ranges.log_time[0]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"--ranges": "{nav}"}, "RINEX type 'N' is not observation data"),
        ({"--nav": "{obs}"}, "RINEX type 'O' is not navigation data"),
        ({"--nav": "nowhere.nav"}, "nowhere.nav: No such file"),
        ({"--clock-offset": "1000"}, "are not of the time of the recording"),
        ({"--out": "{bag}"}, "--out is a new file"),
        ({"--out": "nowhere/x.mcap"}, "there is no folder nowhere"),
    ],
)
def test_mistakes_are_named(
    folder: Path, tmp_path: Path, change: dict[str, str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"nav": SKY_FILE, "obs": folder / "rover.obs", "bag": folder / "plain.mcap"}
    options = {"--ranges": "{obs}", "--nav": "{nav}", "--out": str(tmp_path / "x.mcap"), **change}
    command = [str(names["bag"]), *itertools.chain(*((key, value.format(**names)) for key, value in options.items()))]
    before = names["bag"].read_bytes()
    assert main(command) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert names["bag"].read_bytes() == before
    assert list(tmp_path.iterdir()) == []


def test_ranges_are_not_written_twice(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = ["--ranges", str(folder / "rover.obs"), "--nav", str(SKY_FILE), "--quiet"]
    assert main([str(folder / "plain.mcap"), *files, "--out", str(tmp_path / "a.mcap")]) == 0
    assert main([str(tmp_path / "a.mcap"), *files, "--out", str(tmp_path / "b.mcap")]) == 2
    assert "gnss/ranges is in the recording already" in capsys.readouterr().err


def test_the_offset_that_is_missing_is_suggested(folder: Path) -> None:
    file = read_range_file(folder / "rover.obs")
    first = int(file.stamps[0]) + 5000 * SECOND
    with pytest.raises(RangesError, match=r"2025-06-01T08:00:40 to .*--clock-offset \(first to first: 5000 s\)"):
        read_beside(folder / "rover.obs", [SKY_FILE], first, first + 60 * SECOND)
    beside = read_beside(folder / "rover.obs", [SKY_FILE], first, first + 60 * SECOND, 5000.0)
    assert len(beside.ranges.log_time) == len(file.stamps)
    assert beside.outside == 0


def test_signals_without_number_and_satellites_without_ephemeris(folder: Path, tmp_path: Path) -> None:
    text = (folder / "rover.obs").read_text("ascii").replace("C1C D1C S1C", "C1W D1W S1W", 1)
    (tmp_path / "p.obs").write_text(text, encoding="ascii")
    old = tmp_path / "old.nav"
    old.write_text(SKY_FILE.read_text("ascii").replace("2025 06 01", "2024 06 01"), encoding="ascii")
    first = START_STAMP + 50 * SECOND
    beside = read_beside(tmp_path / "p.obs", [old], first, first + 20 * SECOND)
    assert any("signals that the topic has no number for" in note for note in beside.notes)
    assert any("no ephemeris serves the time of the recording" in note for note in beside.notes)
    assert len(beside.ephemerides.log_time) == 0
    assert all(Gnss.GPS not in points["gnss_id"] for points in beside.ranges.messages["points"])
    with pytest.raises(RinexError):
        read_beside(old, [SKY_FILE], first, first)
    assert len(write_epoch(measurements().epoch(0), 1, 2.0)) > 0
