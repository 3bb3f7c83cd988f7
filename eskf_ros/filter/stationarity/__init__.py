"""Static detector: tells whether the robot is stationary; writes its own evidence, never the estimate."""
