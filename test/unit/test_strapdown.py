"""Strapdown navigation against an integration in the inertial frame that shares nothing with it but gravity."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.predict import LONGEST_STEP, step
from eskf_ros.filter.state.time import SECOND
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.simulate.imu import ideal_samples
from eskf_ros.simulate.scenario import DATUM, trajectory
from support.inertial_oracle import Inputs, MapState, integrate
from support.kernels import core, make_settings, make_state, make_work, run_samples, to_rotation, tuples

Array = NDArray[np.float64]

# A gap longer than any here: what a hole in the data costs is tested with the covariance.
SETTINGS = make_settings(imu__gap=10.0)
WORK = make_work()


def shaking(t: float) -> tuple[Array, Array]:
    """A body that turns about all axes out of phase: coning, sculling, and every term of the equations at work."""
    force = np.array([1.5 * math.sin(2.1 * t), 2.0 * math.cos(1.7 * t + 0.3), 9.8 + 1.2 * math.sin(2.6 * t)])
    rate = np.array([0.7 * math.cos(2.4 * t), 0.6 * math.sin(2.1 * t + 0.5), 0.3 + 0.5 * math.cos(1.3 * t)])
    return force, rate


def samples_of(inputs: Inputs, stamps: NDArray[np.int64]) -> tuple[Array, Array]:
    readings = [inputs(stamp / SECOND) for stamp in stamps]
    return np.array([reading[0] for reading in readings]), np.array([reading[1] for reading in readings])


def navigate(
    start: tuple[Any, Any, Rotation],
    datum: Any,
    stamps: NDArray[np.int64],
    force: Array,
    rate: Array,
    cuts: NDArray[np.int64] | None = None,
) -> Any:
    """Return the state after all samples, the intervals between them cut at ``cuts``."""
    state = make_state(start[0], start[1], start[2], datum)
    run_samples(state, stamps, force, rate, SETTINGS, WORK, cuts)
    return state


def departures(state: Any, truth: MapState) -> tuple[float, float, float]:
    """Return how far a state is off the last row of the truth: m, m/s, rad."""
    turn = to_rotation(truth.attitude_body_to_map[-1]).inv() * to_rotation(state["attitude"])
    return (
        float(np.linalg.norm(state["position_map"] - truth.position_map[-1])),
        float(np.linalg.norm(state["velocity_map"] - truth.velocity_map[-1])),
        float(turn.magnitude()),
    )


SHAKING_START = (
    np.array([100.0, -50.0, 20.0]),
    np.array([20.0, 5.0, -1.0]),
    Rotation.from_euler("xyz", [0.3, -0.2, 2.0]),
)
SHAKING_DATUM = (-33.0, 151.0, 40.0)
SHAKING_SECONDS = 30


@lru_cache
def shaking_truth() -> MapState:
    position, velocity, attitude = SHAKING_START
    start = (position, velocity, attitude.as_quat()[[3, 0, 1, 2]])
    return integrate(shaking, start, SHAKING_DATUM, [0.0, float(SHAKING_SECONDS)])


def stamps_at(rate_hz: int, seconds: float) -> NDArray[np.int64]:
    return np.round(np.arange(int(seconds * rate_hz) + 1) * (SECOND / rate_hz)).astype(np.int64)


def test_error_is_of_second_order_in_the_imu_interval() -> None:
    """Half the interval, at most a quarter of the error, in position, velocity and attitude alike.

    The line of equal mean even gives the third order; straight lines from sample to sample give exactly the second,
    and a hundred times the error at 400 Hz.
    """
    errors = []
    for rate_hz in (50, 100, 200, 400):
        stamps = stamps_at(rate_hz, SHAKING_SECONDS)
        state = navigate(SHAKING_START, SHAKING_DATUM, stamps, *samples_of(shaking, stamps))
        errors.append(departures(state, shaking_truth()))
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert (ratios > 4.0).all(), (errors, ratios)
    np.testing.assert_array_less(errors[-1], (2e-4, 1e-5, 2e-7))


def test_one_step_is_exact_for_linear_readings_to_the_fourth_order() -> None:
    """Half the interval, a 32nd of the error: without the coning or the sculling terms it would be an eighth.

    Force and rate are parallel at mid-interval: the rotation of the force to second order, omega x (omega x f), is
    none of these terms.
    """
    rate, rate_slope = np.array([1.0, -2.0, 1.5]), np.array([-3.0, 1.0, 4.0])
    force, force_slope = 5.0 * rate, np.array([20.0, 30.0, -10.0])
    attitude = Rotation.from_euler("xyz", [0.3, -0.2, 2.0])

    def derivative(t: float, y: Array) -> Array:
        turn = Rotation.from_quat(y[3:7])
        w = rate + t * rate_slope
        x, scalar = y[3:6], y[6]
        change = 0.5 * np.concatenate([scalar * w + np.cross(x, w), [-x @ w]])
        return np.concatenate([turn.apply(force + t * force_slope) - (0.0, 0.0, 9.80665), change])

    errors = []
    for dt in (0.08, 0.04):
        solution = solve_ivp(
            derivative,
            (-0.5 * dt, 0.5 * dt),
            [*np.zeros(3), *attitude.as_quat()],
            method="DOP853",
            rtol=1e-13,
            atol=1e-15,
        )
        # No datum: neither Earth rate nor a change of gravity, only the increments.
        state = make_state(attitude=attitude, datum=None)
        half_force, half_rate = 0.5 * dt * force_slope, 0.5 * dt * rate_slope
        ends = (force - half_force, rate - half_rate, force + half_force, rate + half_rate)
        step(state, *(tuples(end) for end in ends), dt, 0.0, SETTINGS, WORK)
        turn = Rotation.from_quat(solution.y[3:7, -1]).inv() * to_rotation(state["attitude"])
        errors.append((np.linalg.norm(state["velocity_map"] - solution.y[:3, -1]), turn.magnitude()))
    ratios = np.array(errors[0]) / np.array(errors[1])
    assert (ratios > 28.0).all(), (errors, ratios)


def test_intervals_may_be_split_anywhere() -> None:
    """Aids at stamps of their own cut intervals: the parts give the whole, to what a step itself leaves."""
    rng = np.random.default_rng(2)
    for rate_hz in (50, 100, 200):
        stamps = stamps_at(rate_hz, SHAKING_SECONDS)
        force, rate = samples_of(shaking, stamps)
        cuts = np.unique(np.concatenate([rng.integers(0, stamps[-1], len(stamps)), stamps[1:50] - 1]))
        ends = [navigate(SHAKING_START, SHAKING_DATUM, stamps, force, rate, c) for c in (None, cuts)]
        assert ends[0]["stamp"] == ends[1]["stamp"]
        difference = np.linalg.norm(ends[1]["position_map"] - ends[0]["position_map"])
        assert difference < 0.5 * departures(ends[0], shaking_truth())[0]


def test_long_intervals_are_cut() -> None:
    """Constant readings over a second, as across a hole in the data, give what 50 steps give."""
    force, rate = np.array([0.4, -0.2, 9.8]), np.array([0.02, -0.3, 0.5])
    few = np.array([0, SECOND], dtype=np.int64)
    many = np.arange(0, SECOND + 1, LONGEST_STEP, dtype=np.int64)
    ends = [
        navigate(
            SHAKING_START, SHAKING_DATUM, stamps, np.tile(force, (len(stamps), 1)), np.tile(rate, (len(stamps), 1))
        )
        for stamps in (few, many)
    ]
    np.testing.assert_allclose(ends[0]["position_map"], ends[1]["position_map"], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(ends[0]["attitude"], ends[1]["attitude"], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(core(ends[0]), core(ends[1]), rtol=1e-10, atol=1e-20)


@pytest.mark.parametrize("offset", [(50e3, 0.0, -196.0), (-30e3, 40e3, -196.0), (0.0, -900e3, -63e3)])
def test_far_from_the_datum_nothing_is_approximated(offset: tuple[float, float, float]) -> None:
    """``map`` is rigid: the same second order 50 km and even 900 km from its origin."""
    position = np.array(offset)
    start = (position, SHAKING_START[1], SHAKING_START[2])
    truth = integrate(shaking, (*start[:2], start[2].as_quat()[[3, 0, 1, 2]]), SHAKING_DATUM, [0.0, 10.0])
    errors = []
    for rate_hz in (200, 400):
        stamps = stamps_at(rate_hz, 10.0)
        errors.append(departures(navigate(start, SHAKING_DATUM, stamps, *samples_of(shaking, stamps)), truth))
    ratios = np.array(errors[0]) / np.array(errors[1])
    assert (ratios[1:] > 4.0).all(), (errors, ratios)
    # Micrometres, most of them from the very first interval, which knows no earlier sample.
    assert errors[1][0] < 1e-5


def test_gravity_without_a_datum_points_down() -> None:
    state = make_state(datum=None)
    assert gravity_map(state, (5.0, 6.0, 7.0)) == (0.0, 0.0, -9.80665)


def test_standing_on_the_turning_earth() -> None:
    """A body at rest that reads gravity and Earth rate exactly stays where it is for ten minutes."""
    attitude = Rotation.from_euler("xyz", [0.1, -0.3, 1.0])
    state = make_state((2000.0, 1000.0, 30.0), attitude=attitude)
    gravity = np.array(gravity_map(state, (2000.0, 1000.0, 30.0)))
    stamps = stamps_at(100, 600.0)
    force = np.tile(attitude.inv().apply(-gravity), (len(stamps), 1))
    rate = np.tile(attitude.inv().apply(state["frame"]["earth_rate_map"]), (len(stamps), 1))
    run_samples(state, stamps, force, rate, SETTINGS, WORK)
    # Rounding of 60 000 attitudes tilts by 1e-12 rad.
    np.testing.assert_allclose(state["position_map"], (2000.0, 1000.0, 30.0), rtol=0.0, atol=5e-6)
    assert (to_rotation(state["attitude"]) * attitude.inv()).magnitude() < 1e-11


class DriveInputs:
    """The ideal IMU of a drive as smooth splines from joint to joint, quick enough for a differential equation."""

    def __init__(self, name: str, seconds: float) -> None:
        self.path = trajectory(name)
        joints = self.path.breakpoints
        self.joints = np.append(joints[joints < seconds], seconds)
        frame = MapFrame(DATUM)
        self._splines = []
        for begin, end in zip(self.joints[:-1], self.joints[1:]):
            times = np.linspace(begin, end, max(12, math.ceil((end - begin) * 60.0)))
            readings = np.hstack(ideal_samples(self.path, frame, times))
            self._splines.append(make_interp_spline(times, readings, k=7))

    def __call__(self, t: float) -> tuple[Array, Array]:
        piece = min(max(int(np.searchsorted(self.joints, t, side="right")) - 1, 0), len(self._splines) - 1)
        reading = self._splines[piece](t)
        return reading[:3], reading[3:]


@lru_cache
def ten_minutes() -> tuple[DriveInputs, tuple[Any, Any, Rotation], MapState]:
    """Return the inputs of ten minutes of city laps, the state at their start and, by integration, at their end."""
    seconds = 600.0
    inputs = DriveInputs("hour_drive", seconds)
    probe = np.random.default_rng(1).uniform(0.0, seconds, 500)
    exact = np.hstack(ideal_samples(inputs.path, MapFrame(DATUM), probe))
    np.testing.assert_allclose([np.hstack(inputs(t)) for t in probe], exact, rtol=0.0, atol=2e-9)
    motion = inputs.path.motion([0.0])
    begin = (motion.position_map[0], motion.velocity_map[0], motion.attitude_body_to_map[0])
    truth = integrate(inputs, begin, DATUM, [0.0, seconds], inputs.joints)
    return inputs, (begin[0], begin[1], to_rotation(begin[2])), truth


@lru_cache
def ten_minutes_error(rate_hz: int) -> tuple[float, float, float]:
    """Return the departures after ten minutes of ideal samples."""
    inputs, start, truth = ten_minutes()
    stamps = stamps_at(rate_hz, 600.0)
    force, rate = ideal_samples(inputs.path, MapFrame(DATUM), stamps * 1e-9)
    return departures(navigate(start, DATUM, stamps, force, rate), truth)


@pytest.mark.slow
def test_ten_minutes_of_the_drive_are_of_second_order() -> None:
    """Half the interval, at most a quarter of the error."""
    assert ten_minutes_error(100)[0] / ten_minutes_error(200)[0] > 4.0


@pytest.mark.slow
def test_ten_minutes_of_the_drive_at_1_khz_are_within_a_millimetre() -> None:
    """Without the bend of the signal between samples it is 11 mm."""
    assert ten_minutes_error(1000)[0] < 1e-3
