"""A recording as files that other programs read: KF-GINS, RTKLIB, sidereon, evo."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.geodesy.map_frame import MapFrame, east_north_up_to_ecef, to_geodetic
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.tum_writer import tum_text
from peers_sidereon import BIAS_TIME, SECOND, Inputs, imu_to_base

Array = NDArray[np.float64]

GPS_EPOCH = 315_964_800
"""1980-01-06 in seconds of Unix time."""
WEEK = 604_800
FORWARD_RIGHT_DOWN = np.diag([1.0, -1.0, -1.0])
"""From axes forward, left, up."""
NORTH_EAST_DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""From axes East, North, Up."""
MILLIGAL = 1e-5
"""m/s2."""


def seconds_of_week(stamps: NDArray[np.int64]) -> Array:
    """Seconds of the week (n,) in which the recording begins, of the clock of its stamps."""
    start = (int(stamps[0]) // SECOND - GPS_EPOCH) // WEEK * WEEK + GPS_EPOCH
    return np.asarray((stamps - start * SECOND) / SECOND)


def export(folder: Path, inputs: Inputs, start: NDArray[Any], frame: MapFrame, parameters: Parameters) -> None:
    """Write the files of KF-GINS, RTKLIB and sidereon into a folder; the start is that of a row of our estimate."""
    folder.mkdir(parents=True, exist_ok=True)
    both = np.concatenate([inputs.stamp[:1], inputs.fix_stamp])
    fix_seconds = seconds_of_week(both)[1:]
    _write_kf_gins_imu(folder / "kf_gins_imu.txt", inputs, parameters)
    degrees = np.degrees(inputs.geodetic[:, :2])
    deviations = np.sqrt(np.diagonal(inputs.covariance, axis1=1, axis2=2))
    north_east_down = deviations[:, [1, 0, 2]]
    columns = np.column_stack([fix_seconds, degrees, inputs.geodetic[:, 2], north_east_down])
    np.savetxt(folder / "kf_gins_gnss.txt", columns, fmt=["%.6f", "%.11f", "%.11f", "%.4f", *["%.4f"] * 3])
    (folder / "kf-gins.yaml").write_text(kf_gins_configuration(inputs, start, frame, parameters), encoding="utf-8")
    (folder / "rtklib.pos").write_text(rtklib_positions(inputs), encoding="ascii")
    np.savez_compressed(folder / "sidereon.npz", **vars(inputs))


def _write_kf_gins_imu(path: Path, inputs: Inputs, parameters: Parameters) -> None:
    """Increments over each interval in axes forward, right, down of base_link: rad and m/s."""
    seconds = seconds_of_week(inputs.stamp)
    steps = np.diff(seconds)[:, None]
    turn = FORWARD_RIGHT_DOWN @ imu_to_base(parameters)
    angle, velocity = (0.5 * (values[1:] + values[:-1]) * steps @ turn.T for values in (inputs.rate, inputs.force))
    np.savetxt(path, np.column_stack([seconds[1:], angle, velocity]), fmt=["%.9f", *["%.12e"] * 6])


def kf_gins_configuration(inputs: Inputs, start: NDArray[Any], frame: MapFrame, parameters: Parameters) -> str:
    """Configuration of KF-GINS: start, noise, lever arm, in its units (deg, deg/sqrt(h), mGal, ppm)."""
    position_ecef = frame.to_ecef(start["position_map"][None])
    geodetic = to_geodetic(position_ecef)
    to_local = east_north_up_to_ecef(geodetic)[0].T @ frame.rotation_map_to_ecef
    attitude = Rotation.from_quat(np.roll(start["attitude_body_to_map"], -1)).as_matrix()
    local = NORTH_EAST_DOWN @ to_local @ attitude @ FORWARD_RIGHT_DOWN
    yaw, pitch, roll = Rotation.from_matrix(local).as_euler("ZYX", degrees=True)
    velocity = NORTH_EAST_DOWN @ to_local @ start["velocity_map"]
    pose = np.sqrt(np.diagonal(start["pose_covariance"]))
    speed = math.sqrt(np.diagonal(start["twist_covariance"])[:3].max())
    imu, walk = parameters.imu, math.sqrt(0.5 * BIAS_TIME)
    lever = FORWARD_RIGHT_DOWN @ np.subtract(parameters.gnss.lever_arm, parameters.imu.mount_position)
    latitude, longitude = np.degrees(geodetic[0, :2]).tolist()
    begin = seconds_of_week(np.array([inputs.stamp[0], start["stamp"]]))[1]
    rate = round((len(inputs.stamp) - 1) / (int(inputs.stamp[-1] - inputs.stamp[0]) / SECOND))

    def thrice(value: float) -> str:
        return f"[ {value:.9g}, {value:.9g}, {value:.9g} ]"

    def listed(values: Any) -> str:
        return "[ " + ", ".join(f"{float(value):.9g}" for value in values) + " ]"

    return f"""\
imupath: "kf_gins_imu.txt"
gnsspath: "kf_gins_gnss.txt"
outputpath: "."
imudatalen: 7
imudatarate: {rate}
starttime: {begin:.6f}
endtime: -1
initpos: [ {latitude:.11f}, {longitude:.11f}, {geodetic[0, 2]:.4f} ]
initvel: {listed(velocity)}
initatt: {listed((roll, pitch, yaw))}
initgyrbias: {listed(np.degrees(FORWARD_RIGHT_DOWN @ start["gyro_bias"]) * 3600.0)}
initaccbias: {listed(FORWARD_RIGHT_DOWN @ start["accel_bias"] / MILLIGAL)}
initgyrscale: [ 0, 0, 0 ]
initaccscale: [ 0, 0, 0 ]
initposstd: {listed(pose[[1, 0, 2]])}
initvelstd: {thrice(speed)}
initattstd: {listed(np.degrees([pose[3:5].max(), pose[3:5].max(), pose[5]]))}
initbgstd: {listed(np.degrees(start["gyro_bias_std"]) * 3600.0)}
initbastd: {listed(start["accel_bias_std"] / MILLIGAL)}
imunoise:
  arw: {thrice(math.degrees(imu.gyro_noise_density) * 60.0)}
  vrw: {thrice(imu.accel_noise_density * 60.0)}
  gbstd: {thrice(math.degrees(imu.gyro_bias_random_walk * walk) * 3600.0)}
  abstd: {thrice(imu.accel_bias_random_walk * walk / MILLIGAL)}
  gsstd: [ 300.0, 300.0, 300.0 ]
  asstd: [ 300.0, 300.0, 300.0 ]
  corrtime: {BIAS_TIME / 3600.0:.6f}
antlever: {listed(lever)}
"""


def rtklib_positions(inputs: Inputs) -> str:
    """The fixes as a solution file of RTKLIB (.pos), on the clock of the stamps."""
    lines = ["% program   : eskf_ros", "%  UTC                   latitude(deg) longitude(deg)  height(m)   Q  ns"]
    lines[-1] += "   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
    for stamp, geodetic, covariance in zip(inputs.fix_stamp, inputs.geodetic, inputs.covariance, strict=True):
        moment = np.datetime64(int(stamp), "ns").astype("datetime64[ms]").astype(object)
        east, north, up = np.sqrt(np.diagonal(covariance)).tolist()
        mixed = (covariance[0, 1], covariance[0, 2], covariance[1, 2])
        sdne, sdeu, sdun = (math.copysign(math.sqrt(abs(value)), value) for value in mixed)
        latitude, longitude = np.degrees(geodetic[:2]).tolist()
        lines.append(
            f"{moment:%Y/%m/%d %H:%M:%S}.{moment.microsecond // 1000:03d} {latitude:14.9f} {longitude:14.9f} "
            f"{geodetic[2]:10.4f} {5:3d} {0:3d} {north:8.4f} {east:8.4f} {up:8.4f} {sdne:8.4f} {sdeu:8.4f} "
            f"{sdun:8.4f} {0.0:6.2f} {0.0:6.1f}"
        )
    return "\n".join(lines) + "\n"


def write_tum(path: Path, rows: NDArray[Any]) -> None:
    """Positions and attitudes of ODOMETRY rows (n,), for evo."""
    numbers = np.column_stack([rows["position_map"], rows["attitude_body_to_map"][:, [1, 2, 3, 0]]])
    path.write_bytes(tum_text(rows["stamp"], numbers))
