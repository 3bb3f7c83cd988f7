"""States of the installation: lever arm, time offsets, scales of the IMU, and what they do before the heading is known.

Their Jacobians in the measurements are tested with all others (test_measurement_rows).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.filter.alignment.heading import begin_with_heading
from eskf_ros.filter.alignment.levelling import reset_tilt
from eskf_ros.filter.integrity.humble_lane import size_for_gnss
from eskf_ros.filter.measurements.antenna import antenna_velocity, lever_arm_of, time_offset_of
from eskf_ros.filter.measurements.gnss_position import predict
from eskf_ros.filter.predict import step
from eskf_ros.filter.state.augmented_states import update_error_size
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, NOWHERE, POSITION, VELOCITY
from eskf_ros.geodesy.rotation import to_matrix
from support.kernels import copy_of, make_settings, make_work, random_state, to_rotation

Array = NDArray[np.float64]

INSTALLATION: dict[str, Any] = {
    "gnss__correlation_time": 0.0,
    "imu__mount_rpy_deg": [10.0, -20.0, 130.0],
    "imu__mount_position": [0.3, 0.1, -0.2],
    "gnss__lever_arm": [0.8, -0.2, 1.4],
}
ALL = make_settings(
    **INSTALLATION,
    estimate__lever_arm=True,
    estimate__time_offset=True,
    estimate__imu_scale=True,
    estimate__mounting=False,
)
SCALE = int(ALL["imu_scale_at"])


def active(seed: int, settings: Any = ALL) -> Any:
    """A state with all errors in use and its acceleration beyond doubt."""
    state = random_state(seed)
    update_error_size(state, int(settings["reach"].max()), settings)
    state["heading_known"], state["excitation"]["left"] = 1, 60.0
    return state


def test_they_are_off_by_default() -> None:
    plain = make_settings()
    for name in ("lever_arm", "time_offset", "velocity_time_offset", "imu_scale", "wheel_time_offset", "nhc_position"):
        assert plain[f"{name}_at"] == NOWHERE


@pytest.mark.parametrize("seed", range(3))
def test_lever_arm_is_added_in_base_link(seed: int) -> None:
    found = np.random.default_rng(seed).normal(size=3)
    state = active(seed)
    state["optional"][:3] = found
    told = make_settings(**{**INSTALLATION, "gnss__lever_arm": (np.array([0.8, -0.2, 1.4]) + found).tolist()})
    np.testing.assert_allclose(lever_arm_of(state, 0, ALL), told["lever_arms_body"][0], atol=1e-12)
    # The antenna of another receiver is another one.
    np.testing.assert_array_equal(lever_arm_of(state, 1, ALL), ALL["lever_arms_body"][1])
    velocity = antenna_velocity(state, to_matrix(state["attitude"]), 0, ALL)
    np.testing.assert_allclose(velocity, antenna_velocity(state, to_matrix(state["attitude"]), 0, told), atol=1e-12)


def test_velocities_have_an_offset_besides_that_of_positions() -> None:
    state = active(1)
    state["optional"][int(ALL["time_offset_at"]) - ERROR_SIZE] = 0.1
    state["optional"][int(ALL["velocity_time_offset_at"]) - ERROR_SIZE] = -0.3
    assert time_offset_of(state, 0, False, ALL) == pytest.approx(0.1)
    assert time_offset_of(state, 0, True, ALL) == pytest.approx(-0.2)
    assert time_offset_of(state, 1, True, ALL) == 0.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scale", range(6))
def test_scales_act_on_the_covariance_as_on_the_motion(scale: int, seed: int) -> None:
    """The column of a scale after one step is what differences of the motion say."""
    rng = np.random.default_rng(seed)
    force, rate, dt = rng.normal(0.0, 5.0, 3), rng.normal(0.0, 0.5, 3), 0.005
    state, work = active(seed), make_work()
    state["covariance"][:] = 0.0
    state["covariance"][SCALE + scale, SCALE + scale] = 1.0
    state["optional"][SCALE - ERROR_SIZE + scale] = 0.02
    difference = 1e-4
    ends = []
    for sign in (1.0, -1.0):
        moved = copy_of(state)
        moved["optional"][SCALE - ERROR_SIZE + scale] += sign * difference
        step(moved, force, rate, force, rate, dt, 0.0, ALL, work)
        ends.append(moved)
    step(state, force, rate, force, rate, dt, 0.0, ALL, work)
    column = state["covariance"][:ERROR_SIZE, SCALE + scale] / state["covariance"][SCALE + scale, SCALE + scale]
    turn = to_rotation(ends[0]["attitude"]) * to_rotation(ends[1]["attitude"]).inv()
    np.testing.assert_allclose(
        column[ATTITUDE : ATTITUDE + 3],
        turn.as_rotvec() / (2.0 * difference),
        atol=1e-4 * dt * np.abs(rate).max() + 1e-9,
    )
    change = (ends[0]["velocity_map"] - ends[1]["velocity_map"]) / (2.0 * difference)
    # To first order in the interval: the body turns by a milliradian or two meanwhile.
    np.testing.assert_allclose(column[VELOCITY : VELOCITY + 3], change, atol=5e-3 * dt * np.abs(force).max())
    np.testing.assert_array_equal(state["covariance"], state["covariance"].T)


def test_an_open_lever_arm_makes_the_position_uncertain_once_the_heading_is_known() -> None:
    """Fixes of centimetres have told where the antenna is, not where the IMU is: no lever arm is learnt from that."""
    state = active(2)
    state["heading_known"], state["position_known"] = 0, 1
    state["optional"][:] = 0.0
    state["covariance"][POSITION : POSITION + 3, :] = 0.0
    state["covariance"][:, POSITION : POSITION + 3] = 0.0
    state["covariance"][ATTITUDE : ATTITUDE + 3, :] = 0.0
    state["covariance"][:, ATTITUDE : ATTITUDE + 3] = 0.0
    place = slice(int(ALL["lever_arm_at"]), int(ALL["lever_arm_at"]) + 3)
    begin_with_heading(state, 1.0, 0.0, ALL)
    covariance = state["covariance"]
    to_map = np.array(to_matrix(state["attitude"])) @ ALL["imu_to_base"].T
    np.testing.assert_allclose(covariance[POSITION : POSITION + 3, place], -0.25 * to_map, atol=1e-12)
    antenna = covariance[:3, :3] + to_map @ covariance[place, :3] + covariance[:3, place] @ to_map.T
    antenna += to_map @ covariance[place, place] @ to_map.T
    # What is left is the way that the time offset may stand for.
    velocity = np.array(state["velocity_map"])
    np.testing.assert_allclose(antenna, np.outer(velocity, velocity) * 0.1**2, atol=1e-9)


def test_an_estimated_lever_arm_counts_when_a_heading_is_set() -> None:
    """What was found of the arm before the heading was lost is still there: the antenna stays in its place."""
    state = active(2)
    state["position_known"] = 1
    place = int(ALL["lever_arm_at"]) - ERROR_SIZE
    state["optional"][place : place + 3] = 0.3, -0.2, 0.1
    before = np.array(predict(state, 0, ALL))
    begin_with_heading(state, 1.0, 0.1, ALL)
    np.testing.assert_allclose(predict(state, 0, ALL), before, rtol=0.0, atol=1e-9)


def test_scales_of_accelerometers_have_tilted_the_level() -> None:
    """At rest a scale error reads as a bias does: once both are open, the tilt follows the sum of the two."""
    state = random_state(3)
    state["attitude"] /= np.linalg.norm(state["attitude"])
    update_error_size(state, int(ALL["reach"].max()), ALL)
    rotation, up = np.array(to_matrix(state["attitude"])), np.array([0.0, 0.0, 1.0])
    force = 9.8 * rotation.T @ up
    reset_tilt(state, tuple(up), 9.8, (0.0, 0.0, 0.0), 0.2**2, 1e-8, ALL)
    covariance = state["covariance"]
    for k in range(3):
        by_bias = covariance[ATTITUDE : ATTITUDE + 3, ACCEL_BIAS + k] / 0.2**2
        by_scale = covariance[ATTITUDE : ATTITUDE + 3, SCALE + k] / 0.01**2
        np.testing.assert_allclose(by_scale, by_bias * force[k], atol=1e-12)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)


def test_the_humble_lane_has_what_fixes_need() -> None:
    assert size_for_gnss(active(0), ALL) == int(ALL["velocity_time_offset_at"]) + 1
    only = make_settings(**INSTALLATION, estimate__lever_arm=True)
    assert size_for_gnss(active(0, only), only) == int(only["lever_arm_at"]) + 3
    assert size_for_gnss(random_state(0), ALL) == ERROR_SIZE
    lasting = make_settings(gnss__correlation_time=50.0, gnss__correlated_share=0.5)
    assert size_for_gnss(active(0, lasting), lasting) == ERROR_SIZE + 3


def test_wheels_activate_the_states_before_theirs() -> None:
    """The order of the indices is fixed: what is active is always the first part of it."""
    settings = make_settings(estimate__time_offset=True, estimate__lever_arm=True)
    assert settings["reach"][Stream.WHEEL] == settings["wheel_time_offset_at"] + 1
    assert settings["reach"][Stream.GNSS_POSITION] == settings["time_offset_at"] + 1
    assert math.isclose(settings["optional_std"][settings["time_offset_at"] - ERROR_SIZE], 0.1)
