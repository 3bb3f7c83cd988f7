"""What the package says about itself agrees, and what it promises exists."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import xml.etree.ElementTree
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import pytest
import yaml

import eskf_ros

CHECKOUT = Path(__file__).resolve().parents[2]
# Import name -> name in package indices, where they differ.
DISTRIBUTIONS = {"yaml": "pyyaml", "ruamel": "ruamel.yaml"}
# ROS packages: rosdep keys by their own name; those that are on PyPI come with the extra [ros].
ROS_PACKAGES = {
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "launch",
    "launch_ros",
    "nav_msgs",
    "rcl_interfaces",
    "rclpy",
    "sensor_msgs",
    "std_srvs",
    "tf2_msgs",
}
# Imported by the tests alone.
ROS_TEST_PACKAGES = {"rosgraph_msgs", "std_msgs"}
# Programs of ROS that tests call.
ROS_TEST_TOOLS = {"ament_copyright", "ament_flake8", "ament_pep257", "ament_xmllint"}
ADDRESS = "https://github.com/eskf-ros/eskf_ros"
# Used where somebody else has installed it.
OPTIONAL = {"bokeh", "distributed", "evo", "pandas", "robot_localization", "pygeomag"}
# What `eskf_calibrate --static` imports when it is asked for: the extra [calibrate].
CALIBRATE = {"allantools", "matplotlib"}
# Import name -> rosdep key that brings it, where it is not python3-NAME.
ROSDEP_KEYS = {
    "lz4": "mcap-ros2-support",
    "mcap": "mcap-ros2-support",
    "rosbags": "python3-rosbags-pip",
    "ruamel": "python3-ruamel.yaml",
    "zstandard": "mcap-ros2-support",
}


class SetupArguments(dict[str, object]):
    """The literal keyword arguments of the setup() call in setup.py."""

    def __init__(self) -> None:
        module = ast.parse((CHECKOUT / "setup.py").read_text(encoding="utf-8"))
        call = next(
            node for node in ast.walk(module) if isinstance(node, ast.Call) and ast.unparse(node.func) == "setup"
        )
        super().__init__()
        for keyword in call.keywords:
            try:
                self[str(keyword.arg)] = ast.literal_eval(keyword.value)
            except ValueError:
                self[str(keyword.arg)] = ast.unparse(keyword.value)


SETUP = SetupArguments()
PACKAGE_XML = xml.etree.ElementTree.parse(CHECKOUT / "package.xml").getroot()


def imports_of(paths: Iterable[Path]) -> set[str]:
    """Top-level names of all that these files import."""
    names: set[str] = set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                names.add(node.module.split(".")[0])
    return names


def third_party_imports() -> set[str]:
    """What the package and its launch files import, but for Python's and the package's own."""
    names = imports_of([*(CHECKOUT / "eskf_ros").rglob("*.py"), *(CHECKOUT / "launch").glob("*.py")])
    return names - set(sys.stdlib_module_names) - OPTIONAL - CALIBRATE - {"eskf_ros"}


def third_party_imports_of_tests() -> set[str]:
    """The same for the tests, and for what they borrow from the benchmarks."""
    benchmarks = {path.stem: path for path in (CHECKOUT / "benchmark").glob("*.py")}
    tests = {path.stem: path for path in (CHECKOUT / "test").rglob("*.py")}
    files = set(tests.values())
    while borrowed := {benchmarks[name] for name in imports_of(files) & (benchmarks.keys() - tests.keys())} - files:
        files |= borrowed
    folders = {path.parent.name for path in (CHECKOUT / "benchmark").glob("*/__init__.py")}
    own = {"eskf_ros", "support", *folders, *benchmarks, *tests}
    return imports_of(files) - set(sys.stdlib_module_names) - OPTIONAL - own


def distributions(lines: Iterable[str]) -> set[str]:
    """The names in requirements."""
    return {re.split(r"[<>=\[; ]", line)[0] for line in lines}


def dependencies(*tags: str) -> set[str | None]:
    """The rosdep keys of package.xml under these tags."""
    return {element.text for tag in tags for element in PACKAGE_XML.findall(tag)}


def test_one_version_everywhere() -> None:
    assert SETUP["version"] == eskf_ros.__version__
    assert PACKAGE_XML.findtext("version") == eskf_ros.__version__
    changelog = (CHECKOUT / "CHANGELOG.rst").read_text(encoding="utf-8")
    newest = re.search(r"^(\d+\.\d+\.\d+) \(\d{4}-\d\d-\d\d\)$", changelog, re.MULTILINE)
    assert newest is not None
    assert newest.group(1) == eskf_ros.__version__
    citation = yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == eskf_ros.__version__
    assert f"{citation['version']} ({citation['date-released']})" in changelog


def test_one_address_everywhere() -> None:
    """Where to find the project and whom to write to: the same in all files, and nobody's example."""
    urls = {element.get("type"): element.text for element in PACKAGE_XML.findall("url")}
    assert urls == {"website": ADDRESS, "repository": ADDRESS, "bugtracker": f"{ADDRESS}/issues"}
    assert SETUP["url"] == ADDRESS
    people = [*PACKAGE_XML.findall("maintainer"), *PACKAGE_XML.findall("author")]
    assert {element.get("email") for element in people} == {SETUP["maintainer_email"]} == {SETUP["author_email"]}
    assert len(people) == 2
    assert yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))["repository-code"] == ADDRESS
    for path in ("package.xml", "setup.py", "CITATION.cff", "README.md", "CONTRIBUTING.md"):
        assert "example.org" not in (CHECKOUT / path).read_text(encoding="utf-8")


