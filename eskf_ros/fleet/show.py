"""What the user sees of a fleet: progress over all, and a table with the worst first."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from eskf_ros.fleet.run import Watch
from eskf_ros.fleet.task import Job, Outcome

ROWS = 20
"""Rows of the table; fleet.json has all."""

WIDTH = 160
"""Characters of a line of the table in a file or a pipe."""

PERIOD = 10.0
"""Seconds from one line about progress to the next where there is no terminal."""


@contextmanager
def watching(count: int, say: Callable[[str], None], quiet: bool) -> Iterator[Watch]:
    """Show progress over all `count` recordings, and say at once which failed, and what was warned of."""
    told = 0

    def news(outcomes: Sequence[Outcome]) -> None:
        nonlocal told
        for outcome in outcomes[told:]:
            for sentence in _sentences(outcome):
                say(sentence if outcome.task.name in sentence else f"{sentence} ({outcome.task.name})")
        told = len(outcomes)

    if quiet:
        yield lambda outcomes, shares: news(outcomes)
        return
    if not sys.stderr.isatty():
        last = began = time.monotonic()

        def lines(outcomes: Sequence[Outcome], shares: Mapping[str, float]) -> None:
            nonlocal last
            news(outcomes)
            now = time.monotonic()
            if now - last > PERIOD:
                last = now
                say(f"{_counted(outcomes, count)} after {now - began:.0f} s")

        yield lines
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        row = bar.add_task("starting", total=count)

        def move(outcomes: Sequence[Outcome], shares: Mapping[str, float]) -> None:
            news(outcomes)
            bar.update(row, description=_counted(outcomes, count), completed=len(outcomes) + sum(shares.values()))

        yield move


def _sentences(outcome: Outcome) -> list[str]:
    """Return what is said of a recording: its error, or the first of its warnings, if it was done just now."""
    if outcome.error:
        return [f"error: {outcome.error}"]
    warnings = outcome.figures.get("warnings") or []
    if outcome.state != "done" or not warnings:
        return []
    more = f"; and {len(warnings) - 1} more in fleet.json" if len(warnings) > 1 else ""
    return [f"warning: {warnings[0]}{more}"]


def _counted(outcomes: Sequence[Outcome], count: int) -> str:
    failed = sum(outcome.state == "failed" for outcome in outcomes)
    return f"{len(outcomes)} of {count}" + (f", {failed} failed" if failed else "")


def show(job: Job, content: Mapping[str, Any], place: str, to_stderr: bool) -> None:
    """Print the table and where the rest is."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(stderr=to_stderr)
    if not console.is_terminal:
        console = Console(stderr=to_stderr, width=WIDTH)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("worst first", overflow="fold", min_width=12)
    table.add_column("", no_wrap=True)
    for column in job.columns:
        table.add_column(column.heading, justify="right", no_wrap=True)
    recordings = content["recordings"]
    for entry in recordings[:ROWS]:
        figures = entry["figures"]
        values = [_written(figures.get(column.figure), column.form) for column in job.columns]
        table.add_row(entry["name"], entry["state"], *values)
    console.print(table)
    if len(recordings) > ROWS:
        console.print(f"and {len(recordings) - ROWS} more", highlight=False)
    counts = ", ".join(f"{number} {state}" for state, number in content["counts"].items() if number)
    console.print(f"{len(recordings)} recordings: {counts}, in {content['wall_s']:.1f} s", highlight=False)
    console.print(f"All figures: {place}", highlight=False, soft_wrap=True)


def _written(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)
