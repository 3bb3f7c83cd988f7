"""Monitors of the receivers: each fault is named with about the right size, and nothing where there is none."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.episodes import Outage
from eskf_ros.simulate.gnss_episodes import CorrelatedErrors, Multipath, Overconfidence, Spoofing
from eskf_ros.simulate.imu import grade_parameters
from eskf_ros.simulate.sampling import START_STAMP
from eskf_ros.simulate.scenario import simulate
from monte_carlo import NO_SIDE_SLIP, feed

RTK = {"position_std": (0.01, 0.02), "velocity_std": (0.03, 0.05)}
POSITION_ONLY = {"gnss.use_velocity": False}
OUTAGES = tuple(Outage(start, 20.0) for start in (60.0, 110.0, 160.0, 210.0))
ARM = (0.8, -0.2, 1.4)
"""Of the simulated receiver."""


def navigated(name: str, seed: int, changes: dict[str, Any] | None = None, **options: Any) -> Navigator:
    recording = simulate(name, seed, **{"imu_rate": 50.0, **options})
    slip = NO_SIDE_SLIP if "drive" in name else {}
    navigator = Navigator(from_mapping({**recording.parameters(), **slip, **(changes or {})}))
    for _ in feed(recording, navigator, np.append(np.arange(99, len(recording.imu_stamp) - 1, 500), -1)):
        pass
    return navigator


def only_complaint(name: str, seed: int, changes: dict[str, Any] | None = None, **options: Any) -> str:
    complaints = navigated(name, seed, changes, **options).complaints
    assert len(complaints) == 1, complaints
    return complaints[0]


def numbers(sentence: str) -> list[float]:
    return [float(text) for text in re.findall(r"[-+]?\d+\.\d+|\b\d+\b", sentence)]


@pytest.mark.parametrize(
    ("name", "options", "changes"),
    [
        ("drive", {}, {}),
        ("drive", {}, POSITION_ONLY),
        ("drive", {"episodes": OUTAGES}, {}),
        ("drive", {"grade": "consumer", "episodes": OUTAGES}, {}),
        ("drive", RTK, {}),
        ("tunnel_drive", {"grade": "tactical"}, {}),
        ("reverse_start", {}, {}),
        ("multirotor", {}, {}),
        ("aeroplane", {}, {}),
        ("field_robot", {}, {}),
        ("parked", {"stop": 200.0}, {}),
        ("drive", {"episodes": (CorrelatedErrors(0.0, np.inf, (1.0, 1.5), 60.0),)}, {}),
    ],
)
def test_without_a_fault_nothing_is_said(name: str, options: dict[str, Any], changes: dict[str, Any]) -> None:
    for seed in range(30, 33):
        assert navigated(name, seed, changes, **options).complaints == []


@pytest.mark.parametrize(
    ("error", "changes", "options", "tolerance"),
    [
        ((-1.0, 0.0, 0.0), {}, {}, 0.15),
        ((0.0, 0.8, 0.0), {}, {}, 0.15),
        ((-1.5, 0.0, 0.0), POSITION_ONLY, {}, 0.5),
        ((-0.2, 0.0, 0.0), {}, RTK, 0.05),
    ],
)
def test_a_wrong_lever_arm_is_named(
    error: tuple[float, ...], changes: dict[str, Any], options: dict[str, Any], tolerance: float
) -> None:
    """The mounting of the IMU is another one than that of base_link: the sentence is about base_link."""
    mount = {"imu_rpy_deg": (0.0, 0.0, 90.0)}
    told = {"gnss.lever_arm": [a - e for a, e in zip(ARM, error)]}
    sentence = only_complaint("drive", 7, {**changes, **told}, **options, **mount)
    assert "gnss.lever_arm" in sentence
    assert numbers(sentence)[:3] == pytest.approx(error, abs=tolerance)


@pytest.mark.parametrize(
    ("offset", "changes", "options"), [(0.1, {}, {}), (-0.15, {}, {}), (0.15, POSITION_ONLY, {}), (0.02, {}, RTK)]
)
def test_a_time_offset_is_named(offset: float, changes: dict[str, Any], options: dict[str, Any]) -> None:
    """The stamps are right: told that they are off by ``offset``, the filter takes them to be off."""
    sentence = only_complaint("drive", 8, {**changes, "gnss.time_offset": -offset}, **options)
    assert ("early" if offset > 0.0 else "late") in sentence
    size, _, right = numbers(sentence)
    assert size == pytest.approx(abs(offset), rel=0.2)
    assert right == pytest.approx(0.0, abs=0.2 * abs(offset))


def test_a_reflection_is_named_with_its_size() -> None:
    sentence = only_complaint("drive", 9, episodes=(Multipath(100.0, 5.0, (20.0, -15.0, 0.0)),))
    assert "multipath" in sentence
    assert numbers(sentence) == pytest.approx([2.0, 25.0], abs=3.0)


def test_fixes_that_are_drawn_away_are_named() -> None:
    complaints = navigated("drive", 9, episodes=(Spoofing(100.0, 60.0, (1.5, 0.0, 0.0), 0.1, consistent=False),))
    sentence = complaints.complaints[0]
    assert "moved otherwise than the velocities" in sentence
    assert "multipath or spoofing" in sentence


def test_a_receiver_that_lies_consistently_is_caught_by_the_imu() -> None:
    complaints = navigated("drive", 9, stop=130.0, episodes=(Spoofing(100.0, 60.0, (5.0, 0.0, 0.0), 0.5),)).complaints
    (sentence,) = (text for text in complaints if "IMU went different ways" in text)
    assert 100.0 < numbers(sentence)[1] - START_STAMP * 1e-9 < 108.0


def test_the_scale_to_set_does_not_depend_on_the_one_that_is_set() -> None:
    lies = (Overconfidence(0.0, np.inf, 3.0),)
    advised = []
    for scale in (1.0, 2.0):
        complaints = navigated("drive", 10, {"gnss.covariance_scale": scale}, episodes=lies).complaints
        (sentence,) = (text for text in complaints if "set gnss.covariance_scale" in text)
        advised.append(float(re.findall(r"covariance_scale to ([\d.]+)", sentence)[0]))
    assert advised == pytest.approx([9.0, 9.0], rel=0.25)


@pytest.mark.parametrize("changes", [{}, POSITION_ONLY])
def test_covariances_that_are_too_small_are_named(changes: dict[str, Any]) -> None:
    complaints = navigated("drive", 10, changes, episodes=(Overconfidence(0.0, np.inf, 3.0),)).complaints
    assert "scatter" in complaints[0]
    assert numbers(complaints[0])[0] == pytest.approx(3.0, rel=0.25)
    assert numbers(complaints[0])[-1] == pytest.approx(9.0, rel=0.5)


def test_velocities_that_claim_too_much_are_named() -> None:
    changes = {"gnss.covariance_scale": 0.1, "gnss.position_std_floor": 1.0}
    sentence = navigated("drive", 10, changes).complaints[0]
    assert "velocities" in sentence
    assert 1.5 < numbers(sentence)[0] < 3.5


def test_covariances_that_are_too_large_are_named() -> None:
    """What is left of the claim may last: that is modelled, and said as a note."""
    navigator = navigated("drive", 10, {"gnss.covariance_scale": 100.0})
    assert navigator.complaints == []
    (sentence,) = navigator.notes
    assert numbers(sentence)[0] == pytest.approx(0.1, abs=0.03)
    assert "gnss.correlation_time" in sentence


def test_a_filter_that_is_told_a_better_grade_is_told_which_it_has() -> None:
    noise = {name: value for name, value in grade_parameters("tactical").items() if "std" not in name}
    complaints = navigated("drive", 11, {**noise, **POSITION_ONLY}, grade="consumer", episodes=OUTAGES).complaints
    (sentence,) = complaints
    assert "imu.gyro_noise_density" in sentence
    ratio, wanted = numbers(sentence)[0], numbers(sentence)[-1]
    assert ratio == pytest.approx(20.0, rel=0.15)
    assert wanted == pytest.approx(2e-4, rel=0.15)


def test_first_fixes_after_outages_that_are_further_off_than_expected_are_named() -> None:
    """As far off as expected they are not; four times as far, the factor is named."""
    navigator = navigated("drive", 12, POSITION_ONLY, grade="consumer", episodes=OUTAGES)
    receiver = navigator._states[0]["receiver"]
    assert receiver["coasts"] == len(OUTAGES)
    expected = 3 * receiver["coast_nis"]
    assert chi2.ppf(0.01, 12) < expected < chi2.ppf(0.99, 12)
    assert navigator.complaints == []
    receiver["coast_nis"] *= 16.0
    (sentence,) = navigator.complaints
    assert "imu.*_noise_density" in sentence
    assert numbers(sentence) == [4.0, pytest.approx(4.0 * math.sqrt(expected / 12.0), abs=0.05)]


def test_a_heading_that_cannot_be_found_is_named_when_the_robot_moves() -> None:
    assert "the heading is still unknown in" in only_complaint("motorway", 12)