@pytest.mark.parametrize("form", sorted((CHECKOUT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda f: f.stem)
def test_forms_for_issues_ask_for_what_an_answer_needs(form: Path) -> None:
    text = form.read_text(encoding="utf-8")
    fields = yaml.safe_load(text).get("body", [])
    needed = {field["id"] for field in fields if field.get("validations", {}).get("required")}
    if form.stem == "estimate":
        assert needed >= {"check", "summary", "parameters"}
    for command in re.findall(r"`(eskf_\w+) ", text):
        assert any(line.startswith(f"{command} = ") for line in entry_points()), f"{form.name} names {command}"


def test_ci_runs_the_scripts_that_are_here() -> None:
    workflow = yaml.safe_load((CHECKOUT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    runs = [step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step]
    assert ".ci/run" in runs
    for path in {path for run in runs for path in re.findall(r"\.ci/\w+", run)}:
        assert (CHECKOUT / path).is_file(), f"ci.yml runs {path}"


def test_installed_version() -> None:
    try:
        installed = metadata.version("eskf_ros")
    except metadata.PackageNotFoundError:
        pytest.skip("eskf_ros is not installed here, only on the path")
    assert installed == eskf_ros.__version__


def test_names_and_licence_agree() -> None:
    assert PACKAGE_XML.findtext("name") == eskf_ros.__name__
    assert PACKAGE_XML.findtext("export/build_type") == "ament_python"
    assert PACKAGE_XML.findtext("license") == SETUP["license"] == "Apache-2.0"
    assert "Apache License" in (CHECKOUT / "LICENSE").read_text(encoding="utf-8")
    assert (CHECKOUT / "resource" / eskf_ros.__name__).is_file()


def test_every_import_is_declared_for_pip_and_for_rosdep() -> None:
    required = distributions(SETUP["install_requires"])  # type: ignore[arg-type]
    extras: dict[str, list[str]] = SETUP["extras_require"]  # type: ignore[assignment]
    assert set(extras["calibrate"]) == CALIBRATE
    keys = dependencies("exec_depend")
    imported = third_party_imports()
    assert keys >= ROS_PACKAGES <= imported
    for name in imported - ROS_PACKAGES:
        assert DISTRIBUTIONS.get(name, name) in required, f"{name} is imported, but setup.py does not require it"
        key = ROSDEP_KEYS.get(name, f"python3-{name}")
        assert key in keys, f"{name} is imported, but package.xml has no exec_depend {key}"


def test_every_import_of_the_tests_is_declared() -> None:
    """Nothing that is only there because a benchmark draws, or because another package happens to bring it."""
    extras: dict[str, list[str]] = SETUP["extras_require"]  # type: ignore[assignment]
    required = distributions([*SETUP["install_requires"], *extras["test"]])  # type: ignore[misc]
    imported = third_party_imports_of_tests()
    assert dependencies("exec_depend", "test_depend") >= ROS_PACKAGES | ROS_TEST_PACKAGES | ROS_TEST_TOOLS
    for name in imported - ROS_PACKAGES - ROS_TEST_PACKAGES:
        assert DISTRIBUTIONS.get(name, name) in required, f"the tests import {name}; setup.py does not require it"


def test_what_readme_does_with_launch_files_is_declared() -> None:
    assert "ros2 launch eskf_ros" in (CHECKOUT / "README.md").read_text(encoding="utf-8")
    assert "ros2launch" in dependencies("exec_depend")


def entry_points() -> list[str]:
    return list(SETUP["entry_points"]["console_scripts"])  # type: ignore[index, call-overload]


@pytest.mark.parametrize("line", entry_points())
def test_commands_start_and_explain_themselves(line: str) -> None:
    _, _, target = line.partition(" = ")
    module, _, function = target.partition(":")
    assert callable(getattr(importlib.import_module(module), function))
    code = f"import sys; from {module} import {function}; sys.exit({function}())"
    command = [sys.executable, "-c", code, "--help"]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == 0, result.stderr
    assert "usage" in result.stdout.lower()


def test_installed_files_exist() -> None:
    for folder in ("config", "bags", "launch"):
        assert f"glob('{folder}/*" in str(SETUP["data_files"])
    assert (CHECKOUT / "config" / "eskf.yaml").is_file()
    assert (CHECKOUT / "config" / "tunnel_drive.yaml").is_file()
    assert (CHECKOUT / "launch" / "eskf.launch.py").is_file()
    assert (CHECKOUT / "launch" / "replay.launch.py").is_file()
    for path in re.findall(r"'([^'*]+\.(?:xml|yaml|mcap))'", str(SETUP["data_files"])):
        assert (CHECKOUT / path).is_file()


def test_files_the_commands_of_run_need() -> None:
    script = (CHECKOUT / "run").read_text(encoding="utf-8")
    named = re.findall(r"(?:bags|config)/[\w.]+", script)
    assert named
    for path in named:
        assert (CHECKOUT / path).is_file(), f"run names {path}"


@pytest.mark.parametrize("path", ["run", ".ci/run", ".ci/colcon", ".ci/jazzy", ".ci/release"])
def test_scripts_are_executable(path: str) -> None:
    assert (CHECKOUT / path).stat().st_mode & 0o111
    subprocess.run(["bash", "-n", CHECKOUT / path], check=True)


def test_run_refuses_a_python_that_is_too_old(tmp_path: Path) -> None:
    old = tmp_path / "python"
    old.write_text('#!/bin/sh\ncase "$2" in *exit*) exit 1;; *) echo 3.8.10;; esac\n')
    old.chmod(0o755)
    for python, said in ((str(old), "is Python 3.8.10, 3.10 or newer"), (str(tmp_path / "none"), "no Python found")):
        result = subprocess.run(
            [CHECKOUT / "run", "demo"],
            env={"PATH": "/usr/bin:/bin", "PYTHON": python},
            capture_output=True,
            text=True,
            check=False,
        )
        assert result.returncode == 1
        assert said in result.stderr


def test_run_without_a_verb_explains_itself() -> None:
    result = subprocess.run([CHECKOUT / "run"], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "./run demo" in result.stdout
    assert "./run test" in result.stdout


def test_only_the_simulator_imports_the_simulator():
    """A robot needs none of it: what node and replay share with it stands elsewhere."""
    package = Path(eskf_ros.__file__).parent
    importers = []
    for source in sorted(package.rglob("*.py")):
        if source.is_relative_to(package / "simulate"):
            continue
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.ImportFrom):
                names += [f"{node.module}.{alias.name}" for alias in node.names]
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if any(name.startswith("eskf_ros.simulate") for name in names):
                importers.append(source.relative_to(package).as_posix())
    assert not importers
