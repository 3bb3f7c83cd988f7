"""What satellites cost: one epoch of 50, an ephemeris, a point solution, reading RINEX files.

    python benchmark/satellites.py [--runs 300] [--nav FILE] [--obs FILE]

The satellites are invented, 54 of four constellations with five issues each; ``--nav`` and ``--obs`` add real files to
read. Times are those of the fastest run: other work on the machine is not ours.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "test"))

from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.orbits import satellite_state
from eskf_ros.gnss.point_solution import solve
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, Status, allocate_ranges, locate
from eskf_ros.gnss.rinex_nav import read_navigation
from eskf_ros.gnss.rinex_obs import read_observations
from eskf_ros.gnss.signals import SIGNAL_BY_CODE, Gnss
from support.gnss_sky import KLOBUCHAR, SECONDS, WEEK, all_constellations, measure, receiver_at

SYSTEMS = (Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.GLONASS)
CODES = {Gnss.GPS: "1C", Gnss.GALILEO: "1C", Gnss.BEIDOU: "2I", Gnss.GLONASS: "1C"}


def fastest(action: Callable[[], object], runs: int) -> float:
    """Seconds of the fastest of ``runs`` calls, after one that compiles."""
    action()
    times = []
    for _ in range(runs):
        begin = time.perf_counter()
        action()
        times.append(time.perf_counter() - begin)
    return min(times)


def issues(records: NDArray[np.void]) -> Ephemerides:
    """Each ephemeris with four older ones, as after some hours of reception."""
    copies = []
    for hours in range(5):
        copy = records.copy()
        copy["toe"] -= 3600.0 * hours
        copy["issue"] += hours
        copies.append(copy)
    return Ephemerides(np.concatenate(copies))


def fifty(store: Ephemerides) -> NDArray[np.void]:
    """A range of each of 50 satellites, wherever they are."""
    satellites = sorted({(int(row["gnss_id"]), int(row["sv_id"])) for row in store.records})[:: len(store) // 250]
    ranges = allocate_ranges(50)
    for row, (gnss, sv_id) in zip(ranges, satellites):
        row["gnss_id"], row["sv_id"], row["signal"] = gnss, sv_id, SIGNAL_BY_CODE[Gnss(gnss), CODES[Gnss(gnss)]]
    ranges["pseudorange"], ranges["doppler"], ranges["flags"] = 2.3e7, 0.0, CODE_VALID | DOPPLER_VALID
    return ranges


def report(what: str, seconds: float) -> None:
    print(f"{what:56} {1e6 * seconds:10.2f} us")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--nav", type=Path, help="RINEX navigation file to read as well")
    parser.add_argument("--obs", type=Path, help="RINEX observation file to read as well")
    arguments = parser.parse_args()
    store = issues(all_constellations().records)
    blank = fifty(store)
    ranges = blank.copy()

    def epoch() -> None:
        ranges[:] = blank
        locate(ranges, WEEK, SECONDS, store)

    report(f"epoch of 50 satellites, chosen from {len(store)} ephemerides", fastest(epoch, arguments.runs))
    assert (ranges["status"] == Status.USABLE).all()
    for gnss in (Gnss.GPS, Gnss.GLONASS):
        record = store.of(gnss, 3)[-1]
        report(
            f"one {gnss.name} satellite, called from Python",
            fastest(
                lambda record=record: satellite_state(record, WEEK, SECONDS + 800.0),
                arguments.runs,  # type: ignore[misc]
            ),
        )
    receiver = receiver_at(48.1, 11.6, 565.0, clock_bias=1e4)
    seen = measure(receiver, all_constellations(), SYSTEMS, np.random.default_rng(1))
    what = f"point solution of {len(seen)} ranges"
    report(f"{what}, from nowhere", fastest(lambda: solve(seen, WEEK, SECONDS, KLOBUCHAR), arguments.runs))
    near = receiver.position
    report(f"{what}, near", fastest(lambda: solve(seen, WEEK, SECONDS, KLOBUCHAR, initial=near), arguments.runs))
    for path, read in ((arguments.nav, read_navigation), (arguments.obs, read_observations)):
        if path is not None:
            size = path.stat().st_size / 1e6
            report(f"reading {path.name} ({size:.1f} MB)", fastest(lambda p=path, r=read: r(p), 3))  # type: ignore[misc]


if __name__ == "__main__":
    main()
