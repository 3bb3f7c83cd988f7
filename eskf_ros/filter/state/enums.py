"""Enumerations of the estimator: status, phases of a stream, verdicts and streams."""

from __future__ import annotations

from enum import IntEnum, auto


class Status(IntEnum):
    """How far the alignment is and how good the estimate is, in the order in which a start reaches them.

    COASTING: no position has been accepted for a while (dead reckoning). DEGRADED: fixes come and contradict the
    estimate. FAULT: the estimate is not finite or a variance is negative; only a reset helps.
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


class Quality(IntEnum):
    """Whether the estimate may be used for navigation (`IS_USABLE`), and why not (`QUALITY_REASONS`)."""

    GOOD = 0
    COASTING = 1
    NOT_ALIGNED = 2
    FIXES_CONTRADICT = 3
    HEADING_CONTRADICTED = 4
    SETTLING = 5
    COASTED_TOO_LONG = 6
    TOO_UNCERTAIN = 7
    FAULT = 8
    IMU_CONTRADICTED = 9


IS_USABLE = (Quality.GOOD, Quality.COASTING)
"""Qualities with which a robot may go on."""

QUALITY_REASONS = {
    Quality.GOOD: "aligned, and the sensors agree",
    Quality.COASTING: "no position has been accepted for a moment; dead reckoning",
    Quality.NOT_ALIGNED: "the alignment is not complete: see the state",
    Quality.FIXES_CONTRADICT: "positions come and contradict the estimate",
    Quality.HEADING_CONTRADICTED: "a heading sensor contradicts the estimated heading for long",
    Quality.SETTLING: "the position was reset to the fixes less than quality.settle_time ago",
    Quality.COASTED_TOO_LONG: "no position has been accepted for longer than quality.coast_time",
    Quality.TOO_UNCERTAIN: "the horizontal standard deviation is above quality.position_std",
    Quality.IMU_CONTRADICTED: "the receivers contradicted the IMU, and a lane that believes it less took over, less "
    "than quality.settle_time ago",
    Quality.FAULT: "the estimate is broken: call the service ~/reset",
}
"""What each quality means."""


class Phase(IntEnum):
    """Whether the filter uses a stream of measurements at present (see `recovery`).

    SUSPICIOUS: the latest measurements were rejected. OUTAGE: none has come for a while. REACQUIRING: they come, but
    none has been accepted for a while, or not yet for long. RESET: a short while ago they won over the filter.
    """

    WAITING = 0
    FUSING = 1
    SUSPICIOUS = 2
    OUTAGE = 3
    REACQUIRING = 4
    RESET = 5


class Verdict(IntEnum):
    """What became of an offered measurement (a closed list; files show the names in lower case).

    GATE: outside the innovation gate. WEIGHED_DOWN: fused with inflated noise. INACTIVE: the measurement says
    nothing at the moment, such as a ZUPT in motion; it leaves no record. CONTRADICTED: a position that moves
    otherwise than the velocity of the same receiver, or velocities in other axes than its positions. RESET: the
    last of several rejected measurements that agree with each other; the filter was reset to them. TAKEOVER: fused,
    and the filter continues from the humble lane, which predicted it better. UNFILLED: a fix at latitude and
    longitude zero, which nobody has filled in. REPEATED: the coordinates of an earlier fix, bit for bit, with a
    fresh stamp.
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
    UNFILLED = 17
    REPEATED = 18
    TAKEOVER = 19


class Stream(IntEnum):
    """Streams by rank: of several messages with the same stamp the one with the lower rank comes first.

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
"""ns; spacing of the grid of the constraints.

The errors of the constraints (side slip, a body that sways) last for about half of it, at least. At a shorter spacing
they would be correlated, and the filter would trust their mean too much.
"""
