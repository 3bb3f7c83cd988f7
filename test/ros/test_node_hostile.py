"""A minute of traffic no robot should send: the real node stays alive, publishes numbers only, and finds back."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from eskf_ros.simulate.scenario import simulate
from support.hostile_traffic import Listener, Phase, drive, mixed, not_finite, play, position_errors, resident_megabytes
from support.robot import CONFIG, FIRST_START, start_node
from support.ros_process import Ros, needs_ros

pytestmark = needs_ros

PHASES = (
    Phase(6.0, good=False, hostile=300.0),
    Phase(16.0, good=True, hostile=0.0),
    Phase(16.0, good=True, hostile=300.0),
    Phase(22.0, good=True, hostile=0.0),
)
SETTLED = 5
"""So many fixes, one a second, at the end of a good phase in which the estimate must be right."""

MEMORY_GROWTH = 32.0
"""MB between the first good phase and the end: the buffers of the history may double, no more."""


@pytest.fixture
def ros() -> Iterator[Ros]:
    with Ros() as observer:
        yield observer


def test_a_minute_of_hostile_traffic(ros):
    recording = simulate("hour_drive", seed=11, truth_rate=200.0, start=8.0, stop=70.0)
    node = start_node(ros, "--params-file", str(CONFIG))
    listener = Listener(ros)
    ros.until(
        lambda: all(p.get_subscription_count() for p in listener.publishers.values()), FIRST_START, "the node to start"
    )
    first_stamp, begin = time.time_ns(), time.monotonic()
    messages = list(mixed(drive(recording, first_stamp), first_stamp, PHASES, seed=1))
    end, memory = 0.0, []
    for phase in PHASES:
        start, end = end, end + phase.seconds
        play(ros, listener.publishers, [m for m in messages if start <= m[0] * 1e-9 < end], begin)
        taken = listener.take()
        assert node.is_running, node.output
        for topic, published in taken.items():
            assert not_finite(published) == 0, f"{topic} in {phase}"
        if not phase.hostile:
            assert len(taken["odometry/local"]) > 1000
            error, std = position_errors(taken["gps/filtered"][-SETTLED:], recording, first_stamp)
            assert len(error) == SETTLED
            assert np.all(error < 3.0 * std + 1.0), f"errors {error} m, std {std} m"
            memory.append(resident_megabytes(node.popen.pid))
    assert memory[-1] < memory[0] + MEMORY_GROWTH
    assert node.stop() == 0
    assert "Traceback" not in node.output
