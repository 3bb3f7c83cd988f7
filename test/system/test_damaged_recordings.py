"""What a damaged recording may cost: one test for each kind of damage that was once missed, and a part of the campaign.

The campaign itself is `benchmark/damaged_recordings.py`.
"""

from __future__ import annotations

import sqlite3
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from damaged_recordings import FAILURES, run, whole_results
from eskf_ros.bags import BagError, open_bag
from eskf_ros.gnss.cloud import number_column
from eskf_ros.replay.main import main as eskf_replay
from support.damage import Files, recordings, write

IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
TOPICS = {"imu/data": IMU, "gps/fix": FIX}
WHOLE = {"imu/data": 500, "gps/fix": 25}


@pytest.fixture(scope="module")
def sound() -> dict[str, Files]:
    return recordings()


def read(recording: Path) -> tuple[dict[str, int], list[str]]:
    """Messages by topic that are read, and the warnings, each of which names the recording."""
    with open_bag([recording]) as reader:
        counts = dict.fromkeys(TOPICS, 0)
        for batch in reader.batches(TOPICS):
            for topic, part in batch.items():
                counts[topic] += len(part.log_time)
        assert all(str(recording) in line and "\n" not in line for line in reader.warnings)
        return counts, reader.warnings


def changed(recording: Path, statement: str, *values: Any) -> Path:
    """Change the database in place."""
    database = recording if recording.is_file() else next(recording.glob("*.db3"))
    connection = sqlite3.connect(database)
    connection.execute(statement, values)
    connection.commit()
    connection.close()
    return recording


@pytest.mark.parametrize("kind", ["db3", "db3 directory"])
@pytest.mark.parametrize(
    ("column", "value"),
    [(c, v) for c in ("timestamp", "topic_id") for v in (b"\xff\xfe", "text", float("inf"), 1.5)] + [("data", "text")],
)
def test_a_database_with_other_values_where_its_numbers_belong(
    tmp_path: Path, sound: dict[str, Files], kind: str, column: str, value: Any
) -> None:
    bag = write(sound[kind], tmp_path)
    changed(bag, f"UPDATE messages SET {column} = ? WHERE id BETWEEN 101 AND 150", value)
    counts, said = read(bag)
    assert 440 < counts["imu/data"] < 480
    of_metadata = [line for line in said if "metadata.yaml" in line]
    assert len(of_metadata) == (kind == "db3 directory")
    assert said[len(of_metadata) :] == [
        f"{tmp_path / 'bag.db3'}: 50 of 655 messages have no topic, time or content; skipped"
    ]


def test_a_topic_whose_name_is_no_text(tmp_path: Path, sound: dict[str, Files]) -> None:
    bag = changed(write(sound["db3"], tmp_path), "UPDATE topics SET name = ? WHERE name = 'gps/vel'", b"\xff")
    counts, said = read(bag)
    assert counts == WHOLE
    assert "1 of 6 topics cannot be read; skipped" in said[0]


def test_rows_that_are_no_longer_in_a_database(tmp_path: Path, sound: dict[str, Files]) -> None:
    counts, said = read(changed(write(sound["db3"], tmp_path), "DELETE FROM messages WHERE id BETWEEN 101 AND 150"))
    assert counts["imu/data"] < 480
    assert said == [f"{tmp_path / 'bag.db3'}: 50 messages between the 605 that are there are missing"]


@pytest.mark.parametrize("value", [b"\xff\xfe", float("inf"), "text"])
def test_compressed_messages_with_other_values_where_times_belong(
    tmp_path: Path, sound: dict[str, Files], value: Any
) -> None:
    bag = write(sound["db3 compressed messages"], tmp_path)
    counts, said = read(changed(bag, "UPDATE messages SET timestamp = ? WHERE id BETWEEN 101 AND 150", value))
    assert 440 < counts["imu/data"] < 480
    assert f"{counts['imu/data']} of 500 of imu/data" in said[0]


def test_compressed_messages_of_a_topic_without_name(tmp_path: Path, sound: dict[str, Files]) -> None:
    files = dict(sound["db3 compressed messages"])
    files["metadata.yaml"] = files["metadata.yaml"].replace(b"name: gps/vel", b"name: null")
    with pytest.raises(BagError, match=r"\A[^\n]+\Z"):
        read(write(files, tmp_path))


