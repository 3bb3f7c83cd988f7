"""Real drives as the recordings a user would have made: an .mcap file, a parameter file, a truth topic.

One module per drive: what the data are, what was corrected, how offsets and mounting were found. The inputs hold only
what the estimator may see. The topic `truth` holds what was kept from it, stamped on the clock of the IMU.
"""
