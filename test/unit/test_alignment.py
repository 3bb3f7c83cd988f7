"""Start-up: levelling, gyro bias at rest, heading; every sigma against draws from what it claims."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eskf_ros.filter.alignment import first_fix, levelling
from eskf_ros.filter.alignment import heading as heading_start
from eskf_ros.filter.history.records import AID
from eskf_ros.filter.inertial import navigation_frame
from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.integrity.restart import reset_alignment
from eskf_ros.filter.layout import blank_state
from eskf_ros.filter.loop import update_rest
from eskf_ros.filter.measurements import gnss_position
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity import static_window
from eskf_ros.filter.stationarity.detector import add_to_block
from support.kernels import (
    USUAL_STDS,
    conditioned_eigenvalues,
    copy_of,
    core,
    make_settings,
    make_state,
    random_covariance,
    random_state,
    to_quaternion,
    to_rotation,
)
from support.reference_filter import skew

Array = NDArray[np.float64]

MOUNT = {"imu__mount_position": [0.3, 0.1, -0.2], "imu__mount_rpy_deg": [160.0, -25.0, 130.0]}
LEVER_ARM = {"gnss__lever_arm": [0.8, -0.2, 1.4]}
NOISE = {
    "imu__accel_bias_std": 0.02,
    "imu__accel_noise_density": 2e-3,
    "imu__accel_bias_random_walk": 2e-3,
    "imu__gyro_bias_std": 1e-3,
    "imu__gyro_noise_density": 5e-5,
    "imu__gyro_bias_random_walk": 5e-5,
}
"""White noise and walk of the bias weigh about the same in the mean of two seconds."""

DATUM = (48.137, 11.575, 565.0)
RATE_HZ = 100.0
COUNT = 200
DRAWS = 400

seeds = pytest.mark.parametrize("seed", range(6))


def fresh(datum: tuple[float, float, float] | None = DATUM) -> Any:
    """Return a filter that has seen nothing but, perhaps, its datum."""
    state = blank_state()[0]
    if datum is not None:
        navigation_frame.set_datum(state, math.radians(datum[0]), math.radians(datum[1]), datum[2])
    return state


def at_rest(state: Any, attitude: Rotation, accel_bias: Any, gyro_bias: Any) -> tuple[Array, Array]:
    """Return the mean readings of an IMU that lies still with this attitude."""
    gravity = np.array(gravity_map(state, (0.0, 0.0, 0.0)))
    turning = (
        np.array(state["frame"]["earth_rate_map"]) if state["frame"]["datum_known"] else np.array([0.0, 4.8e-5, 5.5e-5])
    )
    return attitude.inv().apply(-gravity) + accel_bias, attitude.inv().apply(turning) + gyro_bias


def level_with(state: Any, force: Array, rate: Array, settings: Any, still: bool = True) -> None:
    levelling.level(state, COUNT * np.concatenate([force, rate]), COUNT, 1.0 / RATE_HZ, still, settings)


def mean_noise(rng: np.random.Generator, settings: Any, sensor: str) -> Array:
    """Draw the difference of the mean reading from the bias at its end: white noise, and a bias that walks."""
    steps = settings[f"{sensor}_bias_random_walk"] / math.sqrt(RATE_HZ) * rng.normal(size=(COUNT, 3))
    walk = np.cumsum(steps, axis=0)
    white = settings[f"{sensor}_noise_density"] / math.sqrt(COUNT / RATE_HZ) * rng.normal(size=3)
    return np.asarray(walk.mean(axis=0) - walk[-1] + white)


def tilt_error(state: Any, attitude: Rotation) -> Array:
    """Return the horizontal part of theta in R_true = exp(theta) R, whatever the heading of either."""
    up = np.array(navigation_frame.local_up(state))
    true_up_body = attitude.inv().apply(up)
    return np.cross(to_rotation(state["attitude"]).apply(true_up_body), up)


def assert_chi_square(squares: Any, dof: int) -> None:
    """A sum of normalised squares lies within what one run in 100 000 exceeds."""
    total, freedom = float(np.sum(squares)), dof * len(squares)
    assert chi2.ppf(5e-6, freedom) < total < chi2.ppf(1.0 - 5e-6, freedom), total / freedom


# ---------------------------------------------------------------------------------------------------- levelling


@seeds
@pytest.mark.parametrize("still", [True, False])
def test_tilt_error_is_what_the_accelerometer_bias_makes_of_it(seed: int, still: bool) -> None:
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(random_state=seed)
    bias = rng.normal(0.0, 0.05, 3)
    state = fresh()
    level_with(state, *at_rest(state, attitude, bias, np.zeros(3)), make_settings(**MOUNT), still)
    up = np.array(navigation_frame.local_up(state))
    expected = np.cross(up, to_rotation(state["attitude"]).apply(bias)) / 9.81
    # To the second order in bias over gravity.
    np.testing.assert_allclose(tilt_error(state, attitude), expected, rtol=0.0, atol=3.0 * (0.1 / 9.8) ** 2)
    assert np.linalg.norm(expected) > 1e-3
    assert state["level_known"] == 1
    np.testing.assert_allclose(core(state), core(state).T, rtol=1e-15)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0.6, -0.8, 0)])
@pytest.mark.parametrize("angle", [180.0 - 1e-7, 180.0 - 1e-4, 90.0, 1e-9])
def test_mounted_upside_down(axis: tuple[float, float, float], angle: float) -> None:
    attitude = Rotation.from_rotvec(math.radians(angle) * np.array(axis))
    state = fresh(None)
    level_with(state, *at_rest(state, attitude, np.zeros(3), np.zeros(3)), make_settings())
    assert np.linalg.norm(tilt_error(state, attitude)) < 2e-9
    true_up_body = attitude.inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(to_rotation(state["attitude"]).apply(true_up_body), (0, 0, 1), rtol=0.0, atol=2e-9)


@pytest.mark.parametrize("a", [(0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.6, 0.8, 0.0), (0.0, -0.6, 0.8)])
def test_turn_into_the_exact_opposite(a: tuple[float, float, float]) -> None:
    opposite = tuple(-c for c in a)
    turn = navigation_frame.shortest_turn(a, opposite)
    assert np.linalg.norm(turn) == pytest.approx(math.pi, abs=1e-12)
    np.testing.assert_allclose(Rotation.from_rotvec(turn).apply(a), opposite, rtol=0.0, atol=1e-12)


def test_level_draws_match_their_covariance() -> None:
    """Tilt and accelerometer bias jointly: with a wrong sign or no cross covariance the figure explodes."""
    settings = make_settings(**NOISE)
    rng = np.random.default_rng(1)
    joint, tilt_only = [], []
    for draw in range(DRAWS):
        attitude = Rotation.random(random_state=draw)
        bias = rng.normal(0.0, settings["accel_bias_std"], 3)
        state = fresh()
        force, rate = at_rest(state, attitude, bias, np.zeros(3))
        level_with(state, force + mean_noise(rng, settings, "accel"), rate, settings)
        chosen = [6, 7, 9, 10, 11]
        covariance = core(state)[np.ix_(chosen, chosen)]
        assert np.linalg.eigvalsh(covariance).min() > 0.0
        tilt = tilt_error(state, attitude)[:2]
        error = np.concatenate([tilt, bias - state["accel_bias"]])
        joint.append(error @ np.linalg.solve(covariance, error))
        tilt_only.append(tilt @ np.linalg.solve(covariance[:2, :2], tilt))
        # Nothing is known of the heading.
        assert core(state)[8, 8] == pytest.approx(math.pi**2, rel=1e-9)
    assert_chi_square(joint, 5)
    assert_chi_square(tilt_only, 2)


# ---------------------------------------------------------------------------------------------------- gyro bias


def bayes(mean_rate: Array, known: Array, prior_variance: float, noise: Array) -> tuple[Array, Array]:
    """Return mean and covariance of a bias of zero mean, given one reading of bias plus ``known`` plus noise."""
    information = np.linalg.inv(noise)
    covariance = np.linalg.inv(np.eye(3) / prior_variance + information)
    return covariance @ information @ (mean_rate - known), covariance


@pytest.mark.parametrize("case", ["no datum", "heading unknown", "heading known", "moving"])
@seeds
def test_gyro_bias_is_the_bayesian_posterior(seed: int, case: str) -> None:
    heading = {"alignment__initial_heading_deg": 25.0} if case == "heading known" else {}
    settings = make_settings(**{**NOISE, **heading, "imu__gyro_bias_std": 1e-4})
    attitude = Rotation.random(random_state=seed)
    state = fresh(None if case == "no datum" else DATUM)
    force, rate = at_rest(state, attitude, np.zeros(3), np.random.default_rng(seed).normal(0.0, 1e-4, 3))
    level_with(state, force, rate, settings, still=case != "moving")
    if case == "heading known":
        # The first levelling takes the heading; the second knows where the Earth's rate points.
        level_with(state, force, rate, settings)

    earth_rate = 7.292115e-5
    duration = COUNT / RATE_HZ
    noise = settings["gyro_noise_density"] ** 2 / duration + settings["gyro_bias_random_walk"] ** 2 * duration / 3.0
    to_body = to_rotation(state["attitude"]).inv().as_matrix()
    up = np.array(navigation_frame.local_up(state))
    earth = np.array(state["frame"]["earth_rate_map"])
    across = np.eye(3) - np.outer(up, up)
    # A rate of known size and unknown direction has half of its square on each of two axes.
    square = (across @ earth) @ (across @ earth)
    known, unknown = (up @ earth) * up, 0.5 * square * across
    if case == "no datum":
        known, unknown = np.zeros(3), earth_rate**2 * np.eye(3)
    elif case == "heading known":
        known, unknown = earth, square * across * settings["initial_heading_std"] ** 2
    elif case == "moving":
        unknown = 1e12 * np.eye(3)
    mean, covariance = bayes(rate, to_body @ known, 1e-8, noise * np.eye(3) + to_body @ unknown @ to_body.T)
    np.testing.assert_allclose(state["gyro_bias"], mean, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(core(state)[12:, 12:], covariance, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("gyro_bias_std", [1e-3, 5e-5])
def test_gyro_bias_draws_are_within_their_covariance(gyro_bias_std: float) -> None:
    """Across the vertical the Earth rate is of unknown direction but known size, so only the mean is chi-square's."""
    settings = make_settings(**{**NOISE, "imu__gyro_bias_std": gyro_bias_std})
    rng = np.random.default_rng(2)
    vertical, horizontal = [], []
    for draw in range(DRAWS):
        attitude = Rotation.random(random_state=draw)
        bias = rng.normal(0.0, gyro_bias_std, 3)
        state = fresh()
        force, rate = at_rest(state, attitude, np.zeros(3), bias)
        level_with(state, force, rate + mean_noise(rng, settings, "gyro"), settings)
        to_map = to_rotation(state["attitude"]).as_matrix()
        error = to_map @ (bias - state["gyro_bias"])
        covariance = to_map @ core(state)[12:, 12:] @ to_map.T
        vertical.append(error[2] ** 2 / covariance[2, 2])
        horizontal.append(error[:2] @ np.linalg.solve(covariance[:2, :2], error[:2]))
    assert_chi_square(vertical, 1)
    assert 0.9 * 2.0 < np.mean(horizontal) < 1.1 * 2.0, np.mean(horizontal)


