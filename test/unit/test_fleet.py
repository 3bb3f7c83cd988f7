"""Fleets: recordings found, shared among processes that may die, taken up again, and told with the worst first."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from eskf_ros.fleet.fingerprint import of_files, of_values, of_version
from eskf_ros.fleet.processes import on_processes
from eskf_ros.fleet.recordings import find, is_recording
from eskf_ros.fleet.run import run_fleet
from eskf_ros.fleet.task import Outcome
from support.fleet_work import JOB, tasks_of


def touched(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x")
    return path


def states(content: Mapping[str, Any]) -> dict[str, str]:
    return {entry["name"]: entry["state"] for entry in content["recordings"]}


def is_running(process: int) -> bool:
    """Whether a process is there and has not ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_recordings_are_found_at_any_depth_and_results_are_not(tmp_path: Path) -> None:
    for name in (
        "a.mcap",
        "day/b.db3",
        "day/whole/metadata.yaml",
        "day/whole/whole_0.mcap",
        "day/cut_off/cut_off_0.mcap",
        "day/cut_off/cut_off_1.mcap",
        "day/loose/first.mcap",
        "a_eskf/odometry.mcap",
        ".hidden/c.mcap",
        "day/.d.mcap",
        "notes/text.txt",
        "old.bag",
    ):
        touched(tmp_path / name)
    (tmp_path / "link").symlink_to(tmp_path / "day")
    said: list[str] = []
    found = find([tmp_path], said.append)
    names = [str(one.path.relative_to(tmp_path)) for one in found]
    assert names == ["a.mcap", "day/b.db3", "day/cut_off", "day/loose/first.mcap", "day/whole"]
    assert len(said) == 1
    assert "1 ROS 1 bag" in said[0]
    out = tmp_path / "out"
    assert [one.results(out) for one in found[1:4]] == [
        out / "day" / "b_eskf",
        out / "day" / "cut_off_eskf",
        out / "day" / "loose" / "first_eskf",
    ]
    assert found[1].results(None) == tmp_path / "day" / "b_eskf"


def test_a_folder_is_one_recording_where_it_was_before_there_were_fleets(tmp_path: Path) -> None:
    touched(tmp_path / "drive" / "any.mcap")
    touched(tmp_path / "drive" / "notes.txt")
    (tmp_path / "empty").mkdir()
    touched(tmp_path / "bag" / "metadata.yaml")
    assert all(is_recording(tmp_path / name) for name in ("drive", "empty", "bag", "missing.mcap"))
    touched(tmp_path / "drive" / "other.mcap")
    assert not is_recording(tmp_path / "drive")


def test_a_fingerprint_is_of_names_sizes_and_times(tmp_path: Path) -> None:
    bag = touched(tmp_path / "a.mcap")
    before = of_files([bag])
    assert of_files([bag]) == before
    os.utime(bag, ns=(0, 5))
    later = of_files([bag])
    bag.write_bytes(b"xy")
    os.utime(bag, ns=(0, 5))
    bag.rename(tmp_path / "b.mcap")
    assert len({before, later, of_files([tmp_path / "b.mcap"]), of_files([bag]), of_files([])}) == 5
    assert of_values({"a": float("nan"), "b": Path("x")}) == of_values({"b": Path("x"), "a": float("nan")})
    assert of_values({"a": 1.0}) != of_values({"a": 1.0 + 2**-50})
    assert len(of_version()) > 16


@pytest.mark.parametrize("count", [1, 3])
def test_a_failing_recording_does_not_stop_the_rest(tmp_path: Path, count: int) -> None:
    names = ["refused", "good", "broken", "deadly", "better_than_good", "unlucky"]
    content = run_fleet(JOB, tasks_of(tmp_path, names), on_processes(count), tmp_path / "fleet.json")
    assert content == json.loads((tmp_path / "fleet.json").read_text())
    assert states(content) == {
        "refused": "failed",
        "broken": "failed",
        "deadly": "failed",
        "good": "done",
        "better_than_good": "done",
        "unlucky": "done",
    }
    assert content["counts"] == {"failed": 3, "done": 3, "skipped": 0, "open": 0}
    entries = {entry["name"]: entry for entry in content["recordings"]}
    assert entries["refused"]["error"] == "refused has no IMU"
    assert entries["refused"]["trace"] == ""
    assert entries["broken"]["error"] == "ZeroDivisionError: a fault of the work"
    assert "fleet_work.py" in entries["broken"]["trace"]
    assert "signal 9 (SIGKILL), 2 times" in entries["deadly"]["error"]
    assert (entries["unlucky"]["attempts"], entries["good"]["attempts"]) == (2, 1)
    # The worst first: what failed, then the greatest error (here: the longest name).
    assert [entry["name"] for entry in content["recordings"]][3:] == ["better_than_good", "unlucky", "good"]


