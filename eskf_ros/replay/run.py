"""Replay of one recording: batches of messages in, result files and a summary out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import BagReader, Batch, open_bag
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.state.enums import Stream
from eskf_ros.fleet import fingerprint
from eskf_ros.fleet.recordings import files_of
from eskf_ros.gnss.rinex import RinexError
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.inputs.rinex_as_messages import RangesError, merged, read_beside
from eskf_ros.inputs.table import FIX
from eskf_ros.parameters.mapping import to_mapping
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.details import Details
from eskf_ros.replay.feed import Feed
from eskf_ros.replay.results import ResultFiles, selected
from eskf_ros.replay.smoothing import Smoothing
from eskf_ros.replay.summary import Summary, ranges_result, truth_result
from eskf_ros.replay.topics import InputError, TopicNames, find_topics, truth_converter
from eskf_ros.replay.truth import TruthComparison

TRUTH_RATE = 50.0
"""Hz; least rate of the rows that are compared with truth, whatever the rate of the files."""


@dataclass(frozen=True)
class Options:
    """The options of the command line. Outages are (start, length) in s from the first IMU stamp.

    ``mode``: loose, tight, ins-only, or empty for that of the parameters (tight with a file of `ranges`). ``ranges``,
    ``navigation``: RINEX files beside the recording; ``clock_offset``: s by which its stamps are ahead of UTC.
    ``smooth``: go back over the recording afterwards.
    """

    folder: Path
    truth: str = ""
    outages: tuple[tuple[float, float], ...] = ()
    mode: str = ""
    order: str = "log"
    smooth: bool = False
    output_rate: float = 50.0
    ranges: Path | None = None
    navigation: tuple[Path, ...] = ()
    clock_offset: float = 0.0


class StageClock:
    """Adds up the wall time of each stage; a stage ends where its `lap` is called."""

    def __init__(self, started: float) -> None:
        self.stages: dict[str, float] = {}
        self._started = self._last = started

    def lap(self, stage: str) -> None:
        """Add the time since the last call to `stage`."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + now - self._last
        self._last = now

    def total(self) -> float:
        """Return the seconds since the start."""
        return time.perf_counter() - self._started


def replay(
    bag: Path,
    parameters: Parameters,
    options: Options,
    progress: Callable[[float], None] = lambda share: None,
    started: float | None = None,
) -> dict[str, Any]:
    """Replay `bag`, write the result files to `options.folder`, return the content of summary.json.

    `progress` is called with the processed share of the recording. Times count from `started` (time.perf_counter).

    Raises:
        BagError: the recording cannot be read, or a result cannot be written.
        InputError: the recording lacks a topic, or does not fit the options.
        OSError: the results cannot be written.

    Over 60 lines: the loop of the replay with its results.
    """
    clock = StageClock(time.perf_counter() if started is None else started)
    marks = fingerprint_of(bag, parameters, options)
    parameters = with_options(parameters, options)
    with open_bag([bag]) as reader:
        topics, hints = find_topics(reader, bag, parameters, options.truth, options.ranges is not None)
        to_epochs = truth_converter(topics, bag, parameters)
        thinned = bool(topics.truth) and 0.0 < options.output_rate < TRUTH_RATE
        output_rate = 0.0 if thinned else options.output_rate
        navigator = Navigator(parameters, output_rate=output_rate, keeps_log=options.smooth)
        intake, messages = open_ranges(navigator, parameters, options, reader, topics)
        feed = Feed(navigator, topics, options.order, options.outages, options.mode == "ins-only", intake)
        point = parameters.gnss.lever_arm if topics.truth_type == FIX else (0.0, 0.0, 0.0)
        truth = TruthComparison(point)
        summary = Summary(feed, options.outages)
        details = Details(topics, parameters)
        if intake is not None:
            intake.watch = details.watch_signals

        thinning = options.output_rate if thinned else 0.0
        with ResultFiles(options.folder, parameters.frames, thinning, bool(topics.truth), options.smooth) as files:
            smoothing = Smoothing(navigator, files, point, bool(topics.truth)) if options.smooth else None

            def collect(rows: NDArray[Any], records: NDArray[Any], *beside: Any) -> None:
                known, datum = selected(rows, rows["position_known"]), navigator.datum
                if len(known) and topics.truth and datum:
                    truth.add_rows(known, datum)
                summary.add(known, records)
                details.add_rows(rows)
                clock.lap("compare")
                if smoothing:
                    smoothing.collect()
                    clock.lap("smooth")
                files.write(rows, records, datum, *beside)
                clock.lap("wait")

            clock.lap("start")
            for batch in feed.ordered(messages):
                clock.lap("read")
                details.add_batch(batch)
                clock.lap("details")
                rows = feed.push(batch)
                clock.lap("filter")
                epochs = to_epochs(batch[topics.truth]) if topics.truth in batch else None
                if epochs is not None:
                    truth.add_truth(epochs)
                    if smoothing:
                        smoothing.keep_truth(epochs)
                collect(rows, navigator.take_records(), batch.get(topics.of(Stream.GNSS_POSITION)), epochs)
                progress(reader.bytes_done / reader.bytes_total)
            clock.lap("read")
            collect(np.zeros(0, ODOMETRY), navigator.finish())
            smoothed = {}
            if smoothing:
                smoothed = {"smoothed": smoothing.result(summary)}
                clock.lap("smooth")
            files.finish()
            clock.lap("wait")
            compared = truth.compared() if topics.truth else None
            details.save(files.details, navigator, feed.first_stamp, compared)
            clock.lap("details")
            result = {
                "bag": str(bag),
                "fingerprint": marks,
                "mode": options.mode or parameters.mode,
                "order": options.order,
                **summary.result(navigator, clock.total()),
                **({} if intake is None else ranges_result(navigator, intake, feed)),
                **({} if compared is None else truth_result(topics.truth, truth.offered, compared)),
                "outages": summary.outages(compared),
                **smoothed,
                "warnings": [
                    *reader.warnings,
                    *hints,
                    *(intake.complaints if intake is not None else ()),
                    *summary.warnings(navigator, topics, parameters),
                ],
                "timing": clock.stages | {"write": files.seconds, "total": clock.total()},
            }
            files.write_summary(result)
    return result


