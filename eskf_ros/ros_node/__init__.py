"""The ROS 2 node: a thin layer of messages, parameters and diagnostics around the estimator."""
