"""What several tests need: oracles, kernels, recordings, a robot on ROS."""
