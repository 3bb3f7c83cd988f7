"""Inertial navigation: propagates nominal state and covariance over an IMU interval, and holds the map frame."""
