"""Monte Carlo runs of the estimator over simulated recordings, and the statistics of their consistency.

The errors of a run are those of the state of the IMU against the truth, in the order and with the conventions of the
estimator's error state. For a consistent filter the normalised estimation error squared, e' P^-1 e (NEES), of a block
of n errors has the chi-square distribution with n degrees of freedom at every epoch, and the normalised innovation
squared (NIS) that of the innovation (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
Navigation, section 5.4).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from eskf_ros.filter.history.records import RECORD
from eskf_ros.filter.integrity.motion_monitor import offset_by_jumps
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import STREAM_NAMES, Verdict
from eskf_ros.filter.state.error_state import ACCEL_BIAS, ATTITUDE, ERROR_SIZE, GYRO_BIAS, POSITION, VELOCITY
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.tree import Parameters
from eskf_ros.simulate.imu import ImuMount
from eskf_ros.simulate.scenario import Recording, simulate
from eskf_ros.tables.feeding import push_row, rows_from

Array = NDArray[np.float64]

NO_SIDE_SLIP: dict[str, Any] = {"alignment.course_std_deg": 0.1}
"""The simulated car points where it drives: the estimator is told so, as it is told the noise of the sensors."""

NO_REST: dict[str, Any] = {"zupt.enabled": False}
"""The simulated car stands without swaying by a micrometre: an estimator that holds it at rest, within what springs do,
is better than it says, and its statistics say nothing of the navigation."""

BLOCKS: dict[str, slice] = {
    "position": slice(POSITION, POSITION + 3),
    "velocity": slice(VELOCITY, VELOCITY + 3),
    "attitude": slice(ATTITUDE, ATTITUDE + 3),
    "accelerometer bias": slice(ACCEL_BIAS, ACCEL_BIAS + 3),
    "gyro bias": slice(GYRO_BIAS, GYRO_BIAS + 3),
    "all 15": slice(0, ERROR_SIZE),
}


@dataclass(frozen=True)
class Run:
    """One run: at n epochs the errors of the state (n, 15), its covariance (n, 15, 15), and the final records.

    ``seconds`` (n,) from the start of the scenario; ``aligned`` (n,): the heading was known. Everything is the state
    as it was when the IMU sample of the epoch arrived.
    """

    seconds: Array
    aligned: NDArray[np.bool_]
    error: Array
    covariance: Array
    records: np.ndarray


@dataclass(frozen=True)
class Ensemble:
    """Runs of one scenario that differ in the seed only, cut to the epochs at which all are aligned.

    ``error`` (runs, epochs, 15) and ``covariance`` (runs, epochs, 15, 15) as in `Run`. ``nis`` by stream: NIS of all
    measurements offered since then, whatever became of them; ``gated``: the share of them that was outside the gate.
    """

    seconds: Array
    error: Array
    covariance: Array
    nis: dict[str, Array]
    gated: dict[str, float]

    @cached_property
    def nees(self) -> dict[str, Array]:
        """NEES by block, (runs, epochs) each."""
        return {name: nees(self.error, self.covariance, block) for name, block in BLOCKS.items()}


Message = tuple[int, str, int, Array]
"""Arrival (ns), table, stamp (ns) and row of a message."""


def feed(
    recording: Recording,
    navigator: Navigator,
    stops: NDArray[np.int64],
    messages: Sequence[Message] | None = None,
    has_arrivals: bool = False,
) -> Iterable[tuple[int, np.ndarray]]:
    """Run a recording through a navigator; yield (i, state) right after each of its IMU samples ``stops`` (indices).

    The state at a stop has seen what had arrived by then. In between, messages are handed over in bulk: the order
    makes no difference to the state (principle of the timeline) but to the time it takes. ``messages``: those of
    `messages_of`, or others, in the order of arrival. ``has_arrivals``: the navigator learns when samples came.
    """
    waiting, given, sample = messages_of(recording) if messages is None else messages, 0, 0
    for i in stops:
        now = recording.imu_arrival[i]
        while given < len(waiting) and waiting[given][0] <= now:
            arrival, name, stamp, row = waiting[given]
            push_row(navigator, name, stamp, row, arrival)
            given += 1
        part = slice(sample, i + 1)
        arrivals = recording.imu_arrival[part] if has_arrivals else None
        samples = recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part]
        navigator.push_imu(*samples, arrivals=arrivals)
        sample = i + 1
        yield int(i), navigator.state[0]


def messages_of(recording: Recording) -> list[Message]:
    """Return (arrival, table, stamp, row) of all messages of GNSS, wheels and body velocity, as they come."""
    places = np.column_stack([recording.fix_latitude_deg, recording.fix_longitude_deg, recording.fix_altitude])
    fixes = rows_from(places, recording.fix_covariance, recording.fix_covariance_type, recording.fix_status)
    velocities = rows_from(recording.velocity_enu, recording.velocity_covariance)
    tables = [
        ("gnss_position", recording.fix_stamp, recording.fix_arrival, fixes),
        ("gnss_velocity", recording.velocity_stamp, recording.velocity_arrival, velocities),
    ]
    wheel, body = recording.wheel, recording.body_velocity
    if wheel is not None:
        covariance = np.diag([wheel.speed_variance, wheel.yaw_rate_variance, -1.0])
        values = np.column_stack([wheel.speed, wheel.yaw_rate, np.zeros(len(wheel.speed))])
        tables.append(("wheel", wheel.stamp, wheel.arrival, rows_from(values, covariance)))
    if body is not None:
        tables.append(("body_velocity", body.stamp, body.arrival, rows_from(body.velocity, np.diag(body.variance))))
    found = [
        (int(arrival), name, int(stamp), row)
        for name, stamps, arrivals, rows in tables
        for stamp, arrival, row in zip(stamps, arrivals, rows)
    ]
    return sorted(found, key=lambda message: message[0])


def state_error(recording: Recording, i: int, truth: int, state: np.void) -> Array:
    """Return the error (15,), truth minus estimate, of ``state`` at IMU sample ``i`` and truth sample ``truth``."""
    mount = ImuMount(recording.options.imu_position, recording.options.imu_rpy_deg)
    body_to_map = Rotation.from_quat(np.roll(recording.truth_attitude_body_to_map[truth], -1))
    sway_body = np.cross(recording.truth_angular_rate_body[truth], mount.position)
    position = recording.truth_position_map[truth] + body_to_map.apply(mount.position)
    velocity = recording.truth_velocity_map[truth] + body_to_map.apply(sway_body)
    imu_to_map = body_to_map * Rotation.from_matrix(mount.rotation_imu_to_body)
    turn = imu_to_map * Rotation.from_quat(np.roll(state["attitude"], -1)).inv()
    return np.concatenate(
        [
            position - state["position_map"],
            velocity - state["velocity_map"],
            turn.as_rotvec(),
            recording.accel_bias[i] - state["accel_bias"],
            recording.gyro_bias[i] - state["gyro_bias"],
        ]
    )


def run(recording: Recording, navigator: Navigator, interval: float = 0.5) -> Run:
    """Run one recording and compare with the truth every ``interval`` s, a multiple of that of the truth."""
    every = round(interval * recording.options.imu_rate)
    stops = np.arange(every - 1, len(recording.imu_stamp), every)
    truth = np.searchsorted(recording.truth_stamp, recording.imu_stamp[stops])
    if np.any(recording.truth_stamp[truth] != recording.imu_stamp[stops]):
        raise ValueError(f"no truth every {interval:g} s in recording {recording.name}")
    records, errors, covariances, aligned = [], [], [], []
    for k, (i, state) in enumerate(feed(recording, navigator, stops)):
        records.append(navigator.take_records())
        aligned.append(bool(state["heading_known"]))
        errors.append(state_error(recording, i, truth[k], state))
        covariances.append(published_covariance(state)[:ERROR_SIZE, :ERROR_SIZE])
    records.append(navigator.finish())
    return Run(
        seconds=(stops + 1) / recording.options.imu_rate,
        aligned=np.array(aligned),
        error=np.array(errors),
        covariance=np.array(covariances),
        records=np.concatenate(records, dtype=RECORD),
    )


def published_covariance(states: np.void | NDArray[Any]) -> Array:
    """Return the covariances of one state or of many (...,), with what odometry adds where the heading is known.

    That is lasting errors of fixes, the effect of faults of the installation, and that of clocks that are apart.
    """
    covariance = np.array(states["covariance"])
    scatter = states["scatter"]
    held = (scatter["share"] ** 2 * (scatter["calm"][..., None] * scatter["claimed"])).sum(axis=-2)
    covariance[..., np.arange(3), np.arange(3)] += held
    found = states["installation"]
    effects = found["considered"] * found["is_considered"][..., None]
    covariance[..., :ERROR_SIZE, :ERROR_SIZE] += np.einsum("...si,...sj->...ij", effects, effects)
    offsets = np.array([offset_by_jumps(state) for state in np.atleast_1d(states)]).reshape(*np.shape(states), 2)
    covariance[..., :2, :2] += offsets[..., :, None] * offsets[..., None, :]
    late = states["motion"]["turns"]["lag"][..., None] * states["velocity_map"]
    covariance[..., :3, :3] += late[..., :, None] * late[..., None, :]
    return covariance


def nees(error: Array, covariance: Array, block: slice) -> Array:
    """Return e' P^-1 e of a block of errors; ``error`` (..., 15), ``covariance`` (..., 15, 15)."""
    part = error[..., block]
    return np.einsum("...i,...i->...", part, np.linalg.solve(covariance[..., block, block], part[..., None])[..., 0])