def fingerprint_of(bag: Path, parameters: Parameters, options: Options) -> dict[str, str]:
    """Return what a result is of, as short texts: recording (and files beside it), configuration, version."""
    beside = [*options.navigation, *(Path(name) for name in parameters.ranges.rinex_nav_files.split(":") if name)]
    if options.ranges is not None:
        beside.append(options.ranges)
    chosen = {key: value for key, value in dataclasses.asdict(options).items() if key != "folder"}
    return {
        "recording": fingerprint.of_files([*files_of(bag), *beside]),
        "configuration": fingerprint.of_values({"options": chosen, "parameters": to_mapping(parameters)}),
        "version": fingerprint.of_version(),
    }


def with_options(parameters: Parameters, options: Options) -> Parameters:
    """Return the parameters as changed by the options."""
    mode = options.mode if options.mode in ("loose", "tight") else ""
    if not options.mode and options.ranges is not None and not parameters.ranges.use_point_solution:
        mode = "tight"
    if mode:
        parameters = dataclasses.replace(parameters, mode=mode)
    if options.navigation:
        names = ":".join(str(path) for path in options.navigation)
        parameters = dataclasses.replace(
            parameters, ranges=dataclasses.replace(parameters.ranges, rinex_nav_files=names)
        )
    return parameters


def open_ranges(
    navigator: Navigator, parameters: Parameters, options: Options, reader: BagReader, topics: TopicNames
) -> tuple[RangeIntake | None, Iterable[dict[str, Batch]]]:
    """Return the intake of ranges, if there are any, and all messages of the recording and of the files beside it.

    Raises InputError if a file cannot be read or does not belong to the recording.
    """
    batches = reader.batches(topics.wanted())
    named = {kind.name: topic for kind, topic in topics.inputs.items()}
    if "ranges" not in named:
        if options.ranges is not None:
            raise InputError("--ranges FILE is used in mode tight, or with ranges.use_point_solution in mode loose")
        return None, batches
    try:
        intake = RangeIntake(navigator, parameters)
        if options.ranges is not None:
            files = [Path(name) for name in parameters.ranges.rinex_nav_files.split(":") if name]
            offset = options.clock_offset
            beside = read_beside(options.ranges, files, reader.start_time, reader.end_time, offset)
            batches = merged(batches, {named["ranges"]: beside.ranges, named["ephemerides"]: beside.ephemerides})
    except (RinexError, RangesError) as error:
        raise InputError(str(error)) from error
    return intake, batches
