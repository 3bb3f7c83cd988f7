"""Calibration of an installation from recordings: constants of the sensors as states of the filter."""
