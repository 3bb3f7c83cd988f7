"""The command `eskf_watch`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

_EPILOG = """\
Without --bag it listens to /diagnostics and eskf/quality of a running node and needs ROS; Ctrl-C ends it.
exit code: 0; 2 the recording cannot be read or holds no diagnostics, or ROS is missing; with --bag and --once 1 if the
robot could not be navigated by the estimate at the end.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eskf_watch",
        description="Shows the diagnostics of eskf_node in the terminal: state, what it waits for, rates, sigmas, "
        "sensors, warnings.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--node", default="", metavar="NAME", help="of several nodes the one of this name, /ns/eskf_node"
    )
    parser.add_argument(
        "--bag", type=Path, metavar="BAG", help="a recording with /diagnostics, or odometry.mcap of a replay"
    )
    parser.add_argument(
        "--speed", type=float, default=10.0, metavar="X", help="with --bag: times real time (default 10)"
    )
    parser.add_argument(
        "--once", action="store_true", help="show the last report only: of --bag its end; live the next"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    options = _parser().parse_args(arguments)
    from eskf_ros.bags import BagError

    try:
        if options.bag is None:
            return _live(options.node, options.once)
        return _recorded(options.bag, options.node, options.once, options.speed)
    except BagError as error:
        print(f"eskf_watch: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0


def _live(node: str, once: bool) -> int:
    try:
        from eskf_ros.ros_node.listen import listen
    except ImportError:
        print(
            "eskf_watch: error: rclpy is missing: source a ROS installation, pip install eskf_ros[ros], or give --bag",
            file=sys.stderr,
        )
        return 2
    return listen(node, once)


def _recorded(bag: Path, node: str, once: bool, speed: float) -> int:
    from rich.console import Console
    from rich.live import Live

    from eskf_ros.watch.panels import dashboard
    from eskf_ros.watch.recording import reports
    from eskf_ros.watch.seen import DIAGNOSTICS, Report, Seen

    seen, console = Seen(node), Console()
    found: Iterable[Report] = reports(bag)
    if once:
        for report in found:
            seen.note(report)
        console.print(dashboard(seen, f"{DIAGNOSTICS} of {node or 'a node'} in {bag}"))
        return 0 if seen.quality is not None and seen.quality.values.get("usable") == "yes" else 1
    with Live(dashboard(seen, str(bag)), console=console, auto_refresh=False) as screen:
        last = None
        for report in found:
            if last is not None and report.stamp > last:
                time.sleep(min(1.0, (report.stamp - last) / speed))
            last = report.stamp
            seen.note(report)
            screen.update(dashboard(seen, str(bag)), refresh=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
