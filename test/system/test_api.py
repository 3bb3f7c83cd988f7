"""The filter over arrays in memory: the truth of the bundled drive, any order, any form of a table, clear refusals."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray

import eskf_ros
from eskf_ros.bags import open_bag
from eskf_ros.parameters.ros_yaml import load

CHECKOUT = Path(__file__).resolve().parents[2]
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
TOPICS = {
    "imu/data": "sensor_msgs/msg/Imu",
    "gps/fix": "sensor_msgs/msg/NavSatFix",
    "gps/vel": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "truth": "nav_msgs/msg/Odometry",
}
SHORT = 30 * 10**9

Tables = dict[str, dict[str, NDArray[Any]]]


@pytest.fixture(scope="module")
def messages() -> dict[str, NDArray[Any]]:
    with open_bag([CHECKOUT / "bags" / "tunnel_drive.mcap"]) as bag:
        batches = list(bag.batches(TOPICS))
    return {name: np.concatenate([batch[name].messages for batch in batches if name in batch]) for name in TOPICS}


@pytest.fixture(scope="module")
def drive(messages: dict[str, NDArray[Any]]) -> Tables:
    imu, fix, velocity = messages["imu/data"], messages["gps/fix"], messages["gps/vel"]
    return {
        "imu": {
            "stamp": imu["stamp"],
            "specific_force": imu["linear_acceleration"],
            "angular_rate": imu["angular_velocity"],
        },
        "gnss_position": {
            "stamp": fix["stamp"],
            "latitude_deg": fix["latitude"],
            "longitude_deg": fix["longitude"],
            "altitude": fix["altitude"],
            "covariance": fix["position_covariance"],
            "status": fix["status"],
        },
        "gnss_velocity": {
            "stamp": velocity["stamp"],
            "velocity": velocity["linear_velocity"],
            "covariance": velocity["twist_covariance"].reshape(-1, 6, 6)[:, :3, :3],
        },
    }


@pytest.fixture(scope="module")
def short(drive: Tables) -> Tables:
    """The first half minute, from 2000 s on: seconds as floats hold these stamps to the nanosecond."""
    start = drive["imu"]["stamp"].min()
    cut: Tables = {}
    for name, table in drive.items():
        early = table["stamp"] < start + SHORT
        cut[name] = {column: values[early] for column, values in table.items()}
        cut[name]["stamp"] = cut[name]["stamp"] - start + 2000 * 10**9
    return cut


def bits(result: eskf_ros.Result) -> tuple[bytes, bytes]:
    return result.odometry.tobytes(), np.asarray(result.innovations).tobytes()


def run(tables: Tables, **others: Any) -> eskf_ros.Result:
    return eskf_ros.run(**tables, parameters=CONFIG, **others)


def changed(tables: Tables, name: str, **columns: Any) -> Tables:
    return {**tables, name: {**tables[name], **columns}}


def test_the_truth_is_recovered(drive: Tables, messages: dict[str, NDArray[Any]]) -> None:
    result = eskf_ros.run(**drive, parameters=CONFIG)
    truth = messages["truth"]
    rows = result.odometry
    _, ours, theirs = np.intersect1d(rows["stamp"], truth["stamp"], return_indices=True)
    known = rows["position_known"][ours] & rows["heading_known"][ours]
    assert known.sum() > 1000
    # The truth is in Earth-centred coordinates.
    table = result.trajectory
    place = [np.asarray(table[name])[ours][known] for name in ("latitude_deg", "longitude_deg", "altitude")]
    error = np.column_stack(pymap3d.geodetic2ecef(*place)) - truth["position"][theirs][known]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 2.0
    aid = result.summary["aids"]["gnss_position"]
    assert aid["offered"] == len(drive["gnss_position"]["stamp"])
    assert aid["fused"] + aid["rejected"] + aid["late"] + aid["waiting"] == aid["offered"]
    assert aid["late"] == 0
    assert 2.0 < aid["nis_mean"] < 4.0
    assert result.summary["final"]["status"] == "GOOD"
    assert len(result.trajectory) == len(result.biases) == len(rows)


def test_any_order_of_pushing_gives_the_same_bits(short: Tables) -> None:
    seen = set()
    for names in itertools.permutations(short):
        for flip in (1, -1):
            runner = eskf_ros.Filter(CONFIG)
            for name in names:
                getattr(runner, f"push_{name}")({column: values[::flip] for column, values in short[name].items()})
            seen.add(bits(runner.result()))
    assert seen == {bits(run(short))}


def test_in_pieces_as_at_once(short: Tables) -> None:
    runner = eskf_ros.Filter(load(CONFIG))
    for second in range(2000, 2031, 3):
        for name in ("gnss_velocity", "imu", "gnss_position"):
            now = short[name]["stamp"] // (3 * 10**9) == second // 3
            if now.any():
                getattr(runner, f"push_{name}")({column: values[now] for column, values in short[name].items()})
        runner.update()
        runner.result()
    assert bits(runner.result()) == bits(run(short))


def test_measurements_wait_for_the_imu(short: Tables) -> None:
    runner = eskf_ros.Filter(CONFIG)
    runner.push_gnss_velocity(short["gnss_velocity"])
    runner.push_gnss_position(short["gnss_position"])
    for second in range(2000, 2031, 3):
        now = short["imu"]["stamp"] // (3 * 10**9) == second // 3
        runner.push_imu({column: values[now] for column, values in short["imu"].items()})
        runner.update()
    assert bits(runner.result()) == bits(run(short))


def test_early_fixes_by_the_thousand_lose_nothing(short: Tables) -> None:
    stamps = np.sort(short["imu"]["stamp"])
    stamps = np.arange(stamps[0], stamps[-1], 4_000_000)
    fixes = {name: np.interp(stamps, short["gnss_position"]["stamp"], short["gnss_position"][name]) for name in
             ("latitude_deg", "longitude_deg", "altitude")}  # fmt: skip
    runner = eskf_ros.Filter(CONFIG)
    runner.push_gnss_position({"stamp": stamps, **fixes, "covariance": np.full(len(stamps), 25.0)})
    assert len(runner.update()) == 0
    runner.push_imu(short["imu"])
    verdicts = runner.result().summary["aids"]["gnss_position"]["verdicts"]
    assert len(stamps) > 4096
    assert not {"outside_history", "bad_stamp", "waiting"} & set(verdicts)
    # The robot is levelled within 5 s: no fix is lost but for those of that time.
    assert verdicts["before_alignment"] < 5 * 250


@pytest.mark.parametrize("form", ["float", "datetime64[ns]", "datetime64[us]", "uint64"])
def test_forms_of_stamps(short: Tables, form: str) -> None:
    tables = short
    for name, table in short.items():
        stamps = table["stamp"]
        assert not (stamps % 1000).any(), "microseconds cannot hold these stamps"
        given = stamps * 1e-9 if form == "float" else stamps.astype("datetime64[ns]" if form[0] == "d" else form)
        tables = changed(tables, name, stamp=given.astype(form) if form[0] == "d" else given)
    assert bits(run(tables)) == bits(run(short))


def test_forms_of_covariances_and_tables(short: Tables) -> None:
    count = len(short["gnss_position"]["stamp"])
    forms = [np.full(count, 4.0), np.full((count, 3), 4.0), np.tile(4.0 * np.eye(3), (count, 1, 1))]
    forms.append(forms[-1].reshape(count, 9))
    seen = {bits(run(changed(short, "gnss_position", covariance=form))) for form in forms}
    imu = short["imu"]
    split = {
        f"{name}_{axis}": imu[name][:, i] for name in ("specific_force", "angular_rate") for i, axis in enumerate("xyz")
    }
    structured = np.zeros(len(imu["stamp"]), [("stamp", "i8"), ("specific_force", "f8", 3), ("angular_rate", "f8", 3)])
    for name in structured.dtype.names or ():
        structured[name] = imu[name]
    base = changed(short, "gnss_position", covariance=forms[0])
    seen |= {bits(run({**base, "imu": table})) for table in ({"stamp": imu["stamp"], **split}, structured)}
    assert len(seen) == 1


def test_other_sensors(short: Tables) -> None:
    stamps = short["gnss_velocity"]["stamp"]
    speed = np.linalg.norm(short["gnss_velocity"]["velocity"][:, :2], axis=1)
    tables: dict[str, Any] = {
        **short,
        "wheel": {"stamp": stamps, "speed": speed, "covariance": np.full(len(stamps), 0.01)},
    }
    tables["baro"] = {"stamp": stamps, "pressure": np.full(len(stamps), 1e5), "covariance": np.full(len(stamps), 25.0)}
    tables["body_velocity"] = {
        "stamp": stamps,
        "velocity": np.column_stack([speed, 0 * speed, 0 * speed]),
        "covariance": np.tile([0.01, -1.0, -1.0], (len(stamps), 1)),
    }
    aids = run(tables).summary["aids"]
    for name in ("wheel", "baro", "body_velocity"):
        assert aids[name]["offered"] == len(stamps)
        assert aids[name]["fused"] > 0, name


def test_what_is_dropped_is_said(short: Tables) -> None:
    fixes = {column: np.concatenate([values, values[-3:]]) for column, values in short["gnss_position"].items()}
    fixes["altitude"][5] = np.nan
    runner = eskf_ros.Filter(CONFIG)
    runner.push_imu({**short["imu"], "temperature": np.zeros(len(short["imu"]["stamp"]))})
    runner.update()
    runner.push_gnss_position(fixes)
    text = "\n".join(runner.result().warnings)
    for part in ("outside_history", "duplicate", "temperature"):
        assert part in text


COUNT = 4
IMU = {
    "stamp": np.arange(COUNT) * 5_000_000 + 10**15,
    "specific_force": np.tile([0.0, 0.0, 9.8], (COUNT, 1)),
    "angular_rate": np.zeros((COUNT, 3)),
}


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("stamp", np.arange(COUNT), "too small for nanoseconds"),
        ("stamp", np.arange(COUNT) * 5 + 1_700_000_000_000, "too close for nanoseconds"),
        ("stamp", np.arange(COUNT) * 5e6 + 1.7e18, "too large for seconds"),
        ("stamp", np.array([1.0, 2.0, np.nan, 3.0]), "row 2, which is no time"),
        ("stamp", np.array(["NaT"] * COUNT, "datetime64[ns]"), "which is no time"),
        ("stamp", np.arange(COUNT, dtype=np.float32), "of type float32"),
        ("stamp", np.array(["a"] * COUNT), "of type <U1"),
        ("stamp", np.zeros((COUNT, 2)), "shape"),
        ("stamp", np.zeros(0), "empty"),
        ("specific_force", np.zeros((COUNT, 2)), "shape"),
        ("specific_force", np.array([["a"] * 3] * COUNT), "give numbers"),
        ("specific_force", np.array([[None] * 3] * COUNT), "give numbers"),
    ],
)
def test_refusals(column: str, value: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said) as refusal:
        eskf_ros.run({**IMU, column: value})
    assert str(refusal.value).startswith("imu: ")
    assert column in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_other_refusals(short: Tables) -> None:
    with pytest.raises(ValueError, match="imu: the column angular_rate is missing"):
        eskf_ros.run({name: IMU[name] for name in ("stamp", "specific_force")})
    with pytest.raises(ValueError, match="imu: a list is no table"):
        eskf_ros.run([1, 2])
    later = changed(short, "gnss_position", stamp=short["gnss_position"]["stamp"] + 10**15)
    with pytest.raises(ValueError, match=r"gnss_position: .* no time in common"):
        run(later)
    with pytest.raises(ValueError, match="wheel: the column covariance has the shape"):
        eskf_ros.Filter().push_wheel(
            {"stamp": IMU["stamp"], "speed": np.ones(4), "yaw_rate": np.ones(4), "covariance": np.ones(4)}
        )
    with pytest.raises(ValueError, match="heading: the column covariance is missing"):
        eskf_ros.Filter().push_heading({"stamp": IMU["stamp"], "yaw": np.ones(4)})
    with pytest.raises(ValueError, match="output_rate"):
        eskf_ros.Filter(output_rate=-1.0)
    with pytest.raises(ValueError, match="lever_arn"):
        eskf_ros.Filter({"gnss": {"lever_arn": [0.0, 0.0, 0.0]}})
    with pytest.raises(TypeError, match="parameters are a int"):
        eskf_ros.Filter(3)  # type: ignore[arg-type]
