"""Admission: what a message must be before it enters the timeline. A bad one gets a verdict and is never applied."""

from __future__ import annotations

import math

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, XY, XZ, YY, YZ, ZZ
from eskf_ros.filter.state.enums import Verdict

VARIANCES = (3, 6, 8)
"""Index in the payload of the variances of the three values."""

ABSENT = -1.0
"""Variance of an axis that was not measured."""


@njit
def admit(offered, values, covariance, stand_in, scale, std_floor, may_lack_axes):
    """Write three values and the conditioned covariance to the payload of the record on offer; return its verdict.

    ``covariance`` is row-major 3x3, in the unit of the values squared; if ``stand_in`` has a positive first element, it
    is the diagonal used instead. The covariance is scaled by ``scale``, then its diagonal is raised to the floor
    (``std_floor``, per axis), which keeps a positive semidefinite matrix positive semidefinite. If ``may_lack_axes``,
    an axis whose variance is negative or NaN was not measured: its value becomes 0 and its variance -1.
    """
    payload = offered[0].payload
    for i in range(3):
        payload[i] = values[i]
    for i in range(3, len(payload)):
        payload[i] = 0.0
    payload[XX] = covariance[0]
    payload[XY] = covariance[1]
    payload[XZ] = covariance[2]
    payload[YY] = covariance[4]
    payload[YZ] = covariance[5]
    payload[ZZ] = covariance[8]
    if stand_in[0] > 0.0:
        for i in range(3, 9):
            payload[i] = 0.0
        payload[XX] = stand_in[0]
        payload[YY] = stand_in[1]
        payload[ZZ] = stand_in[2]
    lacking = 0
    if may_lack_axes:
        lacking = take_out_absent_axes(payload)
    for i in range(9):
        if not math.isfinite(payload[i]):
            return Verdict.NON_FINITE
    lowest = min(payload[XX], payload[YY], payload[ZZ])
    for i in range(3, 9):
        payload[i] *= scale
    payload[XX] = max(payload[XX], std_floor[0] * std_floor[0])
    payload[YY] = max(payload[YY], std_floor[1] * std_floor[1])
    payload[ZZ] = max(payload[ZZ], std_floor[2] * std_floor[2])
    xx, xy, xz = payload[XX], payload[XY], payload[XZ]
    yy, yz, zz = payload[YY], payload[YZ], payload[ZZ]
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    for i in range(3):
        if lacking & (1 << i):
            payload[VARIANCES[i]] = ABSENT
    if lowest < 0.0 or not (xx * yy - xy * xy > 0.0 and determinant > 0.0) or lacking == 7:
        return Verdict.BAD_COVARIANCE
    return Verdict.WAITING


@njit
def take_out_absent_axes(payload):
    """Zero the values and covariances of axes whose variance is negative or NaN; return these axes as bits."""
    lacking = 0
    for i in range(3):
        if not payload[VARIANCES[i]] >= 0.0:
            lacking |= 1 << i
            payload[i] = 0.0
            payload[VARIANCES[i]] = 0.0
    if lacking & 3:
        payload[XY] = 0.0
    if lacking & 5:
        payload[XZ] = 0.0
    if lacking & 6:
        payload[YZ] = 0.0
    return lacking
