"""eskf_replay end to end: every figure and file against what the test works out on its own from the recording."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2

from eskf_ros.bags import BagWriter, open_bag
from eskf_ros.compiled import COMPILED
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Status
from eskf_ros.parameters.docs import to_yaml
from eskf_ros.parameters.mapping import from_mapping, to_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.replay.main import main
from eskf_ros.replay.tum_writer import tum_text

Array = NDArray[np.float64]

CHECKOUT = Path(__file__).resolve().parents[2]
BAG = CHECKOUT / "bags" / "tunnel_drive.mcap"
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
LEVER_ARM = np.array([0.8, -0.2, 1.4])
TYPES = {
    "imu/data": "sensor_msgs/msg/Imu",
    "gps/fix": "sensor_msgs/msg/NavSatFix",
    "gps/vel": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "truth": "nav_msgs/msg/Odometry",
}
FILES = ["aids.csv", "details.npz", "odometry.mcap", "summary.json", "trajectory.tum"]
OUTAGE = (80.0, 20.0)


def read_topics(bag: Path, types: dict[str, str]) -> dict[str, tuple[NDArray[np.int64], NDArray[Any]]]:
    """Log times and messages of whole topics."""
    with open_bag([bag]) as reader:
        batches = list(reader.batches(types))
    return {
        topic: (
            np.concatenate([batch[topic].log_time for batch in batches if topic in batch]),
            np.concatenate([batch[topic].messages for batch in batches if topic in batch]),
        )
        for topic in types
    }


@dataclass
class Results:
    """One run of the command and the files it left."""

    folder: Path

    @property
    def summary(self) -> dict[str, Any]:
        return json.loads((self.folder / "summary.json").read_text())  # type: ignore[no-any-return]

    @property
    def aids(self) -> list[dict[str, str]]:
        with (self.folder / "aids.csv").open() as file:
            return list(csv.DictReader(file))

    @property
    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps in ns, exact, and the seven other columns."""
        lines = [line.split(" ") for line in (self.folder / "trajectory.tum").read_text().splitlines()]
        stamps = [int(line[0].replace(".", "")) for line in lines]
        return np.array(stamps), np.array([line[1:] for line in lines], np.float64)

    @property
    def odometry(self) -> NDArray[Any]:
        return read_topics(self.folder / "odometry.mcap", {"/odometry/global": TYPES["truth"]})["/odometry/global"][1]


def run(out: Path, *arguments: str, bag: Path = BAG) -> Results:
    assert main([str(bag), "--config", str(CONFIG), "--out", str(out), "--quiet", *arguments]) == 0
    return Results(out / f"{bag.stem}_eskf")


@pytest.fixture(scope="module")
def recording() -> dict[str, tuple[NDArray[np.int64], NDArray[Any]]]:
    return read_topics(BAG, TYPES)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return run(tmp_path_factory.mktemp("out"), "--truth", "truth", "--outage", f"{OUTAGE[0]}:{OUTAGE[1]}")


def in_outage(stamps: Any, first_stamp: int) -> Any:
    seconds = (stamps - first_stamp) / 1e9
    return (seconds >= OUTAGE[0]) & (seconds < OUTAGE[0] + OUTAGE[1])


@pytest.fixture(scope="module")
def reference(recording: Any) -> tuple[Navigator, NDArray[Any], NDArray[Any]]:
    """The navigator fed one message after the other in recorded order; its rows at 50 Hz and its records."""
    navigator = Navigator(load(CONFIG), output_rate=50.0)
    times, messages, first_stamp = {}, {}, int(recording["imu/data"][1]["stamp"][0])
    for topic in ("gps/fix", "gps/vel", "imu/data"):
        times[topic], messages[topic] = recording[topic]
    merged = sorted((int(t), topic, i) for topic, log in times.items() for i, t in enumerate(log))
    rows, records = [], []
    for log_time, topic, i in merged:
        m = messages[topic][i]
        if topic == "imu/data":
            imu = messages[topic][i : i + 1]
            produced = navigator.push_imu(imu["stamp"], imu["linear_acceleration"], imu["angular_velocity"])
            rows += [produced] if len(produced) else []
        elif in_outage(m["stamp"], first_stamp):
            continue
        elif topic == "gps/fix":
            covariance, kind = m["position_covariance"], int(m["position_covariance_type"])
            position = (float(m["latitude"]), float(m["longitude"]), float(m["altitude"]))
            navigator.push_gnss_position(int(m["stamp"]), *position, covariance, kind, int(m["status"]), log_time)
        else:
            covariance = m["twist_covariance"].reshape(6, 6)[:3, :3].ravel()
            navigator.push_gnss_velocity(int(m["stamp"]), m["linear_velocity"], covariance, log_time)
        if i % 5000 == 0:
            records.append(navigator.take_records())
    records.append(navigator.finish())
    return navigator, np.concatenate(rows), np.concatenate(records)


