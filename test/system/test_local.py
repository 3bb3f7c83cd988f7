"""Odometry without jumps: what moves the map pose at once does not move the local one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from eskf_ros.filter.alignment.heading_search import COSINE as SEARCH_COSINE
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Status, Stream
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate

SECOND = 1_000_000_000


@pytest.fixture(scope="module", params=["mount at base_link", "IMU mounted apart"])
def driven(request) -> tuple[Recording, np.ndarray]:
    """A drive through start-up with fixes 80 to 200 ms late, and every published row."""
    apart = {"imu_position": (0.5, -0.3, 0.8), "imu_rpy_deg": (0.0, 0.0, 90.0)} if "apart" in request.param else {}
    recording = simulate("drive", seed=4, imu_rate=100.0, start=10.0, stop=70.0, position_std=(3.0, 5.0), **apart)
    navigator = Navigator(from_mapping(recording.parameters()))
    rows = []
    for epoch, arrival in enumerate(recording.fix_arrival):
        rows.append(give_imu(navigator, recording, arrival))
        give_fix(navigator, recording, epoch)
    return recording, np.concatenate(rows)


def give_imu(navigator: Navigator, recording: Recording, until: int) -> np.ndarray:
    """Push the IMU samples newer than those the navigator has, up to ``until`` (ns)."""
    part = (recording.imu_stamp > navigator.state["imu"]["stamp"][0]) & (recording.imu_stamp <= until)
    return navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])


def give_fix(navigator: Navigator, recording: Recording, epoch: int) -> None:
    """Push position and velocity of one GNSS epoch."""
    navigator.push_gnss_position(
        int(recording.fix_stamp[epoch]),
        float(recording.fix_latitude_deg[epoch]),
        float(recording.fix_longitude_deg[epoch]),
        float(recording.fix_altitude[epoch]),
        recording.fix_covariance[epoch],
        2,
        0,
    )
    navigator.push_gnss_velocity(
        int(recording.velocity_stamp[epoch]), recording.velocity_enu[epoch], recording.velocity_covariance[epoch]
    )


def heading(quaternion: np.ndarray) -> np.ndarray:
    w, x, y, z = quaternion.T
    return np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def steps_of(positions: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """How far each row is from where the velocity takes the one before (m)."""
    dt = np.diff(rows["stamp"])[:, None] * 1e-9
    return np.linalg.norm(np.diff(positions, axis=0), axis=1) - np.linalg.norm(rows["velocity_body"][:-1] * dt, axis=1)


def test_the_local_pose_does_not_jump_where_the_map_pose_does(driven):
    _, rows = driven
    known = rows[rows["heading_known"]]
    assert np.abs(steps_of(known["position_map"], known)).max() > 0.1
    # A step is that of the latest velocity: corrections of the velocity and of roll and pitch are millimetres.
    assert np.abs(steps_of(known["position_odom"], known)).max() < 0.03
    turn = np.diff(heading(rows["attitude_body_to_odom"]))
    rate = rows["angular_rate_body"][1:, 2] * np.diff(rows["stamp"]) * 1e-9
    assert np.abs(turn - rate).max() < 0.01
    assert np.abs(np.diff(heading(rows["attitude_body_to_map"]))).max() > 0.1


def test_roll_and_pitch_are_those_of_the_map_pose(driven):
    _, rows = driven
    leaning = []
    for field in ("attitude_body_to_map", "attitude_body_to_odom"):
        w, x, y, z = rows[field].T
        leaning.append((2 * (w * y - x * z), np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))))
    np.testing.assert_allclose(leaning[1], leaning[0], rtol=0.0, atol=1e-9)


def test_the_local_pose_is_published_from_the_start_of_levelling(driven):
    recording, rows = driven
    assert rows["stamp"][0] < recording.imu_stamp[0] + 2.5e9
    assert rows["status"][0] < Status.ALIGNING
    np.testing.assert_allclose(rows["position_odom"][0], 0.0, rtol=0.0, atol=1.0)


def test_the_local_pose_drifts_no_more_than_its_covariance_says(driven):
    """Distance and turn since the pull-away against the truth, in units of the published sigma."""
    recording, rows = driven
    known = rows[rows["heading_known"] & np.isin(rows["stamp"], recording.truth_stamp)]
    first, last = known[100], known[-1]
    truth = [np.searchsorted(recording.truth_stamp, row["stamp"]) for row in (first, last)]
    moved = last["position_odom"] - first["position_odom"]
    true = np.subtract(*recording.truth_position_map[truth[::-1]])
    sigma = math.sqrt(2.0 * last["local_position_variance"])
    assert abs(np.linalg.norm(moved) - np.linalg.norm(true)) < 3.0 * sigma
    assert np.all(np.diff(rows["local_position_variance"]) >= 0.0)
    assert np.all(np.diff(rows["local_heading_variance"]) >= 0.0)


def test_a_new_datum_moves_the_map_and_not_the_local_pose(driven):
    recording, _ = driven
    navigator = Navigator(from_mapping(recording.parameters()))
    half = len(recording.imu_stamp) // 2
    rows = []
    for epoch, stamp in enumerate(recording.fix_stamp[recording.fix_stamp < recording.imu_stamp[half]]):
        rows.append(give_imu(navigator, recording, stamp))
        give_fix(navigator, recording, epoch)
    assert navigator.set_datum_here()
    rows.append(give_imu(navigator, recording, recording.imu_stamp[half]))
    around = np.concatenate(rows)[-50:]
    assert np.linalg.norm(around["position_map"][-1] - around["position_map"][0]) > 50.0
    assert np.abs(steps_of(around["position_odom"], around)).max() < 0.03
    turn = np.diff(heading(around["attitude_body_to_odom"]))
    assert np.abs(turn - around["angular_rate_body"][1:, 2] * np.diff(around["stamp"]) * 1e-9).max() < 0.01


def test_a_heading_that_wheels_tell_turns_the_map_and_not_the_local_pose(driven):
    """The search says a quarter turn, and is as good as sure when the next message of the wheels comes."""
    recording, _ = driven
    navigator = Navigator(from_mapping({**recording.parameters(), "gnss.lever_arm": [2.0, 1.0, 0.5]}))
    until = int(recording.imu_stamp[0]) + 7 * SECOND
    for epoch in range(int(np.searchsorted(recording.fix_stamp, until))):
        give_imu(navigator, recording, recording.fix_stamp[epoch])
        give_fix(navigator, recording, epoch)
    before = give_imu(navigator, recording, until)[-1]
    state = navigator._states[0]
    assert state["search"]["started"] == 1
    assert state["heading_known"] == 0
    quarter = SEARCH_COSINE, SEARCH_COSINE + 1
    state["search"]["estimate"][list(quarter)] = 0.0, 1.0
    state["search"]["covariance"][quarter, :] = state["search"]["covariance"][:, quarter] = 0.0
    state["search"]["covariance"][quarter, quarter] = 1e-5
    navigator.push(Stream.WHEEL, until + 1, (1.0, 0.0, 0.0), np.diag([100.0, 1.0, -1.0]).ravel())
    after = give_imu(navigator, recording, until + SECOND // 20)[-1]
    assert navigator.state["heading_known"][0] == 1
    turned = heading(np.array([after["attitude_body_to_map"], before["attitude_body_to_map"]]))
    assert abs(turned[0] - turned[1]) > 1.0
    stayed = heading(np.array([after["attitude_body_to_odom"], before["attitude_body_to_odom"]]))
    assert abs(stayed[0] - stayed[1]) < 0.01
    assert np.linalg.norm(after["position_odom"] - before["position_odom"]) < 0.1
