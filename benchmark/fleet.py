"""Fleets: two processes against one, memory over a thousand recordings, and by simulation what 64 workers would give.

    python benchmark/fleet.py [--short 1000] [--copies 40] [--parts speed,memory,scaling]

The recordings are links to the bundled drive (221 s), and to its first 20 s for the thousand. Processor time is that of
the command and all its workers; it says on a busy machine, too, what the wall time of idle cores would be.

The simulation takes measured figures: the time of each recording, the start of a worker, and the time that the command
itself spends on a recording, during which no other is handed out. Workers take the largest recording that is left.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from eskf_ros.bags import BagWriter, open_bag
from eskf_ros.fleet.processes import on_processes
from eskf_ros.fleet.run import run_fleet
from eskf_ros.fleet.task import Job, Progress, Task
from markdown_table import table

CHECKOUT = Path(__file__).resolve().parent.parent
BAG = CHECKOUT / "bags" / "tunnel_drive.mcap"
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
TYPES = {
    "imu/data": "sensor_msgs/msg/Imu",
    "gps/fix": "sensor_msgs/msg/NavSatFix",
    "gps/vel": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
RUN = """
import json, resource, sys
from eskf_ros.replay.main import main
code = main(sys.argv[1:])
own, workers = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
print(json.dumps({"code": code, "command_mb": own.ru_maxrss / 1024, "command_s": own.ru_utime + own.ru_stime,
                  "workers_s": workers.ru_utime + workers.ru_stime}))
