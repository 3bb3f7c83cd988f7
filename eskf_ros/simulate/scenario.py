"""Scenarios by name, and `simulate`, which turns one into a recording with truth.

What does not depend on the seed is computed once per process and kept, so that many seeds of one scenario are cheap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate import gnss
from eskf_ros.simulate.imu import ImuMount, SensorErrors, grade_parameters, ideal_interval_means, ideal_samples
from eskf_ros.simulate.map_frame import MapFrame
from eskf_ros.simulate.trajectory import DriveTrajectory, Hold, Instruction, SpeedTo, Turn

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

START_STAMP = 1_748_764_800_000_000_000
"""Time zero of every scenario: 2025-06-01T08:00:00Z in ns since 1970."""

GNSS_PHASE = 0.0137
"""Seconds from time zero to the first GNSS epoch, so that epochs fall between IMU samples, as they do on a robot."""

DATUM = (48.137, 11.575, 565.0)

IMU_LATENCY = (0.0005, 0.0015)
VELOCITY_AFTER_POSITION = (0.0002, 0.002)
"""Seconds, uniformly distributed: from stamp to arrival of an IMU sample; from a position to its velocity."""

_BLOCK = 65536


@dataclass(frozen=True)
class Scenario:
    """A drive and where it has no GNSS.

    ``outages`` are intervals (first, last) in seconds from time zero; no GNSS message has a stamp within one.
    """

    description: str
    instructions: tuple[Instruction, ...]
    heading_deg: float
    outages: tuple[tuple[float, float], ...] = ()


_CITY_LAP: tuple[Instruction, ...] = (
    SpeedTo(13.5),
    Hold(12.0),
    SpeedTo(6.0),
    Turn(90.0, 2.5),
    SpeedTo(10.0, 1.5),
    Turn(25.0),
    Turn(-25.0),
    Hold(6.0),
    SpeedTo(0.0, 2.5),
    Hold(8.0),
    SpeedTo(6.0),
    Turn(90.0, 2.5),
    SpeedTo(14.0, 2.5),
    Hold(10.0),
    Turn(-15.0),
    Turn(15.0),
    SpeedTo(5.0),
    Turn(90.0, 2.0),
    SpeedTo(11.0),
    Hold(8.0),
    SpeedTo(5.5),
    Turn(90.0, 2.5),
    SpeedTo(0.0, 1.5),
    Hold(5.0),
)

SCENARIOS: dict[str, Scenario] = {
    "drive": Scenario(
        "five minutes in a city: two laps around blocks, with turns and stops",
        (Hold(20.0), *_CITY_LAP, *_CITY_LAP, Hold(5.0)),
        heading_deg=35.0,
    ),
    "tunnel_drive": Scenario(
        "stand still 20 s, drive with turns and stops, a tunnel of 45 s at speed, and on",
        (
            Hold(20.0),
            SpeedTo(8.0),
            Turn(80.0, 2.5),
            SpeedTo(13.0),
            Hold(6.0),
            Turn(-60.0, 2.5),
            SpeedTo(0.0, 2.5),
            Hold(6.0),
            SpeedTo(7.0, 2.5),
            Turn(-95.0, 2.5),
            SpeedTo(12.0),
            Turn(30.0),
            Turn(-30.0),
            SpeedTo(0.0),
            Hold(4.0),
            SpeedTo(7.0),
            Turn(90.0, 2.5),
            SpeedTo(17.0),
            Hold(8.0),
            # The tunnel begins about here and bends to the left.
            Hold(15.0),
            Turn(35.0, 1.0),
            SpeedTo(15.0, 0.8),
            Hold(13.0),
            Turn(-20.0, 1.0),
            Hold(12.0),
            SpeedTo(7.0),
            Turn(90.0, 2.5),
            SpeedTo(11.0),
            Hold(8.0),
            Turn(-40.0),
            SpeedTo(0.0),
            Hold(8.0),
        ),
        heading_deg=-20.0,
        outages=((125.0, 170.0),),
    ),
    "hour_drive": Scenario(
        "one hour of city laps, for measuring speed",
        (Hold(20.0), *(_CITY_LAP * 27), Hold(47.5)),
        heading_deg=35.0,
    ),
}


@dataclass(frozen=True)
class Options:
    """How a scenario is recorded.

    Rates in Hz; truth is given at every n-th IMU stamp, at most at ``truth_rate``. ``lever_arm`` (m): the antenna in
    base_link. ``imu_position`` (m) and ``imu_rpy_deg``: pose of the IMU in base_link. ``imu_interval_mean``: see
    `eskf_ros.simulate.imu`. Standard deviations are (horizontal, vertical) in m and m/s. ``latency``: shortest and
    longest seconds from a GNSS epoch to its arrival. ``outages``: intervals in seconds from time zero without GNSS;
    None takes the scenario's. ``start`` and ``stop``: the part of the scenario that is recorded, in seconds from time
    zero; ``stop`` None is its end. Scale factor errors (standard deviation, 1) and quanta (rad/s, m/s2) are off by
    default.
    """

    grade: str = "industrial"
    imu_rate: float = 200.0
    gnss_rate: float = 5.0
    truth_rate: float = 50.0
    lever_arm: tuple[float, float, float] = (0.8, -0.2, 1.4)
    imu_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    imu_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    imu_interval_mean: bool = False
    position_std: tuple[float, float] = (1.0, 1.5)
    velocity_std: tuple[float, float] = (0.08, 0.12)
    latency: tuple[float, float] = (0.08, 0.2)
    outages: tuple[tuple[float, float], ...] | None = None
    start: float = 0.0
    stop: float | None = None
    gyro_scale_std: float = 0.0
    accel_scale_std: float = 0.0
    gyro_quantum: float = 0.0
    accel_quantum: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError for options that fit no recording."""
        grade_parameters(self.grade)
        for name in ("imu_rate", "gnss_rate", "truth_rate"):
            value = getattr(self, name)
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"{name} must be a positive number of Hz, not {value}")


