"""What the source distribution and the wheel hold: all that is needed, nothing that was left lying about.

That a clean installation of each runs the demo is in `.ci/release`, for it needs the network.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib import metadata, util
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
NOT_SOURCES = (".git", ".venv*", "__pycache__", "*.egg-info", "build", "dist", "install", "log", "results", "*_eskf")
NOT_SOURCES += (".hypothesis", ".mypy_cache", ".pytest_cache", ".ruff_cache", "site")
INSTALLED = ("bags", "config", "launch")
"""Folders that are installed below share/eskf_ros."""
LEAST_SETUPTOOLS = (70, 1)
"""Older ones need the package wheel to make a wheel."""


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout with what a developer leaves lying about in it."""
    copy = tmp_path_factory.mktemp("sources") / "eskf_ros"
    shutil.copytree(CHECKOUT, copy, ignore=shutil.ignore_patterns(*NOT_SOURCES))
    for left in (
        "results/old/summary.json",
        "bags/tunnel_drive_eskf/summary.json",
        "eskf_ros/__pycache__/a.cpython.pyc",
    ):
        (copy / left).parent.mkdir(parents=True, exist_ok=True)
        (copy / left).write_text("{}")
    return copy


def build(sources: Path, kind: str) -> Path:
    """Build a distribution as pip does, for every processor."""
    code = f"import build_backend; print(build_backend.build_{kind}('out'))"
    environment = {**os.environ, "ESKF_ROS_COMPILE": "0", "PYTHONPATH": ""}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=sources, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return sources / "out" / result.stdout.split()[-1]


def files_below(sources: Path, *folders: str, suffix: str = "") -> set[str]:
    """Files that the checkout has in these folders, relative to it."""
    paths = {path for folder in folders for path in (sources / folder).rglob(f"*{suffix}") if path.is_file()}
    left = {path for path in paths if path.suffix == ".pyc" or any(part.endswith("_eskf") for part in path.parts)}
    return {path.relative_to(sources).as_posix() for path in paths - left}


def test_the_sdist_has_what_builds_tests_and_explains_the_package(sources: Path) -> None:
    with tarfile.open(build(sources, "sdist")) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    folders = (".ci", "bags", "benchmark", "config", "docs", "eskf_ros", "examples", "launch", "resource", "test")
    wanted = files_below(sources, *folders)
    wanted |= {
        "package.xml",
        "setup.py",
        "setup.cfg",
        "pyproject.toml",
        "build_backend.py",
        "run",
        "LICENSE",
        "README.md",
    }
    wanted |= {"CHANGELOG.rst", "CITATION.cff", "CONTRIBUTING.md", "QUALITY_DECLARATION.md"}
    assert not wanted - names
    assert not [name for name in names if name.endswith(".pyc") or "_eskf/" in name or name.startswith("results")]


def test_the_wheel_has_package_commands_and_data_and_fits_every_processor(sources: Path) -> None:
    version = tuple(int(part) for part in metadata.version("setuptools").split(".")[:2])
    if version < LEAST_SETUPTOOLS and util.find_spec("wheel") is None:
        pytest.skip("needs setuptools 70.1 or newer, or the package wheel")
    path = build(sources, "wheel")
    assert path.name.endswith("-py3-none-any.whl")
    assert path.stat().st_size < 8e6
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        texts = {name.rpartition("/")[2]: archive.read(name).decode() for name in names if ".dist-info/" in name}
    assert {name for name in names if name.startswith("eskf_ros/")} >= files_below(sources, "eskf_ros", suffix=".py")
    share = {name.partition("/share/eskf_ros/")[2] for name in names if "/share/eskf_ros/" in name}
    assert share == files_below(sources, *INSTALLED) | {"package.xml"}
    assert any(name.endswith("share/ament_index/resource_index/packages/eskf_ros") for name in names)
    tops = {name.partition("/")[0].partition("-")[0].partition(".")[0] for name in names}
    assert tops == {"eskf_ros"}, "tests and benchmarks are no part of what is installed"
    assert not [name for name in names if "machine_code" in name or name.endswith((".pyc", ".so", ".nbc", ".nbi"))]
    assert "eskf_node = eskf_ros.ros_node.main:main" in texts["entry_points.txt"]
    assert "License" in texts["METADATA"]
    assert any("LICENSE" in name for name in names)
