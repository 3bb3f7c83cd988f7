"""How a scenario is recorded, and the recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.simulate.barometer import Barometer, BarometerMeasurements
from eskf_ros.simulate.body_velocity import BodyVelocity, BodyVelocityMeasurements
from eskf_ros.simulate.dual_antenna import DualAntenna, DualAntennaMeasurements
from eskf_ros.simulate.episodes import ClockSet, Episode, MagneticDisturbance, Outage, WheelSlip
from eskf_ros.simulate.gnss import GnssMeasurements, GnssReceiver
from eskf_ros.simulate.gnss_episodes import (
    BadFixes,
    ClaimedStd,
    CorrelatedErrors,
    GnssEpisode,
    Multipath,
    Overconfidence,
    RtkSolution,
    Spoofing,
    ZeroCovariance,
)
from eskf_ros.simulate.gnss_message_episodes import GNSS_MESSAGE_EPISODES, GnssMessageEpisode
from eskf_ros.simulate.imu import grade_parameters
from eskf_ros.simulate.imu_episodes import IMU_EPISODES
from eskf_ros.simulate.magnetometer import Magnetometer, MagnetometerMeasurements
from eskf_ros.simulate.motion import Vector
from eskf_ros.simulate.range_episodes import RANGE_EPISODES
from eskf_ros.simulate.range_receiver import RangeMeasurements, RangeReceiver
from eskf_ros.simulate.sampling import Interval, Stamps, check_rate
from eskf_ros.simulate.wheel import WheelMeasurements, WheelOdometer

Array = NDArray[np.float64]

AIDS = {
    "second_gnss": GnssReceiver,
    "dual_antenna": DualAntenna,
    "wheel": WheelOdometer,
    "magnetometer": Magnetometer,
    "barometer": Barometer,
    "body_velocity": BodyVelocity,
    "ranges": RangeReceiver,
}
"""The sensors there may be besides an IMU and a GNSS receiver, by their names in `Options` and in `Recording`."""

EPISODES = {
    "outage": Outage,
    "bad_fixes": BadFixes,
    "multipath": Multipath,
    "spoofing": Spoofing,
    "correlated_errors": CorrelatedErrors,
    "rtk_solution": RtkSolution,
    "overconfidence": Overconfidence,
    "claimed_std": ClaimedStd,
    "zero_covariance": ZeroCovariance,
    **GNSS_MESSAGE_EPISODES,
    **IMU_EPISODES,
    "clock_set": ClockSet,
    "wheel_slip": WheelSlip,
    "magnetic_disturbance": MagneticDisturbance,
    **RANGE_EPISODES,
}
"""The kinds of episodes as the command line names them."""


@dataclass(frozen=True)
class Options:
    """How a scenario is recorded.

    Rates in Hz; truth is given at every n-th IMU stamp, at most at ``truth_rate``. ``imu_position`` (m) and
    ``imu_rpy_deg``: pose of the IMU in base_link. ``imu_interval_mean``: see `eskf_ros.simulate.imu`. Scale factor
    errors (standard deviation, 1) and quanta (rad/s, m/s2) of the IMU are off by default. ``gyro_offset`` (rad/s) and
    ``accel_offset`` (m/s2), in IMU axes, are added to the biases, and with ``gravity_removed`` the specific force is
    given without gravity: faults the estimator is told nothing about. ``vibration``: what a road does to specific force
    (m/s2) and angular rate (rad/s) at 10 m/s, see `eskf_ros.simulate.imu.vibration`.

    ``lever_arm``, ``gnss_rate``, ``position_std``, ``velocity_std``, ``latency``: the first GNSS receiver, see
    `eskf_ros.simulate.gnss.GnssReceiver`. The sensors that are None are not there; ``ranges`` are those of the first
    receiver's antenna. ``outages``: intervals (first,
    last) in seconds from time zero without GNSS; None takes the scenario's. ``episodes``: what else goes wrong, see
    `eskf_ros.simulate.episodes`, `gnss_episodes`, `gnss_message_episodes`, `imu_episodes` and `range_episodes`.
    ``start`` and ``stop``: the part of the scenario that is recorded, in seconds from time zero; ``stop`` None is its
    end.
    """

    grade: str = "industrial"
    imu_rate: float = 200.0
    gnss_rate: float = 5.0
    truth_rate: float = 50.0
    lever_arm: Vector = (0.8, -0.2, 1.4)
    imu_position: Vector = (0.0, 0.0, 0.0)
    imu_rpy_deg: Vector = (0.0, 0.0, 0.0)
    imu_interval_mean: bool = False
    position_std: tuple[float, float] = (1.0, 1.5)
    velocity_std: tuple[float, float] = (0.08, 0.12)
    latency: Interval = (0.08, 0.2)
    outages: tuple[Interval, ...] | None = None
    start: float = 0.0
    stop: float | None = None
    gyro_scale_std: float = 0.0
    accel_scale_std: float = 0.0
    gyro_quantum: float = 0.0
    accel_quantum: float = 0.0
    gyro_offset: Vector = (0.0, 0.0, 0.0)
    accel_offset: Vector = (0.0, 0.0, 0.0)
    gravity_removed: bool = False
    vibration: tuple[float, float] = (0.0, 0.0)
    second_gnss: GnssReceiver | None = None
    dual_antenna: DualAntenna | None = None
    wheel: WheelOdometer | None = None
    magnetometer: Magnetometer | None = None
    barometer: Barometer | None = None
    body_velocity: BodyVelocity | None = None
    ranges: RangeReceiver | None = None
    episodes: tuple[Episode, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError for options that fit no recording."""
        grade_parameters(self.grade)
        for name in ("imu_rate", "gnss_rate", "truth_rate"):
            check_rate(name, getattr(self, name))
        for episode in self.episodes:
            if isinstance(episode, (Outage, GnssEpisode, GnssMessageEpisode)) and episode.receiver not in (0, 1, 2):
                raise ValueError(f"{episode}: the receiver must be 1, 2 or, for both, 0")

    @property
    def first_gnss(self) -> GnssReceiver:
        """The receiver of ``gps/fix`` and ``gps/vel``."""
        return GnssReceiver(self.lever_arm, self.gnss_rate, self.position_std, self.velocity_std, self.latency)

    def of_ideal_imu_and_truth(self) -> Options:
        """Return the options that ideal IMU samples and truth depend on, all others at their defaults."""
        names = "imu_rate truth_rate imu_position imu_rpy_deg imu_interval_mean gravity_removed start stop"
        return Options(**{name: getattr(self, name) for name in names.split()})


