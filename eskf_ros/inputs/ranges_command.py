"""``eskf_ranges``: write the ranges of RINEX files into a copy of a recording."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from eskf_ros.bags import POINT_CLOUD, BagError, BagReader, BagWriter, open_bag
from eskf_ros.gnss.rinex import RinexError
from eskf_ros.inputs.rinex_as_messages import Beside, RangesError, read_beside

RANGES, EPHEMERIDES = "gnss/ranges", "gnss/ephemerides"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0, 2 for the user's mistakes, 130 after Ctrl-C."""
    arguments = _parser().parse_args(argv)
    out: Path = arguments.out
    try:
        if not out.parent.is_dir():
            raise RangesError(f"{out}: there is no folder {out.parent}")
        if out.is_dir() or any(out.exists() and path.samefile(out) for path in arguments.bag if path.exists()):
            raise RangesError(f"{out}: --out is a new file, FILE.mcap")
        with open_bag(arguments.bag) as reader:
            beside = read_beside(
                arguments.ranges,
                arguments.nav,
                reader.start_time,
                reader.end_time,
                arguments.clock_offset,
                arguments.frame,
                arguments.satellites,
            )
            # The incomplete file is in a folder of its own: an interrupted run leaves an older file as it was.
            with tempfile.TemporaryDirectory(prefix=".eskf_ranges-", dir=out.parent) as folder:
                skipped = _write(Path(folder) / out.name, reader, beside)
                os.replace(Path(folder) / out.name, out)
            notes = [*reader.warnings, *skipped, *beside.notes]
    except (BagError, RangesError, RinexError) as error:
        print(f"eskf_ranges: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"eskf_ranges: {out} cannot be written: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("eskf_ranges: interrupted, nothing written", file=sys.stderr)
        return 130
    if not arguments.quiet:
        for note in notes:
            print(f"eskf_ranges: {note}", file=sys.stderr)
        signals = sum(len(points) for points in beside.ranges.messages["points"])
        sent = sum(len(points) for points in beside.ephemerides.messages["points"])
        print(
            f"{out}: {len(beside.ranges.log_time)} epochs with {signals} signals, {sent} ephemerides; "
            f"{beside.outside} epochs outside of the recording left out"
        )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eskf_ranges",
        description="Write the pseudoranges and Doppler of a RINEX observation file into a copy of a rosbag2 "
        "recording, as the topics gnss/ranges and gnss/ephemerides.",
    )
    parser.add_argument("bag", nargs="+", type=Path, metavar="BAG", help="rosbag2 directories, .mcap or .db3 files")
    parser.add_argument("--ranges", type=Path, required=True, metavar="FILE.obs", help="RINEX observation file")
    parser.add_argument(
        "--nav",
        type=Path,
        action="append",
        required=True,
        metavar="FILE.nav",
        help="RINEX navigation file (repeatable)",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.mcap", help="the file to write")
    parser.add_argument(
        "--clock-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="seconds by which the stamps of the recording are ahead of UTC (default 0; GPS time: 18)",
    )
    parser.add_argument("--frame", default="gps", metavar="NAME", help="frame of the antenna (default gps)")
    parser.add_argument(
        "--satellites", action="store_true", help="write satellite states with the ranges instead of ephemerides"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _write(path: Path, reader: BagReader, beside: Beside) -> list[str]:
    """Copy the recording and add the messages; return what was left out, one line each."""
    slash = "/" if any(topic.startswith("/") for topic in reader.topics) else ""
    added = {slash + RANGES: beside.ranges, slash + EPHEMERIDES: beside.ephemerides}
    for topic in added:
        if topic in reader.topics:
            raise RangesError(f"{topic} is in the recording already")
    skipped = []
    with BagWriter(path) as writer:
        handles: dict[str, int] = {}
        for topic, info in reader.topics.items():
            try:
                handles[topic] = writer.add_topic(topic, info.type)
            except BagError:
                skipped.append(f"topic {topic} is of type {info.type}, which cannot be copied; left out")
        for topic, batch in added.items():
            if len(batch.log_time):
                writer.write(writer.add_topic(topic, POINT_CLOUD), batch.log_time, batch.messages, batch.strings)
        for topic, payloads in reader.serialised(handles):
            for positions, rows in payloads.groups:
                times = payloads.log_time if positions is None else payloads.log_time[positions]
                writer.write(handles[topic], times, rows)
    return skipped


if __name__ == "__main__":
    sys.exit(main())
