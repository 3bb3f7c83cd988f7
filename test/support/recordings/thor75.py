"""thor75_flight (NorthStarUAS/insgnss_tools): a fixed-wing UAV, 696 s, of which 367 s in the air.

A MEMS IMU and a magnetometer at 50 Hz, GPS position and velocity once a second, and the estimate of the navigation
filter on board (15 states, the same sensors), the peer. Nothing independent tells the truth: the topic `peer` is
compared, from 260 s, when its heading has settled, to 580 s, before it lands. On the ground its heading wanders.

- IMU axes are forward, right, down. A fifth of the samples repeats the one before. From 24.8 s on the file holds
  readings less the biases that the peer estimated: the roll rate at rest jumps from -1.15 to -0.6 deg/s there. With
  them added again it stays.
- GPS messages are stamped when the flight computer took them, in steps of 20 ms; they drift by 0.14 s against GPS
  time during the flight, which is the clock of the computer. They are 0.06 s late (+-0.02): the mean NIS of the
  velocity is least then.
- Positions and velocities come without covariances; the defaults of the parameters stand in for them. A GPS velocity
  differs from the peer by 0.19 m/s north, 0.04 east, 0.09 down (rms), a position by 0.7 m, 0.5 m, 1.4 m.
- Altitudes are above mean sea level, as those of the peer.
- The magnetometer gives gauss, its axes are forward, left, up; in the air it is off by (0.40, 0.16, -0.38) gauss, more
  than the horizontal field, and on the ground by something else.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from eskf_ros.geodesy import earth
from eskf_ros.geodesy.map_frame import east_north_up_to_ecef
from support.recordings.common import (
    STATUS_FIX,
    Array,
    Fixes,
    Recording,
    gnss_fix,
    gnss_velocity,
    gps_to_unix,
    imu,
    magnetic_field,
    pose_in_earth,
    write_bag,
)

FILE = "thor_flight75_WaypointTracker_150squareWaypointNew_2012_10_10.mat"
WEEK = 1709
LEAP_SECONDS = 16
START_TOW = 319547.2
"""GPS time of week at the time zero of the flight computer, to a few tenths of a second."""
TIME_OFFSET = -0.06
PEER_SETTLED = (260.0, 580.0)
GAUSS = 1e-4
FRONT_LEFT_UP = np.diag([1.0, -1.0, -1.0])
EAST_NORTH_UP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
NO_FIX = 45.0
"""The latitude before the first fix."""

INSTALLATION = f"""\
/**:
  ros__parameters:
    imu.mount_rpy_deg: [180.0, 0.0, 0.0]
    # The iron in the aeroplane is stronger than the horizontal field, and nobody has calibrated it.
    mag.use: false
    gnss.time_offset: {TIME_OFFSET}
"""

NOISE = """\
    # Pushed by hand, in a cross wind: an aeroplane does not always go where its nose points.
    alignment.use_course: false
"""


def thor75_recording(folder: Path, source: Path) -> Recording:
    """Write the flight (the folder `source`) to `folder`; the topic `peer` is the estimate of the filter on board."""
    flight = loadmat(source / FILE, squeeze_me=True, struct_as_record=False)["flight_data"]

    def columns(*names: str) -> Array:
        return np.column_stack([getattr(flight, name) for name in names]).astype(np.float64)

    time = gps_to_unix(WEEK, START_TOW + flight.time.astype(np.float64), LEAP_SECONDS)
    valid = flight.imuStatus > 0
    force = columns("ax", "ay", "az") + columns("ax_bias", "ay_bias", "az_bias")
    rate = columns("p", "q", "r") + columns("p_bias", "q_bias", "r_bias")
    new = np.concatenate([[False], np.diff(flight.GPS_TOW) != 0]) & (flight.lat != NO_FIX)
    count = int(new.sum())
    fixes = Fixes(time[new], columns("lat", "lon", "alt")[new], None, np.full(count, STATUS_FIX, np.int8))
    north_east_down = columns("vn", "ve", "vd")[new]
    known = (flight.time >= PEER_SETTLED[0]) & (flight.time <= PEER_SETTLED[1])
    latitude, longitude, altitude = columns("navlat", "navlon", "navalt")[known].T
    ecef = np.array([earth.geodetic_to_ecef(*p) for p in zip(latitude, longitude, altitude, strict=True)])
    local = east_north_up_to_ecef(np.column_stack([latitude, longitude]))
    attitude = Rotation.from_euler("ZYX", columns("psi", "theta", "phi")[known]).as_matrix()
    speed = np.linalg.norm(columns("navvn", "navve", "navvd")[known], axis=1)
    bag = folder / "thor75.mcap"
    write_bag(
        bag,
        imu(time[valid], force[valid], rate[valid]),
        gnss_fix(fixes, TIME_OFFSET),
        gnss_velocity(time[new], north_east_down @ EAST_NORTH_UP.T, None, time[new]),
        magnetic_field(time[valid], columns("hx", "hy", "hz")[valid] * GAUSS),
        pose_in_earth("peer", time[known], ecef, local @ EAST_NORTH_UP @ attitude @ FRONT_LEFT_UP, speed),
    )
    return Recording(bag, INSTALLATION, NOISE)
