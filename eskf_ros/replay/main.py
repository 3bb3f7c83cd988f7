"""The command `eskf_replay`: arguments, errors and exit codes, progress and the final table.

Only the modules that the arguments need are imported here; the estimator is imported once they are known to be right.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eskf_ros.fleet.command import is_fleet
from eskf_ros.fleet.stopping import Stopped, stoppable
from eskf_ros.replay.arguments import Mistake, parser

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.table import Table

    from eskf_ros.fleet.recordings import Found
    from eskf_ros.parameters.tree import Parameters
    from eskf_ros.replay.run import Options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 0, 2 for a mistake of the user, 130 after Ctrl-C, 143 after `kill`."""
    try:
        with stoppable():
            return _run(parser().parse_args(arguments))
    except Mistake as mistake:
        _say(f"error: {mistake}")
        return 2
    except Stopped as stopped:
        _say("interrupted; nothing is written for the recording in progress")
        return 128 + stopped.number
    except BrokenPipeError:
        # The reader of stdout has gone, as in `eskf_replay ... | head`.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _say(text: str) -> None:
    print(f"eskf_replay: {' '.join(text.split())}", file=sys.stderr, flush=True)


def _run(options: argparse.Namespace) -> int:
    from eskf_ros.fleet.recordings import find
    from eskf_ros.parameters.ros_yaml import load
    from eskf_ros.parameters.schema import ParameterError

    if options.report:
        from eskf_ros.report.main import MISSING, is_available

        if not is_available():
            raise Mistake(MISSING)
    found = find(options.bags, _say)
    if not found:
        raise Mistake("there is nothing to replay")
    folders = [recording.results(options.out) for recording in found]
    for folder, count in Counter(folders).items():
        if count > 1:
            raise Mistake(f"two of the recordings would write to {folder}; replay them one by one with different --out")
    try:
        parameters = load(options.config, profile=options.profile)
    except ParameterError as error:
        raise Mistake("; ".join(str(error).splitlines())) from error

    if is_fleet(found, options):
        code = _replay_fleet(found, parameters, options)
        for folder in folders if options.report else ():
            if (folder / "summary.json").is_file():
                _report(folder)
        return code
    summaries: list[dict[str, Any]] = []
    for bag, folder in zip(options.bags, folders, strict=True):
        try:
            summaries.append(_replay(bag, folder, parameters, options))
        except Mistake as mistake:
            _say(f"error: {mistake}")
    if options.json:
        _write_json(options.json, summaries[0] if len(options.bags) == 1 and summaries else summaries)
    return 0 if len(summaries) == len(options.bags) else 2


def _replay(bag: Path, folder: Path, parameters: Parameters, options: argparse.Namespace) -> dict[str, Any]:
    """Replay one recording and show the result; raises Mistake."""
    started = time.perf_counter()
    from eskf_ros.bags import BagError
    from eskf_ros.replay.run import replay
    from eskf_ros.replay.topics import InputError

    wanted = _wanted(folder, options)
    try:
        with _progress(bag, options.quiet) as (progress, compiling):
            summary = replay(bag, parameters, wanted, progress, started)
    except (BagError, InputError) as error:
        raise Mistake(str(error)) from error
    except OSError as error:
        raise Mistake(f"{error.filename or folder}: {error.strerror or error}") from error
    report = _report(folder) if options.report else None
    if not options.quiet:
        _show(summary, folder, report, compiling(), to_stderr=options.json == "-")
    for warning in summary["warnings"]:
        _say(f"warning: {warning}")
    return summary


def _report(folder: Path) -> Path:
    """Make the page of a result and return where it is; raises Mistake."""
    from eskf_ros.report.main import NAME, write_report
    from eskf_ros.report.read import ReportError

    try:
        write_report([folder], folder / NAME)
    except ReportError as error:
        raise Mistake(str(error)) from error
    return folder / NAME


def _wanted(folder: Path, options: argparse.Namespace) -> Options:
    from eskf_ros.replay.run import Options

    return Options(
        folder=folder,
        truth=options.truth,
        outages=tuple(options.outage),
        mode=options.mode,
        order=options.order,
        smooth=options.smooth,
        output_rate=options.output_rate,
        ranges=options.ranges,
        navigation=tuple(options.nav),
        clock_offset=options.clock_offset,
    )


def _replay_fleet(found: Sequence[Found], parameters: Parameters, options: argparse.Namespace) -> int:
    """Replay many recordings and show one table; raises Mistake."""
    from eskf_ros.fleet.dask_cluster import ClusterError
    from eskf_ros.replay.fleet import replay_fleet

    try:
        content = replay_fleet(found, parameters, _wanted(Path(), options), options, _say)
    except (ClusterError, OSError) as error:
        raise Mistake(str(error)) from error
    if options.json:
        _write_json(options.json, content)
    return 2 if content["counts"]["failed"] else 0


