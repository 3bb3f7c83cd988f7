"""What the recordings of all drives are made of: measurements as ROS messages, the .mcap file, the parameter file."""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.bags import BagWriter, message_dtype
from eskf_ros.geodesy import earth
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.replay.main import main

Array = NDArray[np.float64]

IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
VELOCITY = "geometry_msgs/msg/TwistWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"
FRAMES = ("base_link", "imu_link", "gps", "odom", "earth")
BASE_FRAME, IMU_FRAME, GNSS_FRAME, ODOM_FRAME, EARTH_FRAME = range(len(FRAMES))
GNSS_LATENCY = 0.1
IMU_LATENCY = 0.002
STATUS_FIX, STATUS_GBAS = 0, 2
COVARIANCE_KNOWN = 3
ABSENT = -1.0
"""Variance of what is not measured."""

GPS_EPOCH = 315964800
"""1980-01-06 in seconds of Unix time."""
WEEK = 604800

Outages = Sequence[tuple[float, float]]
"""(start, length) in s from the first IMU stamp."""


@dataclass(frozen=True)
class Recording:
    """What `eskf_replay` needs: the bag, and the lines of its parameter file.

    `installation` says how the sensors are installed; `noise` was chosen on the drive.
    """

    bag: Path
    installation: str
    noise: str

    def config(self, lines: Sequence[str], chosen_noise: bool) -> Path:
        """Write a parameter file beside the bag, with `lines` (as in `gnss.use_velocity: false`) added."""
        text = self.installation + (self.noise if chosen_noise else "") + "".join(f"    {line}\n" for line in lines)
        path = self.bag.with_name(f"{self.bag.stem}.yaml")
        path.write_text(text, encoding="utf-8")
        return path


@dataclass(frozen=True)
class Messages:
    """One topic of a recording: when its messages arrived (n,) in s, and the messages."""

    topic: str
    type_name: str
    arrival: Array
    messages: NDArray[Any]


@dataclass(frozen=True)
class Fixes:
    """Positions of the antenna: time (n,) in s, geodetic (n, 3) in deg, deg, m, covariance (n, 3, 3) ENU in m2.

    Without `covariance` the messages say that it is unknown.
    """

    time: Array
    geodetic: Array
    covariance: Array | None
    status: NDArray[np.int8]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Fixes:
        covariance = None if self.covariance is None else self.covariance[chosen]
        return Fixes(self.time[chosen], self.geodetic[chosen], covariance, self.status[chosen])


def diagonal(std: Array) -> Array:
    """Covariances (n, 3, 3) of independent axes with standard deviations (n, 3)."""
    return np.asarray(std)[:, :, None] ** 2 * np.eye(3)


def gps_to_unix(week: int, seconds: Array, leap_seconds: int) -> Array:
    """Unix time (s) of GPS time of week."""
    return GPS_EPOCH + WEEK * week + seconds - leap_seconds


def read_rtklib(path: Path) -> tuple[Array, Array]:
    """GPS time (n,) in s since 1970 and the columns after it: lat lon height Q ns sdn sde sdu ... vn ve vu sdvn ..."""
    times, rows = [], []
    for line in path.read_text(encoding="ascii").splitlines():
        if line.startswith("%"):
            continue
        day, clock, *numbers = line.split()
        moment = datetime.datetime.strptime(f"{day} {clock}", "%Y/%m/%d %H:%M:%S.%f")
        times.append(moment.replace(tzinfo=datetime.timezone.utc).timestamp())
        rows.append([float(number) for number in numbers])
    return np.array(times), np.array(rows)


def ecef_to_geodetic_deg(position_ecef: Array) -> Array:
    """Latitude, longitude (deg), ellipsoidal altitude (m), (n, 3), of ECEF positions (n, 3)."""
    geodetic = np.array([earth.ecef_to_geodetic(x, y, z) for x, y, z in position_ecef.tolist()])
    geodetic[:, :2] = np.degrees(geodetic[:, :2])
    return geodetic


def differences(fixes: Fixes, reference: Fixes) -> Array:
    """East, north, up (n, 3) in m of fixes from the reference, interpolated."""
    place = MapFrame(tuple(reference.geodetic[0].tolist()))
    position, true = (
        np.array([place.from_geodetic_deg(*geodetic) for geodetic in part.geodetic.tolist()])
        for part in (fixes, reference)
    )
    return position - np.column_stack([np.interp(fixes.time, reference.time, axis) for axis in true.T])


def shifted(fixes: Fixes, shift: Array) -> Fixes:
    """Fixes moved by `shift` (3,), m east, north, up."""
    place = MapFrame(tuple(fixes.geodetic[0].tolist()))
    moved = [place.to_geodetic_deg(place.from_geodetic_deg(*geodetic) + shift) for geodetic in fixes.geodetic.tolist()]
    return Fixes(fixes.time, np.array(moved), fixes.covariance, fixes.status)


def imu(time: Array, specific_force: Array, angular_rate: Array) -> Messages:
    """`imu/data` of stamps (n,) in s, specific force (n, 3) in m/s2 and angular rate (n, 3) in rad/s in IMU axes."""
    messages = np.zeros(len(time), message_dtype(IMU))
    messages["stamp"] = nanoseconds(time)
    messages["frame_id"] = IMU_FRAME
    messages["orientation"][:, 3] = 1.0
    messages["orientation_covariance"][:, 0] = ABSENT
    messages["linear_acceleration"] = specific_force
    messages["angular_velocity"] = angular_rate
    return Messages("imu/data", IMU, time + IMU_LATENCY, messages)


