"""The command `eskf_replay`: arguments, errors and exit codes, progress and the final table.

Only the modules that the arguments need are imported here; the estimator is imported once they are known to be right.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.table import Table

    from eskf_ros.parameters.tree import Parameters

_EPILOG = """\
results, in DIR/<bag name>_eskf/ (files of an earlier replay are replaced):
  odometry.mcap   odometry/global and gps/filtered; opens in Foxglove
  trajectory.tum  t x y z qx qy qz qw: base_link in map as it was published at that time, from the first known position
  trajectory_smoothed.tum  with --smooth: the same trajectory as it is known afterwards; in odometry.mcap as
                  odometry/smoothed
  aids.csv        one line per GNSS message or signal: stamp, arrival, aid, innovation, NIS, degrees of freedom, verdict
  summary.json    everything in numbers

A rosbag2 directory is one recording; several arguments are replayed one after the other.
ROS 1 bags: `rosbags-convert --src IN.bag --dst OUT` makes a ROS 2 bag of one.
"""


class _Mistake(Exception):
    """A mistake of the user; the text is one line."""


class _Stopped(BaseException):
    """Ctrl-C or `kill`.

    It is not KeyboardInterrupt: one that passes through an import of a dataclass makes Python die of SIGINT although it
    is caught.
    """

    def __init__(self, number: int) -> None:
        self.number = number


_STOPPING = (signal.SIGINT, signal.SIGTERM)


def _stop(number: int, frame: object) -> NoReturn:
    raise _Stopped(number)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise _Mistake(f"{message} (eskf_replay --help explains)")


def _outage(text: str) -> tuple[float, float]:
    try:
        start, length = (float(part) for part in text.split(":"))
    except ValueError:
        start = length = math.nan
    if not (0.0 <= start < math.inf and 0.0 < length < math.inf):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not START:LENGTH in seconds, START at least 0 and LENGTH above 0, as in 120:45"
        )
    return start, length


def _rate(text: str) -> float:
    try:
        rate = float(text)
    except ValueError:
        rate = math.nan
    if not (rate == 0.0 or 1e-3 <= rate <= 1e5):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a rate in Hz from 0.001 to 100000, or 0 for every IMU sample"
        )
    return rate


def _parser() -> argparse.ArgumentParser:
    """Open all that the node needs.

    Over 60 lines: a list of options.
    """
    parser = _Parser(
        prog="eskf_replay",
        description="Runs recordings of an IMU and a GNSS receiver through the estimator of eskf_node.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 directory, .mcap or .db3 file")
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="parameter file of the node (default: the defaults)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="where the results go (default: next to the bag)")
    parser.add_argument(
        "--truth",
        default="",
        metavar="TOPIC",
        help="compare with this topic: nav_msgs/Odometry of base_link in frame earth (ECEF), or in the map frame when "
        "datum is configured, or NavSatFix of the antenna",
    )
    parser.add_argument(
        "--outage",
        action="append",
        default=[],
        type=_outage,
        metavar="START:LENGTH",
        help="withhold GNSS for LENGTH seconds, START seconds after the first IMU stamp; can be given several times",
    )
    parser.add_argument(
        "--mode",
        choices=("loose", "tight", "ins-only"),
        default="",
        help="loose: the receiver's fixes; tight: range and Doppler of each satellite; ins-only: GNSS until the state "
        "is GOOD, then none (default: the parameter mode; tight with --ranges)",
    )
    parser.add_argument(
        "--ranges",
        type=Path,
        metavar="FILE.obs",
        help="RINEX observation file with the pseudoranges and Doppler of the drive, in place of the topic gnss/ranges",
    )
    parser.add_argument(
        "--nav",
        type=Path,
        action="append",
        default=[],
        metavar="FILE.nav",
        help="RINEX navigation file with the orbits of the satellites; can be given several times (default: the "
        "parameter ranges.rinex_nav_files)",
    )
    parser.add_argument(
        "--clock-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="with --ranges: seconds by which the stamps of the recording are ahead of UTC (GPS time: 18)",
    )
    parser.add_argument(
        "--order",
        choices=("log", "stamp"),
        default="log",
        help="give messages as they were recorded, or sorted by stamp within 10 s (default: %(default)s)",
    )
    parser.add_argument(
        "--smooth",
        action="store_true",
        help="afterwards go back over the recording: the best trajectory, from what came before and after each moment",
    )
    parser.add_argument(
        "--output-rate",
        type=_rate,
        default=50.0,
        metavar="HZ",
        help="rate of trajectory.tum and odometry.mcap; 0: every IMU sample (default: %(default)g)",
    )
    parser.add_argument(
        "--json", metavar="FILE", help="write the summary here too; - is stdout, tables go to stderr then"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress and no table; warnings and errors only")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 0, 2 for a mistake of the user, 130 after Ctrl-C, 143 after `kill`."""
    previous = [signal.signal(number, _stop) for number in _STOPPING]
    try:
        return _run(_parser().parse_args(arguments))
    except _Mistake as mistake:
        _say(f"error: {mistake}")
        return 2
    except _Stopped as stopped:
        _say("interrupted; nothing is written for the recording in progress")
        return 128 + stopped.number
    except BrokenPipeError:
        # The reader of stdout has gone, as in `eskf_replay ... | head`.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    finally:
        for number, handler in zip(_STOPPING, previous, strict=True):
            signal.signal(number, handler)


