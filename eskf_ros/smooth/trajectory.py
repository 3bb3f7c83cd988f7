"""The smoothed trajectory: corrections of the nodes, interpolated, on the trajectory of the filter between them."""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.output.global_odometry import write_odometry
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, GYRO_BIAS, POSITION, VELOCITY
from eskf_ros.geodesy.rotation import from_rotation_vector, left_jacobian, multiply, normalized, rotate
from eskf_ros.smooth.backward import CORRECTION_AFTER, CORRECTION_BEFORE, SMOOTHED_AFTER, SMOOTHED_BEFORE


@njit
def write_rows(points, nodes, numbers, state_, local, settings, rows):
    """Fill one ODOMETRY row for each point (POINT), which lie after the first of the smoothed nodes.

    Between two nodes the errors follow the motion of the filter. So do the corrections but for the noise of the IMU
    within one interval: the position by the cubic that has the corrected positions and velocities at its ends, all else
    on straight lines, the covariance, too. ``state_`` (STATE) supplies the frame and is overwritten; status and quality
    are those of the filter.
    """
    state = state_[0]
    k = 0
    for i in range(len(points)):
        point, row = points[i], rows[i]
        while k + 1 < len(nodes) and nodes[k + 1].stamp < point.stamp:
            k += 1
        begin, end = numbers[k], numbers[min(k + 1, len(nodes) - 1)]
        duration = (nodes[min(k + 1, len(nodes) - 1)].stamp - nodes[k].stamp) * 1e-9
        share = (point.stamp - nodes[k].stamp) * 1e-9 / duration if duration > 0.0 else 0.0
        state.stamp = point.stamp
        state.position_known = 1
        state.heading_known = point.heading_known
        correct_point(state, point, begin, end, share, duration)
        at = 0
        for a in range(ERROR_SIZE):
            for b in range(a + 1):
                value = (1.0 - share) * begin[SMOOTHED_AFTER + at] + share * end[SMOOTHED_BEFORE + at]
                state.covariance[a, b] = value
                state.covariance[b, a] = value
                at += 1
        write_odometry(state, local[0], settings[0], row)
        row.status = point.status
        row.quality = point.quality


@njit
def correct_point(state, point, begin, end, share, duration):
    """Write the nominal state of a point to ``state``, corrected at ``share`` of an interval of ``duration`` s."""
    rest = 1.0 - share
    # The Hermite basis: values and slopes at both ends.
    at_begin, at_end = (1.0 + 2.0 * share) * rest * rest, share * share * (3.0 - 2.0 * share)
    slope_begin, slope_end = share * rest * rest * duration, -share * share * rest * duration
    b, e = CORRECTION_AFTER, CORRECTION_BEFORE
    turn = (
        rest * begin[b + ATTITUDE] + share * end[e + ATTITUDE],
        rest * begin[b + ATTITUDE + 1] + share * end[e + ATTITUDE + 1],
        rest * begin[b + ATTITUDE + 2] + share * end[e + ATTITUDE + 2],
    )
    q = point.attitude
    attitude = normalized(multiply(from_rotation_vector(turn), (q[0], q[1], q[2], q[3])))
    for i in range(4):
        state.attitude[i] = attitude[i]
    for i in range(3):
        p, v, a, g = POSITION + i, VELOCITY + i, ACCEL_BIAS + i, GYRO_BIAS + i
        state.position_map[i] = (
            at_begin * begin[b + p] + at_end * end[e + p] + slope_begin * begin[b + v] + slope_end * end[e + v]
        )
        state.velocity_map[i] = rest * begin[b + v] + share * end[e + v]
        state.accel_bias[i] = point.accel_bias[i] + rest * begin[b + a] + share * end[e + a]
        state.gyro_bias[i] = point.gyro_bias[i] + rest * begin[b + g] + share * end[e + g]
        state.angular_rate[i] = point.angular_rate[i]
    # The corrections of position and velocity are injected as those of the filter (`kalman_update`).
    turning = left_jacobian(turn)
    step, change = rotate(turning, state.position_map), rotate(turning, state.velocity_map)
    for i in range(3):
        state.position_map[i] = point.position_map[i] + step[i]
        state.velocity_map[i] = point.velocity_map[i] + change[i]
