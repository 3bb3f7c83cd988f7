"""The launch files: what they name exists, and, where ROS's launch is installed, they do what they say."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from eskf_ros.filter.warm_up import compile_kernels
from eskf_ros.parameters.mapping import leaves
from eskf_ros.replay.main import main as replay
from support.ros_process import Process, Ros

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "tunnel_drive.yaml"
LEVER_ARM = [0.8, -0.2, 1.4]
BAG = ROOT / "bags" / "tunnel_drive.mcap"

needs_launch = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("rclpy", "launch_ros")),
    reason="needs launch_ros, which is not on PyPI: source a ROS 2 installation",
)

LIKE_ROS2_LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
file, *arguments = sys.argv[1:]
service = LaunchService(argv=arguments)
included = IncludeLaunchDescription(
    PythonLaunchDescriptionSource(file), launch_arguments=[argument.split(":=") for argument in arguments]
)
service.include_launch_description(LaunchDescription([included]))
sys.exit(service.run())
"""

WITH_COMPANION = """
from launch import LaunchDescription
from launch.actions import ExecuteProcess, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import SetRemap

def generate_launch_description():
    included = IncludeLaunchDescription(PythonLaunchDescriptionSource({file!r}), launch_arguments={arguments!r})
    return LaunchDescription([
        GroupAction([SetRemap("imu/data", "/chassis/imu"), included]),
        ExecuteProcess(cmd=[{python!r}, "-c", "import time; time.sleep(60)"], name="companion", output="screen"),
    ])
"""


