"""walk_0827 (rtklibexplorer/GNSS_IMU): a hand-held IMU and an u-blox X20P, 134 s, tight turns in a back yard.

IMU at 166 Hz, RTK solution (NAV-PVT) and raw measurements four times a second.

- Stamps are GPS time in Unix seconds. IMU and positions agree within 0.02 s (mean NIS by offset), the velocity of the
  receiver is 0.12 s (+-0.02) older than its position (as on drive_0708).
- IMU axes are right, backward, up, as the author says; how the hand holds it differs by some 20 deg from step to step.
  It is within 5 cm of the antenna.
- The solutions of the first 87 s have fixed ambiguities; only these are truth. Our point solutions lie 6.3 m east,
  5.8 m north and 4 m above them: the datum of the base station.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eskf_ros.gnss.ephemeris import Broadcast, Ephemerides, Message, usual_message
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, allocate_ranges
from eskf_ros.gnss.signals import LETTERS, SIGNAL_BY_CODE, SIGNAL_CARRIER_HZ, Gnss
from eskf_ros.gnss.time import BEIDOU_OFFSET, SECONDS_PER_WEEK
from support.recordings.common import (
    GNSS_LATENCY,
    STATUS_FIX,
    STATUS_GBAS,
    Array,
    Fixes,
    Recording,
    diagonal,
    differences,
    gnss_fix,
    gnss_velocity,
    gps_to_unix,
    imu,
    shifted,
    truth_fix,
    write_bag,
)
from support.recordings.satellites import RangeEpochs, gnss_ephemerides, gnss_ranges, masked, solved_fixes

WEEK = 2381
STANDARD_GRAVITY = 9.80665
TIME_OFFSET = 0.0
VELOCITY_AGE = 0.12
FIXED = 2

SYSTEMS = (Gnss.GPS, Gnss.GLONASS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.QZSS)
FNAV = 258
COLUMNS = (
    *("af0", "af1", "af2", "sqrt_a", "e", "i0", "omega0", "omega", "m0", "delta_n", "omega_dot", "idot"),
    *("cuc", "cus", "crc", "crs", "cic", "cis", "toe", "", "", "issue", "health", "", "", ""),
)
"""ephemeris.csv from the clock on, by the names of `Broadcast.fields`."""

INSTALLATION = f"""\
/**:
  ros__parameters:
    imu.mount_rpy_deg: [0.0, 0.0, 90.0]
    gnss.time_offset: {TIME_OFFSET}
"""

NOISE = """\
    # A hand points it elsewhere than the feet go.
    alignment.use_course: false
    # A clock that is shaken.
    ranges.clock_drift_noise: 0.6
"""

MASKED = ((25.0, 30.0), (40.0, 30.0), (55.0, 30.0))
"""When few satellites are left (start, length in s), in replays of their own."""

OUTAGE_SETS = {
    15.0: (((25.0, 15.0), (60.0, 15.0)), ((40.0, 15.0),), ((50.0, 15.0),), ((70.0, 15.0),)),
    30.0: (((25.0, 30.0),), ((40.0, 30.0),), ((55.0, 30.0),)),
}
"""Outages (start, length in s) by length, while the walker moves and the truth is fixed."""


def walk_recording(folder: Path, source: Path) -> Recording:
    """Write the walk (the folder `source`) to `folder`: one RTK solution a second; the other three are the truth."""
    time, specific_force, angular_rate = read_imu(source)
    fixes, velocity, velocity_std = read_solution(source)
    given = np.abs(fixes.time - np.round(fixes.time)) < 0.1
    bag = folder / "walk.mcap"
    write_bag(
        bag,
        imu(time, specific_force, angular_rate),
        gnss_fix(fixes[given], TIME_OFFSET),
        gnss_velocity(
            fixes.time[given] - VELOCITY_AGE,
            velocity[given],
            velocity_std[given],
            fixes.time[given] + TIME_OFFSET + GNSS_LATENCY,
        ),
        truth_fix(fixes[~given & (fixes.status == STATUS_GBAS)], TIME_OFFSET),
    )
    return Recording(bag, INSTALLATION, NOISE)


def walk_ranges_recording(
    folder: Path, source: Path, count: int | None = None, start: float = 0.0, length: float = 0.0
) -> Recording:
    """Write the walk with ranges, ephemerides and our own point solutions four times a second.

    With a `count` only so many satellites are there from `start` on, for `length` (s from the first IMU sample).

    Truth are all fixed RTK positions, shifted by what they differ from the point solutions on the average: the datum of
    the base station, and what is common to the errors of the point solutions.
    """
    time, specific_force, angular_rate = read_imu(source)
    epochs, broadcasts = read_ranges(source), read_broadcasts(source)
    ephemerides = Ephemerides(np.array([broadcast.record() for broadcast in broadcasts]))
    solved, velocity_time, velocity, velocity_std = solved_fixes(epochs, ephemerides)
    reference, _, _ = read_solution(source)
    shift = np.mean(differences(solved, reference), axis=0)
    if count is not None:
        epochs = masked(epochs, count, time[0] + start, length)
        solved, velocity_time, velocity, velocity_std = solved_fixes(epochs, ephemerides)
    bag = folder / ("walk_ranges.mcap" if count is None else "walk_masked.mcap")
    write_bag(
        bag,
        imu(time, specific_force, angular_rate),
        gnss_fix(solved, TIME_OFFSET),
        gnss_velocity(velocity_time, velocity, velocity_std, velocity_time + TIME_OFFSET + GNSS_LATENCY),
        gnss_ranges(epochs, epochs.time + TIME_OFFSET + GNSS_LATENCY),
        gnss_ephemerides(time[0], broadcasts),
        truth_fix(shifted(reference[reference.status == STATUS_GBAS], shift), TIME_OFFSET),
    )
    return Recording(bag, INSTALLATION, NOISE)


def read_imu(source: Path) -> tuple[Array, Array, Array]:
    """Stamps (n,) in s, specific force (n, 3) in m/s2 and angular rate (n, 3) in rad/s in IMU axes."""
    table = np.loadtxt(source / "imu.csv", delimiter=",", skiprows=1)
    return gps_to_unix(WEEK, table[:, 0], 0), table[:, 1:4] * STANDARD_GRAVITY, table[:, 4:7]


def read_solution(source: Path) -> tuple[Fixes, Array, Array]:
    """The RTK solution of the receiver: positions, East-North-Up velocities (n, 3) in m/s, their deviations (n, 3)."""
    table = np.loadtxt(source / "truth_navpvt.csv", delimiter=",", skiprows=1)
    horizontal, vertical, speed = table[:, 7], table[:, 8], table[:, 9]
    # The receiver gives the accuracy of the horizontal position and of the velocity as a whole.
    std = np.column_stack([horizontal, horizontal, vertical]) / np.array([np.sqrt(2.0), np.sqrt(2.0), 1.0])
    fixes = Fixes(
        gps_to_unix(WEEK, table[:, 0] * 1e-3, 0),
        table[:, 1:4],
        diagonal(std),
        np.where(table[:, 11] == FIXED, STATUS_GBAS, STATUS_FIX).astype(np.int8),
    )
    velocity = table[:, [5, 4, 6]] * np.array([1.0, 1.0, -1.0])
    return fixes, velocity, np.repeat(speed[:, None], 3, axis=1) / np.sqrt(3.0)


def read_ranges(source: Path) -> RangeEpochs:
    """The measurements of the receiver: all signals, weights by C/N0."""
    table = np.genfromtxt(source / "obs.csv", delimiter=",", skip_header=1, dtype=None, encoding="ascii")
    _, seconds, letters, numbers, codes, pseudorange, _, doppler, cn0, *_ = (table[name] for name in table.dtype.names)
    ranges = allocate_ranges(len(table))
    ranges["gnss_id"] = [LETTERS[letter] for letter in letters]
    ranges["sv_id"] = numbers
    ranges["signal"] = [SIGNAL_BY_CODE[LETTERS[letter], code] for letter, code in zip(letters, codes, strict=True)]
    ranges["carrier_hz"] = SIGNAL_CARRIER_HZ[ranges["signal"]]
    ranges["pseudorange"], ranges["doppler"], ranges["cn0"] = pseudorange, doppler, cn0
    ranges["flags"] = CODE_VALID | DOPPLER_VALID
    starts = np.flatnonzero(np.diff(seconds, prepend=-1.0))
    parts = np.split(ranges, starts[1:])
    return RangeEpochs(gps_to_unix(WEEK, seconds[starts], 0), WEEK, seconds[starts], parts)


def read_broadcasts(source: Path) -> list[Broadcast]:
    """The navigation messages of the receiver; it heard no parameters of the ionosphere."""
    broadcasts = []
    for row in np.loadtxt(source / "ephemeris.csv", delimiter=",").tolist():
        gnss, sv_id = SYSTEMS[int(row[0])], int(row[1])
        # Times count from the beginning of GPS time.
        week, toc = divmod(row[3] - (BEIDOU_OFFSET if gnss == Gnss.BEIDOU else 0.0), SECONDS_PER_WEEK)
        fields = {name: value for name, value in zip(COLUMNS, row[4:], strict=True) if name}
        delays = {Gnss.GALILEO: ("bgd_e5a", "bgd_e5b"), Gnss.BEIDOU: ("tgd", "tgd2")}.get(gnss, ("tgd",))
        fields |= dict(zip(delays, row[23:25], strict=False))
        message = Message.FNAV if int(row[29]) == FNAV else usual_message(gnss, sv_id)
        assert message is not None
        broadcasts.append(Broadcast(gnss, sv_id, message, int(week), toc, fields))
    return broadcasts
