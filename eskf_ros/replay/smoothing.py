"""Smoothing in a replay: the smoothed rows go to the result files, and are compared with truth as the filter's are."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.replay.results import ResultFiles
from eskf_ros.replay.summary import Summary, accuracy
from eskf_ros.replay.truth import EPOCH, TruthComparison
from eskf_ros.smooth.smoother import Smoother
from eskf_ros.smooth.spill import Spill

EPOCHS = 4096
"""Truth epochs that are read at once."""


class Smoothing:
    """A smoother with the truth that it will be compared with, both on disk until the filter has ended."""

    def __init__(
        self, navigator: Navigator, files: ResultFiles, point_body: tuple[float, ...], has_truth: bool
    ) -> None:
        self._navigator = navigator
        self._files = files
        self._smoother = Smoother(navigator, files.scratch)
        self._truth = TruthComparison(point_body) if has_truth else None
        self._epochs = Spill(EPOCH, folder=files.scratch)

    def collect(self) -> None:
        """Take what became final of the log of the navigator."""
        self._smoother.collect()

    def keep_truth(self, epochs: NDArray[Any]) -> None:
        """Keep truth epochs (n,) `EPOCH`."""
        self._epochs.append(epochs)

    def result(self, summary: Summary) -> dict[str, Any]:
        """Smooth, write the result files and return `smoothed` of the summary; the navigator has finished."""
        self._smoother.smooth()
        read = 0
        newest = -1
        for rows in self._smoother.rows():
            datum = self._navigator.datum
            if self._truth is not None and datum:
                while read < len(self._epochs) and newest <= rows["stamp"][-1]:
                    epochs = self._epochs.read(read, min(read + EPOCHS, len(self._epochs)))
                    self._truth.add_truth(epochs)
                    read, newest = read + len(epochs), int(epochs["stamp"].max())
                self._truth.add_rows(rows, datum)
            self._files.write_smoothed(rows)
        compared = None if self._truth is None else self._truth.compared()
        return {
            "nodes": self._smoother.node_count,
            "breaks": self._smoother.breaks,
            **({} if compared is None else accuracy(compared)),
            "outages": [] if compared is None else summary.outage_errors(compared),
        }
