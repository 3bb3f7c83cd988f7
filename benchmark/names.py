"""What the filter says: does it name what is wrong, does it blame what is not, and does its advice help?

    python benchmark/names.py [--seeds 20] [--hours 10] [--only WORD] [--jobs 2] [--out docs/trust.md]

Power: of the faults that have a name (`campaign/`), the share of runs in which the right cause is named, the time from
the beginning of the fault to the name (median and longest, s), and the share of runs in which a cause is named that is
none. Advice: where a sentence says what to set ("set NAME to VALUE", a lever arm that is off), it is set, and the same
drive runs again; the error is the horizontal rms from 60 s on (m, median before and after), and "better" the share of
runs in which it falls, or stays within a hundredth. False alarms: sentences per hour on clean city drives of an hour,
on a smooth and on a rough road.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.progress import track

from campaign.advice import advice_of
from campaign.document import replace_section
from campaign.fault import DEFAULT_POSITION, DEFAULT_VELOCITY, TOLD_VELOCITY, Fault, Filter, Kind
from campaign.imu_faults import ROUGH
from campaign.judge import figures_of, mean
from campaign.running import Trace, messages_with_heading, parameters_of, recording_of, run_one
from faults import all_faults
from markdown_table import table

FILTERS = (TOLD_VELOCITY, DEFAULT_VELOCITY, DEFAULT_POSITION)
SETTLED = 60.0
"""s from which on errors count."""
HOUR = 3600.0


@dataclass(frozen=True)
class Named:
    """One run: time to the right name (s, infinite without), wrong sentences, rms before and after the advice (m)."""

    after: float
    wrong: tuple[str, ...]
    advised: tuple[str, ...]
    before: float
    followed: float


def rms(trace: Trace) -> float:
    """Return the horizontal rms (m) from `SETTLED` on."""
    return float(np.sqrt(np.mean(trace.error[trace.seconds >= SETTLED] ** 2)))


def follow(fault: Fault, seed: int, given: Filter) -> Named:
    """Run a fault, do what is advised, and run it again."""
    recording = recording_of(fault, seed)
    messages = messages_with_heading(recording)
    trace = run_one(fault, recording, given, True, messages)
    figures = figures_of(fault, trace)
    advice = advice_of(trace.final, parameters_of(fault, recording, given.is_told))
    followed = math.nan
    if advice:
        # Numbers are set as they are: three of them are no change of the true ones.
        again = replace(fault, parameters={**fault.parameters, **advice})
        try:
            followed = rms(run_one(again, recording, given, True, messages))
        except ValueError:
            followed = math.inf  # The parameter does not take the value that is advised.
    return Named(figures.named_after, figures.wrong, tuple(advice), rms(trace), followed)


def follow_task(task: tuple[Fault, int, Filter]) -> Named:
    """`follow`, for a pool."""
    return follow(*task)


def alarms(task: tuple[int, bool, Filter]) -> Counter[str]:
    """Return the sentences of one clean hour, each once."""
    seed, is_rough, given = task
    fault = Fault("clean", Kind.CLEAN, scenario="hour_drive", stop=HOUR, options=ROUGH if is_rough else {})
    return Counter(run_one(fault, recording_of(fault, seed), given).said.keys())


def power_row(fault: Fault, given: Filter, runs: list[Named]) -> list[str]:
    """One row of the table of power and advice."""
    times = [run.after for run in runs if math.isfinite(run.after)]
    advised = [run for run in runs if run.advised]
    better = mean([float(run.followed <= 1.01 * run.before) for run in advised])
    wrong = Counter(sentence for run in runs for sentence in set(run.wrong))
    return [
        fault.name,
        str(given),
        f"{100.0 * len(times) / len(runs):.0f}",
        f"{np.median(times):.0f} / {max(times):.0f}" if times else "-",
        f"{100.0 * mean([float(bool(run.wrong)) for run in runs]):.0f}",
        ", ".join(sorted({name for run in advised for name in run.advised})) or "-",
        f"{np.median([run.before for run in advised]):.2f} / {np.median([run.followed for run in advised]):.2f}"
        if advised
        else "-",
        f"{100.0 * better:.0f} of {len(advised)}" if advised else "-",
        wrong.most_common(1)[0][0][:60].replace("|", "/") if wrong else "",
    ]


POWER_HEADINGS = (
    "fault",
    "filter",
    "named %",
    "after s (median / all)",
    "wrong %",
    "advised",
    "rms m before / after",
    "better %",
    "wrong most",
)


def main() -> int:
    """Run the campaign; print the tables, and write them where asked. Exit code 0, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--hours", type=int, default=10, help="clean hours, of each kind of road and filter")
    parser.add_argument("--only", default="", metavar="WORD", help="faults with this word in their name")
    parser.add_argument("--amplitude", type=float, default=1.0, metavar="FACTOR", help="size of the faults (default 1)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the tables into this document")
    options = parser.parse_args()
    pairs = [
        (fault, given)
        for fault in all_faults(options.amplitude)
        if fault.names and not fault.is_version and options.only in fault.name
        for given in fault.filters
        if given in FILTERS
    ]
    tasks = [(fault, seed, given) for fault, given in pairs for seed in range(options.seeds)]
    clean = [(is_rough, given) for is_rough in (False, True) for given in FILTERS]
    hours = [(seed, is_rough, given) for is_rough, given in clean for seed in range(options.hours)]
    try:
        with ProcessPoolExecutor(options.jobs) as pool:
            named = list(track(pool.map(follow_task, tasks), "faults", len(tasks)))
            heard = list(track(pool.map(alarms, hours), "clean hours", len(hours)))
    except KeyboardInterrupt:
        return 130
    count = options.seeds
    rows = [power_row(*pair, named[k * count : (k + 1) * count]) for k, pair in enumerate(pairs)]
    alarm_rows = []
    for k, (is_rough, given) in enumerate(clean):
        sentences = sum(heard[k * options.hours : (k + 1) * options.hours], Counter[str]())
        rate = sentences.total() / max(options.hours, 1)
        what = "; ".join(f"{text[:60]} ({times})" for text, times in sentences.most_common(3))
        alarm_rows.append(["rough" if is_rough else "smooth", str(given), str(options.hours), f"{rate:.2f}", what])
    text = table(POWER_HEADINGS, rows)
    if options.hours:
        text += "\n" + table(("road", "filter", "hours", "alarms per hour", "which (hours)"), alarm_rows)
    print(text)
    if options.out is not None:
        lead = f"Written by `python benchmark/names.py --out docs/trust.md`, {options.seeds} seeds a row.\n\n"
        replace_section(options.out, "Names", lead + text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