"""
WORKERS = (1, 2, 4, 8, 16, 32, 64)


@dataclass(frozen=True)
class Costs:
    """Seconds.

    Work of each recording; of a worker its start and its first loading of machine code; of the command, what it needs
    for a recording.
    """

    work: tuple[float, ...]
    start: float
    load: float
    command: float


def links(folder: Path, bag: Path, count: int) -> Path:
    """A folder with `count` links to a recording."""
    folder.mkdir()
    for number in range(count):
        (folder / f"{number:04d}.mcap").symlink_to(bag)
    return folder


def replay(folder: Path, jobs: int) -> dict[str, Any]:
    """Replay a folder with a new command; its figures and the content of fleet.json."""
    command = [sys.executable, "-c", RUN, str(folder), "--config", str(CONFIG), "--jobs", str(jobs), "--quiet"]
    began = time.perf_counter()
    done = subprocess.run([*command, "--again"], cwd=CHECKOUT, stdout=subprocess.PIPE, text=True, check=True)
    figures: dict[str, Any] = json.loads(done.stdout)
    assert figures["code"] == 0
    return figures | {"wall_s": time.perf_counter() - began, "fleet": json.loads((folder / "fleet.json").read_text())}


def speed(folder: Path, count: int) -> tuple[str, tuple[float, ...]]:
    """Table of one and of two processes, and the seconds of each recording."""
    fleet = links(folder / "copies", BAG, count)
    runs = {jobs: replay(fleet, jobs) for jobs in (1, 2)}
    rows = []
    for jobs, run in runs.items():
        processor = run["command_s"] + run["workers_s"]
        rows.append([str(jobs), f"{run['wall_s']:.1f}", f"{processor:.1f}", f"{processor / run['wall_s']:.2f}"])
    processor = [run["command_s"] + run["workers_s"] for run in runs.values()]
    text = table(("processes", "wall, s", "processor time, s", "cores kept busy"), rows)
    text += f"\nLoad of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores. "
    text += f"Wall time {runs[1]['wall_s'] / runs[2]['wall_s']:.2f} times as fast with two; "
    text += f"processor time {processor[0] / processor[1]:.3f} of one to two.\n"
    start = sum(start_costs())
    share = (processor[0] - start) / count  # Processor time: the wall time of a busy machine is not ours alone.
    return text, (share,) * count


def short_recording(folder: Path, seconds: float) -> Path:
    """The first seconds of the bundled drive."""
    short = folder / "short.mcap"
    with open_bag([BAG]) as reader, BagWriter(short) as writer:
        handles = {topic: writer.add_topic(topic, type_name) for topic, type_name in TYPES.items()}
        end = reader.start_time + round(seconds * 1e9)
        for batch in reader.batches(TYPES):
            for topic, part in batch.items():
                inside = part.log_time < end
                writer.write(handles[topic], part.log_time[inside], part.messages[inside], part.strings)
    return short


def memory(folder: Path, count: int) -> str:
    """Table of peak memory of the command and its two workers, by number of recordings."""
    short = short_recording(folder, 20.0)
    rows = []
    for number in (count // 10, count):
        run = replay(links(folder / f"short_{number}", short, number), 2)
        peaks = [entry["peak_mb"] for entry in run["fleet"]["recordings"]]
        counts = run["fleet"]["counts"]
        rows.append(
            [
                f"{counts['done']} of {number}",
                f"{run['command_mb']:.0f}",
                f"{np.percentile(peaks, 10):.0f}",
                f"{max(peaks):.0f}",
            ]
        )
    headings = ("recordings done", "command, MB", "workers after a tenth, MB", "workers at the end, MB")
    return table(headings, rows)


def no_work(task: Task, progress: Progress) -> dict[str, Any]:
    """Write the result only."""
    content = {"fingerprint": dict(task.fingerprint)}
    task.result.write_text(json.dumps(content))
    return content


def no_figures(content: Mapping[str, Any]) -> dict[str, Any]:
    """Nothing to tell, in the size of what a replay tells."""
    return {f"figure_{number}": 1.0 / 3.0 for number in range(15)}


def no_badness(figures: Mapping[str, Any]) -> tuple[float, ...]:
    """All are alike."""
    return (0.0,)


def command_cost(folder: Path, count: int = 2000) -> float:
    """Processor seconds that the command itself spends on a recording, fleet.json included."""
    job = Job("nothing", no_work, no_figures, no_badness, ())
    tasks = [Task(f"{number}", folder, folder / f"{number}.json", {"recording": "x"}) for number in range(count)]
    run_fleet(job, tasks[:1], on_processes(1), folder / "fleet.json", again=True)
    began = time.process_time()
    run_fleet(job, tasks, on_processes(1), folder / "fleet.json", again=True)
    return (time.process_time() - began) / count


def start_costs() -> tuple[float, float]:
    """Processor seconds of a worker: Python and imports, and then the machine code of its first recording."""
    imports = "import eskf_ros.replay.fleet, eskf_ros.filter.warm_up as warm_up"
    both = f"{imports}; warm_up.compile_kernels()"
    # The least of three: another version at work here may have pushed ours out of the cache of machine code.
    first, whole = (min(_processor_seconds(program) for _ in range(3)) for program in (imports, both))
    return first, whole - first


def _processor_seconds(program: str) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", program], check=True, cwd=CHECKOUT)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def simulated(costs: Costs, workers: int) -> float:
    """Seconds until the last of the recordings is done.

    All workers start at once; the first loads machine code alone, the others when it has begun. The command serves one
    worker at a time.
    """
    begun = costs.start + costs.load
    free = [(begun if number == 0 else begun + costs.load, number) for number in range(workers)]
    heapq.heapify(free)
    command_free = end = 0.0
    for seconds in sorted(costs.work, reverse=True):
        ready, number = heapq.heappop(free)
        command_free = max(ready, command_free) + costs.command
        done = command_free + seconds
        end = max(end, done)
        heapq.heappush(free, (done, number))
    return end


def bottleneck(costs: Costs, workers: int) -> str:
    """What costs most of the time that an even share of the work does not explain."""
    now = simulated(costs, workers)
    gains = {
        "start of the workers": now - simulated(replace(costs, start=0.0, load=0.0), workers),
        "the command": now - simulated(replace(costs, command=0.0), workers),
        "the longest recording": now - simulated(_cut(costs, workers), workers),
    }
    name, gain = max(gains.items(), key=lambda item: item[1])
    return f"{name} ({gain / now:.0%})" if gain > 0.01 * now else "none above 1 %"


def _cut(costs: Costs, workers: int) -> Costs:
    """The same work in many equal recordings."""
    count = max(len(costs.work), 100 * workers)
    return replace(costs, work=(sum(costs.work) / count,) * count, command=costs.command * len(costs.work) / count)


def scaling(fleets: Mapping[str, Costs]) -> str:
    """Table of the speed-up of several fleets by number of workers, each with its bottleneck at the largest."""
    rows = []
    for name, costs in fleets.items():
        alone = simulated(costs, 1)
        speeds = [f"{alone / simulated(costs, workers):.1f}" for workers in WORKERS]
        rows.append([name, *speeds, bottleneck(costs, WORKERS[-1])])
    return table(("fleet", *(str(workers) for workers in WORKERS), f"bottleneck at {WORKERS[-1]}"), rows)


def fleets_of(start: float, load: float, command: float, per_second: float) -> dict[str, Costs]:
    """Fleets to simulate, with seconds of work per second of recording."""
    random = np.random.default_rng(1)
    mixed = np.clip(random.lognormal(np.log(600.0), 1.2, 1000), 10.0, 8 * 3600.0)
    lengths = {
        "40 of 221 s": np.full(40, 221.0),
        "40 of 10 min": np.full(40, 600.0),
        "1000 of 20 s": np.full(1000, 20.0),
        "1000 of 1 h": np.full(1000, 3600.0),
        "1000 mixed, 10 s to 8 h": mixed,
    }
    return {
        name: Costs(tuple((per_second * length).tolist()), start, load, command) for name, length in lengths.items()
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--copies", type=int, default=40, help="recordings for the speed (default 40)")
    parser.add_argument("--short", type=int, default=1000, help="recordings for the memory (default 1000)")
    parser.add_argument("--parts", default="speed,memory,scaling", help="what to measure (default: all)")
    options = parser.parse_args(arguments)
    parts = options.parts.split(",")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        replay(links(folder / "first", BAG, 2), 1)  # compiles
        if "speed" in parts or "scaling" in parts:
            text, work = speed(folder, options.copies)
            print(text)
        if "memory" in parts:
            print(memory(folder, options.short))
        if "scaling" in parts:
            (start, load), command = start_costs(), command_cost(folder)
            print(f"A worker starts in {start:.2f} s and loads machine code for {load:.2f} s; the command needs")
            print(f"{1e3 * command:.2f} ms for a recording,")
            print(f"a worker {1e3 * work[0] / 221.0:.2f} ms for a second of recording (processor time).\n")
            print(scaling(fleets_of(start, load, command, work[0] / 221.0)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
