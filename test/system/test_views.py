"""The views of config/views show topics and fields that are there: in odometry.mcap of a replay, and of the node."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from eskf_ros.parameters.tree import Topics
from eskf_ros.replay.main import main as replay

CHECKOUT = Path(__file__).resolve().parents[2]
VIEWS = CHECKOUT / "config" / "views"
STORE = get_typestore(Stores.ROS2_JAZZY)
SECOND = 1_000_000_000

ONLY_LIVE = {f"/{Topics().initial_pose}": "geometry_msgs/msg/PoseWithCovarianceStamped"}
"""What the views send to the node."""

WHEN_THERE = {"/odometry/smoothed": "nav_msgs/msg/Odometry"}

DISPLAYS = {
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/SetInitialPose": "geometry_msgs/msg/PoseWithCovarianceStamped",
}
PANELS = {
    "3D": ("nav_msgs/msg/Odometry", "nav_msgs/msg/Path"),
    "map": ("sensor_msgs/msg/NavSatFix",),
    "DiagnosticSummary": ("diagnostic_msgs/msg/DiagnosticArray",),
    "DiagnosticStatusPanel": ("diagnostic_msgs/msg/DiagnosticArray",),
}


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, list[tuple[int, Any]]]]:
    """All of odometry.mcap of a replay with truth: type, and (log time, message), by topic."""
    out = tmp_path_factory.mktemp("views")
    options = ["--config", str(CHECKOUT / "config" / "tunnel_drive.yaml"), "--truth", "truth", "--quiet"]
    assert replay([str(CHECKOUT / "bags" / "tunnel_drive.mcap"), "--out", str(out), *options]) == 0
    found: dict[str, tuple[str, list[tuple[int, Any]]]] = {}
    with AnyReader([out / "tunnel_drive_eskf" / "odometry.mcap"], default_typestore=STORE) as reader:
        for connection, log_time, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, (connection.msgtype, []))[1].append((log_time, message))
    return found


@pytest.fixture(scope="module")
def types(messages: dict[str, tuple[str, list[tuple[int, Any]]]]) -> dict[str, str]:
    return {**{topic: kind for topic, (kind, _) in messages.items()}, **WHEN_THERE}


def check_field(kind: str, fields: list[str]) -> None:
    """Walk from a message type to a number, by names and indices; fails where there is no such field."""
    for name in fields:
        bare, _, index = name.partition("[")
        definition = dict(STORE.fielddefs[kind][1])
        assert bare in definition, f"{kind} has no {bare}"
        node, described = definition[bare]
        if node.name == "ARRAY":
            assert index, f"{bare} of {kind} is an array"
            assert int(index.rstrip("]")) < described[1]
            described = described[0]
        else:
            assert node.name in ("NAME", "BASE")
            assert not index
        kind = described if node.name == "NAME" else ""
        last = described
    assert kind == "", f"{fields} is no number"
    assert last


def stamp(message: Any) -> int:
    return message.header.stamp.sec * SECOND + message.header.stamp.nanosec


# ---- the recording


def test_a_replay_carries_what_the_node_publishes_and_the_reference(types: dict[str, str]) -> None:
    assert types == {
        "/odometry/global": "nav_msgs/msg/Odometry",
        "/gps/filtered": "sensor_msgs/msg/NavSatFix",
        "/gps/fix": "sensor_msgs/msg/NavSatFix",
        "/imu/bias": "geometry_msgs/msg/TwistWithCovarianceStamped",
        "/eskf/aids": "diagnostic_msgs/msg/DiagnosticArray",
        "/eskf/quality": "diagnostic_msgs/msg/DiagnosticStatus",
        "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/path": "nav_msgs/msg/Path",
        "/path/truth": "nav_msgs/msg/Path",
        "/truth": "nav_msgs/msg/Odometry",
        **WHEN_THERE,
    }


def test_truth_path_and_transforms_lie_in_the_map_where_the_estimate_does(messages: Any) -> None:
    estimate = {at: m.pose.pose for at, m in messages["/odometry/global"][1]}
    true = {at: m.pose.pose for at, m in messages["/truth"][1]}
    both = sorted(estimate.keys() & true.keys())
    assert len(both) > 1000

    def places(poses: dict[int, Any]) -> np.ndarray:
        return np.array([(poses[at].position.x, poses[at].position.y, poses[at].position.z) for at in both])

    errors = np.linalg.norm(places(estimate) - places(true), axis=1)
    assert np.median(errors) < 0.5
    # The truth is turned as the estimate is: the same heading within a degree, after the start.
    late = both[len(both) // 2]
    dot = sum(getattr(estimate[late].orientation, axis) * getattr(true[late].orientation, axis) for axis in "xyzw")
    assert abs(dot) > np.cos(np.radians(0.5))
    (at, path), (_, true_path) = messages["/path"][1][0], messages["/path/truth"][1][0]
    assert at == stamp(path.poses[0]), "there from the beginning"
    assert len(path.poses) > 200
    assert len(true_path.poses) > 200
    for pose in path.poses[1::50]:
        assert pose.pose == estimate[stamp(pose)]
        assert pose.header.frame_id == "map"
    for _, message in messages["/tf"][1][::100]:
        (transform,) = message.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "base_link")
        assert transform.transform.translation.x == estimate[stamp(transform)].position.x
        assert transform.transform.rotation == estimate[stamp(transform)].orientation


def test_verdicts_quality_and_diagnostics_tell_the_tunnel(messages: Any) -> None:
    """In the tunnel nothing is fused, the robot may go on for a while, and afterwards all is well."""
    verdicts = [(at, status) for at, message in messages["/eskf/aids"][1] for status in message.status]
    fused = [at for at, status in verdicts if status.name == "gnss_position" and status.message == "fused"]
    gaps = np.diff(fused) / SECOND
    assert gaps.max() == pytest.approx(45.0, abs=3.0)
    assert np.median(gaps) == pytest.approx(1.0, abs=0.3), "one a second of those that are fine"
    levels = [message.level for _, message in messages["/eskf/quality"][1]]
    assert {0, 1, 2} == set(levels)
    assert levels[-1] == 0
    _, last = messages["/diagnostics"][1][-1]
    (status,) = last.status
    values = {pair.key: pair.value for pair in status.values}
    assert (status.message, status.level) == ("GOOD", 0)
    assert int(values["gnss_position fused"]) > 800
    assert float(values["heading std (deg)"]) < 1.0
    bias = messages["/imu/bias"][1][-1][1].twist
    assert bias.twist.linear.x == pytest.approx(float(values["accelerometer bias (m/s2)"].split()[0]), abs=6e-5)
    assert bias.covariance[0] > 0.0


def test_fixes_are_those_of_the_recording(messages: Any) -> None:
    topic = "gps/fix"
    with AnyReader([CHECKOUT / "bags" / "tunnel_drive.mcap"], default_typestore=STORE) as reader:
        own = [c for c in reader.connections if c.topic == topic]
        recorded = {stamp(m): m for c, _, data in reader.messages(own) for m in [reader.deserialize(data, c.msgtype)]}
    shown = messages["/gps/fix"][1]
    assert [at for at, _ in shown] == sorted(recorded)
    for at, message in shown[::50]:
        assert (message.latitude, message.altitude) == (recorded[at].latitude, recorded[at].altitude)
        assert message.header.frame_id == recorded[at].header.frame_id


# ---- the views


def test_the_foxglove_layout_shows_what_is_there(types: dict[str, str]) -> None:
    layout = json.loads((VIEWS / "foxglove.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    for name, panel in panels.items():
        kind = name.partition("!")[0]
        topics = [*panel.get("topics", ()), *panel.get("topicColors", ()), panel.get("topicToRender")]
        topics += [panel.get("followTopic"), panel.get("topicPath")]
        for topic in filter(None, topics):
            assert topic in types, f"{name}: {topic}"
            assert kind not in PANELS or types[topic] in PANELS[kind], f"{name}: {topic}"
        for path in panel.get("paths", ()):
            topic, *fields = path["value"].split(".")
            check_field(types[topic], fields)
    # Each panel is in the layout, and the layout has no other.
    placed = set(re.findall(r'"(\w+!\w+)"', json.dumps([panels["Tab!main"], layout["layout"]])))
    assert placed == set(panels)


def test_the_plotjuggler_layout_shows_what_is_there(types: dict[str, str]) -> None:
    root = xml.etree.ElementTree.parse(VIEWS / "plotjuggler.xml").getroot()
    curves = [str(element.get("name")) for element in root.iter("curve")]
    subscribed = {str(element.get("name")) for element in root.iter("topic")}
    assert len(curves) > 20
    shown = set()
    for curve in curves:
        topic = max((name for name in types if curve.startswith(f"{name}/")), key=len)
        check_field(types[topic], curve.removeprefix(f"{topic}/").split("/"))
        shown.add(topic)
    assert shown == subscribed


def displays(node: Any) -> Iterator[dict[str, Any]]:
    """All displays and tools of an RViz configuration."""
    if isinstance(node, dict):
        if "Class" in node:
            yield node
        for value in node.values():
            yield from displays(value)
    elif isinstance(node, list):
        for value in node:
            yield from displays(value)


def test_the_rviz_configuration_shows_what_is_there(types: dict[str, str]) -> None:
    config = yaml.safe_load((VIEWS / "eskf.rviz").read_text(encoding="utf-8"))
    assert config["Visualization Manager"]["Global Options"]["Fixed Frame"] == "map"
    shown = [display for display in displays(config) if "Topic" in display]
    assert len(shown) == 5
    for display in shown:
        topic = display["Topic"]["Value"]
        assert {**types, **ONLY_LIVE}[topic] == DISPLAYS[display["Class"]], topic


def test_what_the_views_show_live_the_node_publishes(types: dict[str, str]) -> None:
    """The topics of a replay that the node has too bear the same names there (docs/node.md is its list)."""
    text = (CHECKOUT / "docs" / "node.md").read_text(encoding="utf-8")
    live = {f"/{topic.strip('/')}": kind for topic, kind in re.findall(r"^\| `([\w/]+)` \| (\w+/\w+) \|", text, re.M)}
    live["/gps/fix"] = "sensor_msgs/NavSatFix"
    for topic in types.keys() - {"/path", "/path/truth", "/truth", *WHEN_THERE}:
        assert live[topic] == types[topic].replace("/msg", ""), topic
