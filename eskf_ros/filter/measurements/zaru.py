"""Zero angular rate update: a robot that stands still turns with the Earth, and the rest that its gyro reads is bias.

mean rate = gyro bias + R' Omega + noise, over the time since the last point on the grid of the constraints (Groves,
section 15.3.2). The Earth rate depends on the attitude, which is therefore in the Jacobian: an unknown heading leaves
the horizontal part of the Earth rate in doubt, and the measurement can sharpen a known one.

The white noise in the mean has also turned the attitude since the last grid point: noise and attitude error are
correlated, and the update is told so (``work.shared``). A correction of the noise then corrects the attitude, too, so
that the heading of a robot at rest does not walk with the noise of the gyro.
"""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.gyro_noise import gyro_density
from eskf_ros.filter.measurements.jacobians import clear, set_identity
from eskf_ros.filter.measurements.row import Row
from eskf_ros.filter.measurements.zupt import CONSTRAINT_GATE_PROBABILITY, is_enabled
from eskf_ros.filter.state.enums import CONSTRAINT_INTERVAL, Stream
from eskf_ros.filter.state.error_state import ATTITUDE, GYRO_BIAS
from eskf_ros.filter.stationarity.detector import is_resting, is_turning, mean_rate
from eskf_ros.geodesy.rotation import cross, rotate_back, to_matrix

SIZE = 3

INTERVAL = CONSTRAINT_INTERVAL * 1e-9
"""s; time over which the mean rate is taken."""


@njit
def predict(state):
    """Return what the gyro reads (rad/s, IMU axes) when the robot stands still."""
    earth = rotate_back(to_matrix(state.attitude), state.frame.earth_rate_map)
    bias = state.gyro_bias
    return (bias[0] + earth[0], bias[1] + earth[1], bias[2] + earth[2])


@njit
def remaining_share(state, density):
    """Return the share (0 to 1) of the noise of the last interval that is certainly still in the attitude error.

    Measurements in between may have removed it. The share is limited, so that attitude error and noise keep a positive
    definite joint covariance.
    """
    smallest = min(
        state.covariance[ATTITUDE, ATTITUDE],
        state.covariance[ATTITUDE + 1, ATTITUDE + 1],
        state.covariance[ATTITUDE + 2, ATTITUDE + 2],
    )
    return min(1.0, math.sqrt(0.5 * smallest / (density**2 * INTERVAL)))


@njit
def linearize(state, settings, work):
    """Write innovation, Jacobian and noise to ``work``; return the number of scalars, 0 unless the robot is at rest.

    Nor if it may be turning more slowly than the gate, with the noise of the parameters, would notice.
    """
    if not is_resting(state, settings) or is_turning(state):
        return 0
    clear(work)
    measured, predicted = mean_rate(state), predict(state)
    rotation = to_matrix(state.attitude)
    density = gyro_density(state, settings)
    shared = density**2 * remaining_share(state, density)
    set_identity(work.jacobian, GYRO_BIAS)
    for i in range(SIZE):
        work.innovation[i] = measured[i] - predicted[i]
        work.noise[i, i] = density**2 / INTERVAL + settings.zupt.rate_std**2
        axis = (rotation[0][i], rotation[1][i], rotation[2][i])
        earth = cross(axis, state.frame.earth_rate_map)
        for j in range(3):
            work.jacobian[i, ATTITUDE + j] = earth[j]
            # The attitude has turned by R times the noise, and lags by it: the covariance of noise i and error j.
            work.shared[i, ATTITUDE + j] = -axis[j] * shared
    return SIZE


ROW = Row(
    Stream.ZARU,
    "zero angular rate",
    group_name="zupt",
    gate_probability=CONSTRAINT_GATE_PROBABILITY,
    is_enabled=is_enabled,
)
"""The facts of this measurement; its parameters and settings are those of the zero velocity."""
