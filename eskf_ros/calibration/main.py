"""The command `eskf_calibrate`: the installation of the sensors from recordings, or their noise from hours at rest."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eskf_ros.fleet.command import add_options, is_fleet
from eskf_ros.fleet.recordings import RESULTS, find
from eskf_ros.fleet.stopping import Stopped, stoppable

if TYPE_CHECKING:
    from eskf_ros.calibration.fleet import Rounds

_EPILOG = """\
One installation, one or several recordings of it: fixes, velocities and, as far as there are, wheels and a dual
antenna. Drive turns to both sides, speed up and brake. docs/calibrate.md says what shows what.

A folder of recordings, or --jobs or --dask, makes a fleet: each pass works on N recordings at a time, with the result
of one process. A recording that cannot be read is named and left out. What is finished lies in FILE_eskf/ (without
.yaml): after a stop the same command goes on from there, and its fleet.json has a row for each recording.
exit code: 0 done, 2 a recording cannot be read or the command was mistaken, 130 after Ctrl-C.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="eskf_calibrate",
        description="Finds lever arm, mounting of the IMU, time offsets, scales and noise from recordings.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 directory, .mcap or .db3 file, or a folder of such"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="parameter file of the node: what is known so far")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("calibrated.yaml"),
        metavar="FILE",
        help="the parameter file to write (default: %(default)s)",
    )
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument(
        "--vehicle",
        action="store_true",
        default=None,
        help="it has wheels that do not slip sideways: finds the mounting of the IMU, from any orientation, and the "
        "rear axle (default: if nhc.enabled is configured, or wheels were recorded)",
    )
    kind.add_argument("--no-vehicle", dest="vehicle", action="store_false", help="it has none, or they slip")
    parser.add_argument("--truth", default="", metavar="TOPIC", help="compare with this topic, as eskf_replay does")
    parser.add_argument("--no-comparison", action="store_true", help="no runs before and after")
    parser.add_argument(
        "--static", action="store_true", help="BAG is of an IMU at rest: Allan deviation, noise densities, plot"
    )
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="with --static: the plot (default: that of --out with .png)"
    )
    parser.add_argument("--json", metavar="FILE", help="write the results here too; - is stdout, tables go to stderr")
    parser.add_argument("--quiet", action="store_true", help="no progress and no tables; warnings and errors only")
    add_options(parser)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code: 0, 2, 130 after Ctrl-C, 143 after `kill`."""
    options = _parser().parse_args(arguments)
    from eskf_ros.bags import BagError
    from eskf_ros.fleet.dask_cluster import ClusterError
    from eskf_ros.parameters.schema import ParameterError
    from eskf_ros.replay.topics import InputError

    try:
        with stoppable():
            return _static(options) if options.static else _calibrate(options)
    except (BagError, ClusterError, InputError, ParameterError, ValueError) as error:
        return _mistake("; ".join(str(error).splitlines()))
    except ImportError as error:
        return _mistake(f"{error.name} is missing: pip install 'eskf_ros[calibrate]'")
    except OSError as error:
        return _mistake(f"{error.filename or options.bags[0]}: {error.strerror or error}")
    except Stopped as stopped:
        _say(f"interrupted; {options.out} is not written")
        return 128 + stopped.number


def _calibrate(options: argparse.Namespace) -> int:
    from rich.console import Console

    from eskf_ros.calibration.calibrate import calibrate
    from eskf_ros.calibration.report import as_dict, parameter_file, show
    from eskf_ros.parameters.ros_yaml import load
    from eskf_ros.parameters.tree import Parameters

    parameters = load(options.config) if options.config else Parameters()
    found = find(options.bags, _say)
    rounds: Rounds | None = None
    recordings: list[Any] = [one.path for one in found]
    if found and is_fleet(found, options):
        from eskf_ros.calibration.fleet import Rounds, recordings_of

        recordings = recordings_of(found, parameters)
        rounds = Rounds(options, options.out.with_name(options.out.stem + RESULTS), _say)
    calibration = calibrate(
        recordings,
        parameters,
        options.vehicle,
        options.truth,
        not options.no_comparison,
        each=map if rounds is None else rounds,
        say=(lambda text: None) if options.quiet else _say,
    )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(parameter_file(calibration), encoding="utf-8")
    _write_json(options, as_dict(calibration))
    for warning in calibration.warnings:
        _say(f"warning: {warning}")
    if not options.quiet:
        show(calibration, Console(stderr=options.json == "-"), is_compared=rounds is None)
        if rounds is not None:
            rounds.show()
        _say(f"written: {options.out}")
    return 2 if rounds is not None and rounds.failed else 0


def _static(options: argparse.Namespace) -> int:
    import numpy as np

    from eskf_ros.bags import open_bag
    from eskf_ros.calibration.static import draw, parameters_of, static_noise
    from eskf_ros.parameters.docs import yaml_value
    from eskf_ros.parameters.ros_yaml import load
    from eskf_ros.parameters.tree import Parameters
    from eskf_ros.replay.topics import IMU, InputError, find_topic

    parameters = load(options.config) if options.config else Parameters()
    if len(options.bags) != 1:
        raise InputError("--static takes one recording")
    with open_bag(options.bags) as reader:
        topic = find_topic(reader, parameters.topics.imu)
        if not topic or reader.topics[topic].type != IMU:
            raise InputError(f"{options.bags[0]}: no IMU on {parameters.topics.imu}; set topics.imu in --config FILE")
        samples = np.concatenate([batch[topic].messages for batch in reader.batches({topic: IMU}) if topic in batch])
    columns = {"specific_force": "linear_acceleration", "angular_rate": "angular_velocity"}
    noise = static_noise({"stamp": samples["stamp"], **{name: samples[column] for name, column in columns.items()}})
    found = parameters_of(noise)
    lines = [f"# By eskf_calibrate --static from {options.bags[0].name}.", "/**:", "  ros__parameters:"]
    for name, (value, about) in found.items():
        lines += [f"    # {about}", f"    {name}: {yaml_value(float(f'{value:.4g}'))}"]
    options.out.write_text("\n".join(lines if found else [*lines, "    mode: loose"]) + "\n", encoding="utf-8")
    plot = options.plot or options.out.with_suffix(".png")
    draw(noise, plot)
    axes = [
        {"name": a.name, "density": a.density, "bias_instability": a.instability, "bias_random_walk": a.walk}
        for a in noise.axes
    ]
    _write_json(options, {"seconds": noise.seconds, "rate": noise.rate, "axes": axes, "warnings": noise.warnings})
    for warning in noise.warnings:
        _say(f"warning: {warning}")
    if not options.quiet:
        for name, (value, about) in found.items():
            _say(f"{name}: {value:.3g} ({about})")
        _say(f"written: {options.out}, {plot}")
    return 0


def _write_json(options: argparse.Namespace, content: object) -> None:
    if options.json == "-":
        print(json.dumps(content, indent=2))
    elif options.json:
        Path(options.json).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _say(text: str) -> None:
    print(f"eskf_calibrate: {text}", file=sys.stderr, flush=True)


def _mistake(text: str) -> int:
    _say(f"error: {text}")
    return 2


if __name__ == "__main__":
    sys.exit(main())
