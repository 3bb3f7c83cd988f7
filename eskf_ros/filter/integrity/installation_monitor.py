"""Installation monitor: constant faults of receivers and gyros, found from innovations.

The innovations are compared with what remains in them of the faults (`fault_effects`; Friedland, Treatment of bias in
recursive filtering, 1969). What is found is allowed for: what it does to the estimate is in the covariance that is
published.
"""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.compiled import njit
from eskf_ros.filter.integrity.fault_effects import (
    FAULTS,
    VELOCITY_TIME,
    absorb_completely,
    carry_absorbed,
)
from eskf_ros.filter.integrity.heading_corrections import HEADING
from eskf_ros.filter.integrity.stepwise import best_cause, lost_by_exchange, sweep
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_CAPACITY, ERROR_SIZE, SOURCES
from eskf_ros.filter.state.time import NEVER, SECOND

LEARNING_HEADING_STD = 0.35
"""rad; where the heading is known no better, nothing is learnt of the faults."""

LASTING_TIME = 60.0
"""s; correlation time of the errors of fixes that last, as far as the faults are concerned."""

LEAST_INTERVAL = 0.05
"""s; interval of fixes below which more of them do not say more."""

LARGEST_FAULT = 3.0
"""Prior standard deviations; an estimate beyond is no fault of the installation, whatever it is."""

MEMORY = 600.0
"""s; time constant with which the normal equations of the faults forget."""

FAULT_PRIOR = (5.0, 5.0, 5.0, 1.0, 1.0, 0.03, 1e-4)
"""Prior standard deviations of the faults (m, m, m, s, s, 1, rad/s2)."""

FAULT_SIGMAS = 6.0
"""Standard deviations from zero beyond which a fault is reported."""

CONSIDERED_SIGMAS = 3.0
"""Standard deviations from zero beyond which a fault is estimated, and what faults do to an error is allowed for: to be
wrong costs certainty only."""

FOUND_SIGMAS = 1.0
"""The same once a fault is certain (`FAULT_SIGMAS`): what is left of it at the moment is allowed for, too."""

LEVER_ARM_ERROR = 0.05
"""m; smaller errors of the lever arm are not reported."""

TIME_ERROR = 0.01
"""s; smaller time offsets are not reported."""

SCALE_ERROR = 0.003
"""Smaller scale errors of the gyros are not reported."""

DRIFT_ERROR = 2e-6
"""rad/s2 (0.4 deg/s in an hour); smaller drifts of the gyro bias are not reported."""

LEAST_FAULT = (LEVER_ARM_ERROR, LEVER_ARM_ERROR, LEVER_ARM_ERROR, TIME_ERROR, TIME_ERROR, SCALE_ERROR, DRIFT_ERROR)
"""Faults that are not reported (m, m, m, s, s, 1, rad/s2)."""

LEAKAGE = 0.3
"""Share of the significance of the most certain fault above which another is certain, too."""

LASTING_LOOKS = 6
"""Looks in a row at which a fault must be certain to be reported: errors that last look like one for a while."""

CHECK_INTERVAL = 5 * SECOND
"""ns; time between two looks at the estimated faults."""

INSTALLATION = np.dtype(
    [
        ("stamp", "i8"),
        ("force", "f8", (3,)),
        ("absorbed", "f8", (SOURCES, ERROR_CAPACITY, FAULTS)),
        ("information", "f8", (SOURCES, FAULTS, FAULTS)),
        ("evidence", "f8", (SOURCES, FAULTS)),
        ("misfit", "f8", (SOURCES, 2)),
        ("unexplained", "f8", (SOURCES,)),
        ("checked", "i8"),
        ("estimate", "f8", (SOURCES, FAULTS)),
        ("found", "f8", (SOURCES, FAULTS)),
        ("covariance", "f8", (SOURCES, FAULTS, FAULTS)),
        ("sigma", "f8", (SOURCES, FAULTS)),
        ("held", "i8", (SOURCES, FAULTS)),
        ("is_considered", "i8", (SOURCES,)),
        ("considered", "f8", (SOURCES, ERROR_SIZE)),
    ],
    align=True,
)
"""Estimation of the faults of the installation, by receiver.

- ``stamp``, ``force``: stamp (ns) and specific force (m/s2, map) of its last step.
- ``absorbed``: derivative of the errors, augmented states included, by the faults.
- ``information``, ``evidence``: normal equations of the faults. ``misfit``: sum of the NIS that they are to explain,
  and of its degrees of freedom; ``unexplained``: the part of this sum that they leave.
- ``checked``: when they were solved last (ns).
- ``estimate``, ``covariance``, ``sigma``: the faults, true minus configured, their covariance and standard deviations.
- ``found``: those that are certain, else 0; ``held``: for how many looks in a row they have been so.
- ``is_considered``, ``considered``: whether faults have an effect on the 15 errors of the core that is not chance, and
  that effect: `update_considered`.
"""


