"""The arguments of the command `eskf_replay`, and what is wrong with them."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NoReturn

from eskf_ros.fleet.command import add_options

_EPILOG = """\
results, in DIR/<bag name>_eskf/ (files of an earlier replay are replaced):
  odometry.mcap   odometry, fixes, verdicts, biases, diagnostics, path and truth, for Foxglove and others
  trajectory.tum  t x y z qx qy qz qw: base_link in map as it was published at that time, from the first known position
  trajectory_smoothed.tum  with --smooth: the same trajectory as it is known afterwards; in odometry.mcap as
                  odometry/smoothed
  aids.csv        one line per GNSS message or signal: stamp, arrival, aid, innovation, NIS, degrees of freedom, verdict
  details.npz     what only a report needs: biases, states, errors, fixes and the IMU by the second
  summary.json    everything in numbers
  report.html     with --report: all of it as a page for a browser (eskf_report makes one of several results)

A rosbag2 directory is one recording; several arguments are replayed one after the other. A folder of recordings, or
--jobs or --dask, makes a fleet: what is finished and unchanged is skipped, and DIR/fleet.json has a row for each.
ROS 1 bags: `rosbags-convert --src IN.bag --dst OUT` makes a ROS 2 bag of one.
"""


class Mistake(Exception):
    """A mistake of the user; the text is one line."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise Mistake(f"{message} (eskf_replay --help explains)")


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


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command.

    Over 60 lines: a list of options.
    """
    options = _Parser(
        prog="eskf_replay",
        description="Runs recordings of an IMU and a GNSS receiver through the estimator of eskf_node.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    options.add_argument(
        "bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 directory, .mcap or .db3 file, or a folder of such"
    )
    options.add_argument(
        "--config", type=Path, metavar="FILE", help="parameter file of the node (default: the defaults)"
    )
    options.add_argument(
        "--profile", default="", metavar="NAME", help="parameters for a kind of robot, below those of --config"
    )
    options.add_argument("--out", type=Path, metavar="DIR", help="where the results go (default: next to the bag)")
    options.add_argument(
        "--truth",
        default="",
        metavar="TOPIC",
        help="compare with this topic: nav_msgs/Odometry of base_link in frame earth (ECEF), or in the map frame when "
        "datum is configured, or NavSatFix of the antenna",
    )
    options.add_argument(
        "--outage",
        action="append",
        default=[],
        type=_outage,
        metavar="START:LENGTH",
        help="withhold GNSS for LENGTH seconds, START seconds after the first IMU stamp; can be given several times",
    )
    options.add_argument(
        "--mode",
        choices=("loose", "tight", "ins-only"),
        default="",
        help="loose: the receiver's fixes; tight: range and Doppler of each satellite; ins-only: GNSS until the state "
        "is GOOD, then none (default: the parameter mode; tight with --ranges)",
    )
    options.add_argument(
        "--ranges",
        type=Path,
        metavar="FILE.obs",
        help="RINEX observation file with the pseudoranges and Doppler of the drive, in place of the topic gnss/ranges",
    )
    options.add_argument(
        "--nav",
        type=Path,
        action="append",
        default=[],
        metavar="FILE.nav",
        help="RINEX navigation file with the orbits of the satellites; can be given several times (default: the "
        "parameter ranges.rinex_nav_files)",
    )
    options.add_argument(
        "--clock-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="with --ranges: seconds by which the stamps of the recording are ahead of UTC (GPS time: 18)",
    )
    options.add_argument(
        "--order",
        choices=("log", "stamp"),
        default="log",
        help="give messages as they were recorded, or sorted by stamp within 10 s (default: %(default)s)",
    )
    options.add_argument(
        "--smooth",
        action="store_true",
        help="afterwards go back over the recording: the best trajectory, from what came before and after each moment",
    )
    options.add_argument(
        "--output-rate",
        type=_rate,
        default=50.0,
        metavar="HZ",
        help="rate of trajectory.tum and odometry.mcap; 0: every IMU sample (default: %(default)g)",
    )
    options.add_argument(
        "--json", metavar="FILE", help="write the summary here too; - is stdout, tables go to stderr then"
    )
    options.add_argument("--report", action="store_true", help="make report.html, too (needs the package bokeh)")
    options.add_argument("--quiet", action="store_true", help="no progress and no table; warnings and errors only")
    add_options(options)
    return options