@dataclass(frozen=True)
class Recording(GnssMeasurements):
    """What the sensors gave, when it arrived, and the truth.

    Stamps and arrivals (``*_arrival``: log time) are int64 ns; arrays of one sensor have one row per message. The
    fields of `GnssMeasurements` are of the first receiver; what the options ask for besides is in the fields named
    like these options, each with its ``sensor`` (where it is mounted), the true errors drawn for it, and None where
    there is no such sensor. The truth is of base_link: position and velocity in ``map`` (m, m/s), attitude as
    quaternion w x y z, ``truth_angular_rate_body`` relative to the Earth in base_link axes (rad/s). ``gyro_bias`` and
    ``accel_bias`` (one row per IMU sample, IMU axes) are the true biases, without episodes; ``imu_taken`` (int64 ns) is
    when each sample was taken: ``imu_stamp``, unless an episode changes that. ``datum``: latitude and longitude in
    degrees, ellipsoidal altitude in m. Recordings of one scenario share the arrays that do not depend on the seed: do
    not write to them.
    """

    name: str
    seed: int
    options: Options
    datum: Vector
    outages: tuple[Interval, ...]
    imu_stamp: Stamps
    imu_taken: Stamps
    imu_arrival: Stamps
    specific_force: Array
    angular_rate: Array
    accel_bias: Array
    gyro_bias: Array
    truth_stamp: Stamps
    truth_position_map: Array
    truth_velocity_map: Array
    truth_attitude_body_to_map: Array
    truth_angular_rate_body: Array
    frame: MapFrame = field(repr=False)
    second_gnss: GnssMeasurements | None = None
    dual_antenna: DualAntennaMeasurements | None = None
    wheel: WheelMeasurements | None = None
    magnetometer: MagnetometerMeasurements | None = None
    barometer: BarometerMeasurements | None = None
    body_velocity: BodyVelocityMeasurements | None = None
    ranges: RangeMeasurements | None = None

    def parameters(self) -> dict[str, Any]:
        """Return the estimator's parameters that describe the sensors of this recording, by dotted name."""
        described = (self.options.dual_antenna, self.options.barometer, self.options.magnetometer)
        return {
            **grade_parameters(self.options.grade),
            "imu.mount_position": list(self.options.imu_position),
            "imu.mount_rpy_deg": list(self.options.imu_rpy_deg),
            "gnss.lever_arm": list(self.options.lever_arm),
            "datum": list(self.datum),
            **{name: value for sensor in described if sensor for name, value in sensor.parameters().items()},
        }
