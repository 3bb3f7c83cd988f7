"""Heading of a dual antenna: Jacobian, conventions, how it starts the filter, and what a wrong one does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from test_aiding import geodetic_of, local_axes_in_map

from eskf_ros.bags import Batch, message_dtype
from eskf_ros.filter.measurements import heading
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state import augmented_states
from eskf_ros.filter.state.enums import Status, Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.inputs.table import INPUTS
from eskf_ros.simulate.dual_antenna import DualAntenna
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import simulate
from monte_carlo import feed, nees, run
from support.aided import AidedNavigator, run_aided
from support.kernels import Array, make_settings, make_state, make_work, random_state, with_error

SECOND = 1_000_000_000
MOUNT = {"imu__mount_position": [0.3, 0.1, -0.2], "imu__mount_rpy_deg": [10.0, -20.0, 130.0]}
YAW = slice(8, 9)
SETTINGS = make_settings(heading__mount_rpy_deg=[0.0, -7.0, 80.0], **MOUNT)

seeds = pytest.mark.parametrize("seed", range(5))
places = pytest.mark.parametrize("far", [0.0, 50e3, 500e3])


def payload(yaw: float, pitch: float, variances: tuple[float, float], mixed: float = 0.0) -> Array:
    return np.array([yaw, pitch, 0.0, variances[0], mixed, 0.0, variances[1], 0.0, -1.0, *np.zeros(7)])


def levelled(seed: int, far: float) -> Any:
    """Return a running filter whose baseline is at most 70 degrees from level."""
    while True:
        state = random_state(seed, far)
        if abs(heading.predict(state, 0, SETTINGS)[1]) < math.radians(70.0):
            return state
        seed += 100


# ------------------------------------------------------------------------------------------------ the measurement


@places
@seeds
@pytest.mark.parametrize("source", [0, 1])
def test_jacobian(seed: int, far: float, source: int) -> None:
    state, work = levelled(seed, far), make_work()
    if abs(heading.predict(state, source, SETTINGS)[1]) > math.radians(75.0):
        pytest.skip("too steep for this line")
    assert heading.linearize(state, payload(0.3, 0.1, (1e-4, 4e-4), 1e-5), source, SETTINGS, work) == 2
    expected = np.zeros((2, 15))
    for j in range(6, 9):
        error = 1e-5 * np.eye(15)[j]
        plus, minus = (np.array(heading.predict(with_error(state, k * error), source, SETTINGS)) for k in (1.0, -1.0))
        expected[:, j] = np.remainder(plus - minus + math.pi, math.tau) - math.pi
    np.testing.assert_allclose(work["jacobian"][:2, :15], expected / 2e-5, rtol=0.0, atol=1e-7)
    assert np.abs(work["jacobian"][:2, 6:9]).max(axis=1).min() > 0.5
    np.testing.assert_array_equal(work["noise"][:2, :2], [[1e-4, 1e-5], [1e-5, 4e-4]])


@places
@seeds
def test_yaw_is_about_the_local_vertical_from_the_local_east(seed: int, far: float) -> None:
    """Far from the datum the axes of map are degrees off; the direction of the baseline by way of pymap3d."""
    state, work = levelled(seed, far), make_work()
    axes = local_axes_in_map(state, *geodetic_of(state)[:2])
    base_to_imu = Rotation.from_euler("xyz", MOUNT["imu__mount_rpy_deg"], degrees=True).inv()
    baseline = base_to_imu.apply(Rotation.from_euler("xyz", [0.0, -7.0, 80.0], degrees=True).apply([1.0, 0.0, 0.0]))
    w, x, y, z = state["attitude"]
    east, north, up = axes.T @ Rotation.from_quat([x, y, z, w]).apply(baseline)
    measured = payload(math.atan2(north, east) + 0.01, math.asin(-up) - 0.02, (1e-4, 1e-4))
    heading.linearize(state, measured, 0, SETTINGS, work)
    np.testing.assert_allclose(work["innovation"][:2], (0.01, -0.02), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("turns", [-1.0, 0.0, 1.0])
@pytest.mark.parametrize("off", [-3.0, -0.01, 0.02, 3.1])
def test_the_innovation_is_the_short_way_round(turns: float, off: float) -> None:
    settings = make_settings()
    work = make_work()
    for yaw_deg in (-179.9, -90.0, 0.0, 179.9):
        state = make_state(attitude=Rotation.from_euler("z", yaw_deg, degrees=True))
        measured = math.radians(yaw_deg) + off + math.tau * turns
        heading.linearize(state, payload(measured, 0.0, (1e-4, -1.0)), 0, settings, work)
        assert work["innovation"][0] == pytest.approx(off, abs=1e-6)


def test_the_offset_is_in_yaw_alone() -> None:
    state, plain, work = levelled(1, 0.0), make_work(), make_work()
    heading.linearize(state, payload(0.3, 0.1, (1e-4, 4e-4)), 0, SETTINGS, plain)
    augmented_states.update_error_size(state, SETTINGS["reach"][Stream.HEADING], SETTINGS)
    place = int(SETTINGS["heading_offset_at"])
    state["optional"][place - ERROR_SIZE] = 0.02
    heading.linearize(state, payload(0.3, 0.1, (1e-4, 4e-4)), 0, SETTINGS, work)
    np.testing.assert_allclose(plain["innovation"][:2] - work["innovation"][:2], (0.02, 0.0), rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(work["jacobian"][:2, place], (1.0, 0.0))
    heading.linearize(state, payload(0.3, 0.1, (1e-4, 4e-4)), 1, SETTINGS, work)
    assert (work["jacobian"][:, place] == 0.0).all()


def test_what_was_not_measured_is_left_out() -> None:
    state, work = levelled(1, 0.0), make_work()
    both, yaw, pitch = (make_work() for _ in range(3))
    assert heading.linearize(state, payload(0.3, 0.1, (1e-4, 4e-4)), 0, SETTINGS, both) == 2
    assert heading.linearize(state, payload(0.3, 0.0, (1e-4, -1.0)), 0, SETTINGS, yaw) == 1
    assert heading.linearize(state, payload(0.0, 0.1, (-1.0, 4e-4)), 0, SETTINGS, pitch) == 1
    assert heading.linearize(state, payload(0.0, 0.0, (-1.0, -1.0)), 0, SETTINGS, work) == 0
    for row, one in enumerate((yaw, pitch)):
        assert one["innovation"][0] == both["innovation"][row]
        assert one["noise"][0, 0] == both["noise"][row, row]
        np.testing.assert_array_equal(one["jacobian"][0], both["jacobian"][row])


def test_an_upright_baseline_has_no_heading() -> None:
    settings = make_settings()
    work = make_work()
    for pitch_deg, size in ((60.0, 2), (85.0, 0), (-85.0, 0)):
        state = make_state(attitude=Rotation.from_euler("xyz", [0.0, pitch_deg, 30.0], degrees=True))
        assert heading.linearize(state, payload(0.5, 1.0, (1e-4, 1e-4)), 0, settings, work) == size


# ------------------------------------------------------------------------------------------------------- the door


def judged(*covariance: float, yaw: float = 1.0) -> np.void:
    """Return the record, on a running robot, of a message with this diagonal."""
    recording = simulate("drive", 2, imu_rate=50.0, stop=12.0)
    navigator = AidedNavigator(recording, alignment__initial_heading_deg=35.0)
    for _ in feed(recording, navigator, np.array([len(recording.imu_stamp) - 1])):
        pass
    navigator.push(Stream.HEADING, int(recording.imu_stamp[-1]), (yaw, 0.0, 0.0), np.diag(covariance).ravel())
    records = navigator.finish()
    return records[records["stream"] == Stream.HEADING][-1]


@pytest.mark.parametrize(
    ("covariance", "dof"),
    [
        ((1e-4, 1e-4, -1.0), 2),
        ((1e-4, 1000.0, -1.0), 1),  # u-blox: what it does not know
        ((1e-4, math.pi**2, math.pi**2), 1),
        ((0.0, 0.0, 0.0), 1),  # no covariance: one degree stands in for that of the yaw
    ],
)
def test_only_angles_that_were_measured_count(covariance: tuple[float, ...], dof: int) -> None:
    record = judged(*covariance, yaw=math.radians(36.0))
    assert (record["verdict"], record["dof"]) == (Verdict.FUSED, dof)


@pytest.mark.parametrize(
    ("covariance", "yaw", "verdict"),
    [
        ((1000.0, 1000.0, 1000.0), 1.0, Verdict.BAD_COVARIANCE),
        ((-1.0, -1.0, -1.0), 1.0, Verdict.BAD_COVARIANCE),
        ((1e-4, -1.0, -1.0), math.nan, Verdict.NON_FINITE),
        ((1e-4, -1.0, -1.0), 271.0, Verdict.BAD_VALUE),
        ((1e-4, -1.0, -1.0), math.radians(35.0 + 180.0), Verdict.GATE),
    ],
)
def test_impossible_messages_are_named(covariance: tuple[float, ...], yaw: float, verdict: Verdict) -> None:
    assert judged(*covariance, yaw=yaw)["verdict"] == verdict


def test_orientations_that_are_none_do_not_become_a_heading() -> None:
    """All zero, not a number, or declared as absent (REP-145); yaw and pitch of the others by way of scipy."""
    messages = np.zeros(4, message_dtype("sensor_msgs/msg/Imu"))
    messages["stamp"] = np.arange(4)
    messages["orientation"][0] = Rotation.from_euler("ZYX", [2.5, -0.3, 0.0]).as_quat()
    messages["orientation"][1] = math.nan
    messages["orientation"][3] = (0.0, 0.0, 0.0, 1.0)
    messages["orientation_covariance"][:, [0, 4, 8]] = (1000.0, 0.04, 0.01)
    messages["orientation_covariance"][3] = (-1.0, *np.zeros(8))
    kind = next(kind for kind in INPUTS if kind.stream == Stream.HEADING)
    good, nothing, zero, absent = kind.arguments(Batch(np.arange(4), messages, ["gps"]))
    np.testing.assert_allclose(good[1], (2.5, -0.3, 0.0), atol=1e-12)
    np.testing.assert_array_equal(good[2][[0, 4, 8]], (0.01, 0.04, -1.0))
    assert math.isnan(nothing[1][0])
    assert math.isnan(zero[1][0])
    assert (absent[2] == -1.0).all()


# -------------------------------------------------------------------------------------------------------- start-up


def standing(seed: int, **options: Any) -> Recording:
    return simulate("drive", seed, imu_rate=50.0, stop=15.0, **options)


def heading_error(recording: Recording, navigator: Navigator) -> float:
    """Return the error of the heading in sigma."""
    row = navigator.odometry[0]
    truth = recording.truth_attitude_body_to_map[np.searchsorted(recording.truth_stamp, row["stamp"])]
    found = row["attitude_body_to_map"]
    turn = Rotation.from_quat(np.roll(truth, -1)) * Rotation.from_quat(np.roll(found, -1)).inv()
    return float(turn.as_rotvec()[2] / math.sqrt(row["pose_covariance"][5, 5]))


def run_through(recording: Recording, navigator: Navigator) -> None:
    for _ in feed(recording, navigator, np.array([len(recording.imu_stamp) - 1])):
        pass


@pytest.mark.parametrize("baseline", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -0.8, 0.1), (0.5, 0.5, -0.4)])
def test_a_parked_robot_knows_its_heading_after_seconds(baseline: tuple[float, float, float]) -> None:
    recording = standing(3, dual_antenna=DualAntenna(baseline), imu_rpy_deg=(170.0, 20.0, -60.0))
    navigator = AidedNavigator(recording)
    run_through(recording, navigator)
    assert navigator.status == Status.GOOD
    assert abs(heading_error(recording, navigator)) < 4.0
    assert navigator.odometry["pose_covariance"][0, 5, 5] < math.radians(0.3) ** 2
    verdicts = navigator.finish()
    of_heading = verdicts[verdicts["stream"] == Stream.HEADING]["verdict"]
    # Once it is known every message counts; before, it took a position and a few that agree.
    assert set(of_heading[20:]) == {Verdict.FUSED}
    assert set(of_heading[:10]) == {Verdict.BEFORE_ALIGNMENT}


def test_the_error_at_the_start_is_what_its_sigma_says() -> None:
    """Thirty parked robots, right after the heading became known."""
    squares = []
    for seed in range(30):
        recording = simulate("drive", seed, imu_rate=50.0, stop=4.0, dual_antenna=DualAntenna(yaw_std_deg=1.0))
        navigator = AidedNavigator(recording)
        run_through(recording, navigator)
        assert navigator.odometry["heading_known"][0]
        squares.append(heading_error(recording, navigator) ** 2)
    assert chi2.ppf(1e-4, 30) < sum(squares) < chi2.ppf(1.0 - 1e-4, 30)


@pytest.mark.parametrize("place", range(4))
def test_a_wild_message_does_not_start_the_filter(place: int) -> None:
    recording = standing(4, dual_antenna=DualAntenna())
    navigator = AidedNavigator(recording)
    # After position and level are known: one of those that would have been believed.
    first = next(k for k, offer in enumerate(navigator.offers) if offer[0] > recording.imu_stamp[0] + 2.1 * SECOND)
    stamp, stream, values, covariance, arrival = navigator.offers[first + place]
    navigator.offers[first + place] = (stamp, stream, (values[0] + 2.0, 0.0, 0.0), covariance, arrival)
    run_through(recording, navigator)
    assert navigator.status == Status.GOOD
    assert abs(heading_error(recording, navigator)) < 4.0


@pytest.mark.parametrize("name", ["multirotor", "drive", "boat"])
def test_the_covariance_is_honest_with_a_dual_antenna(name: str) -> None:
    attitude, position, known = [], [], []
    for seed in range(4):
        recording = simulate(name, seed, imu_rate=50.0, stop=80.0, dual_antenna=DualAntenna(pitch_std_deg=0.6))
        result = run_aided(recording, alignment__use_course=False)
        settled = result.aligned
        known.append(result.seconds[settled][0])
        attitude.append(nees(result.error[settled], result.covariance[settled], slice(6, 9)).mean())
        position.append(nees(result.error[settled], result.covariance[settled], slice(0, 3)).mean())
        yaw = np.degrees(result.error[settled, 8][10:])
        assert np.sqrt(np.mean(yaw**2)) < 0.15
        nis = result.records[(result.records["stream"] == Stream.HEADING) & (result.records["dof"] == 2)]["nis"]
        assert 1.6 < nis.mean() < 2.4
    assert max(known) < 6.0
    assert 1.0 < np.mean(attitude) < 6.0, attitude
    assert 1.5 < np.mean(position) < 5.0, position


def test_a_baseline_askew_is_part_of_the_sigma_and_found_on_the_way() -> None:
    """Antennas mounted some degree off: with the state for it the heading is honest, without it is not."""
    means: dict[float, list[float]] = {1.5: [], 0.0: []}
    for seed in range(4):
        recording = simulate("drive", seed, imu_rate=50.0, stop=80.0, dual_antenna=DualAntenna())
        askew = 1.5 * float(np.random.default_rng(seed).normal())
        for std, values in means.items():
            changes = {"heading__mount_rpy_deg": [0.0, 0.0, askew], "heading__offset_std_deg": std}
            navigator = AidedNavigator(recording, **changes, alignment__use_course=False)
            result = run(recording, navigator)
            parts = np.array_split(nees(result.error[result.aligned], result.covariance[result.aligned], YAW), 8)
            values += [part.mean() for part in parts]
            if std > 0.0:
                state, place = navigator.state[0], int(navigator._settings["heading_offset_at"][0])
                # What is measured is less than what it is said to be by as much as the baseline is told to be askew.
                off = state["optional"][place - ERROR_SIZE] + math.radians(askew)
                assert abs(off) < 4.0 * math.sqrt(state["covariance"][place, place])
                assert abs(math.degrees(off)) < 0.4
    assert 0.2 < np.mean(means[1.5]) < 2.5, means
    assert np.mean(means[0.0]) > 10.0, means


# ------------------------------------------------------------------------------------------------- what goes wrong


def swapped(stop: float = 70.0, **changes: Any) -> tuple[Recording, AidedNavigator]:
    """A drive with the second antenna in front, told to be behind."""
    recording = simulate("drive", 5, imu_rate=50.0, stop=stop, dual_antenna=DualAntenna())
    navigator = AidedNavigator(recording, heading__mount_rpy_deg=[0.0, 0.0, 180.0], **changes)
    run_through(recording, navigator)
    return recording, navigator


def test_swapped_antennas_are_named_when_the_heading_is_known_otherwise() -> None:
    recording, navigator = swapped(alignment__initial_heading_deg=35.0)
    assert [sentence for sentence in navigator.complaints if "dual antenna differ" in sentence and "180" in sentence]
    assert abs(heading_error(recording, navigator)) < 4.0


@pytest.mark.parametrize("wrong_by", [0.0, 60.0, 180.0])
@pytest.mark.parametrize("use_velocity", [True, False])
def test_a_wrong_heading_that_was_given_does_not_stay(wrong_by: float, use_velocity: bool) -> None:
    """The antennas say so from the first message on; motion decides between them, and then they are fused."""
    recording = simulate("drive", 6, imu_rate=50.0, stop=90.0, dual_antenna=DualAntenna())
    w, x, y, z = recording.truth_attitude_body_to_map[0]
    given = math.degrees(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))) + wrong_by
    changes = {"alignment__initial_heading_deg": given, "gnss__use_velocity": use_velocity}
    navigator = AidedNavigator(recording, **changes)
    complained = False
    for _ in feed(recording, navigator, np.arange(499, len(recording.imu_stamp), 500)):
        complained = complained or any("contradict each other" in sentence for sentence in navigator.complaints)
    assert complained == (wrong_by != 0.0)
    assert navigator.restarts == (wrong_by != 0.0)
    assert abs(heading_error(recording, navigator)) < 4.0
    assert navigator.status == Status.GOOD
    assert len(navigator.complaints) == (wrong_by != 0.0)
    assert all(f"was off by {wrong_by:.0f} deg, and has been corrected" in text for text in navigator.complaints)
    records = navigator.finish()
    headings = records[records["stream"] == Stream.HEADING]
    assert (headings["verdict"][-100:] == Verdict.FUSED).mean() > 0.95


@pytest.mark.parametrize("wrong_by", [60.0, 180.0])
def test_a_pose_with_a_wrong_heading_gives_way_to_antennas_that_were_believed(wrong_by: float) -> None:
    recording = standing(6, dual_antenna=DualAntenna())
    navigator = AidedNavigator(recording)
    posed = False
    for i, state in feed(recording, navigator, np.arange(0, len(recording.imu_stamp), 10)):
        if not posed and recording.imu_stamp[i] > recording.imu_stamp[0] + 5 * SECOND:
            x, y, z, w = np.roll(navigator.odometry[0]["attitude_body_to_map"], -1)
            yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) + math.radians(wrong_by)
            posed = navigator.set_pose(state["position_map"].tolist(), np.eye(3), yaw, 0.1)
    assert posed
    assert navigator.restarts == 0
    assert abs(heading_error(recording, navigator)) < 4.0


def test_the_pitch_that_a_driver_leaves_zero_is_none() -> None:
    """On a slope it would contradict the attitude, and the yaw be refused with it."""
    (kind,) = (kind for kind in INPUTS if kind.stream == Stream.HEADING)
    messages = np.zeros(3, message_dtype("sensor_msgs/msg/Imu"))
    messages["orientation"][:, 3] = 1.0
    messages["orientation_covariance"][:, 8] = 1e-4
    messages["orientation_covariance"][1, 4] = 1e-4
    messages["orientation_covariance"][2] = 0.0
    covariances = [arguments[2] for arguments in kind.arguments(Batch(np.zeros(3, np.int64), messages, [""]))]
    assert [covariance[4] for covariance in covariances] == [-1.0, 1e-4, 0.0]
    assert [covariance[0] for covariance in covariances] == [1e-4, 1e-4, 0.0]


def test_swapped_antennas_are_named_when_they_are_the_only_source() -> None:
    """The motion refutes the heading that they gave, and then they are what differs from it."""
    recording, navigator = swapped(160.0)
    (sentence,) = [sentence for sentence in navigator.complaints if "dual antenna differ" in sentence]
    assert abs(abs(float(sentence.split("estimate by ")[1].split(" deg")[0])) - 180.0) < 10.0
    assert "are the antennas swapped" in sentence
    assert abs(heading_error(recording, navigator)) < 4.0


def test_good_antennas_are_not_accused() -> None:
    """In reverse for a while, too."""
    for name in ("reverse_start", "drive"):
        recording = simulate(name, 5, imu_rate=50.0, stop=70.0, dual_antenna=DualAntenna())
        navigator = AidedNavigator(recording)
        run_through(recording, navigator)
        assert navigator.complaints == []
        assert abs(heading_error(recording, navigator)) < 4.0
