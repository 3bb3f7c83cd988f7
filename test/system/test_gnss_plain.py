"""The satellite kernels uncompiled, as they run without numba: the same results to rounding."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from eskf_ros.compiled import COMPILED
from eskf_ros.gnss.point_solution import solve
from eskf_ros.gnss.signals import Gnss
from support.gnss_sky import KLOBUCHAR, SECONDS, WEEK, all_constellations, measure, receiver_at

CHECKOUT = Path(__file__).resolve().parents[2]


def navigate(path: Path) -> None:
    """One epoch from ephemerides to position and velocity, written to an npz file."""
    receiver = receiver_at(48.1, 11.6, 565.0, clock_bias=1234.5, clock_drift=-7.0)
    systems = (Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.GLONASS)
    solution = solve(measure(receiver, all_constellations(), systems), WEEK, SECONDS, KLOBUCHAR)
    np.savez(
        path,
        compiled=COMPILED,
        satellite=solution.ranges["satellite"],
        satellite_clock=solution.ranges["satellite_clock"],
        pseudorange=solution.predictions["pseudorange"],
        range_rate=solution.predictions["range_rate"],
        position=solution.position_ecef,
        velocity=solution.velocity_ecef,
    )


@pytest.mark.skipif(not COMPILED, reason="needs numba to compare with")
def test_plain_kernels_agree_with_the_compiled_ones(tmp_path: Path) -> None:
    navigate(tmp_path / "compiled.npz")
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join([str(CHECKOUT), *sys.path])}
    subprocess.run([sys.executable, __file__, str(tmp_path / "plain.npz")], check=True, env=environment, timeout=120)
    with np.load(tmp_path / "compiled.npz") as compiled, np.load(tmp_path / "plain.npz") as plain:
        assert compiled["compiled"]
        assert not plain["compiled"]
        assert len(compiled["satellite"]) > 20
        for name, tolerance in (
            ("satellite", 1e-6),
            ("satellite_clock", 1e-17),
            ("pseudorange", 1e-6),
            ("range_rate", 1e-9),
            ("position", 1e-5),
            ("velocity", 1e-8),
        ):
            np.testing.assert_allclose(compiled[name], plain[name], rtol=0.0, atol=tolerance, err_msg=name)


if __name__ == "__main__":
    navigate(Path(sys.argv[1]))
