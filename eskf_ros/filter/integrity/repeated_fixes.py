"""Repeated fixes: coordinates that come again, bit for bit, with a fresh stamp.

Drivers send a fix of 1 Hz at 5 Hz, receivers freeze. A copy of a fix that was fused tells nothing new of the position:
fused again it would make the estimate too certain, and in motion it is wrong. It is refused, and is no evidence of rest
either. What a receiver says while the robot stands may repeat by chance (quantised coordinates, position hold); that
costs nothing, because a robot at rest keeps its position.

"The one before" is the one before in the order of stamps, so that the order of arrival leaves no trace.
"""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, YY
from eskf_ros.filter.measurements.gnss_position import NO_ALTITUDE, position_of_fix, predict
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import SOURCES, VELOCITY
from eskf_ros.filter.state.time import NEVER

REPEATED_FIXES = np.dtype(
    [
        ("fix", "f8", (SOURCES, 4)),
        ("fix_stamp", "i8", (SOURCES,)),
        ("velocity", "f8", (SOURCES, 3)),
        ("is_copy", "i8", (SOURCES,)),
        ("fresh", "i8"),
        ("copies", "i8"),
        ("longest", "i8"),
    ],
    align=True,
)
"""The last fix and velocity by receiver, and how often they came again.

``fix``: latitude, longitude (rad), altitude (m), and the mark of a missing altitude, of the last fix that was fused;
``fix_stamp``: its stamp (ns), `NEVER` before the first. ``velocity``: the last one (m/s). ``is_copy``: whether the
newest fix was a copy. ``fresh``, ``copies``, ``longest``: fixes while the robot moved, copies among them, and the
longest time over which one fix was repeated (ns).
"""

MOVING = 0.5
"""m/s; estimated speed above which coordinates cannot stay the same to the last bit."""

AGREES = 3.0
"""Standard deviations of a fix by which the estimate may be away from its copy, for the copy to count as heard."""

FEWEST_COPIES = 10
"""Copies in motion from which on the warning appears."""

FROZEN = 3.0
"""s; a fix that is repeated for longer comes from a receiver that is frozen, not from one that is read too often."""


@njit
def is_repeated(state, aid):
    """Say whether a fix or a velocity is a copy of the one before it of the same receiver, and take note of it.

    A velocity counts only if the fix of its epoch was a copy, too: a constant velocity may be true.
    """
    repeats, source, payload = state.repeats, aid.source, aid.payload
    if aid.stream == Stream.GNSS_POSITION:
        if state.position_known == 0:
            return False
        is_copy = repeats.fix_stamp[source] != NEVER and same_fix(repeats.fix[source], payload)
        repeats.is_copy[source] = 1 if is_copy else 0
        if is_moving(state):
            repeats.fresh += 1
            if is_copy:
                repeats.copies += 1
                repeats.longest = max(repeats.longest, aid.stamp - repeats.fix_stamp[source])
        return is_copy
    if aid.stream != Stream.GNSS_VELOCITY:
        return False
    is_copy = repeats.is_copy[source] == 1
    for i in range(3):
        is_copy = is_copy and payload[i] == repeats.velocity[source, i]
    for i in range(3):
        repeats.velocity[source, i] = payload[i]
    return is_copy


@njit
def same_fix(fix, payload):
    """Say whether the coordinates of a fix are those of ``payload`` to the last bit."""
    if fix[0] != payload[0] or fix[1] != payload[1] or fix[3] != payload[NO_ALTITUDE]:
        return False
    return fix[3] != 0.0 or fix[2] == payload[2]


@njit
def is_moving(state):
    """Say whether the estimate certainly moves faster than `MOVING`."""
    square = state.velocity_map[0] ** 2 + state.velocity_map[1] ** 2
    variance = state.covariance[VELOCITY, VELOCITY] + state.covariance[VELOCITY + 1, VELOCITY + 1]
    return square > max(MOVING**2, 9.0 * variance)


@njit
def note_fused_fix(state, aid):
    """Keep a fix that was fused; copies of one that was refused go on to be judged."""
    if aid.verdict in (Verdict.FUSED, Verdict.WEIGHED_DOWN, Verdict.TAKEOVER, Verdict.RESET):
        for i in range(3):
            state.repeats.fix[aid.source, i] = aid.payload[i]
        state.repeats.fix[aid.source, 3] = aid.payload[NO_ALTITUDE]
        state.repeats.fix_stamp[aid.source] = aid.stamp


@njit
def note_copy(state, aid, settings):
    """Count a copy as heard while the estimate has not left its place by more than the fix may err."""
    if aid.stream == Stream.GNSS_POSITION:
        there, here = position_of_fix(state, aid.payload), predict(state, aid.source, settings)
        square = (there[0] - here[0]) ** 2 + (there[1] - here[1]) ** 2
        if square > AGREES**2 * (aid.payload[XX] + aid.payload[YY]):
            return
        state.recovery.absolute_stamp = state.stamp
    elif state.streams.fused_stamp[Stream.GNSS_POSITION.value, aid.source] != state.stamp:
        return
    state.streams.last_stamp[aid.stream, aid.source] = state.stamp
    state.streams.fused_stamp[aid.stream, aid.source] = state.stamp


def repeat_complaints(state: np.void) -> list[str]:
    """Return a sentence if fixes repeated while the robot moved, with what to do."""
    repeats = state["repeats"]
    fresh, copies, longest = int(repeats["fresh"]), int(repeats["copies"]), int(repeats["longest"]) * 1e-9
    if copies < FEWEST_COPIES:
        return []
    if longest > FROZEN:
        return [
            f"the receiver repeated its coordinates bit for bit for {longest:.1f} s with fresh stamps while the robot "
            f"moved ({copies} fixes): it is frozen, or its driver is; these fixes are not used"
        ]
    return [
        f"{copies} of {fresh} fixes repeat the coordinates of the one before bit for bit while the robot moves: the "
        "driver sends each fix of the receiver several times; only the first is used, publish each once with its stamp"
    ]
