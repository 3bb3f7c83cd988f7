"""What the motion monitor has found, one sentence each with what to do."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from eskf_ros.filter.integrity.heading_monitor import slip_of
from eskf_ros.filter.integrity.motion_monitor import lag_of_receiver
from eskf_ros.filter.integrity.motion_sums import FEWEST_TURNS, MANY_TURNS, SAME, TURNED, has_turned
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.time import NEVER, SECOND

LONGEST_COMPARISON = 180 * SECOND
"""ns; after this time without turns or accelerations nothing is waited for."""

OTHER = 0.3
"""Correlation of changes of course with a gyro below which it does not show them."""

FEWEST_PUSHES = 30
"""Windows with an acceleration from which on those are compared."""

MANY_PUSHES = 60
"""Such windows from which on a small angle to the direction of travel is told: fewer do not show how errors last."""

LARGE_YAW = math.radians(20.0)
"""rad; an angle that is told without waiting for them."""

PUSHED = 0.2
"""m2/s4; mean square of the accelerations along each axis from which on they are."""

MISSED = 0.5
"""Share of the specific force that may stay unexplained by accelerations where axes are judged by it."""

MOST_TOGETHER = 0.9
"""Largest product of the correlations from window to window of accelerations and of what they leave unexplained."""

MIRRORED = -0.5
"""Determinant of a comparison, as a share of that of a rotation, below which axes are mirrored."""

NOTABLE_YAW, YAW_SIGMAS = math.radians(3.0), 3.5
"""rad and standard deviations from which on a direction of travel is told."""


def motion_complaints(state: np.void) -> list[str]:
    """Return one sentence for each fault of axes and clocks that receiver and IMU show without the filter."""
    motion = state["motion"]
    found = []
    if motion["clock_steps"]:
        found.append(
            f"the clock was set forward by {float(motion['clock_step']):.1f} s about the stamp "
            f"{int(motion['clock_stamp']) * 1e-9:.1f} ({int(motion['clock_steps'])} times): the stamps of IMU and "
            "fixes went ahead, and the robot did not; let the clock be slewed, or set it before the drive"
        )
    if motion["has_other_axes"]:
        # With such velocities the course says nothing of the IMU.
        return [
            *found,
            "the velocities of the receiver fit its positions with east and north exchanged: they seem to be in "
            "North-East-Down axes, and are not used; publish East-North-Up (REP-103)",
        ]
    fewest = 0 if motion["heard_stamp"] != NEVER else MANY_TURNS
    if motion["turns"]["lag"] == 0.0 and (lag := float(lag_of_receiver(state))) != 0.0:
        found.append(_clocks_apart("as the robot set out from rest", lag))
    return found + _turn_complaints(motion["turns"], fewest) + _push_complaints(motion["pushes"])


def _clocks_apart(seen: str, lag: float) -> str:
    return (
        f"{seen} the receiver is stamped about {abs(lag):.1f} s {'later' if lag > 0.0 else 'earlier'} than "
        "the IMU: the clocks are apart; synchronise the clocks, or set the time_offset of the receiver"
    )


def has_compared(state: np.void) -> bool:
    """Say whether the axes of the IMU have been compared with the motion, or would have been by now."""
    turns = state["motion"]["turns"]
    has_both = has_turned(turns, FEWEST_TURNS) and state["motion"]["pushes"]["count"] >= FEWEST_PUSHES
    return bool(has_both) or int(state["stamp"]) - int(state["first_stamp"]) > LONGEST_COMPARISON


def _turn_complaints(turns: np.void, fewest: int) -> list[str]:
    """Compare changes of course with the gyros; clocks are said to be apart after ``fewest`` windows."""
    weight = max(float(turns["weight"]), 1e-9)
    mean = float(turns["course"]) / weight
    square = float(turns["course_square"]) / weight - mean * mean
    if turns["count"] < FEWEST_TURNS or square * turns["count"] < TURNED:
        return []
    of_gyro = turns["gyro"] / weight
    squares = turns["gyro_square"] / weight - of_gyro * of_gyro
    products = turns["product"] / weight - of_gyro * mean
    shown = products / np.sqrt(np.maximum(squares * square, 1e-18))
    lag = float(turns["lag"])
    if lag != 0.0 and turns["count"] >= fewest:
        return [_clocks_apart("by their turns", lag)]
    if shown[2] < -SAME:
        return [
            "about the vertical of base_link the gyro turns the other way than the course: axes of the IMU are negated "
            "or swapped, or imu.mount_rpy_deg is wrong"
        ]
    best = int(np.argmax(np.abs(shown)))
    if abs(shown[2]) < OTHER and abs(shown[best]) > SAME:
        return [
            f"the gyro about {'xyz'[best]} of base_link shows the turns of the course, that about z does not: axes of "
            "the IMU are swapped, or imu.mount_rpy_deg is wrong"
        ]
    return []


def _compared(pushes: np.void) -> tuple[np.ndarray, float] | None:
    """Return the matrix (2, 2) from acceleration to specific force, and the standard deviation (rad) of its angle.

    None without enough accelerations, or where they do not explain the force. What is left of the force lasts from
    window to window, on slopes most of all, and so do accelerations: their products are fewer than they seem, by
    (1 + r) / (1 - r) with the product r of both correlations (Bayley and Hammersley, The effective number of
    independent observations in an autocorrelated time series, 1946).
    """
    count = float(pushes["count"])
    square = pushes["acceleration_square"]
    if count < FEWEST_PUSHES or np.linalg.eigvalsh(square)[0] < PUSHED * count:
        return None
    matrix: np.ndarray = np.linalg.solve(square, pushes["product"].T).T
    explained = float(np.trace(matrix @ square @ matrix.T))
    missed = float(pushes["force_square"]) - explained
    if missed > MISSED * float(pushes["force_square"]):
        return None
    step = pushes["acceleration_next"]
    missed_next = float(pushes["force_next"]) - float(np.sum(matrix * pushes["product_next"]))
    missed_next += float(np.trace(matrix @ step @ matrix.T))
    together = missed_next / max(missed, 1e-9) * float(np.trace(step)) / float(np.trace(square))
    together = min(max(together, 0.0), MOST_TOGETHER)
    return matrix, math.sqrt(max(missed, 0.0) / (explained * count) * (1.0 + together) / (1.0 - together))


def _push_complaints(pushes: np.void) -> list[str]:
    """Compare accelerations along the course and to its left with the specific force."""
    compared = _compared(pushes)
    if compared is None:
        return []
    matrix, _ = compared
    if np.linalg.det(matrix) > 0.5 * MIRRORED * float(np.sum(matrix * matrix)):
        return []
    return [
        "accelerations along the course and to its left appear mirrored in x and y of base_link: axes of the "
        "accelerometer are swapped or negated"
    ]


def travel_complaints(state: np.void, settings: np.void, mount_rpy_deg: Sequence[float]) -> tuple[list[str], bool]:
    """Return a sentence if the robot does not travel along x of base_link, and whether it is told to do so.

    Only a robot that is made to travel along x is mounted wrong then. Where positions alone do not show accelerations,
    the estimate shows the direction of travel.
    """
    compared, slip = _compared(state["motion"]["pushes"]), slip_of(state)
    if motion_complaints(state):
        return [], False
    if compared is not None:
        matrix, std = compared
        yaw, what = -math.atan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1]), "accelerations"
    elif slip is not None and state["motion"]["heard_stamp"] == NEVER:
        (yaw, std), what = (-slip[0], slip[1]), "velocity"
    else:
        return [], False
    is_early = what == "accelerations" and state["motion"]["pushes"]["count"] < MANY_PUSHES
    if abs(yaw) < max(LARGE_YAW if is_early else NOTABLE_YAW, YAW_SIGMAS * std):
        return [], False
    roll, pitch, told = mount_rpy_deg
    wanted = (told + math.degrees(yaw) + 180.0) % 360.0 - 180.0
    text = (
        f"by its {what} the robot travels at {-math.degrees(yaw):+.1f} deg (+- {math.degrees(std):.1f}) to x of "
        f"base_link: if it is made to travel along x, set imu.mount_rpy_deg to [{roll:g}, {pitch:g}, {wanted:.1f}]"
    )
    return [text], bool(settings["use_course"]) or bool(settings["constrains"][Stream.NHC])
