"""Two real drives as the recordings a user would have made: an .mcap file, a parameter file, a truth topic.

The inputs hold only what the estimator may see. The topic `truth` holds the positions kept from it, stamped on the
clock of the IMU, as NavSatFix of the same antenna.

KITTI (from the PyPI package gtsam): a car in a town, 3.7 km in 470 s. Inertial unit of an OXTS RT3003 at 100 Hz and its
position once a second, in metres east, north and up of an unknown place; we put them near Karlsruhe. What the
data say (checked with the accelerations and the course over ground):

- IMU axes are forward, left, up, specific force +9.8 upwards; car and IMU agree within 0.5 deg; position refers to it.
- Eight times there is no IMU sample for 1.5 to 1.6 s; the file bridges the hole with rows on a straight line, which
  miss up to 12 deg of a turn. `measured_rows` finds these rows and they are left out. Nearly two seconds more are
  missing between the first row and the second.
- A sample describes the motion 0.065 s (+-0.01) before the position of the same stamp (a low pass before the output).
- Positions repeat within a few centimetres from second to second; how far off they are together does not show here.
- There is no velocity. The velocity messages are a stand-in for the Doppler of a receiver: once every ten seconds
  the difference of the positions one second before and after, good to 0.13 m/s against the estimate from all
  positions. These neighbours are no truth, with or without velocity.

drive_0708 (rtklibexplorer/GNSS_IMU): a car with a consumer IMU on the roof, 4.1 km in 549 s, RTK four times a second.

- IMU axes are backward, right, up. Over 4 m/s and straight ahead the velocity lies 5.1 deg to the left of -x and
  6.8 deg above it, which is how the author of the data mounts it (5.35 and 6.79 deg).
- The stamps in the file run 257 ppm fast: the counter of the sensor took 548.590 s for what is spread over
  548.731 s. Without the correction the offset to GNSS grows from 0.15 s to 0.26 s along the drive.
- Then IMU stamps are 0.13 s (+-0.01) later than those of the positions with the same motion, and the velocity of
  the receiver is 0.13 s (+-0.01) older than its position; vertically 0.2 s more, hence 0.1 m/s at least.
- Altitudes are above mean sea level. A constant of some metres changes nothing here.
- The running engine turns the pitch gyro by 2.3 deg/s (rms) at rest, folded in by sampling at 100 Hz; on the road it
  wanders by 1 to 3 deg of pitch in 15 s. The noise densities of the parameters are what the drive needs, not those
  of the data sheet. One g reads 9.93 m/s2.
"""

from __future__ import annotations

import calendar
import datetime
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import BagWriter, message_dtype
from eskf_ros.replay.main import main
from eskf_ros.simulate.map_frame import MapFrame, to_geodetic

Array = NDArray[np.float64]

IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
VELOCITY = "geometry_msgs/msg/TwistWithCovarianceStamped"
FRAMES = ("imu_link", "gps")
GNSS_LATENCY = 0.1
IMU_LATENCY = 0.002
STATUS_FIX, STATUS_GBAS = 0, 2
COVARIANCE_DIAGONAL_KNOWN = 2

KITTI_DATUM = (49.0, 8.43, 115.0)
KITTI_MIDNIGHT = calendar.timegm((2011, 10, 3, 0, 0, 0))
KITTI_TIME_OFFSET = 0.065
KITTI_POSITION_STD = 0.05
KITTI_VELOCITY_STD = (0.15, 0.15, 0.1)
KITTI_DENSE = 60.0
KITTI_STEP = 10

DRIVE_CLOCK_RATE = 548.590 / 548.731
DRIVE_TIME_OFFSET = 0.13
DRIVE_VELOCITY_AGE = 0.13
DRIVE_VELOCITY_STD = (0.05, 0.05, 0.1)

# What a user has to say about a car: where the sensors are and how their clocks differ.
KITTI_INSTALLATION = f"""\
/**:
  ros__parameters:
    gnss.time_offset: {KITTI_TIME_OFFSET}
"""

KITTI_NOISE = """\
    imu.gyro_noise_density: 2.0e-4
    imu.gyro_bias_random_walk: 3.0e-6
    imu.accel_bias_random_walk: 1.7e-4
    # What a turn of a car hides in a hole of 1.6 s.
    imu.gap_gyro_std: 0.1
    imu.gap_accel_std: 1.0
"""

DRIVE_INSTALLATION = f"""\
/**:
  ros__parameters:
    imu.mount_position: [0.0, 0.0, 0.65]
    imu.mount_rpy_deg: [0.0, -6.8, 174.9]
    gnss.lever_arm: [0.0, 0.05, 0.65]
    gnss.time_offset: {DRIVE_TIME_OFFSET}
"""

DRIVE_NOISE = """\
    # Vibration of roof and engine.
    imu.gyro_noise_density: 3.5e-3
    imu.accel_bias_random_walk: 3.0e-4
    gnss.position_std_floor: 0.01
"""

