"""What commands that work on fleets share: their options, and a run with progress, fleet.json and a table."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from eskf_ros.fleet.recordings import Found
from eskf_ros.fleet.task import Backend, Job, Task

FILE = "fleet.json"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add --jobs, --dask and --again."""
    parser.add_argument(
        "--jobs", type=_count, metavar="N", help="work on N recordings at a time, each in a process of its own"
    )
    parser.add_argument(
        "--dask", default="", metavar="ADDRESS", help="work on the Dask cluster with this scheduler, as tcp://host:8786"
    )
    parser.add_argument("--again", action="store_true", help="do finished recordings of a fleet, too")


def _count(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes, 1 or more")
    return int(text)


def is_fleet(found: Sequence[Found], options: argparse.Namespace) -> bool:
    """Return whether a command is to treat its recordings as a fleet: a folder of them, --jobs or --dask was given."""
    return bool(options.jobs or options.dask) or any(recording.inside is not None for recording in found)


def root_of(found: Sequence[Found]) -> Path:
    """Return the folder that holds all recordings: that of fleet.json without --out, and of their names."""
    places = [(one.path.parent if one.inside is None else one.inside).absolute() for one in found]
    return Path(os.path.commonpath(places))


def run_command(
    job: Job, tasks: Sequence[Task], options: argparse.Namespace, folder: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """Run a fleet with options as of `add_options` (and ``quiet``, ``json``), and return what `folder`/fleet.json has.

    Raises ClusterError (`dask_cluster`), and OSError if fleet.json cannot be written.
    """
    from eskf_ros.fleet.run import run_fleet
    from eskf_ros.fleet.show import show, watching

    file = folder / FILE
    with watching(len(tasks), say, options.quiet) as watch:
        try:
            content = run_fleet(job, tasks, backend_of(options), file, options.again, watch)
        except Exception:
            raise
        except BaseException:  # However the command takes Ctrl-C.
            say(f"stopped; {file} says how far it came, and the same command does the rest")
            raise
    if not options.quiet:
        show(job, content, str(file), to_stderr=options.json == "-")
    return content


def backend_of(options: argparse.Namespace) -> Backend:
    """Return the workers that --jobs or --dask asks for; raises ClusterError (`dask_cluster`)."""
    if options.dask:
        from eskf_ros.fleet.dask_cluster import on_dask

        return on_dask(options.dask)
    from eskf_ros.fleet.processes import on_processes

    return on_processes(options.jobs or 1)
