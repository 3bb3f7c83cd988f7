"""Monitors of the installation, of the direction of travel and of the errors of fixes, one kernel at a time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from eskf_ros.filter.history.records import AID
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.integrity.fault_effects import POSITION_TIME, VELOCITY_TIME, write_effect_on_velocity
from eskf_ros.filter.integrity.fix_errors import update_shares
from eskf_ros.filter.integrity.heading_monitor import slip_of, watch_slip
from eskf_ros.filter.integrity.installation_monitor import (
    LASTING_LOOKS,
    find_faults,
    learn_faults,
)
from eskf_ros.filter.integrity.motion_report import _compared, travel_complaints
from eskf_ros.filter.integrity.motion_sums import add_push, add_turn
from eskf_ros.filter.integrity.receiver_report import aid_complaints
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.geodesy.rotation import to_matrix
from support.kernels import make_settings, make_state, make_work

SETTINGS = make_settings()


@pytest.mark.parametrize(("rate", "share"), [(1e-4, 0.0), (0.5, 1.0)])
def test_a_rate_within_its_noise_says_nothing_of_the_lever_arm(rate: float, share: float) -> None:
    """The velocity of an antenna 1 m ahead is that to the left, by the rate about the vertical."""
    state, effect = make_state(), np.zeros((3, 7))
    state["imu"]["interval"], state["imu"]["smooth_rate"] = 0.01, (0.0, 0.0, rate)
    state["quality"]["change"][3:] = 1e-3
    write_effect_on_velocity(state, effect)
    expected = np.array(to_matrix(state["attitude"]))[:, 1] * rate * share
    np.testing.assert_allclose(effect[:, 0], expected, rtol=2e-3, atol=2e-4 * share)


@pytest.mark.parametrize(("acceleration", "share"), [(1e-3, 0.0), (3.0, 1.0)])
def test_an_acceleration_within_vibration_says_nothing_of_the_time(acceleration: float, share: float) -> None:
    state, effect = make_state(), np.zeros((3, 7))
    to_map = np.array(to_matrix(state["attitude"]))
    forward = to_map[:, 0]
    gravity = np.array(gravity_map(state, tuple(state["position_map"])))
    state["imu"]["interval"], state["imu"]["smooth_force"] = 0.01, to_map.T @ (acceleration * forward - gravity)
    state["quality"]["change"][:3] = 1e-3
    write_effect_on_velocity(state, effect)
    np.testing.assert_allclose(effect[:, VELOCITY_TIME], acceleration * share * forward, rtol=2e-3, atol=1e-9)


def travelled(angles_deg: Any) -> Any:
    """A state that has travelled straight on at these angles to x of base_link, a second each."""
    state = make_state(velocity=(10.0, 0.0, 0.0))
    for k, angle in enumerate(angles_deg):
        state["stamp"] = (k + 1) * SECOND
        watch_slip(state, -math.radians(angle))
    return state


def test_the_direction_of_travel_is_known_where_it_stays() -> None:
    found = slip_of(travelled([8.0, 7.0, 9.0, 8.0] * 10))
    assert found is not None
    assert math.degrees(found[0]) == pytest.approx(8.0, abs=0.1)
    assert math.degrees(found[1]) < 1.0


def test_the_direction_of_travel_is_not_known_by_few_seconds_or_where_it_changes_or_fixes_err_for_long() -> None:
    assert slip_of(travelled([8.0] * 20)) is None
    assert slip_of(travelled([30.0, -20.0] * 30)) is None, "a multirotor flies in any direction"
    state = travelled([8.0] * 40)
    state["scatter"]["pairs"][0], state["scatter"]["calm"][0] = 500.0, 0.9
    assert slip_of(state) is None


def test_the_direction_of_travel_is_not_asked_for_in_turns_or_at_rest() -> None:
    for velocity, rate in (((1.0, 0.0, 0.0), 0.0), ((10.0, 0.0, 0.0), 0.3)):
        state = make_state(velocity=velocity)
        state["stamp"], state["imu"]["smooth_rate"] = SECOND, (0.0, 0.0, rate)
        watch_slip(state, 0.0)
        assert not state["heading_monitor"]["slip"].any()


def test_few_pairs_of_fixes_must_walk_further_to_be_said_to() -> None:
    """Of white errors the part that is not taken back scatters by 0.3 of the changes after 90 pairs, later by 0.14."""
    state, work = make_state(), make_work()
    state["error_size"] = 15
    state["recovery"]["absolute_interval"] = SECOND // 5
    state["scatter"]["white"][0] = state["scatter"]["spread"][0] = state["scatter"]["change"][0] = 1.0
    state["scatter"]["walk"][0] = 0.65
    for pairs, walks in ((90.0, False), (400.0, True)):
        state["scatter"]["pairs"][0] = pairs
        update_shares(state, state.copy(), 0, SETTINGS, work)
        assert bool(state["scatter"]["walking"][0]) == walks, pairs


def test_fixes_that_hardly_change_are_calm_however_little_they_walk() -> None:
    """They change by 5 % of their claim, and half of that walks: nearly all of the claim lasts."""
    state, work = make_state(), make_work()
    state["error_size"] = 15
    state["recovery"]["absolute_interval"] = SECOND
    state["scatter"]["white"][0] = state["scatter"]["spread"][0] = 1.0
    state["scatter"]["pairs"][0], state["scatter"]["change"][0], state["scatter"]["walk"][0] = 500.0, 0.05, 0.0005
    update_shares(state, state.copy(), 0, SETTINGS, work)
    assert state["scatter"]["calm"][0] == pytest.approx(0.95)
    state["scatter"]["walk"][0] = 0.03
    update_shares(state, state.copy(), 0, SETTINGS, work)
    assert state["scatter"]["calm"][0] >= 0.95


def turned(rate_of: Any, lag: float, seed: int, bias: float = 0.0) -> list[float]:
    """The lags (s) told in 200 s of turns at ``rate_of`` (s) -> rad/s, with a receiver stamped ``lag`` later.

    The gyro has a ``bias`` (rad/s).
    """
    rng, turns = np.random.default_rng(seed), make_state()["motion"]["turns"]
    seconds = np.arange(0.0, 201.0, 0.01)
    turn = np.concatenate([[0.0], np.cumsum(rate_of(seconds[:-1]) * 0.01)])
    told = []
    for k in range(10, 200):
        course = np.interp([k - 1.0 - lag, k - lag], seconds, turn) + 0.005 * rng.normal(size=2)
        gyro = float(np.interp(k, seconds, turn) - np.interp(k - 1.0, seconds, turn))
        before, after = ((10.0 * math.cos(angle), 10.0 * math.sin(angle)) for angle in course)
        add_turn(turns, before, after, (0.0, 0.0, gyro + bias), 2.0 * 0.005**2, (k - 1) * SECOND, 1.0)
        told.append(float(turns["lag"]))
    return told


@pytest.mark.parametrize("period", [30.0, 400.0])
def test_smooth_turns_are_no_sign_of_clocks_that_are_apart(period: float) -> None:
    for seed in range(10):
        assert not any(turned(lambda t: 0.25 * np.sin(2.0 * np.pi * t / period), 0.0, seed)), seed


@pytest.mark.parametrize("period", [20.0, 60.0])
@pytest.mark.parametrize("lag", [-2.4, 1.2])
def test_smooth_turns_show_clocks_that_are_apart(period: float, lag: float) -> None:
    told = turned(lambda t: 0.25 * np.sin(2.0 * np.pi * t / period), lag, 0, bias=math.radians(0.5))
    assert told[60:] == [pytest.approx(lag, abs=0.15)] * len(told[60:])


@pytest.mark.parametrize("lag", [-3.6, -1.2, 1.2, 2.4, 4.2])
def test_corners_show_clocks_that_are_seconds_apart(lag: float) -> None:
    assert turned(lambda t: 0.3 * (t % 17.0 < 5.0), lag, 0)[-1] == pytest.approx(lag, abs=0.25)


def test_slopes_are_no_mounting() -> None:
    """Gravity on slopes of half a minute is as strong as braking: the angle to the travel is as certain as is said."""
    sigmas = []
    for seed in range(60):
        rng, pushes = np.random.default_rng(seed), make_state()["motion"]["pushes"]
        pull, slope = np.zeros(2), np.zeros(2)
        for _ in range(150):
            pull, slope = 0.8 * pull + 0.5 * rng.normal(size=2), 0.97 * slope + 0.12 * rng.normal(size=2)
            before, after = np.array([20.0, 0.0]), np.array([20.0, 0.0]) + pull
            course = math.atan2(after[1], before[0] + after[0])
            along = math.cos(course) * pull[0] + math.sin(course) * pull[1]
            left = math.cos(course) * pull[1] - math.sin(course) * pull[0]
            add_push(pushes, tuple(before), tuple(after), (along + slope[0], left + slope[1], 9.8), 1.0)
        compared = _compared(pushes)
        assert compared is not None
        matrix, std = compared
        sigmas.append(math.atan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1]) / std)
    assert 0.5 < np.mean(np.square(sigmas)) < 2.0


@pytest.mark.parametrize(("windows", "angle_deg", "told"), [(40, 8.0, False), (120, 8.0, True), (40, 90.0, True)])
def test_a_small_angle_to_the_travel_is_not_told_before_it_is_known_how_errors_last(
    windows: int, angle_deg: float, told: bool
) -> None:
    rng, state = np.random.default_rng(0), make_state()
    state["motion"]["heard_stamp"] = SECOND
    angle = math.radians(angle_deg)
    for _ in range(windows):
        pull = rng.normal(size=2)
        x = math.cos(angle) * pull[0] + math.sin(angle) * pull[1]
        y = math.cos(angle) * pull[1] - math.sin(angle) * pull[0]
        add_push(state["motion"]["pushes"], (100.0, 0.0), (100.0 + pull[0], pull[1]), (x, y, 9.8), 1.0)
    texts, _ = travel_complaints(state, SETTINGS, (0.0, 0.0, 0.0))
    assert bool(texts) == told


@pytest.mark.parametrize("stamp", [SECOND, NEVER])
def test_a_takeover_keeps_what_was_learnt_of_faults_and_what_they_have_done(stamp: int) -> None:
    """The innovation in the work space is not that of the message any more: nothing is learnt from it."""
    state, work, aid = make_state(velocity=(10.0, 0.0, 0.0)), make_work(), np.zeros(1, AID)[0]
    state["stamp"], state["heading_known"], state["error_size"] = SECOND, 1, 15
    state["installation"]["stamp"] = stamp
    state["installation"]["absorbed"][0, 0, VELOCITY_TIME] = 5.0
    state["installation"]["evidence"], state["installation"]["information"] = 1.0, 2.0
    work["innovation"], work["gain"] = 100.0, 1.0
    aid["stream"], aid["verdict"] = Stream.GNSS_VELOCITY, Verdict.TAKEOVER
    learn_faults(state, aid, 3, 16.0, work, SETTINGS)
    assert state["installation"]["stamp"] == stamp
    assert state["installation"]["absorbed"][0, 0, VELOCITY_TIME] == 5.0
    assert (state["installation"]["evidence"] == 1.0).all()
    assert (state["installation"]["information"] == 2.0).all()


@pytest.mark.parametrize(("alike", "found"), [(0.9, True), (0.999, False)])
def test_a_fault_is_certain_where_no_other_explains_the_same(alike: float, found: bool) -> None:
    """A lever arm of 1 m at 30 sigmas, and a time offset whose effect has the correlation ``alike`` with its own."""
    state, work = make_state(), make_work()
    state["stamp"] = 1000 * SECOND
    installation = state["installation"]
    scale = np.array([30.0, 300.0])
    pair = np.ix_([0], [0, POSITION_TIME], [0, POSITION_TIME])
    installation["information"][pair] = np.outer(scale, scale) * [[1.0, alike], [alike, 1.0]]
    installation["evidence"][0, [0, POSITION_TIME]] = scale * 30.0 * np.array([1.0, alike])
    installation["misfit"][0] = (3000.0 + 900.0, 3000.0)
    find_faults(state, work)
    assert installation["estimate"][0, 0] == pytest.approx(1.0, rel=0.01)
    assert installation["estimate"][0, POSITION_TIME] == 0.0
    assert installation["unexplained"][0] == pytest.approx(3000.0, rel=0.01)
    assert bool(installation["found"][0, 0]) == found


@pytest.mark.parametrize(
    ("total", "unexplained", "sigmas", "told"),
    [
        (1100.0, 1090.0, 12.0, True),
        (1500.0, 1100.0, 12.0, True),
        (1500.0, 1400.0, 12.0, False),
        (1500.0, 1400.0, 30.0, True),
    ],
)
def test_a_fault_that_leaves_innovations_too_large_must_be_very_certain(
    total: float, unexplained: float, sigmas: float, told: bool
) -> None:
    """Innovations with 1000 degrees of freedom: where most of their excess stays, something else is wrong."""
    state = make_state()
    state["receiver"]["fix_count"][0] = 1000
    installation = state["installation"]
    installation["misfit"][0] = (total, 1000.0)
    installation["unexplained"][0] = unexplained
    installation["found"][0, 0] = installation["estimate"][0, 0] = 1.0
    installation["sigma"][0] = 1.0 / sigmas
    installation["held"][0, 0] = LASTING_LOOKS
    texts = aid_complaints(state, SETTINGS, False, False)
    assert any("gnss.lever_arm" in text for text in texts) == told