# ------------------------------------------------------------------------------------------------------ heading


@seeds
@pytest.mark.parametrize("heading_deg", [-170.0, 0.0, 95.0])
def test_heading_is_that_of_base_link_with_any_mount(seed: int, heading_deg: float) -> None:
    settings = make_settings(**MOUNT, **LEVER_ARM)
    base = Rotation.from_euler("xyz", [4.0, -7.0, 40.0 * seed], degrees=True)
    mount = Rotation.from_euler("xyz", MOUNT["imu__mount_rpy_deg"], degrees=True)
    state = make_state((0.0, 0.0, 3.0), attitude=base * mount)
    assert heading_start.heading_of(state, settings) == pytest.approx(
        math.remainder(math.radians(40.0 * seed), 2.0 * math.pi), abs=1e-12
    )
    before = copy_of(state)
    heading_start.reset_heading(state, math.radians(heading_deg), 0.1, settings)
    expected = Rotation.from_euler("xyz", [4.0, -7.0, heading_deg], degrees=True)
    turned = to_rotation(state["attitude"]) * mount.inv()
    # The plumb line at the datum's altitude leans against map's z by a microradian.
    assert (turned.inv() * expected).magnitude() < 5e-6
    # The antenna, which is what GNSS had held, stays in its place.
    np.testing.assert_allclose(
        gnss_position.predict(state, 0, settings), gnss_position.predict(before, 0, settings), rtol=0.0, atol=1e-12
    )


