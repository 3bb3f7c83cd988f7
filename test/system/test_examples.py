"""The examples run, and show what they say."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import eskf_ros

CHECKOUT = Path(__file__).resolve().parents[2]
EXAMPLES = CHECKOUT / "examples"


def test_numpy_arrays(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "numpy_arrays.py"), run_name="__main__")
    assert "fixes fused" in capsys.readouterr().out


def test_a_bag_gives_the_messages_that_its_arrays_give() -> None:
    by_bag = runpy.run_path(str(EXAMPLES / "a_bag.py"))["main"]()
    by_arrays = runpy.run_path(str(EXAMPLES / "numpy_arrays.py"))["main"]()
    fixes = [result.summary["aids"]["gnss_position"]["offered"] for result in (by_bag, by_arrays)]
    assert fixes[0] == fixes[1]
    assert by_bag.summary["aids"]["gnss_velocity"]["fused"] > 800
    np.testing.assert_array_equal(by_bag.odometry["stamp"], by_arrays.odometry["stamp"])


def test_two_configurations_are_compared(tmp_path: Path) -> None:
    picture = tmp_path / "compared.png"
    results = runpy.run_path(str(EXAMPLES / "compare_configurations.py"))["main"](picture)
    assert picture.stat().st_size > 10_000
    nis = [float(np.nanmean(result.innovations["nis"])) for result in results.values()]
    assert nis[1] > nis[0], "without the lever arm the innovations are larger, though it is found"
    named = [[text for text in result.warnings if "gnss.lever_arm" in text] for result in results.values()]
    assert [len(texts) for texts in named] == [0, 1]


@pytest.fixture(scope="module")
def patched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the package that knows the measurement of the example."""
    folder = tmp_path_factory.mktemp("patched")
    runpy.run_path(str(EXAMPLES / "own_measurement.py"))["patched_package"](folder)
    return folder


def uncompiled(patched: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(patched), "NUMBA_DISABLE_JIT": "1"}


def test_an_own_measurement_holds_the_position() -> None:
    command = [sys.executable, str(EXAMPLES / "own_measurement.py")]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    errors = [abs(float(line.split(": ")[1].split()[0])) for line in lines]
    assert errors[0] > 2.0
    assert errors[1] < 0.5
    fused, offered = map(int, re.findall(r"(\d+) of (\d+) ranges", lines[1])[0])
    assert offered == 200
    assert fused > 0.8 * offered
    # 168 values of chi-square / n scatter by 0.11 about 1.
    assert 0.67 < float(lines[1].split()[-1]) < 1.33


def test_an_own_measurement_keeps_the_contract(patched: Path) -> None:
    """The contract test of the rows, on the patched package: Jacobian, gate, documentation, message."""
    tests, settings = CHECKOUT / "test" / "unit" / "test_measurement_rows.py", CHECKOUT / "pyproject.toml"
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-k",
        "beacon_range",
        "-c",
        str(settings),
    ]
    # From the folder of the copy: there Python finds it before the checkout.
    done = subprocess.run([*command, str(tests)], env=uncompiled(patched), cwd=patched, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    # Jacobian with four seeds, gate, parameters and messages.
    assert "7 passed" in done.stdout


def test_adding_a_measurement_takes_four_edits_of_two_files() -> None:
    edits = runpy.run_path(str(EXAMPLES / "own_measurement.py"))["EDITS"]
    assert len(edits) == 4
    assert {name for name, _, _ in edits} == {"filter/state/enums.py", "filter/fuse.py"}
    guide = (CHECKOUT / "docs" / "add_a_measurement.md").read_text(encoding="utf-8")
    for name, _, addition in edits:
        assert f"eskf_ros/{name}" in guide
        assert all(line.strip() in guide for line in addition.splitlines())
    assert Path(eskf_ros.__file__).parent.name == "eskf_ros"
