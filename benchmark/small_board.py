"""What a small board needs: the first start, resident memory and the share of a core, on one core and in little memory.

    python benchmark/small_board.py [--memory 1536] [--seconds 30] [--out docs/small_boards.md]

Every run is a process of its own that may use one core and so much address space (MB, as `ulimit -v`). Its time is that
of the processor (user and system), so that another program on the machine changes little; its memory is the most that
was resident. The first starts have an empty cache. A row that does not run in this memory says so. Exit code 1: a bar
is missed, or a row failed. Without rclpy the rows of the node are left out.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from markdown_table import table

ROOT = Path(__file__).resolve().parents[1]
MARKERS = ("<!-- figures: written by benchmark/small_board.py -->\n", "<!-- end of figures -->\n")
COMPILE_BARS = {"loose": 60.0, "tight": 90.0}
"""Processor time (s) of the first start, by mode."""
IMU_RATE = 200.0
"""Hz, of the node's IMU."""
LIMITED = """
import os, resource, sys
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]) << 20,) * 2)
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
os.execv(sys.argv[2], sys.argv[2:])
"""
"""What a process is started through: memory (MB), command."""
COMPILE = """
import sys
from eskf_ros.parameters.tree import Parameters
from eskf_ros.ros_node.warm_up import compile_node
compile_node(Parameters(), with_ranges=sys.argv[1] == "tight")
"""
REPLAY = "import sys; from eskf_ros.replay.main import main; sys.exit(main(sys.argv[1:]))"
PEAK = """
import atexit, re
@atexit.register
def tell():
    print("PEAK", re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())[1])
"""
"""Begins each program: at its end it tells the most memory that was resident (kB)."""


@dataclass(frozen=True)
class Cost:
    """What a run took: processor time in s (NaN: not measured), resident memory at its most in MB."""

    processor: float
    megabytes: float


def limited(memory: int, *command: str) -> list[str]:
    """Return a command that runs on one core and in so much address space (MB)."""
    return [sys.executable, "-c", LIMITED, str(memory), *command]


def cost(memory: int, environment: Mapping[str, str], program: str, *arguments: str) -> Cost | None:
    """Run a program; None if it fails, its last words go to stderr."""
    command = limited(memory, sys.executable, "-c", PEAK + program, *arguments)
    with tempfile.TemporaryFile("w+") as output:
        child = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read()
    peak = re.search(r"^PEAK (\d+)$", text, re.MULTILINE)
    if child.returncode or peak is None:
        print(f"ended with {child.returncode} in {memory} MB:", *text.strip().splitlines()[-1:], file=sys.stderr)
        return None
    return Cost(usage.ru_utime + usage.ru_stime, int(peak[1]) / 1024.0)


def measure(memory: int, seconds: float) -> list[tuple[str, Cost | None, float]]:
    """Return the rows: what, its cost, and the bar of its processor time (s; infinite: none)."""
    rows: list[tuple[str, Cost | None, float]] = []
    bag, config = str(ROOT / "bags" / "tunnel_drive.mcap"), str(ROOT / "config" / "tunnel_drive.yaml")
    for mode, bar in COMPILE_BARS.items():
        with tempfile.TemporaryDirectory() as cache:
            environment = {**os.environ, "XDG_CACHE_HOME": cache, "PYTHONPATH": python_path()}
            environment.pop("NUMBA_CACHE_DIR", None)
            first = cost(memory, environment, COMPILE, mode)
            rows.append((f"first start, mode {mode}: compiling", first, bar))
            if mode == "tight" and first is not None:
                rows.append(("every later start", cost(memory, environment, COMPILE, mode), float("inf")))
                arguments = (bag, "--config", config, "--quiet", "--out", cache)
                cost(memory, environment, REPLAY, *arguments)
                replay = cost(memory, environment, REPLAY, *arguments)
                rows.append(("replay of the bundled recording (221 s, IMU at 200 Hz)", replay, float("inf")))
                if importlib.util.find_spec("rclpy"):
                    rows.append((f"node, IMU at {IMU_RATE:g} Hz", node(memory, seconds, environment), float("inf")))
    return rows


def python_path() -> str:
    """Return PYTHONPATH with the checkout first."""
    return os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])


def node(memory: int, seconds: float, environment: Mapping[str, str]) -> Cost | None:
    """Run the node against a sender at `IMU_RATE`; the processor time is that of one second."""
    import node_latency

    os.environ["XDG_CACHE_HOME"] = environment["XDG_CACHE_HOME"]
    try:
        found = node_latency.measure(IMU_RATE, seconds, False, limited(memory))
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return None
    return Cost(found["processor"] / 100.0, found["megabytes"])


def text_of(rows: list[tuple[str, Cost | None, float]], memory: int) -> str:
    """Return the table and what it was measured on."""
    lines = []
    for what, found, bar in rows:
        if found is None:
            lines.append([what, f"does not run in {memory} MB", "", ""])
            continue
        share = what.startswith("node")
        time = f"{100.0 * found.processor:.0f} % of a core" if share else f"{found.processor:.1f} s"
        lines.append([what, time, "" if bar == float("inf") else f"{bar:g} s", f"{found.megabytes:.0f} MB"])
    processor = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("numba", "numpy"))
    machine = f"{processor[1] if processor else platform.machine()}, Python {platform.python_version()}, {versions}"
    return (
        table(["", "processor time", "bar", "most memory resident"], lines)
        + f"\nOne core, address space limited to {memory} MB (`ulimit -v`). {machine}.\n"
    )


def main() -> int:
    """Measure, print and, with --out, write the table between its markers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--memory", type=int, default=1536, help="address space of each process, MB (default 1536)")
    parser.add_argument("--seconds", type=float, default=30.0, help="of the node, once it is GOOD (default 30)")
    parser.add_argument("--out", type=Path, help="document whose figures are replaced: docs/small_boards.md")
    arguments = parser.parse_args()
    rows = measure(arguments.memory, arguments.seconds)
    text = text_of(rows, arguments.memory)
    print(text)
    if arguments.out is not None:
        before, _, rest = arguments.out.read_text(encoding="utf-8").partition(MARKERS[0])
        after = rest.partition(MARKERS[1])[2]
        arguments.out.write_text(before + MARKERS[0] + "\n" + text + "\n" + MARKERS[1] + after, encoding="utf-8")
    missed = [what for what, found, bar in rows if found is None or found.processor > bar]
    print("missed:" if missed else "all bars kept", "; ".join(missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
