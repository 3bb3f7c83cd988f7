"""Hostile traffic between phases of a good drive for ten minutes: `python benchmark/hostile_traffic.py [--minutes 10]`.

A line for each round of a minute: what the node has published, what of it was not finite, how far it was from the truth
after twenty seconds of good data, and its memory. The exit code is 1 if a number was not finite, if an error was
beyond three sigma and a metre, or if the memory grew by more than 32 MB after the first round.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from eskf_ros.simulate.scenario import simulate  # noqa: E402
from support.hostile_traffic import Listener, Phase, drive, mixed, not_finite, play, position_errors, resident_megabytes  # noqa: E402
from support.robot import CONFIG, start_node  # noqa: E402
from support.ros_process import Ros  # noqa: E402

ROUND = (Phase(8.0, good=False, hostile=300.0), Phase(20.0, good=True, hostile=300.0), Phase(32.0, True, 0.0))
SETTLED = 5
MEMORY_GROWTH = 32.0


def main() -> int:
    """Run the rounds; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=int, default=10)
    minutes = parser.parse_args().minutes
    phases = ROUND * minutes
    recording = simulate("hour_drive", seed=11, truth_rate=200.0, start=8.0, stop=8.0 + 60.0 * minutes)
    failures, memory = 0, []
    with Ros() as ros:
        node = start_node(ros, "--params-file", str(CONFIG))
        listener = Listener(ros)
        ros.until(lambda: all(p.get_subscription_count() for p in listener.publishers.values()), 180.0, "the node")
        first_stamp, begin = time.time_ns(), time.monotonic()
        traffic = mixed(drive(recording, first_stamp), first_stamp, phases, seed=1)
        waiting = next(traffic)
        for minute in range(1, minutes + 1):
            part = []
            while waiting is not None and waiting[0] < minute * 60 * 10**9:
                part.append(waiting)
                waiting = next(traffic, None)
            play(ros, listener.publishers, part, begin)
            taken = listener.take()
            bad = sum(not_finite(messages) for messages in taken.values())
            error, std = position_errors(taken["gps/filtered"][-SETTLED:], recording, first_stamp)
            memory.append(resident_megabytes(node.popen.pid))
            right = len(error) == SETTLED and bool(np.all(error < 3.0 * std + 1.0))
            failures += bad > 0 or not right
            print(
                f"minute {minute:2d}: {len(part)} messages in, {len(taken['odometry/local'])} odometries out, "
                f"{bad} not finite; error {error.max(initial=0.0):.2f} m, std {std.max(initial=0.0):.2f} m; "
                f"{memory[-1]:.0f} MB",
                flush=True,
            )
        failures += memory[-1] > memory[0] + MEMORY_GROWTH
        failures += node.stop() != 0
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
