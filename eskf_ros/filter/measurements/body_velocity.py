"""Velocity of a point of the vehicle in the axes of its sensor: DVL, optical flow, radar, odometry of any kind.

Payload: velocity (m/s, axes of the sensor), covariance (xx, xy, xz, yy, yz, zz); an axis with variance -1 was not
measured. Along each axis a of the sensor, a . (R' v + omega x arm), omega the body rate relative to the Earth, free of
the gyro bias (Groves, section 14.3.1).
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.measurements.jacobians import clear, gyro_noise_variance, point_velocity, set_point_velocity_row
from eskf_ros.geodesy.rotation import cross, dot, to_matrix

COVARIANCES = ((3, 4, 5), (4, 6, 7), (5, 7, 8))
"""Where the covariance of two axes is in the payload."""


@njit
def axis_of(settings, i):
    """Return an axis of the sensor as a unit vector in IMU axes."""
    axes = settings.body_velocity_axes_body
    return (axes[i, 0], axes[i, 1], axes[i, 2])


@njit
def predict(state, settings):
    """Return the velocity (m/s) that the sensor should show along its three axes."""
    rotation = to_matrix(state.attitude)
    velocity = point_velocity(state, rotation, body_rate(state, rotation), settings.body_velocity_arm_body)
    return (
        dot(axis_of(settings, 0), velocity),
        dot(axis_of(settings, 1), velocity),
        dot(axis_of(settings, 2), velocity),
    )


@njit
def linearize(state, payload, settings, work):
    """Write innovation, Jacobian and noise of the measured axes to ``work``; return how many there are."""
    clear(work)
    rotation = to_matrix(state.attitude)
    arm = settings.body_velocity_arm_body
    predicted = predict(state, settings)
    rate_variance = gyro_noise_variance(state, settings)
    row = 0
    for i in range(3):
        if payload[COVARIANCES[i][i]] < 0.0:
            continue
        axis = axis_of(settings, i)
        work.innovation[row] = payload[i] - predicted[i]
        set_point_velocity_row(work.jacobian, row, axis, 1.0, state, rotation, arm)
        lever = cross(axis, arm)
        column = 0
        for j in range(i + 1):
            if payload[COVARIANCES[j][j]] < 0.0:
                continue
            # The noise of the gyro is in the predictions of all axes.
            shared = rate_variance * dot(lever, cross(axis_of(settings, j), arm))
            work.noise[row, column] = payload[COVARIANCES[i][j]] + shared
            work.noise[column, row] = work.noise[row, column]
            column += 1
        row += 1
    return row
