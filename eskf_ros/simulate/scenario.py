"""`simulate` turns a scenario into a recording with truth.

What does not depend on the seed is computed once per process and kept, so that many seeds of one scenario are cheap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.simulate.episodes import Outage, outages_of
from eskf_ros.simulate.gnss import GnssStreams
from eskf_ros.simulate.imu import (
    ImuMount,
    SensorErrors,
    grade_parameters,
    ideal_interval_means,
    ideal_samples,
    vibration,
)
from eskf_ros.simulate.imu_episodes import IMU_CHANGES, ImuSamples, change_samples
from eskf_ros.simulate.recording import AIDS, Options, Recording
from eskf_ros.simulate.sampling import (
    START_STAMP,
    RandomStream,
    Section,
    Stamps,
    arrivals,
    generators,
    nanoseconds,
    seed_of,
)
from eskf_ros.simulate.scenarios import SCENARIOS, Scenario, scenario, trajectory

__all__ = [
    "DATUM",
    "SCENARIOS",
    "START_STAMP",
    "Options",
    "Recording",
    "Scenario",
    "scenario",
    "simulate",
    "trajectory",
]

Array = NDArray[np.float64]

DATUM = (48.137, 11.575, 565.0)

IMU_LATENCY = (0.0005, 0.0015)
"""Seconds from stamp to arrival of an IMU sample, uniformly distributed."""

_BLOCK = 65536


def simulate(name: str, seed: int = 0, **options: Any) -> Recording:
    """Return a recording of scenario ``name``, the same for the same ``seed`` and `Options`, which are keywords.

    Raises ValueError for an unknown scenario or grade and for options out of range, TypeError for an unknown option.
    """
    chosen = Options(**options)
    tunnels = scenario(name).outages if chosen.outages is None else chosen.outages
    episodes = (*(Outage(first, last - first) for first, last in tunnels), *chosen.episodes)
    section = _section(name, chosen.start, chosen.stop)
    ideal = _ideal(name, chosen.of_ideal_imu_and_truth())
    gyro, accelerometer = _imu_errors(chosen)
    angular_rate, gyro_bias = gyro.apply(ideal.angular_rate, chosen.imu_rate, seed_of(seed, RandomStream.GYRO))
    specific_force, accel_bias = accelerometer.apply(
        ideal.specific_force, chosen.imu_rate, seed_of(seed, RandomStream.ACCELEROMETER)
    )
    if any(chosen.vibration):
        speed = np.interp(ideal.imu_stamp, ideal.truth_stamp, np.linalg.norm(ideal.truth_velocity_map, axis=1))
        streams = generators(seed_of(seed, RandomStream.VIBRATION), 2)
        specific_force += vibration(speed, chosen.vibration[0], streams[0])
        angular_rate += vibration(speed, chosen.vibration[1], streams[1])
    imu_stamp = ideal.imu_stamp
    kept: slice | NDArray[np.bool_] = slice(None)
    if any(isinstance(episode, IMU_CHANGES) for episode in episodes):
        samples = ImuSamples.of(section.elapsed(imu_stamp), imu_stamp, specific_force, angular_rate)
        streams = generators(seed_of(seed, RandomStream.IMU_EPISODES), len(episodes))
        for episode, stream in zip(episodes, streams, strict=True):
            change_samples(samples, episode, stream)
        imu_stamp, kept = samples.stamp[samples.kept], samples.kept
    imu_delay, *gnss_delays = generators(seed_of(seed, RandomStream.ARRIVAL), 3)
    gnss_streams = GnssStreams(*generators(seed_of(seed, RandomStream.GNSS), 3), *gnss_delays)
    aids = {
        aid: sensor.measure(section, episodes, seed_of(seed, RandomStream[aid.upper()]))
        for aid in AIDS
        if aid != "ranges" and (sensor := getattr(chosen, aid))
    }
    if chosen.ranges:
        seeds = seed_of(seed, RandomStream.RANGES)
        aids["ranges"] = chosen.ranges.measure(section, chosen.lever_arm, episodes, seeds)
    return Recording(
        **vars(chosen.first_gnss.measure_as(1, section, episodes, gnss_streams)),
        **aids,
        name=name,
        seed=seed,
        options=chosen,
        datum=DATUM,
        outages=tuple((gap.start, gap.start + gap.length) for gap in outages_of(episodes, (1,))),
        imu_stamp=imu_stamp,
        imu_taken=ideal.imu_stamp[kept],
        imu_arrival=arrivals(ideal.imu_stamp, IMU_LATENCY, imu_delay)[kept],
        specific_force=specific_force[kept],
        angular_rate=angular_rate[kept],
        accel_bias=accel_bias[kept],
        gyro_bias=gyro_bias[kept],
        truth_stamp=ideal.truth_stamp,
        truth_position_map=ideal.truth_position_map,
        truth_velocity_map=ideal.truth_velocity_map,
        truth_attitude_body_to_map=ideal.truth_attitude_body_to_map,
        truth_angular_rate_body=ideal.truth_angular_rate_body,
        frame=section.frame,
    )


def _section(name: str, start: float, stop: float | None) -> Section:
    path = trajectory(name)
    return Section(path, MapFrame(DATUM), start, path.duration if stop is None else stop)


def _imu_errors(options: Options) -> tuple[SensorErrors, SensorErrors]:
    """Return the error models of gyro and accelerometer."""
    noise = grade_parameters(options.grade)
    gyro = SensorErrors(
        noise["imu.gyro_noise_density"],
        noise["imu.gyro_bias_random_walk"],
        noise["imu.gyro_bias_std"],
        options.gyro_scale_std,
        options.gyro_quantum,
        options.gyro_offset,
    )
    accelerometer = SensorErrors(
        noise["imu.accel_noise_density"],
        noise["imu.accel_bias_random_walk"],
        noise["imu.accel_bias_std"],
        options.accel_scale_std,
        options.accel_quantum,
        options.accel_offset,
    )
    return gyro, accelerometer


@dataclass(frozen=True)
class _Ideal:
    """What all seeds share: the IMU's samples without error, and the truth."""

    imu_stamp: Stamps
    specific_force: Array
    angular_rate: Array
    truth_stamp: Stamps
    truth_position_map: Array
    truth_velocity_map: Array
    truth_attitude_body_to_map: Array
    truth_angular_rate_body: Array


