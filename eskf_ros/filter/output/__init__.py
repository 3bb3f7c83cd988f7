"""Output: odometry in `map` and `odom`; reads the estimate and writes rows and the local pose, never the estimate."""