OUTAGE_LENGTH = 15.0
OUTAGE_SETS = tuple(
    tuple(np.arange(first, 548.6 - 30.0 - OUTAGE_LENGTH, 45.0).tolist()) for first in (40.0, 55.0, 70.0)
)
"""Starts (s) of the outages of drive_0708: every 45 s, with 30 s of fixes between them, in three staggered replays."""


@dataclass(frozen=True)
class Recording:
    """What `eskf_replay` needs: the bag with the topic `truth`, and a parameter file.

    `default_config` leaves the noise of the IMU at its defaults and says only how the sensors are installed.
    """

    bag: Path
    config: Path
    default_config: Path


@dataclass(frozen=True)
class ImuSamples:
    """Stamps (n,) in s, specific force (n, 3) in m/s2 and angular rate (n, 3) in rad/s, both in IMU axes."""

    time: Array
    specific_force: Array
    angular_rate: Array


@dataclass(frozen=True)
class Fixes:
    """Positions of the antenna: time (n,) in s, geodetic (n, 3) in deg, deg, m, std (n, 3) of east, north, up in m."""

    time: Array
    geodetic: Array
    std: Array
    status: NDArray[np.int8]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Fixes:
        return Fixes(self.time[chosen], self.geodetic[chosen], self.std[chosen], self.status[chosen])


@dataclass(frozen=True)
class Velocities:
    """East-North-Up velocities (n, 3) in m/s, valid at time (n,) in s, known at `arrival` (n,), with std (n, 3)."""

    time: Array
    arrival: Array
    velocity: Array
    std: Array


def kitti_recording(folder: Path, with_velocity: bool) -> Recording:
    """Write the KITTI drive to `folder`: each position of the first minute, then one in ten.

    Raises ModuleNotFoundError without gtsam.
    """
    time, specific_force, angular_rate = read_kitti_imu()
    position_time, position = read_kitti_positions()
    time, position_time = time + KITTI_MIDNIGHT, position_time + KITTI_MIDNIGHT
    count = len(position_time)
    geodetic = to_geodetic(MapFrame(KITTI_DATUM).to_ecef(position))
    geodetic[:, :2] = np.degrees(geodetic[:, :2])
    fixes = Fixes(position_time, geodetic, np.full((count, 3), KITTI_POSITION_STD), np.full(count, STATUS_FIX, np.int8))
    every_ten = np.arange(count) % KITTI_STEP == 0
    given = every_ten | (position_time <= position_time[0] + KITTI_DENSE)

    inner = np.flatnonzero(every_ten[1:-1]) + 1
    velocity = (position[inner + 1] - position[inner - 1]) / (position_time[inner + 1] - position_time[inner - 1])[
        :, None
    ]
    beside = np.zeros(count, bool)
    beside[np.concatenate([inner - 1, inner + 1])] = True
    velocities = Velocities(
        position_time[inner],
        position_time[inner] + KITTI_TIME_OFFSET + GNSS_LATENCY,
        velocity,
        np.tile(KITTI_VELOCITY_STD, (len(inner), 1)),
    )
    return _write(
        folder / ("kitti_velocity" if with_velocity else "kitti"),
        (KITTI_INSTALLATION, KITTI_NOISE),
        ImuSamples(time, specific_force, angular_rate),
        fixes[given],
        velocities if with_velocity else None,
        fixes[~given & ~beside],
        KITTI_TIME_OFFSET,
    )


def read_kitti_imu() -> tuple[Array, Array, Array]:
    """Time of day (n,) in s, specific force (n, 3), angular rate (n, 3) as measured: without the interpolated rows."""
    import gtsam

    table = np.loadtxt(gtsam.findExampleDataFile("KittiEquivBiasedImu.txt"), skiprows=1)
    time, readings = table[:, 0], table[:, 2:8]
    measured = measured_rows(time, readings)
    return time[measured], readings[measured, :3], readings[measured, 3:]


def measured_rows(time: Array, readings: Array) -> NDArray[np.bool_]:
    """True for the rows that were measured: no sensor puts three samples (n, 6) exactly on a straight line.

    The row before such a triple's middle is on the line too; the line ends in the first measured row after the hole.
    """
    slope = np.diff(readings, axis=0) / np.diff(time)[:, None]
    middle = np.concatenate([[False], np.abs(np.diff(slope, axis=0)).max(axis=1) < 1e-3, [False]])
    start = np.concatenate([middle[1:], [False]])
    return ~(middle | start)


def read_kitti_positions() -> tuple[Array, Array]:
    """Time of day (n,) in s and position (n, 3) in m, east, north, up."""
    import gtsam

    table = np.loadtxt(gtsam.findExampleDataFile("KittiGps_converted.txt"), skiprows=1, delimiter=",")
    return table[:, 0], table[:, 1:4]


