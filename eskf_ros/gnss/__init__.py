"""Satellites: broadcast ephemerides, RINEX files, atmosphere, weights, and a point solution of one epoch.

Knows neither ROS nor the filter. An instant is a GPS week and seconds of that week (`eskf_ros.gnss.time`), a satellite
is a u-blox ``gnss_id`` and a number, a signal is an index into `eskf_ros.gnss.signals.SIGNALS`. Positions are WGS84
ECEF in metres; the frames of the constellations (PZ-90.11, GTRF, CGCS2000) agree with it within centimetres.

From a file to a position: `rinex_nav.read_navigation` and `rinex_obs.read_observations` read files, `ranges.locate`
adds the satellites to the observations, `point_solution.solve` computes position, velocity and clock.
"""
