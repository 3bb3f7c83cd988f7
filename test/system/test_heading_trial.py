"""A heading that was given is on trial: one that is wrong is replaced within seconds of motion, a right one stays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from campaign.fault import DEFAULT_VELOCITY, TOLD_VELOCITY, Filter
from campaign.judge import figures_of
from campaign.running import heading_at_start_deg, recording_of, run_one
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.error_state import ATTITUDE, GYRO_BIAS
from eskf_ros.filter.state.time import NEVER
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate
from faults import all_faults
from monte_carlo import feed

MOTION = 20.0
"""s; when the drives begin to move."""

FAULTS = {fault.name: fault for fault in all_faults()}


def filter_of(recording: Recording, off_deg: float) -> Navigator:
    """Return a filter that was given a heading ``off_deg`` off as 5 deg."""
    given = {
        "alignment.initial_heading_deg": heading_at_start_deg(recording) + off_deg,
        "alignment.initial_heading_std_deg": 5.0,
    }
    return Navigator(from_mapping({**recording.parameters(), **given}))


def states(recording: Recording, navigator: Navigator) -> Iterator[tuple[float, np.ndarray]]:
    """Yield time (s) and state once a second."""
    for i, state in feed(recording, navigator, np.arange(99, len(recording.imu_stamp), 100)):
        yield float(recording.imu_stamp[i] - recording.truth_stamp[0]) * 1e-9, state


def heading_error(recording: Recording, seconds: float, state: np.ndarray) -> float:
    """Return the error of the heading (rad)."""
    k = int(np.searchsorted((recording.truth_stamp - recording.truth_stamp[0]) * 1e-9, seconds))
    w, x, y, z = recording.truth_attitude_body_to_map[min(k, len(recording.truth_stamp) - 1)]
    a, b, c, d = state["attitude"]
    true, own = (
        math.atan2(2.0 * (p * s + q * r), 1.0 - 2.0 * (r * r + s * s)) for p, q, r, s in ((w, x, y, z), (a, b, c, d))
    )
    return abs(math.remainder(true - own, 2.0 * math.pi))


@pytest.mark.parametrize("off_deg", [70.0, 120.0, 180.0, -90.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_wrong_heading_is_replaced_in_the_first_seconds_of_motion(off_deg: float, seed: int) -> None:
    recording = simulate("drive", seed, imu_rate=100.0, stop=60.0)
    navigator = filter_of(recording, off_deg)
    for seconds, state in states(recording, navigator):
        if seconds > MOTION + 15.0:
            sigma = math.sqrt(state["covariance"][ATTITUDE + 2, ATTITUDE + 2])
            assert sigma < math.radians(10.0)
            assert heading_error(recording, seconds, state) < 4.0 * sigma, seconds
    assert state["trial"]["is_on"] == 0
    assert "heading that was given" in " ".join(navigator.complaints)


@pytest.mark.parametrize("seed", range(6))
def test_a_right_heading_stays_and_is_believed_once_the_trial_is_over(seed: int) -> None:
    recording = simulate("drive", seed, imu_rate=100.0, stop=90.0)
    off = 5.0 * float(np.random.default_rng(seed).standard_normal())
    navigator, was_on = filter_of(recording, off), False
    for seconds, state in states(recording, navigator):
        if was_on and not state["trial"]["is_on"]:
            assert state["heading"]["given_stamp"] == NEVER
        was_on |= bool(state["trial"]["is_on"])
        assert state["heading_known"] or not state["level_known"]
        assert heading_error(recording, seconds, state) < math.radians(20.0) or not state["level_known"]
    assert was_on
    assert state["trial"]["is_on"] == 0
    assert navigator.complaints == []


def test_where_nothing_shows_the_heading_the_trial_ends_after_three_minutes_of_motion() -> None:
    recording = simulate("straight:33", 1, imu_rate=50.0, stop=230.0)
    on = [seconds for seconds, state in states(recording, filter_of(recording, 2.0)) if state["trial"]["is_on"]]
    assert 175.0 < max(on) < 190.0


def test_a_robot_that_waits_is_tried_with_what_it_knew_at_the_last_moment_at_rest() -> None:
    """Gyro bias and tilt become better all the time at rest: the lane without the heading has them, too."""
    recording = simulate("drive", 3, imu_rate=100.0, stop=19.0)
    navigator = filter_of(recording, 120.0)
    for seconds, state in states(recording, navigator):
        lane = navigator._states[1]
        if seconds > 15.0:
            assert lane["heading_known"] == 0
            assert lane["covariance"][GYRO_BIAS, GYRO_BIAS] < 1.2 * state["covariance"][GYRO_BIAS, GYRO_BIAS]


@pytest.mark.parametrize(
    ("name", "given", "seed"),
    [
        ("heading given 120 deg wrong", TOLD_VELOCITY, 0),
        ("heading given 180 deg wrong", TOLD_VELOCITY, 2),
        ("heading given 120 deg wrong", DEFAULT_VELOCITY, 2),
    ],
)
def test_a_wrong_heading_does_not_lie_on_smooth_drives_of_another_generator(
    data_folder: Callable[[str], Path], name: str, given: Filter, seed: int
) -> None:
    drives = data_folder("independent_drives")
    figures = figures_of(FAULTS[name], run_one(FAULTS[name], recording_of(FAULTS[name], seed, drives), given))
    assert figures.heading_lies <= 0.01
    assert figures.position_lies <= 0.01
    assert math.isfinite(figures.named_after)
