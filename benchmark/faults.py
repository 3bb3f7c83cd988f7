"""Faults that the model does not know, one by one: is the filter lost, does it lie, and what does it say?

    python benchmark/faults.py [--seeds 20] [--only WORD] [--amplitude 1] [--jobs 2] [--quick] [--out docs/trust.md]
        [--generator independent]

Every fault (`campaign/`) is an episode of the simulation (`eskf_simulate --episode`) or a wrong parameter, on city
drives of 286 s, and faults of sensors with the default noise on a field robot, a boat and a multirotor, too. "told":
the noise parameters are those of the IMU; "default": the defaults; GNSS positions alone or with velocities, at 5 Hz.
Beside each row stands the same filter with all innovation gates open, which therefore never resets nor
restarts.

Worst: largest horizontal error since the fault began, median and largest of the runs. Lost: horizontal error above
max(10 m, 5 sigma) while usable fixes come, later than 15 s after the fault has ended, or while it lasts if it does not
end. Lie: an error of position or heading above 5 sigma, from 60 s after the fault has begun on (120 s where a setting,
a scale or a noise is wrong), or from 15 s after its end. Headings lost: known to 30 deg, then unknown. Heading known:
from the first motion on (s, median / all). False rests: seconds in which rest was taken for granted in motion. Named:
runs in which the right cause was named; wrong: runs in which a cause was named that is none (`campaign/causes.py`).
Bars missed: number of the bar, and the figure that misses it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

from rich.progress import track

from campaign.document import replace_section
from campaign.fault import DEFAULT_POSITION, TOLD_VELOCITY, VEHICLES, Fault, Kind, with_vehicles
from campaign.imu_faults import ROUGH, imu_faults
from campaign.independent import FOLDER, has_drive
from campaign.judge import HEADINGS, Figures, Row, figures_of, summary
from campaign.motion_faults import motion_faults
from campaign.receiver_faults import receiver_faults
from campaign.running import messages_with_heading, recording_of, run_one
from campaign.settings_faults import settings_faults
from markdown_table import table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))

from support.data import find_data_folder

QUICK_FILTERS = (TOLD_VELOCITY, DEFAULT_POSITION)
QUICK_SEEDS = 3


def all_faults(amplitude: float = 1.0) -> list[Fault]:
    """Return the whole list, the sizes of the faults times ``amplitude``."""
    return with_vehicles(
        [
            Fault("clean", Kind.CLEAN, vehicles=VEHICLES),
            Fault("clean, rough road", Kind.CLEAN, options=ROUGH),
            *imu_faults(amplitude),
            *settings_faults(amplitude),
            *receiver_faults(amplitude),
            *motion_faults(),
        ]
    )


def runs_of(task: tuple[Fault, int, Path | None]) -> list[tuple[Figures, Figures]]:
    """Run one fault with one seed; return, by filter, the figures with and without gates."""
    fault, seed, drives = task
    recording = recording_of(fault, seed, drives)
    messages = messages_with_heading(recording)

    def figures(k: int, has_gates: bool) -> Figures:
        return figures_of(fault, run_one(fault, recording, fault.filters[k], has_gates, messages))

    return [(figures(k, True), figures(k, False)) for k in range(len(fault.filters))]


def rows_of(faults: Sequence[Fault], seeds: int, jobs: int, drives: Path | None = None) -> Iterator[Row]:
    """Run faults on a pool of processes; yield a row for each fault and filter, in their order."""
    tasks = [(fault, seed, drives) for fault in faults for seed in range(max(seeds, fault.seeds))]
    with ProcessPoolExecutor(jobs) as pool:
        found = iter(track(pool.map(runs_of, tasks), "runs", len(tasks)))
        for fault in faults:
            runs = [next(found) for _ in range(max(seeds, fault.seeds))]
            for k, given in enumerate(fault.filters):
                yield Row(fault, given, [run[k][0] for run in runs], [run[k][1] for run in runs])


def quick(fault: Fault) -> Fault:
    """The same fault with two of the filters at most, and few seeds."""
    if len(fault.filters) <= len(QUICK_FILTERS):
        return replace(fault, seeds=0)
    filters = tuple(given for given in fault.filters if given in QUICK_FILTERS)
    return replace(fault, filters=filters or fault.filters[:1], seeds=0)


def main() -> int:
    """Run the campaign; print the table, and write it where asked. Exit code 0, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--only", default="", metavar="WORD", help="faults with this word in their name or kind")
    parser.add_argument("--amplitude", type=float, default=1.0, metavar="FACTOR", help="size of the faults (default 1)")
    parser.add_argument(
        "--generator",
        choices=("own", "independent"),
        default="own",
        help="independent: the faults on drives of another generator, where their files are",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_SEEDS} seeds, two filters, city drives only")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the table to this document")
    options = parser.parse_args()
    chosen = [f for f in all_faults(options.amplitude) if options.only in f.name or options.only == f.kind.value]
    seeds = options.seeds
    if options.quick:
        seeds, chosen = QUICK_SEEDS, [quick(fault) for fault in chosen if not fault.is_version]
    drives = None
    if options.generator == "independent":
        try:
            drives = find_data_folder(FOLDER)
        except FileNotFoundError as problem:
            print(f"skipped: {problem}")
            return 0
        chosen = [fault for fault in chosen if has_drive(fault)]
    try:
        rows = list(rows_of(chosen, seeds, options.jobs, drives))
    except KeyboardInterrupt:
        return 130
    text = table(HEADINGS, [row.cells() for row in rows])
    bars = table(("bar", "rows ok", "rows"), summary(rows))
    print(text, bars, sep="\n")
    if options.out is not None:
        how = " --quick" * options.quick + f" --generator {options.generator}" * (drives is not None)
        lead = (
            f"Written by `python benchmark/faults.py{how} --out {options.out}`, {seeds} seeds a row; its first lines "
            "say how the columns are counted.\n\n"
        )
        replace_section(options.out, "Bars", lead + bars)
        replace_section(options.out, "Faults", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
