"""What goes wrong with a simulated GNSS receiver goes wrong as declared, when declared, and nowhere else."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from eskf_ros.simulate import main as command
from eskf_ros.simulate.dual_antenna import DualAntenna
from eskf_ros.simulate.episodes import Episode, Outage
from eskf_ros.simulate.gnss import GnssReceiver
from eskf_ros.simulate.gnss_episodes import (
    RTK_SOLUTIONS,
    BadFixes,
    ClaimedStd,
    CorrelatedErrors,
    GnssEpisode,
    Multipath,
    Overconfidence,
    RtkSolution,
    Spoofing,
    ZeroCovariance,
)
from eskf_ros.simulate.recording import EPISODES
from eskf_ros.simulate.scenario import Recording, simulate
from support.simulated import TOPICS, antenna_errors, assert_chi_square, read, seconds

Array = NDArray[np.float64]

COARSE = {"imu_rate": 10.0, "truth_rate": 1.0}


def recorded(*episodes: Episode, seed: int = 2, **options: object) -> Recording:
    return simulate("drive", seed, episodes=episodes, **COARSE, **options)


def errors(recording: Recording) -> tuple[Array, Array]:
    return antenna_errors("drive", recording, recording.options.lever_arm)


def added_by(*episodes: Episode, **options: object) -> tuple[Array, Array, Array]:
    """Seconds, and what episodes add to the errors of position and velocity, by comparison with none."""
    plain, changed = recorded(**options), recorded(*episodes, **options)
    np.testing.assert_array_equal(plain.fix_stamp, changed.fix_stamp)
    before, after = errors(plain), errors(changed)
    return seconds(plain.fix_stamp), after[0] - before[0], after[1] - before[1]


def reported_std(recording: Recording) -> Array:
    return np.sqrt(recording.fix_covariance[:, ::4])


def test_multipath_is_a_step_of_the_position_alone() -> None:
    t, position, velocity = added_by(Multipath(40.0, 12.0, (8.0, -5.0, 3.0)))
    inside = (t >= 40.0) & (t < 52.0)
    assert inside.sum() == 60
    np.testing.assert_allclose(position[inside], np.tile([8.0, -5.0, 3.0], (60, 1)), atol=1e-5)
    np.testing.assert_allclose(position[~inside], 0.0, atol=1e-8)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-5)
    np.testing.assert_array_equal(reported_std(recorded(Multipath(40.0, 12.0))), reported_std(recorded()))


def test_bad_fixes_after_an_outage_fade() -> None:
    t, position, _ = added_by(BadFixes(80.0, 10.0, (30.0, 0.0, -10.0)), outages=((50.0, 80.0),))
    inside = (t >= 80.0) & (t < 90.0)
    assert 80.0 < t[inside][0] < 80.2, "they come right after the outage"
    east = position[inside, 0]
    assert 29.0 < east[0] < 30.0
    assert 1.5 < east[-1] < 1.6
    np.testing.assert_allclose(np.diff(np.log(east)), math.log(0.05) * 0.2 / 10.0, atol=1e-5)
    np.testing.assert_allclose(position[inside, 2], -east / 3.0, atol=1e-4)
    np.testing.assert_allclose(position[~inside], 0.0, atol=1e-8)


@pytest.mark.parametrize("consistent", [False, True])
def test_spoofing_draws_the_position_away_with_or_without_the_velocity(consistent: bool) -> None:
    spoofing = Spoofing(30.0, 60.0, (1.2, -1.6, 0.0), acceleration=0.1, consistent=consistent)
    t, position, velocity = added_by(spoofing)
    inside = (t >= 30.0) & (t < 90.0)
    along = position[inside] @ [0.6, -0.8, 0.0]
    np.testing.assert_allclose(position[inside], along[:, None] * [0.6, -0.8, 0.0], atol=1e-4)
    since = t[inside] - 30.0
    onset = since < 20.0  # 2 m/s at 0.1 m/s2
    np.testing.assert_allclose(along[onset], 0.05 * since[onset] ** 2, atol=1e-4)
    np.testing.assert_allclose(along[~onset], 20.0 + 2.0 * (since[~onset] - 20.0), atol=1e-4)
    if consistent:
        # The velocity is that of the false position.
        np.testing.assert_allclose(velocity[inside][1:-1], np.gradient(position[inside], 0.2, axis=0)[1:-1], atol=0.01)
    else:
        np.testing.assert_allclose(velocity, 0.0, atol=2e-4)
    np.testing.assert_allclose(position[~inside], 0.0, atol=1e-8)
    np.testing.assert_allclose(velocity[~inside], 0.0, atol=1e-8)


def test_correlated_errors_are_a_gauss_markov_process() -> None:
    """Stationary from the start, with the declared spread and the autocorrelation exp(-lag / correlation time)."""
    episode = CorrelatedErrors(0.0, math.inf, (2.0, 3.0), correlation_time=8.0)
    runs = []
    for seed in range(40):
        plain, changed = (recorded(*some, seed=seed, position_std=(0.5, 0.5)) for some in ((), (episode,)))
        runs.append((errors(changed)[0] - errors(plain)[0]) / [2.0, 2.0, 3.0])
    process = np.stack(runs)  # (seeds, epochs, axes)
    for epoch in (0, 100, -1):
        assert_chi_square(process[:, epoch])
    duration = 0.2 * process.shape[1]
    for lag in (1, 10, 40, 100, 200):
        expected = math.exp(-0.2 * lag / 8.0)
        found = np.mean(process[:, lag:] * process[:, :-lag])
        # Some 8 s of samples count as one: independent ones are duration / 16 s per run and axis.
        assert found == pytest.approx(expected, abs=5.0 / math.sqrt(40 * 3 * duration / 16.0)), lag
    innovation = process[:, 1:] - math.exp(-0.2 / 8.0) * process[:, :-1]
    assert_chi_square(innovation / math.sqrt(1.0 - math.exp(-0.4 / 8.0)))
    for first, second in ((0, 1), (1, 2)):
        assert abs(np.mean(innovation[..., first] * innovation[..., second])) < 5.0 * 0.05 / math.sqrt(
            innovation[..., 0].size
        )


def test_correlated_errors_are_in_the_covariance_reported() -> None:
    recording = recorded(CorrelatedErrors(50.0, 100.0, (2.0, 4.0), correlation_time=30.0), position_std=(1.5, 3.0))
    inside = (seconds(recording.fix_stamp) >= 50.0) & (seconds(recording.fix_stamp) < 150.0)
    np.testing.assert_allclose(reported_std(recording)[inside], np.tile([2.5, 2.5, 5.0], (500, 1)))
    np.testing.assert_allclose(reported_std(recording)[~inside][:, 2], 3.0)


def test_rtk_solutions_change_status_and_errors_together() -> None:
    episodes = (RtkSolution(0.0, 60.0, "fixed"), RtkSolution(60.0, 40.0, "float"), RtkSolution(100.0, 500.0, "single"))
    recording = recorded(*episodes)
    t, error = seconds(recording.fix_stamp), errors(recording)[0]
    for episode in episodes:
        # NavSatStatus: 0 fix, 1 with corrections, 2 with a base station.
        status = {"single": 0, "float": 1, "fixed": 2}[episode.solution]
        horizontal, vertical = RTK_SOLUTIONS[episode.solution][1]
        inside = episode.covers(t)
        assert inside.sum() >= 200
        assert (recording.fix_status[inside] == status).all()
        np.testing.assert_allclose(reported_std(recording)[inside][0], [horizontal, horizontal, vertical])
        assert_chi_square(error[inside] / [horizontal, horizontal, vertical])
    assert RTK_SOLUTIONS["fixed"][1] < RTK_SOLUTIONS["float"][1] < RTK_SOLUTIONS["single"][1]


def test_an_overconfident_receiver_errs_as_before() -> None:
    plain, sure = recorded(), recorded(Overconfidence(30.0, 100.0, factor=5.0))
    inside = (seconds(plain.fix_stamp) >= 30.0) & (seconds(plain.fix_stamp) < 130.0)
    for name in ("fix_covariance", "velocity_covariance"):
        np.testing.assert_allclose(getattr(sure, name)[inside] * 25.0, getattr(plain, name)[inside])
        np.testing.assert_array_equal(getattr(sure, name)[~inside], getattr(plain, name)[~inside])
    for name in ("fix_latitude_deg", "fix_longitude_deg", "fix_altitude", "velocity_enu"):
        np.testing.assert_array_equal(getattr(sure, name), getattr(plain, name))


def test_three_millimetres_are_claimed_for_errors_of_a_metre() -> None:
    recording = recorded(ClaimedStd(0.0, math.inf), position_std=(1.0, 1.0))
    np.testing.assert_allclose(reported_std(recording), 0.003)
    assert_chi_square(errors(recording)[0])
    np.testing.assert_array_equal(recording.velocity_covariance, recorded().velocity_covariance)


def test_zero_covariances_are_of_unknown_type() -> None:
    recording = recorded(ZeroCovariance(30.0, 100.0))
    inside = (seconds(recording.fix_stamp) >= 30.0) & (seconds(recording.fix_stamp) < 130.0)
    assert not recording.fix_covariance[inside].any()
    assert not recording.velocity_covariance[inside].any()
    assert not recording.fix_covariance_type[inside].any()
    assert recording.fix_covariance[~inside].any(axis=1).all()
    assert recording.velocity_covariance[~inside].any(axis=1).all()
    assert (recording.fix_covariance_type[~inside] == 2).all()


def test_episodes_combine_in_their_order() -> None:
    both = recorded(RtkSolution(20.0, 50.0), Overconfidence(40.0, 50.0, factor=2.0), Multipath(60.0, 5.0, (3.0, 0, 0)))
    t = seconds(both.fix_stamp)
    np.testing.assert_allclose(reported_std(both)[(t >= 40.0) & (t < 70.0), 0], 0.005)
    np.testing.assert_allclose(reported_std(both)[(t >= 70.0) & (t < 90.0), 0], 0.5)
    np.testing.assert_allclose(errors(both)[0][(t >= 60.0) & (t < 65.0), 0], 3.0, atol=0.05)
    other = recorded(Overconfidence(40.0, 50.0, factor=2.0), RtkSolution(20.0, 50.0))
    np.testing.assert_allclose(reported_std(other)[(t >= 40.0) & (t < 70.0), 0], 0.01)
    twice = added_by(Multipath(30.0, 10.0, (1.0, 0.0, 0.0)), Multipath(35.0, 10.0, (2.0, 0.0, 0.0)))
    assert sorted(set(np.round(twice[1][:, 0], 3) + 0.0)) == [0.0, 1.0, 2.0, 3.0]


def test_episodes_of_one_receiver_leave_the_other_as_it_was() -> None:
    def with_two(*episodes: Episode) -> Recording:
        return recorded(*episodes, second_gnss=GnssReceiver(), dual_antenna=DualAntenna())

    def altitudes(recording: Recording) -> tuple[Array, Array]:
        assert recording.second_gnss is not None
        return recording.fix_altitude, recording.second_gnss.fix_altitude

    plain = altitudes(with_two())
    for receiver, changes in ((0, (True, True)), (1, (True, False)), (2, (False, True))):
        found = altitudes(with_two(Multipath(30.0, 20.0, receiver=receiver)))
        assert tuple(not np.array_equal(a, b) for a, b in zip(plain, found)) == changes
        gap = Outage(30.0, 20.0, receiver=receiver)
        found = altitudes(with_two(gap))
        assert tuple(len(a) - len(b) for a, b in zip(plain, found)) == tuple(100 * change for change in changes)
        heading = with_two(gap).dual_antenna
        assert heading is not None
        assert len(plain[0]) - len(heading.stamp) == 100, "a dual antenna needs both"
        assert with_two(gap).outages == (((30.0, 50.0),) if changes[0] else ())
    slow = with_two(CorrelatedErrors(0.0, math.inf))
    moved = [after - before for before, after in zip(plain, altitudes(slow))]
    assert abs(np.corrcoef(*moved)[0, 1]) < 0.9, "each receiver has its own errors"


@settings(max_examples=15)
@given(
    kind=st.sampled_from(sorted(name for name, kind in EPISODES.items() if issubclass(kind, (GnssEpisode, Outage)))),
    start=st.floats(-10.0, 60.0),
    length=st.floats(0.0, 60.0),
)
def test_nothing_changes_outside_of_an_episode(kind: str, start: float, length: float) -> None:
    options = {"stop": 40.0, **COARSE}
    plain = simulate("drive", 3, **options)
    changed = simulate("drive", 3, episodes=(EPISODES[kind](start, length),), **options)
    for prefix, stamp in (("fix", "fix_stamp"), ("velocity", "velocity_stamp")):
        t = seconds(getattr(plain, stamp))
        outside = (t < start) | (t >= start + length)
        there = np.isin(getattr(changed, stamp), getattr(plain, stamp)[outside])
        assert there.sum() == outside.sum()
        for field in dataclasses.fields(plain):
            value = getattr(plain, field.name)
            if field.name.startswith(prefix):
                np.testing.assert_array_equal(value[outside], getattr(changed, field.name)[there], field.name)
    for name in ("specific_force", "angular_rate", "imu_arrival"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(changed, name))


@pytest.mark.parametrize(
    ("episode", "expected"),
    [
        ("spoofing:start=0,length=9,acceleration=0", "acceleration of spoofing must be a positive number"),
        ("correlated_errors:start=0,length=9,correlation_time=-1", "correlation time must be a positive number"),
        ("rtk_solution:start=0,length=9,solution=wide", "unknown RTK solution 'wide'; there are single, float, fixed"),
        ("multipath:start=0,length=9,receiver=3", "the receiver must be 1, 2 or, for both, 0"),
        ("multipath:start=0,length=9,receiver=one", "receiver takes a number"),
    ],
)
def test_impossible_episodes_are_refused(episode: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["drive", "--episode", episode]) == 2
    assert expected in capsys.readouterr().err


def test_command_writes_the_episodes(tmp_path: Path) -> None:
    episodes = {
        "multipath:start=5,length=10,offset=8/-5/3": Multipath(5.0, 10.0, (8.0, -5.0, 3.0)),
        "rtk_solution:start=20,length=5": RtkSolution(20.0, 5.0),
        "zero_covariance:start=30,length=inf": ZeroCovariance(30.0, math.inf),
        "spoofing:start=10,length=20,consistent=false": Spoofing(10.0, 20.0, consistent=False),
    }
    arguments = [argument for text in episodes for argument in ("--episode", text)]
    recording = simulate("drive", 1, episodes=tuple(episodes.values()), stop=40.0)
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        out = str(tmp_path / name / "drive.mcap")
        assert command.main(["drive", "--seed", "1", "--set", "stop=40", *arguments, "--quiet", "--out", out]) == 0
    path = tmp_path / "first" / "drive.mcap"
    assert path.read_bytes() == (tmp_path / "second" / "drive.mcap").read_bytes()
    found = read(path, TOPICS)
    fix, velocity = found["gps/fix"][1], found["gps/vel"][1]
    np.testing.assert_array_equal(fix["latitude"], recording.fix_latitude_deg)
    np.testing.assert_array_equal(fix["position_covariance"], recording.fix_covariance)
    np.testing.assert_array_equal(fix["status"], recording.fix_status)
    np.testing.assert_array_equal(fix["position_covariance_type"], recording.fix_covariance_type)
    assert set(fix["status"]) == {0, 2}
    late = seconds(velocity["stamp"]) >= 30.0
    assert not velocity["twist_covariance"][late].any()
    assert (velocity["twist_covariance"][~late][:, 21] == -1.0).all()
