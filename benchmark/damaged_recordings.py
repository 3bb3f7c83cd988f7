"""Damaged recordings through `eskf_replay`: is the damage said, is the rest used, and does nothing else happen?

    python benchmark/damaged_recordings.py [--count 10000] [--seed 0] [--jobs 2]

A drive of five seconds in every kind of file that is read (mcap with each compression, without checksums, index or
chunks; sqlite3; rosbag2 directories) is damaged in a way that its seed tells (`test/support/damage.py`), and replayed
by the command in a process of its own. A failure is

- traceback: an exception, death by a signal, an exit code other than 0 and 2, or a line that is not the command's own;
- hang: more than TIME_LIMIT of processor time, or WAIT_LIMIT of wall time;
- memory: more than MEMORY_LIMIT on top of what the process began with;
- silence: messages of a topic in use are missing and no line names the recording or the topic, or an error is not one
  line. Where the same messages are there under another name for the topic, that is other content.

Prints a table of outcomes by kind of file and by damage and the seeds of the failures; the exit code is 1 if there are
any. `--count 1 --seed N --keep DIR` leaves the recording of one seed in DIR.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import traceback
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.progress import track

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from eskf_ros.bags import open_bag  # noqa: E402
from eskf_ros.replay.main import main as eskf_replay  # noqa: E402
from markdown_table import table  # noqa: E402
from support.damage import Files, damaged, recordings, write  # noqa: E402

TIME_LIMIT = 10
"""s of processor time for one recording; a whole one takes 0.1 s."""
WAIT_LIMIT = 120
"""s of wall time; on a busy machine processor time says more."""
MEMORY_LIMIT = 256 << 20
"""bytes of resident memory."""
ADDRESS_LIMIT = 4 << 30
"""bytes of addresses beyond those at the start: a machine is not brought down by what is looked for here."""
TIGHT_SHARE = 4
"""One seed in so many is replayed in mode tight: point clouds."""

HARMLESS = ("unharmed", "said, rest used", "said, not readable", "other content")
FAILURES = ("traceback", "hang", "memory", "silence")
OUTCOMES = (*HARMLESS, *FAILURES)


@dataclass(frozen=True)
class Replayed:
    """What the command did: exit code, lines on stderr, messages offered by input, the last odometry.

    ``counts``: the numbers of messages of all topics, whatever their names.
    """

    code: int
    lines: tuple[str, ...]
    offered: dict[str, int]
    final: Any
    counts: tuple[int, ...] = ()


def replay(recording: Path, out: Path, mode: str) -> Replayed:
    """Run the command in this process."""
    stderr = io.StringIO()
    with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
        code = eskf_replay([str(recording), "--out", str(out), "--mode", mode, "--quiet"])
    summaries = [json.loads(file.read_text()) for file in sorted(out.glob("*_eskf/summary.json"))]
    offered: Counter[str] = Counter()  # A folder of .mcap files is a fleet: of all its recordings.
    for summary in summaries:
        offered["imu"] += summary["imu_count"]
        # Of ranges the messages are counted, not their signals.
        for name, aid in summary["aids"].items():
            offered[name] += int(aid["offered"]) if aid["withheld"] is not None else 0
        offered["ranges"] += summary["ranges"]["epochs"] if "ranges" in summary else 0
    lines = tuple(line for line in stderr.getvalue().splitlines() if ": compiling " not in line)
    counts: tuple[int, ...] = ()
    if code == 0:
        with open_bag([recording]) as reader:
            counts = tuple(sorted(info.count for info in reader.topics.values()))
    return Replayed(code, lines, dict(offered), [summary["final"] for summary in summaries], counts)


def replay_apart(files: Files, mode: str, keep: Path | None = None) -> tuple[str, Any]:
    """Replay in a process of its own; returns ("", Replayed), or the kind of failure and what is known of it."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as place:
        folder, out, said = Path(place) / "recording", Path(place) / "out", Path(place) / "said"
        folder.mkdir()
        recording = write(files, folder)
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            write(files, keep)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        child = os.fork()
        if child == 0:
            os._exit(_child(recording, out, mode, said))
        _, status, usage = os.wait4(child, 0)
        text = said.read_text() if said.exists() else ""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return (
            ("hang", "") if number in (signal.SIGALRM, signal.SIGXCPU) else ("traceback", signal.Signals(number).name)
        )
    if os.WEXITSTATUS(status):
        return "traceback", text
    growth = usage.ru_maxrss * 1024 - before
    if growth > MEMORY_LIMIT:
        return "memory", f"{growth >> 20} MB"
    result = json.loads(text)
    # The name of the folder differs from run to run.
    lines = tuple(line.replace(str(folder), "RECORDING") for line in result["lines"])
    return "", Replayed(**{**result, "lines": lines, "counts": tuple(result["counts"])})