@seeds
def test_set_heading_turns_the_tilt_error_with_the_attitude(seed: int) -> None:
    settings = make_settings(**MOUNT)
    state = make_state(attitude=Rotation.random(random_state=seed))
    core(state)[:] = random_covariance(seed, USUAL_STDS)
    before = copy_of(state)
    theta = np.array([1e-3, -2e-3, 0.0])
    truth = Rotation.from_rotvec(theta) * to_rotation(state["attitude"])
    np.testing.assert_allclose(tilt_error(state, truth), theta, rtol=0.0, atol=5e-6)
    std = 0.05
    heading_start.reset_heading(state, 2.0, std, settings)
    turn = to_rotation(state["attitude"]) * to_rotation(before["attitude"]).inv()
    # What is true has not moved: its tilt, seen from the new attitude, has.
    np.testing.assert_allclose(tilt_error(state, truth), turn.apply(theta), rtol=0.0, atol=5e-6)
    up = np.array(navigation_frame.local_up(before))
    full = np.eye(15)
    full[6:9, 6:9] = (np.eye(3) - np.outer(up, up)) @ turn.as_matrix()
    expected = full @ core(before) @ full.T
    expected[6:9, 6:9] += std**2 * np.outer(up, up)
    np.testing.assert_allclose(core(state), expected, rtol=0.0, atol=1e-14)
    assert conditioned_eigenvalues(core(state)).min() > 0.0


def test_level_and_heading_draws_match_their_covariance() -> None:
    """Level, then heading from the parameter: tilt, heading and accelerometer bias jointly, IMU mounted anyhow."""
    settings = make_settings(
        **NOISE, **MOUNT, alignment__initial_heading_deg=70.0, alignment__initial_heading_std_deg=2.0
    )
    mount = Rotation.from_euler("xyz", MOUNT["imu__mount_rpy_deg"], degrees=True)
    rng = np.random.default_rng(6)
    squares = []
    for _ in range(DRAWS):
        heading = 70.0 + 2.0 * rng.normal()
        attitude = Rotation.from_euler("xyz", [rng.normal(), rng.normal(), heading], degrees=True) * mount
        bias = rng.normal(0.0, settings["accel_bias_std"], 3)
        state = fresh()
        force, rate = at_rest(state, attitude, bias, np.zeros(3))
        level_with(state, force + mean_noise(rng, settings, "accel"), rate, settings)
        assert state["heading_known"] == 1
        theta = (attitude * to_rotation(state["attitude"]).inv()).as_rotvec()
        error = np.concatenate([theta, bias])
        covariance = core(state)[6:12, 6:12]
        squares.append(error @ np.linalg.solve(covariance, error))
    assert_chi_square(squares, 6)


def driving(velocity: Any, velocity_covariance: Any, heading: float | None = None, search_std: float = 0.1) -> Any:
    """Return a level filter of unknown heading whose search has found this velocity from GNSS and accelerations.

    The accelerations have told the search a heading (default: the course) with ``search_std`` (rad). It has agreed with
    the course for a while.
    """
    state = make_state((100.0, 50.0, 0.0), velocity, Rotation.from_euler("z", 1.0))
    state["heading_known"] = 0
    core(state)[:] = np.diag(np.repeat([1.0, 0.1, 0.002, 0.02, 1e-3], 3) ** 2)
    core(state)[8, 8] = math.pi**2
    core(state)[3:5, 3:5] = velocity_covariance
    turn = (math.atan2(velocity[1], velocity[0]) if heading is None else heading) - 1.0
    state["search"]["started"] = 1
    state["search"]["course_since"] = state["stamp"] - 10_000_000_000
    state["search"]["estimate"][2:4] = velocity[:2]
    state["search"]["covariance"][2:4, 2:4] = velocity_covariance
    state["search"]["estimate"][4:6] = math.cos(turn), math.sin(turn)
    state["search"]["covariance"][4:6, 4:6] = search_std**2 * np.eye(2)
    return state