def arguments_of(file: str) -> dict[str, dict[str, Any]]:
    """The literal keywords of each DeclareLaunchArgument whose name is literal; needs no launch."""
    arguments = {}
    for node in ast.walk(ast.parse((ROOT / "launch" / file).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "DeclareLaunchArgument":
            name, keywords = ast.unparse(node.args[0]), {str(k.arg): k.value for k in node.keywords}
            arguments[name.strip("'")] = {
                key: ast.literal_eval(value)
                for key, value in keywords.items()
                if isinstance(value, (ast.Constant, ast.List))
            }
    return arguments


def test_the_transforms_to_choose_from_are_those_of_the_parameter():
    (parameter,) = [leaf for leaf in leaves() if leaf.name == "output.tf"]
    choices = arguments_of("eskf.launch.py")["tf"]["choices"]
    assert "|".join(choices[1:]) == parameter.rule.pattern
    assert choices[0] == ""


def test_the_arguments_of_the_replay_are_options_of_the_command(capsys):
    (options,) = [
        ast.literal_eval(node.value)
        for node in ast.parse((ROOT / "launch" / "replay.launch.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "OPTIONS"
    ]
    with pytest.raises(SystemExit):
        replay(["--help"])
    described = capsys.readouterr().out
    assert options
    for name in options:
        assert f" --{name} " in described


@pytest.fixture
def ros() -> Iterator[Ros]:
    with Ros() as observer:
        yield observer


@pytest.fixture
def launch(ros: Ros, tmp_path: Path) -> Callable[..., Process]:
    """Start a launch file of the checkout, or another one, as `ros2 launch` does."""
    compile_kernels()  # or the node would, while the test waits
    prefix = tmp_path / "prefix"
    executables, share = prefix / "lib" / "eskf_ros", prefix / "share" / "eskf_ros"
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    for folder in (executables, share, index):
        folder.mkdir(parents=True)
    (index / "eskf_ros").touch()
    for command, room in (("node", "ros_node"), ("replay", "replay")):
        script = executables / f"eskf_{command}"
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m eskf_ros.{room}.main "$@"\n')
        script.chmod(0o755)
    prefixes = os.pathsep.join(filter(None, [str(prefix), os.environ.get("AMENT_PREFIX_PATH")]))

    def start(file: str | Path, **arguments: object) -> Process:
        words = [f"{name}:={value}" for name, value in arguments.items()]
        command = [sys.executable, "-c", LIKE_ROS2_LAUNCH, ROOT / "launch" / file, *words]
        return ros.spawn(command, {"AMENT_PREFIX_PATH": prefixes})

    return start


def ask(ros: Ros, node: str, *names: str) -> list[Any]:
    """Values of parameters of a running node; waits until it is there."""
    from rcl_interfaces.srv import GetParameters
    from rclpy.parameter import parameter_value_to_python

    client = ros.node.create_client(GetParameters, f"{node}/get_parameters")
    ros.until(client.service_is_ready, 60.0, f"the parameters of {node}")
    answer = client.call_async(GetParameters.Request(names=list(names)))
    ros.until(answer.done, 60.0, "the parameters")
    values = [parameter_value_to_python(value) for value in answer.result().values]
    return [value.tolist() if hasattr(value, "tolist") else value for value in values]


def end(launch: Process) -> None:
    """SIGINT ends launch and node in good order."""
    assert launch.stop() == 0
    assert "process has finished cleanly" in launch.output, launch.output
    assert "Traceback" not in launch.output


@needs_launch
def test_the_arguments_reach_the_node(ros, launch):
    running = launch(
        "eskf.launch.py", namespace="robot", params_file=CONFIG, use_sim_time="True", tf="none", log_level="debug"
    )
    names = ("gnss.lever_arm", "use_sim_time", "output.tf")
    assert ask(ros, "/robot/eskf_node", *names) == [LEVER_ARM, True, "none"]
    ros.until(lambda: ros.node.count_publishers("/robot/odometry/global"), what="odometry of the robot")
    ros.until(lambda: ros.node.count_subscribers("/robot/imu/data"), what="the node to listen")
    assert "[DEBUG]" in running.output
    end(running)


@needs_launch
def test_without_arguments_the_node_runs_on_its_defaults(ros, launch):
    running = launch("eskf.launch.py")
    default = {leaf.name: leaf.default for leaf in leaves()}["output.tf"]
    assert ask(ros, "/eskf_node", "use_sim_time", "output.tf") == [False, default]
    ros.until(lambda: "ready" in running.output, 60.0, "the node to be ready")
    assert "[DEBUG]" not in running.output
    end(running)


@needs_launch
def test_an_argument_counts_more_than_the_file_however_the_file_names_the_node(ros, launch, tmp_path):
    """Both keys of the file match the node; an argument that is not given leaves what the file says."""
    file = tmp_path / "robot.yaml"
    file.write_text(
        "/**: {ros__parameters: {output.tf: full}}\n"
        "/robot/eskf_node: {ros__parameters: {output.tf: map_to_odom, use_sim_time: true}}\n"
    )
    running = launch("eskf.launch.py", namespace="robot", params_file=file, tf="none")
    assert ask(ros, "/robot/eskf_node", "output.tf", "use_sim_time") == ["none", True]
    end(running)


@needs_launch
def test_a_launch_file_that_includes_it_can_remap(ros, launch, tmp_path):
    file = tmp_path / "robot.launch.py"
    included = str(ROOT / "launch" / "eskf.launch.py")
    file.write_text(WITH_COMPANION.format(file=included, arguments=[("namespace", "robot")], python=sys.executable))
    running = launch(file)
    ros.until(lambda: ros.node.count_subscribers("/chassis/imu"), 60.0, "the node to listen to the other topic")
    assert running.stop() == 0


@needs_launch
def test_a_parameter_file_that_is_not_there_is_named_and_nothing_runs(launch, tmp_path):
    """launch_ros itself would warn and let the robot drive on the defaults."""
    running = launch("eskf.launch.py", params_file=tmp_path / "robot.yaml")
    assert running.popen.wait(30) == 1
    assert str(tmp_path / "robot.yaml") in running.output
    assert "process started" not in running.output


@needs_launch
def test_a_replay_gets_its_options_and_ends_the_launch(launch, tmp_path):
    running = launch("replay.launch.py", bag=BAG, config=CONFIG, out=tmp_path, truth="truth")
    assert running.popen.wait(120) == 0
    summary = json.loads((tmp_path / "tunnel_drive_eskf" / "summary.json").read_text())
    # With the parameters of the file, and against the truth.
    assert summary["error"]["horizontal"]["p50"] < 0.3


@needs_launch
def test_a_replay_that_fails_ends_everything_launched_with_it_and_shows_in_the_exit_code(launch, tmp_path):
    file = tmp_path / "study.launch.py"
    arguments = [("bag", str(tmp_path / "no_bag"))]
    included = str(ROOT / "launch" / "replay.launch.py")
    file.write_text(WITH_COMPANION.format(file=included, arguments=arguments, python=sys.executable))
    running = launch(file)
    assert running.popen.wait(60) == 1
    assert "no_bag" in running.output
    assert "exit code 2" in running.output
    assert "sending signal 'SIGINT' to process[companion" in running.output
