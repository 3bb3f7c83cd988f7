"""Zero velocity update: a robot that stands still has no velocity.

No payload; the timeline puts it on its grid, and the static detector (`stationarity.detector`) decides whether it
holds. The velocity of the IMU is zero but for the swaying of a body on its springs (Groves, section 15.3.1). Swaying
lasts for less than the spacing of the grid, so that the errors of the updates are independent; ten updates in a second
would not be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.jacobians import clear, set_identity
from eskf_ros.filter.measurements.row import Row
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import VELOCITY
from eskf_ros.filter.stationarity.detector import is_resting
from eskf_ros.parameters.schema import parameter

SIZE = 3


@njit
def linearize(state, settings, work):
    """Write innovation, Jacobian and noise to ``work``; return the number of scalars, 0 unless the robot is at rest."""
    if not is_resting(state, settings):
        return 0
    clear(work)
    set_identity(work.jacobian, VELOCITY)
    for i in range(SIZE):
        work.innovation[i] = -state.velocity_map[i]
        work.noise[i, i] = settings.zupt.velocity_std**2
    return SIZE


@dataclass(frozen=True)
class Zupt:
    enabled: bool = parameter(
        True,
        "",
        "While the vehicle stands still, hold velocity and turn rate at zero. Wheels, GNSS and the spread of the IMU's "
        "readings tell when it does.",
        live=True,
    )
    velocity_std: float = parameter(
        0.02,
        "m/s",
        "Standard deviation of the velocity of a vehicle that stands: it sways on its springs.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    rate_std: float = parameter(
        1.0e-4,
        "rad/s",
        "Standard deviation of its turn rate, as a mean over one second.",
        above=0.0,
        maximum=1.0,
        live=True,
    )


CONSTRAINT_GATE_PROBABILITY = 0.999
"""Share of the constraints that passes the chi-square gate if they hold."""

SETTINGS = np.dtype([("velocity_std", "f8"), ("rate_std", "f8")], align=True)
"""Standard deviations of the velocity (m/s) and of the rate (rad/s) of a body at rest."""


def describe(settings: np.void, parameters: Any) -> None:
    """Fill `SETTINGS` from the parameters."""
    settings["velocity_std"] = parameters.zupt.velocity_std
    settings["rate_std"] = parameters.zupt.rate_std


def is_enabled(parameters: Any) -> bool:
    """Say whether the constraints at rest are switched on."""
    return bool(parameters.zupt.enabled)


ROW = Row(
    Stream.ZUPT,
    "zero velocity",
    Zupt,
    "Standing still.",
    gate_probability=CONSTRAINT_GATE_PROBABILITY,
    settings=SETTINGS,
    describe=describe,
    is_enabled=is_enabled,
)
"""The facts of this measurement."""
