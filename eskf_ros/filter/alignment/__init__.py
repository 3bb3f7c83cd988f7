"""Coarse alignment: level, first position and heading; may set the whole core state and its covariance."""
