"""Range to a radio beacon whose place is known: a measurement of your own, from ``docs/add_a_measurement.md``.

    range = |beacon - (position + R arm)| + noise

Payload: range (m), variance (m2). ``position`` and R of the IMU in map, ``arm`` from the IMU to the antenna of the
radio. The Jacobian is that of a distance: with u the unit vector from the antenna to the beacon, d range / d position
is -u, and a small rotation theta of the attitude moves the antenna by theta x R arm (Groves, section 14.3.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.jacobians import clear
from eskf_ros.filter.measurements.row import UNMEASURED, Place, Readings, Row, arm_body, threefold
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ATTITUDE, POSITION
from eskf_ros.geodesy.earth import geodetic_to_ecef
from eskf_ros.geodesy.rotation import cross, dot, rotate, rotate_back, to_matrix
from eskf_ros.parameters.schema import Aid, parameter

LONGEST_RANGE = 1e5
"""m; no radio of a robot reaches further."""

SETTINGS = np.dtype([("arm_body", "f8", (3,)), ("beacon_ecef", "f8", (3,))], align=True)
"""The antenna (m from the IMU, in its axes), and the beacon (m, ECEF)."""


@dataclass(frozen=True)
class BeaconRange(Aid):
    position: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), "m", "Position of the antenna of the radio in base_link.", minimum=-1000.0, maximum=1000.0
    )
    beacon: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        "deg, deg, m",
        "Where the beacon stands: latitude, longitude, ellipsoidal altitude.",
        minimum=(-90.0, -180.0, -1.0e4),
        maximum=(90.0, 180.0, 1.0e6),
    )
    std_floor: float = parameter(
        0.1, "m", "The standard deviation is never taken smaller than this.", above=0.0, maximum=1.0e4, live=True
    )
    unknown_std: float = parameter(
        0.5, "m", "Standard deviation where the message gives none.", above=0.0, maximum=1.0e4, live=True
    )


@njit
def linearize(state, payload, settings, work):
    """Write innovation, Jacobian and noise to ``work``; return the number of scalars."""
    clear(work)
    beacon, origin = settings.beacon_range.beacon_ecef, state.frame.origin_ecef
    beacon_map = rotate_back(
        state.frame.map_to_ecef, (beacon[0] - origin[0], beacon[1] - origin[1], beacon[2] - origin[2])
    )
    arm = rotate(to_matrix(state.attitude), settings.beacon_range.arm_body)
    p = state.position_map
    way = (beacon_map[0] - p[0] - arm[0], beacon_map[1] - p[1] - arm[1], beacon_map[2] - p[2] - arm[2])
    distance = math.sqrt(dot(way, way))
    unit = (way[0] / distance, way[1] / distance, way[2] / distance)
    # -u . (theta x arm) = -theta . (arm x u)
    turned = cross(arm, unit)
    for i in range(3):
        work.jacobian[0, POSITION + i] = -unit[i]
        work.jacobian[0, ATTITUDE + i] = -turned[i]
    work.innovation[0] = payload[0] - distance
    work.noise[0, 0] = payload[3]
    return 1


def read(messages: npt.NDArray[Any]) -> Readings:
    """Range (m) of sensor_msgs/Range, whose variance is 0 where it is unknown; the other axes are absent."""
    values, covariances = np.zeros((len(messages), 3)), np.zeros((len(messages), 9))
    values[:, 0] = messages["range"]
    covariances[:, 0] = messages["variance"]
    covariances[messages["variance"] != 0.0, 4::4] = UNMEASURED
    return values, covariances


def limits(beacon_range: BeaconRange) -> dict[str, Any]:
    """Particulars of the `Intake`."""
    return {
        "std_floor": threefold(beacon_range.std_floor),
        "unknown_std": threefold(beacon_range.unknown_std),
        "largest": LONGEST_RANGE,
        "lowest": 0.0,
        "may_lack_axes": True,
    }


def describe(settings: np.void, parameters: Any) -> None:
    """Fill in `SETTINGS`."""
    beacon_range: BeaconRange = parameters.beacon_range
    latitude, longitude, altitude = beacon_range.beacon
    settings["arm_body"] = arm_body(beacon_range.position, parameters)
    settings["beacon_ecef"] = geodetic_to_ecef(math.radians(latitude), math.radians(longitude), altitude)


ROW = Row(
    Stream.BEACON_RANGE,
    "radio beacon",
    BeaconRange,
    "Range to a radio beacon.",
    types=("sensor_msgs/msg/Range",),
    topic="beacon/range",
    topic_about="sensor_msgs/Range: distance of the antenna of the radio from the beacon.",
    read=read,
    limits=limits,
    place=Place("beacon_range.position", inputs=("beacon_range",)),
    settings=SETTINGS,
    describe=describe,
    columns=("range",),
)
"""The facts of this measurement."""