@contextmanager
def _progress(bag: Path, quiet: bool) -> Iterator[tuple[Callable[[float], None], Callable[[], float]]]:
    """Show a progress bar if there is a terminal; report compiling in any case.

    Gives what is called with the share that is done, and what returns the seconds of compiling.
    """
    if quiet:
        yield lambda share: None, lambda: 0.0
        return
    from eskf_ros.compiled import sentence_on_compiling, while_compiling

    if not sys.stderr.isatty():
        with while_compiling(sentence_on_compiling(_say)) as compiling:
            yield lambda share: None, compiling
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        with while_compiling(sentence_on_compiling(lambda text: bar.update(task, description=text))) as compiling:
            yield lambda share: bar.update(task, description=bag.name, completed=share), compiling


def _write_json(target: str, content: Any) -> None:
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
        sys.stdout.flush()
        return
    try:
        Path(target).write_text(text, encoding="utf-8")
    except OSError as error:
        raise Mistake(f"--json {target}: {error.strerror or error}") from error


def _show(summary: dict[str, Any], folder: Path, report: Path | None, compiling: float, to_stderr: bool) -> None:
    """Print the tables; ``compiling``: seconds of the replay that only the first one takes."""
    from rich.console import Console

    console = Console(stderr=to_stderr)
    duration, imu_count = summary["duration_s"], summary["imu_count"]
    rate = (imu_count - 1) / duration if duration > 0.0 else 0.0
    seconds = summary["wall_s"] - compiling
    after = f" after {compiling:.0f} s of compiling" if compiling >= 1.0 else ""
    console.print(
        f"{summary['bag']}: {duration:.1f} s, IMU {rate:.1f} Hz, replayed in {seconds:.2f} s{after} "
        f"({duration / seconds:.0f} times real time), at the end {summary['final']['status']}",
        highlight=False,
        soft_wrap=True,
    )
    counted = ("offered", "fused", "rejected", "late", "withheld")
    aids = _table("aid", *counted, "NIS", "in 95 %")
    for name, aid in summary["aids"].items():
        counts = [_rounded(aid[key], "d") for key in counted]
        aids.add_row(name, *counts, _rounded(aid["nis_mean"], ".2f"), _rounded(aid["nis_in_95"], ".1%"))
    imu = summary["imu"]
    used = imu["offered"] - sum(count for reason, count in imu.items() if reason != "offered")
    aids.add_row(
        "imu", *(str(count) for count in (imu["offered"], used, imu["offered"] - used - imu["late"], imu["late"]))
    )
    console.print(aids)
    for line in _rejections(summary):
        console.print(line, highlight=False, soft_wrap=True)
    quality = summary["quality"]
    console.print(
        f"Usable for navigation: {quality['usable']:.1%} of the time from the first position on", highlight=False
    )
    if "ranges" in summary:
        console.print(f"Epochs of ranges: {summary['ranges']['epochs']}, withheld: {summary['ranges']['withheld']}")
    for label, found in (("error against truth", summary), ("the same, smoothed", summary.get("smoothed", {}))):
        if "error" not in found:
            continue
        errors = _table(label, "rms", "50 %", "95 %", "largest")
        units = {"horizontal": "m", "vertical": "m", "speed": "m/s", "heading_deg": "deg"}
        for name, unit in units.items():
            error = found["error"][name] or {}
            values = [_rounded(error.get(key), ".3f") for key in ("rms", "p50", "p95", "max")]
            errors.add_row(f"{name.removesuffix('_deg')}, {unit}", *values)
        console.print(errors)
        for name, nees in found["nees"].items():
            if nees:
                console.print(f"NEES {name}: mean {nees['mean']:.2f} (ideal 3), in 95 %: {nees['in_95']:.1%}")
    if summary["outages"]:
        outages = _table("outage", "s", "driven, m", "error: horizontal, m", "vertical, m", "heading, deg")
        for outage in summary["outages"]:
            at_end = [_rounded(outage.get(key), ".2f") for key in ("horizontal", "vertical", "heading_deg")]
            outages.add_row(f"at {outage['start']:g} s", f"{outage['length']:g}", f"{outage['distance']:.0f}", *at_end)
        console.print(outages)
    console.print(f"Results: {folder}", highlight=False, soft_wrap=True)
    if report is not None:
        console.print(f"Report, open it in a browser: {report}", highlight=False, soft_wrap=True)


def _rejections(summary: dict[str, Any]) -> list[str]:
    """Return a line for each input of which something was rejected, with the reasons."""
    fine = ("fused", "weighed_down", "reset", "outside_history", "waiting")
    reasons = {
        name: {why: count for why, count in aid["verdicts"].items() if why not in fine}
        for name, aid in summary["aids"].items()
    }
    reasons["imu"] = {why: count for why, count in summary["imu"].items() if why not in ("offered", "late") and count}
    return [
        f"{name} rejected: {', '.join(f'{count} {why}' for why, count in counts.items())}"
        for name, counts in reasons.items()
        if counts
    ]


def _table(*headings: str) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column(headings[0], no_wrap=True)
    for heading in headings[1:]:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _rounded(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


if __name__ == "__main__":
    sys.exit(main())
