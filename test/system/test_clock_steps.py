"""The clock that stamps all messages is set in the middle of a drive: the estimate is carried on, and it is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import eskf_ros
from eskf_ros.bags import BagWriter, Batch, open_bag
from eskf_ros.filter.history.clock_steps import steps_back
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Status, Verdict
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.replay.run import Options, replay
from eskf_ros.simulate.scenario import Recording, simulate
from eskf_ros.tables.feeding import push_row
from monte_carlo import messages_of

SECOND = 1_000_000_000
STEP_AT = 30.0
"""s from the first sample: the car has been driving for a while, and its heading is known."""


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate("drive", seed=3, imu_rate=100.0, gnss_rate=5.0, start=12.0, stop=62.0)


def events(recording: Recording) -> list[tuple[int, str, int, int, object]]:
    """Arrival, kind, true stamp, row of everything, in the order of arrival."""
    imu = [
        (int(arrival), "imu", int(stamp), i, None)
        for i, (stamp, arrival) in enumerate(zip(recording.imu_stamp, recording.imu_arrival))
    ]
    aids = [(arrival, name, stamp, -1, row) for arrival, name, stamp, row in messages_of(recording)]
    return sorted([*imu, *aids], key=lambda event: event[0])


def moved(recording: Recording, stamp: int, size: float) -> int:
    """A stamp as the clock gives it that is set by ``size`` (s) after STEP_AT."""
    begin = int(recording.imu_stamp[0]) + round(STEP_AT * SECOND)
    return stamp + (round(size * SECOND) if stamp >= begin else 0)


def run(recording: Recording, size: float, knows_arrival: bool = True) -> tuple[Navigator, NDArray, NDArray]:
    """Give all messages in the order of arrival; return the navigator, its rows with true stamps, its records."""
    navigator = Navigator(from_mapping(recording.parameters()))
    rows, records = [], []
    for arrival, name, stamp, i, row in events(recording):
        given = moved(recording, stamp, size)
        if name == "imu":
            part = slice(i, i + 1)
            arrivals = np.array([arrival]) if knows_arrival else None
            rows.append(
                navigator.push_imu(
                    np.array([given]), recording.specific_force[part], recording.angular_rate[part], arrivals
                )
            )
        else:
            push_row(navigator, name, given, row, arrival)
        if i % 1000 == 0:
            records.append(navigator.take_records())
    records.append(navigator.finish())
    return navigator, np.concatenate(rows), np.concatenate(records)


@pytest.mark.parametrize("size", [-0.5, -1.0, -5.0, -60.0, -3600.0, 0.5, 5.0, 60.0, 3600.0])
def test_the_estimate_is_carried_on_over_a_step(recording: Recording, size: float) -> None:
    plain, plain_rows, plain_records = run(recording, 0.0)
    navigator, rows, records = run(recording, size)
    steps = navigator.clock_steps
    assert [round(step.size / SECOND, 2) for step in steps] == pytest.approx([size], abs=0.02)
    word = "forward" if size > 0.0 else "back"
    assert any(f"was set {word} by {abs(size):.1f} s" in text for text in navigator.complaints)
    assert navigator.status == plain.status == Status.GOOD
    assert (navigator.restarts, navigator.position_resets) == (0, 0)
    # Every sample is answered, with the stamp that it came with.
    assert rows["stamp"].tolist() == [moved(recording, stamp, size) for stamp in plain_rows["stamp"].tolist()]
    # The first fix around the step may be refused, nothing else.
    assert np.count_nonzero(records["verdict"] == Verdict.FUSED) >= (
        np.count_nonzero(plain_records["verdict"] == Verdict.FUSED) - 3
    )
    difference = np.linalg.norm(rows["position_map"] - plain_rows["position_map"], axis=1)
    assert difference.max() < 0.3
    assert difference[-500:].max() < 0.1


def test_without_arrivals_a_step_back_is_seen_all_the_same(recording: Recording) -> None:
    navigator, _, _ = run(recording, -5.0, knows_arrival=False)
    assert [round(step.size / SECOND) for step in navigator.clock_steps] == [-5]
    assert navigator.status == Status.GOOD


def test_samples_that_come_late_are_no_step(recording: Recording) -> None:
    """A second of samples comes behind newer ones: it fills the hole that it left."""
    navigator = Navigator(from_mapping(recording.parameters()))
    order = np.arange(len(recording.imu_stamp))
    order = np.concatenate([order[:2000], order[2100:2150], order[2000:2100], order[2150:]])
    for i in order:
        part = slice(i, i + 1)
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
    in_order = Navigator(from_mapping(recording.parameters()))
    in_order.push_imu(recording.imu_stamp, recording.specific_force, recording.angular_rate)
    assert not navigator.clock_steps
    assert navigator.imu_counts["late"] == 0
    for name in ("position_map", "velocity_map", "attitude", "covariance"):
        assert navigator.state[name].tobytes() == in_order.state[name].tobytes(), name


def test_samples_that_come_twice_are_no_step(recording: Recording) -> None:
    """A block of the recording that was written twice."""
    navigator = Navigator(from_mapping(recording.parameters()))
    for part in (slice(0, 2000), slice(1900, 2000), slice(2000, None)):
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
    assert not navigator.clock_steps
    assert navigator.imu_counts["duplicate"] == 100


@pytest.mark.parametrize("hole", [0.5, 3.0])
def test_a_silent_imu_is_no_step(recording: Recording, hole: float) -> None:
    navigator = Navigator(from_mapping(recording.parameters()))
    seconds = (recording.imu_stamp - recording.imu_stamp[0]) * 1e-9
    for part in np.flatnonzero((seconds < 20.0) | (seconds >= 20.0 + hole))[:, None]:
        navigator.push_imu(
            recording.imu_stamp[part],
            recording.specific_force[part],
            recording.angular_rate[part],
            recording.imu_arrival[part],
        )
    assert not navigator.clock_steps
    assert navigator.imu_counts["bad_stamp"] == 0


def test_stamps_ahead_that_nothing_follows_cost_nothing(recording: Recording) -> None:
    """One wrong stamp three seconds ahead would make all samples of three seconds late."""
    navigator = Navigator(from_mapping(recording.parameters()))
    for i in range(3000):
        part = slice(i, i + 1)
        stamps = recording.imu_stamp[part] + (3 * SECOND if i == 2500 else 0)
        navigator.push_imu(
            stamps, recording.specific_force[part], recording.angular_rate[part], recording.imu_arrival[part]
        )
    assert not navigator.clock_steps
    assert (navigator.imu_counts["bad_stamp"], navigator.imu_counts["late"]) == (1, 0)


BAG = Path(__file__).resolve().parents[2] / "bags" / "tunnel_drive.mcap"
CONFIG = BAG.parents[1] / "config" / "tunnel_drive.yaml"
TYPES = {
    "imu/data": "sensor_msgs/msg/Imu",
    "gps/fix": "sensor_msgs/msg/NavSatFix",
    "gps/vel": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
CUT, END = 40.0, 70.0
"""s from the start of the bundled drive: where the clock is set, and where the recording ends."""


@pytest.fixture(scope="module")
def messages() -> dict[str, Batch]:
    found: dict[str, list[Batch]] = {topic: [] for topic in TYPES}
    with open_bag([BAG]) as reader:
        end = reader.start_time + round(END * SECOND)
        for batch in reader.batches(TYPES):
            for topic, part in batch.items():
                found[topic].append(part)
    joined = {}
    for topic, parts in found.items():
        log_time = np.concatenate([part.log_time for part in parts])
        kept = log_time < end
        content = np.concatenate([part.messages for part in parts])[kept]
        joined[topic] = Batch(log_time[kept], content, parts[-1].strings)
    return joined


def set_by(messages: dict[str, Batch], size: float) -> dict[str, Batch]:
    """All stamps from CUT on moved by ``size`` (s); they were recorded by a clock that nobody set."""
    begin = messages["imu/data"].messages["stamp"][0] + round(CUT * SECOND)
    changed = {}
    for topic, part in messages.items():
        content = part.messages.copy()
        content["stamp"] += np.where(content["stamp"] >= begin, round(size * SECOND), 0)
        changed[topic] = Batch(part.log_time, content, part.strings)
    return changed


@pytest.mark.parametrize("order", ["log", "stamp"])
@pytest.mark.parametrize("size", [-60.0, -5.0, -0.5, 5.0])
def test_the_replay_carries_on(messages: dict[str, Batch], tmp_path: Path, size: float, order: str) -> None:
    summaries = {}
    for name, given in (("plain", 0.0), ("set", size)):
        bag = tmp_path / f"{name}.mcap"
        with BagWriter(bag) as writer:
            for topic, part in set_by(messages, given).items():
                writer.write(writer.add_topic(topic, TYPES[topic]), part.log_time, part.messages, part.strings)
        summaries[name] = replay(bag, load(CONFIG), Options(folder=tmp_path / name, order=order))
    plain, stepped = summaries["plain"], summaries["set"]
    assert any(
        f"was set {'back' if size < 0 else 'forward'} by {abs(size):.1f} s" in text for text in stepped["warnings"]
    )
    assert not [text for text in plain["warnings"] if "was set" in text]
    assert stepped["restarts"] == stepped["position_resets"] == 0
    assert stepped["imu"]["late"] == stepped["imu"]["bad_stamp"] == 0
    assert stepped["duration_s"] == pytest.approx(plain["duration_s"], abs=0.1)
    assert stepped["aids"]["gnss_position"]["fused"] >= plain["aids"]["gnss_position"]["fused"] - 3
    assert stepped["final"]["position"] == pytest.approx(plain["final"]["position"], abs=0.1)
    assert stepped["final"]["status"] == "GOOD"


@pytest.mark.parametrize("size", [-20.0, -5.0, -0.5])
def test_tables_in_memory_carry_on(messages: dict[str, Batch], size: float) -> None:
    """Rows in the order in which they came: sorted by stamp, old and new ones would be mixed."""

    def result(given: float) -> eskf_ros.Result:
        parts = {topic: part.messages for topic, part in set_by(messages, given).items()}
        imu, fix, velocity = parts["imu/data"], parts["gps/fix"], parts["gps/vel"]
        return eskf_ros.run(
            {
                "stamp": imu["stamp"],
                "specific_force": imu["linear_acceleration"],
                "angular_rate": imu["angular_velocity"],
            },
            {
                "stamp": fix["stamp"],
                "latitude_deg": fix["latitude"],
                "longitude_deg": fix["longitude"],
                "altitude": fix["altitude"],
                "covariance": fix["position_covariance"],
            },
            {
                "stamp": velocity["stamp"],
                "velocity": velocity["linear_velocity"],
                "covariance": velocity["twist_covariance"].reshape(-1, 6, 6)[:, :3, :3],
            },
            parameters=CONFIG,
        )

    plain, stepped = result(0.0), result(size)
    assert any(f"was set back by {-size:.1f} s" in text for text in stepped.warnings)
    assert len(stepped.odometry) == len(plain.odometry)
    assert stepped.summary["restarts"] == stepped.summary["position_resets"] == 0
    assert stepped.summary["aids"]["gnss_position"]["fused"] >= plain.summary["aids"]["gnss_position"]["fused"] - 3
    assert stepped.summary["final"]["position"] == pytest.approx(plain.summary["final"]["position"], abs=0.1)


def test_blocks_of_a_table_in_any_order_are_no_step(messages: dict[str, Batch]) -> None:
    stamps = messages["imu/data"].messages["stamp"]
    third = len(stamps) // 3
    assert steps_back(np.concatenate([stamps[third:], stamps[:third]]), begins_earlier=False) == []
    assert steps_back(np.concatenate([stamps[:third], stamps[2 * third :], stamps[third : 2 * third]]), False) == []
    rng = np.random.default_rng(0)
    assert steps_back(rng.permutation(stamps), begins_earlier=False) == []
