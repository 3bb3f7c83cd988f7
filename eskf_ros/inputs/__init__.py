"""The inputs of the estimator for node and replay alike, and RINEX files as messages of a recording."""
