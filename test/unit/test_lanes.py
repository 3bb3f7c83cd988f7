"""Two lanes and the motion: when the humble lane takes over, what the filter keeps, and what jumps and axes say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from eskf_ros.filter.alignment.heading_search import LEAST_ACCELERATION_STD, TILT
from eskf_ros.filter.alignment.heading_sensors import CONFIRMATIONS, confirm_given_heading
from eskf_ros.filter.history.records import AID
from eskf_ros.filter.integrity.heading_trial import reset_to_found_heading, start_without_heading
from eskf_ros.filter.integrity.humble_lane import EVIDENCE, reset_to_humble_lane, update_doubt, weigh_evidence
from eskf_ros.filter.integrity.motion_monitor import compare_axes, offset_by_jumps
from eskf_ros.filter.integrity.refusal import FEWEST, rival_offset
from eskf_ros.filter.layout import blank_state
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, GYRO_BIAS
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from support.kernels import make_settings, make_work

SETTINGS = make_settings()
GYRO_STD, HUMBLE_GYRO_STD = 1e-4, 1e-3
"""rad/s; of the gyro bias in the filter and in the humble lane."""


def lanes(gyro_bias: float) -> Any:
    """Both lanes, aligned; the humble one has a ``gyro_bias`` (rad/s) about each axis, the filter none."""
    states = blank_state()
    for state, gyro_std, accel_std in ((states[0], GYRO_STD, 1e-3), (states[1], HUMBLE_GYRO_STD, 1e-2)):
        state["error_size"], state["heading_known"], state["attitude"] = 15, 1, (1.0, 0.0, 0.0, 0.0)
        state["stamp"], state["frame"]["map_to_ecef"] = 1000 * SECOND, np.eye(3)
        covariance = np.diag([1.0] * 9 + [accel_std**2] * 3 + [gyro_std**2] * 3)
        state["covariance"][:15, :15] = covariance
    states[1]["position_map"], states[1]["gyro_bias"] = (5.0, 0.0, 0.0), gyro_bias
    return states


def test_what_was_thought_with_a_wrong_heading_is_forgotten_with_it() -> None:
    states = lanes(1e-3)
    state = states[0]
    state["heading"]["given_stamp"], state["trial"]["is_on"] = 900 * SECOND, 1
    state["trust"]["refused"] = 7
    state["installation"]["stamp"], state["installation"]["misfit"] = 999 * SECOND, 5.0
    reset_to_found_heading(states)
    np.testing.assert_allclose(state["position_map"], (5.0, 0.0, 0.0))
    np.testing.assert_allclose(state["gyro_bias"], 1e-3)
    assert state["heading"]["given_stamp"] == state["installation"]["stamp"] == NEVER
    assert (state["trial"]["is_on"], state["trust"]["takeovers"]) == (0, 1)
    assert not state["trust"]["refused"].any()
    assert not state["installation"]["misfit"].any()
    # The humble lane starts anew from the filter, to judge it.
    assert states[1]["heading_known"] == 0


@pytest.mark.parametrize("is_on", [True, False])
def test_fused_messages_do_not_confirm_a_heading_while_it_is_on_trial(is_on: bool) -> None:
    """A filter that believes a wrong heading bends everything to fit, and then fuses all messages."""
    state = lanes(0.0)[0]
    state["heading"]["given_stamp"], state["trial"]["is_on"], state["excitation"]["left"] = SECOND, is_on, 5.0
    for _ in range(CONFIRMATIONS):
        confirm_given_heading(state)
    assert (state["heading"]["given_stamp"] == SECOND) == is_on


@pytest.mark.parametrize("tilt_std", [1e-4, 0.05])
def test_the_lane_without_the_heading_knows_the_tilt_no_better_than_the_filter(tilt_std: float) -> None:
    states = lanes(0.0)
    state = states[0]
    for k in (ATTITUDE, ATTITUDE + 1):
        state["covariance"][k, k] = tilt_std**2 + (1e-3 / STANDARD_GRAVITY) ** 2
    start_without_heading(states, SETTINGS)
    assert states[1]["heading_known"] == 0
    expected = STANDARD_GRAVITY**2 * state["covariance"][ATTITUDE, ATTITUDE] + LEAST_ACCELERATION_STD**2
    assert states[1]["search"]["covariance"][TILT, TILT] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("sigmas", [0.5, 1.5])
def test_a_takeover_keeps_biases_that_the_humble_lane_does_not_contradict(sigmas: float) -> None:
    states = lanes(sigmas * HUMBLE_GYRO_STD)
    reset_to_humble_lane(states, False, make_work())
    state = states[0]
    assert state["position_map"][0] == pytest.approx(5.0)
    # With sigmas of 4e-4 (four times that of the filter) and 1e-3.
    assert np.abs(state["gyro_bias"]).max() < 0.15 * sigmas * HUMBLE_GYRO_STD
    assert np.sqrt(state["covariance"][GYRO_BIAS, GYRO_BIAS]) == pytest.approx(3.7e-4, rel=0.01)
    assert (state["doubt"], state["bias_doubt"]) == (1.0, 0.0)


@pytest.mark.parametrize("why", ["contradicted", "told", "again", "heading drifts"])
def test_a_takeover_brings_the_biases_of_the_humble_lane_where_those_of_the_filter_are_doubtful(why: str) -> None:
    bias = (10.0 if why == "contradicted" else 0.5) * HUMBLE_GYRO_STD
    states = lanes(bias)
    if why == "again":
        states[0]["trust"]["doubt_stamp"], states[0]["trust"]["doubt_time"] = 970 * SECOND, 60.0
    if why == "heading drifts":
        states[0]["corrections"]["left"] = 3.0
    reset_to_humble_lane(states, why == "told", make_work())
    state = states[0]
    np.testing.assert_allclose(state["gyro_bias"], bias)
    assert np.sqrt(state["covariance"][GYRO_BIAS, GYRO_BIAS]) == pytest.approx(HUMBLE_GYRO_STD)
    assert state["bias_doubt"] == 1.0


def test_accelerometer_biases_are_judged_on_their_own() -> None:
    states = lanes(10.0 * HUMBLE_GYRO_STD)
    reset_to_humble_lane(states, False, make_work())
    assert np.sqrt(states[0]["covariance"][ACCEL_BIAS, ACCEL_BIAS]) == pytest.approx(3.7e-3, rel=0.01)
    assert np.sqrt(states[0]["covariance"][GYRO_BIAS, GYRO_BIAS]) == pytest.approx(HUMBLE_GYRO_STD)


@pytest.mark.parametrize(("bias", "lasting"), [(10.0 * HUMBLE_GYRO_STD, 0.7), (0.0, 0.0)])
def test_doubt_about_the_imu_fades_in_a_minute_and_that_about_biases_that_have_moved_lasts(
    bias: float, lasting: float
) -> None:
    states = lanes(bias)
    reset_to_humble_lane(states, False, make_work())
    state = states[0]
    for passed, doubt, bias_doubt in (
        (30, 0.5, max(0.5, lasting)),
        (61, 0.0, lasting),
        (599, 0.0, lasting),
        (601, 0, 0),
    ):
        state["stamp"] = (1000 + passed) * SECOND
        update_doubt(state)
        assert state["doubt"] == pytest.approx(doubt)
        assert state["bias_doubt"] == pytest.approx(bias_doubt if bias else 0.0)


def messages_to_takeover(nis: float, humble_nis: float) -> int:
    """How many velocities with these NIS in filter and humble lane it takes until the humble lane takes over."""
    states = lanes(0.0)
    aid = np.zeros(1, AID)[0]
    aid["stream"] = Stream.GNSS_VELOCITY
    for count in range(1, 1000):
        if weigh_evidence(states, aid, nis, 0.0, humble_nis, 0.0, SETTINGS):
            return count
    return 1000


def test_a_message_that_surprises_both_lanes_is_less_evidence() -> None:
    """The same difference of 10 in NIS, where the humble lane expects the message, and where it does not."""
    assert messages_to_takeover(13.0, 3.0) == EVIDENCE / 5.0
    assert messages_to_takeover(25.0, 15.0) > 1.5 * messages_to_takeover(13.0, 3.0)


def refused(state: Any, seconds: float, offset: tuple[float, float]) -> None:
    """Let fixes be refused that have agreed with each other for ``seconds``, at ``offset`` (m) from the estimate."""
    trust, now = state["trust"], int(state["stamp"])
    trust["refused"][0, 0] = FEWEST
    trust["refused_since"][0, 0], trust["refused_stamp"][0, 0] = now - int(seconds * SECOND), now
    trust["refused_innovation"][0, 0, :2] = offset


def test_fixes_that_agree_while_they_are_refused_may_be_right() -> None:
    state = lanes(0.0)[0]
    state["recovery"]["absolute_stamp"] = NEVER
    refused(state, 5.0, (15.0, 0.0))
    assert rival_offset(state) == (0.0, 0.0)
    refused(state, 12.0, (15.0, 0.0))
    assert rival_offset(state) == (15.0, 0.0)
    state["recovery"]["absolute_stamp"] = state["stamp"]
    assert rival_offset(state) == (0.0, 0.0)


def test_after_a_jump_the_estimate_is_off_by_as_much_as_it_has_followed() -> None:
    state = lanes(0.0)[0]
    state["motion"]["jumps"], state["motion"]["offset"] = 1, (15.0, 0.0)
    state["motion"]["offset_stamp"] = state["stamp"]
    assert offset_by_jumps(state) == (15.0, 0.0)
    # Refused: the estimate has not followed.
    refused(state, 2.0, (15.0, 0.0))
    assert offset_by_jumps(state) == (0.0, 0.0)
    # Followed; then the fixes jumped back, and are refused.
    state["motion"]["offset"] = (0.0, 0.0)
    refused(state, 2.0, (-15.0, 0.0))
    assert offset_by_jumps(state) == (15.0, 0.0)


def test_velocities_in_other_axes_are_found_by_two_windows_in_motion() -> None:
    """However long the robot stood before; ways that agree say that they are not."""
    state = lanes(0.0)[0]
    for exchanged in (True, False):
        motion = state["motion"]
        motion["axes"], motion["has_other_axes"] = 0.0, 0
        for _ in range(200):
            motion["start_way"] = (0.1, -0.2)
            compare_axes(motion, (0.4, 0.3))
        for window in range(2):
            assert motion["has_other_axes"] == 0, window
            motion["start_way"] = (18.0, 5.0) if exchanged else (5.0, 18.0)
            compare_axes(motion, (5.5, 17.5))
        assert motion["has_other_axes"] == int(exchanged)
