"""Recovery: when fix after fix contradicts the filter, the filter is taken to be wrong and starts again."""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.alignment import restart
from eskf_ros.filter.layout import NEVER, Verdict

FUSED = int(Verdict.FUSED)
GATE = int(Verdict.GATE)

REJECTED_FIXES = 5
REJECTED_TIME = 5_000_000_000
"""So many fixes in a row, over at least this long (ns), outside the gate: more than an outlier or a multipath step."""


@njit
def judge_filter(state, verdict):
    """Count what became of the latest fix; restart the alignment when too many in a row were rejected."""
    if verdict == FUSED:
        if state.absolute_stamp != NEVER:
            state.absolute_interval = state.stamp - state.absolute_stamp
        state.absolute_stamp = state.stamp
        state.rejected_fixes = 0
    elif verdict == GATE:
        state.rejected_fixes += 1
        if state.rejected_fixes >= REJECTED_FIXES and state.stamp - state.absolute_stamp >= REJECTED_TIME:
            restart(state)
