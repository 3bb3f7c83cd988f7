"""Heading of a slow robot whose fixes are a metre wrong: wheels tell it, forward and in reverse."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import simulate
from eskf_ros.simulate.wheel import WheelOdometer
from support.aided import Run, run

YAW = 8
DRIVES_FROM = 15.0


def robot(seed: int) -> Recording:
    return simulate("field_robot", seed, imu_rate=50.0, grade="consumer", stop=60.0, wheel=WheelOdometer(rate=10.0))


def driven(recording: Recording, **parameters: Any) -> Run:
    """Position only: a fix of a metre is the best a cheap receiver has."""
    given = {**recording.parameters(), "gnss.use_velocity": False, **parameters}
    return run(recording, Navigator(from_mapping(given)), 1.0)


def found(result: Run) -> tuple[float, float, float]:
    """Seconds until the heading was known, its error and its standard deviation then (rad)."""
    variance = result.covariance[:, YAW, YAW]
    known = np.flatnonzero((variance > 0.0) & (variance < 1.0))
    assert len(known), "the heading was never found"
    first = known[0]
    return float(result.seconds[first]), float(result.error[first, YAW]), math.sqrt(variance[first])


def test_wheels_tell_the_heading_sooner_than_fixes_alone() -> None:
    normalised = []
    for seed in range(6):
        recording = robot(seed)
        seconds, error, std = found(driven(recording))
        assert seconds < DRIVES_FROM + 15.0
        assert std < math.radians(5.5)
        normalised.append(abs(error) / std)
    assert max(normalised) < 3.0
    alone = driven(robot(1), **{"wheel.use": False})
    aided = driven(robot(1))
    assert alone.covariance[-1, YAW, YAW] > 2.0 * aided.covariance[-1, YAW, YAW]


@pytest.mark.parametrize("seed", [0, 1])
def test_in_reverse_the_heading_is_the_other_way(seed: int) -> None:
    """base_link is told the other way round, so that the robot drives backwards and its wheels say so."""
    recording = robot(seed)
    assert recording.wheel is not None
    backwards = dataclasses.replace(recording, wheel=dataclasses.replace(recording.wheel, speed=-recording.wheel.speed))
    x, y, z = recording.options.lever_arm
    roll, pitch, yaw = recording.options.imu_rpy_deg
    assert (roll, pitch) == (0.0, 0.0)
    turned = {"gnss.lever_arm": [-x, -y, z], "imu.mount_rpy_deg": [0.0, 0.0, yaw + 180.0]}
    # Compared is the attitude of the IMU, which is what it was.
    _, error, std = found(driven(backwards, **turned))
    assert abs(error) < 3.0 * std