def ensemble(
    name: str,
    seeds: Iterable[int],
    changes: dict[str, Any] | None = None,
    interval: float = 0.5,
    progress: Callable[[int], None] = lambda done: None,
    **options: Any,
) -> Ensemble:
    """Simulate and run scenario ``name`` for all ``seeds``.

    ``options`` are those of the simulation; ``changes`` are parameters of the estimator by dotted name, on top of those
    that describe the simulation. ``progress`` is called with the number of runs done.
    """
    seeds = list(seeds)
    runs = []
    for seed in seeds:
        recording = simulate(name, seed, **options)
        parameters: Parameters = from_mapping({**recording.parameters(), **NO_SIDE_SLIP, **NO_REST, **(changes or {})})
        runs.append(run(recording, Navigator(parameters), interval))
        progress(len(runs))
    # From the moment on at which the last of the runs is aligned.
    for seed, r in zip(seeds, runs):
        if not r.aligned.any():
            raise ValueError(f"{name} with seed {seed}: the heading never became known")
    first = max(int(np.argmax(r.aligned)) for r in runs)
    start_stamp = recording.imu_stamp[0] + round((runs[0].seconds[first] - 1.0 / recording.options.imu_rate) * 1e9)
    nis, gated = {}, {}
    for stream, stream_name in enumerate(STREAM_NAMES):
        of_stream = [r.records[(r.records["stream"] == stream) & (r.records["stamp"] > start_stamp)] for r in runs]
        offered = np.concatenate([records[records["dof"] > 0] for records in of_stream])
        if len(offered):
            nis[stream_name] = offered["nis"]
            gated[stream_name] = float(np.mean(offered["verdict"] != Verdict.FUSED))
    return Ensemble(
        seconds=runs[0].seconds[first:],
        error=np.array([r.error[first:] for r in runs]),
        covariance=np.array([r.covariance[first:] for r in runs]),
        nis=nis,
        gated=gated,
    )


def mean_band(degrees: int, count: int, probability: float = 0.95) -> tuple[float, float]:
    """Return the central band of the mean of ``count`` independent chi-square variables with ``degrees`` each."""
    low, high = chi2.ppf([0.5 - probability / 2.0, 0.5 + probability / 2.0], degrees * count) / count
    return float(low), float(high)


def share_in_band(nees_of_runs: Array, degrees: int) -> float:
    """Return the share of epochs at which the mean over the runs (runs, epochs) lies in its 95 % band."""
    low, high = mean_band(degrees, len(nees_of_runs))
    mean = nees_of_runs.mean(axis=0)
    return float(np.mean((mean > low) & (mean < high)))
