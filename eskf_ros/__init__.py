"""Error-state Kalman filter fusing an IMU with GNSS: a ROS 2 package and a replay tool for recordings.

For arrays in memory, imported when they are asked for: `run`, `Filter`, `Result` and `Smoothed` of `eskf_ros.api`;
`read_bag`, a recording as tables; `check`, what is wrong with a recording; `calibrate`, how the sensors are installed;
`load_parameters`, a ROS 2 parameter file.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from eskf_ros.api import Filter, Result, Smoothed, run
    from eskf_ros.calibration.calibrate import calibrate
    from eskf_ros.doctor.examine import check
    from eskf_ros.parameters.ros_yaml import load as load_parameters
    from eskf_ros.tables.bag import read_bag

__all__ = ["Filter", "Result", "Smoothed", "__version__", "calibrate", "check", "load_parameters", "read_bag", "run"]

__version__ = "1.0.0"

_HOMES = {
    "Filter": "eskf_ros.api.Filter",
    "Result": "eskf_ros.api.Result",
    "calibrate": "eskf_ros.calibration.calibrate.calibrate",
    "Smoothed": "eskf_ros.api.Smoothed",
    "check": "eskf_ros.doctor.examine.check",
    "run": "eskf_ros.api.run",
    "load_parameters": "eskf_ros.parameters.ros_yaml.load",
    "read_bag": "eskf_ros.tables.bag.read_bag",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    module, _, attribute = _HOMES[name].rpartition(".")
    return getattr(import_module(module), attribute)