def test_a_damaged_record_between_whole_ones(tmp_path: Path, sound: dict[str, Files]) -> None:
    # Without checksums only the records themselves tell: an impossible length in the midst of a chunk.
    content = bytearray(sound["mcap without checksums"]["bag.mcap"])
    places = [place for place in range(8, 60_000) if content[place : place + 9] == struct.pack("<BQ", 5, 346)]
    content[places[60] + 4] = 0xFF
    counts, said = read(write({"bag.mcap": bytes(content)}, tmp_path))
    assert 400 < counts["imu/data"] < 500
    assert f"{counts['imu/data']} of 500 of imu/data" in said[0]
    assert "1 damaged chunk skipped" in said[1]
    assert "those before it are used" in said[1]


def test_messages_of_a_channel_that_is_not_described(tmp_path: Path, sound: dict[str, Files]) -> None:
    content = bytearray(sound["mcap without chunks"]["bag.mcap"])
    places = [place for place in range(8, 60_000) if content[place : place + 9] == struct.pack("<BQ", 5, 346)]
    content[places[10] + 9] = 99
    counts, said = read(write({"bag.mcap": bytes(content)}, tmp_path))
    assert counts == WHOLE | {"imu/data": 499}
    assert any("1 messages belong to no known topic" in line for line in said)
    assert any("499 of 500 of imu/data" in line for line in said)


@pytest.mark.parametrize(
    ("was", "becomes"),
    [
        (b"  relative_file_paths:\n  - bag.db3", b"  relative_file_paths: text"),
        (b"  compression_mode: ''", b"  compression_mode: []"),
        (b"  - message_count: 500", b"  - message_count: 480"),
        (b"  topics_with_message_count:", b"  topics_with_message_count: {}\n  other:"),
    ],
)
def test_metadata_with_other_values(tmp_path: Path, sound: dict[str, Files], was: bytes, becomes: bytes) -> None:
    files = dict(sound["db3 directory"])
    assert was in files["metadata.yaml"]
    files["metadata.yaml"] = files["metadata.yaml"].replace(was, becomes)
    counts, said = read(write(files, tmp_path))
    assert counts == WHOLE
    expected = [f"{tmp_path / 'metadata.yaml'}: messages found, of those it states: 500 of 480 of imu/data"]
    assert said == (expected if b"480" in becomes else [])


def test_a_summary_with_a_wrong_checksum_is_told(tmp_path: Path, sound: dict[str, Files]) -> None:
    content = bytearray(sound["mcap zstd"]["bag.mcap"])
    content[-200] ^= 1
    counts, said = read(write({"bag.mcap": bytes(content)}, tmp_path))
    assert counts == WHOLE
    assert "summary at its end is damaged" in said[0]


def test_a_satellite_with_a_signalling_nan() -> None:
    points = np.zeros(3, [("pseudorange_std", "<f4")])
    points["pseudorange_std"].view("<u4")[1] = 0x7F80_0001
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        column = number_column(points, "pseudorange_std")
    assert np.isnan(column[1])
    assert column[[0, 2]].tolist() == [0.0, 0.0]


def test_a_cut_file_in_a_folder_of_recordings_is_said(
    tmp_path: Path, sound: dict[str, Files], capsys: pytest.CaptureFixture[str]
) -> None:
    files = dict(sound["two mcap files"])
    files["a.mcap"] = files["a.mcap"][:20_000]
    recording = tmp_path / "drives"
    recording.mkdir()
    assert eskf_replay([str(write(files, recording)), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    (of_a,) = [line for line in capsys.readouterr().err.splitlines() if "a.mcap" in line]
    assert of_a.startswith("eskf_replay: warning: ")
    assert "cut off at byte" in of_a
    assert "the messages before it are used" in of_a


@pytest.mark.slow
def test_a_part_of_the_campaign(sound: dict[str, Files]) -> None:
    whole = whole_results(sound)
    runs = [run(whole, sound, None, seed) for seed in range(100_000, 100_060)]
    assert [run for run in runs if run[3] in FAILURES] == []
