"""`eskf_replay`: recordings through the estimator. `run.py` is the loop; the other files are its input and output."""