@dataclass(frozen=True)
class Recording:
    """What the sensors gave, when it arrived, and the truth.

    Stamps and arrivals (``*_arrival``: log time) are int64 ns; arrays of one sensor have one row per message.
    Covariances are row-major (n, 9), in m2 and m2/s2; GNSS velocity and both covariances are in east, north, up at the
    antenna. The truth is of base_link: position and velocity in ``map`` (m, m/s), attitude as quaternion w x y z,
    ``truth_angular_rate_body`` relative to the Earth in base_link axes (rad/s). ``gyro_bias`` and ``accel_bias`` (one
    row per IMU sample, IMU axes) are the true biases. ``datum``: latitude and longitude in degrees, ellipsoidal
    altitude in m. Recordings of one scenario share the arrays that do not depend on the seed: do not write to them.
    """

    name: str
    seed: int
    options: Options
    datum: tuple[float, float, float]
    outages: tuple[tuple[float, float], ...]
    imu_stamp: Stamps
    imu_arrival: Stamps
    specific_force: Array
    angular_rate: Array
    accel_bias: Array
    gyro_bias: Array
    fix_stamp: Stamps
    fix_arrival: Stamps
    fix_latitude_deg: Array
    fix_longitude_deg: Array
    fix_altitude: Array
    fix_covariance: Array
    velocity_stamp: Stamps
    velocity_arrival: Stamps
    velocity_enu: Array
    velocity_covariance: Array
    truth_stamp: Stamps
    truth_position_map: Array
    truth_velocity_map: Array
    truth_attitude_body_to_map: Array
    truth_angular_rate_body: Array
    frame: MapFrame = field(repr=False)

    def parameters(self) -> dict[str, Any]:
        """Return the estimator's parameters that describe the sensors of this recording, by dotted name."""
        return {
            **grade_parameters(self.options.grade),
            "imu.mount_position": list(self.options.imu_position),
            "imu.mount_rpy_deg": list(self.options.imu_rpy_deg),
            "gnss.lever_arm": list(self.options.lever_arm),
            "datum": list(self.datum),
        }


