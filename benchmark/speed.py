"""The speed of the estimator per IMU sample and per late fix; that of eskf_replay for an hour, by stage, with memory.

    python benchmark/speed.py [--runs 3]

The recording is the simulator's hour_drive: 200 Hz IMU, 5 Hz fixes and velocities, mcap with zstd; it is made once and
kept in the folder for temporary files. Its first ten minutes show whether memory grows with the length. Every run is a
process of its own, measured from outside, after one that compiles what is not compiled yet.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from eskf_ros.bags import BagWriter, open_bag
from eskf_ros.bags.mcap_file import McapFile
from eskf_ros.simulate.main import main as simulate
from estimator_speed import measure as measure_estimator

CHECKOUT = Path(__file__).resolve().parent.parent
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
TYPES = {
    "imu/data": "sensor_msgs/msg/Imu",
    "gps/fix": "sensor_msgs/msg/NavSatFix",
    "gps/vel": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
TARGET = 3.0
"""Seconds for the hour."""
RUN = """
import json, re, sys, time
from eskf_ros.replay.main import main
if main(sys.argv[1:]):
    sys.exit(1)
peak = re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())
print(json.dumps({"processor": time.process_time(), "megabytes": int(peak[1]) / 1024.0}))
"""
"""What a run does: the command, then its processor time and its peak memory (Linux)."""
ROWS = (
    ("start", "python, imports, opening the recording"),
    ("decompress", "reading and decompressing alone, a part of read"),
    ("read", "reading, decompressing, decoding"),
    ("filter", "the estimator and what hands it the messages"),
    ("compare", "summary"),
    ("write", "formatting, compressing and writing, in a thread beside the others"),
    ("wait", "waiting for that"),
    ("total", "the whole process"),
    ("processor", "processor time of all threads: what the total would be on one idle core"),
    ("megabytes", "peak memory, MB"),
)


def recordings(folder: Path) -> dict[str, Path]:
    """The hour and its first ten minutes."""
    hour, ten_minutes = folder / "hour_drive.mcap", folder / "ten_minutes.mcap"
    if not hour.exists():
        print("simulating an hour ...")
        simulate(["hour_drive", "--truth-rate", "1", "--out", str(hour), "--quiet"])
    if not ten_minutes.exists():
        with open_bag([hour]) as reader, BagWriter(ten_minutes) as writer:
            handles = {topic: writer.add_topic(topic, type_name) for topic, type_name in TYPES.items()}
            end = reader.start_time + 600 * 10**9
            for batch in reader.batches(TYPES):
                for topic, part in batch.items():
                    inside = part.log_time < end
                    writer.write(handles[topic], part.log_time[inside], part.messages[inside], part.strings)
    return {"10 min": ten_minutes, "1 h": hour}


def measure(bag: Path, out: Path) -> dict[str, float]:
    """Seconds of each stage and peak memory of one run."""
    command = [sys.executable, "-c", RUN, str(bag), "--config", str(CONFIG), "--quiet", "--out", str(out)]
    began = time.perf_counter()
    finished = subprocess.run(command, cwd=CHECKOUT, stdout=subprocess.PIPE, text=True, check=True)
    total = time.perf_counter() - began
    summary: dict[str, Any] = json.loads((out / f"{bag.stem}_eskf" / "summary.json").read_text())
    figures: dict[str, float] = dict(summary["timing"])
    figures["start"] += total - figures["total"]
    figures["total"] = total
    figures |= json.loads(finished.stdout)

    began = time.perf_counter()
    for block in McapFile(bag).blocks(TYPES):
        block.load()
    figures["decompress"] = time.perf_counter() - began
    return figures


def main() -> int:
    """Measure and print the table; returns 1 if the hour takes longer than it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="the fastest of so many runs is shown (default 3)")
    runs = parser.parse_args().runs
    estimator = Table("estimator", "best", "target")
    for row in measure_estimator():
        estimator.add_row(*row)
    Console().print(estimator)
    cache = Path(tempfile.gettempdir()) / "eskf_ros_benchmark"
    cache.mkdir(exist_ok=True)
    bags = recordings(cache)
    with tempfile.TemporaryDirectory() as out:
        measure(bags["10 min"], Path(out))
        figures = {name: [measure(bag, Path(out)) for _ in range(runs)] for name, bag in bags.items()}
    fastest = {name: min(found, key=lambda run: run["total"]) for name, found in figures.items()}
    table = Table("s", *bags, "what")
    for key, text in ROWS:
        table.add_row(
            key,
            *(f"{found[key]:.0f}" if key == "megabytes" else f"{found[key]:.2f}" for found in fastest.values()),
            text,
        )
    Console().print(table)
    total = fastest["1 h"]["total"]
    print(f"one hour in {total:.2f} s; the target is {TARGET:g} s")
    return 0 if total <= TARGET else 1


if __name__ == "__main__":
    sys.exit(main())
