"""eskf_replay on folders of recordings: the same results as one by one, taken up again, on processes and on Dask."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from eskf_ros.replay.main import main

CHECKOUT = Path(__file__).resolve().parents[2]
BAG = CHECKOUT / "bags" / "tunnel_drive.mcap"
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
OPTIONS = ["--config", str(CONFIG), "--truth", "truth", "--quiet"]
FILES = ["aids.csv", "details.npz", "odometry.mcap", "summary.json", "trajectory.tum"]


def make_fleet(folder: Path, count: int) -> Path:
    for number in range(count):
        place = folder / f"day_{number % 2}"
        place.mkdir(parents=True, exist_ok=True)
        shutil.copy(BAG, place / f"drive_{number}.mcap")
    return folder


def fleet_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "fleet.json").read_text())
    return content


def states_of(folder: Path) -> dict[str, str]:
    return {entry["name"]: entry["state"] for entry in fleet_of(folder)["recordings"]}


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the recording replayed by itself."""
    out = tmp_path_factory.mktemp("alone")
    assert main([str(BAG), *OPTIONS, "--out", str(out)]) == 0
    return out / "tunnel_drive_eskf"


def assert_same_results(folder: Path, alone: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == FILES
    for name in ("trajectory.tum", "aids.csv"):
        assert (folder / name).read_bytes() == (alone / name).read_bytes()


def test_a_folder_is_replayed_as_one_by_one_and_skipped_when_done(
    tmp_path: Path, alone: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = make_fleet(tmp_path / "fleet", 3), tmp_path / "out"
    (folder / "cut.mcap").write_bytes(BAG.read_bytes()[:100])
    command = [str(folder), *OPTIONS[:-1], "--out", str(out), "--jobs", "2"]
    assert main(command) == 2
    captured = capsys.readouterr()
    assert "cut.mcap" in captured.err
    assert "4 recordings: 1 failed, 3 done" in captured.out
    names = [f"day_{number % 2}/drive_{number}.mcap" for number in range(3)]
    assert states_of(out) == {"cut.mcap": "failed", **dict.fromkeys(names, "done")}
    assert fleet_of(out)["recordings"][0]["name"] == "cut.mcap"
    for number in range(3):
        assert_same_results(out / f"day_{number % 2}" / f"drive_{number}_eskf", alone)

    figures = fleet_of(out)["recordings"][1]["figures"]
    summary = json.loads((alone / "summary.json").read_text())
    assert figures["horizontal_p95"] == summary["error"]["horizontal"]["p95"]
    assert figures["usable"] == summary["quality"]["usable"]

    (folder / "cut.mcap").unlink()
    shutil.copy(BAG, folder / "day_0" / "drive_0.mcap")  # A new time of change.
    os.utime(folder / "day_0" / "drive_0.mcap", ns=(0, 7))
    assert main([*command, "--json", "-", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out) == fleet_of(out)
    assert states_of(out) == {names[0]: "done", names[1]: "skipped", names[2]: "skipped"}
    assert main([*command, "--quiet", "--outage", "80:20"]) == 0
    assert states_of(out) == dict.fromkeys(names, "done")
    assert main([*command, "--quiet", "--outage", "80:20"]) == 0
    assert states_of(out) == dict.fromkeys(names, "skipped")


def test_what_was_replayed_alone_counts_as_done_and_results_lie_beside_the_recordings(tmp_path: Path) -> None:
    folder = make_fleet(tmp_path / "fleet", 2)
    assert main([str(folder / "day_1" / "drive_1.mcap"), *OPTIONS]) == 0
    assert main([str(folder), *OPTIONS]) == 0
    assert states_of(folder) == {"day_0/drive_0.mcap": "done", "day_1/drive_1.mcap": "skipped"}
    assert (folder / "day_0" / "drive_0_eskf" / "summary.json").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--jobs", "0"], "'0' is not a number of processes, 1 or more"),
        (["--jobs", "two"], "'two' is not a number of processes"),
    ],
)
def test_mistakes_are_told(arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(BAG), *arguments]) == 2
    assert sentence in capsys.readouterr().err


def test_a_folder_without_recordings_is_a_mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "fleet" / "notes").mkdir(parents=True)
    assert main([str(tmp_path / "fleet"), *OPTIONS]) == 2
    assert "there is no recording in it" in capsys.readouterr().err


