"""The smoother of one recording: takes the log of the forward pass while the filter runs, then goes back over it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.forward_log import NODE, POINT
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.output.local_odometry import LOCAL
from eskf_ros.filter.settings import settings_from
from eskf_ros.filter.state.memory import allocate
from eskf_ros.smooth.backward import PASS, smooth_nodes
from eskf_ros.smooth.spill import Spill, as_records
from eskf_ros.smooth.trajectory import write_rows

BLOCK = 2048
"""Nodes or points that are in memory at once."""


class Smoother:
    """Fixed-interval smoother of a `Navigator` with ``keeps_log``.

    Call `collect` after every push (or now and then), `smooth` once after `Navigator.finish`, then read `rows`. What
    late messages made wrong never enters: only what is final does.
    """

    def __init__(self, navigator: Navigator, folder: Path | None = None) -> None:
        """Prepare a smoother whose temporary files lie in ``folder`` (None: where the system has them)."""
        self._navigator = navigator
        self._folder = folder
        self._nodes, self._points = Spill(NODE, folder=folder), Spill(POINT, folder=folder)
        self._numbers: Spill | None = None
        self._stamps: list[NDArray[np.int64]] = []
        self._is_smoothed = False
        self.breaks = 0
        """Starts, resets and takeovers of the filter, over which nothing is smoothed."""

    @property
    def node_count(self) -> int:
        """Number of nodes."""
        return len(self._nodes)

    def copied_for(self, navigator: Navigator) -> Smoother:
        """Return a smoother with the same log that ends with ``navigator``, a copy of that of this one."""
        other = Smoother(navigator, self._folder)
        other._nodes, other._points = self._nodes.copied(), self._points.copied()
        other._numbers = None if self._numbers is None else self._numbers.copied()
        other._stamps = list(self._stamps)
        return other

    def collect(self, everything: bool = False) -> None:
        """Take what became final of the log; ``everything``: all of it, after which nothing may be pushed."""
        for log in self._navigator.take_log(everything):
            if self._numbers is None:
                self._numbers = Spill(np.float64, log.numbers.shape[1], self._folder)
            self._nodes.append(log.nodes)
            self._numbers.append(log.numbers)
            self._points.append(log.points)
            self._stamps.append(log.nodes["stamp"].copy())

    def smooth(self) -> None:
        """Take the rest of the log, and go backward over all of it; to be called once for good."""
        if self._is_smoothed:
            return
        self._is_smoothed = True
        self.collect(everything=True)
        if self._numbers is None:
            return
        settings = settings_from(self._navigator.parameters)
        carried = allocate(PASS)
        for end in range(len(self._nodes), 0, -BLOCK):
            first = max(0, end - BLOCK)
            nodes, numbers = self._nodes.read(first, end), self._numbers.read(first, end)
            smooth_nodes(nodes, numbers, carried, int(settings["clock_at"][0]))
            self._numbers.replace(first, numbers)
            self.breaks += int(np.count_nonzero((nodes["is_linked"] == 1) & (nodes["is_continued"] == 0)))

    def rows(self) -> Iterator[NDArray[Any]]:
        """Yield the smoothed ODOMETRY rows in blocks, at the output stamps; pose in odom and its variances are zero."""
        if self._numbers is None:
            return
        settings, local = settings_from(self._navigator.parameters), allocate(LOCAL)
        state = as_records(self._navigator.state)
        stamps = np.concatenate(self._stamps)
        for first in range(0, len(self._points), BLOCK):
            points = self._points.read(first, min(first + BLOCK, len(self._points)))
            begin = max(0, int(np.searchsorted(stamps, points["stamp"][0])) - 1)
            end = int(np.searchsorted(stamps, points["stamp"][-1])) + 1
            rows = allocate(ODOMETRY, len(points))
            nodes, numbers = self._nodes.read(begin, end), self._numbers.read(begin, end)
            write_rows(points, nodes, numbers, state, local, settings, rows)
            rows["stamp"] = self._navigator.stamps_of(rows["stamp"])
            yield np.asarray(rows)
