"""The node: `ros2 launch eskf_ros eskf.launch.py params_file:=my_robot.yaml`; `--show-args` lists the arguments.

The node's topic names are relative: `namespace` moves them, and a launch file that includes this one can remap them,
GroupAction([SetRemap("imu/data", "/imu"), IncludeLaunchDescription(...)]).
"""

from pathlib import Path
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            # Not config/eskf.yaml: it gives the sensors places, which then are no longer looked up in /tf_static.
            DeclareLaunchArgument(
                "params_file", default_value="", description="Parameters of the node, a YAML file; empty: the defaults."
            ),
            DeclareLaunchArgument(
                "profile", default_value="", description="Parameters for a kind of robot, below those of params_file."
            ),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node and its topics."),
            DeclareLaunchArgument(
                "use_sim_time", default_value="", description="true: time from /clock; empty: as in params_file."
            ),
            DeclareLaunchArgument(
                "tf",
                default_value="",
                choices=["", "full", "map_to_odom", "none"],
                description="Transforms to publish, parameter output.tf; empty: as in params_file.",
            ),
            DeclareLaunchArgument(
                "log_level",
                default_value="info",
                choices=["debug", "info", "warn", "error", "fatal"],
                description="Least severity that is logged.",
            ),
            OpaqueFunction(function=start_node),
        ]
    )


def start_node(context: LaunchContext) -> list[Node]:
    """The node with the parameters of the file, and in their place those given as arguments."""
    params_file = LaunchConfiguration("params_file").perform(context)
    if params_file and not Path(params_file).is_file():  # launch_ros would warn and run the robot on the defaults
        raise FileNotFoundError(f"params_file: there is no file {params_file}")
    profile = LaunchConfiguration("profile").perform(context)
    parameters: list[Any] = [params_file] if params_file else []
    for argument, parameter, kind in (("use_sim_time", "use_sim_time", bool), ("tf", "output.tf", str)):
        if LaunchConfiguration(argument).perform(context):
            parameters.append({parameter: ParameterValue(LaunchConfiguration(argument), value_type=kind)})
    return [
        Node(
            package="eskf_ros",
            executable="eskf_node",
            name="eskf_node",
            namespace=LaunchConfiguration("namespace"),
            arguments=["--profile", profile] if profile else [],
            parameters=parameters,
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
        )
    ]