def drive_0708_recording(folder: Path, source: Path, with_velocity: bool) -> Recording:
    """Write drive_0708 (the folder `source`) to `folder`: one RTK solution a second; the other three are the truth."""
    table = np.loadtxt(source / "imu_1934_stamped.csv", delimiter=",", comments="#")
    time = table[0, 0] + (table[:, 0] - table[0, 0]) * DRIVE_CLOCK_RATE
    solution_time, solution = _read_rtklib(source / "gnss_1934_sf.pos")
    quality, std = solution[:, 3], solution[:, [6, 5, 7]]
    fixes = Fixes(solution_time, solution[:, :3], std, np.where(quality == 1, STATUS_GBAS, STATUS_FIX).astype(np.int8))
    # Epochs are at x.499, x.749, x.999 and x.249 s.
    given = np.abs(np.round(solution_time) - solution_time) < 0.1
    velocities = Velocities(
        solution_time[given] - DRIVE_VELOCITY_AGE,
        solution_time[given] + DRIVE_TIME_OFFSET + GNSS_LATENCY,
        solution[given][:, [14, 13, 15]],
        np.maximum(solution[given][:, [17, 16, 18]], DRIVE_VELOCITY_STD),
    )
    return _write(
        folder / ("drive_0708_velocity" if with_velocity else "drive_0708"),
        (DRIVE_INSTALLATION, DRIVE_NOISE),
        ImuSamples(time, table[:, 1:4], table[:, 4:7]),
        fixes[given],
        velocities if with_velocity else None,
        fixes[~given & (quality == 1)],
        DRIVE_TIME_OFFSET,
    )


def _read_rtklib(path: Path) -> tuple[Array, Array]:
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


def replayed(bag: Path, config: Path, starts: Sequence[float] = ()) -> dict[str, Any]:
    """summary.json of `eskf_replay`, with outages of `OUTAGE_LENGTH` from each of `starts` (s); results beside the bag.

    Raises RuntimeError when the command fails.
    """
    outages = [f"--outage={start:g}:{OUTAGE_LENGTH:g}" for start in starts]
    code = main([str(bag), f"--config={config}", "--truth=truth", "--quiet", *outages])
    if code != 0:
        raise RuntimeError(f"eskf_replay {bag} ended with {code}")
    return json.loads((results_folder(bag) / "summary.json").read_text())  # type: ignore[no-any-return]


def results_folder(bag: Path) -> Path:
    """Where `eskf_replay` puts the results of `bag`."""
    return bag.parent / f"{bag.stem}_eskf"


def _write(
    stem: Path,
    parameters: tuple[str, str],
    imu: ImuSamples,
    fixes: Fixes,
    velocities: Velocities | None,
    truth: Fixes,
    time_offset: float,
) -> Recording:
    """Write `stem`.mcap and two parameter files: `parameters` is the installation, and what is added for the noise.

    `time_offset` is that of the parameters: GNSS stamp + offset = IMU stamp.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    bag, config, default_config = (stem.parent / f"{stem.name}{end}" for end in (".mcap", ".yaml", "_default.yaml"))
    installation, noise = parameters
    config.write_text(installation + noise, encoding="utf-8")
    default_config.write_text(installation, encoding="utf-8")
    with BagWriter(bag) as writer:

        def write(topic: str, type_name: str, arrival: Array, messages: NDArray[Any]) -> None:
            writer.write(writer.add_topic(f"/{topic}", type_name), _nanoseconds(arrival), messages, FRAMES)

        write("imu/data", IMU, imu.time + IMU_LATENCY, _imu_messages(imu))
        write("gps/fix", FIX, fixes.time + time_offset + GNSS_LATENCY, _fix_messages(fixes, 0.0))
        if velocities is not None:
            write("gps/vel", VELOCITY, velocities.arrival, _velocity_messages(velocities))
        write("truth", FIX, truth.time + time_offset, _fix_messages(truth, time_offset))
    return Recording(bag, config, default_config)


def _nanoseconds(seconds: Array) -> NDArray[np.int64]:
    return np.round(seconds * 1e9).astype(np.int64)


def _imu_messages(imu: ImuSamples) -> NDArray[Any]:
    messages = np.zeros(len(imu.time), message_dtype(IMU))
    messages["stamp"] = _nanoseconds(imu.time)
    messages["orientation"][:, 3] = 1.0
    messages["orientation_covariance"][:, 0] = -1.0
    messages["linear_acceleration"] = imu.specific_force
    messages["angular_velocity"] = imu.angular_rate
    return messages


def _fix_messages(fixes: Fixes, added_time: float) -> NDArray[Any]:
    messages = np.zeros(len(fixes.time), message_dtype(FIX))
    messages["stamp"] = _nanoseconds(fixes.time + added_time)
    messages["frame_id"] = 1
    messages["status"] = fixes.status
    messages["service"] = 1
    messages["latitude"], messages["longitude"], messages["altitude"] = fixes.geodetic.T
    messages["position_covariance"][:, ::4] = fixes.std**2
    messages["position_covariance_type"] = COVARIANCE_DIAGONAL_KNOWN
    return messages


def _velocity_messages(velocities: Velocities) -> NDArray[Any]:
    messages = np.zeros(len(velocities.time), message_dtype(VELOCITY))
    messages["stamp"] = _nanoseconds(velocities.time)
    messages["frame_id"] = 1
    messages["linear_velocity"] = velocities.velocity
    # The diagonal of the linear block; a receiver does not measure rotation.
    messages["twist_covariance"][:, [0, 7, 14]] = velocities.std**2
    messages["twist_covariance"][:, 21] = -1.0
    return messages
