"""A measurement of your own, tried out: ranges to a beacon hold the position where GNSS is gone.

``beacon_range.py`` is the measurement. Here a copy of the package gets it, by the four edits of
``docs/add_a_measurement.md``, and runs over a simulated drive with 15 s without GNSS, with and without the ranges. In a
checkout you make the four edits by hand. The copy runs uncompiled, because compiling takes longer than this drive.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import eskf_ros

EXAMPLES = Path(__file__).resolve().parent

EDITS = (
    # file of the package, the line that is there, what is put behind it
    ("filter/state/enums.py", "    RANGE_RATE = auto()\n", "    BEACON_RANGE = auto()\n"),
    ("filter/fuse.py", "from eskf_ros.filter.measurements import (\n", "    beacon_range,\n"),
    ("filter/fuse.py", "MEASUREMENTS = (\n", "    beacon_range.ROW,\n"),
    (
        "filter/fuse.py",
        "    if aid.stream == Stream.WHEEL:\n        return wheel.linearize(state, aid.payload, settings, work)\n",
        "    if aid.stream == Stream.BEACON_RANGE:\n"
        "        return beacon_range.linearize(state, aid.payload, settings, work)\n",
    ),
)
"""A stream, an import, an entry in the list of rows, a branch."""

BEACON_MAP = np.array([250.0, -120.0, 4.0])
"""The beacon in the map of the simulation: East, North, Up (m)."""

RANGE_STD = 0.3
"""m"""

GNSS_ENDS = 25.0
"""Seconds after the start of the recording."""


def patched_package(folder: Path) -> None:
    """Copy the package to ``folder`` and add the measurement to it."""
    package = folder / "eskf_ros"
    shutil.copytree(Path(eskf_ros.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(EXAMPLES / "beacon_range.py", package / "filter" / "measurements")
    for name, anchor, addition in EDITS:
        text = (package / name).read_text(encoding="utf-8")
        if text.count(anchor) != 1:
            raise SystemExit(f"{name} has changed: the line {anchor!r} is not there once")
        (package / name).write_text(text.replace(anchor, anchor + addition), encoding="utf-8")


def record_drive(path: Path) -> None:
    """Simulate a drive of 40 s with GNSS for its first 25 s and ranges to a beacon at 5 Hz; write it to an npz file."""
    from eskf_ros.geodesy.map_frame import MapFrame
    from eskf_ros.simulate.scenario import simulate

    drive = simulate("drive", seed=4, imu_rate=25.0, start=15.0, stop=55.0, grade="consumer")
    has_gnss = (drive.fix_stamp - drive.imu_stamp[0]) * 1e-9 < GNSS_ENDS
    chosen = slice(0, None, len(drive.truth_stamp) // 200)
    distance = np.linalg.norm(BEACON_MAP - drive.truth_position_map[chosen], axis=1)
    noise = RANGE_STD * np.random.default_rng(1).normal(size=len(distance))
    latitude, longitude, altitude = MapFrame(drive.datum).to_geodetic_deg(BEACON_MAP)
    np.savez(
        path,
        imu_stamp=drive.imu_stamp,
        specific_force=drive.specific_force,
        angular_rate=drive.angular_rate,
        fix_stamp=drive.fix_stamp[has_gnss],
        latitude_deg=drive.fix_latitude_deg[has_gnss],
        longitude_deg=drive.fix_longitude_deg[has_gnss],
        altitude=drive.fix_altitude[has_gnss],
        fix_covariance=drive.fix_covariance[has_gnss],
        velocity=drive.velocity_enu[has_gnss],
        velocity_covariance=drive.velocity_covariance[has_gnss],
        range_stamp=drive.truth_stamp[chosen],
        range=distance + noise,
        beacon=(latitude, longitude, altitude),
        datum=drive.datum,
        truth=drive.truth_position_map[-1],
    )


def run_drive(path: Path) -> None:
    """Run the filter over the drive, with and without the ranges; print errors (m) and the ranges used."""
    drive = np.load(path)
    tables = {
        "imu": {name: drive[name] for name in ("specific_force", "angular_rate")} | {"stamp": drive["imu_stamp"]},
        "gnss_position": {name: drive[name] for name in ("latitude_deg", "longitude_deg", "altitude")}
        | {"stamp": drive["fix_stamp"], "covariance": drive["fix_covariance"]},
        "gnss_velocity": {
            "stamp": drive["fix_stamp"],
            "velocity": drive["velocity"],
            "covariance": drive["velocity_covariance"],
        },
    }
    parameters = {
        "datum": drive["datum"].tolist(),
        "alignment.static_duration": 1.0,
        "beacon_range.beacon": drive["beacon"].tolist(),
    }
    ranges = {
        "stamp": drive["range_stamp"],
        "range": drive["range"],
        "covariance": np.full(len(drive["range"]), RANGE_STD**2),
    }
    way = BEACON_MAP - drive["truth"]
    for name, others in (("without", {}), ("with", {"beacon_range": ranges})):
        result = eskf_ros.run(**tables, parameters=parameters, output_rate=1.0, **others)
        last = result.odometry[-1]
        along = float((last["position_map"] - drive["truth"]) @ way) / float(np.linalg.norm(way))
        counts = result.summary["aids"].get("beacon_range", {})
        print(
            f"{name} ranges: {along:.2f} m of error along the line to the beacon, "
            f"{counts.get('fused', 0)} of {counts.get('offered', 0)} ranges fused, "
            f"mean NIS {counts.get('nis_mean') or 0.0:.2f}"
        )


def main() -> None:
    """Simulate, copy and add, run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record_drive(folder / "drive.npz")
        patched_package(folder)
        environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_DISABLE_JIT": "1"}
        command = [sys.executable, __file__, str(folder / "drive.npz")]
        subprocess.run(command, check=True, env=environment)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        run_drive(Path(sys.argv[1]))
    else:
        main()
