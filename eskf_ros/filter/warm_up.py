"""Compile all that a navigator calls, or load it from the cache, before the first message comes."""

from __future__ import annotations

import numpy as np

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.time import SECOND
from eskf_ros.gnss.measurements import MEASURED_SIGNAL
from eskf_ros.parameters.tree import Parameters


def compile_kernels() -> None:
    """Compile all that a `Navigator` calls, or load it from the cache: nothing of it is left for a callback."""
    trial = Navigator(Parameters())
    stamp, point, unit = SECOND, (0.0, 0.0, 0.0), np.eye(3).ravel()
    trial.push_imu(np.array([stamp]), np.array([[0.0, 0.0, 9.8]]), np.zeros((1, 3)))
    trial.push_gnss_position(stamp, *point, unit, 2, 0)
    trial.push_gnss_velocity(stamp, point, unit)
    trial.push_ranges(stamp, (0, 0.0), np.zeros(1, MEASURED_SIGNAL))
    trial.take_records()
    trial.odometry  # noqa: B018 - asked for its side effect
    trial.status  # noqa: B018
    trial.phase(Stream.GNSS_POSITION)
    trial._forget()
    trial.take_live()
    trial.set_datum(0.0, 0.0, 0.0)
    # Known by decree: these ask for level or position first.
    trial._states["level_known"] = 1
    trial.set_pose(point, np.eye(3), 0.0, 1.0)
    trial.set_datum_here()
