"""The calibration over a fleet: each step is done with many recordings at a time, on processes or on a Dask cluster.

A step (the first look, a pass of the filter, the comparison) needs the results of all recordings of the step before, so
it is a round of its own. What a recording has said in a round is a JSON file, which has the floats exactly: the result
is that of one process, and after a stop the same command takes up the rounds that are there.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eskf_ros.bags import BagError
from eskf_ros.calibration.compare import compared
from eskf_ros.calibration.recording import Look, Pass, Recording, look_at, run_pass
from eskf_ros.filter.warm_up import compile_kernels
from eskf_ros.fleet import fingerprint
from eskf_ros.fleet.command import FILE, backend_of, root_of
from eskf_ros.fleet.recordings import Found, files_of
from eskf_ros.fleet.run import run_fleet
from eskf_ros.fleet.show import show, watching
from eskf_ros.fleet.task import Column, Job, Progress, RefusedError, Task
from eskf_ros.parameters.mapping import to_mapping
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.topics import InputError

COMMAND = "eskf_calibrate"

COLUMNS = (
    Column("outages m, before", "outage_before", ".2f"),
    Column("after", "outage_after", ".2f"),
    Column("NIS, before", "nis_before", ".2f"),
    Column("after", "nis_after", ".2f"),
)
"""Medians of the ends of outages; the NIS of the stream with the largest. Of a pass only the NIS after it is known."""

FORMS: dict[Callable[..., Any], tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    look_at: (Look.as_dict, Look.from_dict),
    run_pass: (Pass.as_dict, Pass.from_dict),
    compared: (dict, dict),
}
"""How the result of each step becomes JSON, and is made of it again."""


def recordings_of(found: Sequence[Found], parameters: Parameters) -> list[Recording]:
    """Return the recordings of a fleet, each named after its path below the folder that holds all.

    Raises InputError if one is named twice.
    """
    root = root_of(found)
    names = [os.path.relpath(one.path, root) for one in found]
    for name, count in Counter(names).items():
        if count > 1:
            raise InputError(f"{name} is given {count} times")
    return [Recording(name, path=one.path, parameters=parameters) for name, one in zip(names, found, strict=True)]


class Rounds:
    """`each` of `calibrate`: does one step with all recordings, as --jobs, --dask and --again say.

    ``folder``: where fleet.json of the latest round is written, and the results of all; ``failed`` tells how many
    recordings were left out so far.
    """

    def __init__(self, options: argparse.Namespace, folder: Path, say: Callable[[str], None]) -> None:
        self.failed = 0
        self._options, self._folder, self._say = options, folder, say
        self._number = 0
        self._latest: tuple[Job, dict[str, Any]] | None = None

    def __call__(self, step: Callable[[Any], Any], recordings: Iterable[Recording]) -> list[Any]:
        """Return the results of a step in the order of the recordings, None where it has failed.

        Raises ClusterError (`fleet.dask_cluster`), and OSError if fleet.json cannot be written.
        """
        assert isinstance(step, partial)
        given = list(recordings)
        self._number += 1
        folder = self._folder / f"round_{self._number}"
        tasks = [task_of(one, step, folder) for one in given]
        job = Job(COMMAND, partial(work, step, given[0].parameters), figures_of, badness_of, COLUMNS)
        options = self._options
        with watching(len(tasks), self._say, options.quiet) as watch:
            content = run_fleet(job, tasks, backend_of(options), self._folder / FILE, options.again, watch)
        self._latest = job, content
        self.failed += content["counts"]["failed"]
        done = {entry["name"] for entry in content["recordings"] if entry["state"] != "failed"}
        form = FORMS[step.func][1]
        return [form(json.loads(task.result.read_text())["result"]) if task.name in done else None for task in tasks]

    def show(self) -> None:
        """Print the table of the latest round, the worst recordings first."""
        if self._latest is not None:
            show(*self._latest, str(self._folder / FILE), to_stderr=self._options.json == "-")


def task_of(recording: Recording, step: partial[Any], folder: Path) -> Task:
    """Return the task of a step with one recording."""
    assert recording.path is not None
    navigation = recording.parameters.ranges.rinex_nav_files
    files = [*files_of(recording.path), *(Path(name) for name in navigation.split(":") if name)]
    values = {"step": step.func.__name__, "topics": to_mapping(recording.parameters), **step.keywords}
    return Task(
        name=recording.name,
        recording=recording.path,
        result=folder / f"{recording.name}.json",
        fingerprint={
            "recording": fingerprint.of_files(files),
            "configuration": fingerprint.of_values({key: plain(value) for key, value in values.items()}),
            "version": fingerprint.of_version(),
        },
        size=sum(file.stat().st_size for file in files if file.exists()),
    )


def plain(value: Any) -> Any:
    """Return an argument of a step as JSON has it, exactly."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return to_mapping(value) if isinstance(value, Parameters) else value


def work(step: partial[Any], parameters: Parameters, task: Task, progress: Progress) -> dict[str, Any]:
    """Do a step with one recording in a worker; raises RefusedError with the sentence that the command would say."""
    if step.func is not look_at:
        compile_kernels()
    progress(0.0)  # The others may begin: what is compiled is in the cache.
    try:
        result = step(Recording(task.name, path=task.recording, parameters=parameters))
    except (BagError, InputError) as error:
        raise RefusedError(str(error)) from error
    except OSError as error:
        raise RefusedError(f"{error.filename or task.recording}: {error.strerror or error}") from error
    content = {"fingerprint": dict(task.fingerprint), "result": FORMS[step.func][0](result)}
    task.result.parent.mkdir(parents=True, exist_ok=True)
    partial_file = task.result.with_name(f".{task.result.name}.{os.getpid()}")
    partial_file.write_text(json.dumps(content), encoding="utf-8")
    partial_file.replace(task.result)
    return content


def figures_of(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return of the result of any step what compares recordings; None where there is none."""
    result = content["result"]
    both = {"before": result.get("before", {}), "after": result.get("after", result)}
    found: dict[str, Any] = {}
    for label, figures in both.items():
        ends = figures.get("outage_ends")
        found[f"outage_{label}"] = float(np.median(ends)) if ends else None
        found[f"nis_{label}"] = max(figures.get("nis", {}).values(), default=None)
    return found


def badness_of(figures: Mapping[str, Any]) -> tuple[float, ...]:
    """Return what the table is sorted by: the outages after the calibration, then the NIS."""
    return (figures["outage_after"] or 0.0, figures["nis_after"] or 0.0)
