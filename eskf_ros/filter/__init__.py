"""The estimator: knows neither ROS, nor files, nor wall clocks."""
