"""From an IMU sample to its odometry through the real node, over DDS: latency, processor time, losses; late fixes.

    python benchmark/node_latency.py [--rates 100 200 400 1000] [--seconds 30]

A sender, the node and a receiver, each a process of its own on an isolated ROS domain. The sender plays the simulator's
hour_drive in real time: IMU at the given rate, 5 Hz fixes and velocities that arrive 80 to 200 ms late, so that each
rewinds the filter. When the state is GOOD, after ten seconds, the measurement begins. Latency is from the call that
publishes the IMU sample to the return of the call that takes its `odometry/global`, so both transports and the wake-up
of the receiver are in it. `processor` is the time of all threads of the node, in per cent of one core. `lost` are IMU
samples without odometry.

The last row: all fixes and velocities come 500 ms late, and what is measured is the odometry of the first IMU sample
after each of them. Figures count on a machine that does nothing else. The exit code is 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from support.ros_process import Process, free_domain  # noqa: E402

CONFIG = ROOT / "config" / "tunnel_drive.yaml"
ENDS = ROOT / "benchmark" / "latency_ends.py"

TARGET_RATE = 1000.0
"""The targets are for this IMU rate (Hz): no sample lost, and"""

TARGET_PROCESSOR = 30.0
"""per cent of one core, and"""

TARGET_LATENCY = 1.0
"""ms for 99 % of all odometries, and for half of those after a late fix."""

QUIET_LOAD = 0.3


def measure(rate: float, seconds: float, is_late: bool, through: Sequence[str] = ()) -> dict[str, float]:
    """One run: `processor` (% of a core), `lost`, and of `measured` latencies `p50`, `p99` and `max` (ms).

    `megabytes`: what the node had resident at its most. ``through``: command that the node is started with.
    Raises RuntimeError when a process fails, or the state was not GOOD in time.
    """
    with tempfile.TemporaryDirectory() as folder, ExitStack() as processes:
        sent, received = Path(folder) / "sent.npz", Path(folder) / "received.npz"
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(free_domain()),
            "ROS_LOG_DIR": folder,
            "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        }

        def start(*words: object, through: Sequence[str] = ()) -> Process:
            process = Process([*through, sys.executable, *map(str, words)], environment)
            processes.callback(process.stop)
            return process

        node = start("-m", "eskf_ros.ros_node.main", "--ros-args", "--params-file", CONFIG, through=through)
        receiver = start(ENDS, "receive", received)
        sender = start(ENDS, "send", sent, node.popen.pid, rate, seconds, int(is_late))
        sender.popen.wait()
        memory = Path(f"/proc/{node.popen.pid}/status")
        peak = re.search(r"VmHWM:\s*(\d+)", memory.read_text() if memory.exists() else "")
        for process in (sender, receiver, node):
            code = process.stop()
            if code:
                raise RuntimeError(f"{' '.join(map(str, process.popen.args))} ended with {code}:\n{process.output}")
        with np.load(sent) as from_sender, np.load(received) as from_receiver:
            found = figures({**from_sender, **from_receiver}, is_late)
        return {**found, "megabytes": int(peak[1]) / 1024.0 if peak else float("nan")}


def figures(found: dict[str, np.ndarray], is_late: bool) -> dict[str, float]:
    """Join what the two ends saved; the latencies are all, or those of the samples after what came late."""
    sent, received = found["sent"], found["received"]
    if found["good_since"] > sent[0, 1]:
        raise RuntimeError("the state was not GOOD when the measurement began")
    stamps, at_sent, at_received = np.intersect1d(sent[:, 0], received[:, 0], return_indices=True)
    latency = (received[at_received, 1] - sent[at_sent, 1]) * 1e-6
    if is_late:
        latency = latency[np.isin(stamps, found["after_gnss"])]
    p50, p99 = np.percentile(latency, [50.0, 99.0])
    return {
        "processor": 100.0 * float(found["processor"]),
        "lost": len(sent) - len(stamps),
        "measured": len(latency),
        "p50": float(p50),
        "p99": float(p99),
        "max": float(latency.max()),
    }


def verdict(found: dict[str, float], is_late: bool) -> str:
    """What became of the targets, which are for `TARGET_RATE`."""
    name = "p50" if is_late else "p99"
    limits = {"lost": 0.0, "processor": TARGET_PROCESSOR, name: TARGET_LATENCY}
    missed = [name for name, limit in limits.items() if found[name] > limit]
    return f"missed: {', '.join(missed)}" if missed else "kept"


def main() -> int:
    """Measure and print the table; returns 1 if a target is missed, 2 if a run failed, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=float, nargs="+", default=[100.0, 200.0, 400.0, 1000.0], help="of the IMU (Hz)")
    parser.add_argument("--seconds", type=float, default=30.0, help="measured per row (default 30)")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    print(f"load average at the start: {load:.2f}" + (": something else is running" if load > QUIET_LOAD else ""))
    runs = [(rate, False) for rate in arguments.rates]
    runs += [(TARGET_RATE, True)] if TARGET_RATE in arguments.rates else []
    verdicts = []
    print(f"{'':22}{'odometries':>11}{'lost':>6}{'processor':>11}{'p50':>9}{'p99':>9}{'max':>9}  targets")
    try:
        for rate, is_late in runs:
            found = measure(rate, arguments.seconds, is_late)
            if rate == TARGET_RATE:
                verdicts.append(verdict(found, is_late))
            print(
                f"{f'{rate:g} Hz' + (', 500 ms late' if is_late else ''):22}"
                f"{found['measured']:11.0f}{found['lost']:6.0f}{found['processor']:9.1f} %"
                f"{found['p50']:6.2f} ms{found['p99']:6.2f} ms{found['max']:6.2f} ms"
                f"  {verdicts[-1] if rate == TARGET_RATE else ''}"
            )
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    print(
        f"targets at {TARGET_RATE:g} Hz: nothing lost, {TARGET_PROCESSOR:g} % of one core, p99 {TARGET_LATENCY:g} ms; "
        f"after a late fix p50 {TARGET_LATENCY:g} ms"
    )
    return int(any(text != "kept" for text in verdicts))


if __name__ == "__main__":
    sys.exit(main())
