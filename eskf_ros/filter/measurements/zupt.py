"""Zero velocity update: a robot that stands still has no velocity.

No payload; the timeline puts it on its grid, and ``stillness`` decides when it holds. The velocity of the IMU is zero
but for what a body sways on its springs (Groves, section 15.3.1). Swaying lasts for less than the grid is wide, so that
it is new every time; ten zeros in a second would be believed ten times.
"""

from __future__ import annotations

from eskf_ros.compiled import njit
from eskf_ros.filter.measurements.jacobians import clear, set_identity
from eskf_ros.filter.state.error_state import VELOCITY
from eskf_ros.filter.stationarity.detector import is_resting

SIZE = 3


@njit
def linearize(state, settings, work):
    """Write innovation, Jacobian and noise to ``work``; return the number of scalars, 0 when it does not hold."""
    if not is_resting(state, settings):
        return 0
    clear(work)
    set_identity(work.jacobian, VELOCITY)
    for i in range(SIZE):
        work.innovation[i] = -state.velocity_map[i]
        work.noise[i, i] = settings.zupt_velocity_std**2
    return SIZE
