"""Tables in and out of the filter for arrays in memory (`eskf_ros.api`)."""
