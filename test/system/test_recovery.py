"""Recovery: who wins when fixes and filter disagree, and what that costs.

Few seeds of the scenarios of `benchmark/recovery.py`, which has the figures of a hundred.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Phase, Stream, Verdict
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.episodes import Episode, Outage
from eskf_ros.simulate.gnss_episodes import Multipath, Spoofing
from eskf_ros.simulate.scenario import Recording, simulate
from monte_carlo import NO_SIDE_SLIP, feed, nees, state_error
from recovery import BEGIN, CASES, Case, Outcome, Run, run_case

SEEDS = (1, 2, 3)
SECOND = 1_000_000_000
POSITION_ONLY = {"gnss.use_velocity": False}
INPUTS = pytest.mark.parametrize("changes", [{}, POSITION_ONLY], ids=["with_velocity", "position_only"])


def outcomes(label: str, changes: dict[str, Any]) -> list[Outcome]:
    case = next(case for case in CASES if case.label == label)
    return [run_case(case, seed, changes)[0] for seed in SEEDS]


def verdicts_of(done: Run, begin: float = BEGIN, end: float = np.inf) -> np.ndarray:
    """What became of the fixes with stamps in an interval (s from the start)."""
    first = done.records["stamp"].min()
    seconds = (done.records["stamp"] - first) / SECOND
    chosen = (done.records["stream"] == Stream.GNSS_POSITION) & (seconds >= begin) & (seconds < end)
    return np.asarray(done.records["verdict"][chosen])


@INPUTS
@pytest.mark.parametrize("label", ["clean", "one fix off by 30 m", "multipath of 25 m for 5 s", "covariance all zero"])
def test_what_is_short_or_harmless_leaves_no_trace(label: str, changes: dict[str, Any]) -> None:
    for outcome in outcomes(label, changes):
        assert outcome.resets == outcome.restarts == 0
        assert max(outcome.during, outcome.after) < 1.5
        assert outcome.nees < 8.0


@INPUTS
def test_after_an_outage_the_first_good_fix_is_accepted(changes: dict[str, Any]) -> None:
    case = Case("outage", 60.0, (Outage(BEGIN, 60.0),))
    for seed in SEEDS:
        outcome, done, _ = run_case(case, seed, changes)
        assert verdicts_of(done, BEGIN + 60.0)[0] == Verdict.FUSED
        assert outcome.recovery < 1.0
        assert outcome.resets == outcome.restarts == 0


@INPUTS
def test_bad_fixes_after_an_outage_do_not_hold_the_filter(changes: dict[str, Any]) -> None:
    for outcome in outcomes("60 s without GNSS, then 5 bad fixes", changes):
        assert outcome.recovery < 5.0
        assert outcome.restarts == 0
        # Attitude and biases keep what the bad ones did to them.
        assert outcome.nees < 20.0


@INPUTS
def test_millimetres_claimed_for_metres_are_not_believed(changes: dict[str, Any]) -> None:
    for seed in SEEDS:
        case = next(case for case in CASES if "claimed" in case.label)
        outcome, done, _ = run_case(case, seed, changes)
        assert outcome.during < 3.0
        # Twenty seconds on, the covariance is that of the errors there are.
        told = (done.seconds > BEGIN + 20.0) & (done.seconds < BEGIN + 60.0)
        assert np.mean(nees(done.error[told], done.covariance[told], slice(0, 3))) < 9.0
        assert np.mean(verdicts_of(done, BEGIN + 20.0, BEGIN + 60.0) == Verdict.FUSED) > 0.8


def test_a_position_that_is_drawn_away_is_caught_by_the_velocity() -> None:
    for seed in SEEDS:
        case = next(case for case in CASES if "drawn away" in case.label)
        outcome, _, _ = run_case(case, seed)
        assert outcome.during < 3.0
        assert outcome.after < 3.0
        assert outcome.resets == outcome.restarts == 0


@pytest.mark.parametrize(("length", "resets"), [(3.9, 0), (8.0, 0)])
def test_after_an_outage_fewer_fixes_than_a_cluster_do_not_win(length: float, resets: int) -> None:
    """At 1 Hz: four fixes that are 300 m off, or eight. The right ones win over those in the same time."""
    episodes: tuple[Episode, ...] = (Outage(BEGIN, 20.0), Multipath(BEGIN + 20.0, length, (240.0, -180.0, 0.0)))
    case = Case("away", 20.0 + length, episodes, {"gnss_rate": 1.0})
    outcome, done, navigator = run_case(case, 1)
    assert navigator.position_resets == resets
    assert np.count_nonzero(done.records["verdict"] == Verdict.RESET) == resets
    assert outcome.recovery < (2.0 if resets == 0 else 7.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_fixes_that_have_drawn_the_filter_away_are_followed_when_they_come_back(seed: int) -> None:
    """40 s of a walk of 1 m/s that no velocity contradicts: the filter is with the fixes within seconds of its end."""
    case = Case("away", 40.0, (Spoofing(BEGIN, 40.0, (1.0, 0.0, 0.0), 0.1),))
    outcome, _, navigator = run_case(case, seed, POSITION_ONLY)
    assert navigator.takeovers > 0
    assert outcome.recovery < 4.0


def test_agreeing_fixes_that_contradict_the_velocity_do_not_win() -> None:
    """Half a minute of fixes in one line, far away, and their velocities say that they should stand still there."""
    episodes = (
        Multipath(BEGIN, 30.0, (100.0, 0.0, 0.0)),
        Spoofing(BEGIN, 30.0, (2.0, 0.0, 0.0), 50.0, consistent=False),
    )
    outcome, _, navigator = run_case(Case("away", 30.0, episodes), 1)
    assert navigator.position_resets == 0
    assert outcome.during < 2.0
    # The same without the drift does win, after half a minute.
    away = Multipath(BEGIN, 40.0, (100.0, 0.0, 0.0))
    _, done, navigator = run_case(Case("away", 40.0, (away,)), 1)
    assert navigator.position_resets > 0
    verdicts = verdicts_of(done, BEGIN, BEGIN + 40.0)
    assert 150 <= int(np.argmax(verdicts == Verdict.RESET)) <= 155


def recorded(*episodes: Episode, **options: Any) -> Recording:
    return simulate("drive", 1, **{"imu_rate": 100.0, "stop": 150.0, "episodes": episodes, **options})


def navigator_for(recording: Recording, **changes: Any) -> Navigator:
    return Navigator(from_mapping({**recording.parameters(), **NO_SIDE_SLIP, **changes}))


FAR_AWAY = Multipath(BEGIN, 45.0, (100.0, -50.0, 20.0))


@INPUTS
def test_a_reset_moves_position_and_velocity_and_nothing_else(changes: dict[str, Any]) -> None:
    """No jump of the local odometry either; position and velocity are those of the fixes within their new sigma."""
    recording = recorded(FAR_AWAY)
    navigator = navigator_for(recording, **changes)
    stops = np.arange(99, len(recording.imu_stamp))
    rows, before, seen = [], None, 0
    for i, state in feed(recording, navigator, stops):
        rows.append(navigator.odometry[0])
        if navigator.position_resets > seen == 0:
            assert before is not None
            jump = state["position_map"] - before["position_map"]
            truth = int(np.searchsorted(recording.truth_stamp, recording.imu_stamp[i]))
            error = state_error(recording, i, truth, state)
            seen = navigator.position_resets
            turn = 2.0 * np.linalg.norm(np.cross(state["attitude"][1:], before["attitude"][1:]))
            assert np.linalg.norm(jump) > 80.0
            assert turn < 0.01
            assert np.abs(state["accel_bias"] - before["accel_bias"]).max() < 0.01
            assert np.abs(state["gyro_bias"] - before["gyro_bias"]).max() < 1e-3
            error[:3] += FAR_AWAY.offset
            assert nees(error, state["covariance"][:15, :15], slice(0, 3)) < 16.0
            assert nees(error, state["covariance"][:15, :15], slice(3, 6)) < 16.0
        before = state
    assert seen == 1
    local = np.array([row["position_odom"] for row in rows])
    assert np.linalg.norm(np.diff(local, axis=0), axis=1).max() < 0.3
    assert navigator.restarts == 0
    assert [sentence for sentence in navigator.complaints if "reset" in sentence]


def test_the_phases_of_an_aid() -> None:
    """An outage, a step that is too short to win, and one that is not."""
    episodes = (Outage(80.0, 10.0), Multipath(105.0, 4.0, (60.0, 0.0, 0.0)), Multipath(118.0, 15.0, (60.0, 0.0, 0.0)))
    recording = recorded(*episodes, stop=132.0)
    navigator = navigator_for(recording)
    at = {}
    for i, _ in feed(recording, navigator, np.arange(49, len(recording.imu_stamp), 50)):
        at[(i + 1) / 100] = [navigator.phase(Stream.GNSS_POSITION), navigator.phase(Stream.GNSS_VELOCITY)]
    assert at[1.0] == [Phase.WAITING, Phase.WAITING]
    assert at[79.0] == [Phase.FUSING, Phase.FUSING]
    assert at[85.0] == [Phase.OUTAGE, Phase.OUTAGE]
    assert at[92.0] == [Phase.REACQUIRING, Phase.REACQUIRING]
    assert at[104.0] == [Phase.FUSING, Phase.FUSING]
    assert at[105.5] == [Phase.SUSPICIOUS, Phase.FUSING]
    assert at[108.0] == [Phase.REACQUIRING, Phase.FUSING]
    assert at[117.5] == [Phase.REACQUIRING, Phase.FUSING]
    assert at[124.0] == [Phase.REACQUIRING, Phase.FUSING]
    assert at[131.0] == [Phase.RESET, Phase.FUSING]
    assert navigator.phase(Stream.BARO) == Phase.WAITING


def test_late_fixes_change_nothing_of_a_recovery() -> None:
    """Whether messages arrive as on the robot, or all fixes at once and late: every bit of the state is the same."""
    recording = recorded(FAR_AWAY, stop=140.0)
    states = []
    for every in (7, 150):
        navigator = navigator_for(recording)
        stops = np.unique(np.append(np.arange(99, len(recording.imu_stamp), every), len(recording.imu_stamp) - 1))
        for _ in feed(recording, navigator, stops):
            pass
        assert navigator.position_resets == 1
        states.append(navigator.state[0])
    names = [name for name in states[0].dtype.names if name not in ("imu_next", "aid_next")]
    assert [name for name in names if states[0][name].tobytes() != states[1][name].tobytes()] == []


def test_a_heading_that_is_wrong_and_sure_is_corrected() -> None:
    """A heading that is wrong by a right angle and claimed to be sure: the filter without it finds another one."""
    recording = recorded(stop=240.0)
    navigator = navigator_for(recording)
    for i, state in feed(recording, navigator, np.arange(99, len(recording.imu_stamp), 100)):
        if (i + 1) / 100 == 70.0:
            position, heading = tuple(state["position_map"]), float(np.pi)
            navigator.set_pose(position, 0.01 * np.eye(3), heading, 1e-4)
    truth = int(np.searchsorted(recording.truth_stamp, recording.imu_stamp[i]))
    error = state_error(recording, i, truth, navigator.state[0])
    assert navigator.restarts == 0
    assert navigator.takeovers > 0
    assert np.linalg.norm(error[:2]) < 3.0
    assert abs(error[8]) < 0.1


def test_a_few_bad_fixes_after_a_long_outage_do_not_start_the_alignment_again() -> None:
    """The minute that fixes have to come in vain does not begin with the outage."""
    episodes = (Outage(BEGIN, 65.0), Multipath(BEGIN + 65.0, 1.6, (500.0, 0.0, 0.0)))
    outcome, done, navigator = run_case(Case("away", 66.6, episodes, {"gnss_rate": 5.0}), 1)
    doubted = (Verdict.GATE, Verdict.CONTRADICTED, Verdict.WEIGHED_DOWN)
    assert np.count_nonzero(np.isin(verdicts_of(done, BEGIN + 65.0), doubted)) > 5
    assert navigator.restarts == 0
    assert outcome.recovery < 3.0
