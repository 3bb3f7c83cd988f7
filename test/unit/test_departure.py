"""Departures from rest: the lag between receiver and IMU, and what must not be taken for one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from eskf_ros.filter.history.records import AID, XX, YY
from eskf_ros.filter.inertial.covariance import ACCELERATION_TIME
from eskf_ros.filter.integrity.departure import (
    add_heard,
    begin_departure,
    extend_departure,
    hear_fix,
    hear_speed,
)
from eskf_ros.filter.integrity.motion_monitor import lag_of_receiver
from eskf_ros.filter.integrity.motion_report import motion_complaints
from eskf_ros.filter.integrity.motion_sums import FEWEST_TURNS
from eskf_ros.filter.state.time import NEVER, SECOND
from support.kernels import make_settings, make_state

SETTINGS = make_settings()

VELOCITY_STD = 0.05
"""m/s per axis."""


def depart(
    lag: float = 0.0,
    acceleration: float = 2.0,
    has_velocity: bool = True,
    error: float = 0.0,
    fix_std: float = 1.0,
    seed: int = 0,
    state: Any = None,
) -> Any:
    """Let a robot rest for 3.5 s, speed up to 12 m/s and go on for some seconds; return the state.

    The receiver sends at 5 Hz, stamped ``lag`` (s) late. ``error``: of the acceleration by the IMU (m/s2), in its
    direction. A ``state`` is continued.
    """
    state, rng = make_state() if state is None else state, np.random.default_rng(seed)
    start = int(state["stamp"]) + SECOND
    aid = np.zeros(1, AID)[0]
    leaves, fast = 3.5, 3.5 + 12.0 / acceleration

    def speed(t: float) -> float:
        return acceleration * min(max(t - leaves, 0.0), 12.0 / acceleration)

    def way(t: float) -> float:
        moved = min(max(t - leaves, 0.0), 12.0 / acceleration)
        return 0.5 * acceleration * moved * moved + 12.0 * max(t - fast, 0.0)

    low_passed, dt = 0.0, 0.01
    for k in range(1600):
        t = k * dt
        state["stamp"] = aid["stamp"] = start + k * 10_000_000
        now = acceleration * (leaves <= t < fast) + error
        low_passed += dt / ACCELERATION_TIME * (now - low_passed)
        state["excitation"]["acceleration"] = (0.6 * low_passed, 0.8 * low_passed, 0.0)
        if k in (0, 200):  # as each window of 2 s at rest ends
            begin_departure(state, SETTINGS)
        extend_departure(state)
        if k % 20:
            continue
        if has_velocity:
            aid["payload"][[XX, YY]] = VELOCITY_STD**2
            aid["payload"][:2] = rng.normal(0.0, VELOCITY_STD, 2) + (0.8 * speed(t - lag), -0.6 * speed(t - lag))
            hear_speed(state["departure"], aid)
        else:
            aid["payload"][[XX, YY]] = fix_std**2
            away = rng.normal(0.0, fix_std, 2) + (0.8 * way(t - lag), -0.6 * way(t - lag))
            fix = np.array([away[0], away[1], 0.0])
            away -= state["departure"]["rest_fix"][:2]
            hear_fix(state["departure"], aid, fix, (away[0], away[1]))
    return state


@pytest.mark.parametrize("has_velocity", [True, False])
@pytest.mark.parametrize("lag", [-1.5, 0.9, 1.2, 2.0])
def test_a_lag_is_found(lag: float, has_velocity: bool) -> None:
    for fix_std in (1.0, 0.02):
        state = depart(lag, has_velocity=has_velocity, fix_std=fix_std)
        assert state["departure"]["lag"] == pytest.approx(lag, abs=0.2)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("has_velocity", [True, False])
@pytest.mark.parametrize(
    ("acceleration", "error"), [(2.0, 0.0), (0.5, 0.0), (2.0, 0.2), (2.0, -0.2), (0.5, 0.15), (0.2, -0.1)]
)
def test_without_a_lag_none_is_found(acceleration: float, error: float, has_velocity: bool, seed: int) -> None:
    """Nor where the level was found while the robot braked, so that its acceleration is wrong."""
    for fix_std in (1.0, 0.02):
        assert depart(0.0, acceleration, has_velocity, error, fix_std, seed)["departure"]["lag"] == 0.0


@pytest.mark.parametrize("has_velocity", [True, False])
@pytest.mark.parametrize(("lag", "acceleration"), [(1.2, 0.5), (2.6, 2.0), (6.0, 2.0)])
def test_a_lag_that_hardly_shows_or_is_too_long_is_not_told(
    lag: float, acceleration: float, has_velocity: bool
) -> None:
    """0.6 m/s of difference may come from elsewhere; 2.6 s are at the end of the range, 6 s beyond it."""
    assert depart(lag, acceleration, has_velocity)["departure"]["lag"] == 0.0


def test_braking_before_the_rest_is_no_motion_in_it() -> None:
    """What the low-passed acceleration still holds of it fades, and is no change of the speed."""
    state, decay = make_state(), math.exp(-0.01 / ACCELERATION_TIME)
    state["excitation"]["acceleration"] = (-1.5, 0.5, 0.0)
    begin_departure(state, SETTINGS)
    for k in range(1, 501):
        state["stamp"] = k * 10_000_000
        state["excitation"]["acceleration"] *= decay
        extend_departure(state)
    departure = state["departure"]
    assert departure["bins"] >= 24
    assert departure["by_imu"][:24, 0].max() < 0.02


def test_noise_does_not_make_a_length_longer() -> None:
    departure = make_state()["departure"]
    departure["since"] = 0
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(2000):
        departure["count"] = 0
        add_heard(departure, SECOND, math.hypot(2.0 + rng.normal(), rng.normal()), 1.0)
        squares.append(departure["heard"][0, 1] ** 2)
    assert np.mean(squares) == pytest.approx(4.0, rel=0.1)


def test_a_later_departure_without_a_lag_takes_it_back() -> None:
    state = depart(1.2)
    assert state["departure"]["lag"] != 0.0
    assert depart(0.0, state=state)["departure"]["lag"] == 0.0


def test_a_level_that_is_not_known_says_nothing() -> None:
    state = make_state()
    state["covariance"][6, 6] = state["covariance"][7, 7] = math.radians(3.0) ** 2
    begin_departure(state, SETTINGS)
    assert state["departure"]["since"] == NEVER


def test_an_imu_that_is_upside_down_says_nothing() -> None:
    state = make_state()
    state["attitude"] = (0.0, 1.0, 0.0, 0.0)
    begin_departure(state, SETTINGS)
    assert state["departure"]["since"] == NEVER


def test_a_heading_that_was_given_may_be_corrected_below_the_motion() -> None:
    state = make_state()
    begin_departure(state, SETTINGS)
    assert state["departure"]["since"] == state["stamp"]
    state["heading_known"], state["heading"]["given_stamp"] = 1, SECOND
    begin_departure(state, SETTINGS)
    assert state["departure"]["since"] == NEVER


@pytest.mark.parametrize("place", [("recovery", "reset_stamp"), ("trust", "doubt_stamp")])
def test_a_reset_turns_the_axes_below_the_motion(place: tuple[str, str]) -> None:
    state = make_state()
    state["stamp"] = 100 * SECOND
    begin_departure(state, SETTINGS)
    state["stamp"] += SECOND // 5
    extend_departure(state)
    assert state["departure"]["bins"] == 1
    state[place[0]][place[1]] = state["stamp"]
    state["stamp"] += SECOND // 5
    extend_departure(state)
    assert state["departure"]["since"] == NEVER


def test_the_lag_is_said_and_published_until_turns_tell() -> None:
    state = depart(1.2)
    assert lag_of_receiver(state) == pytest.approx(1.2, abs=0.1)
    assert [text for text in motion_complaints(state) if "set out from rest" in text and "1.2 s later" in text]
    turns = state["motion"]["turns"]
    turns["count"], turns["weight"], turns["course_square"] = 2 * FEWEST_TURNS, 1e4, 1e4
    state["motion"]["heard_stamp"] = state["stamp"]
    assert lag_of_receiver(state) == 0.0
    turns["lag"] = -0.8
    assert lag_of_receiver(state) == -0.8
    assert not [text for text in motion_complaints(state) if "set out from rest" in text]
