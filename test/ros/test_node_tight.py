"""The node in mode tight, without a network: a minute of a simulated drive with ranges, beside truth and replay."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from test_node_inside import Drive, Inside

from eskf_ros.bags import POINT_CLOUD, StringTable, cloud_messages, decode, encode, open_bag
from eskf_ros.filter.state.enums import Verdict
from eskf_ros.filter.tight.signal import satellite_of
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.replay.main import main as replay
from eskf_ros.replay.summary import final_result
from eskf_ros.simulate.main import main as simulate
from support.robot import CONFIG, stamp_of
from support.ros_process import needs_ros

SECOND = 1_000_000_000
TYPES = {"imu/data": "sensor_msgs/msg/Imu", "gnss/ranges": POINT_CLOUD, "gnss/ephemerides": POINT_CLOUD}
ODOMETRY = "nav_msgs/msg/Odometry"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tight") / "drive.mcap"
    options = ["--set=start=12", "--set=stop=72", "--set=imu_rate=100", "--sensor", "ranges", "--quiet"]
    assert simulate(["drive", "--seed", "4", *options, "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def drive(bag: Path) -> Drive:
    with open_bag([bag]) as reader:
        messages = [
            (int(time), topic, bytes(row))
            for topic, payloads in reader.serialised(TYPES)
            for positions, rows in payloads.groups
            for time, row in zip(payloads.log_time if positions is None else payloads.log_time[positions], rows)
        ]
    return sorted(messages)


@pytest.fixture
def make() -> Iterator[Callable[..., Inside]]:
    made: list[Inside] = []

    def make_one(*arguments: str) -> Inside:
        made.append(Inside("-p", "mode:=tight", *arguments))
        for publisher in (made[-1].node._solutions, made[-1].node._aids):
            publisher.get_subscription_count = lambda: 1
        made[-1].report()
        return made[-1]

    yield make_one
    for inside in made:
        inside.close()


@needs_ros
def test_a_minute_in_mode_tight_ends_as_the_replay_does(bag: Path, drive: Drive, make: Callable[..., Inside]) -> None:
    inside = make()
    inside.play(drive)
    assert inside.report().message == "GOOD"
    command = [str(bag), "--config", str(CONFIG), "--mode", "tight", "--out", str(bag.parent), "--quiet"]
    assert replay(command) == 0
    result = json.loads((bag.parent / "drive_eskf" / "summary.json").read_text())
    final = final_result(inside.node.navigator.odometry[0], inside.node.navigator.datum)
    assert json.loads(json.dumps(final)) == result["final"]
    assert result["ranges"]["signals"] == {"usable": int(inside.values["signals usable"])}


@needs_ros
def test_what_is_published_of_ranges(bag: Path, drive: Drive, make: Callable[..., Inside]) -> None:
    """The ephemerides come on their topic; solutions and signals are told to who listens, the clock to everybody."""
    inside = make()
    inside.play(drive[: len(drive) // 2])
    inside.report()
    assert inside.node.parameters.ranges.rinex_nav_files == ""
    assert int(inside.values["signals usable"]) > 3000
    assert "signals no_ephemeris" not in inside.values

    with open_bag([bag]) as reader:
        truth = np.concatenate([batch["truth"].messages for batch in reader.batches({"truth": ODOMETRY})])
    solutions = inside.published["/gnss/point_solution"]
    assert len(solutions) == int(inside.values["point solutions"]) > 140
    arm = Rotation.from_quat(truth["orientation"]).apply(inside.node.parameters.gnss.lever_arm)
    errors, nees = [], []
    for fix in solutions:
        nearest = np.abs(truth["stamp"] - stamp_of(fix)).argmin()
        frame = MapFrame((fix.latitude, fix.longitude, fix.altitude))
        off = truth["position"][nearest] + arm[nearest] - frame.origin_ecef
        errors.append(frame.rotation_map_to_ecef.T @ off)
        nees.append(errors[-1] @ np.linalg.solve(fix.position_covariance.reshape(3, 3), errors[-1]))
        assert fix.header.frame_id == "gps"
    # Of one epoch alone, on one frequency: the height is good to 4 m, so that a few are off by more than 10 m.
    assert np.percentile(np.linalg.norm(errors, axis=1), 95.0) < 10.0
    assert np.linalg.norm(np.array(errors)[:, :2], axis=1).max() < 5.0
    assert max(nees) < chi2.ppf(0.999, 3)

    told = [status for message in inside.published["/eskf/aids"] for status in message.status]
    assert {status.name for status in told} == {"pseudorange", "range_rate"}
    signals = {pair.value for status in told for pair in status.values if pair.key == "signal"}
    assert not any(pair.key == "receiver" for status in told for pair in status.values)
    assert {name[0] for name in signals} == set("GEC")
    assert all(re.fullmatch(r"[GEC]\d\d \d\w", name) for name in signals)

    state, values = inside.node.navigator.clock, inside.values
    assert [float(values[f"clock {name}"]) for name in ("bias (m)", "drift (m/s)")] == pytest.approx(state, abs=0.01)
    assert {key for key in values if key.startswith("clock offset of")} == {
        "clock offset of galileo (m)",
        "clock offset of beidou-3 (m)",
    }
    assert (values["clock jumps (ms)"], values["range faults"]) == ("0", "0")
    assert values["position by pseudoranges"] == "FUSING"
    assert not {"fixes", "velocities"} & set(values)


@needs_ros
@pytest.mark.parametrize("count", [1, 3])
def test_with_less_than_four_satellites_the_node_says_what_holds_the_position(
    drive: Drive, make: Callable[..., Inside], count: int
) -> None:
    inside = make()
    lost = drive[0][0] + 30 * SECOND
    inside.play([message for message in drive if message[0] < lost])
    assert inside.report().message == "GOOD"
    fused = inside.node.navigator.latest_epoch
    kept = [satellite_of.py_func(source) for source in fused["source"][fused["verdict"] == Verdict.FUSED].tolist()]

    def few(topic: str, data: bytes) -> bytes:
        return with_satellites(data, kept[:count]) if topic == "gnss/ranges" else data

    inside.play([(t, topic, few(topic, data)) for t, topic, data in drive if lost <= t < lost + 4 * SECOND])
    holds = (
        "1 satellite is fused: it and the IMU hold" if count == 1 else "3 satellites are fused: they and the IMU hold"
    )
    assert inside.report().message == f"COASTING; {holds} the position"
    inside.play(
        [(t, topic, few(topic, data)) for t, topic, data in drive if lost + 4 * SECOND <= t < lost + 5 * SECOND]
    )
    inside.play([m for m in drive if lost + 5 * SECOND <= m[0] < lost + 9 * SECOND and m[1] == "imu/data"])
    assert inside.report().message.startswith("COASTING; no message for 4 s on /gnss/ranges; 0 publishers")


def with_satellites(data: bytes, kept: list[tuple[int, int]]) -> bytes:
    """The message with the signals of these satellites only."""
    strings = StringTable()
    messages, _ = decode(POINT_CLOUD, np.frombuffer(data, np.uint8)[None], strings)
    points = messages["points"][0]
    chosen = [pair in kept for pair in zip(points["gnss_id"].tolist(), points["sv_id"].tolist())]
    return bytes(encode(POINT_CLOUD, cloud_messages(messages["stamp"], [points[chosen]]), strings.values)[0])
