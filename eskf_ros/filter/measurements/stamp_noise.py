"""Stamps of receivers that a driver has cut to whole seconds: when a message was measured is known to a second only.

Several messages with one stamp, a whole second, and different contents give it away. One of them is used; it may have
been measured any time in the second that begins there.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.time import SECOND

FEWEST_CUT = 8
"""Messages of a receiver that share a stamp with others from which on its stamps are cut."""

TIME_VARIANCE = 1.0 / 3.0
"""s2; mean square of a time that may be anything from 0 to 1 s."""

ACCELERATION = 1.0
"""m/s2 per axis; of a vehicle over a second, for what velocities may be off by."""


@njit
def note_cut_stamp(state, aids, i):
    """Count a message of a receiver that is not used because another has its stamp, if this is a whole second."""
    aid = aids[i]
    if aid.stream not in (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY) or aid.stamp % SECOND != 0:
        return
    is_other = aid.payload[0] != aids[i - 1].payload[0] or aid.payload[1] != aids[i - 1].payload[1]
    if aid.verdict == Verdict.DUPLICATE and is_other:
        state.scatter.cut_stamps[aid.source] += 1


@njit
def add_way_of_cut_stamp(state, source, work):
    """Add to the noise of a position in ``work`` the way that the robot goes in the time by which it may be late."""
    if state.scatter.cut_stamps[source] < FEWEST_CUT:
        return
    v = state.velocity_map
    for i in range(3):
        for j in range(3):
            work.noise[i, j] += TIME_VARIANCE * v[i] * v[j]


@njit
def add_gain_of_cut_stamp(state, source, work):
    """Add to the noise of a velocity in ``work`` what the robot may gain in the time by which it may be late."""
    if state.scatter.cut_stamps[source] < FEWEST_CUT:
        return
    for i in range(3):
        work.noise[i, i] += TIME_VARIANCE * ACCELERATION**2
