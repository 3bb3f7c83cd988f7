"""The worked numbers of the textbook case, through the estimator's own functions and in its frames.

The textbook has north-east-down and forward-right-down; here it is east-north-up and forward-left-up.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eskf_ros.filter.inertial.strapdown import gravity_map
from eskf_ros.filter.measurements import gnss_position, gnss_velocity
from eskf_ros.filter.measurements.kalman_update import update
from eskf_ros.filter.state.enums import Stream, Verdict
from support.kernels import core, make_settings, make_state, make_work, run_samples

FACING_NORTH, FACING_EAST = (Rotation.from_euler("z", degrees, degrees=True) for degrees in (90.0, 0.0))


def north_east_down(vector: Any) -> tuple[float, float, float]:
    """Return N, E, D of a vector in east-north-up."""
    return vector[1], vector[0], -vector[2]


def van(facing: Rotation) -> tuple[Any, Any]:
    """Return state and settings of the van at N 200 E 50 D 0, its antenna 1.5 m forward, 0 right, -2.0 m down."""
    forward, right, down = 1.5, 0.0, -2.0
    settings = make_settings(gnss__lever_arm=[forward, -right, -down])
    return make_state((50.0, 200.0, 0.0), attitude=facing), settings


def test_altitude_fix() -> None:
    """Prior 412.30 m with P 9, fix 409.80 m with R 4: innovation -2.50, K 0.692, 410.57 m, P 2.77."""
    state = make_state((0.0, 0.0, 412.30), datum=(48.0, 11.0, 0.0))
    core(state)[2, 2] = 9.0
    work = make_work()
    # Straight above the datum the height in map is the altitude.
    payload = np.array([math.radians(48.0), math.radians(11.0), 409.80, 4.0, 0.0, 0.0, 4.0, 0.0, 4.0])
    size = gnss_position.linearize(state, payload, 0, make_settings(), work)
    assert work["innovation"][2] == pytest.approx(-2.50, abs=1e-8)
    verdict, nis = update(state, size, 100.0, work)
    assert verdict == Verdict.FUSED
    assert nis == pytest.approx(2.5**2 / 13.0, abs=1e-8)
    assert work["gain"][2, 2] == pytest.approx(0.692, abs=5e-4)
    assert state["position_map"][2] == pytest.approx(410.57, abs=5e-3)
    assert core(state)[2, 2] == pytest.approx(2.77, abs=5e-3)


def test_antenna_of_the_van() -> None:
    """Facing north it is at 201.5, 50, -2; facing east at 200, 51.5, -2 (north, east, down)."""
    for facing, expected in ((FACING_NORTH, (201.5, 50.0, -2.0)), (FACING_EAST, (200.0, 51.5, -2.0))):
        state, settings = van(facing)
        antenna = north_east_down(gnss_position.predict(state, 0, settings))
        np.testing.assert_allclose(antenna, expected, rtol=0.0, atol=1e-12)


def test_antenna_of_the_turning_van_moves_sideways() -> None:
    """Yaw rate 0.2 rad/s to the right: 0.3 m/s to the right, which is east for a van that faces north."""
    state, settings = van(FACING_NORTH)
    # To the right is about down; the gyro senses the Earth's turning as well.
    state["angular_rate"] = (0.0, 0.0, -0.2) + FACING_NORTH.inv().apply(state["frame"]["earth_rate_map"])
    velocity = north_east_down(gnss_velocity.predict(state, 0, settings))
    np.testing.assert_allclose(velocity, (0.0, 0.3, 0.0), rtol=0.0, atol=1e-12)


def test_a_tenth_of_a_degree_of_tilt_leaks_gravity() -> None:
    """0.017 m/s2 sideways: what a level, resting IMU gains in a second with an attitude 0.1 degrees off."""
    state = make_state(attitude=Rotation.from_euler("x", 0.1, degrees=True))
    state["frame"]["earth_rate_map"] = 0.0
    gravity = gravity_map(state, (0.0, 0.0, 0.0))
    stamps = np.arange(0, 1_000_000_001, 10_000_000, dtype=np.int64)
    force = np.tile((0.0, 0.0, -gravity[2]), (len(stamps), 1))
    run_samples(state, stamps, force, np.zeros_like(force), make_settings(), make_work())
    assert abs(state["velocity_map"][1]) == pytest.approx(0.017, abs=5e-4)
    assert abs(state["velocity_map"][1]) == pytest.approx(-gravity[2] * math.sin(math.radians(0.1)), rel=1e-3)


def test_20_ms_at_30_m_per_s() -> None:
    """0.6 m: the same fix, 20 ms apart in the timeline, has innovations that differ by that."""
    state, settings = van(FACING_EAST)
    state["velocity_map"] = (30.0, 0.0, 0.0)
    gravity = gravity_map(state, (0.0, 0.0, 0.0))
    force = np.tile((0.0, 0.0, -gravity[2]), (2, 1))
    datum = state["frame"]["datum"]
    payload = np.array([datum[0], datum[1], datum[2], 1.0, 0.0, 0.0, 1.0, 0.0, 1.0])
    innovations = []
    for _ in range(2):
        work = make_work()
        gnss_position.linearize(state, payload, 0, settings, work)
        innovations.append(work["innovation"][0])
        run_samples(state, np.array([0, 20_000_000]), force, np.zeros((2, 3)), settings, make_work())
    assert innovations[0] - innovations[1] == pytest.approx(0.6, abs=1e-5)


def test_gate_of_16() -> None:
    """With three degrees of freedom 16.0 is the 99.89 % quantile."""
    assert chi2.cdf(16.0, 3) == pytest.approx(0.9989, abs=5e-5)
    gate = make_settings(gnss__gate_probability=float(chi2.cdf(16.0, 3)))["gate"][Stream.GNSS_POSITION, 3]
    assert gate == pytest.approx(16.0, abs=1e-9)
    for distance, expected in ((3.999, Verdict.FUSED), (4.001, Verdict.GATE)):
        state, _ = van(FACING_NORTH)
        work = make_work()
        work["jacobian"][:, :15] = np.eye(3, 15)
        work["noise"] = np.eye(3)
        work["innovation"] = (0.0, distance, 0.0)
        assert update(state, 3, gate, work)[0] == expected