def test_the_result_folder_holds_the_four_files_and_nothing_else(results: Results) -> None:
    assert sorted(path.name for path in results.folder.iterdir()) == FILES


def test_trajectory_is_what_the_navigator_gave(results: Results, reference: Any) -> None:
    _, rows, _ = reference
    rows = rows[rows["position_known"]]
    stamps, numbers = results.trajectory
    assert np.array_equal(stamps, rows["stamp"])
    assert np.allclose(numbers[:, :3], rows["position_map"], rtol=0.0, atol=5.1e-7)
    assert np.allclose(numbers[:, 3:], rows["attitude_body_to_map"][:, [1, 2, 3, 0]], rtol=0.0, atol=5.1e-10)


def test_odometry_mcap_is_what_the_navigator_gave(results: Results, reference: Any) -> None:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    navigator, rows, _ = reference
    rows = rows[rows["position_known"]]
    store = get_typestore(Stores.ROS2_JAZZY)
    fixes = []
    with AnyReader([results.folder / "odometry.mcap"], default_typestore=store) as reader:
        own = [c for c in reader.connections if c.topic in ("/odometry/global", "/gps/filtered")]
        assert [c.msgtype for c in own] == [TYPES["truth"], TYPES["gps/fix"]]
        messages = []
        for connection, log_time, data in reader.messages(own):
            message: Any = reader.deserialize(data, connection.msgtype)
            assert log_time == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            (messages if connection.topic == "/odometry/global" else fixes).append((log_time, message))
    assert [stamp for stamp, _ in messages] == rows["stamp"].tolist()
    for (_, m), row in list(zip(messages, rows))[::97]:
        pose, twist = m.pose.pose, m.twist.twist
        assert (m.header.frame_id, m.child_frame_id) == ("map", "base_link")
        assert (pose.position.x, pose.position.y, pose.position.z) == tuple(row["position_map"])
        q = pose.orientation
        assert (q.w, q.x, q.y, q.z) == tuple(row["attitude_body_to_map"])
        assert (twist.linear.x, twist.linear.y, twist.linear.z) == tuple(row["velocity_body"])
        assert (twist.angular.x, twist.angular.y, twist.angular.z) == tuple(row["angular_rate_body"])
        assert np.array_equal(m.pose.covariance, row["pose_covariance"].ravel())
        assert np.array_equal(m.twist.covariance, row["twist_covariance"].ravel())
    # About once a second, where base_link is.
    assert abs(len(fixes) - (rows["stamp"][-1] - rows["stamp"][0]) * 1e-9) <= 2
    row_of = {int(row["stamp"]): row for row in rows}
    for stamp, fix in fixes[::20]:
        enu = pymap3d.geodetic2enu(fix.latitude, fix.longitude, fix.altitude, *navigator.datum)
        assert np.allclose(enu, row_of[stamp]["position_map"], atol=1e-6)