def test_the_filter_goes_on_with_the_velocity_of_the_search_that_has_found_the_heading() -> None:
    """The search has used the accelerations; fixes may err together for longer than it averages them."""
    state = driving((8.0, 3.0, 0.5), np.diag([0.04, 0.09]))
    before, block = copy_of(state), random_covariance(1, [0.2, 0.3])
    state["search"]["estimate"][:4] = found = np.array([101.0, 49.0, 8.5, 2.5])
    state["search"]["covariance"][2:4, 2:4] = block
    heading_start.reset_to_search(state, 0.3, 0.05, make_settings())
    assert state["heading_known"] == 1
    np.testing.assert_array_equal(state["velocity_map"], [*found[2:], 0.5])
    np.testing.assert_array_equal(core(state)[3:5, 3:5], block)
    assert not core(state)[3:5, np.setdiff1d(np.arange(15), [3, 4])].any()
    np.testing.assert_array_equal(core(state)[:3, :3], core(before)[:3, :3])
    assert core(state)[8, 8] == pytest.approx(0.05**2)
    assert conditioned_eigenvalues(core(state)).min() > 0.0


def test_a_search_that_has_gone_astray_does_not_give_the_velocity() -> None:
    """Its velocity is 5 m/s away from that of the filter, which the fixes have told to 0.3 m/s."""
    state = driving((8.0, 3.0, 0.5), np.diag([0.04, 0.09]))
    before = copy_of(state)
    state["search"]["estimate"][2:4] = 3.0, 3.0
    heading_start.reset_to_search(state, 0.3, 0.05, make_settings())
    assert state["heading_known"] == 1
    np.testing.assert_array_equal(state["velocity_map"], before["velocity_map"])
    np.testing.assert_array_equal(core(state)[3:5, 3:5], core(before)[3:5, 3:5])


@seeds
def test_a_found_heading_leaves_the_antenna_as_certain_as_it_was(seed: int) -> None:
    """Fixes have told where the antenna is; the position is antenna - R lever_arm, whatever the attitude is."""
    settings = make_settings(**MOUNT, **LEVER_ARM)
    state = make_state((3.0, 2.0, 1.0), attitude=Rotation.random(random_state=seed))
    core(state)[:] = np.diag(np.repeat([0.5, 0.1, 0.02, 0.02, 1e-3], 3) ** 2)
    state["heading_known"], state["position_known"] = 0, 1
    before = core(state)[:3, :3].copy()
    heading_start.begin_with_heading(state, 1.0, 0.2, settings)
    jacobian = np.zeros((3, 15))
    jacobian[:, :3] = np.eye(3)
    jacobian[:, 6:9] = -skew(to_rotation(state["attitude"]).apply(settings["lever_arms_body"][0]))
    np.testing.assert_allclose(jacobian @ core(state) @ jacobian.T, before, atol=1e-12)


def test_course_alignment_is_no_worse_than_it_says() -> None:
    """Heading error over its sigma, for velocities in error as their covariance says and a crab angle as declared.

    It may be better: the standard deviation is not below that of the search, however well both agree.
    """
    settings = make_settings(alignment__course_std_deg=1.0, **LEVER_ARM)
    rng = np.random.default_rng(3)
    normalized = []
    for draw in range(DRAWS):
        heading, speed = rng.uniform(-math.pi, math.pi), rng.uniform(4.0, 15.0)
        covariance = random_covariance(draw, [0.25, 0.1])
        course = heading + math.radians(1.0) * rng.normal()
        velocity = speed * np.array([math.cos(course), math.sin(course)])
        velocity = velocity + rng.multivariate_normal([0.0, 0.0], covariance)
        state = driving((*velocity, 0.0), covariance, heading + 0.03 * rng.normal(), search_std=0.03)
        heading_start.align_to_course(state, settings)
        if state["heading_known"]:
            off = math.remainder(heading - heading_start.heading_of(state, settings), 2.0 * math.pi)
            normalized.append(off**2 / core(state)[8, 8])
    assert len(normalized) > 0.6 * DRAWS
    assert 0.2 < np.mean(normalized) < 1.1


@pytest.mark.parametrize(("crab_deg", "share"), [(0.0, 0.8), (40.0, 0.03)])
def test_what_crabs_is_hardly_ever_locked_onto_its_course(crab_deg: float, share: float) -> None:
    """And then with a standard deviation that allows for it: the search is wrong by its own, at the limit of belief."""
    rng, locked, settings = np.random.default_rng(4), 0, make_settings()
    for _ in range(1000):
        heading = math.radians(crab_deg) + 0.19 * rng.normal()
        state = driving((3.0, 0.0, 0.0), 1e-4 * np.eye(2), heading, search_std=0.19)
        heading_start.align_to_course(state, settings)
        locked += int(state["heading_known"])
        if state["heading_known"]:
            assert math.radians(crab_deg) < 4.0 * math.sqrt(core(state)[8, 8])
    assert locked >= 800 if crab_deg == 0.0 else locked < share * 1000


@pytest.mark.parametrize("since", [0.0, 0.4])
def test_search_and_course_must_agree_over_a_way(since: float) -> None:
    state = driving((8.0, 0.0, 0.0), 0.01 * np.eye(2))
    state["search"]["course_since"] = NEVER if since == 0.0 else state["stamp"] - round(since * 1e9)
    heading_start.align_to_course(state, make_settings())
    assert state["heading_known"] == 0
    state["stamp"] += 1_000_000_000
    heading_start.align_to_course(state, make_settings())
    assert state["heading_known"] == 1


@pytest.mark.parametrize(
    ("velocity", "std", "turn_rate", "aligned"),
    [
        ((8.0, 3.0, 0.0), 0.1, 0.0, True),
        ((8.0, 3.0, 0.0), 0.1, 0.19, True),
        ((8.0, 3.0, 0.0), 0.1, 0.25, False),
        ((8.0, 3.0, 0.0), 0.1, -0.25, False),
        ((8.0, 3.0, 0.0), 2.0, 0.0, False),
        ((1.9, 0.0, 0.0), 0.1, 0.0, False),
        ((2.1, 0.0, 0.0), 0.1, 0.0, True),
        ((0.0, 0.0, 0.0), 0.1, 0.0, False),
    ],
)
def test_course_is_taken_only_when_it_means_something(
    velocity: Any, std: float, turn_rate: float, aligned: bool
) -> None:
    settings = make_settings(alignment__course_min_speed=2.0)
    state = driving(velocity, std**2 * np.eye(2))
    state["angular_rate"] = (0.0, 0.0, turn_rate)
    before = copy_of(state)
    heading_start.align_to_course(state, settings)
    assert bool(state["heading_known"]) == aligned
    if not aligned:
        np.testing.assert_array_equal(state["attitude"], before["attitude"])
        np.testing.assert_array_equal(core(state), core(before))


