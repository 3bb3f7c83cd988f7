"""The log of the forward pass, for a smoother: what the filter knew before and after the measurements of each stamp.

Nothing is kept unless somebody asks for it (``settings.keeps_log``). A node is a stamp at which measurements changed
the estimate, or `LONGEST_INTERVAL` after the last one: nominal state and covariance before and after them, the matrix
by which resets turned the errors in between, and the transition matrix of the errors from the node before. A
point is the nominal state at an output stamp, before the measurements of that stamp. Where the log stands is part of
the state, so a rewind takes back what it makes wrong.

A smoother must not carry anything over a change that the transition does not describe. A node is linked to the one
before if the estimate was only predicted in between, and continued if its measurements only updated it: no start, no
reset, no takeover (`breaks_of`). Augmented states that were reset are listed one by one (``renewed``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.compiled import njit
from eskf_ros.filter.history.arguments import copied
from eskf_ros.filter.history.timeline import latest_of
from eskf_ros.filter.inertial.covariance import apply_transition, vertical
from eskf_ros.filter.output.status import quality_of, status_of
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ERROR_SIZE, OPTIONAL_CAPACITY
from eskf_ros.filter.state.lanes import FILTER
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import SECOND

FORWARD = np.dtype(
    [
        ("node_next", "i8"),
        ("point_next", "i8"),
        ("node_stamp", "i8"),
        ("breaks", "i8"),
        ("given_stamp", "i8"),
        ("breaks_before", "i8"),
        ("given_before", "i8"),
        ("is_open", "i8"),
        ("renewed", "i8"),
        ("transition", "f8", (ERROR_SIZE, ERROR_SIZE)),
        ("reset", "f8", (3, 3)),
        ("fade", "f8", (OPTIONAL_CAPACITY,)),
        ("clock_gain", "f8"),
    ],
    align=True,
)
"""Where the log stands, and the transition of the errors since its last node.

- ``node_next``, ``point_next``: index of the next node and point in the buffers.
- ``node_stamp``, ``breaks``, ``given_stamp``: of the last node: stamp (ns), and what must be the same for a link.
- ``is_open``, ``breaks_before``, ``given_before``: whether a node waits for its end; the same before its measurements.
- ``renewed``: augmented states that were reset, as bits.
- ``reset``: product of the matrices by which updates turned the errors (`kalman_update.reset_errors`).
- ``transition``: of the core; ``fade``: of each augmented state; ``clock_gain``: drift to bias of the clock (s).
"""

NODE = np.dtype(
    [
        ("stamp", "i8"),
        ("size_before", "i8"),
        ("size_after", "i8"),
        ("has_before", "i8"),
        ("has_after", "i8"),
        ("is_linked", "i8"),
        ("is_continued", "i8"),
        ("renewed", "i8"),
    ],
    align=True,
)
"""The facts of a node; its numbers are a row of another array, because their count depends on the parameters.

