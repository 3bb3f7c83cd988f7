"""Frames of the node: transforms from rows, places of sensors from a tree of static transforms, planar output."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.tree import Parameters
from eskf_ros.ros_node.extrinsics import ANTENNA, IMU, Extrinsics, matrix_of, roll_pitch_yaw_deg
from eskf_ros.ros_node.transforms import Track, TransformWatch, map_to_odom, yaw_of
from eskf_ros.ros_node.two_d import PLANAR, flatten
from support.kernels import to_quaternion, to_rotation
from support.ros_process import needs_ros

angles = st.tuples(st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5), st.floats(-math.pi, math.pi))
positions = st.tuples(*[st.floats(-1e4, 1e4)] * 3)


def make_row(stamp: int = 10**9, position: Any = (0.0, 0.0, 0.0), attitude: Rotation | None = None) -> Any:
    row = np.zeros(1, ODOMETRY)[0]
    row["stamp"] = stamp
    row["position_map"] = position
    for name in ("attitude_body_to_map", "attitude_body_to_odom"):
        row[name] = to_quaternion(attitude or Rotation.identity())
    return row


@given(positions, positions, angles, st.floats(-math.pi, math.pi))
def test_odom_in_map_joins_the_two_poses_and_stays_level(position_map, position_odom, turns, difference):
    attitude = Rotation.from_euler("ZYX", turns)
    row = make_row(position=position_map, attitude=attitude)
    row["position_odom"] = position_odom
    row["attitude_body_to_odom"] = to_quaternion(Rotation.from_euler("z", difference) * attitude)
    translation, quaternion = map_to_odom(row)
    odom = to_rotation(quaternion)
    assert quaternion[1] == quaternion[2] == 0.0
    assert np.allclose(translation + odom.apply(position_odom), position_map, atol=1e-8)
    assert (odom * to_rotation(row["attitude_body_to_odom"]) * attitude.inv()).magnitude() < 1e-7


@given(angles)
def test_yaw_of_a_quaternion(turns):
    yaw = yaw_of(*to_quaternion(Rotation.from_euler("ZYX", turns)))
    assert math.remainder(yaw - turns[0], math.tau) == pytest.approx(0.0, abs=1e-7)


def test_the_track_tells_the_pose_between_two_rows_the_short_way_round():
    track = Track()
    assert track.at(10) is None
    for stamp, x, yaw in ((100, 1.0, 3.1), (200, 3.0, -3.1), (300, 4.0, -3.0)):
        track.note(make_row(stamp, (x, 0.0, 2.0 * x), Rotation.from_euler("z", yaw)))
    assert track.newest == 300
    (x, _, z), yaw = track.at(150)
    assert (x, z) == (2.0, 4.0)
    assert math.remainder(yaw - math.pi, math.tau) == pytest.approx(0.0, abs=1e-12)
    assert track.at(300)[0][0] == 4.0
    assert track.at(99) is None
    assert track.at(301) is None
    # After a reset the stamps go back: what was before is another track.
    track.note(make_row(50))
    assert track.newest == 50
    assert track.at(150) is None


def test_strangers_are_told_from_our_own_transforms():
    watch = TransformWatch({"odom": "map", "base_link": "odom"})
    watch.note_received("odom", "base_link", 5, 1.0)  # before a watch nothing counts
    watch.begin()
    watch.note_sent("odom", 7, 2.0)
    watch.note_received("map", "odom", 7, 2.0)
    watch.note_received("base_link", "wheel", 7, 2.0)
    watch.end()
    assert watch.strangers == ()
    watch.begin()
    watch.note_sent("odom", 8, 2.0)
    watch.note_received("map", "odom", 8, 2.1)
    watch.note_received("odom", "base_link", 9, 0.0)
    watch.end()
    assert watch.strangers == ("map -> odom", "odom -> base_link")
    # A watch in which nothing came tells nothing new.
    watch.begin()
    watch.end()
    assert watch.strangers == ("map -> odom", "odom -> base_link")


def transform(parent: str, child: str, position: Any, rotation: Rotation) -> Any:
    from geometry_msgs.msg import TransformStamped

    message = TransformStamped()
    message.header.frame_id, message.child_frame_id = parent, child
    t, q = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = map(float, position)
    q.x, q.y, q.z, q.w = map(float, rotation.as_quat())
    return message


@needs_ros
@given(st.lists(st.tuples(positions, angles), min_size=3, max_size=3))
def test_a_sensor_is_found_along_the_tree(links):
    """footprint -> base_link, and footprint -> mast -> imu: up to the common ancestor and down again."""
    (p, a), (q, b), (r, c) = ((np.array(position), Rotation.from_euler("ZYX", turns)) for position, turns in links)
    extrinsics = Extrinsics(Parameters())
    extrinsics.note_transform(transform("footprint", "base_link", p, a))
    extrinsics.note_transform(transform("footprint", "mast", q, b))
    extrinsics.note_frame(IMU, "imu")
    assert extrinsics.find() == []
    assert extrinsics.completed(Parameters()) == Parameters()
    extrinsics.note_transform(transform("mast", "imu", r, c))
    assert len(extrinsics.find()) == 1
    assert extrinsics.find() == []
    imu = extrinsics.completed(Parameters()).imu
    in_base = a.inv().apply(q + b.apply(r) - p)
    assert np.allclose(imu.mount_position, in_base, atol=1e-7)
    mounted = Rotation.from_euler("xyz", imu.mount_rpy_deg, degrees=True)
    assert (mounted * (a.inv() * b * c).inv()).magnitude() < 1e-6


@given(angles, st.sampled_from([None, 90.0, -90.0]))
def test_roll_pitch_yaw_of_a_matrix(turns, pitch):
    """Straight up and down too, where there are many answers: any of them is right."""
    rotation = Rotation.from_euler("ZYX", (turns[0], turns[1] if pitch is None else math.radians(pitch), turns[2]))
    found = Rotation.from_euler("xyz", roll_pitch_yaw_deg(rotation.as_matrix()), degrees=True)
    assert (found * rotation.inv()).magnitude() < 1e-7
    assert np.allclose(matrix_of(*rotation.as_quat()), rotation.as_matrix(), atol=1e-12)


@needs_ros
def test_what_a_parameter_gives_is_not_looked_up():
    parameters = from_mapping({"gnss.lever_arm": [1.0, 0.0, 0.0]})
    extrinsics = Extrinsics(parameters)
    extrinsics.note_frame(ANTENNA, "gps")
    extrinsics.note_frame(IMU, "unknown")
    extrinsics.note_frame(IMU, "base_link")
    extrinsics.note_transform(transform("base_link", "gps", (5.0, 0.0, 0.0), Rotation.identity()))
    assert [line.split()[0] for line in extrinsics.find()] == ["IMU"]
    assert extrinsics.completed(parameters).gnss.lever_arm == (1.0, 0.0, 0.0)
    assert extrinsics.source_of(ANTENNA) == "parameters"
    assert extrinsics.source_of(IMU) == "/tf_static"
    unused = Extrinsics(from_mapping({"frames.extrinsics": "parameters"}))
    unused.note_frame(IMU, "base_link")
    assert unused.find() == []


@needs_ros
def test_a_ring_of_transforms_and_broken_ones_end_the_search():
    extrinsics = Extrinsics(Parameters())
    extrinsics.note_transform(transform("a", "b", (1.0, 0.0, 0.0), Rotation.identity()))
    extrinsics.note_transform(transform("b", "a", (1.0, 0.0, 0.0), Rotation.identity()))
    broken = transform("base_link", "b", (math.nan, 0.0, 0.0), Rotation.identity())
    extrinsics.note_transform(broken)
    extrinsics.note_frame(IMU, "b")
    assert extrinsics.find() == []


@given(angles, positions, st.integers(0, 2**32 - 1))
def test_planar_output_keeps_x_y_and_yaw(turns, position, seed):
    row = make_row(position=position, attitude=Rotation.from_euler("ZYX", turns))
    root = np.random.default_rng(seed).normal(size=(6, 6))
    row["pose_covariance"] = root @ root.T
    row["twist_covariance"] = root.T @ root
    row["velocity_body"], row["angular_rate_body"] = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)
    before = row["pose_covariance"].copy()
    flatten(row)
    assert row["position_map"].tolist() == [position[0], position[1], 0.0]
    assert math.remainder(yaw_of(*row["attitude_body_to_map"].tolist()) - turns[0], math.tau) == pytest.approx(
        0.0, abs=1e-7
    )
    assert row["attitude_body_to_odom"][1:3].tolist() == [0.0, 0.0]
    assert row["velocity_body"].tolist() == [1.0, 2.0, 0.0]
    assert row["angular_rate_body"].tolist() == [0.0, 0.0, 0.3]
    kept = [0, 1, 5]
    assert np.array_equal(row["pose_covariance"][np.ix_(kept, kept)], before[np.ix_(kept, kept)])
    assert np.all(row["pose_covariance"][np.ix_(kept, PLANAR)] == 0.0)
    assert np.linalg.eigvalsh(row["twist_covariance"]).min() > 0.0
