"""Feed of a replay: in which order the messages of a recording enter the estimator, and which are withheld."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import Batch
from eskf_ros.filter.history.clock_steps import AHEAD, steps_back
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.state.enums import Status
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.inputs.table import Input
from eskf_ros.replay.topics import TopicNames

LARGEST_PUSH = 1024
"""IMU samples given to the estimator at once, at most, if no other message lies between them."""
LOOK_AHEAD = 10_000_000_000
"""ns of log time within which messages are sorted by stamp."""

Offer = tuple[int, Input, tuple[Any, ...]]
"""A message: how many IMU samples of the batch come before it, its input, and the arguments of the push."""


class Feed:
    """Gives batches of messages to the navigator, in the order of log time or of stamps.

    `outages` are (start, length) in s from the first IMU stamp: GNSS messages with a stamp in [start, start + length)
    are withheld. `ins_only` withholds all GNSS messages from the moment the state is GOOD.

    Attributes:
        first_stamp: ns, the earliest IMU stamp of the first batch that has IMU samples, before a step of the clock.
        imu_count: IMU samples offered.
        withheld: number of messages that were not offered, by input.
    """

    def __init__(
        self,
        navigator: Navigator,
        topics: TopicNames,
        order: str = "log",
        outages: tuple[tuple[float, float], ...] = (),
        ins_only: bool = False,
        intake: RangeIntake | None = None,
    ) -> None:
        self._navigator = navigator
        self._topics = topics
        self._by_stamp = order == "stamp"
        self._outages = outages
        self._ins_only = ins_only
        self._gnss_over = False
        self.first_stamp: int | None = None
        self.imu_count = 0
        self.withheld = dict.fromkeys(topics.inputs, 0)
        self._pushes = {kind.name: kind.push_of(navigator, intake) for kind in topics.inputs}

    def ordered(self, batches: Iterable[dict[str, Batch]]) -> Iterable[dict[str, Batch]]:
        """Return the batches in the order in which they have to be pushed."""
        return in_stamp_order(batches, self._topics.imu) if self._by_stamp else batches

    def push(self, batch: dict[str, Batch]) -> NDArray[Any]:
        """Offer the messages of a batch; return the ODOMETRY rows of its IMU samples, (n,)."""
        rows: list[NDArray[Any]] = []
        imu = batch.get(self._topics.imu)
        if imu is not None:
            stamps = np.ascontiguousarray(imu.messages["stamp"])
            specific_force = np.ascontiguousarray(imu.messages["linear_acceleration"])
            angular_rate = np.ascontiguousarray(imu.messages["angular_velocity"])
            self.imu_count += len(stamps)
            if self.first_stamp is None and (stamps > 0).any():
                before = stamps[: next(iter(steps_back(stamps, begins_earlier=True)), None)]
                self.first_stamp = int(before[before > 0].min(initial=stamps[stamps > 0][0]))
        done = 0

        def push_imu_until(end: int) -> None:
            nonlocal done
            while imu is not None and done < end:
                part = slice(done, min(end, done + LARGEST_PUSH))
                orientation = imu.messages["orientation"][part], imu.messages["orientation_covariance"][part]
                self._navigator.push_imu_orientation(stamps[part], *orientation)
                readings = specific_force[part], angular_rate[part]
                rows.append(self._navigator.push_imu(stamps[part], *readings, imu.log_time[part]))
                done = part.stop

        for place, kind, arguments in self._offers(batch):
            push_imu_until(place)
            self._gnss_over = self._gnss_over or (self._ins_only and self._navigator.status >= Status.GOOD)
            if kind.is_gnss and (self._gnss_over or (self._outages and self._in_outage(arguments[0]))):
                self.withheld[kind] += 1
            else:
                self._pushes[kind.name](*arguments)
        if imu is not None:
            push_imu_until(len(stamps))
        # Joined as bytes: numpy copies structured arrays field by field, which takes ten times as long.
        return np.frombuffer(b"".join(part.data for part in rows), ODOMETRY)

    def _in_outage(self, stamp: int) -> bool:
        if self.first_stamp is None:
            return False
        return any(
            round(start * 1e9) <= stamp - self.first_stamp < round((start + length) * 1e9)
            for start, length in self._outages
        )

    def _time(self, batch: Batch) -> NDArray[np.int64]:
        return batch.messages["stamp"] if self._by_stamp else batch.log_time

    def _offers(self, batch: dict[str, Batch]) -> list[Offer]:
        """Return the messages of a batch other than the IMU, in their order."""
        imu = batch.get(self._topics.imu)
        imu_time = np.zeros(0, np.int64) if imu is None else self._time(imu)
        offers: list[tuple[int, Offer]] = []
        for kind, topic in self._topics.inputs.items():
            part = batch.get(topic)
            if part is None:
                continue
            times = self._time(part)
            places = np.searchsorted(imu_time, times)
            for time, place, arguments in zip(times.tolist(), places.tolist(), kind.arguments(part), strict=True):
                offers.append((time, (place, kind, arguments)))
        offers.sort(key=lambda item: item[0])
        return [offer for _, offer in offers]


def in_stamp_order(batches: Iterable[dict[str, Batch]], imu: str) -> Iterator[dict[str, Batch]]:
    """Yield batches in the order of stamps from batches in the order of log time, with bounded memory.

    A message waits until the recording has been read for another `LOOK_AHEAD` of log time. One that was recorded later
    than that behind newer stamps comes late here, too. Where the clock of the topic ``imu`` was set back, what was
    stamped before comes first.
    """
    held: dict[str, Batch] = {}
    for batch in batches:
        for topic, new in batch.items():
            held[topic] = _joined(held[topic], new) if topic in held else new
        while imu in held and (steps := steps_back(held[imu].messages["stamp"], begins_earlier=True)):
            before, held = _cut(held, imu, steps[0])
            yield _taken(before, np.iinfo(np.int64).max)
        newest = max(int(part.log_time.max()) for part in held.values())
        settled = [part.messages["stamp"][part.log_time <= newest - LOOK_AHEAD] for part in held.values()]
        settled = [stamps for stamps in settled if len(stamps)]
        if settled:
            limit = max(int(stamps.max()) for stamps in settled)
            yield _taken(held, limit)
    yield _taken(held, np.iinfo(np.int64).max)


def _cut(held: dict[str, Batch], imu: str, first: int) -> tuple[dict[str, Batch], dict[str, Batch]]:
    """Return the messages before and after the clock was set back, ``first`` being the first IMU sample after it.

    A measurement that was recorded after it, but is stamped ahead of the IMU of then, still has the old clock.
    """
    samples = held[imu]
    log_time, stamps = samples.log_time[first:], samples.messages["stamp"][first:]
    before: dict[str, Batch] = {}
    after: dict[str, Batch] = {}
    for topic, part in held.items():
        is_new = part.log_time >= log_time[0]
        if topic == imu:
            is_new = np.arange(len(part.log_time)) >= first
        else:
            there = stamps[np.clip(np.searchsorted(log_time, part.log_time), 0, len(stamps) - 1)]
            is_new &= part.messages["stamp"] <= there + AHEAD
        for chosen, target in ((~is_new, before), (is_new, after)):
            if chosen.any():
                target[topic] = Batch(part.log_time[chosen], part.messages[chosen], part.strings)
    return before, after


def _joined(first: Batch, second: Batch) -> Batch:
    return Batch(
        np.concatenate([first.log_time, second.log_time]),
        np.concatenate([first.messages, second.messages]),
        second.strings,
    )


def _taken(held: dict[str, Batch], limit: int) -> dict[str, Batch]:
    """Take the messages with stamps up to `limit` out of `held`, in the order of their stamps."""
    taken: dict[str, Batch] = {}
    for topic, part in list(held.items()):
        chosen = part.messages["stamp"] <= limit
        if chosen.any():
            order = np.flatnonzero(chosen)[np.argsort(part.messages["stamp"][chosen], kind="stable")]
            taken[topic] = Batch(part.log_time[order], part.messages[order], part.strings)
        held[topic] = Batch(part.log_time[~chosen], part.messages[~chosen], part.strings)
        if chosen.all():
            del held[topic]
    return taken
