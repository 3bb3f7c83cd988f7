"""Compiling all kernels before they are needed: at the start of the node, or where an image is built."""

from __future__ import annotations

import numpy as np

from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.warm_up import compile_kernels
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.inputs.epochs import compile_ranges
from eskf_ros.parameters.tree import Parameters
from eskf_ros.ros_node.odometry import NUMBERS, fill_odometry


def compile_node(parameters: Parameters, with_ranges: bool) -> None:
    """Compile every kernel that a node calls, or load it from the cache: nothing of it is left for a callback.

    ``with_ranges``: those that take satellites' ranges too.
    """
    compile_kernels()
    if with_ranges:
        compile_ranges(parameters)
    fill_odometry(allocate(ODOMETRY), 0, False, np.zeros((2, NUMBERS)))
    MapFrame((0.0, 0.0, 0.0)).to_geodetic_deg(np.zeros(3))
