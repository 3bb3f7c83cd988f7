"""The backward pass: equal to batch least squares, and to a filter that comes from the other end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.forward_log import (
    AFTER,
    BEFORE,
    COVARIANCE_BEFORE,
    FADE,
    NODE,
    POINT,
    RESET,
    TRANSITION,
    Log,
)
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ERROR_SIZE, OPTIONAL_CAPACITY
from eskf_ros.filter.state.memory import allocate
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate
from eskf_ros.smooth.backward import (
    CORRECTION_AFTER,
    CORRECTION_BEFORE,
    PASS,
    SMOOTHED_AFTER,
    SMOOTHED_BEFORE,
    smooth_nodes,
)
from eskf_ros.smooth.smoother import Smoother
from eskf_ros.smooth.trajectory import correct_point
from monte_carlo import NO_REST, feed, messages_of
from support.kernels import make_state
from support.reference_filter import mean_rotation

Array = NDArray[np.float64]

CLOCK = 18
SIZE = 20
"""Errors of the linear case: the core, three that fade, bias and drift of a clock."""

SCALE = np.ones(SIZE)
SCALE[6:9] = 1e-10
"""Attitude errors so small that their composition is a sum: the case is linear."""

NODES, JOINED, RENEWED = 9, 4, 7
"""Nodes of the linear case, at which of them the clock joins, and the first fading error is another one."""


def triangle(matrix: Array) -> Array:
    return matrix[np.tril_indices(len(matrix))]


def matrix_of(numbers: Array, place: int, size: int) -> Array:
    """The symmetric matrix whose lower triangle lies at ``place``."""
    found = np.zeros((size, size))
    found[np.tril_indices(size)] = numbers[place : place + size * (size + 1) // 2]
    return found + np.tril(found, -1).T


def nominal_of(numbers: Array, place: int) -> Array:
    """Position, velocity, rotation vector, biases and augmented states of a node."""
    x = numbers[place : place + 16 + OPTIONAL_CAPACITY]
    turn = Rotation.from_quat(x[[7, 8, 9, 6]]).as_rotvec()
    return np.concatenate([x[:6], turn, x[10:]])


def put_nominal(numbers: Array, place: int, x: Array) -> None:
    """Write errors (n,) of a nominal state zero, whose rotation is tiny."""
    numbers[place : place + 6] = x[:6]
    numbers[place + 6] = 1.0
    numbers[place + 7 : place + 10] = 0.5 * x[6:9]
    numbers[place + 10 : place + 10 + len(x) - 9] = x[9:]


class LinearCase:
    """Random linear equations, filtered by plain numpy into a log, and solved as one least squares problem."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.nodes = allocate(NODE, NODES)
        self.numbers = np.zeros((NODES, COVARIANCE_BEFORE + SIZE * (SIZE + 1)))
        self.after: list[Array] = []
        self.resets: list[Array] = []
        # Rows of the least squares problem: coefficients of all errors of all nodes (scaled), and right sides.
        self.rows: list[Array] = []
        self.values: list[float] = []
        self.filter()

    def add_rows(self, parts: dict[int, Array], values: Array, covariance: Array) -> None:
        """Add equations sum of parts[k] x_k = values, with errors of this covariance; unscaled."""
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        rows = np.zeros((len(values), NODES * SIZE))
        for k, part in parts.items():
            rows[:, k * SIZE : k * SIZE + part.shape[1]] = part * SCALE[: part.shape[1]]
        self.rows += list(root @ rows)
        self.values += list(root @ values)

    def spd(self, size: int, scale: Array) -> Array:
        a = self.random.normal(size=(size, size))
        return scale[:, None] * (a @ a.T / size + 0.3 * np.eye(size)) * scale

    def transition(self, numbers: Array, size: int) -> Array:
        """A random transition of the form that the log keeps, written to it."""
        r = self.random
        f = np.eye(size)
        core = (np.eye(ERROR_SIZE) + 0.2 * r.normal(size=(ERROR_SIZE, ERROR_SIZE)))[:ACCEL_BIAS]
        core *= SCALE[:ACCEL_BIAS, None] / SCALE[:ERROR_SIZE]
        f[:ACCEL_BIAS, :ERROR_SIZE] = core
        fade = r.uniform(0.8, 1.0, OPTIONAL_CAPACITY)
        f[np.arange(ERROR_SIZE, size), np.arange(ERROR_SIZE, size)] = fade[: size - ERROR_SIZE]
        if size > CLOCK:
            f[CLOCK, CLOCK + 1] = 0.3
        numbers[TRANSITION:FADE] = core.ravel()
        numbers[FADE : FADE + OPTIONAL_CAPACITY] = fade
        numbers[FADE + OPTIONAL_CAPACITY] = 0.3
        return f

    def join(self, k: int, x: Array, p: Array) -> tuple[Array, Array]:
        """What joins or is renewed at node ``k``, with the equations that say what is known of it."""
        if k == JOINED:
            self.add_rows({k: np.eye(SIZE)[CLOCK:]}, np.zeros(2), np.diag([4.0, 1.0]))
            x, p = np.concatenate([x, np.zeros(2)]), block_diag(p, np.diag([4.0, 1.0]))
        if k == RENEWED:
            x[ERROR_SIZE], p[ERROR_SIZE], p[:, ERROR_SIZE] = 0.0, 0.0, 0.0
            p[ERROR_SIZE, ERROR_SIZE] = 9.0
            self.nodes[k]["renewed"] = 1
            self.add_rows({k: np.eye(SIZE)[ERROR_SIZE : ERROR_SIZE + 1]}, np.zeros(1), np.diag([9.0]))
        return x, p

    def filter(self) -> None:
        size = CLOCK
        x, p = np.zeros(size), self.spd(size, SCALE[:size])
        self.add_rows({0: np.eye(size)}, x, p)
        for k in range(NODES):
            node, numbers = self.nodes[k], self.numbers[k]
            if k:
                f, q = self.transition(numbers, size), self.spd(size, 0.5 * SCALE[:size])
                kept = np.array([i for i in range(size) if k != RENEWED or i != ERROR_SIZE])
                # The errors that the transition carries are those whose axes the reset has turned.
                turned, offset = f @ self.reset[:size, :size], f @ (x - self.reset[:size, :size] @ x)
                self.add_rows({k - 1: -turned[kept], k: np.eye(size)[kept]}, offset[kept], q[np.ix_(kept, kept)])
                x, p = f @ x, f @ p @ f.T + q
            node["stamp"], node["is_linked"], node["is_continued"] = k, k > 0, k > 0
            node["has_before"] = node["has_after"] = 1
            node["size_before"] = size
            put_nominal(numbers, BEFORE, x)
            numbers[COVARIANCE_BEFORE : COVARIANCE_BEFORE + size * (size + 1) // 2] = triangle(p)
            x, p = self.join(k, x, p)
            size = len(x)
            h, r = self.random.normal(size=(3, size)) / SCALE[:size], self.spd(3, np.ones(3))
            z = self.random.normal(size=3) * 3.0
            self.add_rows({k: h}, z, r)
            gain = np.linalg.solve(h @ p @ h.T + r, h @ p).T
            x = x + gain @ (z - h @ x)
            rest = np.eye(size) - gain @ h
            p = rest @ p @ rest.T + gain @ r @ gain.T
            self.reset = np.eye(SIZE)
            turn = np.eye(3) + 0.2 * self.random.normal(size=(3, 3))
            self.reset[:9, :9] = np.kron(np.eye(3), turn)
            self.resets.append(self.reset[:ERROR_SIZE, :ERROR_SIZE])
            numbers[RESET : RESET + 9] = turn.ravel()
            p = self.reset[:size, :size] @ p @ self.reset[:size, :size].T
            node["size_after"] = size
            put_nominal(numbers, AFTER, x)
            after = (COVARIANCE_BEFORE + len(numbers)) // 2
            numbers[after : after + size * (size + 1) // 2] = triangle(p)
            self.after.append(x)

    def solution(self) -> tuple[Array, Array]:
        """Errors (nodes, 15) and their covariances (nodes, 15, 15), scaled, by least squares over all nodes at once."""
        rows, values = np.array(self.rows), np.array(self.values)
        used = np.flatnonzero(np.abs(rows).max(axis=0) > 0.0)
        x, covariance = np.zeros(NODES * SIZE), np.zeros((NODES * SIZE, NODES * SIZE))
        q, r = np.linalg.qr(rows[:, used])
        root = np.linalg.inv(r)
        x[used], covariance[np.ix_(used, used)] = root @ (q.T @ values), root @ root.T
        core = [slice(k * SIZE, k * SIZE + ERROR_SIZE) for k in range(NODES)]
        return np.array([x[part] for part in core]), np.array([covariance[part, part] for part in core])


@pytest.mark.parametrize("seed", range(4))
def test_equal_to_least_squares_over_all_nodes(seed: int) -> None:
    """With states that join, one that is renewed and axes that are turned in between, to 1e-9 standard deviations."""
    case = LinearCase(seed)
    expected, covariance = case.solution()
    smooth_nodes(case.nodes, case.numbers, allocate(PASS), CLOCK)
    scale = SCALE[:ERROR_SIZE]
    for k in range(NODES):
        numbers = case.numbers[k]
        back = np.linalg.inv(case.resets[k])
        found = (case.after[k][:ERROR_SIZE] + back @ numbers[CORRECTION_AFTER : CORRECTION_AFTER + ERROR_SIZE]) / scale
        np.testing.assert_allclose(found, expected[k], atol=1e-9 * np.sqrt(np.diag(covariance[k])).max())
        spread = back @ matrix_of(numbers, SMOOTHED_AFTER, ERROR_SIZE) @ back.T / scale / scale[:, None]
        np.testing.assert_allclose(spread, covariance[k], atol=1e-9 * np.abs(covariance[k]).max())


def test_nothing_passes_a_break() -> None:
    """Before a node that is not continued the estimate is the filter's own, and after it as without what was before."""
    case, alone = LinearCase(1), LinearCase(1)
    case.nodes[5]["is_continued"] = 0
    after = (COVARIANCE_BEFORE + case.numbers.shape[1]) // 2
    last = matrix_of(case.numbers[4], after, ERROR_SIZE)
    predicted = matrix_of(case.numbers[5], COVARIANCE_BEFORE, ERROR_SIZE)
    smooth_nodes(case.nodes, case.numbers, allocate(PASS), CLOCK)
    smooth_nodes(alone.nodes[5:], alone.numbers[5:], allocate(PASS), CLOCK)
    assert not case.numbers[4, CORRECTION_AFTER : CORRECTION_AFTER + ERROR_SIZE].any()
    assert not case.numbers[5, CORRECTION_BEFORE : CORRECTION_BEFORE + ERROR_SIZE].any()
    np.testing.assert_array_equal(matrix_of(case.numbers[4], SMOOTHED_AFTER, ERROR_SIZE), last)
    np.testing.assert_array_equal(matrix_of(case.numbers[5], SMOOTHED_BEFORE, ERROR_SIZE), predicted)
    for part in (slice(CORRECTION_AFTER, ERROR_SIZE), slice(SMOOTHED_AFTER, SMOOTHED_BEFORE)):
        np.testing.assert_array_equal(case.numbers[5:, part], alone.numbers[5:, part])


def logged(recording: Recording, changes: dict[str, Any], messages: Any = None) -> tuple[Navigator, Smoother]:
    """Filter and smoother after all of a recording but the end, the log collected every second."""
    navigator = Navigator(
        from_mapping({**recording.parameters(), **NO_REST, **changes}), output_rate=20.0, keeps_log=True
    )
    smoother = Smoother(navigator)
    second = round(recording.options.imu_rate)
    for _ in feed(recording, navigator, np.arange(second - 1, len(recording.imu_stamp), second), messages):
        smoother.collect()
    navigator.finish()
    return navigator, smoother


@pytest.fixture(scope="module")
def drive() -> Recording:
    return simulate("drive", 3, stop=100.0)


def joined(logs: list[Log]) -> Log:
    return Log(*(np.concatenate([log[i] for log in logs]) for i in range(3)))


def whole_log(navigator: Navigator, smoother: Smoother) -> Log:
    """What was collected of the nodes, and the rest of them."""
    log = joined(navigator.take_log(True))
    nodes, numbers = smoother._nodes, smoother._numbers
    assert numbers is not None
    return joined([Log(nodes.read(0, len(nodes)), numbers.read(0, len(nodes)), log.points[:0]), log])


def backward_information(log: Log, first: int) -> tuple[Array, Array]:
    """Information of all measurements after node ``first`` on its errors: matrix and vector.

    A filter that starts with nothing at the last node and comes backward (Fraser and Potter, 1969). It takes from the
    log the trajectory and the transitions, and the measurements, which are positions of the IMU: what they were follows
    from what they changed in the position. The process noise is what the prediction added to the covariance.
    """
    half = (COVARIANCE_BEFORE + log.numbers.shape[1]) // 2
    matrix, vector = np.zeros((15, 15)), np.zeros(15)
    for k in range(len(log.nodes) - 1, first, -1):
        numbers = log.numbers[k]
        before, after = nominal_of(numbers, BEFORE), nominal_of(numbers, AFTER)
        step = (after - before)[:15]
        turns = [Rotation.from_quat(numbers[place + 6 + np.array([1, 2, 3, 0])]) for place in (BEFORE, AFTER)]
        step[6:9] = (turns[1] * turns[0].inv()).as_rotvec()
        turning = np.linalg.inv(mean_rotation(step[6:9]))
        step[:3], step[3:6] = turning @ step[:3], turning @ step[3:6]
        reset = np.eye(15)
        reset[:9, :9] = np.kron(np.eye(3), numbers[RESET : RESET + 9].reshape(3, 3))
        predicted = matrix_of(numbers, COVARIANCE_BEFORE, 15)
        back = np.linalg.inv(reset)
        updated = back @ matrix_of(numbers, half, 15) @ back.T
        matrix, vector = reset.T @ matrix @ reset, reset.T @ (vector + matrix @ reset @ step)
        p = predicted[:3, :3]
        if not np.array_equal(predicted, matrix_of(numbers, half, 15)):
            innovation_covariance = p @ np.linalg.solve(p - updated[:3, :3], p)
            weight = np.linalg.inv(innovation_covariance - p)
            matrix[:3, :3] += weight
            vector[:3] += weight @ innovation_covariance @ np.linalg.solve(p, step[:3])
        f = np.eye(15)
        f[:9] = numbers[TRANSITION:FADE].reshape(9, 15)
        earlier = matrix_of(log.numbers[k - 1], half, 15)
        noise = predicted - f @ earlier @ f.T
        spread = np.linalg.inv(np.eye(15) + matrix @ noise)
        matrix, vector = f.T @ spread @ matrix @ f, f.T @ spread @ vector
    return matrix, vector


@pytest.mark.parametrize("name", ["drive", "parked"])
def test_the_log_is_what_the_filter_did(name: str) -> None:
    """The logged transition and reset make the covariances of the filter out of each other.

    What a smoother of an older filter believes of F or of the reset shows here: the process noise of an interval is
    that of the parameters, and what one position takes from the covariance follows from what it takes from the position
    alone. Both in standard deviations, on a drive with turns whose heading is corrected by many of them, and parked,
    where accelerations are not believed.
    """
    recording = simulate(name, 3, stop=100.0)
    changes: dict[str, Any] = {"gnss.use_velocity": False, "gnss.lever_arm": (0.0, 0.0, 0.0)}
    if name == "parked":
        changes["alignment.initial_heading_deg"] = -75.0
    log = whole_log(*logged(recording, changes))
    half = (COVARIANCE_BEFORE + log.numbers.shape[1]) // 2
    parameters = from_mapping({**recording.parameters(), **changes}).imu
    turned, compared, intervals = 0.0, 0, 0
    for k in range(1, len(log.nodes)):
        numbers, seconds = log.numbers[k], (log.nodes["stamp"][k] - log.nodes["stamp"][k - 1]) * 1e-9
        before, after = matrix_of(numbers, COVARIANCE_BEFORE, 15), matrix_of(numbers, half, 15)
        if log.nodes["is_linked"][k] and seconds < 0.3:
            f = np.eye(15)
            f[:9] = numbers[TRANSITION:FADE].reshape(9, 15)
            noise = before - f @ matrix_of(log.numbers[k - 1], half, 15) @ f.T
            sigma = np.sqrt(np.diag(before))
            expected = np.zeros(15)
            expected[3:6] = parameters.accel_noise_density**2 * seconds
            expected[6:9] = parameters.gyro_noise_density**2 * seconds
            expected[9:12] = parameters.accel_bias_random_walk**2 * seconds
            expected[12:15] = parameters.gyro_bias_random_walk**2 * seconds
            np.testing.assert_allclose(np.diag(noise)[3:], expected[3:], rtol=0.02, atol=0.0)
            # In so short a time the noise of the gyro hardly enters the velocity.
            assert np.abs(noise[3:6, 6:9] / sigma[3:6, None] / sigma[6:9]).max() < 1e-4
            intervals += 1
        if log.nodes["is_continued"][k] and not np.array_equal(before[:3, :3], after[:3, :3]):
            back = np.eye(15)
            back[:9, :9] = np.kron(np.eye(3), np.linalg.inv(numbers[RESET : RESET + 9].reshape(3, 3)))
            sigma = np.sqrt(np.diag(before))
            taken = before - back @ after @ back.T
            root = np.linalg.solve(before[:3, :3], before[:3])
            by_position = root.T @ taken[:3, :3] @ root
            if name == "parked":
                # GNSS corrects neither heading nor gyro bias about the vertical where nothing shows them
                # (`kalman_update`): what is taken from them does not follow from the position.
                held = np.ix_([8, 14], [8, 14])
                by_position[held] = taken[held]
            np.testing.assert_allclose(taken / sigma / sigma[:, None], by_position / sigma / sigma[:, None], atol=1e-7)
            turned = max(turned, np.abs(back - np.eye(15)).max())
            compared += 1
    assert min(compared, intervals) > 200
    assert turned > 1e-3 or name == "parked"


def test_equal_to_a_filter_from_the_other_end(drive: Recording) -> None:
    """The whole filter on a drive, positions only, to a thousandth of a standard deviation.

    Its estimate and that from the other end are combined. Corrections are up to 60 standard deviations here.
    """
    log = whole_log(*logged(drive, {"gnss.use_velocity": False, "gnss.lever_arm": (0.0, 0.0, 0.0)}))
    half = (COVARIANCE_BEFORE + log.numbers.shape[1]) // 2
    smoothed = log.numbers.copy()
    smooth_nodes(log.nodes, smoothed, allocate(PASS), 36)
    chosen = [k for k in range(len(log.nodes)) if log.nodes["is_continued"][k]][20::40]
    assert len(chosen) > 5
    for k in chosen:
        matrix, vector = backward_information(log, k)
        covariance = matrix_of(log.numbers[k], half, 15)
        combined = np.linalg.solve(np.eye(15) + covariance @ matrix, covariance)
        combined = 0.5 * (combined + combined.T)
        sigma = np.sqrt(np.diag(combined))
        correction = smoothed[k, CORRECTION_AFTER : CORRECTION_AFTER + 15]
        np.testing.assert_allclose(correction / sigma, combined @ vector / sigma, atol=1e-3)
        spread = matrix_of(smoothed[k], SMOOTHED_AFTER, 15)
        np.testing.assert_allclose(np.diag(spread), np.diag(combined), rtol=1e-2)
        assert np.linalg.eigvalsh(spread / sigma / sigma[:, None]).min() > 0.0
        assert (np.diag(spread) <= np.diag(covariance) * (1.0 + 1e-6)).all()


def test_the_order_of_arrival_does_not_matter(drive: Recording) -> None:
    """Late messages, within the window, leave no trace: the smoothed rows are the same to the last bit."""
    messages = messages_of(drive)
    random = np.random.default_rng(0)
    # The last ones come in time: what never comes would make the difference.
    last = drive.imu_arrival[-1] - 1
    delays = random.uniform(0.0, 1.5e9, len(messages)).astype(np.int64)
    delayed = [(min(message[0] + delay, last), *message[1:]) for message, delay in zip(messages, delays.tolist())]
    late = sorted(delayed, key=lambda message: message[0])
    found = []
    for order in (messages, late):
        _, smoother = logged(drive, {}, order)
        smoother.smooth()
        found.append(np.concatenate(list(smoother.rows())))
    assert len(found[0]) > 1000
    assert smoother.breaks == 0
    for name in ("stamp", "position_map", "attitude_body_to_map", "pose_covariance", "accel_bias"):
        np.testing.assert_array_equal(found[0][name], found[1][name])


def test_a_smoothed_velocity_turns_along_the_arc_with_its_heading() -> None:
    """The correction of a point is injected as those of the filter: 10 m/s, whose heading is 60 degrees off."""
    state, point = make_state(), allocate(POINT)[0]
    point["attitude"][0] = 1.0
    point["velocity_map"][0] = point["position_map"][0] = 10.0
    correction = np.zeros(2 * ERROR_SIZE)
    for place in (CORRECTION_AFTER, CORRECTION_BEFORE):
        correction[place + 8] = np.pi / 3.0
        correction[place + 4] = correction[place + 1] = 10.0 * np.pi / 3.0
    correct_point(state, point, correction, correction, 0.5, 0.0)
    expected = 10.0 * np.array([0.5, np.sqrt(0.75), 0.0])
    np.testing.assert_allclose(state["velocity_map"], expected, atol=1e-9)
    np.testing.assert_allclose(state["position_map"], expected, atol=1e-9)
