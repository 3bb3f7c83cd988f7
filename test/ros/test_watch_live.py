"""`eskf_watch` of a running node."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from support.robot import start_node
from support.ros_process import Ros, needs_ros

pytestmark = needs_ros


@pytest.fixture
def ros() -> Iterator[Ros]:
    with Ros() as observer:
        yield observer


@pytest.mark.parametrize("arguments", [[], ["--node", "/robot/eskf_node"]])
def test_a_node_without_messages_says_what_it_waits_for(ros: Ros, arguments: list[str]) -> None:
    start_node(ros, "-r", "__ns:=/robot")
    watch = ros.spawn([sys.executable, "-m", "eskf_ros.watch.main", "--once", *arguments], {"COLUMNS": "160"})
    ros.until(lambda: not watch.is_running, 120.0, "the next report")
    for words in ("WAITING_IMU", "usable for navigation: no", "no message on", "imu/data", "0 publishers"):
        assert words in watch.output, watch.output
    assert watch.stop() == 0
