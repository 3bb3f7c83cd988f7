"""Fault detection and recovery; may reset position, velocity and alignment, and widen the covariance."""
