"""The command `eskf_report`: results of replays as one HTML page."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

NAME = "report.html"
MISSING = "the report needs the Python package bokeh: pip install 'bokeh>=3.4', or 'eskf_ros[report]'"

_EPILOG = """\
A RESULT is the folder that eskf_replay has written. The first is shown in full, the others beside it: other modes or
configurations, or the trajectory of another program as a TUM file (t x y z qx qy qz qw), in the map frame of the first.
The page needs no network and no other file. Exit code 2: a result cannot be shown.
"""


def is_available() -> bool:
    """Return whether bokeh, which draws the page, is installed."""
    return importlib.util.find_spec("bokeh") is not None


def write_report(results: Sequence[Path], target: Path) -> None:
    """Write the page on these results. Raises ReportError."""
    from eskf_ros.report.page import page
    from eskf_ros.report.read import ReportError, read_result

    text = page([read_result(path) for path in results])
    try:
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ReportError(f"{error.filename or target}: {error.strerror or error}") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 0, 2 for a mistake of the user, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog="eskf_report",
        description="Shows what a replay found as one HTML page: verdict, map, and all curves over time.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("results", nargs="+", type=Path, metavar="RESULT", help="folder of a replay, or a TUM file")
    parser.add_argument("--out", type=Path, metavar="FILE", help=f"the page (default: {NAME} in the first RESULT)")
    options = parser.parse_args(arguments)
    if not is_available():
        return _say(MISSING)
    from eskf_ros.report.read import ReportError

    target = options.out or options.results[0] / NAME
    try:
        write_report(options.results, target)
    except ReportError as error:
        return _say(str(error))
    except KeyboardInterrupt:
        print("eskf_report: interrupted, nothing written", file=sys.stderr)
        return 130
    print(f"Report: {target}")
    return 0


def _say(text: str) -> int:
    print(f"eskf_report: error: {text}", file=sys.stderr, flush=True)
    return 2


if __name__ == "__main__":
    sys.exit(main())