``size_before``, ``size_after``: errors in use; ``has_before``, ``has_after``: whether level and position were known.
"""

NOMINAL = 16 + OPTIONAL_CAPACITY
"""Numbers of a nominal state: position, velocity, attitude (w x y z), accelerometer bias, gyro bias, augmented."""

BEFORE, AFTER = 0, NOMINAL
"""Places of the nominal states in the numbers of a node."""

TRANSITION = 2 * NOMINAL
"""Place of the nine rows of the transition of the core that are not those of the identity."""

FADE = TRANSITION + ACCEL_BIAS * ERROR_SIZE
"""Place of the transition of the augmented states: their fading, then the gain from clock drift to clock bias."""

RESET = FADE + OPTIONAL_CAPACITY + 1
"""Place of the matrix that turned the attitude error between before and after, by rows."""

COVARIANCE_BEFORE = RESET + 9
"""Place of the covariance before: its lower triangle by rows; that after follows, at the middle of what is left."""

POINT = np.dtype(
    [
        ("stamp", "i8"),
        ("status", "i4"),
        ("quality", "i4"),
        ("heading_known", "i8"),
        ("position_map", "f8", (3,)),
        ("velocity_map", "f8", (3,)),
        ("attitude", "f8", (4,)),
        ("accel_bias", "f8", (3,)),
        ("gyro_bias", "f8", (3,)),
        ("angular_rate", "f8", (3,)),
    ],
    align=True,
)
"""The nominal state (IMU in map) and the raw angular rate (rad/s, IMU axes) at an output stamp."""

LONGEST_INTERVAL = SECOND
"""ns; without measurements there is a node after this time: corrections are interpolated between nodes."""


class Log(NamedTuple):
    """Buffers of the log: facts (n,) and numbers (n, width) of the nodes, and points (m,)."""

    nodes: NDArray[Any]
    numbers: NDArray[np.float64]
    points: NDArray[Any]


def allocate_log(size: int, node_count: int, point_count: int) -> Log:
    """Return buffers for nodes with up to ``size`` errors; for the size 0 next to nothing."""
    width = COVARIANCE_BEFORE + size * (size + 1)
    return Log(allocate(NODE, max(1, node_count)), np.zeros((max(1, node_count), width)), allocate(POINT, point_count))


def grown(log: Log, node_count: int, point_count: int) -> Log:
    """Return buffers for ``node_count`` nodes and ``point_count`` points, or more, with the same contents."""
    if len(log.nodes) >= node_count and len(log.points) >= point_count:
        return log
    bigger = allocate_log(0, max(node_count, len(log.nodes)), max(point_count, len(log.points)))
    bigger = bigger._replace(numbers=np.zeros((len(bigger.nodes), log.numbers.shape[1])))
    for new, old in zip(bigger, log, strict=True):
        new[: len(old)] = old
    return bigger


def take_log(
    log: Log, states: NDArray[Any], checkpoints: NDArray[Any], timeline: NDArray[Any], everything: bool
) -> Log:
    """Return what can no longer change, and drop it from the buffers: what is before any checkpoint still needed."""
    node_count, point_count = final_count(states, checkpoints, timeline, everything)
    taken = Log(copied(log.nodes, node_count), log.numbers[:node_count].copy(), copied(log.points, point_count))
    drop_log(log, states, checkpoints, timeline, node_count, point_count)
    return taken


@njit
def breaks_of(state):
    """Return a number that changes with every start, reset and takeover; -1 while something is not known."""
    if state.level_known == 0 or state.position_known == 0 or state.heading_known == 0:
        return -1
    return state.restarts + state.recovery.resets + state.trust.takeovers + state.tight.range_faults


@njit
def carry_transition(state, rotation, force, gravity, dt, coupling, settings):
    """Carry the transition since the last node over one interval; arguments as of `propagate_covariance`."""
    forward = state.forward
    up, gradient = vertical(gravity)
    transition = forward.transition
    apply_transition(
        transition, transition, ERROR_SIZE, rotation, force, up, gradient, state.frame.earth_rate_map, dt, coupling
    )
    bias = settings.clock_at - ERROR_SIZE
    if settings.clock_at < state.error_size:
        forward.clock_gain += dt * forward.fade[bias + 1]
    for k in range(state.error_size - ERROR_SIZE):
        remaining = 1.0 - settings.optional_decay[k] * dt
        forward.fade[k] *= remaining
        if k == bias:
            forward.clock_gain *= remaining


@njit
def write_state(state, log, k, place, covariance_place):
    """Write the nominal state and the covariance to the numbers of node ``k``."""
    numbers = log.numbers[k]
    for i in range(3):
        numbers[place + i] = state.position_map[i]
        numbers[place + 3 + i] = state.velocity_map[i]
        numbers[place + 10 + i] = state.accel_bias[i]
        numbers[place + 13 + i] = state.gyro_bias[i]
    for i in range(4):
        numbers[place + 6 + i] = state.attitude[i]
    for i in range(state.error_size - ERROR_SIZE):
        numbers[place + 16 + i] = state.optional[i]
    at = covariance_place
    for i in range(state.error_size):
        for j in range(i + 1):
            numbers[at] = state.covariance[i, j]
            at += 1


@njit
def open_node(state, log):
    """Begin a node with the estimate before the measurements of its stamp."""
    forward = state.forward
    k = forward.node_next
    node = log.nodes[k]
    forward.breaks_before, forward.given_before = breaks_of(state), state.heading.given_stamp
    same = forward.breaks_before == forward.breaks and forward.given_before == forward.given_stamp
    node.stamp = state.stamp
    node.size_before = state.error_size
    node.has_before = state.level_known * state.position_known
    node.is_linked = 1 if same and forward.breaks >= 0 else 0
    write_state(state, log, k, BEFORE, COVARIANCE_BEFORE)
    numbers = log.numbers[k]
    for i in range(ACCEL_BIAS):
        for j in range(ERROR_SIZE):
            numbers[TRANSITION + ERROR_SIZE * i + j] = forward.transition[i, j]
    for i in range(OPTIONAL_CAPACITY):
        numbers[FADE + i] = forward.fade[i]
    numbers[FADE + OPTIONAL_CAPACITY] = forward.clock_gain
    forward.is_open = 1


@njit
def close_node(state, log, is_kept, settings):
    """End the open node with the estimate after its measurements.

    If they changed nothing it is dropped, unless it ``is_kept``.
    """
    forward = state.forward
    forward.is_open = 0
    k = forward.node_next
    node = log.nodes[k]
    node.has_after = state.level_known * state.position_known
    if node.has_before == 0 and node.has_after == 0:
        return
    if not is_kept and not is_changed(state, log, k):
        return
    breaks, given = breaks_of(state), state.heading.given_stamp
    same = breaks == forward.breaks_before and given == forward.given_before
    node.is_continued = 1 if same and breaks >= 0 else 0
    node.size_after = state.error_size
    node.renewed = forward.renewed
    for i in range(3):
        for j in range(3):
            log.numbers[k, RESET + 3 * i + j] = forward.reset[i, j]
    fade_before(forward, log, k, settings)
    write_state(state, log, k, AFTER, (COVARIANCE_BEFORE + log.numbers.shape[1]) // 2)
    forward.breaks, forward.given_stamp = breaks, given
    begin_interval(state)
    forward.node_next += 1


@njit
def begin_interval(state):
    """Begin the interval after a node: the transition is the identity."""
    forward = state.forward
    forward.node_stamp = state.stamp
    forward.renewed = 0
    forward.clock_gain = 0.0
    for i in range(OPTIONAL_CAPACITY):
        forward.fade[i] = 1.0
    for i in range(ERROR_SIZE):
        for j in range(ERROR_SIZE):
            forward.transition[i, j] = 1.0 if i == j else 0.0
    for i in range(3):
        for j in range(3):
            forward.reset[i, j] = forward.transition[i, j]


@njit
def is_changed(state, log, k):
    """Say whether the measurements changed anything in the estimate: a variance at least."""
    if state.error_size != log.nodes[k].size_before or breaks_of(state) != state.forward.breaks_before:
        return True
    at = COVARIANCE_BEFORE - 1
    for i in range(state.error_size):
        at += i + 1
        if log.numbers[k, at] != state.covariance[i, i]:
            return True
    return False


@njit
def fade_before(forward, log, k, settings):
    """Move the fading of augmented states that came with the measurements (magnetometer) into the prediction.

    Their variance without measurements stays the initial one, as `mag.propagate_mag_error` has it.
    """
    numbers = log.numbers[k]
    for m in range(log.nodes[k].size_before - ERROR_SIZE):
        if forward.fade[m] == numbers[FADE + m]:
            continue
        fading = forward.fade[m] / numbers[FADE + m]
        numbers[FADE + m] = forward.fade[m]
        numbers[BEFORE + 16 + m] *= fading
        row = ERROR_SIZE + m
        for j in range(log.nodes[k].size_before):
            a, b = max(row, j), min(row, j)
            numbers[COVARIANCE_BEFORE + a * (a + 1) // 2 + b] *= fading * fading if j == row else fading
        noise = (1.0 - fading * fading) * settings.optional_std[m] ** 2
        numbers[COVARIANCE_BEFORE + row * (row + 1) // 2 + row] += noise


@njit
def log_sample(state, log, is_point, settings):
    """Add what an IMU sample needs: a node if the last one is long ago, and a point on the output grid."""
    if state.level_known == 0 or state.position_known == 0:
        return
    if state.stamp - state.forward.node_stamp >= LONGEST_INTERVAL:
        open_node(state, log)
        close_node(state, log, True, settings)
    if not is_point:
        return
    point = log.points[state.forward.point_next]
    point.stamp = state.stamp
    point.status = status_of(state, settings)
    point.quality = quality_of(state, point.status, settings)
    point.heading_known = state.heading_known
    for i in range(3):
        point.position_map[i] = state.position_map[i]
        point.velocity_map[i] = state.velocity_map[i]
        point.accel_bias[i] = state.accel_bias[i]
        point.gyro_bias[i] = state.gyro_bias[i]
        point.angular_rate[i] = state.angular_rate[i]
    for i in range(4):
        point.attitude[i] = state.attitude[i]
    state.forward.point_next += 1


@njit
def log_end(state, log, settings):
    """Add a last node, so that no point is behind all nodes."""
    if state.level_known == 1 and state.position_known == 1 and state.stamp > state.forward.node_stamp:
        open_node(state, log)
        close_node(state, log, True, settings)


@njit
def final_count(states, checkpoints, timeline, everything):
    """Return how many nodes and points can no longer change: no rewind goes back to a checkpoint before them."""
    t = timeline[0]
    forward = states[FILTER].forward
    if everything:
        return forward.node_next, forward.point_next
    keep = -1
    while keep + 1 < t.checkpoint_count and latest_of(checkpoints[keep + 1, FILTER]) < t.frontier - t.window:
        keep += 1
    if keep < 0:
        return 0, 0
    forward = checkpoints[keep, FILTER].forward
    return max(0, forward.node_next), max(0, forward.point_next)


@njit
def drop_log(log, states, checkpoints, timeline, node_count, point_count):
    """Drop the first nodes and points from the buffers."""
    forward = states[FILTER].forward
    for i in range(node_count, forward.node_next):
        log.nodes[i - node_count] = log.nodes[i]
        for j in range(log.numbers.shape[1]):
            log.numbers[i - node_count, j] = log.numbers[i, j]
    for i in range(point_count, forward.point_next):
        log.points[i - point_count] = log.points[i]
    forward.node_next -= node_count
    forward.point_next -= point_count
    for k in range(timeline[0].checkpoint_count):
        checkpoints[k, FILTER].forward.node_next -= node_count
        checkpoints[k, FILTER].forward.point_next -= point_count