@dataclass(frozen=True)
class _NoiseFree:
    """What all seeds of one scenario and one set of options share."""

    imu_stamp: Stamps
    specific_force: Array
    angular_rate: Array
    epoch_stamp: Stamps
    epochs: gnss.IdealEpochs
    truth_stamp: Stamps
    truth_position_map: Array
    truth_velocity_map: Array
    truth_attitude_body_to_map: Array
    truth_angular_rate_body: Array


def scenario(name: str) -> Scenario:
    """Return the scenario ``name``; ValueError names those there are."""
    if name not in SCENARIOS:
        raise ValueError(f"unknown scenario '{name}'; there are {', '.join(SCENARIOS)}")
    return SCENARIOS[name]


@lru_cache(maxsize=4)
def trajectory(name: str) -> DriveTrajectory:
    """Return the motion of scenario ``name``; ValueError names those there are."""
    found = scenario(name)
    return DriveTrajectory(found.instructions, found.heading_deg)


def simulate(name: str, seed: int = 0, **options: Any) -> Recording:
    """Return a recording of scenario ``name``, the same for the same ``seed`` and `Options`, which are keywords.

    Raises ValueError for an unknown scenario or grade and for options out of range, TypeError for an unknown option.
    """
    chosen = Options(**options)
    outages = scenario(name).outages if chosen.outages is None else chosen.outages
    ideal = _noise_free(name, chosen)
    # One stream per sensor, by its number: a new sensor leaves the others' numbers as they were.
    gyro_seed, accel_seed, gnss_seed, arrival_seed = (
        np.random.SeedSequence(entropy=seed, spawn_key=(sensor,)) for sensor in range(4)
    )
    noise = grade_parameters(chosen.grade)
    gyro = SensorErrors(
        noise["imu.gyro_noise_density"],
        noise["imu.gyro_bias_random_walk"],
        noise["imu.gyro_bias_std"],
        chosen.gyro_scale_std,
        chosen.gyro_quantum,
    )
    accelerometer = SensorErrors(
        noise["imu.accel_noise_density"],
        noise["imu.accel_bias_random_walk"],
        noise["imu.accel_bias_std"],
        chosen.accel_scale_std,
        chosen.accel_quantum,
    )
    angular_rate, gyro_bias = gyro.apply(ideal.angular_rate, chosen.imu_rate, gyro_seed)
    specific_force, accel_bias = accelerometer.apply(ideal.specific_force, chosen.imu_rate, accel_seed)
    measured = gnss.measure(ideal.epochs, chosen.position_std, chosen.velocity_std, gnss_seed)

    imu_stream, fix_stream, velocity_stream = (np.random.Generator(np.random.PCG64(s)) for s in arrival_seed.spawn(3))
    imu_arrival = _arrivals(ideal.imu_stamp, IMU_LATENCY, imu_stream)
    fix_arrival = _arrivals(ideal.epoch_stamp, chosen.latency, fix_stream)
    velocity_arrival = _arrivals(fix_arrival, VELOCITY_AFTER_POSITION, velocity_stream)

    # Outages only remove messages, so that what lies outside of them does not depend on them.
    elapsed = (ideal.epoch_stamp - START_STAMP) * 1e-9
    kept = np.ones(len(elapsed), dtype=bool)
    for first, last in outages:
        kept &= (elapsed < first) | (elapsed > last)
    count = int(kept.sum())
    geodetic = measured.geodetic[kept]
    return Recording(
        name=name,
        seed=seed,
        options=chosen,
        datum=DATUM,
        outages=outages,
        imu_stamp=ideal.imu_stamp,
        imu_arrival=imu_arrival,
        specific_force=specific_force,
        angular_rate=angular_rate,
        accel_bias=accel_bias,
        gyro_bias=gyro_bias,
        fix_stamp=ideal.epoch_stamp[kept],
        fix_arrival=fix_arrival[kept],
        fix_latitude_deg=geodetic[:, 0].copy(),
        fix_longitude_deg=geodetic[:, 1].copy(),
        fix_altitude=geodetic[:, 2].copy(),
        fix_covariance=np.tile(np.diag(gnss.axis_stds(chosen.position_std) ** 2).ravel(), (count, 1)),
        velocity_stamp=ideal.epoch_stamp[kept],
        velocity_arrival=velocity_arrival[kept],
        velocity_enu=measured.velocity_enu[kept],
        velocity_covariance=np.tile(np.diag(gnss.axis_stds(chosen.velocity_std) ** 2).ravel(), (count, 1)),
        truth_stamp=ideal.truth_stamp,
        truth_position_map=ideal.truth_position_map,
        truth_velocity_map=ideal.truth_velocity_map,
        truth_attitude_body_to_map=ideal.truth_attitude_body_to_map,
        truth_angular_rate_body=ideal.truth_angular_rate_body,
        frame=MapFrame(DATUM),
    )


