"""The smoother for who cannot wait for the end: each moment again when some seconds have come after it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.forward_log import Log, allocate_log
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.output.local_odometry import LOCAL
from eskf_ros.filter.settings import settings_from
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import SECOND
from eskf_ros.smooth.backward import PASS, smooth_nodes
from eskf_ros.smooth.spill import as_records
from eskf_ros.smooth.trajectory import write_rows

LARGEST_RATE = 50.0
"""Hz of the rows, at most: they are for a record or a map, not for a controller."""


class FixedLag:
    """Smoothed rows of a `Navigator` with ``keeps_log``, each from the measurements up to ``lag`` s after it, at least.

    Only what is final is used, so a row comes ``lag`` and the history window after its stamp, or a little later.
    """

    def __init__(self, navigator: Navigator, lag: float) -> None:
        """Prepare a smoother that waits for ``lag`` s."""
        self._navigator = navigator
        self._lag = round(lag * SECOND)
        self.forget()
        self._compile()

    def _compile(self) -> None:
        """Compile what `update` calls, or load it: not in a callback of a robot that drives."""
        self._navigator.take_log()
        settings, nothing = settings_from(self._navigator.parameters), allocate_log(0, 0, 0)
        nodes, numbers = nothing.nodes[:0], nothing.numbers[:0]
        smooth_nodes(nodes, numbers, allocate(PASS), 0)
        write_rows(
            nothing.points,
            nodes,
            numbers,
            as_records(self._navigator.state),
            allocate(LOCAL),
            settings,
            allocate(ODOMETRY),
        )

    def forget(self) -> None:
        """Forget all that was logged: the filter began anew."""
        self._log: Log | None = None
        self._datum = self._navigator.datum
        self._newest = -1

    def update(self) -> NDArray[Any]:
        """Return the ODOMETRY rows (n,) that have become old enough since the last call."""
        parts = self._navigator.take_log()
        if self._navigator.datum != self._datum:
            # What was logged belongs to another map.
            self.forget()
            return np.zeros(0, ODOMETRY)
        parts = parts if self._log is None else [self._log, *parts]
        if not parts:
            return np.zeros(0, ODOMETRY)
        nodes, numbers, points = (as_records(np.concatenate([part[i] for part in parts])) for i in range(3))
        self._log = Log(nodes, numbers, points)
        if not len(nodes):
            return np.zeros(0, ODOMETRY)
        ready = int(np.searchsorted(points["stamp"], nodes["stamp"][-1] - self._lag))
        if ready == 0:
            return np.zeros(0, ODOMETRY)
        grid = round(SECOND / LARGEST_RATE)
        chosen = points[:ready][np.diff(points["stamp"][:ready] // grid, prepend=self._newest // grid) > 0]
        self._newest = int(points["stamp"][ready - 1])
        rows = allocate(ODOMETRY, len(chosen))
        smoothed = numbers.copy()
        settings = settings_from(self._navigator.parameters)
        smooth_nodes(nodes, smoothed, allocate(PASS), int(settings["clock_at"][0]))
        write_rows(chosen, nodes, smoothed, as_records(self._navigator.state), allocate(LOCAL), settings, rows)
        rows["stamp"] = self._navigator.stamps_of(rows["stamp"])
        needed = max(0, int(np.searchsorted(nodes["stamp"], self._newest)) - 1)
        self._log = Log(nodes[needed:], numbers[needed:], points[ready:])
        return rows
