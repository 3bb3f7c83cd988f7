"""One run of a fault: the drive, the filter, and its figures against the truth, once a second."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import norm

from campaign import independent
from campaign.fault import RATE, Fault, Filter
from eskf_ros.filter.history.records import RECORD
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import CONSTRAINT_INTERVAL, SENSOR_STREAMS, Stream, Verdict
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.episodes import ClockSet
from eskf_ros.simulate.imu import ImuMount
from eskf_ros.simulate.scenario import Recording, simulate
from eskf_ros.tables.feeding import rows_from
from monte_carlo import NO_SIDE_SLIP, Message, feed, messages_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

IMU_NOISE = ("gyro_noise_density", "accel_noise_density", "gyro_bias_random_walk", "accel_bias_random_walk")
"""Parameters that the told filter knows and the default one does not."""

RAISED = "asked for its complaints, the filter raises"

ASKED_EVERY = 5
"""s between two looks at what the filter says."""

GOLDEN_RATIO = 0.618034
"""Step between the quantiles of given headings from seed to seed: few of them have the mean square of many."""

KNOWN = math.radians(30.0)
"""rad; a heading known to this must not be thrown away."""

MOVES, TURNS = 0.05, math.radians(0.1)
"""m/s and rad/s from which on rest is false."""


@dataclass(frozen=True)
class Trace:
    """What a run gave at n times, ``seconds`` (n,) from the start, since the position was known for the first time.

    ``error``, ``sigma``: horizontal, m. ``heading_error``, ``heading_sigma``: rad; where the heading is not
    ``is_known`` they say nothing. ``speed``, ``turn``: of the truth, m/s and rad/s. ``said``: sentences, with the time
    (s) at which each was first seen, numbers left out; ``final``: those at the end, as they are. ``offered``,
    ``refused``: measurements, and those of them that were not fused. ``rest_speed`` (m,): the truth at the stamps at
    which rest was taken for granted; ``rest`` (m,): these stamps, s. ``rest_turn`` (k,): the mean of the truth over the
    seconds in which no turn was taken for granted, of which the constraint takes the mean rate.
    """

    seconds: Array
    error: Array
    sigma: Array
    heading_error: Array
    heading_sigma: Array
    is_known: Mask
    speed: Array
    turn: Array
    restarts: int
    resets: int
    thrown_away: int
    said: dict[str, float]
    final: tuple[str, ...]
    offered: int
    refused: int
    rest: Array
    rest_speed: Array
    rest_turn: Array


def without_gates(navigator: Navigator) -> None:
    """Let a filter believe everything: its innovation gates are open, so it never resets a position nor restarts."""
    navigator._settings["gate"][:] = 1e300
    navigator._settings["has_humble_lane"] = 0


CARS = ("drive", "hour_drive", "tunnel_drive", "stand", "straight", "creep", "train")
"""Scenarios, or their families, in which what moves points where it goes: the filter is told so."""


def heading_at_start_deg(recording: Recording) -> float:
    """Return the true heading at the start, counter-clockwise from east."""
    w, x, y, z = recording.truth_attitude_body_to_map[0].tolist()
    return math.degrees(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def parameters_of(fault: Fault, recording: Recording, is_told: bool) -> dict[str, Any]:
    """Parameters of the recording, changed by the fault; without the noise of the IMU where it is not told."""
    parameters = recording.parameters()
    if fault.scenario.partition(":")[0] in CARS and not isinstance(recording, independent.IndependentRecording):
        parameters.update(NO_SIDE_SLIP)
    if std := fault.given_heading_std_deg:
        off = fault.given_heading_off_deg
        if off is None:
            off = std * norm.ppf((0.5 + GOLDEN_RATIO * recording.seed) % 1.0)
        parameters["alignment.initial_heading_deg"] = heading_at_start_deg(recording) + off
        parameters["alignment.initial_heading_std_deg"] = std
    if not is_told:
        parameters = {name: value for name, value in parameters.items() if name.removeprefix("imu.") not in IMU_NOISE}
    for name, value in fault.parameters.items():
        if isinstance(value, tuple):
            before = parameters.get(name, (0.0, 0.0, 0.0))
            value = tuple(float(a) + b for a, b in zip(before, value))
        parameters[name] = value
    return parameters


def recording_of(fault: Fault, seed: int, drives: Path | None = None) -> Recording:
    """Return the drive of a fault: simulated, or from the folder ``drives`` of the other generator."""
    if drives is not None:
        return independent.recording_from(drives, fault, seed)
    options = {"imu_rate": RATE, "stop": fault.stop, "episodes": fault.episodes, **fault.options}
    return simulate(fault.scenario, seed, **options)


def messages_with_heading(recording: Recording) -> list[Message]:
    """Return all messages of a recording in the order of arrival, those of a dual antenna among them."""
    found, antenna = messages_of(recording), recording.dual_antenna
    if antenna is not None:
        values = np.column_stack([antenna.yaw, np.zeros((len(antenna.yaw), 2))])
        variances = np.diag([math.radians(antenna.sensor.yaw_std_deg) ** 2, -1.0, -1.0])
        rows = rows_from(values, variances)
        found += [
            (int(arrival), "heading", int(stamp), row)
            for arrival, stamp, row in zip(antenna.arrival, antenna.stamp, rows)
        ]
    return sorted(found, key=lambda message: message[0])


def run_one(
    fault: Fault,
    recording: Recording,
    given: Filter,
    has_gates: bool = True,
    messages: Sequence[Message] | None = None,
) -> Trace:
    """Run a filter over the recording of a fault; ``messages``: those of `messages_with_heading`, where known."""
    if messages is None:
        messages = messages_with_heading(recording)
    if not given.has_velocity:
        messages = [message for message in messages if message[1] != "gnss_velocity"]
    navigator = Navigator(from_mapping(parameters_of(fault, recording, given.is_told)))
    if not has_gates:
        without_gates(navigator)
    start = int(recording.truth_stamp[0])
    taken = (recording.imu_taken - start) * 1e-9
    stops = np.unique(np.searchsorted(taken, np.arange(1.0, taken[-1])))
    rows: list[np.ndarray] = []
    parts = []
    said: dict[str, float] = {}
    for k, state in enumerate(states_at(stops, recording, navigator, messages, has_order_of_arrival(fault))):
        if rows or state["position_known"]:
            rows.append(navigator.odometry)
        if k % ASKED_EVERY == 0:
            parts.append(navigator.take_records())
            for sentence in sentences(navigator):
                said.setdefault(sentence, float(taken[stops[k]]))
    parts.append(navigator.finish())
    final = () if any(sentence.startswith(RAISED) for sentence in sentences(navigator)) else tuple(navigator.complaints)
    for sentence in sentences(navigator):
        said.setdefault(sentence, float(taken[-1]))
    if not rows:  # The filter never started: it claims nothing, and has nothing but its word.
        rows.append(navigator.odometry)
    records = np.concatenate(parts, dtype=RECORD)
    return _trace(recording, navigator, stops, np.concatenate(rows), records, said, final)


def has_order_of_arrival(fault: Fault) -> bool:
    """Whether the order of arrival makes a difference: it does where a clock is set, and nowhere else."""
    return any(isinstance(episode, ClockSet) for episode in fault.episodes)


def states_at(
    stops: NDArray[np.int64], recording: Recording, navigator: Navigator, messages: Sequence[Message], in_order: bool
) -> Iterator[np.ndarray]:
    """Yield the state after each of the IMU samples ``stops``.

    ``in_order``: messages are not handed over in bulk, and the filter learns when they came, as in node and replay.
    """
    if not in_order:
        yield from (state for _, state in feed(recording, navigator, stops, messages))
        return
    wanted = set(stops.tolist())
    for i, state in feed(recording, navigator, np.arange(stops[-1] + 1), messages, has_arrivals=True):
        if i in wanted:
            yield state


def sentences(navigator: Navigator) -> list[str]:
    """What the filter says at present, numbers left out, so that one that grows is the same sentence."""
    try:
        found = [*navigator.complaints, *navigator.notes]
    except np.linalg.LinAlgError as problem:
        found = [f"{RAISED}: {problem}"]
    return [" ".join("".join(" " if c.isdigit() else c for c in text).split()) for text in found]


def _trace(
    recording: Recording,
    navigator: Navigator,
    stops: NDArray[np.int64],
    rows: np.ndarray,
    records: np.ndarray,
    said: dict[str, float],
    final: tuple[str, ...],
) -> Trace:
    stops = stops[len(stops) - len(rows) :]
    start = recording.truth_stamp[0]
    truth_seconds = (recording.truth_stamp - start) * 1e-9
    seconds = np.clip((recording.imu_taken[stops] - start) * 1e-9, 0.0, truth_seconds[-1])
    attitudes = Rotation.from_quat(recording.truth_attitude_body_to_map[:, [1, 2, 3, 0]])
    body_to_map = Slerp(truth_seconds, attitudes)(seconds)
    position = np.column_stack([np.interp(seconds, truth_seconds, axis) for axis in recording.truth_position_map.T])
    # The errors are those of the IMU: where a wrong mounting is the fault, that of base_link is judged by its name.
    mount = ImuMount(recording.options.imu_position, recording.options.imu_rpy_deg)
    told = ImuMount(navigator.parameters.imu.mount_position, navigator.parameters.imu.mount_rpy_deg)
    estimated = Rotation.from_quat(rows["attitude_body_to_map"][:, [1, 2, 3, 0]])
    away = position + body_to_map.apply(mount.position) - rows["position_map"] - estimated.apply(told.position)
    imu_to_map = body_to_map * Rotation.from_matrix(mount.rotation_imu_to_body)
    turn = (imu_to_map * (estimated * Rotation.from_matrix(told.rotation_imu_to_body)).inv()).as_rotvec()
    is_known = rows["heading_known"]
    variances = np.maximum(np.einsum("nii->ni", rows["pose_covariance"]), 1e-12)
    sigma = np.sqrt(variances[:, 5])
    was_known = is_known[:-1] & (sigma[:-1] < KNOWN) & (np.abs(turn[:-1, 2]) < KNOWN)
    rest = records[(records["stream"] == Stream.ZUPT) & (records["verdict"] == Verdict.FUSED)]["stamp"]
    turning = records[(records["stream"] == Stream.ZARU) & (records["verdict"] == Verdict.FUSED)]["stamp"]
    aids = records[(records["stream"] < SENSOR_STREAMS) & (records["dof"] > 0)]
    speed = np.linalg.norm(recording.truth_velocity_map, axis=1)
    rate = np.linalg.norm(recording.truth_angular_rate_body, axis=1)

    turned = cumulative_trapezoid(rate, truth_seconds, initial=0.0)

    def at(stamps: NDArray[np.int64], quantity: Array) -> Array:
        return np.interp((stamps - start) * 1e-9, truth_seconds, quantity)

    return Trace(
        seconds=seconds,
        error=np.hypot(away[:, 0], away[:, 1]),
        sigma=np.sqrt(variances[:, 0] + variances[:, 1]),
        heading_error=turn[:, 2],
        heading_sigma=sigma,
        is_known=is_known,
        speed=at(recording.imu_taken[stops], speed),
        turn=at(recording.imu_taken[stops], rate),
        restarts=navigator.restarts,
        resets=navigator.position_resets,
        thrown_away=int(np.count_nonzero(was_known & ~is_known[1:])),
        said=said,
        final=final,
        offered=len(aids),
        refused=int(np.count_nonzero(~np.isin(aids["verdict"], (Verdict.FUSED, Verdict.WEIGHED_DOWN)))),
        rest=(rest - start) * 1e-9,
        rest_speed=at(rest, speed),
        rest_turn=(at(turning, turned) - at(turning - CONSTRAINT_INTERVAL, turned)) / (1e-9 * CONSTRAINT_INTERVAL),
    )
