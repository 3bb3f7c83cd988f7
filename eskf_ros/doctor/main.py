"""The command `eskf_check`: what is wrong or odd with a recording, before one runs it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

_EPILOG = """\
exit code: 0 the recording can be navigated by, 1 a finding of severity error would break that, 2 it cannot be read
or the command was mistaken. Topics need no configuration: they are found by type and name.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eskf_check",
        description="Says in plain words what is wrong or odd with a recording, topic by topic, and what to do.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 directory, .mcap or .db3 file")
    parser.add_argument("--config", type=Path, metavar="FILE", help="parameter file of the node, as far as it is known")
    parser.add_argument("--json", metavar="FILE", help="write the findings here too; - is stdout, tables go to stderr")
    parser.add_argument("--write-config", type=Path, metavar="FILE", help="write a first parameter file")
    parser.add_argument("--no-filter", action="store_true", help="look at the messages only, without a replay")
    parser.add_argument("--quiet", action="store_true", help="no tables")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 0, 1 for findings that break navigation, 2, 130 after Ctrl-C."""
    options = _parser().parse_args(arguments)
    from eskf_ros.bags import BagError
    from eskf_ros.doctor.examine import check
    from eskf_ros.parameters.ros_yaml import load
    from eskf_ros.parameters.schema import ParameterError
    from eskf_ros.parameters.tree import Parameters

    try:
        parameters = load(options.config) if options.config else Parameters()
        report = check(options.bag, parameters, not options.no_filter)
        if options.json and options.json != "-":
            Path(options.json).write_text(json.dumps(report.as_dict(), indent=2) + "\n", encoding="utf-8")
        if options.write_config:
            options.write_config.write_text(report.parameter_file(), encoding="utf-8")
    except (BagError, ParameterError) as error:
        return _say("; ".join(str(error).splitlines()))
    except OSError as error:
        return _say(f"{error.filename or options.bag}: {error.strerror or error}")
    except KeyboardInterrupt:
        _say("interrupted")
        return 130
    if options.json == "-":
        print(json.dumps(report.as_dict(), indent=2))
    if not options.quiet:
        from rich.console import Console

        report.show(Console(stderr=options.json == "-"))
    return report.exit_code


def _say(text: str) -> int:
    print(f"eskf_check: error: {text}", file=sys.stderr, flush=True)
    return 2


if __name__ == "__main__":
    sys.exit(main())