def test_aids_csv_and_its_counts(results: Results, reference: Any) -> None:
    _, _, records = reference
    records = records[np.lexsort((records["stream"], records["stamp"]))]
    aids = results.aids
    assert [int(aid["stamp"].replace(".", "")) for aid in aids] == records["stamp"].tolist()
    assert [int(aid["arrival"].replace(".", "")) for aid in aids] == records["arrival"].tolist()
    for name in ("nis", "innovation_0", "innovation_1", "innovation_2"):
        column = [float(aid[name]) for aid in aids]
        expected = records["nis"] if name == "nis" else records["innovation"][:, int(name[-1])]
        assert np.array_equal(column, expected, equal_nan=True)
    for name, found in results.summary["aids"].items():
        own = [aid for aid in aids if aid["aid"] == name]
        verdicts = Counter(aid["verdict"] for aid in own)
        nis = np.array([float(aid["nis"]) for aid in own])
        dof = np.array([int(aid["dof"]) for aid in own])
        nis, dof = nis[np.isfinite(nis)], dof[np.isfinite(nis)]
        assert found["offered"] == len(own)
        fused = verdicts["fused"] + verdicts["weighed_down"]
        assert found["fused"] == fused > (5 if name in ("zupt", "zaru") else 700)
        assert found["late"] == verdicts["outside_history"] == 0
        assert found["rejected"] == len(own) - fused - verdicts["waiting"]
        assert found["verdicts"] == verdicts
        assert found["nis_mean"] == pytest.approx(nis.mean(), rel=1e-12)
        assert found["nis_in_95"] == pytest.approx(np.mean(nis <= chi2.ppf(0.95, dof)), abs=1e-12)


def test_an_outage_withholds_exactly_the_messages_stamped_within(results: Results, recording: Any) -> None:
    first_stamp = int(recording["imu/data"][1]["stamp"][0])
    for topic, name in (("gps/fix", "gnss_position"), ("gps/vel", "gnss_velocity")):
        stamps = recording[topic][1]["stamp"]
        outside = stamps[~in_outage(stamps, first_stamp)]
        offered = [int(aid["stamp"].replace(".", "")) for aid in results.aids if aid["aid"] == name]
        assert offered == outside.tolist()
        assert results.summary["aids"][name]["withheld"] == len(stamps) - len(outside) == 100


def test_summary_says_where_it_ended(results: Results, reference: Any, recording: Any) -> None:
    navigator, _, _ = reference
    row, summary = navigator.odometry[0], results.summary
    stamps = recording["imu/data"][1]["stamp"]
    final = summary["final"]
    assert summary["imu_count"] == len(stamps)
    assert summary["duration_s"] == pytest.approx((stamps[-1] - stamps[0]) * 1e-9, abs=1e-9)
    assert summary["realtime_factor"] == pytest.approx(summary["duration_s"] / summary["wall_s"])
    assert summary["datum"] == list(navigator.datum)
    assert final["stamp"] == stamps[-1]
    assert final["status"] == navigator.status.name
    assert final["position"] == row["position_map"].tolist()
    assert final["velocity"] == row["velocity_map"].tolist()
    assert final["accel_bias"] == row["accel_bias"].tolist()
    assert final["gyro_bias"] == row["gyro_bias"].tolist()
    assert np.allclose(pymap3d.geodetic2enu(*final["lla"], *navigator.datum), final["position"], atol=1e-6)
    # The map is level at the datum; 1.5 km from it the local axes differ by 2e-4 rad.
    w, x, y, z = row["attitude_body_to_map"]
    expected = Rotation.from_quat([x, y, z, w]).as_euler("xyz", degrees=True)
    assert np.allclose(final["rpy_deg"], expected, atol=0.03)


@dataclass
class Compared:
    stamps: NDArray[np.int64]
    horizontal: Array
    vertical: Array
    speed: Array
    heading_deg: Array
    nees_position: Array
    nees_attitude: Array


