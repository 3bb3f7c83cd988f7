"""A simulated inertial measurement unit.

A sample is INSTANTANEOUS by default: specific force and angular rate at its stamp, as an ideal sensor without filter
delay gives them. With ``interval_mean`` it is their mean over the preceding sample interval, as sensors that integrate
and decimate give it (its effective time is then half an interval before its stamp).

The error of a sample is a turn-on bias (constant, Gaussian), plus a bias that walks at random (zero at the first
sample), plus white noise of density times the square root of the sample rate. All of it is in IMU axes. Scale factor
errors and quantisation are off unless asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.simulate.motion import Trajectory, Vector, cross, mounting
from eskf_ros.simulate.sampling import generators

Array = NDArray[np.float64]

GRADES: dict[str, dict[str, float]] = {
    # Telephone and hobby sensors.
    "consumer": {
        "imu.gyro_noise_density": 2.0e-4,
        "imu.accel_noise_density": 2.0e-3,
        "imu.gyro_bias_random_walk": 1.0e-5,
        "imu.accel_bias_random_walk": 2.0e-4,
        "imu.gyro_bias_std": 1.0e-2,
        "imu.accel_bias_std": 2.0e-1,
    },
    # MEMS units of robots and machines, calibrated over temperature.
    "industrial": {
        "imu.gyro_noise_density": 5.0e-5,
        "imu.accel_noise_density": 6.0e-4,
        "imu.gyro_bias_random_walk": 2.0e-6,
        "imu.accel_bias_random_walk": 5.0e-5,
        "imu.gyro_bias_std": 3.0e-3,
        "imu.accel_bias_std": 5.0e-2,
    },
    # The best MEMS and small fibre-optic units.
    "tactical": {
        "imu.gyro_noise_density": 1.0e-5,
        "imu.accel_noise_density": 3.0e-4,
        "imu.gyro_bias_random_walk": 1.0e-7,
        "imu.accel_bias_random_walk": 3.0e-6,
        "imu.gyro_bias_std": 5.0e-5,
        "imu.accel_bias_std": 1.5e-2,
    },
}
"""Error model by grade, keyed by the estimator's parameters: noise density in rad/s/rtHz and m/s2/rtHz, random walk of
the bias in rad/s2/rtHz and m/s3/rtHz, standard deviation of the turn-on bias in rad/s and m/s2."""

_MEAN_NODES, _MEAN_WEIGHTS = np.polynomial.legendre.leggauss(3)


def grade_parameters(grade: str) -> dict[str, float]:
    """Return the estimator's ``imu.*`` noise parameters for ``grade``; ValueError names the grades there are."""
    if grade not in GRADES:
        raise ValueError(f"unknown IMU grade '{grade}'; there are {', '.join(GRADES)}")
    return dict(GRADES[grade])


@dataclass(frozen=True)
class ImuMount:
    """Pose of the IMU in base_link: ``position`` (m) and fixed-axis ``rpy_deg``, as in URDF."""

    position: Vector = (0.0, 0.0, 0.0)
    rpy_deg: Vector = (0.0, 0.0, 0.0)

    @property
    def rotation_imu_to_body(self) -> Array:
        """Rotation matrix (3, 3) from IMU to base_link axes."""
        return mounting(self.rpy_deg)


def ideal_samples(
    trajectory: Trajectory,
    frame: MapFrame,
    times: Array,
    mount: ImuMount | None = None,
    gravity_removed: bool = False,
) -> tuple[Array, Array]:
    """Return specific force (m/s2) and inertial angular rate (rad/s), both (n, 3) in IMU axes, at ``times`` (n,) s.

    f = R^T (a + 2 Omega x v - g) of the IMU's own point, and omega = rate relative to the Earth + R^T Omega: Groves,
    section 5.3, in a frame that is fixed to the Earth; g is normal gravity, the centrifugal part included. With
    ``gravity_removed`` g is left out, as by a driver that gives "linear acceleration".
    """
    mount = mount or ImuMount()
    motion = trajectory.motion(times)
    body_to_map = motion.rotation_body_to_map
    coriolis = 2.0 * cross(frame.earth_rate_map, motion.velocity_of(mount.position))
    force_map = motion.acceleration_of(mount.position) + coriolis
    if not gravity_removed:
        force_map -= frame.gravity_map(motion.position_of(mount.position))
    force_body = np.einsum("nji,nj->ni", body_to_map, force_map)
    rate_body = motion.angular_rate_body + frame.earth_rate_map @ body_to_map
    # Row vectors times the rotation to the body are the transposed rotation: body to IMU.
    return force_body @ mount.rotation_imu_to_body, rate_body @ mount.rotation_imu_to_body


def ideal_interval_means(
    trajectory: Trajectory,
    frame: MapFrame,
    times: Array,
    interval: float,
    mount: ImuMount | None = None,
    gravity_removed: bool = False,
) -> tuple[Array, Array]:
    """Return what `ideal_samples` does, each averaged over the ``interval`` (s) that ends at its time."""
    force = np.zeros((len(times), 3))
    rate = np.zeros((len(times), 3))
    for node, weight in zip(_MEAN_NODES, _MEAN_WEIGHTS, strict=True):
        instant = ideal_samples(trajectory, frame, times - 0.5 * interval * (1.0 - node), mount, gravity_removed)
        force += 0.5 * weight * instant[0]
        rate += 0.5 * weight * instant[1]
    return force, rate


def vibration(speed: Array, std: float, stream: np.random.Generator) -> Array:
    """Return what the road adds to a signal (n, 3): ``std`` (unit of the signal) at 10 m/s, like the root of the speed.

    ``speed`` (n,) in m/s at the samples. The body shakes about where it is: sample by sample the velocity, or the
    angle, jumps by a random amount and back, so that the sum of what is added never grows.
    """
    jump = stream.standard_normal((len(speed), 3)) * (std * np.sqrt(0.05 * speed))[:, None]
    return np.diff(jump, axis=0, prepend=np.zeros((1, 3)))


@dataclass(frozen=True)
class SensorErrors:
    """Error model of one three-axis sensor, in the unit of its signal (rad/s or m/s2).

    ``offset`` is added to the turn-on bias that is drawn with ``bias_std``.
    """

    noise_density: float
    bias_random_walk: float
    bias_std: float
    scale_std: float = 0.0
    quantum: float = 0.0
    offset: Vector = (0.0, 0.0, 0.0)

    def apply(self, ideal: Array, rate_hz: float, seed: np.random.SeedSequence) -> tuple[Array, Array]:
        """Return the measured signal and its true bias, both (n, 3), for the ``ideal`` one sampled at ``rate_hz``.

        Each kind of error has its own random stream, so that switching one off leaves the others as they are.
        """
        bias_stream, walk_stream, noise_stream, scale_stream = generators(seed, 4)
        bias = walk_stream.standard_normal(ideal.shape)
        bias *= self.bias_random_walk / math.sqrt(rate_hz)
        bias[0] = bias_stream.standard_normal(3) * self.bias_std + np.array(self.offset)
        np.cumsum(bias, axis=0, out=bias)
        measured = noise_stream.standard_normal(ideal.shape)
        measured *= self.noise_density * math.sqrt(rate_hz)
        measured += bias
        measured += ideal * (1.0 + self.scale_std * scale_stream.standard_normal(3)) if self.scale_std else ideal
        if self.quantum:
            measured = np.round(measured / self.quantum) * self.quantum
        return measured, bias
