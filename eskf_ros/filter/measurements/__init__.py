"""Measurement models, one file each; only `kalman_update` and the error of `mag` write the estimate."""