@pytest.mark.parametrize(
    ("heading_deg", "search_std", "found_deg"),
    [
        (0.0, 0.1, 0.0),
        (8.0, 0.1, 0.0),  # they agree, and the course is taken
        (180.0, 0.1, 180.0),  # in reverse
        (172.0, 0.1, 180.0),
        (40.0, 0.1, None),  # side slip
        (90.0, 0.1, None),
        (0.0, 0.4, None),  # not decided yet
    ],
)
def test_the_course_sharpens_what_the_accelerations_have_decided(
    heading_deg: float, search_std: float, found_deg: float | None
) -> None:
    settings = make_settings()
    state = driving((8.0, 0.0, 0.0), 0.01 * np.eye(2), math.radians(heading_deg), search_std)
    heading_start.align_to_course(state, settings)
    assert bool(state["heading_known"]) == (found_deg is not None)
    if found_deg is not None:
        off = heading_start.heading_of(state, settings) - math.radians(found_deg)
        assert math.remainder(off, math.tau) == pytest.approx(0.0, abs=1e-9)


# ---------------------------------------------------------------------------------------------------- stillness


def watch(state: Any, settings: Any, seconds: float, force: Any, rate: Any, shaking: float = 0.0) -> None:
    """Show the stillness watch ``seconds`` of samples at 100 Hz, with a sine of ``shaking`` on the force."""
    for k in range(round(seconds * RATE_HZ)):
        state["stamp"] += 10_000_000
        state["specific_force"] = np.array(force) + (shaking * math.sin(0.9 * k), 0.0, 0.0)
        state["angular_rate"] = rate
        update_rest(state, settings)


def waiting() -> Any:
    state = fresh()
    state["stamp"] = state["imu"]["stamp"] = 1_000_000_000
    state["imu"]["interval"] = 0.01
    return state


def test_level_after_the_first_still_window() -> None:
    settings = make_settings(alignment__static_duration=2.0)
    state = waiting()
    force, rate = at_rest(state, Rotation.from_euler("xyz", [0.2, -0.1, 0.0]), np.zeros(3), [0.01, 0.02, -0.01])
    watch(state, settings, 1.9, force, rate)
    assert state["level_known"] == 0
    watch(state, settings, 0.2, force, rate)
    assert state["level_known"] == 1
    sigma = np.sqrt(np.diag(core(state))[12:])
    watch(state, settings, 30.0, force, rate)
    # More still windows make the mean of the gyro better, until the Earth's rate is what is not known.
    assert (np.sqrt(np.diag(core(state))[12:]) < 0.9 * sigma).all()
    np.testing.assert_allclose(state["gyro_bias"], (0.01, 0.02, -0.01), rtol=0.0, atol=6e-5)


def test_shaking_is_no_rest_and_a_long_drive_levels_all_the_same() -> None:
    settings = make_settings(alignment__static_duration=2.0, alignment__moving_start_after=10.0)
    state = waiting()
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), [0.01, 0.02, -0.01])
    watch(state, settings, 9.0, force, rate, shaking=3.0)
    assert state["level_known"] == 0
    watch(state, settings, 4.0, force, rate, shaking=3.0)
    assert state["level_known"] == 1
    assert core(state)[6, 6] >= settings["moving_tilt_std"] ** 2
    # Not at rest: the gyros say nothing of their bias.
    np.testing.assert_array_equal(state["gyro_bias"], 0.0)
    np.testing.assert_allclose(np.diag(core(state))[12:], settings["gyro_bias_std"] ** 2, rtol=1e-12)


@pytest.mark.parametrize("turn", [math.radians(0.5), math.radians(2.0)])
def test_a_creeping_turn_after_a_rest_is_no_rest(turn: float) -> None:
    """It is quiet, level, and no fix proves the motion: only that no bias changes by as much tells."""
    settings = make_settings(alignment__static_duration=2.0)
    state = waiting()
    bias = np.array([0.01, 0.02, -0.01])
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), bias)
    watch(state, settings, 10.5, force, rate)
    known = state["gyro_bias"].copy()
    watch(state, settings, 10.0, force, rate + np.array([0.0, 0.0, turn]))
    np.testing.assert_array_equal(state["gyro_bias"], known)


def test_a_bias_that_warms_up_is_followed_at_rest() -> None:
    settings = make_settings(alignment__static_duration=2.0)
    state = waiting()
    bias = np.array([0.01, 0.02, -0.01])
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), bias)
    for second in range(60):
        watch(state, settings, 1.0, force, rate + np.radians(0.1) * second / 60.0)
    assert state["stamp"] - state["window"]["still_stamp"] < 3_000_000_000


def test_the_force_of_a_body_that_sways_says_nothing_of_a_slow_turn() -> None:
    """Held in the hand: accelerations of 0.2 m/s2, which are no gravity that turns."""
    settings, state = make_settings(alignment__static_duration=2.0), waiting()
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), np.zeros(3))
    for k in range(210):
        state["stamp"] += 10_000_000
        state["specific_force"] = force + (0.2 * math.sin(0.03 * k), 0.0, 0.0)
        state["angular_rate"] = rate
        update_rest(state, settings)
    assert state["level_known"] == 1
    assert np.abs(state["gyro_bias"]).max() < 2e-4
    assert np.sqrt(np.diag(core(state))[12:]).max() < 2e-3