@pytest.fixture(scope="module")
def compared(results: Results, recording: Any) -> Compared:
    """The errors worked out from the result files and the truth topic, by other means than the command uses."""
    odometry, truth = results.odometry, recording["truth"][1]
    stamps = odometry["stamp"]
    truth = truth[(truth["stamp"] >= stamps[0]) & (truth["stamp"] <= stamps[-1])]
    seconds, at = (stamps - stamps[0]) * 1e-9, (truth["stamp"] - stamps[0]) * 1e-9

    def interpolated(values: Array) -> Array:
        columns = values.reshape(len(values), -1).T
        return np.stack([np.interp(at, seconds, column) for column in columns], 1)

    latitude, longitude, altitude = results.summary["datum"]
    east, north, up = pymap3d.ecef2enu(*truth["position"].T, latitude, longitude, altitude)
    error = interpolated(odometry["position"]) - np.stack([east, north, up], 1)
    to_ecef = np.stack(pymap3d.enu2uvw(*np.eye(3), latitude, longitude), 0)
    true_attitude = Rotation.from_matrix(to_ecef.T) * Rotation.from_quat(truth["orientation"])
    attitude = Slerp(seconds, Rotation.from_quat(odometry["orientation"]))(at)
    heading = attitude.as_euler("ZYX")[:, 0] - true_attitude.as_euler("ZYX")[:, 0]
    covariance = interpolated(odometry["pose_covariance"]).reshape(-1, 6, 6)
    rotation_error = (true_attitude * attitude.inv()).as_rotvec()
    speed = np.linalg.norm(interpolated(odometry["linear_velocity"]), axis=1)
    return Compared(
        truth["stamp"],
        np.hypot(error[:, 0], error[:, 1]),
        np.abs(error[:, 2]),
        np.abs(speed - np.linalg.norm(truth["linear_velocity"], axis=1)),
        np.abs(np.degrees((heading + math.pi) % (2.0 * math.pi) - math.pi)),
        np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance[:, :3, :3]), error),
        np.einsum("ni,nij,nj->n", rotation_error, np.linalg.inv(covariance[:, 3:, 3:]), rotation_error),
    )


@pytest.mark.parametrize("name", ["horizontal", "vertical", "speed", "heading_deg"])
def test_errors_against_truth(results: Results, compared: Compared, name: str) -> None:
    values, found = getattr(compared, name), results.summary["error"][name]
    if name == "heading_deg":
        # The command leaves out what comes before the heading is known: the vehicle stands still then.
        values = values[-results.summary["truth"]["heading_compared"] :]
    # The test subtracts in the map, not in the local axes, and interpolates body velocities: 1 mm, 1 mm/s.
    assert found["rms"] == pytest.approx(math.sqrt(np.mean(values**2)), abs=1e-3)
    assert found["p50"] == pytest.approx(np.percentile(values, 50), abs=1e-3)
    assert found["p95"] == pytest.approx(np.percentile(values, 95), abs=1e-3)
    assert found["max"] == pytest.approx(values.max(), abs=2e-3)


def test_consistency_against_truth(results: Results, compared: Compared) -> None:
    nees = results.summary["nees"]
    known = results.summary["truth"]["heading_compared"]
    for name, values in (("position", compared.nees_position), ("attitude", compared.nees_attitude[-known:])):
        assert nees[name]["mean"] == pytest.approx(values.mean(), rel=1e-3)
        assert nees[name]["in_95"] == pytest.approx(np.mean(values <= chi2.ppf(0.95, 3)), abs=1e-3)


def test_outage_tells_the_error_at_its_end_and_the_way_driven(
    results: Results, compared: Compared, recording: Any
) -> None:
    (outage,) = results.summary["outages"]
    first_stamp = int(recording["imu/data"][1]["stamp"][0])
    end = first_stamp + round(sum(OUTAGE) * 1e9)
    last = np.flatnonzero(compared.stamps <= end)[-1]
    assert (outage["start"], outage["length"]) == OUTAGE
    assert outage["compared_stamp"] == compared.stamps[last]
    for name in ("horizontal", "vertical", "heading_deg"):
        assert outage[name] == pytest.approx(getattr(compared, name)[last], abs=1e-3)
    truth = recording["truth"][1]
    speed = np.linalg.norm(truth["linear_velocity"][in_outage(truth["stamp"], first_stamp)], axis=1)
    assert outage["distance"] == pytest.approx(speed.mean() * OUTAGE[1], rel=0.03)


def test_evo_reads_the_trajectory(results: Results) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    trajectory = file_interface.read_tum_trajectory_file(results.folder / "trajectory.tum")
    valid, details = trajectory.check()
    assert valid, details
    assert trajectory.num_poses == len(results.trajectory[0])


