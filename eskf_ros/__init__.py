"""Error-state Kalman filter fusing an IMU with GNSS: a ROS 2 package and a replay tool for recordings.

For arrays in memory: `run`, `Filter` and `Result` of `eskf_ros.api`, imported when they are asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from eskf_ros.api import Filter, Result, run

__all__ = ["Filter", "Result", "__version__", "run"]

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in ("Filter", "Result", "run"):
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from eskf_ros import api

    return getattr(api, name)
