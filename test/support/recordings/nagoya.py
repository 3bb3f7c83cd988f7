"""nagoya_20240720 (taroz/gtsam_gnss): a car in Nagoya, 4.39 km in 1140 s, the trajectory of an Applanix POS LV 220.

There is no IMU data. Its samples are simulated on the true trajectory: what an IMU of a grade would have measured on
this drive at 100 Hz. The fixes are real: the single-point solution (RTKLIB, five systems) of a mosaic-X5 on the car,
once a second, with the covariances of RTKLIB.

- The trajectory (5 Hz; position to 1 mm, attitude to 0.001 deg) becomes quintic splines of position and of roll, pitch,
  yaw. They are smooth between the epochs: the vibration of road and engine is not in them.
- base_link is the point whose position is given; the single-point solution knows no lever arm that matters beside its
  errors: 1.9 m horizontally (median), 14 m (95 %), 184 m at worst.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.signals import Gnss
from eskf_ros.simulate.episodes import Episode
from eskf_ros.simulate.imu import SensorErrors, grade_parameters, ideal_samples
from eskf_ros.simulate.motion import Motion, checked_times
from eskf_ros.simulate.range_episodes import StreetCanyon
from eskf_ros.simulate.range_receiver import RangeReceiver
from eskf_ros.simulate.sampling import START_STAMP, RandomStream, Section, seed_of
from support.recordings.common import (
    GNSS_LATENCY,
    STATUS_FIX,
    Array,
    Fixes,
    Messages,
    Recording,
    gnss_fix,
    gnss_velocity,
    gps_to_unix,
    imu,
    pose_in_earth,
    read_rtklib,
    write_bag,
)
from support.recordings.satellites import RangeEpochs, gnss_ephemerides, gnss_ranges, solved_fixes

WEEK = 2323
LEAP_SECONDS = 18
IMU_RATE = 100.0

RANGE_RATE = 5.0
LEVER_ARM = (0.4, -0.2, 1.3)
STREETS = (StreetCanyon(0.0, math.inf, height=12.0, width=25.0),)

INSTALLATION = """\
/**:
  ros__parameters:
"""
RANGES_INSTALLATION = f"{INSTALLATION}    gnss.lever_arm: {list(LEVER_ARM)}\n"


class RecordedTrajectory:
    """Splines through recorded poses: an `eskf_ros.simulate.motion.Trajectory`.

    ``times`` (n,) s from 0, ``position_map`` (n, 3) m, ``roll_pitch_yaw`` (n, 3) rad: fixed axes, body to map.
    """

    def __init__(self, times: Array, position_map: Array, roll_pitch_yaw: Array) -> None:
        self.breakpoints = times
        self._position = make_interp_spline(times, position_map, k=5)
        self._angles = make_interp_spline(times, np.unwrap(roll_pitch_yaw, axis=0), k=5)

    @property
    def duration(self) -> float:
        """Length in seconds."""
        return float(self.breakpoints[-1])

    def motion(self, times: ArrayLike) -> Motion:
        """The truth at ``times`` (n,) in seconds from the start; ValueError outside of the recording."""
        t = checked_times(times, self.duration)
        angles, rates, accelerations = self._angles(t), self._angles(t, 1), self._angles(t, 2)
        to_rates, to_rates_derivative = euler_rate_matrices(angles, rates)
        attitude = Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat()[:, [3, 0, 1, 2]]
        return Motion(
            position_map=self._position(t),
            velocity_map=self._position(t, 1),
            acceleration_map=self._position(t, 2),
            attitude_body_to_map=attitude,
            angular_rate_body=np.einsum("nij,nj->ni", to_rates, rates),
            angular_acceleration_body=np.einsum("nij,nj->ni", to_rates, accelerations)
            + np.einsum("nij,nj->ni", to_rates_derivative, rates),
        )


def euler_rate_matrices(angles: Array, rates: Array) -> tuple[Array, Array]:
    """Matrices (n, 3, 3) from rates of roll, pitch, yaw to the body rate, and their time derivatives.

    Groves, eq. 2.58; `angles` and `rates` (n, 3).
    """
    sr, cr, sp, cp = np.sin(angles[:, 0]), np.cos(angles[:, 0]), np.sin(angles[:, 1]), np.cos(angles[:, 1])
    p, q = rates[:, 0], rates[:, 1]
    zero, one = np.zeros_like(sr), np.ones_like(sr)
    matrices = [[one, zero, -sp], [zero, cr, sr * cp], [zero, -sr, cr * cp]]
    derivatives = [
        [zero, zero, -cp * q],
        [zero, -sr * p, cr * cp * p - sr * sp * q],
        [zero, -cr * p, -sr * cp * p - cr * sp * q],
    ]
    return np.moveaxis(np.array(matrices), -1, 0), np.moveaxis(np.array(derivatives), -1, 0)


def nagoya_recording(folder: Path, source: Path, grade: str = "consumer", seed: int = 1) -> Recording:
    """Write the drive (the folder `source`) to `folder`, with an IMU of `grade`, the real fixes, and truth at 5 Hz."""
    solution_time, solution = read_rtklib(source / "rover_1Hz_spp.pos")
    solution_time -= LEAP_SECONDS
    status = np.full(len(solution), STATUS_FIX, np.int8)
    fixes = Fixes(solution_time, solution[:, :3], enu_covariance(solution[:, 5:11]), status)
    velocity_std = np.sqrt(np.diagonal(enu_covariance(solution[:, 16:22]), axis1=1, axis2=2))
    bag = folder / f"nagoya_{grade}.mcap"
    write_bag(
        bag,
        *imu_and_truth(*read_drive(source), grade, seed),
        gnss_fix(fixes, 0.0),
        gnss_velocity(solution_time, solution[:, [14, 13, 15]], velocity_std, solution_time + GNSS_LATENCY),
    )
    return Recording(bag, INSTALLATION, noise_lines(grade))


def nagoya_ranges_recording(
    folder: Path,
    source: Path,
    grade: str = "consumer",
    seed: int = 1,
    episodes: Sequence[Episode] = STREETS,
) -> Recording:
    """Write the drive with simulated ranges to the real satellites of that day, and our own point solutions of them."""
    section, start = read_drive(source)
    late = START_STAMP * 1e-9 - start
    receiver = RangeReceiver(rate=RANGE_RATE, nav=str(source / "base.nav"), clock_offset=late)
    measured = receiver.measure(section, LEVER_ARM, episodes, seed_of(seed, RandomStream.RANGES))
    counts = range(len(measured.stamp))
    epochs = RangeEpochs(measured.stamp * 1e-9 - late, WEEK, measured.seconds, [measured.epoch(k) for k in counts])
    ephemerides = Ephemerides(np.array([broadcast.record() for broadcast in measured.broadcasts]))
    fixes, velocity_time, velocity, velocity_std = solved_fixes(epochs, ephemerides, measured.klobuchar[Gnss.GPS])
    bag = folder / f"nagoya_ranges_{grade}.mcap"
    write_bag(
        bag,
        *imu_and_truth(section, start, grade, seed),
        gnss_fix(fixes, 0.0),
        gnss_velocity(velocity_time, velocity, velocity_std, velocity_time + GNSS_LATENCY),
        gnss_ranges(epochs, measured.arrival * 1e-9 - late),
        gnss_ephemerides(start, measured.broadcasts, measured.klobuchar),
    )
    return Recording(bag, RANGES_INSTALLATION, noise_lines(grade))


def noise_lines(grade: str) -> str:
    """Lines of a parameter file that say how good the IMU is."""
    return "".join(f"    {name}: {value}\n" for name, value in grade_parameters(grade).items())


def imu_and_truth(section: Section, start: float, grade: str, seed: int) -> tuple[Messages, Messages]:
    """`imu/data` of an IMU of `grade`, and `truth`."""
    noise, trajectory, frame = grade_parameters(grade), section.path, section.frame
    times = np.arange(1, int(trajectory.duration * IMU_RATE) + 1) / IMU_RATE
    specific_force, angular_rate = ideal_samples(trajectory, frame, times)
    gyro, accelerometer = (
        SensorErrors(*(noise[f"imu.{sensor}_{name}"] for name in ("noise_density", "bias_random_walk", "bias_std")))
        for sensor in ("gyro", "accel")
    )
    angular_rate, _ = gyro.apply(angular_rate, IMU_RATE, seed_of(seed, RandomStream.GYRO))
    specific_force, _ = accelerometer.apply(specific_force, IMU_RATE, seed_of(seed, RandomStream.ACCELEROMETER))
    truth = trajectory.motion(trajectory.breakpoints)
    return imu(start + times, specific_force, angular_rate), pose_in_earth(
        "truth",
        start + trajectory.breakpoints,
        frame.to_ecef(truth.position_map),
        frame.rotation_map_to_ecef @ truth.rotation_body_to_map,
        np.linalg.norm(truth.velocity_map, axis=1),
    )


def enu_covariance(std: Array) -> Array:
    """East-North-Up covariances (n, 3, 3) of RTKLIB's roots of variances and covariances (signed): n e u ne eu un."""
    squares = np.sign(std) * std**2
    return squares[:, [1, 3, 4, 3, 0, 5, 4, 5, 2]].reshape(-1, 3, 3)


def read_drive(source: Path) -> tuple[Section, float]:
    """The whole drive, and the Unix time (s) of its start."""
    table = np.loadtxt(source / "reference.csv", delimiter=",", skiprows=1)
    frame = MapFrame((float(table[0, 2]), float(table[0, 3]), float(table[0, 4])))
    position_map = (table[:, 5:8] - frame.origin_ecef) @ frame.rotation_map_to_ecef
    # Heading is clockwise from north, pitch is positive nose up. The map is level within 0.02 deg all along the drive.
    roll, pitch, heading = np.radians(table[:, 8:11]).T
    angles = np.column_stack([roll, -pitch, 0.5 * np.pi - heading])
    trajectory = RecordedTrajectory(table[:, 0] - table[0, 0], position_map, angles)
    start = float(gps_to_unix(WEEK, table[0, 0], LEAP_SECONDS))
    return Section(trajectory, frame, 0.0, trajectory.duration), start
