"""Drives of a generator that is not ours, as recordings: so that a proof does not share our simulator's assumptions.

A file holds one drive as numpy arrays (`nmayorov/pyins`): ``imu_t`` s, ``gyro`` rad/s, ``accel`` m/s2 (forward, left,
up), ``fix_t``, ``fix_lla`` deg deg m and ``fix_velocity_enu`` of the antenna, their standard deviations, ``lever_arm``
m, and the truth of the IMU. Another seed is another part of a drive, or another drive.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from campaign.fault import Fault
from eskf_ros.geodesy.map_frame import MapFrame, to_geodetic
from eskf_ros.simulate.episodes import Episode, received
from eskf_ros.simulate.gnss import GnssMeasurements
from eskf_ros.simulate.gnss_episodes import GnssEpisode, GnssReport
from eskf_ros.simulate.gnss_message_episodes import changed_messages
from eskf_ros.simulate.imu import GRADES, vibration
from eskf_ros.simulate.imu_episodes import ImuSamples, change_samples
from eskf_ros.simulate.recording import Options, Recording
from eskf_ros.simulate.sampling import START_STAMP, Stamps, arrivals, generators, nanoseconds

Array = NDArray[np.float64]

FOLDER = "independent_drives"
"""Of the real recordings and of these."""

FILES = {"drive": ("car_2", "car_3"), "stand": ("parked",), "straight": ("motorway",)}
"""Files by the scenario, or its family, that they stand in for."""

PARTS_APART = 40.0
"""s between the beginnings of two parts of a drive."""

NOISE = ("gyro_noise_density", "accel_noise_density", "gyro_bias_random_walk", "accel_bias_random_walk")


@dataclass(frozen=True)
class IndependentRecording(Recording):
    """A recording that states the noise of its own IMU."""

    noise: dict[str, float] = field(default_factory=dict)

    def parameters(self) -> dict[str, Any]:
        """Return the parameters that describe its sensors; the turn-on biases are those of the defaults."""
        mounting = {name: value for name, value in super().parameters().items() if name not in GRADES["consumer"]}
        return {**mounting, **self.noise}


def has_drive(fault: Fault) -> bool:
    """Whether there is a drive for a fault: its motion, sensors and rates are in the files."""
    return fault.scenario.partition(":")[0] in FILES and not set(fault.options) - {"vibration"}


@lru_cache(maxsize=2)
def _drive(folder: Path, name: str) -> dict[str, Array]:
    with np.load(folder / f"{name}.npz") as found:
        return {key: np.asarray(found[key], np.float64) for key in found.files}


def _geodetic_to_map(frame: MapFrame, lla: Array) -> Array:
    return np.array([frame.from_geodetic_deg(*place) for place in lla.tolist()])


def recording_from(folder: Path, fault: Fault, seed: int) -> IndependentRecording:
    """Return the part of a drive that ``seed`` means, with the episodes of a fault."""
    names = FILES[fault.scenario.partition(":")[0]]
    drive = _drive(folder, names[seed % len(names)])
    length = min(fault.stop, float(drive["imu_t"][-1]))
    begin = min(PARTS_APART * (seed // len(names)), float(drive["imu_t"][-1]) - length)
    streams = generators(np.random.SeedSequence([seed, 1]), len(fault.episodes) + 6)

    def part(times: Array) -> slice:
        return slice(*np.searchsorted(times, (begin, begin + length)).tolist())

    truth, imu, fix = (part(drive[f"{name}_t"]) for name in ("truth", "imu", "fix"))
    frame = MapFrame(tuple(drive["truth_lla"][truth][0].tolist()))
    attitude = _attitude(drive, truth)
    position = _geodetic_to_map(frame, drive["truth_lla"][truth])
    truth_stamp = START_STAMP + nanoseconds(drive["truth_t"][truth] - begin)
    velocity = np.gradient(position, drive["truth_t"][truth], axis=0)
    antenna = position + attitude.apply(drive["lever_arm"])
    imu_stamp = START_STAMP + nanoseconds(drive["imu_t"][imu] - begin)
    force, rate = drive["accel"][imu].copy(), drive["gyro"][imu].copy()
    if "vibration" in fault.options:
        speed = np.interp(imu_stamp, truth_stamp, np.linalg.norm(velocity, axis=1))
        force += vibration(speed, fault.options["vibration"][0], streams[-1])
        rate += vibration(speed, fault.options["vibration"][1], streams[-2])
    samples = ImuSamples.of(drive["imu_t"][imu] - begin, imu_stamp, force, rate)
    for episode, stream in zip(fault.episodes, streams):
        change_samples(samples, episode, stream)
    elapsed = drive["fix_t"][fix] - begin
    true_antenna = np.column_stack([np.interp(elapsed, drive["truth_t"][truth] - begin, axis) for axis in antenna.T])
    said = _said(drive, fix, elapsed, true_antenna, frame, fault.episodes, streams)
    options = Options(
        lever_arm=tuple(drive["lever_arm"].tolist()),
        imu_rate=round(1.0 / float(np.median(np.diff(drive["imu_t"])))),
        gnss_rate=round(1.0 / float(np.median(np.diff(drive["fix_t"])))),
    )
    no_bias = np.zeros((np.count_nonzero(samples.kept), 3))
    return IndependentRecording(
        **vars(said),
        name=fault.scenario,
        seed=seed,
        options=options,
        datum=frame.datum,
        outages=(),
        imu_stamp=samples.stamp[samples.kept],
        imu_taken=imu_stamp[samples.kept],
        imu_arrival=arrivals(imu_stamp, (0.0005, 0.0015), streams[-3])[samples.kept],
        specific_force=force[samples.kept],
        angular_rate=rate[samples.kept],
        accel_bias=no_bias,
        gyro_bias=no_bias,
        truth_stamp=truth_stamp,
        truth_position_map=position,
        truth_velocity_map=velocity,
        truth_attitude_body_to_map=attitude.as_quat()[:, [3, 0, 1, 2]],
        truth_angular_rate_body=np.gradient(np.unwrap(attitude.as_euler("xyz"), axis=0), 0.1, axis=0),
        frame=frame,
        noise={f"imu.{name}": float(drive[name].flat[0]) for name in NOISE},
    )


def _attitude(drive: dict[str, Array], part: slice) -> Rotation:
    """Attitude, body (forward, left, up) to east, north, up; pitch is positive nose up in the files."""
    heading = drive["truth_heading_deg"][part]
    roll, pitch = (
        drive.get(f"truth_{name}_deg", np.zeros_like(drive["truth_heading_deg"]))[part] for name in ("roll", "pitch")
    )
    return Rotation.from_euler("ZYX", np.column_stack([90.0 - heading, -pitch, roll]), degrees=True)


def _said(
    drive: dict[str, Array],
    part: slice,
    elapsed: Array,
    true_antenna: Array,
    frame: MapFrame,
    episodes: tuple[Episode, ...],
    streams: list[np.random.Generator],
) -> GnssMeasurements:
    """What the receiver says: the errors of the file, as large as the episodes make them, and what they add."""
    stds: list[Any] = [drive["fix_std_enu"], drive["velocity_std_enu"]]
    report = GnssReport.faultless(elapsed, (stds[0][0], stds[0][2]), (stds[1][0], stds[1][2]))
    for episode, stream in zip(episodes, streams):
        if isinstance(episode, GnssEpisode):
            episode.apply(report, stream)
    error = _geodetic_to_map(frame, drive["fix_lla"][part]) - true_antenna
    fixes = true_antenna + error * report.position_std / stds[0] + report.position_offset
    geodetic = to_geodetic(frame.to_ecef(fixes))
    kept = received(episodes, (1,), elapsed)
    stamp: Stamps = (START_STAMP + nanoseconds(elapsed))[kept]
    arrival = arrivals(stamp, (0.08, 0.2), streams[-4])

    def diagonal(reported: Array) -> Array:
        covariance = np.zeros((len(stamp), 9))
        covariance[:, ::4] = reported[kept] ** 2
        return covariance

    said = GnssMeasurements(
        fix_stamp=stamp,
        fix_arrival=arrival,
        fix_latitude_deg=np.degrees(geodetic[kept, 0]),
        fix_longitude_deg=np.degrees(geodetic[kept, 1]),
        fix_altitude=geodetic[kept, 2],
        fix_status=report.status[kept],
        fix_covariance=diagonal(report.reported_position_std),
        fix_covariance_type=report.covariance_type[kept],
        velocity_stamp=stamp,
        velocity_arrival=arrival + round(1e6),
        velocity_enu=(drive["fix_velocity_enu"][part] + report.velocity_offset)[kept],
        velocity_covariance=diagonal(report.reported_velocity_std),
    )
    for episode, stream in zip(episodes, streams):
        said = changed_messages(said, episode, stream)
    return said
