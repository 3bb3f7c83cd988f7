"""``eskf_simulate``: write a simulated recording with truth."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eskf_ros.bags import BagError, BagWriter
from eskf_ros.simulate import option_text
from eskf_ros.simulate.frames import STRINGS
from eskf_ros.simulate.imu import GRADES
from eskf_ros.simulate.messages import Topic, topics_of
from eskf_ros.simulate.recording import AIDS, EPISODES
from eskf_ros.simulate.scenario import SCENARIOS, Options, Recording, simulate
from eskf_ros.simulate.scenario_families import FAMILIES

_BLOCK_NANOSECONDS = 60_000_000_000


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0, 2 for the user's mistakes, 130 after Ctrl-C."""
    arguments = _parser().parse_args(argv)
    if arguments.list:
        print(_list())
        return 0
    out: Path = arguments.out or Path(f"{str(arguments.scenario).replace(':', '_')}.mcap")
    try:
        if arguments.scenario is None:
            raise ValueError(f"name a scenario: {', '.join(SCENARIOS)}, or one with a number, such as creep:0.4")
        if not out.parent.is_dir():
            raise ValueError(f"{out}: there is no folder {out.parent}")
        recording = simulate(arguments.scenario, arguments.seed, **_options(arguments))
        topics = topics_of(recording)
        # A folder of its own for the file while it is incomplete: an interrupted run leaves an older one as it was.
        with tempfile.TemporaryDirectory(prefix=".eskf_simulate-", dir=out.parent) as folder:
            _write(Path(folder) / out.name, topics)
            os.replace(Path(folder) / out.name, out)
    except (BagError, ValueError) as error:
        print(f"eskf_simulate: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"eskf_simulate: {out} cannot be written: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("eskf_simulate: interrupted, nothing written", file=sys.stderr)
        return 130
    if not arguments.quiet:
        print(_summary(out, recording, topics))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eskf_simulate",
        description="Write a simulated motion as a rosbag2 recording (mcap) with IMU, GNSS, truth and other sensors. "
        "The same scenario, seed and options give the same recording.",
    )
    parser.add_argument("scenario", nargs="?", metavar="SCENARIO", help="what moves, and how; --list describes them")
    parser.add_argument("--list", action="store_true", help="describe scenarios, sensors and episodes and stop")
    parser.add_argument("--out", type=Path, metavar="FILE.mcap", help="the file to write (default: SCENARIO.mcap here)")
    parser.add_argument("--seed", type=_seed, default=0, metavar="N", help="seed of all random errors (default 0)")
    parser.add_argument("--grade", choices=GRADES, default="industrial", help="IMU error model (default industrial)")
    parser.add_argument("--imu-rate", type=float, default=200.0, metavar="HZ", help="default 200")
    parser.add_argument("--gnss-rate", type=float, default=5.0, metavar="HZ", help="default 5")
    parser.add_argument("--truth-rate", type=float, default=50.0, metavar="HZ", help="at most this, default 50")
    parser.add_argument(
        "--sensor",
        action="append",
        default=[],
        metavar="NAME[:KEY=VALUE,...]",
        help=f"record this sensor too (repeatable): {', '.join(AIDS)}; --list shows their keys",
    )
    parser.add_argument(
        "--episode",
        action="append",
        default=[],
        metavar="KIND:KEY=VALUE,...",
        help=f"let this happen (repeatable): {', '.join(EPISODES)}; --list shows their keys",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="OPTION=VALUE",
        help="any option of the simulation (repeatable), such as lever_arm=0.8/-0.2/1.4; --list shows them",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _options(arguments: argparse.Namespace) -> dict[str, Any]:
    options: dict[str, Any] = {
        "grade": arguments.grade,
        "imu_rate": arguments.imu_rate,
        "gnss_rate": arguments.gnss_rate,
        "truth_rate": arguments.truth_rate,
        "episodes": tuple(option_text.read(text, EPISODES)[1] for text in arguments.episode),
    }
    options.update(option_text.read(text, AIDS) for text in arguments.sensor)
    options.update(option_text.read_value(text, Options) for text in arguments.set)
    return options


def _list() -> str:
    width = max(map(len, (*SCENARIOS, *FAMILIES))) + len(":deg/s")
    lines = [
        "Scenarios:",
        *(f"  {name:{width}}  {found.description}" for name, found in SCENARIOS.items()),
        "Scenarios with a number:",
        *(f"  {f'{name}:{family.unit}':{width}}  {family.description}" for name, family in FAMILIES.items()),
        "Sensors, with --sensor:",
        *(f"  {option_text.spelled(name, kind)}" for name, kind in AIDS.items()),
        "Episodes, with --episode; START and LENGTH in seconds:",
        *(f"  {option_text.spelled(name, kind)}" for name, kind in EPISODES.items()),
        "All options, with --set:",
        *(f"  {text}" for text in option_text.values(Options)),
    ]
    return "\n".join(lines)


def _seed(text: str) -> int:
    seed = int(text)
    if seed < 0:
        raise argparse.ArgumentTypeError(f"a seed is not negative: {text}")
    return seed


def _write(path: Path, topics: Sequence[Topic]) -> None:
    """Write the topics minute by minute, so that no whole recording is held serialised."""
    first = min(int(topic.arrival[0]) for topic in topics if len(topic.arrival))
    last = max(int(topic.arrival[-1]) for topic in topics if len(topic.arrival))
    with BagWriter(path) as writer:
        handles = [writer.add_topic(topic.name, topic.type_name) for topic in topics]
        for begin in range(first, last + 1, _BLOCK_NANOSECONDS):
            for handle, topic in zip(handles, topics, strict=True):
                low, high = np.searchsorted(topic.arrival, (begin, begin + _BLOCK_NANOSECONDS))
                block = slice(int(low), int(high))
                writer.write(handle, topic.arrival[block], topic.messages(block), STRINGS)


def _summary(out: Path, recording: Recording, topics: Sequence[Topic]) -> str:
    duration = (recording.imu_stamp[-1] - recording.imu_stamp[0]) * 1e-9
    counts = ", ".join(f"{topic.name} {len(topic.arrival)}" for topic in topics)
    lines = [
        f"{out}: {recording.name}, seed {recording.seed}, {duration:.1f} s, {out.stat().st_size / 1e6:.1f} MB",
        f"  messages: {counts}",
        *(f"  without GNSS: {first:g} s to {last:g} s" for first, last in recording.outages),
        "  parameters of its sensors:",
        *(f"    {name}: {value}" for name, value in recording.parameters().items() if name != "datum"),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
