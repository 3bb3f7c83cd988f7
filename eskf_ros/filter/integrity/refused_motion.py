"""The motion that refused fixes show: wherever a receiver has stepped to, its changes are those of the robot.

Fixes that jump are refused until it is known which of the two is wrong (`refusal`). Where nothing else measures the
velocity, the filter would go on with its own meanwhile, and fixes that have drawn it away have made that wrong, too.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.integrity.refusal import AGREEMENT_GATE, has_velocity
from eskf_ros.filter.measurements.gnss_position import linearize
from eskf_ros.filter.measurements.kalman_update import update
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_CAPACITY, POSITION, VELOCITY

MOST = 25
"""Refused fixes of which the mean is taken, at most: the velocity changes over longer times."""


@njit
def update_with_refused_fix(state, aid, settings, work):
    """Correct the velocity by how far a refused fix is from the mean of those refused before it.

    What the step has added to them cancels: with the innovations r_j of k fixes before, r - mean(r_j) is the error of
    the velocity times the time since their mean, and its noise is independent of that of earlier such differences
    (recursive residuals; Brown, Durbin and Evans, Techniques for testing the constancy of regression relationships over
    time, 1975). A correction of the path moves the earlier innovations, too.
    """
    trust, source = state.trust, aid.source
    if aid.stream != Stream.GNSS_POSITION or has_velocity(state, aid.stream, source):
        return
    linearize(state, aid.payload, source, settings, work)
    before, mean = min(trust.refused[0, source] - 1, MOST), trust.mean_innovation[source]
    innovation = (work.innovation[0], work.innovation[1], work.innovation[2])
    moved, sped, passed = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    if before > 0:
        passed = (aid.stamp - trust.mean_stamp[source]) * 1e-9
        for i in range(3):
            work.innovation[i] -= mean[i]
            for j in range(ERROR_CAPACITY):
                work.jacobian[i, j] = passed if j == VELOCITY + i else 0.0
            for j in range(3):
                work.noise[i, j] *= 1.0 + 1.0 / before
        verdict, _ = update(state, 3, AGREEMENT_GATE, work)
        if verdict == Verdict.FUSED:
            c = work.correction
            moved = (c[POSITION], c[POSITION + 1], c[POSITION + 2])
            sped = (c[VELOCITY], c[VELOCITY + 1], c[VELOCITY + 2])
    else:
        trust.mean_stamp[source] = aid.stamp
        mean.fill(0.0)
    for i in range(3):
        mean[i] += sped[i] * passed - moved[i]
        mean[i] += (innovation[i] - moved[i] - mean[i]) / (before + 1)
    trust.mean_stamp[source] += (aid.stamp - trust.mean_stamp[source]) // (before + 1)