def _say(text: str) -> None:
    print(f"eskf_replay: {' '.join(text.split())}", file=sys.stderr, flush=True)


def _run(options: argparse.Namespace) -> int:
    from eskf_ros.parameters.ros_yaml import load
    from eskf_ros.parameters.schema import ParameterError
    from eskf_ros.parameters.tree import Parameters

    folders = [_folder(bag, options.out) for bag in options.bags]
    for folder in folders:
        if folders.count(folder) > 1:
            raise _Mistake(
                f"two of the recordings would write to {folder}; replay them one by one with different --out"
            )
    try:
        parameters = load(options.config) if options.config else Parameters()
    except ParameterError as error:
        raise _Mistake("; ".join(str(error).splitlines())) from error

    summaries: list[dict[str, Any]] = []
    for bag, folder in zip(options.bags, folders, strict=True):
        try:
            summaries.append(_replay(bag, folder, parameters, options))
        except _Mistake as mistake:
            _say(f"error: {mistake}")
    if options.json:
        _write_json(options.json, summaries[0] if len(options.bags) == 1 and summaries else summaries)
    return 0 if len(summaries) == len(options.bags) else 2


def _folder(bag: Path, out: Path | None) -> Path:
    whole = bag.resolve()
    name = whole.stem if whole.suffix in (".mcap", ".db3") else whole.name
    return (out or whole.parent) / f"{name}_eskf"


def _replay(bag: Path, folder: Path, parameters: Parameters, options: argparse.Namespace) -> dict[str, Any]:
    """Replay one recording and show the result; raises _Mistake."""
    started = time.perf_counter()
    from eskf_ros.bags import BagError
    from eskf_ros.replay.run import Options, replay
    from eskf_ros.replay.topics import InputError

    wanted = Options(
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
    try:
        with _progress(bag, options.quiet) as progress:
            summary = replay(bag, parameters, wanted, progress, started)
    except (BagError, InputError) as error:
        raise _Mistake(str(error)) from error
    except OSError as error:
        raise _Mistake(f"{error.filename or folder}: {error.strerror or error}") from error
    if not options.quiet:
        _show(summary, folder, to_stderr=options.json == "-")
    for warning in summary["warnings"]:
        _say(f"warning: {warning}")
    return summary


@contextmanager
def _progress(bag: Path, quiet: bool) -> Iterator[Callable[[float], None]]:
    """Show a progress bar if there is a terminal; report compiling in any case."""
    if quiet:
        yield lambda share: None
        return
    from eskf_ros.compiled import sentence_on_compiling, while_compiling

    if not sys.stderr.isatty():
        with while_compiling(sentence_on_compiling(_say)):
            yield lambda share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        with while_compiling(sentence_on_compiling(lambda text: bar.update(task, description=text))):
            yield lambda share: bar.update(task, description=bag.name, completed=share)


def _write_json(target: str, content: Any) -> None:
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
        sys.stdout.flush()
        return
    try:
        Path(target).write_text(text, encoding="utf-8")
    except OSError as error:
        raise _Mistake(f"--json {target}: {error.strerror or error}") from error


def _show(summary: dict[str, Any], folder: Path, to_stderr: bool) -> None:
    """Print the tables."""
    from rich.console import Console

    console = Console(stderr=to_stderr)
    duration, imu_count = summary["duration_s"], summary["imu_count"]
    rate = (imu_count - 1) / duration if duration > 0.0 else 0.0
    console.print(
        f"{summary['bag']}: {duration:.1f} s, IMU {rate:.1f} Hz, replayed in {summary['wall_s']:.2f} s "
        f"({summary['realtime_factor']:.0f} times real time), at the end {summary['final']['status']}",
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
