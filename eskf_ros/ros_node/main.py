"""The command `eskf_node`."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

from eskf_ros.ros_node.process import StartError, StopFlag, run

USAGE = """\
usage: eskf_node [--profile NAME] [--ros-args --params-file FILE -p NAME:=VALUE -r FROM:=TO ...]

Error-state Kalman filter: imu/data and gps/fix (gps/vel) in, odometry/global and odometry/local out at IMU rate.
config/eskf.yaml lists every parameter. --profile takes those for a kind of robot (car, mower, vessel ...; see
docs/profiles.md); what is given after --ros-args goes before them.

       eskf_node --compile

Compile the estimator for this processor and end: the next start, of this user, takes a second instead of a minute
(for the build of an image; needs no ROS). NUMBA_CACHE_DIR says where the machine code is kept. colcon build and
pip install from source do it by themselves.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return 0, or 2 if an argument or a parameter cannot be used."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if words and words[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0
    if words == ["--compile"]:
        return _compile()
    stop = StopFlag()
    try:
        from rclpy.executors import ExternalShutdownException  # noqa: F401 - tells whether ROS is there
    except ImportError:
        print(
            "eskf_node: rclpy is not there: source a ROS 2 installation, or pip install eskf_ros[ros]",
            file=sys.stderr,
        )
        return 2
    from eskf_ros.parameters.schema import ParameterError

    try:
        profile, others = taken_profile(sys.argv if arguments is None else words)
        run(partial(_create, profile), stop, others)
    except (ParameterError, StartError) as error:
        print(f"eskf_node: {error}", file=sys.stderr)
        return 2
    return 0


def taken_profile(words: Sequence[str]) -> tuple[str, list[str]]:
    """Return the NAME of `--profile NAME`, empty without, and the other arguments.

    It is not given to ROS as one more parameter file: there the order of files and arguments decides, here it is below
    all of them.
    """
    if "--profile" not in words:
        return "", list(words)
    place = list(words).index("--profile")
    return (words[place + 1] if place + 1 < len(words) else "?"), [*words[:place], *words[place + 2 :]]


def _compile() -> int:
    """Compile all that a node calls, in both modes, and print where the machine code is."""
    from eskf_ros.compiled import CACHE_FOLDER, COMPILED, sentence_on_compiling, while_compiling

    def say(text: str) -> None:
        print(f"eskf_node: {text}", flush=True)

    if not COMPILED:
        print("eskf_node: numba is missing or switched off: there is nothing to compile", file=sys.stderr)
        return 2
    import numpy as np

    from eskf_ros.geodesy.map_frame import to_geodetic
    from eskf_ros.parameters.tree import Parameters
    from eskf_ros.replay.tum_writer import tum_text
    from eskf_ros.ros_node.warm_up import compile_node

    with while_compiling(sentence_on_compiling(say)):
        compile_node(Parameters(), with_ranges=True)
        # The replay is another command of the same package.
        tum_text(np.zeros(1, np.int64), np.zeros((1, 7)))
        to_geodetic(np.zeros((1, 3)))
    say(f"compiled; the machine code is in {CACHE_FOLDER or os.environ.get('NUMBA_CACHE_DIR')}")
    return 0


def _create(profile: str) -> Any:
    from rclpy.exceptions import ParameterException

    from eskf_ros.ros_node.node import EskfNode

    try:
        return EskfNode(profile=profile)
    except (ParameterException, RuntimeError) as error:
        # Wrong parameters of rclpy itself, such as qos_overrides, and invalid names.
        raise StartError(error) from error


if __name__ == "__main__":
    sys.exit(main())
