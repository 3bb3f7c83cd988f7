"""Simulated recordings through a navigator that is given their further sensors too."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Stream
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.recording import Recording
from monte_carlo import NO_SIDE_SLIP, Run, run

Offer = tuple[int, Stream, tuple[float, float, float], NDArray[np.float64], int]


def offers(recording: Recording) -> list[Offer]:
    """Stamp, stream, values, covariance and arrival of what the further sensors gave, in the order of stamps."""
    found: list[Offer] = []

    def add(stream: Stream, measured: Any, values: Any, variances: tuple[float, float, float]) -> None:
        covariance = np.diag(variances).ravel()
        for stamp, arrival, row in zip(measured.stamp.tolist(), measured.arrival.tolist(), values.tolist()):
            found.append((stamp, stream, tuple(row), covariance, arrival))

    if (heading := recording.dual_antenna) is not None:
        stds = heading.sensor.yaw_std_deg, heading.sensor.pitch_std_deg
        yaw, pitch = (min(math.radians(std), math.pi) ** 2 for std in stds)
        values = np.column_stack([heading.yaw, heading.pitch, np.zeros(len(heading.yaw))])
        add(Stream.HEADING, heading, values, (yaw, pitch, -1.0))
    if (mag := recording.magnetometer) is not None:
        variance = mag.sensor.noise_std**2
        add(Stream.MAG, mag, mag.field, (variance, variance, variance))
    if (baro := recording.barometer) is not None:
        values = np.column_stack([baro.pressure, np.zeros((len(baro.pressure), 2))])
        add(Stream.BARO, baro, values, (baro.sensor.noise_std**2, -1.0, -1.0))
    found.sort(key=lambda offer: offer[0])
    return found


class AidedNavigator(Navigator):
    """A navigator that, with the IMU samples, gets what the further sensors of the recording measured meanwhile."""

    def __init__(self, recording: Recording, **changes: Any) -> None:
        """Take the parameters of the recording and what is given as ``group__name=value``."""
        given = {key.replace("__", "."): value for key, value in changes.items()}
        super().__init__(from_mapping({**recording.parameters(), **given}))
        self.offers = offers(recording)
        self.offered = 0

    def push_imu(self, stamps: Any, specific_force: Any, angular_rate: Any, arrivals: Any = None) -> NDArray[Any]:
        while self.offered < len(self.offers) and self.offers[self.offered][0] <= stamps[-1]:
            stamp, stream, values, covariance, arrival = self.offers[self.offered]
            self.push(stream, stamp, values, covariance, arrival)
            self.offered += 1
        return super().push_imu(stamps, specific_force, angular_rate, arrivals)


def run_aided(recording: Recording, interval: float = 0.5, **changes: Any) -> Run:
    """Run a recording with all its sensors; compare with the truth every ``interval`` s."""
    return run(recording, AidedNavigator(recording, **{**_named(NO_SIDE_SLIP), **changes}), interval)


def _named(parameters: dict[str, Any]) -> dict[str, Any]:
    return {name.replace(".", "__"): value for name, value in parameters.items()}
