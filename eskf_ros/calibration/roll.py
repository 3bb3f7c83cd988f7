"""The roll of base_link against the vehicle, which neither its way forward nor the side it does not slip to show.

- In turns a vehicle turns about its own up axis, on a cambered road, too: where base_link is rolled, a part of the yaw
  rate appears about its y axis. Leaning out of turns does the same to both sides, with the square of the yaw rate.
- On straight roads it does not lean in the mean, but for the camber, which is to the same side all the way.

Cross-axis errors of cheap gyros (half a per cent is 0.3 deg) and the camber limit the two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Angle = tuple[float, float]
"""Value and standard deviation (rad), NaN where it is not known."""

ROW_RATE = 10.0
"""Hz; of the rows that are looked at."""

ROAD_SPEED = 5.0
"""m/s; the lean on the road is looked at above this speed."""

STRAIGHT = 0.03
"""rad/s; and below this yaw rate."""

CAMBER_DISTANCE = 100.0
"""m; the camber of a road changes within about this distance."""

CAMBER_STD = math.radians(0.5)
"""rad; what the mean camber of a drive may be."""

TURN_SPEED = 1.5
"""m/s; turns are looked at above this speed."""

CROSS_AXIS_STD = math.radians(0.25)
"""rad; misalignment of the gyros against each other."""

LEAST_TURNS = 1.0
"""rad2/s; integral of the squared yaw rate: four corners of a city."""

SHOWN_BY = "some turns, or 10 s of driving straight on above 5 m/s"


@dataclass(frozen=True)
class Roll:
    """By how much base_link is rolled: as turns say, and as straight roads say."""

    by_turns: Angle
    by_road: Angle

    @property
    def joint(self) -> Angle:
        """The weighed mean of both."""
        return weighed_mean([self.by_turns, self.by_road])

    @property
    def is_known(self) -> bool:
        return math.isfinite(self.joint[0])

    @property
    def text(self) -> str:
        """The evidence, in words."""
        difference = math.degrees(self.by_road[0] - self.by_turns[0])
        if not math.isfinite(difference):
            return "the axis of turns" if math.isfinite(self.by_turns[0]) else "no lean on straight roads in the mean"
        return f"the axis of turns and the lean on straight roads, which differ by {difference:.1f} deg (camber)"


def weighed_mean(angles: Sequence[Angle]) -> Angle:
    """Return the mean of those that are known, weighed by their variances, and its standard deviation.

    The limits of one kind of evidence are common to all recordings: a mean is not better than its best part by more
    than two parts of different kind.
    """
    known = [(value, std) for value, std in angles if math.isfinite(value)]
    if not known:
        return math.nan, math.nan
    weights = np.array([1.0 / std**2 for _, std in known])
    mean = float(np.sum(weights * [value for value, _ in known]) / weights.sum())
    best = min(std for _, std in known)
    return mean, max(float(1.0 / np.sqrt(weights.sum())), best / math.sqrt(2.0))


def roll_of(rows: NDArray[Any]) -> Roll:
    """Return the roll of base_link from ODOMETRY rows at `ROW_RATE`."""
    known = rows[rows["heading_known"]]
    return Roll(by_turns(known), by_road(known))


def by_turns(rows: NDArray[Any]) -> Angle:
    """Return the roll that the axis of turns says."""
    speed = np.linalg.norm(rows["velocity_map"], axis=1)
    rate = rows["angular_rate_body"][speed > TURN_SPEED]
    speed = speed[speed > TURN_SPEED]
    yaw_rate = rate[:, 2] if len(rate) else np.zeros(0)
    if np.sum(yaw_rate**2) / ROW_RATE < LEAST_TURNS:
        return math.nan, math.nan
    design = np.stack([yaw_rate, speed * yaw_rate**2, np.ones(len(yaw_rate))], axis=1)
    found, *_ = np.linalg.lstsq(design, rate[:, 1], rcond=None)
    spread = float(np.std(rate[:, 1] - design @ found))
    # Bumps last for half a second: one sample in five is new.
    std = spread * math.sqrt(5.0 * np.linalg.inv(design.T @ design)[0, 0])
    return float(found[0]), math.hypot(std, CROSS_AXIS_STD)


def by_road(rows: NDArray[Any]) -> Angle:
    """Return the mean lean on straight roads."""
    speed = np.linalg.norm(rows["velocity_map"][:, :2], axis=1)
    chosen = (speed > ROAD_SPEED) & (np.abs(rows["angular_rate_body"][:, 2]) < STRAIGHT)
    if np.count_nonzero(chosen) < 10.0 * ROW_RATE:
        return math.nan, math.nan
    attitude = Rotation.from_quat(np.roll(rows["attitude_body_to_map"][chosen], -1, axis=1))
    roll = attitude.as_euler("ZYX")[:, 2]
    part = np.floor(np.cumsum(speed[chosen]) / ROW_RATE / CAMBER_DISTANCE).astype(int)
    means = np.bincount(part, roll) / np.maximum(np.bincount(part), 1)
    spread = float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 2 else float(np.std(roll))
    return float(np.mean(roll)), math.hypot(spread, CAMBER_STD)