@pytest.mark.parametrize("speed", [0.0, 3.0])
def test_an_even_turn_is_a_bias_of_the_gyro_at_rest_only(speed: float) -> None:
    """3 deg/s for 20 s, as smooth as at rest: no robot turns like that but a boat, a train, or one in a simulation."""
    settings, state = make_settings(alignment__static_duration=2.0), waiting()
    state["position_known"], state["velocity_map"] = int(speed > 0.0), (speed, 0.0, 0.0)
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), np.zeros(3))
    watch(state, settings, 20.0, force, rate + (0.0, 0.0, math.radians(3.0)))
    assert (state["imu_monitor"]["biased_windows"] >= 3) == (speed == 0.0)


@pytest.mark.parametrize("seen", [False, True])
def test_a_creep_that_is_seen_is_not_levelled_as_rest(seen: bool) -> None:
    """Velocities of 0.3 m/s prove no motion at once, but over some seconds."""
    settings, state = make_settings(alignment__static_duration=2.0, alignment__moving_start_after=60.0), waiting()
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), np.zeros(3))
    for _ in range(10):
        watch(state, settings, 0.5, force, rate)
        if seen:
            state["rest"]["moving_stamp"] = state["stamp"]
    assert state["level_known"] == int(not seen)


@pytest.mark.parametrize(("rate_deg", "noise", "seconds"), [(0.05, 0.01, 6.0), (0.2, 0.01, 6.0), (0.15, 0.002, 2.1)])
def test_a_robot_that_tilts_while_it_stands_has_no_other_gyro_bias(
    rate_deg: float, noise: float, seconds: float
) -> None:
    """It pitches, as one that is loaded or that settles does; gravity in the readings shows by how much.

    What tilts evenly does not sway: one window of a good accelerometer is enough.
    """
    settings = make_settings(alignment__static_duration=2.0)
    state, rng = waiting(), np.random.default_rng(3)
    pitching, bias = math.radians(rate_deg), np.array([0.001, -0.002, 0.001])
    for k in range(round(seconds * RATE_HZ)):
        attitude = Rotation.from_euler("y", pitching * k / RATE_HZ)
        force, rate = at_rest(state, attitude, np.zeros(3), bias)
        state["stamp"] += 10_000_000
        state["specific_force"] = force + noise * rng.normal(size=3)
        state["angular_rate"] = rate + (0.0, pitching, 0.0) + 1e-3 * rng.normal(size=3)
        update_rest(state, settings)
    sigma = np.sqrt(np.diag(core(state))[12:])
    assert (np.abs(state["gyro_bias"] - bias) < 3.0 * sigma + 1e-4).all()
    assert abs(state["gyro_bias"][1] - bias[1]) < 0.5 * pitching


def test_a_robot_that_tilts_unevenly_is_levelled_where_it_is_at_the_end() -> None:
    """It pitches by two degrees within 40 s, ever more slowly: the mean and its mean change do not tell where it is."""
    settings, state, rng = make_settings(alignment__static_duration=2.0), waiting(), np.random.default_rng(4)
    attitude = Rotation.identity()
    for k in range(round(40.0 * RATE_HZ)):
        phase = 0.5 * math.pi * k / (40.0 * RATE_HZ)
        attitude = Rotation.from_euler("y", 2.0 * math.sin(phase), degrees=True)
        pitching = math.radians(2.0) * math.cos(phase) * 0.5 * math.pi / 40.0
        force, rate = at_rest(state, attitude, np.zeros(3), np.zeros(3))
        state["stamp"] += 10_000_000
        state["specific_force"] = force + 0.01 * rng.normal(size=3)
        state["angular_rate"] = rate + (0.0, pitching, 0.0) + 1e-3 * rng.normal(size=3)
        update_rest(state, settings)
    assert np.degrees(np.abs(tilt_error(state, attitude))).max() < 0.1
    assert np.abs(state["gyro_bias"]).max() < 3e-4


def started_gently(
    seconds_at_rest: float, jerk: float, pitching_deg: float = 0.0, speed_std: float = 0.3, seconds: float = 6.0
) -> Any:
    """Return a filter ``seconds`` after a robot began to speed up along x, ``jerk`` m/s3.

    It pitches (deg/s) all the time. Its other sensors exclude no speed of ``speed_std`` (m/s).
    """
    settings = make_settings(alignment__static_duration=2.0, imu__gyro_noise_density=5e-5)
    state, rng = waiting(), np.random.default_rng(6)
    state["seen"]["stamp"][0] = state["stamp"]
    state["seen"]["velocity_variance"][0] = speed_std**2
    pitching = math.radians(pitching_deg)
    for k in range(round((seconds_at_rest + seconds) * RATE_HZ)):
        time = k / RATE_HZ
        force, rate = at_rest(state, Rotation.from_euler("y", pitching * time), np.zeros(3), np.zeros(3))
        state["stamp"] += 10_000_000
        state["specific_force"] = (
            force + (jerk * max(time - seconds_at_rest, 0.0), 0.0, 0.0) + 0.01 * rng.normal(size=3)
        )
        state["angular_rate"] = rate + (0.0, pitching, 0.0) + 1e-3 * rng.normal(size=3)
        update_rest(state, settings)
    return state


@pytest.mark.parametrize("seconds_at_rest", [20.0, 20.5, 21.0, 21.5])
def test_a_gentle_start_is_no_tilt(seconds_at_rest: float) -> None:
    """No other sensor has seen it yet, and its readings are as quiet as at rest: but the gyros have seen no turn."""
    for jerk in (0.02, 0.05, 0.1, 0.2, -0.1):
        state = started_gently(seconds_at_rest, jerk)
        assert np.degrees(np.abs(tilt_error(state, Rotation.identity()))).max() < 0.025
        assert np.degrees(np.abs(state["gyro_bias"])).max() < 0.02