@njit
def learn_faults(state, aid, size, gate, work, settings):
    """Carry the effect of the faults on the state through one update, and learn from its innovation."""
    if state.heading_known == 0 or aid.verdict == Verdict.RESET:
        forget_faults(state)
        return
    if aid.verdict == Verdict.TAKEOVER:
        # A wrong lever arm or time offset may be why the filter seemed wrong: the evidence stays. The humble lane has
        # heard the same receivers, and has followed the faults much as the filter has.
        if state.installation.stamp != NEVER:
            carry_absorbed(state, settings)
        return
    if state.covariance[HEADING, HEADING] > LEARNING_HEADING_STD**2:
        # Far from the truth the derivatives are others.
        state.installation.stamp = NEVER
        state.installation.is_considered.fill(0)
        return
    if state.installation.stamp == NEVER:
        absorb_completely(state, settings)
    dt = carry_absorbed(state, settings)
    accepted = aid.verdict in (Verdict.FUSED, Verdict.WEIGHED_DOWN)
    for source in range(SOURCES):
        absorbed, effect = state.installation.absorbed[source], work.effect
        is_own = source == aid.source and aid.stream in (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY)
        for a in range(size):
            for k in range(FAULTS):
                effect[a, k] = work.direct_effect[a, k] if is_own else 0.0
                for i in range(state.error_size):
                    effect[a, k] -= work.jacobian[a, i] * absorbed[i, k]
        if is_own:
            weigh_faults(state, source, dt, min(1.0, gate / max(aid.nis, 1e-9)), work)
        if accepted:
            for i in range(state.error_size):
                for k in range(FAULTS):
                    for a in range(size):
                        absorbed[i, k] += work.gain[i, a] * effect[a, k]
        update_considered(state, source)


@njit
def forget_faults(state):
    """Forget what was learnt of the faults from an estimate that was wrong."""
    state.installation.stamp = NEVER
    state.installation.information.fill(0.0)
    state.installation.evidence.fill(0.0)
    state.installation.misfit.fill(0.0)
    state.installation.found.fill(0.0)
    state.installation.estimate.fill(0.0)
    state.installation.is_considered.fill(0)


@njit
def update_considered(state, source):
    """Update what the faults of a receiver, as they are estimated, do to the errors of the core.

    The estimate is not corrected by it: it is held in the covariance that is published, as the effect of consider
    parameters (Schmidt, 1966; Tapley, Schutz and Born, Statistical Orbit Determination, section 6.5).
    """
    installation = state.installation
    absorbed, estimate = installation.absorbed[source], installation.estimate[source]
    covariance = installation.covariance[source]
    is_found = False
    for k in range(FAULTS):
        is_found |= installation.found[source, k] != 0.0
    sigmas = FOUND_SIGMAS if is_found else CONSIDERED_SIGMAS
    installation.is_considered[source] = 0
    for i in range(ERROR_SIZE):
        effect, variance = 0.0, 0.0
        for k in range(FAULTS):
            effect += absorbed[i, k] * estimate[k]
            for m in range(FAULTS):
                variance += absorbed[i, k] * covariance[k, m] * absorbed[i, m]
        is_certain = effect * effect > sigmas**2 * variance
        installation.considered[source, i] = effect if is_certain else 0.0
        if is_certain:
            installation.is_considered[source] = 1


@njit
def weigh_faults(state, source, dt, weight, work):
    """Add one innovation to the normal equations of the faults; ``work.innovation_covariance`` is inverted already.

    ``dt`` (s): the time since the last measurement; ``weight``: below 1 for an innovation outside the gate.
    """
    inverse, effect = work.innovation_covariance, work.effect
    remains = max(0.0, 1.0 - dt / MEMORY)
    misfit = state.installation.misfit[source]
    misfit[0] *= remains
    misfit[1] = remains * misfit[1] + 3.0
    for a in range(3):
        for b in range(3):
            misfit[0] += weight * work.innovation[a] * inverse[a, b] * work.innovation[b]
    for k in range(FAULTS):
        state.installation.evidence[source, k] *= remains
        for m in range(FAULTS):
            state.installation.information[source, k, m] *= remains
        for a in range(3):
            spread = 0.0
            for b in range(3):
                spread += effect[b, k] * inverse[b, a]
            state.installation.evidence[source, k] += weight * spread * work.innovation[a]
            for m in range(FAULTS):
                state.installation.information[source, k, m] += weight * spread * effect[a, m]


