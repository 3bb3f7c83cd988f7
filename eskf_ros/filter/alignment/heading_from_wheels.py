"""Heading from wheels: the direction of motion on the map while the wheels measure forward motion.

A slow robot whose fixes are accurate to a metre accelerates too little for the search. Its wheels measure a velocity in
level axes that are turned by the unknown heading: one more measurement that is linear in cosine and sine.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment.heading import search_with
from eskf_ros.filter.history.records import XX
from eskf_ros.filter.inertial.navigation_frame import body_rate
from eskf_ros.filter.measurements.jacobians import vehicle_axes
from eskf_ros.filter.measurements.wheel import repeated
from eskf_ros.geodesy.rotation import cross, rotate, to_matrix

LEAST_SPEED = 0.15
"""m/s; slower wheels tell no direction: they scatter, and pulse counters that read zero may be moving."""

SIDE_SLIP_TIME = 10.0
"""s; time for which the course differs from the heading by the same angle."""


@njit
def search_with_wheels(state, payload, gate, settings, work):
    """Update the search for the heading with the speed of the wheels (payload as in `measurements.wheel`).

    The measurement: the velocity of the IMU on the map, minus the velocity of the wheels turned by the unknown heading,
    is zero. Its noise contains the angle between course and heading (``settings.course_std``).
    """
    if state.heading_known == 1 or state.search.started == 0 or settings.use_course == 0 or payload[XX] < 0.0:
        return
    if abs(payload[0]) < LEAST_SPEED:
        return
    rotation = to_matrix(state.attitude)
    forward, _left, _up = vehicle_axes(state, settings)
    lever_velocity = cross(body_rate(state, rotation), settings.wheel.arm_body)
    speed = payload[0]
    motion = rotate(
        rotation,
        (
            speed * forward[0] - lever_velocity[0],
            speed * forward[1] - lever_velocity[1],
            speed * forward[2] - lever_velocity[2],
        ),
    )
    variance = payload[XX] + repeated(state, SIDE_SLIP_TIME) * (settings.course_std * speed) ** 2
    for i in range(3):
        for j in range(3):
            work.noise[i, j] = 0.0
        work.noise[i, i] = variance
    search_with(state, 2, (0.0, 0.0, 0.0), (-motion[0], -motion[1], -motion[2]), gate, settings, work)
