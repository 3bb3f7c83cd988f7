"""Faults of the installation: how the estimate follows them, how they are found, and what is published of them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from campaign.fault import DEFAULT_POSITION, DEFAULT_VELOCITY, TOLD_POSITION, TOLD_VELOCITY, Filter
from campaign.judge import figures_of
from campaign.running import IMU_NOISE, recording_of, run_one
from eskf_ros.filter.integrity.fault_effects import FAULTS, GYRO_DRIFT, GYRO_SCALE, POSITION_TIME, VELOCITY_TIME
from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate
from faults import all_faults
from monte_carlo import feed

Array = NDArray[np.float64]
SECONDS = 70.0
SIZES = {0: 0.02, 1: 0.02, POSITION_TIME: 0.002, VELOCITY_TIME: 0.002, GYRO_SCALE: 1e-4, GYRO_DRIFT: 1e-7}
"""Of each fault, small enough to be linear (m, m, s, s, 1, rad/s2)."""
BY_NAME = {fault.name: fault for fault in all_faults()}


@lru_cache
def drive() -> Recording:
    """A drive whose heading is given: nothing is searched for."""
    return simulate("drive", seed=5, imu_rate=100.0, gnss_rate=2.0, stop=SECONDS, start=10.0)


def estimate(recording: Recording, **changes: Any) -> tuple[Array, Array]:
    """Return position (m) and velocity (m/s) at the end, (6,), and their derivatives by the faults, (6, faults)."""
    parameters = {
        **recording.parameters(),
        "alignment.initial_heading_deg": float(np.degrees(initial_heading(recording))),
        "alignment.initial_heading_std_deg": 1.0,
        **changes,
    }
    navigator = Navigator(from_mapping(parameters))
    state = next(iter(feed(recording, navigator, np.array([len(recording.imu_stamp) - 1]))))[1].copy()
    values = np.concatenate([state["position_map"], state["velocity_map"]])
    effect = np.array(state["installation"]["absorbed"][0, :6])
    # It is that at the last message.
    effect[:3] += (state["stamp"] - state["installation"]["stamp"]) * 1e-9 * effect[3:]
    return values, effect


def initial_heading(recording: Recording) -> float:
    w, x, y, z = recording.truth_attitude_body_to_map[0]
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def broken(recording: Recording, fault: int, size: float) -> tuple[Recording, dict[str, Any]]:
    """The recording, or the parameters, with one fault of a ``size``: true minus configured."""
    changes: dict[str, Any] = {}
    if fault < POSITION_TIME:
        arm = list(recording.parameters()["gnss.lever_arm"])
        arm[fault] -= size
        changes["gnss.lever_arm"] = arm
    elif fault == POSITION_TIME:
        changes["gnss.time_offset"] = -size
        changes["gnss.velocity_time_offset"] = size
    elif fault == VELOCITY_TIME:
        changes["gnss.velocity_time_offset"] = -size
    elif fault == GYRO_SCALE:
        recording = dataclasses.replace(recording, angular_rate=recording.angular_rate * (1.0 + size))
    else:
        seconds = (recording.imu_stamp - recording.imu_stamp[0]) * 1e-9
        drifted = recording.angular_rate + np.array([0.0, 0.0, size]) * seconds[:, None]
        recording = dataclasses.replace(recording, angular_rate=drifted)
    return recording, changes


@pytest.mark.parametrize("fault", SIZES)
def test_the_estimate_follows_a_fault_as_the_monitor_says(fault: int) -> None:
    """Position and velocity with the fault minus without it, against its sensitivity (Friedland)."""
    before, absorbed = estimate(drive())
    size = SIZES[fault]
    recording, changes = broken(drive(), fault, size)
    after, _ = estimate(recording, **changes)
    expected = absorbed[:, fault] * size
    scale = np.abs(expected).max()
    assert scale > 0.0
    np.testing.assert_allclose(after - before, expected, rtol=0.0, atol=0.25 * scale)


@pytest.mark.parametrize("has_velocity", [True, False])
@pytest.mark.parametrize("is_told", [True, False])
def test_a_drive_without_faults_gives_no_evidence_of_them(is_told: bool, has_velocity: bool) -> None:
    """Evidence over the root of its information is standard normal, or less where the noise told is too large.

    A regressor that has seen the innovation, such as the velocity after the update, would explain it.
    """
    squares = []
    for seed in range(12):
        recording = simulate("drive", seed=seed, imu_rate=100.0, stop=80.0)
        parameters = {**recording.parameters(), "gnss.use_velocity": has_velocity}
        if not is_told:
            parameters = {name: value for name, value in parameters.items() if name.split(".")[-1] not in IMU_NOISE}
        navigator = Navigator(from_mapping(parameters))
        _, state = next(iter(feed(recording, navigator, np.array([len(recording.imu_stamp) - 1]))))
        found = state["installation"]
        squares.append(found["evidence"][0] ** 2 / np.maximum(np.diagonal(found["information"][0]), 1e-12))
    seen = np.array(squares)[:, [0, 1, 2, POSITION_TIME, *([VELOCITY_TIME] if has_velocity else [])]]
    assert (seen.sum(axis=0) < chi2.ppf(0.9999, len(seen))).all(), seen.sum(axis=0)
    assert (seen.sum(axis=0) > 0.5).all()


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("lever arm 1.5 m off in x", TOLD_VELOCITY),
        ("lever arm 1.5 m off in y", DEFAULT_VELOCITY),
        ("positions stamped 0.25 s late", TOLD_VELOCITY),
        ("positions stamped 0.25 s late", DEFAULT_POSITION),
        ("velocities stamped 0.13 s late", TOLD_VELOCITY),
        ("scale 1.5 %", TOLD_POSITION),
        ("clocks of IMU and receiver 1.2 s apart", TOLD_VELOCITY),
        ("stamps cut to whole seconds", DEFAULT_VELOCITY),
    ],
)
def test_what_is_found_is_in_the_published_covariance(name: str, given: Filter) -> None:
    """From two minutes on position and heading are within 5 standard deviations (bar 2 of docs/trust.md)."""
    fault = BY_NAME[name]
    figures = figures_of(fault, run_one(fault, recording_of(fault, 2), given))
    assert figures.position_lies <= 0.01
    assert figures.heading_lies <= 0.01


@pytest.mark.parametrize(
    ("name", "seed", "sentence"),
    [
        ("velocities stamped 0.13 s late", 0, r"the velocities are stamped 0\.1[23]\d s .* late"),
        ("velocities stamped 0.13 s late", 1, r"the velocities are stamped 0\.1[23]\d s .* late"),
        ("lever arm 1.5 m off in x", 0, r"the antenna seems to be \(-1\.[3-7]\d, \+0\.00, \+0\.00\) m"),
        ("lever arm 1.5 m off in y", 1, r"the antenna seems to be \(\+0\.00, -1\.[3-7]\d, \+0\.00\) m"),
    ],
)
def test_in_smooth_motion_one_fault_is_found_and_allowed_for(
    data_folder: Callable[[str], Path], name: str, seed: int, sentence: str
) -> None:
    """Drives of another generator, whose accelerations grow over seconds: there all faults look alike."""
    drives = data_folder("independent_drives")
    trace = run_one(BY_NAME[name], recording_of(BY_NAME[name], seed, drives), TOLD_VELOCITY)
    assert re.search(sentence, " ".join(trace.final))
    figures = figures_of(BY_NAME[name], trace)
    assert figures.position_lies <= 0.01
    assert figures.heading_lies <= 0.01


@pytest.mark.parametrize("name", ["holes of 1.6 s, dropped", "gyro bias step 1 deg/s"])
def test_holes_and_biases_that_change_do_not_set_clocks_apart(data_folder: Callable[[str], Path], name: str) -> None:
    """In smooth turns a window with a hole, or a gyro that reads 1 deg/s too much from 100 s on, look like a lag."""
    trace = run_one(BY_NAME[name], recording_of(BY_NAME[name], 0, data_folder("independent_drives")), TOLD_VELOCITY)
    assert not [sentence for sentence in trace.said if "clocks are apart" in sentence]


@pytest.mark.parametrize(
    ("name", "given", "seed", "worst"),
    [
        ("one gyro stuck for 40 s", TOLD_POSITION, 2, 10.0),
        ("velocity in north, east, down", TOLD_VELOCITY, 2, 15.0),
        ("gyro bias ramp 0.5 deg/s in 400 s", TOLD_VELOCITY, 1, 1.0),
        ("velocities stamped 0.13 s late", DEFAULT_VELOCITY, 0, 2.0),
        ("steps of 15 m, 20 s every minute", DEFAULT_POSITION, 5, 30.0),
        ("vibration 15 m/s2, clipped at 2 g: boat", DEFAULT_VELOCITY, 1, 3.0),
        ("rates clipped at 0.2 rad/s: field_robot", DEFAULT_VELOCITY, 1, 3.0),
        ("drawn away by 0.5 m/s, velocity too", TOLD_VELOCITY, 0, 25.0),
        ("train, rough line", DEFAULT_VELOCITY, 0, 3.0),
        ("RTK claims 1 cm and wanders 0.3 m", TOLD_POSITION, 2, 2.0),
        ("RTK claims 1 cm and wanders 0.3 m", TOLD_VELOCITY, 0, 2.0),
    ],
)
def test_what_once_lost_the_filter_does_not(name: str, given: Filter, seed: int, worst: float) -> None:
    """Largest error (m), and neither position nor heading beyond 5 standard deviations once the fault has lasted."""
    fault = BY_NAME[name]
    figures = figures_of(fault, run_one(fault, recording_of(fault, seed), given))
    assert figures.worst < worst
    assert figures.position_lies <= 0.01
    assert figures.heading_lies <= 0.01


def test_while_fixes_that_came_back_are_refused_the_covariance_reaches_to_them() -> None:
    """A receiver was drawn away by 19 m with its velocities; its fixes jump back, and are believed 30 s later."""
    fault = BY_NAME["drawn away by 0.5 m/s, velocity too"]
    trace = run_one(fault, recording_of(fault, 0), TOLD_VELOCITY)
    back = (trace.seconds > fault.end + 12.0) & (trace.seconds < fault.end + 28.0)
    assert (trace.error[back] > 15.0).all()
    assert (trace.error[back] < 2.0 * trace.sigma[back]).all()


def test_errors_of_fixes_that_wrong_velocities_made_up_are_forgotten_with_them() -> None:
    """Velocities in other axes are known from 27 s on: the next fixes are the position, not fixes that err by 9 m."""
    fault = BY_NAME["velocity in north, east, down"]
    trace = run_one(fault, recording_of(fault, 1), TOLD_VELOCITY)
    after = (trace.seconds > 28.0) & (trace.seconds < 34.0)
    assert trace.error[after].max() < 4.0


def test_no_turn_is_judged_by_the_second_that_the_constraint_takes() -> None:
    """A mower begins to turn 70 ms before the end of a second at rest: its mean rate is that of rest."""
    fault = BY_NAME["mower rows, RTK"]
    assert figures_of(fault, run_one(fault, recording_of(fault, 0), TOLD_VELOCITY)).false_rest == 0


@pytest.mark.parametrize(("apart", "lies"), [(1.2, 0.0), (2.4, 0.03), (4.2, 0.06)])
def test_clocks_that_are_seconds_apart_are_told_and_allowed_for(apart: float, lies: float) -> None:
    """The course turns as much later as it is stamped, and the position is off by time times speed.

    What a robot gathers of speed within that time is not allowed for: it lies in the seconds after a start.
    """
    faults = {fault.name: fault for fault in all_faults(apart / 1.2)}
    fault = faults[f"clocks of IMU and receiver {apart:g} s apart"]
    trace = run_one(fault, recording_of(fault, 0), TOLD_VELOCITY)
    told = re.findall(r"stamped about ([\d.]+) s later than the IMU", " ".join(trace.final))
    assert [float(found) for found in told] == [pytest.approx(apart, abs=0.25)]
    late = trace.seconds > 140.0
    assert np.mean(trace.error[late] > 5.0 * trace.sigma[late]) <= lies


def test_a_clean_drive_considers_nothing() -> None:
    navigator = Navigator(from_mapping(drive().parameters()))
    for _, state in feed(drive(), navigator, np.arange(100, len(drive().imu_stamp), 100)):
        assert not state["installation"]["is_considered"].any()
        assert state["installation"]["estimate"].shape[1] == FAULTS
