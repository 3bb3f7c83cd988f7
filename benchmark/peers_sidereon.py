"""The filters of sidereon (PyPI) on the inputs of a recording, as rows that are compared with truth like ours."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.geodesy import earth
from eskf_ros.geodesy.map_frame import MapFrame, east_north_up_to_ecef
from eskf_ros.parameters.tree import Parameters

Array = NDArray[np.float64]

SECOND = 1_000_000_000
BIAS_TIME = 1e6
"""s; correlation time of the biases where these are Gauss-Markov: long, as ours walk at random and forget nothing."""

HELD = 1e-7
"""rad/s; standard deviation of a gyro bias that is to stay as it is. Beside the variance with which the receiver clock
starts, sidereon takes smaller ones for rounding errors and gives up."""

SATELLITES = 10
"""Number of satellites that is told with a fix; NavSatFix does not have it."""


class GaveUpError(Exception):
    """The filter of a peer refused a state or a message."""


@dataclass(frozen=True)
class Inputs:
    """What a filter is given: IMU samples, and fixes of the antenna that were not withheld, by stamp (ns).

    force (n, 3) m/s2 and rate (n, 3) rad/s in IMU axes; geodetic (m, 3) rad, rad, m; covariance (m, 3, 3) m2 in East,
    North, Up; velocity (m, 3) m/s in the same and its covariance, NaN where there is none with the stamp of the fix.
    """

    stamp: NDArray[np.int64]
    force: Array
    rate: Array
    fix_stamp: NDArray[np.int64]
    geodetic: Array
    covariance: Array
    velocity: Array
    velocity_covariance: Array


@dataclass(frozen=True)
class Run:
    """ODOMETRY rows (n,), and processor time per IMU sample in microseconds."""

    rows: NDArray[Any]
    microseconds: float


def imu_to_base(parameters: Parameters) -> Array:
    """Rotation (3, 3) from IMU to base_link axes."""
    return np.asarray(Rotation.from_euler("xyz", parameters.imu.mount_rpy_deg, degrees=True).as_matrix())


def new_filter(
    kind: str,
    start: NDArray[Any],
    frame: MapFrame,
    parameters: Parameters,
    holds_gyro_bias: bool,
    seconds: float = 0.0,
) -> Any:
    """A filter that starts from our own estimate at one row, with its covariance but for what correlates its parts.

    ``seconds``: its time at that row. A loosely coupled filter needs no date, and small numbers keep their digits.
    """
    import sidereon

    turn = imu_to_base(parameters)
    base_to_ecef = frame.rotation_map_to_ecef @ _matrix(start["attitude_body_to_map"])
    position = frame.to_ecef(start["position_map"][None])[0] + base_to_ecef @ parameters.imu.mount_position
    velocity = frame.rotation_map_to_ecef @ start["velocity_map"]
    nominal = sidereon.NavState(
        seconds,
        position.tolist(),
        velocity.tolist(),
        base_to_ecef @ turn,
        accel_bias_mps2=start["accel_bias"].tolist(),
        gyro_bias_rps=start["gyro_bias"].tolist(),
    )
    covariance = np.zeros((15, 15))
    to_ecef = frame.rotation_map_to_ecef
    covariance[:3, :3] = to_ecef @ start["pose_covariance"][:3, :3] @ to_ecef.T
    covariance[3:6, 3:6] = base_to_ecef @ start["twist_covariance"][:3, :3] @ base_to_ecef.T
    covariance[6:9, 6:9] = to_ecef @ start["pose_covariance"][3:, 3:] @ to_ecef.T
    covariance[9:12, 9:12] = np.diag(start["accel_bias_std"] ** 2)
    covariance[12:, 12:] = np.diag(np.full(3, HELD**2) if holds_gyro_bias else start["gyro_bias_std"] ** 2)
    symmetric = 0.5 * (covariance + covariance.T)
    state = sidereon.InsFilterState.from_covariance(nominal, sidereon.ErrorStateLayout.FIFTEEN, symmetric)
    imu, lever = parameters.imu, turn.T @ np.subtract(parameters.gnss.lever_arm, parameters.imu.mount_position)
    walk = np.sqrt(0.5 * BIAS_TIME)
    spec = sidereon.ImuSpec(
        imu.accel_noise_density,
        imu.gyro_noise_density,
        imu.accel_bias_random_walk * walk,
        HELD if holds_gyro_bias else imu.gyro_bias_random_walk * walk,
        BIAS_TIME,
        BIAS_TIME,
    )
    config = sidereon.InertialFilterConfig(
        spec,
        filter_kind=getattr(sidereon.FusionFilterKind, kind),
        loose=sidereon.LooseCouplingConfig(lever_arm_body_m=lever.tolist()),
        tight=sidereon.TightCouplingConfig(
            lever_arm_body_m=lever.tolist(),
            clock_bias_random_walk_m2_s=parameters.ranges.clock_bias_noise**2,
            clock_drift_random_walk_m2_s3=parameters.ranges.clock_drift_noise**2,
        ),
    )
    return sidereon.InertialFilter.with_config(state, config)


def _matrix(quaternion: Array) -> Array:
    """Rotation (3, 3) of a quaternion w x y z."""
    return np.asarray(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix())


def _measurement(sidereon: Any, inputs: Inputs, index: int, seconds: float) -> Any:
    """A fix, with its velocity where it has one, as sidereon takes it: in ECEF."""
    geodetic = inputs.geodetic[index : index + 1]
    turn = east_north_up_to_ecef(geodetic)[0]
    position = np.array(earth.geodetic_to_ecef(*geodetic[0].tolist()))
    covariance = turn @ inputs.covariance[index] @ turn.T
    status = sidereon.GnssFixStatus.SINGLE
    if not np.isfinite(inputs.velocity[index]).all():
        return sidereon.GnssFixMeasurement.position(
            seconds, position.tolist(), covariance, SATELLITES, fix_status=status
        )
    both = np.zeros((6, 6))
    both[:3, :3] = covariance
    both[3:, 3:] = turn @ inputs.velocity_covariance[index] @ turn.T
    velocity = turn @ inputs.velocity[index]
    return sidereon.GnssFixMeasurement.position_velocity(
        seconds, position.tolist(), velocity.tolist(), both, SATELLITES, fix_status=status
    )


def run_loose(
    inputs: Inputs,
    start: NDArray[Any],
    frame: MapFrame,
    parameters: Parameters,
    kind: str,
    holds_gyro_bias: bool = False,
) -> Run:
    """Run the loosely coupled filter (kind: EKF or UKF) from the row `start` of our estimate on."""
    import sidereon

    begin = int(start["stamp"])
    engine = new_filter(kind, start, frame, parameters, holds_gyro_bias)
    updates = {
        int(stamp): partial(engine.update_loose, _measurement(sidereon, inputs, index, (int(stamp) - begin) / SECOND))
        for index, stamp in enumerate(inputs.fix_stamp)
    }
    return driven(engine, inputs, begin, 0.0, updates, frame, parameters)


def driven(
    engine: Any,
    inputs: Inputs,
    begin: int,
    seconds: float,
    updates: Mapping[int, Callable[[], Any]],
    frame: MapFrame,
    parameters: Parameters,
) -> Run:
    """Drive a filter, whose time is `seconds` at the stamp `begin`, with the IMU and with updates by their stamp (ns).

    Updates come at their own time: the readings are interpolated there, and an interval is cut in two.
    """
    import sidereon

    stamps = np.union1d(inputs.stamp, np.array([begin, *updates], np.int64))
    stamps = stamps[(stamps >= begin) & (stamps <= inputs.stamp[-1])]
    since = (inputs.stamp - begin) / SECOND
    at = (stamps - begin) / SECOND
    force, rate = (
        np.column_stack([np.interp(at, since, axis) for axis in values.T]) for values in (inputs.force, inputs.rate)
    )
    # sidereon refuses an interval that is not the difference of its times to the last bit; since J2000 that is 0.1 us.
    times = seconds + at
    steps = np.diff(times)
    delta_velocity = (0.5 * (force[1:] + force[:-1]) * steps[:, None]).tolist()
    delta_angle = (0.5 * (rate[1:] + rate[:-1]) * steps[:, None]).tolist()
    states = []
    began = time.process_time()
    try:
        for index, stamp in enumerate(stamps[1:].tolist()):
            step = float(steps[index])
            engine.propagate(
                sidereon.ImuSample.increment(float(times[index + 1]), delta_velocity[index], delta_angle[index], step)
            )
            update = updates.get(stamp)
            if update is not None:
                update()
            states.append(engine.state)
    except ValueError as error:
        raise GaveUpError(str(error)) from error
    used = time.process_time() - began
    return Run(_rows(states, stamps[1:], frame, parameters), 1e6 * used / len(states))


def _rows(states: list[Any], stamps: NDArray[np.int64], frame: MapFrame, parameters: Parameters) -> NDArray[Any]:
    """ODOMETRY rows (n,) of states: pose of base_link in map, with the covariance of the position."""
    rows = np.zeros(len(states), ODOMETRY)
    rows["stamp"], rows["position_known"], rows["heading_known"] = stamps, True, True
    to_map = frame.rotation_map_to_ecef.T
    imu_to_ecef = np.array([state.nominal.attitude_body_to_ecef for state in states])
    base_to_map = to_map @ imu_to_ecef @ imu_to_base(parameters).T
    position = np.array([state.nominal.position_ecef_m for state in states])
    rows["position_map"] = (position - frame.origin_ecef) @ to_map.T - base_to_map @ parameters.imu.mount_position
    rows["velocity_map"] = np.array([state.nominal.velocity_ecef_mps for state in states]) @ to_map.T
    rows["attitude_body_to_map"] = np.roll(Rotation.from_matrix(base_to_map).as_quat(), 1, axis=1)
    covariance = np.array([state.covariance for state in states])
    rows["pose_covariance"][:, :3, :3] = to_map @ covariance[:, :3, :3] @ to_map.T
    rows["accel_bias"] = [state.nominal.accel_bias_mps2 for state in states]
    rows["gyro_bias"] = [state.nominal.gyro_bias_rps for state in states]
    rows["pose_covariance"][:, 3:, 3:] = to_map @ covariance[:, 6:9, 6:9] @ to_map.T
    return rows


def gyro_bias_at_rest(seconds: float = 60.0) -> tuple[float, float, float]:
    """Return true gyro bias, what sidereon makes of it, and its standard deviation of that (rad/s, first axis).

    An IMU without noise lies level and at rest, with a fix of 1 cm five times a second. The estimate starts at zero,
    with a standard deviation of twice the bias.
    """
    import sidereon

    frame, true = MapFrame((48.0, 11.0, 500.0)), 1e-3
    turn, place = frame.rotation_map_to_ecef, frame.origin_ecef
    force = (-frame.gravity_map(np.zeros((1, 3)))[0]).tolist()
    rate = (frame.earth_rate_map + [true, 0.0, 0.0]).tolist()
    covariance = np.diag(np.repeat([0.01, 0.01, 1e-3, 1e-6, 2e-3], 3) ** 2)
    nominal = sidereon.NavState(0.0, place.tolist(), [0.0, 0.0, 0.0], turn)
    state = sidereon.InsFilterState.from_covariance(nominal, sidereon.ErrorStateLayout.FIFTEEN, covariance)
    engine = sidereon.InertialFilter(state, sidereon.ImuSpec(1e-3, 1e-5, 1e-6, 1e-7, BIAS_TIME, BIAS_TIME))
    for step in range(1, round(20.0 * seconds) + 1):
        engine.propagate(sidereon.ImuSample.rate(0.05 * step, force, rate))
        if step % 4 == 0:
            fix = sidereon.GnssFixMeasurement.position(0.05 * step, place.tolist(), 1e-4 * np.eye(3), SATELLITES)
            engine.update_loose(fix)
    return true, float(engine.state.nominal.gyro_bias_rps[0]), float(np.sqrt(engine.state.covariance[12, 12]))
