"""A drive through the kernels and through the reference filter beside them, and how far apart they are.

The kernels align by themselves; as soon as both lanes run, the reference filters begin with their states. Positions,
velocities and ranges come at their stamps. Rest is switched off, and the parameters are such that nothing is learnt of
the receivers: what is compared are prediction, updates and reset, and the two rules by which messages weigh less.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import INTER_SYSTEM
from eskf_ros.filter.state.lanes import FILTER, HUMBLE, is_running
from eskf_ros.gnss.ranges import Status
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import simulate
from monte_carlo import Message, feed, messages_of
from support.gnss_sky import KLOBUCHAR, WEEK
from support.reference_filter import Array, Model, ReferenceFilter
from support.simulated_ranges import Ranges, simulate_ranges

SCENARIO = "hour_drive"
NO_REST: dict[str, Any] = {"zupt.enabled": False, "alignment.course_std_deg": 0.1}
HUBER = 2.5


@dataclass(frozen=True)
class Comparison:
    """At one instant (s since the reference began): largest relative differences by what is compared."""

    seconds: float
    differences: dict[str, float]


def differences(reference: ReferenceFilter, state: Any) -> dict[str, float]:
    """Return how far the kernels' state is from the reference.

    Vectors over their length (position and velocity: at least 1 m and 1 m/s), attitude in rad, the covariance over the
    product of the standard deviations.
    """

    def relative(ours: Array, theirs: Array, least: float = 0.0) -> float:
        return float(np.linalg.norm(ours - theirs) / max(np.linalg.norm(theirs), least))

    w, x, y, z = state["attitude"]
    vector = np.array([x, y, z])
    matrix = (w * w - vector @ vector) * np.eye(3) + 2.0 * np.outer(vector, vector)
    matrix += 2.0 * w * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    std = np.sqrt(np.diag(reference.covariance))
    size = len(std)
    assert state["error_size"] == size
    found = {
        "position": relative(state["position_map"], reference.p, 1.0),
        "velocity": relative(state["velocity_map"], reference.v, 1.0),
        "attitude": float(np.linalg.norm(matrix - reference.r)),
        "accelerometer bias": relative(state["accel_bias"], reference.ba),
        "gyro bias": relative(state["gyro_bias"], reference.bg),
        "covariance": float(
            np.abs((state["covariance"][:size, :size] - reference.covariance) / np.outer(std, std)).max()
        ),
    }
    if size > 15:
        found["augmented states"] = relative(state["optional"][: size - 15], reference.x)
    return found


def model_of(navigator: Navigator, recording: Recording, is_humble: bool) -> Model:
    """Return what a lane is told, from the parameters."""
    parameters = navigator.parameters
    imu, ranges = parameters.imu, parameters.ranges
    told = (
        imu.accel_noise_density**2,
        imu.gyro_noise_density**2,
        imu.accel_bias_random_walk**2,
        imu.gyro_bias_random_walk**2,
    )
    settings = navigator._settings[0]
    lasting, vertical = ranges.correlated_std, ranges.correlated_std_vertical
    return Model(
        recording.datum,
        *(tuple(settings["humble_noise"]) if is_humble else told),
        imu.accel_noise_density,
        imu.gyro_noise_density,
        np.array(recording.options.lever_arm),
        {name: int(settings[f"{name}_at"]) for name in ("position_error", "clock", "inter_system")},
        settings["optional_noise_density"],
        settings["optional_decay"],
        np.array([lasting, lasting, vertical]),
    )


class Imu:
    """The readings of a recording: the straight lines that stand for them, and what the gyro reads in between."""

    def __init__(self, recording: Recording) -> None:
        self.stamp = recording.imu_stamp
        self.readings = np.hstack([recording.specific_force, recording.angular_rate])

    def interval(self, k: int) -> float:
        """Return the time (s) from sample k - 1 to k."""
        return float(self.stamp[k] - self.stamp[k - 1]) * 1e-9

    def line(self, k: int) -> tuple[Array, Array]:
        """Return the ends of the line from sample k to k + 1, whose mean is that of the parabola with sample k - 1."""
        before, now, after = self.readings[k - 1 : k + 2]
        h, earlier = self.interval(k + 1), self.interval(k)
        bend = ((after - now) / h - (now - before) / earlier) / (h + earlier)
        shift = bend * h**2 / 6.0
        return now - shift, after - shift

    def predict(self, reference: ReferenceFilter, k: int, begin: int, end: int) -> None:
        """Propagate from the stamp ``begin`` to ``end``, both from sample k to k + 1."""
        first, last = self.line(k)
        length = float(self.stamp[k + 1] - self.stamp[k])
        a = first + (begin - self.stamp[k]) / length * (last - first)
        b = first + (end - self.stamp[k]) / length * (last - first)
        reference.predict(a[:3], a[3:], b[:3], b[3:], (end - begin) * 1e-9)

    def rate(self, k: int, stamp: int) -> Array:
        """Return what the gyro reads at a stamp from sample k on."""
        share = (stamp - self.stamp[k]) / float(self.stamp[k + 1] - self.stamp[k])
        return np.asarray(self.readings[k, 3:] + share * (self.readings[k + 1, 3:] - self.readings[k, 3:]))


Update = tuple[int, int, Any]
"""Stamp, order among those of one stamp, and the message."""


def run_beside(
    references: dict[int, ReferenceFilter],
    imu: Imu,
    updates: list[Update],
    first: int,
    states: Iterator[tuple[int, np.ndarray]],
    fuse: Any,
) -> Iterator[Comparison]:
    """Carry the references from sample ``first`` on; compare with the lanes after each sample of ``states``."""
    start = int(imu.stamp[first])
    waiting = iter(sorted((u for u in updates if u[0] >= start), key=lambda update: update[:2]))
    following = next(waiting, None)
    k = first
    for last, lanes in states:
        while k < last:
            now = int(imu.stamp[k])
            until = int(imu.stamp[k + 1])
            while following is not None and following[0] < until:
                for lane, reference in references.items():
                    if following[0] > now:
                        imu.predict(reference, k, now, following[0])
                    fuse(reference, lane, imu, k, following)
                now, following = following[0], next(waiting, None)
            for reference in references.values():
                imu.predict(reference, k, now, until)
            k += 1
        while following is not None and following[0] == imu.stamp[k]:
            for lane, reference in references.items():
                fuse(reference, lane, imu, k, following)
            following = next(waiting, None)
        found: dict[str, float] = {}
        for lane, reference in references.items():
            prefix = "humble lane: " if lane == HUMBLE else ""
            found |= {prefix + name: value for name, value in differences(reference, lanes[lane]).items()}
        yield Comparison((int(imu.stamp[k]) - start) * 1e-9, found)


def weighed_down(reference: ReferenceFilter, innovation: Array, h: Array, noise: Array, gate: float) -> Array:
    """Return the noise that brings a message beyond the gate onto it."""
    nis = reference.nis(innovation, h, noise)
    spread = h @ reference.covariance @ h.T + noise
    return np.asarray(noise + max(0.0, nis / gate - 1.0) * spread)


def compare_loose(stop: float, seed: int = 1, interval: float = 1.0, imu_rate: float = 100.0) -> list[Comparison]:
    """Drive to ``stop`` s with positions and velocities, and compare both lanes."""
    recording = simulate(SCENARIO, seed, imu_rate=imu_rate, stop=stop, latency=(0.0, 0.0))
    navigator = Navigator(from_mapping({**recording.parameters(), **NO_REST}))
    messages = [(stamp, name, stamp, row) for _, name, stamp, row in messages_of(recording)]
    imu, gate = Imu(recording), navigator._settings[0]["gate"][Stream.GNSS_POSITION, 3]

    def fuse(reference: ReferenceFilter, lane: int, imu: Imu, k: int, update: Update) -> None:
        stamp, order, row = update
        covariance = row[3:12].reshape(3, 3)
        if order == 0:
            fix = np.array([math.radians(row[0]), math.radians(row[1]), row[2]])
            innovation, h, noise = reference.gnss_position(fix, covariance)
        else:
            reading = imu.rate(k, stamp) if stamp > imu.stamp[k] else imu.readings[k, 3:]
            innovation, h, noise = reference.gnss_velocity(row[:3], covariance, reading, imu.interval(k))
        if lane == FILTER:
            noise = weighed_down(reference, innovation, h, noise, gate)
        reference.update(innovation, h, noise)

    updates = [(stamp, int(name == "gnss_velocity"), row) for stamp, name, _, row in messages]
    return compare(navigator, recording, imu, updates, _fed(recording, navigator, messages, interval), fuse, True)


def _fed(
    recording: Recording, navigator: Navigator, messages: list[Message], interval: float
) -> Iterator[tuple[int, np.ndarray]]:
    every = round(interval * recording.options.imu_rate)
    stops = np.arange(every - 1, len(recording.imu_stamp), every)
    for i, _ in feed(recording, navigator, stops, messages):
        yield i, navigator._states.copy()


def compare_tight(stop: float, seed: int = 1, interval: float = 1.0, imu_rate: float = 100.0) -> list[Comparison]:
    """Drive to ``stop`` s with pseudoranges and range rates of four constellations, and compare the filter."""
    recording = simulate(SCENARIO, seed, imu_rate=imu_rate, stop=stop)
    ranges = simulate_ranges(recording, seed, rate=1.0, latency=0.0)
    navigator = Navigator(from_mapping({**recording.parameters(), **NO_REST, "mode": "tight"}))
    gate = navigator._settings[0]["gate"]
    mask = navigator._settings[0]["pseudorange"]["elevation_mask"]
    imu = Imu(recording)

    def fuse(reference: ReferenceFilter, lane: int, imu: Imu, k: int, update: Update) -> None:
        stamp, _, (is_code, time, signal) = update
        reading = imu.rate(k, stamp) if stamp > imu.stamp[k] else imu.readings[k, 3:]
        seen = reference.sight(signal, reading)
        if seen["elevation"] < mask:
            return
        if is_code:
            system = int(signal["system"])
            order = INTER_SYSTEM.index(system) if system in INTER_SYSTEM else -1
            innovation, h, noise = reference.pseudorange(signal, seen, time, KLOBUCHAR, order)
        else:
            innovation, h, noise = reference.range_rate(signal, seen, imu.interval(k))
        nis = reference.nis(innovation, h, noise)
        if nis > gate[Stream.PSEUDORANGE if is_code else Stream.RANGE_RATE, 1]:
            return
        reference.update(innovation, h, noise * max(1.0, math.sqrt(nis) / HUBER))

    updates = list(_updates_of(ranges))
    return compare(navigator, recording, imu, updates, _fed_ranges(recording, navigator, ranges, interval), fuse, False)


def _updates_of(ranges: Ranges) -> Iterator[Update]:
    """Yield the signals of all epochs in the order in which they are fused: codes first, each by satellite."""
    for k, stamp in enumerate(ranges.stamp.tolist()):
        usable = ranges.signals[k][ranges.signals[k]["status"] == Status.USABLE]
        by_satellite = usable[np.lexsort((usable["signal"], usable["sv_id"], usable["gnss_id"]))]
        time = WEEK, float(ranges.seconds[k])
        for is_code in (True, False):
            for order, signal in enumerate(by_satellite):
                yield stamp, order + len(by_satellite) * (not is_code), (is_code, time, signal)


def _fed_ranges(
    recording: Recording, navigator: Navigator, ranges: Ranges, interval: float
) -> Iterator[tuple[int, np.ndarray]]:
    every = round(interval * recording.options.imu_rate)
    epoch = first = 0
    for last in range(every - 1, len(recording.imu_stamp), every):
        while epoch < len(ranges.stamp) and ranges.stamp[epoch] <= recording.imu_stamp[last]:
            ranges.push(navigator, epoch)
            epoch += 1
        part = slice(first, last + 1)
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        first = last + 1
        yield last, navigator._states.copy()


def compare(
    navigator: Navigator,
    recording: Recording,
    imu: Imu,
    updates: list[Update],
    states: Iterator[tuple[int, np.ndarray]],
    fuse: Any,
    both: bool,
) -> list[Comparison]:
    """Wait until both lanes run, and 10 s more; begin the references there, and compare until the end."""
    running = first = 0
    lanes = np.zeros(0)
    while running <= 10:
        first, lanes = next(states)
        running += bool(is_running(lanes))
    chosen = (FILTER, HUMBLE) if both else (FILTER,)
    references = {lane: ReferenceFilter(model_of(navigator, recording, lane == HUMBLE), lanes[lane]) for lane in chosen}
    # What has the stamp of the first sample is in its state.
    later = [update for update in updates if update[0] > imu.stamp[first]]
    return list(run_beside(references, imu, later, first, states, fuse))


def largest(found: list[Comparison]) -> dict[str, float]:
    """Return the largest difference of each kind."""
    return {name: max(one.differences[name] for one in found) for name in found[0].differences}