def test_a_worker_that_is_killed_from_outside_loses_nothing(tmp_path: Path) -> None:
    names = [*(f"quick_{number}" for number in range(20)), "patient"]  # waits to be killed the first time
    killed: list[int] = []

    def kill_one(outcomes: Sequence[Outcome], shares: Mapping[str, float]) -> None:
        if len(outcomes) > 2 and "patient" in shares and not killed:
            children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
            workers = [int(c) for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
            killed.extend(workers)
            for worker in workers:
                os.kill(worker, signal.SIGKILL)

    content = run_fleet(JOB, tasks_of(tmp_path, names), on_processes(2), tmp_path / "fleet.json", watch=kill_one)
    assert len(killed) == 2
    assert set(states(content).values()) == {"done"}
    entries = {entry["name"]: entry for entry in content["recordings"]}
    assert entries["patient"]["attempts"] == entries["patient"]["figures"]["begun"] == 2
    assert not any(is_running(worker) for worker in killed)


def test_the_largest_are_begun_first(tmp_path: Path) -> None:
    tasks = tasks_of(tmp_path, ["small", "middle", "large"])
    order: list[str] = []

    def watch(outcomes: Sequence[Outcome], shares: Mapping[str, float]) -> None:
        order[:] = [outcome.task.name for outcome in outcomes]

    run_fleet(JOB, tasks, on_processes(1), tmp_path / "fleet.json", watch=watch)
    assert order == ["large", "middle", "small"]


def test_finished_recordings_are_skipped_unless_something_changed(tmp_path: Path) -> None:
    def run(configuration: str = "", again: bool = False) -> dict[str, str]:
        tasks = tasks_of(tmp_path, ["a", "bb", "refused"], configuration)
        content = run_fleet(JOB, tasks, on_processes(1), tmp_path / "fleet.json", again)
        assert [entry["name"] for entry in content["recordings"]] == ["refused", "bb", "a"]
        return states(content)

    assert run() == {"refused": "failed", "bb": "done", "a": "done"}
    assert run() == {"refused": "failed", "bb": "skipped", "a": "skipped"}
    os.utime(tmp_path / "a.mcap", ns=(0, 5))
    assert run() == {"refused": "failed", "bb": "skipped", "a": "done"}
    (tmp_path / "bb.json").write_text('{"fingerprint": ')
    assert run() == {"refused": "failed", "bb": "done", "a": "skipped"}
    assert run("another") == {"refused": "failed", "bb": "done", "a": "done"}
    assert run("another", again=True) == {"refused": "failed", "bb": "done", "a": "done"}


def test_an_interrupted_fleet_stops_its_workers_and_goes_on_later(tmp_path: Path) -> None:
    names = ["one", "two", "endless"]

    def interrupt(outcomes: Sequence[Outcome], shares: Mapping[str, float]) -> None:
        if len(outcomes) == 2 and shares.get("endless"):
            raise KeyboardInterrupt

    tasks = tasks_of(tmp_path, names)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_fleet(JOB, tasks, on_processes(2), tmp_path / "fleet.json", watch=interrupt)
    assert time.monotonic() - began < 30.0
    content = json.loads((tmp_path / "fleet.json").read_text())
    assert states(content) == {"one": "done", "two": "done", "endless": "open"}
    assert states(run_fleet(JOB, tasks[:2], on_processes(2), tmp_path / "fleet.json")) == {
        "one": "skipped",
        "two": "skipped",
    }


@pytest.fixture
def endless_fleet(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], list[int]]]:
    """A process with a fleet whose two workers never finish, and the numbers of the workers."""
    program = (
        "import sys; from pathlib import Path; from support.fleet_work import JOB, tasks_of;"
        "from eskf_ros.fleet.processes import on_processes; from eskf_ros.fleet.run import run_fleet;"
        "folder = Path(sys.argv[1]);"
        "run_fleet(JOB, tasks_of(folder, ['endless_1', 'endless_2']), on_processes(2), folder / 'fleet.json')"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], env=environment) as process:
        while len(list(tmp_path.glob("*.begun"))) < 2 and process.poll() is None:
            time.sleep(0.02)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        workers = [int(c) for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
        yield process, workers
        process.kill()


def test_workers_end_when_the_command_is_killed(endless_fleet: tuple[subprocess.Popen[bytes], list[int]]) -> None:
    process, workers = endless_fleet
    assert len(workers) == 2
    process.kill()
    process.wait()
    deadline = time.monotonic() + 20.0
    while any(is_running(worker) for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(is_running(worker) for worker in workers)