@pytest.mark.parametrize("jerk", [0.035, -0.017, -0.03])
def test_a_start_in_the_first_seconds_is_no_turn_of_the_body(jerk: float) -> None:
    """Gravity that seems to turn is an acceleration that grows, as long as nothing excludes the speed it leads to."""
    state = started_gently(0.0, jerk)
    assert np.degrees(np.abs(state["gyro_bias"])).max() < 0.02
    tilting = started_gently(0.0, jerk, pitching_deg=0.1)
    assert abs(tilting["gyro_bias"][1]) < 3.0 * math.sqrt(core(tilting)[13, 13])


def test_a_turn_that_is_proven_may_have_been_a_start_in_part() -> None:
    state = started_gently(0.0, 0.01, pitching_deg=0.4, speed_std=0.02, seconds=2.1)
    assert math.radians(0.04) < abs(state["gyro_bias"][1]) < math.radians(0.1)
    assert abs(state["gyro_bias"][1]) < 2.0 * math.sqrt(core(state)[13, 13])


def level_in_bend(rates_deg: Any, speed: float | None, step: float = 0.0) -> Any:
    """Show the stillness watch a yaw rate (deg/s) for a second each; fixes have seen a speed (m/s), or nothing.

    ``step`` (m/s2): the force along y changes by it after the first ten seconds.
    """
    settings, state, rng = make_settings(alignment__static_duration=2.0), waiting(), np.random.default_rng(5)
    if speed is not None:
        state["seen"]["stamp"][0] = state["stamp"]
        state["seen"]["velocity"][0, 0] = speed
        state["seen"]["velocity_variance"][0] = 0.01
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), np.zeros(3))
    for second, yaw_rate in enumerate(rates_deg):
        for _ in range(round(RATE_HZ)):
            state["stamp"] += 10_000_000
            state["specific_force"] = force + (0.0, step * (second >= 10), 0.0) + 0.01 * rng.normal(size=3)
            state["angular_rate"] = rate + (0.0, 0.0, math.radians(yaw_rate)) + 1e-3 * rng.normal(size=3)
            update_rest(state, settings)
            add_to_block(state, settings)
    return state


@pytest.mark.parametrize("first", [0.3, 1.5])
def test_the_rate_in_a_slow_bend_is_no_gyro_bias(first: float) -> None:
    """1 m/s through bends, quiet as at rest: the rate changes all the time. At rest it stays."""
    rates = first + 0.2 * np.sin(0.7 * np.arange(20.0))
    state = level_in_bend(rates, speed=1.0)
    assert state["level_known"] == 1
    assert abs(state["gyro_bias"][2]) < 2.0 * math.sqrt(core(state)[14, 14])
    at_rest, unseen = level_in_bend(np.full(20, first), speed=0.0), level_in_bend(rates, speed=None)
    assert at_rest["gyro_bias"][2] == pytest.approx(math.radians(first), abs=3e-4)
    for known in (at_rest, unseen):
        assert math.sqrt(core(known)[14, 14]) < 5e-4 < 0.1 * math.sqrt(core(state)[14, 14])


def test_the_first_window_in_a_slow_bend_shows_no_gyro_bias() -> None:
    """It ends with the block in which the rate has changed."""
    state = level_in_bend([1.0, 1.3, 1.3], speed=1.0)
    assert state["level_known"] == 1
    assert math.sqrt(core(state)[14, 14]) > 5e-3


def test_a_gentle_start_is_no_change_of_the_gyro_bias() -> None:
    """After four seconds at rest a bend of 0.2 deg/s is within what is not known of the bias."""
    rates = np.concatenate([np.zeros(4), 0.2 + 0.1 * np.sin(1.5 * np.arange(26.0))])
    state = level_in_bend(rates, speed=1.0)
    assert abs(state["gyro_bias"][2]) < 3.0 * math.sqrt(core(state)[14, 14])


def test_a_change_at_rest_is_soon_forgotten() -> None:
    """Somebody steps aboard after ten seconds: the robot may have set out, which the next seconds do not bear out."""
    doubtful = level_in_bend(np.full(13, 0.4), speed=0.0, step=0.05)
    assert core(doubtful)[14, 14] > 1e-5
    state = level_in_bend(np.full(20, 0.4), speed=0.0, step=0.05)
    assert state["rest"]["changed_stamp"] > NEVER
    assert state["gyro_bias"][2] == pytest.approx(math.radians(0.4), abs=3e-4)
    assert core(state)[14, 14] < 1.5 * core(level_in_bend(np.full(10, 0.4), speed=0.0))[14, 14]


def test_restart_while_standing_still_counts_from_zero() -> None:
    """The IMU falls silent on a parked robot: afterwards the gyro bias is what it was before, not several times it."""
    settings = make_settings(alignment__static_duration=2.0)
    state = waiting()
    bias = np.array([0.01, 0.02, -0.01])
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), bias)
    watch(state, settings, 20.5, force, rate)
    np.testing.assert_allclose(state["gyro_bias"], bias, rtol=0.0, atol=1e-4)
    reset_alignment(state)
    state["stamp"] += 6_000_000_000
    watch(state, settings, 2.5, force, rate)
    assert state["level_known"] == 1
    # Two seconds leave 1 % of the prior; the sums of the 20 s before would make it ten times the bias.
    np.testing.assert_allclose(state["gyro_bias"], bias, rtol=0.0, atol=4e-4)