@njit
def find_faults(state, work):
    """Estimate the faults every `CHECK_INTERVAL`, and note which are certain.

    Only faults that the innovations ask for one after the other are estimated, the others are zero (`stepwise`): a
    lever arm, a time offset and a scale explain much the same in smooth motion.
    """
    if state.stamp - state.installation.checked < CHECK_INTERVAL:
        return
    state.installation.checked = state.stamp
    fit, is_chosen = work.fault_fit, work.is_chosen
    for source in range(SOURCES):
        write_normal_equations(state, source, fit)
        choose_faults(state, source, fit, is_chosen)
        write_estimates(state, source, fit, is_chosen)
        note_certain_faults(state, source, fit, is_chosen)


@njit
def write_estimates(state, source, fit, is_chosen):
    """Write the estimates of the chosen faults of a receiver and their covariance; the others are zero.

    Innovations that the faults leave unexplained, a scatter that is larger than expected, and errors of fixes that last
    widen the covariance (`widening`).
    """
    installation, unexplained = state.installation, fit[FAULTS, FAULTS]
    installation.unexplained[source] = unexplained
    widest = widening(state, source, 0, unexplained)
    for k in range(FAULTS):
        variance = fit[k, k] if is_chosen[k] else 1.0 / fit[k, k]
        installation.estimate[source, k] = fit[k, FAULTS] if is_chosen[k] else 0.0
        installation.sigma[source, k] = math.sqrt(variance * widening(state, source, k, unexplained))
        for m in range(FAULTS):
            covariance = fit[k, m] * widest if is_chosen[k] and is_chosen[m] else 0.0
            installation.covariance[source, k, m] = covariance


@njit
def note_certain_faults(state, source, fit, is_chosen):
    """Note which faults are certain: neither none nor another in its place explains nearly as much.

    A large fault leaks into the estimates of the others.
    """
    installation, largest = state.installation, 0.0
    for k in range(FAULTS):
        largest = max(largest, abs(installation.estimate[source, k]) / installation.sigma[source, k])
    for k in range(FAULTS):
        estimate, sigma = installation.estimate[source, k], installation.sigma[source, k]
        is_small = abs(estimate) < max(FAULT_SIGMAS, LEAKAGE * largest) * sigma or abs(estimate) < LEAST_FAULT[k]
        is_certain = is_chosen[k] and not is_small and abs(estimate) < LARGEST_FAULT * FAULT_PRIOR[k]
        if is_certain:
            least = FAULT_SIGMAS**2 * widening(state, source, k, installation.unexplained[source])
            is_certain = lost_by_exchange(fit, is_chosen, k) > least
        installation.found[source, k] = estimate if is_certain else 0.0
        installation.held[source, k] = installation.held[source, k] + 1 if is_certain else 0


@njit
def write_normal_equations(state, source, fit):
    """Write the normal equations of the faults of a receiver, with their priors, as `stepwise` wants them."""
    for k in range(FAULTS):
        for m in range(FAULTS):
            fit[k, m] = state.installation.information[source, k, m]
        fit[k, k] += 1.0 / FAULT_PRIOR[k] ** 2
        fit[k, FAULTS] = fit[FAULTS, k] = state.installation.evidence[source, k]
    fit[FAULTS, FAULTS] = state.installation.misfit[source, 0]


@njit
def choose_faults(state, source, fit, is_chosen):
    """Choose the faults one after the other, the one that explains most first, while one is not chance.

    Errors of fixes that last do not count here: a fault that is not chosen is taken to be zero, and they are no reason
    for that. They widen what is found (`widening`).
    """
    is_chosen.fill(0)
    while True:
        best, most = best_cause(fit, is_chosen)
        if best < 0 or most < CONSIDERED_SIGMAS**2 * excess_of(state, source, fit[FAULTS, FAULTS] - most):
            return
        sweep(fit, best)
        is_chosen[best] = 1


@njit
def excess_of(state, source, unexplained):
    """Return the ratio of the scatter of the innovations to what is expected, at least 1.

    ``unexplained``: the part of the sum of NIS that the faults leave.
    """
    excess = max(1.0, max(state.scatter.velocity[source], state.scatter.spread[source]))
    return max(excess, unexplained / max(state.installation.misfit[source, 1], 1.0))


@njit
def widening(state, source, fault, unexplained):
    """Return the ratio of the variance of an estimated fault to that of the normal equations."""
    excess = excess_of(state, source, unexplained)
    return excess if fault == VELOCITY_TIME else excess + fixes_together(state, source)


@njit
def fixes_together(state, source):
    """Return how many times the variance of a mean of fixes is that of independent ones: their errors last.

    Of a Gauss-Markov error it is twice its time over the interval of the fixes (Papoulis, Probability, Random Variables
    and Stochastic Processes, on ergodicity of the mean).
    """
    interval = max(1e-9 * state.recovery.absolute_interval, LEAST_INTERVAL)
    return 2.0 * LASTING_TIME / interval * state.scatter.calm[source]
