"""A running node with a profile has its parameters, and those of the user over them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.robot import FIRST_START
from support.ros_process import Ros, needs_ros

pytestmark = needs_ros


@pytest.fixture
def ros() -> Iterator[Ros]:
    with Ros() as observer:
        yield observer


def test_the_file_of_the_user_goes_before_the_profile_and_the_command_line_before_both(
    ros: Ros, tmp_path: Path
) -> None:
    from rcl_interfaces.srv import GetParameters

    own = tmp_path / "own.yaml"
    own.write_text("eskf_node:\n  ros__parameters:\n    nhc.lateral_std: 0.3\n    nhc.vertical_std: 0.4\n")
    given = ["--ros-args", "--params-file", str(own), "-p", "nhc.vertical_std:=0.5"]
    ros.spawn([sys.executable, "-m", "eskf_ros.ros_node.main", "--profile", "tractor", *given])
    client = ros.node.create_client(GetParameters, "/eskf_node/get_parameters")
    ros.until(client.service_is_ready, FIRST_START, "the node")
    names = ["nhc.angle_std_deg", "nhc.lateral_std", "nhc.vertical_std"]
    answer = client.call_async(GetParameters.Request(names=names))
    ros.until(answer.done, 30.0, "its parameters")
    assert [value.double_value for value in answer.result().values] == [2.0, 0.3, 0.5]
