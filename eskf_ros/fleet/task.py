"""What a fleet is made of: tasks, the job that is done with each, and what became of it.

A command states its job (`Job`): a function that takes a task, writes results, and the JSON file `task.result` last,
with the fingerprint of the task in it. The rest of the package needs to know nothing more.
"""

from __future__ import annotations

import resource
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Progress = Callable[[float], None]
"""Called with the share of a recording that is processed, 0 to 1."""


class RefusedError(Exception):
    """A recording with which the job cannot be done; the text is a sentence for the user."""


@dataclass(frozen=True)
class Task:
    """One recording: what it is called, the JSON file that tells it is done, what that must be of, and bytes to read.

    `fingerprint` has short texts, by what they are of: recording, configuration, version.
    """

    name: str
    recording: Path
    result: Path
    fingerprint: Mapping[str, str]
    size: int = 0


@dataclass(frozen=True)
class Column:
    """A column of the table: a figure and how it is written."""

    heading: str
    figure: str
    form: str


@dataclass(frozen=True)
class Job:
    """What a command does with each recording.

    Args:
        command: its name.
        work: does it, and returns the content of ``task.result``; raises RefusedError. It is sent to other processes:
            a function of a module, or a functools.partial of one.
        figures: picks from that content what stands in fleet.json; strings, numbers, None, and lists of them.
        badness: of figures, a tuple of numbers: the greatest comes first.
        columns: the table.
    """

    command: str
    work: Callable[[Task, Progress], Mapping[str, Any]]
    figures: Callable[[Mapping[str, Any]], dict[str, Any]]
    badness: Callable[[Mapping[str, Any]], tuple[float, ...]]
    columns: Sequence[Column]


@dataclass(frozen=True)
class Outcome:
    """What became of a task: ``state`` is done, skipped (was done), failed or open (not reached).

    ``seconds`` of wall time of the work, ``attempts`` above 1 where a worker died of it, ``peak_mb``: most memory that
    its process has ever had so far.
    """

    task: Task
    state: str
    figures: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    trace: str = ""
    seconds: float = 0.0
    attempts: int = 1
    worker: str = ""
    peak_mb: float = 0.0


Backend = Callable[[Job, Sequence[Task], Callable[[str, float], None]], Iterator[Outcome]]
"""Does a job with tasks: yields outcomes as they come, tells progress by the name of the task.

Closing the iterator stops the workers.
"""


def attempt(job: Job, task: Task, progress: Progress, worker: str) -> Outcome:
    """Do the job with one recording, in whatever process this is; no error of the work leaves it."""
    began = time.perf_counter()
    error = trace = ""
    figures: dict[str, Any] = {}
    try:
        figures = job.figures(job.work(task, progress))
    except RefusedError as refusal:
        error = str(refusal)
    except Exception as fault:  # A fleet goes on, whatever is wrong with one recording or with the work.
        error = f"{type(fault).__name__}: {fault}"
        trace = traceback.format_exc()
    return Outcome(
        task=task,
        state="failed" if error else "done",
        figures=figures,
        error=error,
        trace=trace,
        seconds=time.perf_counter() - began,
        worker=worker,
        peak_mb=peak_memory(),
    )


def peak_memory() -> float:
    """Return the most memory that this process has ever had, in MB (2^20 bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
