"""The services of robot_localization under their usual names, where that package is installed.

They are fromLL, toLL and datum of navsat_transform, and set_pose of the filter: clients written for them work
unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node

from eskf_ros.filter.navigator import Navigator
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.ros_node.set_pose import set_pose

try:
    from robot_localization import srv as services
except ImportError:
    services = None


class RobotLocalizationServices:
    """Serves FromLL, ToLL, SetDatum and SetPose for a navigator. Made only if `services` is not None.

    The responses have no success flag: without an answer the numbers are NaN, and the log says why.
    """

    def __init__(self, node: Node, navigator: Navigator, map_frame: str) -> None:
        self._node = node
        self._navigator = navigator
        self._map = map_frame
        for kind, name, answer in (
            (services.FromLL, "fromLL", self._from_geodetic),
            (services.ToLL, "toLL", self._to_geodetic),
            (services.SetDatum, "datum", self._set_datum),
            (services.SetPose, "set_pose", self._set_pose),
        ):
            node.create_service(kind, name, self._contained(name, answer))

    def _contained(self, name: str, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return the service callback such that no request ends the node."""

        def contain(request: Any, response: Any) -> Any:
            try:
                return answer(request, response)
            except Exception as error:
                self._node.get_logger().error(f"{name}: {type(error).__name__}: {error}")
                return response

        return contain

    def _from_geodetic(self, request: Any, response: Any) -> Any:
        point = request.ll_point
        position = (math.nan,) * 3
        datum = self._navigator.datum
        if datum is None:
            self._node.get_logger().warn("fromLL: the origin of the map is not known yet; NaN returned")
        else:
            place = MapFrame(datum).from_geodetic_deg(point.latitude, point.longitude, point.altitude)
            position = tuple(place.tolist())
        response.map_point.x, response.map_point.y, response.map_point.z = position
        return response

    def _to_geodetic(self, request: Any, response: Any) -> Any:
        point = request.map_point
        place = (math.nan,) * 3
        datum = self._navigator.datum
        if datum is None:
            self._node.get_logger().warn("toLL: the origin of the map is not known yet; NaN returned")
        else:
            place = MapFrame(datum).to_geodetic_deg(np.array([point.x, point.y, point.z]))
        response.ll_point.latitude, response.ll_point.longitude, response.ll_point.altitude = place
        return response

    def _set_datum(self, request: Any, response: Any) -> Any:
        place = request.geo_pose.position
        if abs(place.latitude) <= 90.0 and abs(place.longitude) <= 360.0 and math.isfinite(place.altitude):
            self._navigator.set_datum(place.latitude, place.longitude, place.altitude)
        else:
            self._node.get_logger().error(f"datum: {place.latitude}, {place.longitude}, {place.altitude} is no place")
        return response

    def _set_pose(self, request: Any, response: Any) -> Any:
        frame = request.pose.header.frame_id
        why = f"the frame is {frame!r}, not {self._map}" if frame not in ("", self._map) else ""
        why = why or set_pose(self._navigator, request.pose.pose)
        if why:
            self._node.get_logger().error(f"set_pose: {why}")
        return response
