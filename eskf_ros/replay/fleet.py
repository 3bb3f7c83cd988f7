"""The replay of many recordings: the job that `eskf_replay` gives to a fleet, and its tasks."""

from __future__ import annotations

import argparse
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from eskf_ros.fleet.command import root_of, run_command
from eskf_ros.fleet.recordings import Found, files_of
from eskf_ros.fleet.task import Column, Job, Progress, RefusedError, Task
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.run import Options, fingerprint_of

COLUMNS = (
    Column("s", "duration_s", ".0f"),
    Column("end", "status", "s"),
    Column("usable", "usable", ".1%"),
    Column("NIS", "nis_position", ".2f"),
    Column("warnings", "warning_count", "d"),
)
TRUTH_COLUMNS = (
    Column("p95 m", "horizontal_p95", ".2f"),
    Column("deg", "heading_p95_deg", ".2f"),
    Column("NEES", "nees_position", ".2f"),
    Column("outage m", "outage_worst", ".2f"),
)
"""Errors against truth: of position (horizontal, 95 %), heading (95 %), and at the worst end of an outage."""


def replay_fleet(
    found: Sequence[Found],
    parameters: Parameters,
    wanted: Options,
    options: argparse.Namespace,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Replay many recordings with the options of the command and return the content of fleet.json.

    Raises ClusterError, and OSError if fleet.json cannot be written.
    """
    root = root_of(found)
    tasks = replay_tasks(found, options.out, root, parameters, wanted)
    return run_command(replay_job(parameters, wanted), tasks, options, options.out or root, say)


def replay_job(parameters: Parameters, options: Options) -> Job:
    """Return the job of replaying a recording; `options.folder` is that of no recording and not used."""
    return Job(
        command="eskf_replay",
        work=partial(_work, parameters, options),
        figures=figures_of,
        badness=badness_of,
        columns=(*COLUMNS, *(TRUTH_COLUMNS if options.truth else ())),
    )


def replay_tasks(
    found: Sequence[Found], out: Path | None, root: Path, parameters: Parameters, options: Options
) -> list[Task]:
    """Return a task for each recording, named after its path below `root`."""
    return [
        Task(
            name=os.path.relpath(one.path, root),
            recording=one.path,
            result=one.results(out) / "summary.json",
            fingerprint=fingerprint_of(one.path, parameters, options),
            size=sum(file.stat().st_size for file in files_of(one.path) if file.exists()),
        )
        for one in found
    ]


def _work(parameters: Parameters, options: Options, task: Task, progress: Progress) -> dict[str, Any]:
    """Replay one recording in a worker; raises RefusedError with the sentence that the command would say."""
    from eskf_ros.bags import BagError
    from eskf_ros.replay.run import replay
    from eskf_ros.replay.topics import InputError

    folder = task.result.parent
    for left in folder.glob(".partial-*"):  # Of a worker that was killed.
        shutil.rmtree(left, ignore_errors=True)
    try:
        return replay(task.recording, parameters, replace(options, folder=folder), progress)
    except (BagError, InputError) as error:
        raise RefusedError(str(error)) from error
    except OSError as error:
        raise RefusedError(f"{error.filename or task.recording}: {error.strerror or error}") from error


def figures_of(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return of a summary what compares recordings: shares, means, errors in m and deg; None where there is none."""
    error, nees = summary.get("error", {}), summary.get("nees", {})
    fixes = summary["aids"].get("gnss_position", {})
    at_ends = [outage["horizontal"] for outage in summary["outages"] if outage.get("horizontal") is not None]
    return {
        "duration_s": summary["duration_s"],
        "replayed_in_s": summary["wall_s"],
        "status": summary["final"]["status"],
        "usable": summary["quality"]["usable"],
        "restarts": summary["restarts"],
        "position_resets": summary["position_resets"],
        "nis_position": fixes.get("nis_mean"),
        "warning_count": len(summary["warnings"]),
        "warnings": summary["warnings"],
        "compared": summary["truth"]["compared"] if "truth" in summary else None,
        "horizontal_rms": (error.get("horizontal") or {}).get("rms"),
        "horizontal_p95": (error.get("horizontal") or {}).get("p95"),
        "heading_p95_deg": (error.get("heading_deg") or {}).get("p95"),
        "nees_position": (nees.get("position") or {}).get("mean"),
        "outage_worst": max(at_ends, default=None),
    }


def badness_of(figures: Mapping[str, Any]) -> tuple[float, ...]:
    """Return what the table is sorted by: the error against truth, then time not usable, then warnings."""
    largest = figures["horizontal_p95"]
    if largest is None:
        largest = 0.0 if figures["compared"] is None else math.inf
    return (largest, 1.0 - figures["usable"], float(figures["warning_count"]))
