"""Fixes that are refused: what their changes say of the velocity is what a filter learns that estimates their step."""

from __future__ import annotations

import math

import numpy as np
import pytest

from eskf_ros.filter.history.records import AID, XX, YY, ZZ
from eskf_ros.filter.integrity.refused_motion import update_with_refused_fix
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.time import SECOND
from eskf_ros.geodesy.earth import ecef_to_geodetic
from support.kernels import make_settings, make_state, make_work

SETTINGS, WORK = make_settings(), make_work()
STD, INTERVAL = 1.0, 0.2
"""m and s; of fixes and between them."""


def refuse(count: int, has_velocity: bool = False, seed: int = 0, wild: float = 0.0):
    """Refuse fixes that have stepped by 40 m, of a robot that goes north by 1 m/s while the filter thinks it rests.

    The last one is ``wild`` m further off. Returns the state, and for each fix how far from the position at the start
    it is measured.
    """
    state = make_state()
    state["covariance"][:6, :6] = np.diag([4.0] * 3 + [1.0] * 3)
    state["covariance"][3, 0] = state["covariance"][0, 3] = 1.2
    aid, rng, measured = np.zeros(1, AID)[0], np.random.default_rng(seed), []
    aid["stream"] = Stream.GNSS_POSITION
    for k in range(count):
        if k > 0:
            transition = np.eye(6) + INTERVAL * np.eye(6, k=3)
            state["position_map"] += INTERVAL * state["velocity_map"]
            state["covariance"][:6, :6] = transition @ state["covariance"][:6, :6] @ transition.T
        state["stamp"] = aid["stamp"] = (10 + k * INTERVAL) * SECOND
        true = np.array([40.0, k * INTERVAL, 0.0]) + rng.normal(0.0, STD, 3) + (wild if k == count - 1 else 0.0)
        measured.append(true)
        ecef = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ true
        latitude, longitude, altitude = ecef_to_geodetic(*ecef)
        aid["payload"][:3] = latitude, longitude, altitude
        aid["payload"][[XX, YY, ZZ]] = STD**2
        state["trust"]["refused"][0, 0] = k + 1
        if has_velocity:
            state["streams"]["last_stamp"][Stream.GNSS_VELOCITY, 0] = aid["stamp"]
        update_with_refused_fix(state, aid, SETTINGS, WORK)
    return state, np.array(measured)


@pytest.mark.parametrize("count", [2, 5, 20])
def test_the_velocity_is_that_of_a_filter_that_estimates_the_step(count: int) -> None:
    """Of a Kalman filter with the step as a third state of which nothing is known (per axis, in information form)."""
    state, measured = refuse(count)
    for axis in range(3):
        prior = np.diag([4.0, 1.0])
        if axis == 0:
            prior[0, 1] = prior[1, 0] = 1.2
        information = np.zeros((3, 3))
        information[:2, :2] = np.linalg.inv(prior)
        vector = np.zeros(3)
        for k in range(count):
            row = np.array([1.0, k * INTERVAL, 1.0])
            information += np.outer(row, row) / STD**2
            vector += row * measured[k, axis] / STD**2
        covariance = np.linalg.inv(information)
        start, velocity, _ = covariance @ vector
        assert state["velocity_map"][axis] == pytest.approx(velocity, abs=2e-3)
        assert state["position_map"][axis] == pytest.approx(start + (count - 1) * INTERVAL * velocity, abs=2e-3)
        assert state["covariance"][3 + axis, 3 + axis] == pytest.approx(covariance[1, 1], rel=1e-3)


def test_what_steps_again_says_nothing_of_the_velocity() -> None:
    before, _ = refuse(9)
    after, _ = refuse(10, wild=30.0)
    np.testing.assert_allclose(after["velocity_map"], before["velocity_map"])


def test_measured_velocities_are_better_than_changes_of_fixes() -> None:
    state, _ = refuse(20, has_velocity=True)
    assert not state["velocity_map"].any()
    assert state["covariance"][3, 3] == 1.0


def test_a_velocity_that_changes_is_followed() -> None:
    """The mean is that of the last fixes: after minutes a fix weighs as much as after five seconds."""
    state, _ = refuse(300)
    assert math.sqrt(state["covariance"][4, 4]) < 1.0
    passed = (state["stamp"] - state["trust"]["mean_stamp"][0]) * 1e-9
    assert passed < 6.0
