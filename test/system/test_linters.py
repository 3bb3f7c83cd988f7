"""The linters of ament, which a package of ROS is looked at with; where they are not installed, ruff has to do.

Of ament_copyright only what it says of LICENSE and CONTRIBUTING.md counts: it wants the whole header of the licence in
each source file, too, and LICENSE covers them all.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
SOURCES = ["eskf_ros", "launch", "examples", "setup.py", "build_backend.py"]
# Which descriptions are needed at all is left to test_structure.py. A first line may be a question (D415 for D400),
# may name what is returned (D401), and a property called `rate` may begin with "Rate (Hz)" (D402).
DOCSTRINGS = ["--convention", "pep257", "--add-select", "D415", "--add-ignore", "D400", "D401", "D402"]
DOCSTRINGS += [f"D10{number}" for number in range(8)]


def lint(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a linter of ament on the checkout; skips where there is none."""
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"needs {name}, which is not on PyPI: source a ROS 2 installation")
    code = f"import sys; from {name}.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)


def test_ament_flake8() -> None:
    result = lint("ament_flake8", "--config", ".flake8", *SOURCES)
    assert result.returncode == 0, result.stdout + result.stderr


def test_ament_pep257() -> None:
    result = lint("ament_pep257", *DOCSTRINGS, "--", *SOURCES)
    assert result.returncode == 0, result.stdout + result.stderr


def test_ament_xmllint() -> None:
    if shutil.which("xmllint") is None:
        pytest.skip("needs the program xmllint (libxml2-utils)")
    result = lint("ament_xmllint", "package.xml")
    if "failed to load" in result.stdout + result.stderr:
        pytest.skip("needs the network: the schema of package.xml is at download.ros.org")
    assert result.returncode == 0, result.stdout + result.stderr


def test_ament_copyright_knows_the_licence() -> None:
    result = lint("ament_copyright", "--verbose", ".")
    told = (result.stdout + result.stderr).splitlines()
    assert "LICENSE: apache2" in told
    assert "CONTRIBUTING.md: apache2" in told
