"""The door: what a GNSS message must be before it enters the timeline. A bad one is named and never applied."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.layout import Verdict

OPEN = int(Verdict.WAITING)
NON_FINITE = int(Verdict.NON_FINITE)
BAD_COVARIANCE = int(Verdict.BAD_COVARIANCE)


@njit
def admit(offered, values, covariance, stand_in, scale, std_floor):
    """Write three values and the conditioned covariance to the payload of the record on offer; open or shut its door.

    ``covariance`` row-major 3x3, in the unit of the values squared; when ``stand_in`` has a positive first element it
    is the diagonal used instead. Scaled, then lifted to the floor: raising the diagonal of a positive semidefinite
    matrix keeps it one.
    """
    aid = offered[0]
    payload = aid.payload
    for i in range(3):
        payload[i] = values[i]
    payload[3] = covariance[0]
    payload[4] = covariance[1]
    payload[5] = covariance[2]
    payload[6] = covariance[4]
    payload[7] = covariance[5]
    payload[8] = covariance[8]
    if stand_in[0] > 0.0:
        for i in range(3, 9):
            payload[i] = 0.0
        payload[3] = stand_in[0]
        payload[6] = stand_in[1]
        payload[8] = stand_in[2]
    for i in range(9):
        if not math.isfinite(payload[i]):
            aid.door = NON_FINITE
            return
    lowest = min(payload[3], payload[6], payload[8])
    floor = std_floor * std_floor
    for i in range(3, 9):
        payload[i] *= scale
    payload[3] = max(payload[3], floor)
    payload[6] = max(payload[6], floor)
    payload[8] = max(payload[8], floor)
    xx, xy, xz = payload[3], payload[4], payload[5]
    yy, yz, zz = payload[6], payload[7], payload[8]
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    aid.door = OPEN
    if lowest < 0.0 or not (xx * yy - xy * xy > 0.0 and determinant > 0.0):
        aid.door = BAD_COVARIANCE