def _child(recording: Path, out: Path, mode: str, said: Path) -> int:
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(WAIT_LIMIT)
    resource.setrlimit(resource.RLIMIT_CPU, (TIME_LIMIT, TIME_LIMIT + 1))
    pages = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (pages + ADDRESS_LIMIT, pages + ADDRESS_LIMIT))
    try:
        done = replay(recording, out, mode)
        said.write_text(json.dumps(vars(done)))
    except BaseException:
        said.write_text(traceback.format_exc())
        return 1
    return 0


def judged(done: Replayed, whole: Replayed) -> tuple[str, str]:
    """The outcome of a replay that ended, against that of the whole recording."""
    new = [line for line in done.lines if line not in whole.lines]
    named = [line for line in new if "RECORDING" in line]
    if done.code == 2:
        is_one_line = len(new) == 1 and new[0].startswith("eskf_replay: error: ") and bool(named)
        return ("said, not readable", new[0]) if is_one_line else ("silence", str(done.lines))
    strange = [line for line in done.lines if not line.startswith("eskf_replay: warning: ")]
    if done.code or strange:
        return "traceback", f"exit code {done.code}: {done.lines}"
    missing = {name: count - done.offered.get(name, 0) for name, count in whole.offered.items()}
    missing = {name: count for name, count in missing.items() if count > 0}
    if done.counts == whole.counts and not new:
        missing = {}  # a topic that is all there under another name: nobody can tell
    if missing and not named and not any(name in line for line in new for name in missing):
        return "silence", f"missing: {missing}; said: {new}"
    if new:
        return "said, rest used", "; ".join(new)
    if done.offered == whole.offered and done.final == whole.final:
        return "unharmed", ""
    return "other content", f"{done.offered} of {whole.offered}"


def mode_of(seed: int) -> str:
    """The mode that a seed is replayed in."""
    return "tight" if seed % TIGHT_SHARE == 0 else "loose"


def run(
    whole: dict[tuple[str, str], Replayed], sound: dict[str, Files], keep: Path | None, seed: int
) -> tuple[int, str, str, str, str]:
    """Damage and replay one recording; returns seed, kind of file, damage, outcome, details."""
    kind, damage, files = damaged(sound, seed)
    failure, done = replay_apart(files, mode_of(seed), keep)
    outcome, details = (failure, done) if failure else judged(done, whole[kind, mode_of(seed)])
    return seed, kind, damage, outcome, details


def whole_results(sound: dict[str, Files]) -> dict[tuple[str, str], Replayed]:
    """Replay the recordings without damage; the first one in this process, so that its children find all compiled.

    Raises RuntimeError if one fails.
    """
    results = {}
    with tempfile.TemporaryDirectory() as place:
        for mode in ("loose", "tight"):
            replay(write(sound["db3 compressed messages"], Path(place)), Path(place) / mode, mode)
    for kind, files in sound.items():
        for mode in ("loose", "tight"):
            failure, done = replay_apart(files, mode)
            if failure or done.code:
                raise RuntimeError(f"{kind}, mode {mode}, without damage: {failure} {done}")
            results[kind, mode] = done
    return results


def summary(runs: list[tuple[int, str, str, str, str]]) -> str:
    """The tables of outcomes, in Markdown."""
    parts = []
    for heading, place in (("kind of file", 1), ("damage", 2)):
        counts = Counter((run[place], run[3]) for run in runs)
        rows = [[name, *(counts[name, outcome] for outcome in OUTCOMES)] for name in sorted({r[place] for r in runs})]
        rows.append(["all", *(sum(row[column] for row in rows) for column in range(1, len(OUTCOMES) + 1))])
        parts.append(table([heading, *OUTCOMES], [[str(cell) for cell in row] for row in rows]))
    return "\n".join(parts)


def main() -> int:
    """Run the campaign; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave the recording here (with --count 1)")
    parser.add_argument("--verbose", action="store_true", help="print every run")
    options = parser.parse_args()
    sound = recordings()
    whole = whole_results(sound)
    seeds = range(options.seed, options.seed + options.count)
    with multiprocessing.get_context("fork").Pool(options.jobs) as pool:
        results = pool.imap_unordered(partial(run, whole, sound, options.keep), seeds, chunksize=8)
        runs = sorted(track(results, "damaged recordings", options.count))
    print(summary(runs))
    failures = [run for run in runs if run[3] in FAILURES]
    for seed, kind, damage, outcome, details in runs if options.verbose else failures:
        print(f"seed {seed}: {kind}, {damage}: {outcome}: {details}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