def test_stamp_order_gives_the_same_final_state_and_records(tmp_path: Path) -> None:
    by_log, by_stamp = run(tmp_path / "log"), run(tmp_path / "stamp", "--order", "stamp")
    assert by_stamp.summary["final"] == by_log.summary["final"]
    assert by_stamp.summary["aids"] == by_log.summary["aids"]
    assert [{**aid, "arrival": ""} for aid in by_stamp.aids] == [{**aid, "arrival": ""} for aid in by_log.aids]
    # The fixes are 80 to 200 ms late: in log order the state published in between does not know them yet.
    assert not np.array_equal(by_stamp.trajectory[1], by_log.trajectory[1])


def messages_of(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Log time and bytes of all messages by topic."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    found: dict[str, list[tuple[int, bytes]]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, log_time, data in reader.messages():
            found.setdefault(connection.topic, []).append((log_time, bytes(data)))
    return found


def test_output_rate(tmp_path: Path, recording: Any) -> None:
    everything = run(tmp_path / "all", "--output-rate", "0")
    slow = run(tmp_path / "slow", "--output-rate", "8")
    stamps, numbers = everything.trajectory
    imu_stamps = recording["imu/data"][1]["stamp"]
    assert np.array_equal(stamps, imu_stamps[imu_stamps >= stamps[0]])
    interval = 125_000_000
    on_grid = np.flatnonzero(stamps[1:] // interval != stamps[:-1] // interval) + 1
    assert np.array_equal(slow.trajectory[0][-len(on_grid) :], stamps[on_grid])
    assert np.array_equal(slow.trajectory[1][-len(on_grid) :], numbers[on_grid])
    # Comparing with truth takes more rows from the navigator, which must not show in the files.
    with_truth = run(tmp_path / "truth", "--output-rate", "8", "--truth", "truth")
    assert (with_truth.folder / "trajectory.tum").read_bytes() == (slow.folder / "trajectory.tum").read_bytes()
    ours, theirs = messages_of(with_truth.folder / "odometry.mcap"), messages_of(slow.folder / "odometry.mcap")
    assert {topic for topic in ours if ours[topic] != theirs.get(topic)} == {"/truth", "/path/truth"}


def test_ins_only_gives_gnss_until_the_state_is_good(tmp_path: Path) -> None:
    results = run(tmp_path, "--mode", "ins-only", "--truth", "truth", "--output-rate", "0")
    aids = results.summary["aids"]
    assert 0 < aids["gnss_position"]["offered"] < 500 < aids["gnss_position"]["withheld"]
    assert aids["gnss_position"]["offered"] + aids["gnss_position"]["withheld"] == 880
    assert results.summary["final"]["status"] != Status.GOOD.name
    assert results.summary["error"]["horizontal"]["max"] > 20.0


def test_truth_as_fixes_of_the_antenna_and_in_the_map(tmp_path: Path, recording: Any, results: Results) -> None:
    """The same truth in its two other forms gives the same position errors; fixes have no attitude or speed."""
    log_time, truth = recording["truth"]
    latitude, longitude, _ = datum = results.summary["datum"]
    attitude = Rotation.from_quat(truth["orientation"])
    antenna = pymap3d.ecef2geodetic(*(truth["position"] + attitude.apply(LEVER_ARM)).T)
    fixes = np.zeros(len(truth), recording["gps/fix"][1].dtype)
    fixes["stamp"] = truth["stamp"]
    fixes["latitude"], fixes["longitude"], fixes["altitude"] = antenna
    fixes["status"][::10] = -1
    fixes["latitude"][::10] = 0.0
    in_map = truth.copy()
    in_map["frame_id"] = 1
    in_map["position"] = np.stack(pymap3d.ecef2enu(*truth["position"].T, *datum), 1)
    to_ecef = np.stack(pymap3d.enu2uvw(*np.eye(3), latitude, longitude), 0)
    in_map["orientation"] = (Rotation.from_matrix(to_ecef.T) * attitude).as_quat()
    bag, config = tmp_path / "drive.mcap", tmp_path / "config.yaml"
    with BagWriter(bag) as writer:
        for topic in ("imu/data", "gps/fix", "gps/vel"):
            writer.write(writer.add_topic(topic, TYPES[topic]), *recording[topic], ["sensor"] * 4)
        writer.write(writer.add_topic("truth/fix", TYPES["gps/fix"]), log_time, fixes, ["gps"])
        writer.write(writer.add_topic("truth/map", TYPES["truth"]), log_time, in_map, ["", "map"] + ["base_link"] * 3)
    configured = to_mapping(load(CONFIG)) | {"datum": datum}
    config.write_text(to_yaml(from_mapping(configured)))
    outage = ["--outage", f"{OUTAGE[0]}:{OUTAGE[1]}", "--config", str(config)]
    by_fix = run(tmp_path / "fix", "--truth", "truth/fix", *outage, bag=bag).summary
    by_map = run(tmp_path / "map", "--truth", "truth/map", *outage, bag=bag).summary
    expected = results.summary
    assert by_map["truth"]["compared"] == expected["truth"]["compared"]
    for name in ("horizontal", "vertical", "speed", "heading_deg"):
        for figure in ("rms", "p50", "p95", "max"):
            assert by_map["error"][name][figure] == pytest.approx(expected["error"][name][figure], rel=1e-4, abs=1e-6)
    assert by_fix["truth"]["compared"] == pytest.approx(0.9 * expected["truth"]["compared"], rel=0.01)
    assert by_fix["error"]["speed"] is by_fix["error"]["heading_deg"] is by_fix["nees"]["attitude"] is None
    # The antenna sways with the attitude error: some centimetres.
    assert by_fix["error"]["horizontal"]["rms"] == pytest.approx(expected["error"]["horizontal"]["rms"], abs=0.03)
    assert by_fix["nees"]["position"]["mean"] == pytest.approx(expected["nees"]["position"]["mean"], rel=0.1)


def test_the_covariance_of_the_truth_counts() -> None:
    """e' (P + R)^-1 e by hand: P = 9, R = 16 and an error of 5 m east give 25 / 25."""
    from eskf_ros.filter.output.global_odometry import ODOMETRY
    from eskf_ros.geodesy.map_frame import MapFrame
    from eskf_ros.replay.truth import EPOCH, compare

    row, epoch = np.zeros(1, ODOMETRY), np.zeros(1, EPOCH)
    row["attitude_body_to_map"][:, 0] = 1.0
    row["position_map"][0] = (5.0, 0.0, 0.0)
    row["pose_covariance"][0] = np.diag([9.0, 9.0, 9.0, 1e-12, 1e-12, 1e-12])
    frame = MapFrame((48.0, 11.0, 500.0))
    epoch["position_ecef"] = frame.origin_ecef
    epoch["rotation_body_to_ecef"] = np.nan
    epoch["covariance_enu"] = 16.0 * np.eye(3)
    (found,) = compare(row, row, epoch, frame, np.zeros(3))
    assert found["nees_position"] == pytest.approx(1.0, rel=1e-6)
    assert found["horizontal"] == pytest.approx(5.0, rel=1e-9)
    assert np.isnan(found["nees_attitude"])


def test_nothing_is_compared_across_a_gap_of_the_estimate(recording: Any, tmp_path: Path) -> None:
    bag = tmp_path / "gap.mcap"
    with BagWriter(bag) as writer:
        for topic, (log_time, messages) in recording.items():
            stamps = messages["stamp"]
            gap = (stamps > stamps[0] + 60 * 10**9) & (stamps < stamps[0] + 61 * 10**9) & (topic == "imu/data")
            writer.write(writer.add_topic(topic, TYPES[topic]), log_time[~gap], messages[~gap], ["", "", "earth", ""])
    arguments = ("--truth", "truth", "--output-rate", "0")
    results, whole = run(tmp_path, *arguments, bag=bag), run(tmp_path, *arguments)
    left = read_topics(bag, {"imu/data": TYPES["imu/data"]})["imu/data"][1]["stamp"]
    edge = int(np.argmax(np.diff(left)))
    truth = recording["truth"][1]["stamp"]
    inside = np.sum((truth > left[edge]) & (truth < left[edge + 1]))
    assert whole.summary["truth"]["compared"] - results.summary["truth"]["compared"] == inside > 10


def test_json_on_stdout_is_nothing_but_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main([str(BAG), "--config", str(CONFIG), "--out", str(tmp_path), "--truth", "truth", "--json", "-"])
    captured = capsys.readouterr()
    assert code == 0
    assert json.loads(captured.out) == Results(tmp_path / "tunnel_drive_eskf").summary
    assert "gnss_position" in captured.err


def test_json_file_and_several_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(BAG.read_bytes())
    target = tmp_path / "summary.json"
    arguments = ["--config", str(CONFIG), "--out", str(tmp_path), "--json", str(target)]
    assert main([str(BAG), str(other), *arguments]) == 0
    assert [Path(part["bag"]).name for part in json.loads(target.read_text())] == ["tunnel_drive.mcap", "other.mcap"]
    table = capsys.readouterr().out
    assert f"Results: {tmp_path / 'other_eskf'}" in table
    assert main([str(other), *arguments, "--quiet"]) == 0
    assert json.loads(target.read_text())["bag"] == str(other)
    assert capsys.readouterr() == ("", "")


def test_results_lie_next_to_the_bag_and_replace_only_their_like(tmp_path: Path) -> None:
    bag = tmp_path / "drive.mcap"
    bag.write_bytes(BAG.read_bytes())
    folder = tmp_path / "drive_eskf"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    (folder / "aids.csv").write_text("old")
    assert main([str(bag), "--config", str(CONFIG), "--quiet"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == sorted([*FILES, "notes.txt"])
    assert (folder / "notes.txt").read_text() == "mine"
    assert (folder / "aids.csv").read_text() != "old"


@pytest.mark.parametrize("earlier", [True, False])
def test_ctrl_c_leaves_nothing_half_done(tmp_path: Path, earlier: bool) -> None:
    out_folder = tmp_path / "results"
    folder = out_folder / "tunnel_drive_eskf"
    if earlier:
        folder.mkdir(parents=True)
        (folder / "summary.json").write_text("of an earlier replay")
    command = [
        sys.executable,
        "-m",
        "eskf_ros.replay.main",
        str(BAG),
        "--config",
        str(CONFIG),
        "--out",
        str(out_folder),
    ]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment, cwd=CHECKOUT) as process:
        deadline = time.monotonic() + 60.0
        while not list(out_folder.glob("*/.partial-*")) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert process.poll() is None, process.communicate()
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=60.0)
    assert process.returncode == 130
    assert out == ""
    assert error == "eskf_replay: interrupted; nothing is written for the recording in progress\n"
    assert sorted(tmp_path.rglob("*")) == ([out_folder, folder, folder / "summary.json"] if earlier else [])


@pytest.mark.skipif(not COMPILED, reason="the kernels run uncompiled here")
def test_a_first_start_says_at_once_that_it_compiles(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "eskf_ros.replay.main", str(BAG), "--config", str(CONFIG), "--out", str(tmp_path)]
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(tmp_path / "cache")
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment, cwd=CHECKOUT) as process:
        assert process.stderr is not None
        first = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60.0)
    assert first.startswith("eskf_replay: compiling the estimator: 1 of about ")


def test_tum_text_writes_as_python_does() -> None:
    # Up to the last digit where Python looks at more digits of a half than a double has.
    random = np.random.default_rng(5)
    stamps = np.concatenate([[0, 1, 999_999_999, 1_000_000_000], random.integers(0, 2**62, 200)])
    numbers = random.uniform(-1.0, 1.0, (204, 7)) * ([1e7] * 3 + [1.0] * 4) ** random.uniform(-1.0, 1.0, (204, 1))
    numbers[:3] = [[0.0] * 7, [0.9999999999] * 7, [-1.25] * 7]
    for line, stamp, row in zip(tum_text(stamps, numbers).decode().splitlines(), stamps, numbers, strict=True):
        seconds, nanoseconds = divmod(int(stamp), 10**9)
        written = line.split(" ")
        assert written[0] == f"{seconds}.{nanoseconds:09d}"
        for text, number, decimals in zip(written[1:], row, [6] * 3 + [9] * 4, strict=True):
            wanted = f"{number:.{decimals}f}"
            assert len(text) == len(wanted)
            assert float(text) == pytest.approx(float(wanted), rel=1e-15, abs=1.01 * 10.0**-decimals)
