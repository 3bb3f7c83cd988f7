"""Error-state Kalman filter fusing an IMU with GNSS: a ROS 2 package and a replay tool for recordings."""

__version__ = "0.1.0"
