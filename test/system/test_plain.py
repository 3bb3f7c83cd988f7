"""The kernels uncompiled, as they run without numba: the same results to rounding."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from eskf_ros.compiled import COMPILED
from eskf_ros.filter.navigator import Navigator
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import simulate
from eskf_ros.smooth.smoother import Smoother

CHECKOUT = Path(__file__).resolve().parents[2]


def drive(path: Path) -> None:
    """Navigate 8 s of a drive, start-up and late fixes included, and write rows and records to an npz file."""
    recording = simulate("tunnel_drive", seed=3, start=17.0, stop=25.0, imu_rate=100.0, grade="industrial")
    # Without a datum: the first fix is it.
    parameters = {**recording.parameters(), "alignment.static_duration": 1.0, "datum": []}
    navigator = Navigator(from_mapping(parameters), keeps_log=True)
    smoother = Smoother(navigator)
    rows = []
    fix = velocity = 0
    for k, arrival in enumerate(recording.imu_arrival):
        while fix < len(recording.fix_arrival) and recording.fix_arrival[fix] < arrival:
            navigator.push_gnss_position(
                int(recording.fix_stamp[fix]),
                float(recording.fix_latitude_deg[fix]),
                float(recording.fix_longitude_deg[fix]),
                float(recording.fix_altitude[fix]),
                recording.fix_covariance[fix],
                3,
                0,
                int(recording.fix_arrival[fix]),
            )
            fix += 1
        while velocity < len(recording.velocity_arrival) and recording.velocity_arrival[velocity] < arrival:
            navigator.push_gnss_velocity(
                int(recording.velocity_stamp[velocity]),
                recording.velocity_enu[velocity],
                recording.velocity_covariance[velocity],
                int(recording.velocity_arrival[velocity]),
            )
            velocity += 1
        sample = slice(k, k + 1)
        rows.append(
            navigator.push_imu(
                recording.imu_stamp[sample], recording.specific_force[sample], recording.angular_rate[sample]
            )
        )
    records = navigator.finish()
    smoother.smooth()
    smoothed = np.concatenate([np.asarray(part) for part in smoother.rows()])
    np.savez(path, compiled=COMPILED, rows=np.concatenate(rows), records=records, smoothed=smoothed)


@pytest.mark.slow
@pytest.mark.skipif(not COMPILED, reason="needs numba to compare with")
def test_plain_kernels_agree_with_the_compiled_ones(tmp_path: Path) -> None:
    drive(tmp_path / "compiled.npz")
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join([str(CHECKOUT), *sys.path])}
    subprocess.run([sys.executable, __file__, str(tmp_path / "plain.npz")], check=True, env=environment, timeout=300)
    with np.load(tmp_path / "compiled.npz") as compiled, np.load(tmp_path / "plain.npz") as plain:
        assert compiled["compiled"]
        assert not plain["compiled"]
        ours, theirs = compiled["rows"], plain["rows"]
        # The drive is far enough for everything to have happened: rows, fixes, velocities, a heading.
        assert len(ours) > 600
        assert ours["heading_known"][-1]
        for name in ours.dtype.names:
            if ours[name].dtype.kind != "f":
                np.testing.assert_array_equal(ours[name], theirs[name])
                continue
            scale = np.abs(ours[name]).max(axis=0) + 1e-6
            np.testing.assert_allclose(ours[name] / scale, theirs[name] / scale, rtol=0.0, atol=1e-8, err_msg=name)
        ours, theirs = compiled["smoothed"], plain["smoothed"]
        assert len(ours) > 500
        for name in ("position_map", "velocity_map", "attitude_body_to_map", "accel_bias", "gyro_bias"):
            np.testing.assert_allclose(ours[name], theirs[name], rtol=0.0, atol=1e-7, err_msg=name)
        np.testing.assert_allclose(ours["pose_covariance"], theirs["pose_covariance"], rtol=1e-6, atol=1e-9)
        assert len(compiled["records"]) > 60
        for name in ("stamp", "arrival", "stream", "verdict", "dof"):
            np.testing.assert_array_equal(compiled["records"][name], plain["records"][name])
        for name in ("nis", "innovation"):
            np.testing.assert_allclose(compiled["records"][name], plain["records"][name], rtol=1e-6, atol=1e-7)


if __name__ == "__main__":
    drive(Path(sys.argv[1]))


@pytest.mark.skipif(not COMPILED, reason="without numba nothing is compiled")
def test_nothing_is_left_to_compile_once_the_kernels_are() -> None:
    """A kernel that compiles in a callback stops the robot's odometry for seconds.

    In a process of its own: whatever another test has compiled would hide what is missing here.
    """
    code = """
import sys, numba, numpy as np
from eskf_ros.filter import navigator
from eskf_ros.filter.warm_up import compile_kernels
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import simulate

compile_kernels()
# The simulator compiles some for itself: that is none of the node's business.
recording = simulate("drive", imu_rate=100.0, start=12.0, stop=62.0)
found = [(f"{module}.{n}", f) for module in list(sys.modules) if module.startswith("eskf_ros.filter")
    for n, f in vars(sys.modules[module]).items()]
compiled = lambda: {n: len(f.signatures) for n, f in found if isinstance(f, numba.core.dispatcher.Dispatcher)}
before = compiled()
pilot = navigator.Navigator(from_mapping(recording.parameters()))
for epoch, stamp in enumerate(recording.fix_stamp):
    part = (recording.imu_stamp <= stamp) & (recording.imu_stamp > pilot.state["imu"]["stamp"][0])
    pilot.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
    pilot.push_gnss_position(int(stamp), *(float(v) for v in (recording.fix_latitude_deg[epoch],
        recording.fix_longitude_deg[epoch], recording.fix_altitude[epoch])), recording.fix_covariance[epoch], 2, 0)
    pilot.push_gnss_velocity(int(stamp), recording.velocity_enu[epoch], recording.velocity_covariance[epoch])
    pilot.take_records()
assert pilot.set_datum_here() and pilot.odometry["heading_known"][0] and pilot.status >= 0
pilot.finish()
after = compiled()
assert len(before) > 5
print([name for name in after if after[name] != before[name]])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"