def test_restart_under_way_does_not_know_the_heading_of_the_start() -> None:
    """The parameter says where the robot pointed when it was switched on, not after a drive and a hole in the data."""
    settings = make_settings(alignment__static_duration=2.0, alignment__initial_heading_deg=30.0)
    state = waiting()
    force, rate = at_rest(state, Rotation.identity(), np.zeros(3), np.zeros(3))
    watch(state, settings, 2.5, force, rate)
    assert state["heading_known"] == 1
    state["attitude"] = to_quaternion(Rotation.from_euler("z", 170.0, degrees=True))
    reset_alignment(state)
    state["stamp"] += 6_000_000_000
    watch(state, settings, 2.5, force, rate)
    assert state["heading_known"] == 0 or core(state)[8, 8] > 0.5


def distrusting(robots: int, std: float, speed: float = 0.0, wild: Any = ()) -> int:
    """Return how many robots, level and waiting for a heading, lose their level to 20 s of fixes at 5 Hz.

    Fixes scatter by ``std`` (m) on each axis and move at ``speed`` (m/s); a still window has just passed every 2 s. The
    fixes ``wild`` are 2 km off.
    """
    rng = np.random.default_rng(7)
    settings = make_settings()
    aid = allocate(AID)[0]
    found = 0
    for _ in range(robots):
        state = make_state()
        state["heading_known"] = 0
        for epoch in range(100):
            seconds = 0.2 * epoch
            east, north, up = std * rng.normal(size=3)
            north += speed * seconds + 2000.0 * (epoch in wild)
            latitude = math.radians(DATUM[0]) + north / 6.378e6
            longitude = math.radians(DATUM[1]) + east / (6.378e6 * math.cos(latitude))
            aid["stamp"] = round(seconds * 1e9)
            aid["payload"][:9] = (latitude, longitude, DATUM[2] + up, std**2, 0.0, 0.0, std**2, 0.0, std**2)
            if static_window.update_evidence_from_fix(state, aid):
                levelling.reset_level_to_moving(state, settings)
            if state["window"]["motion_stamp"] > 0 and state["window"]["still_stamp"] == NEVER:
                found += 1
                break
            if epoch % 10 == 0:
                state["window"]["still_stamp"] = aid["stamp"]
                state["window"]["anchor_stamp"][:] = state["window"]["last_fix_stamp"]
                state["window"]["anchor_ecef"][:] = state["window"]["last_fix_ecef"]
    return found


@pytest.mark.parametrize("std", [1.0, 20.0])
def test_the_scatter_of_fixes_takes_no_level_away(std: float) -> None:
    """At most one parked robot in a hundred; with three sigma, which a norm of three exceeds often, it is 17 or 67."""
    assert distrusting(200, std) <= 2


@pytest.mark.parametrize(("std", "speed"), [(0.02, 6.5), (1.0, 15.0)])
def test_fixes_that_move_take_a_false_level_away(std: float, speed: float) -> None:
    """No robot can have stood still within the last 2 s: what felt like rest was an even drive."""
    assert distrusting(20, std, speed) == 20


@pytest.mark.parametrize("wild", [(54,), (59,), (60,), (61,)])
def test_one_wild_fix_takes_no_level_away(wild: tuple[int, ...]) -> None:
    """Nor is it what the next ones are compared with, wherever in a window of ten it comes."""
    assert distrusting(5, 1.0, wild=wild) == 0


def test_first_fix_starts_the_position() -> None:
    """The datum is the fix; up, so far map's z without a datum, turns to the local vertical; level stays level."""
    settings = make_settings()
    state = fresh(None)
    attitude = Rotation.from_euler("xyz", [0.3, -0.2, 0.0])
    level_with(state, *at_rest(state, attitude, np.zeros(3), np.zeros(3)), settings)
    payload = np.array([math.radians(48.0), math.radians(11.0), 500.0, 1.0, 0.0, 0.0, 1.0, 0.0, 4.0])
    first_fix.reset_position_to_fix(state, payload)
    assert (state["frame"]["datum_known"], state["position_known"]) == (1, 1)
    np.testing.assert_array_equal(state["frame"]["datum"], payload[:3])
    np.testing.assert_allclose(state["position_map"], 0.0, atol=1e-9)
    # The plumb line at 500 m altitude leans by less than a microradian against the normal of the ellipsoid.
    assert np.linalg.norm(tilt_error(state, attitude)) < 1e-6
    assert (core(state) == core(state).T).all()
    assert conditioned_eigenvalues(core(state)).min() > 0.0
    np.testing.assert_array_equal(np.diag(core(state))[:3], first_fix.START_POSITION_STD**2)


def test_far_datum_levels_along_the_local_vertical() -> None:
    """A configured datum 500 km away: its z is 4.5 degrees off the plumb line where the robot stands."""
    settings = make_settings()
    state = fresh((48.0, 11.0, 0.0))
    attitude = Rotation.from_euler("xyz", [0.1, 0.0, 1.0])
    # Level first, along map's z as far as is known; the fix then tells where the robot is.
    force = attitude.inv().apply([0.0, 0.0, 9.81])
    level_with(state, force, np.zeros(3), settings)
    payload = np.array([math.radians(52.5), math.radians(11.0), 80.0, 1.0, 0.0, 0.0, 1.0, 0.0, 4.0])
    first_fix.reset_position_to_fix(state, payload)
    up = np.array(navigation_frame.local_up(state))
    assert math.degrees(math.acos(up[2])) == pytest.approx(4.5, abs=0.02)
    measured_up = to_rotation(state["attitude"]).apply(force / 9.81)
    np.testing.assert_allclose(measured_up, up, rtol=0.0, atol=1e-6)


def test_covariance_of_a_gyro_bias_at_rest_is_exactly_symmetric() -> None:
    for seed in range(20):
        state = random_state(seed)
        up = navigation_frame.local_up(state)
        rate = (1e-3, -2e-3, 5e-4)
        levelling.update_gyro_bias_at_rest(state, (0.0, 0.0, 0.0), 1e-4, rate, 0.0, up, 5.0, True, make_settings())
        assert (core(state) == core(state).T).all()
