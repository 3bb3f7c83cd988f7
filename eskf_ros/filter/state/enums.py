"""The words of the estimator: status, phases of a measurement, verdicts and streams."""

from __future__ import annotations

from enum import IntEnum, auto


class Status(IntEnum):
    """What the estimator has, in the order in which it gets it.

    COASTING: no position was accepted for a while. DEGRADED: fixes come and contradict the estimate. FAULT: the
    estimate is not finite or a variance negative, only a reset helps.
    """

    WAITING_IMU = 0
    LEVELLING = 1
    WAITING_FIX = 2
    WAITING_HEADING = 3
    ALIGNING = 4
    GOOD = 5
    COASTING = 6
    DEGRADED = 7
    FAULT = 8


class Phase(IntEnum):
    """What an aid is to the filter (see ``recovery``).

    SUSPICIOUS: the latest measurements were rejected. OUTAGE: none came for a while. REACQUIRING: they come, but none
    was accepted for a while, or not for long yet. RESET: a short while ago they won over the filter.
    """

    WAITING = 0
    FUSING = 1
    SUSPICIOUS = 2
    OUTAGE = 3
    REACQUIRING = 4
    RESET = 5


class Verdict(IntEnum):
    """What became of an offered measurement (a closed list; files show the names in lower case).

    INACTIVE is for what says nothing at the moment, such as rest while the robot moves: it leaves no record.
    CONTRADICTED: a position that moves otherwise than the velocity of the same receiver. RESET: it is the last of so
    many rejected ones that agree with each other that the filter gave in.
    """

    WAITING = 0
    FUSED = 1
    GATE = 2
    NON_FINITE = 3
    BAD_COVARIANCE = 4
    BAD_VALUE = 5
    BAD_STAMP = 6
    NO_FIX = 7
    DUPLICATE = 8
    BEFORE_ALIGNMENT = 9
    OUTSIDE_HISTORY = 10
    DISABLED = 11
    WEIGHED_DOWN = 12
    INACTIVE = 13
    LOW_ELEVATION = 14
    CONTRADICTED = 15
    RESET = 16


class Stream(IntEnum):
    """Streams by rank: of several messages with one stamp the lower rank comes first.

    From ZUPT on they are constraints: no sensor sends them, the timeline puts them on a grid of stamps.
    """

    IMU = 0
    GNSS_POSITION = auto()
    GNSS_VELOCITY = auto()
    HEADING = auto()
    MAG = auto()
    WHEEL = auto()
    BODY_VELOCITY = auto()
    BARO = auto()
    PSEUDORANGE = auto()
    RANGE_RATE = auto()
    ZUPT = auto()
    ZARU = auto()
    NHC = auto()


STREAM_NAMES = tuple(stream.name.lower() for stream in Stream)

CONSTRAINTS = (Stream.ZUPT, Stream.ZARU, Stream.NHC)

SENSOR_STREAMS = int(min(CONSTRAINTS))
"""Number of the streams that sensors send, the IMU included; they have the lowest ranks."""

CONSTRAINT_INTERVAL = 1_000_000_000
"""The grid of the constraints (ns).

What makes them wrong (side slip, a body that sways) lasts for about half as long at the least: closer together they
would not be independent of each other, and the filter would believe their mean too much.
"""