@lru_cache(maxsize=4)
def _noise_free(name: str, options: Options) -> _NoiseFree:
    path = trajectory(name)
    frame = MapFrame(DATUM)
    stop = path.duration if options.stop is None else options.stop
    if not 0.0 <= options.start < stop <= path.duration:
        raise ValueError(
            f"start {options.start:g} and stop {stop:g} must lie in order within 0 to {path.duration:.1f} s"
        )

    def elapsed(offsets: Stamps) -> Array:
        # Rounding to whole nanoseconds must not lead beyond the end.
        return np.minimum(offsets * 1e-9, path.duration)

    mount = ImuMount(options.imu_position, options.imu_rpy_deg)
    interval = 1.0 / options.imu_rate
    # The first sample is one interval after the start, so that an interval mean has its whole interval.
    samples = np.arange(1, int((stop - options.start) * options.imu_rate + 1e-6) + 1)
    offsets = _nanoseconds(options.start + samples * interval)
    force = np.empty((len(offsets), 3))
    rate = np.empty((len(offsets), 3))
    for begin in range(0, len(offsets), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        times = elapsed(offsets[block])
        if options.imu_interval_mean:
            force[block], rate[block] = ideal_interval_means(path, frame, times, interval, mount)
        else:
            force[block], rate[block] = ideal_samples(path, frame, times, mount)

    first_epoch = int(np.ceil((options.start - GNSS_PHASE) * options.gnss_rate))
    epochs = np.arange(max(first_epoch, 0), int((stop - GNSS_PHASE) * options.gnss_rate) + 1)
    epoch_offsets = _nanoseconds(GNSS_PHASE + epochs / options.gnss_rate)
    step = math.ceil(options.imu_rate / options.truth_rate - 1e-9)
    truth_offsets = offsets[step - 1 :: step]
    truth = path.motion(elapsed(truth_offsets))
    return _NoiseFree(
        imu_stamp=START_STAMP + offsets,
        specific_force=force,
        angular_rate=rate,
        epoch_stamp=START_STAMP + epoch_offsets,
        epochs=gnss.ideal_epochs(path, frame, elapsed(epoch_offsets), options.lever_arm),
        truth_stamp=START_STAMP + truth_offsets,
        truth_position_map=truth.position_map,
        truth_velocity_map=truth.velocity_map,
        truth_attitude_body_to_map=truth.attitude_body_to_map,
        truth_angular_rate_body=truth.angular_rate_body,
    )


def _nanoseconds(seconds: NDArray[np.floating[Any]]) -> Stamps:
    return np.round(seconds * 1e9).astype(np.int64)


def _arrivals(stamps: Stamps, delay: tuple[float, float], stream: np.random.Generator) -> Stamps:
    """Return stamps plus delays, uniform between the two (s), in order: what is held up holds up what comes after."""
    delays = _nanoseconds(stream.uniform(delay[0], delay[1], len(stamps)))
    return np.maximum.accumulate(stamps + delays)