@lru_cache(maxsize=4)
def _ideal(name: str, options: Options) -> _Ideal:
    section = _section(name, options.start, options.stop)
    mount = ImuMount(options.imu_position, options.imu_rpy_deg)
    interval = 1.0 / options.imu_rate
    # The first sample is one interval after the start, so that an interval mean has its whole interval.
    samples = np.arange(1, int((section.stop - section.start) * options.imu_rate + 1e-6) + 1)
    imu_stamp = START_STAMP + nanoseconds(section.start + samples * interval)
    force = np.empty((len(imu_stamp), 3))
    rate = np.empty((len(imu_stamp), 3))
    for begin in range(0, len(imu_stamp), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        times = section.elapsed(imu_stamp[block])
        ideal = (section.path, section.frame, times)
        if options.imu_interval_mean:
            force[block], rate[block] = ideal_interval_means(*ideal, interval, mount, options.gravity_removed)
        else:
            force[block], rate[block] = ideal_samples(*ideal, mount, options.gravity_removed)
    step = math.ceil(options.imu_rate / options.truth_rate - 1e-9)
    truth_stamp = imu_stamp[step - 1 :: step]
    truth = section.motion(truth_stamp)
    return _Ideal(
        imu_stamp=imu_stamp,
        specific_force=force,
        angular_rate=rate,
        truth_stamp=truth_stamp,
        truth_position_map=truth.position_map,
        truth_velocity_map=truth.velocity_map,
        truth_attitude_body_to_map=truth.attitude_body_to_map,
        truth_angular_rate_body=truth.angular_rate_body,
    )
