"""A replay: `ros2 launch eskf_ros replay.launch.py bag:=my_bag`; `--show-args` lists the arguments.

Everything launched with it ends when the replay does; `ros2 launch` returns 0, or 1 if the replay failed.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.substitutions import ExecutableInPackage

OPTIONS = {
    "config": "Parameter file of the node; empty: the defaults.",
    "out": "Folder for the results; empty: next to the bag.",
    "truth": "Topic to compare with; empty: none.",
}


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="The recording: a rosbag2 directory, an .mcap or a .db3 file."),
            *(DeclareLaunchArgument(name, default_value="", description=text) for name, text in OPTIONS.items()),
            OpaqueFunction(function=start_replay),
        ]
    )


def start_replay(context: LaunchContext) -> list[ExecuteProcess]:
    """`eskf_replay` with the options that are not empty."""
    command = [ExecutableInPackage("eskf_replay", "eskf_ros"), LaunchConfiguration("bag")]
    for name in OPTIONS:
        if LaunchConfiguration(name).perform(context):
            command += [f"--{name}", LaunchConfiguration(name)]
    return [ExecuteProcess(cmd=command, output="screen", on_exit=end_launch)]


def end_launch(event: ProcessExited, context: LaunchContext) -> Shutdown:
    """An exception ends the launch in good order too, and is the only way to make it return 1."""
    if event.returncode != 0:
        raise RuntimeError(f"eskf_replay ended with exit code {event.returncode}")
    return Shutdown(reason="the replay has ended")