def children_of(process: int) -> list[int]:
    """The workers of a command."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A fleet in work, in a process group of its own, and its folder; the first of six recordings is done."""
    folder = make_fleet(tmp_path / "fleet", 6)
    command = [sys.executable, "-m", "eskf_ros.replay.main", str(folder), *OPTIONS, "--jobs", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=CHECKOUT, start_new_session=True) as process:
        while not list(folder.glob("*/*_eskf/summary.json")) and process.poll() is None:
            time.sleep(0.01)
        yield process, folder
        process.kill()


def test_ctrl_c_leaves_nothing_half_done_and_the_same_command_does_the_rest(
    running: tuple[subprocess.Popen[str], Path], alone: Path
) -> None:
    process, folder = running
    os.killpg(process.pid, signal.SIGINT)  # As a terminal does: to the command and to its workers.
    _, error = process.communicate(timeout=60.0)
    assert process.returncode == 130
    assert "Traceback" not in error, error
    assert "the same command does the rest" in error
    assert not list(folder.glob("*/*_eskf/.partial-*"))
    states = states_of(folder)
    done = [name for name in states if (folder / name).with_name(f"{Path(name).stem}_eskf").exists()]
    assert 0 < len(done) < 6
    assert {name for name, state in states.items() if state == "done"} <= set(done)
    assert main([str(folder), *OPTIONS, "--jobs", "2"]) == 0
    assert states_of(folder) == {name: "skipped" if name in done else "done" for name in states}
    for name in states:
        assert_same_results((folder / name).with_name(f"{(folder / name).stem}_eskf"), alone)


def test_killed_workers_lose_nothing(running: tuple[subprocess.Popen[str], Path], alone: Path) -> None:
    process, folder = running
    workers = children_of(process.pid)
    for worker in workers:
        os.kill(worker, signal.SIGKILL)
    _, error = process.communicate(timeout=120.0)
    assert workers
    assert process.returncode == 0, error
    assert set(states_of(folder).values()) == {"done"}
    assert 2 in [entry["attempts"] for entry in fleet_of(folder)["recordings"]]
    for name in states_of(folder):
        assert_same_results((folder / name).with_name(f"{(folder / name).stem}_eskf"), alone)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_recordings(tmp_path: Path) -> None:
    folder = tmp_path / "fleet"
    folder.mkdir()
    for number in range(16):
        (folder / f"{number:02d}.mcap").symlink_to(BAG)
    assert main([str(folder), *OPTIONS, "--jobs", "1"]) == 0
    peaks = sorted(entry["peak_mb"] for entry in fleet_of(folder)["recordings"])
    # The process keeps its peak: what the sixth recording needed is all that the last needs, to a thirtieth.
    assert peaks[-1] < 1.03 * peaks[5]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as two_workers:
        yield two_workers


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_and_survives_a_killed_worker(tmp_path: Path, cluster: Any, alone: Path) -> None:
    folder = make_fleet(tmp_path / "fleet", 6)
    command = [sys.executable, "-m", "eskf_ros.replay.main", str(folder), *OPTIONS]
    command += ["--dask", cluster.scheduler_address]
    workers = [worker.process.pid for worker in cluster.workers.values()]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=CHECKOUT) as process:
        while not list(folder.glob("*/*_eskf/summary.json")) and process.poll() is None:
            time.sleep(0.01)
        os.kill(workers[0], signal.SIGKILL)
        _, error = process.communicate(timeout=240.0)
    assert process.returncode == 0, error
    assert set(states_of(folder).values()) == {"done"}
    assert {entry["worker"].partition("://")[0] for entry in fleet_of(folder)["recordings"]} == {"tcp"}
    for name in states_of(folder):
        assert_same_results((folder / name).with_name(f"{(folder / name).stem}_eskf"), alone)


def test_a_cluster_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed")
    from eskf_ros.fleet import dask_cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dask_cluster, "PATIENCE", 0.5)
        assert main([str(BAG), *OPTIONS, "--out", str(tmp_path), "--dask", "tcp://127.0.0.1:9"]) == 2
    assert "no scheduler answers" in capsys.readouterr().err
