"""Work for fleets in tests: what a worker process does with a task, chosen by the name of the recording."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eskf_ros.fleet.fingerprint import of_files, of_values
from eskf_ros.fleet.task import Column, Job, Progress, RefusedError, Task


def work(task: Task, progress: Progress) -> dict[str, Any]:
    """Write how often this recording was begun, or fail as its name says."""
    count = task.recording.with_suffix(".begun")
    begun = int(count.read_text()) + 1 if count.exists() else 1
    count.write_text(str(begun))
    progress(0.1)
    name = task.recording.stem
    if name.startswith("refused"):
        raise RefusedError(f"{name} has no IMU")
    if name.startswith("broken"):
        raise ZeroDivisionError("a fault of the work")
    if name.startswith("deadly") or (name.startswith("unlucky") and begun == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if name.startswith("endless") or (name.startswith("patient") and begun == 1):
        while True:
            progress(0.5)
            time.sleep(0.01)
    content = {"fingerprint": dict(task.fingerprint), "error": float(len(name)), "begun": begun}
    task.result.write_text(json.dumps(content))
    return content


def figures(content: Mapping[str, Any]) -> dict[str, Any]:
    return {"error": content["error"], "begun": content["begun"]}


def badness(content: Mapping[str, Any]) -> tuple[float, ...]:
    return (content["error"],)


JOB = Job("eskf_test", work, figures, badness, (Column("m", "error", ".1f"),))


def tasks_of(folder: Path, names: list[str], configuration: str = "") -> list[Task]:
    """A task for each name, with a recording of that name in the folder."""
    tasks = []
    for size, name in enumerate(names):
        recording = folder / f"{name}.mcap"
        if not recording.exists():
            recording.write_bytes(b"")
        marks = {"recording": of_files([recording]), "configuration": of_values({"all": configuration})}
        tasks.append(Task(name, recording, folder / f"{name}.json", marks, size))
    return tasks
