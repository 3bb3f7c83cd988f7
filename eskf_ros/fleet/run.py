"""Runs a fleet: leaves out what is done, hands the rest to workers, and writes down what became of each."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from eskf_ros.fleet.fingerprint import of_version
from eskf_ros.fleet.task import Backend, Job, Outcome, Task

STATES = ("failed", "done", "skipped", "open")

Watch = Callable[[Sequence[Outcome], Mapping[str, float]], None]
"""Called after each change with the outcomes so far and the shares of the recordings in work, by name."""


def run_fleet(
    job: Job,
    tasks: Sequence[Task],
    backend: Backend,
    file: Path,
    again: bool = False,
    watch: Watch = lambda outcomes, shares: None,
) -> dict[str, Any]:
    """Do the job with each recording and return the content of `file`, which is written in any case, also at Ctrl-C.

    A recording whose result has the fingerprint of its task is skipped, unless `again`. The largest come first, so that
    none is begun when all others are done. Raises OSError if `file` cannot be written.
    """
    began = time.perf_counter()
    outcomes: list[Outcome] = [] if again else [old for old in (_finished(job, task) for task in tasks) if old]
    done = {outcome.task.name for outcome in outcomes}
    waiting = sorted((task for task in tasks if task.name not in done), key=lambda task: -task.size)
    shares: dict[str, float] = {}

    def report(name: str, share: float) -> None:
        shares[name] = share
        watch(outcomes, shares)

    watch(outcomes, shares)
    try:
        if waiting:
            with closing(backend(job, waiting, report)) as results:  # type: ignore[type-var]
                for outcome in results:
                    outcomes.append(outcome)
                    shares.pop(outcome.task.name, None)
                    watch(outcomes, shares)
    finally:
        content = _content(job, tasks, outcomes, time.perf_counter() - began)
        _write(file, content)
    return content


def _finished(job: Job, task: Task) -> Outcome | None:
    """Return the outcome of an earlier run, if its result is of the same recording, configuration and version."""
    try:
        content = json.loads(task.result.read_text(encoding="utf-8"))
        if content["fingerprint"] != dict(task.fingerprint):
            return None
        return Outcome(task, "skipped", figures=job.figures(content))
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _content(job: Job, tasks: Sequence[Task], outcomes: Sequence[Outcome], seconds: float) -> dict[str, Any]:
    reached = {outcome.task.name for outcome in outcomes}
    everything = [*outcomes, *(Outcome(task, "open") for task in tasks if task.name not in reached)]
    everything.sort(key=lambda outcome: outcome.task.name)
    everything.sort(key=lambda outcome: _badness(job, outcome), reverse=True)
    return {
        "command": job.command,
        "version": of_version(),
        "wall_s": seconds,
        "work_s": sum(outcome.seconds for outcome in outcomes),
        "workers": len({outcome.worker for outcome in outcomes if outcome.worker}),
        "counts": {state: sum(outcome.state == state for outcome in everything) for state in STATES},
        "recordings": [_entry(outcome) for outcome in everything],
    }


def _badness(job: Job, outcome: Outcome) -> tuple[float, ...]:
    if outcome.figures:
        return (0.0, *job.badness(outcome.figures))
    return (1.0 if outcome.state == "failed" else -1.0,)


def _entry(outcome: Outcome) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": outcome.task.name,
        "state": outcome.state,
        "recording": str(outcome.task.recording),
        "result": str(outcome.task.result),
        "fingerprint": dict(outcome.task.fingerprint),
    }
    if outcome.state in ("done", "failed"):
        entry |= {
            "seconds": outcome.seconds,
            "attempts": outcome.attempts,
            "worker": outcome.worker,
            "peak_mb": outcome.peak_mb,
        }
    if outcome.error:
        entry |= {"error": outcome.error, "trace": outcome.trace}
    return entry | {"figures": outcome.figures}


def _write(file: Path, content: Mapping[str, Any]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f".{file.name}.{os.getpid()}")
    partial.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(file)