def gnss_fix(fixes: Fixes, time_offset: float) -> Messages:
    """`gps/fix`; `time_offset` is that of the parameters: GNSS stamp + offset = IMU stamp."""
    return Messages("gps/fix", FIX, fixes.time + time_offset + GNSS_LATENCY, _fix_messages(fixes, 0.0))


def gnss_velocity(time: Array, velocity_enu: Array, std: Array | None, arrival: Array) -> Messages:
    """`gps/vel` of East-North-Up velocities (n, 3) in m/s, stamped `time` (n,), known at `arrival`.

    With standard deviations `std` (n, 3), or a covariance that is all zero.
    """
    messages = np.zeros(len(time), message_dtype(VELOCITY))
    messages["stamp"] = nanoseconds(time)
    messages["frame_id"] = GNSS_FRAME
    messages["linear_velocity"] = velocity_enu
    if std is not None:
        # The diagonal of the linear block; a receiver does not measure rotation.
        messages["twist_covariance"][:, [0, 7, 14]] = std**2
        messages["twist_covariance"][:, 21] = ABSENT
    return Messages("gps/vel", VELOCITY, arrival, messages)


def wheel(time: Array, speed: Array, speed_std: float, arrival: Array) -> Messages:
    """`wheel/odom` with the forward speed (n,) in m/s, stamped `time` (n,), and nothing else."""
    messages = np.zeros(len(time), message_dtype(ODOMETRY))
    messages["stamp"] = nanoseconds(time)
    messages["frame_id"], messages["child_frame_id"] = ODOM_FRAME, BASE_FRAME
    messages["orientation"][:, 3] = 1.0
    messages["pose_covariance"] = np.diag([ABSENT] * 6).ravel()
    messages["linear_velocity"][:, 0] = speed
    messages["twist_covariance"] = np.diag([speed_std**2, *[ABSENT] * 5]).ravel()
    return Messages("wheel/odom", ODOMETRY, arrival, messages)


def magnetic_field(time: Array, field: Array) -> Messages:
    """`imu/mag` of the field (n, 3) in tesla, base_link axes; its covariance is unknown."""
    messages = np.zeros(len(time), message_dtype(MAGNETIC_FIELD))
    messages["stamp"] = nanoseconds(time)
    messages["frame_id"] = BASE_FRAME
    messages["magnetic_field"] = field
    return Messages("imu/mag", MAGNETIC_FIELD, time + IMU_LATENCY, messages)


def pose_in_earth(topic: str, time: Array, position_ecef: Array, body_to_ecef: Array, speed: Array) -> Messages:
    """Odometry of base_link in ECEF: positions (n, 3), rotations (n, 3, 3), speeds (n,), stamps on the IMU's clock."""
    messages = np.zeros(len(time), message_dtype(ODOMETRY))
    messages["stamp"] = nanoseconds(time)
    messages["frame_id"], messages["child_frame_id"] = EARTH_FRAME, BASE_FRAME
    messages["position"] = position_ecef
    messages["orientation"] = Rotation.from_matrix(body_to_ecef).as_quat()
    messages["linear_velocity"][:, 0] = speed
    return Messages(topic, ODOMETRY, time, messages)


def truth_fix(fixes: Fixes, time_offset: float, topic: str = "truth") -> Messages:
    """`truth`: positions of the antenna, their stamps moved to the clock of the IMU."""
    return Messages(topic, FIX, fixes.time + time_offset, _fix_messages(fixes, time_offset))


def _fix_messages(fixes: Fixes, added_time: float) -> NDArray[Any]:
    messages = np.zeros(len(fixes.time), message_dtype(FIX))
    messages["stamp"] = nanoseconds(fixes.time + added_time)
    messages["frame_id"] = GNSS_FRAME
    messages["status"] = fixes.status
    messages["service"] = 1
    messages["latitude"], messages["longitude"], messages["altitude"] = fixes.geodetic.T
    if fixes.covariance is not None:
        messages["position_covariance"] = fixes.covariance.reshape(-1, 9)
        messages["position_covariance_type"] = COVARIANCE_KNOWN
    return messages


def write_bag(bag: Path, *topics: Messages) -> None:
    """Write a recording."""
    bag.parent.mkdir(parents=True, exist_ok=True)
    with BagWriter(bag) as writer:
        for part in topics:
            number = writer.add_topic(f"/{part.topic}", part.type_name)
            writer.write(number, nanoseconds(part.arrival), part.messages, FRAMES)


def nanoseconds(seconds: Array) -> NDArray[np.int64]:
    """Seconds as stamps."""
    return np.round(seconds * 1e9).astype(np.int64)


def replayed(
    recording: Recording, *lines: str, outages: Outages = (), chosen_noise: bool = True, truth: str = "truth"
) -> dict[str, Any]:
    """summary.json of `eskf_replay` with the parameters of the recording and `lines`; results beside the bag.

    Raises RuntimeError when the command fails.
    """
    options = [f"--outage={start:g}:{length:g}" for start, length in outages]
    if truth:
        options.append(f"--truth={truth}")
    code = main([str(recording.bag), f"--config={recording.config(lines, chosen_noise)}", "--quiet", *options])
    if code != 0:
        raise RuntimeError(f"eskf_replay {recording.bag} ended with {code}")
    return json.loads((results_folder(recording.bag) / "summary.json").read_text())  # type: ignore[no-any-return]


def results_folder(bag: Path) -> Path:
    """Where `eskf_replay` puts the results of `bag`."""
    return bag.parent / f"{bag.stem}_eskf"
