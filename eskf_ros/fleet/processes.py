"""Workers on this machine: processes that live as long as there is work; a dead one is replaced, its task repeated.

concurrent.futures gives up the whole pool, and all that is in work, when one process dies, and does not say which task
it was; multiprocessing.Pool waits for ever for what a dead process had.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import NoReturn

from eskf_ros.fleet.task import Backend, Job, Outcome, Progress, Task, attempt

ATTEMPTS = 2
"""How often a task is begun: a worker may die of what its neighbours do, e.g. for memory; twice speaks for the task."""

PROGRESS_PERIOD = 0.2
"""Seconds from one message about progress to the next."""

PATIENCE = 5.0
"""Seconds in which a worker that is told to stop has to remove its unfinished files."""


class _Told(BaseException):
    """The parent has asked the worker to stop."""


def _stop(number: int, frame: object) -> NoReturn:
    raise _Told


def _serve(pipe: Connection, job: Job) -> None:
    """Life of a worker: tasks in, progress and outcomes out, until the parent closes the pipe or dies."""
    signal.signal(signal.SIGTERM, _stop)
    try:
        while True:
            task = pipe.recv()
            pipe.send(attempt(job, task, _reporter(pipe), f"process {os.getpid()}"))
    except (EOFError, OSError, _Told):
        return


def _reporter(pipe: Connection) -> Progress:
    """Return what sends the progress of one task: at once when it begins, then not more often than can be seen."""
    told = 0.0

    def report(share: float) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told > PROGRESS_PERIOD:
            told = now
            pipe.send(share)

    return report


class _Worker:
    """A process, the pipe to it, and the task it has."""

    def __init__(self, job: Job) -> None:
        context = multiprocessing.get_context("spawn")  # fork would copy the threads of a progress bar half
        self.pipe, theirs = context.Pipe()
        self.process: SpawnProcess = context.Process(target=_serve, args=(theirs, job), daemon=True)
        # Ctrl-C reaches the whole group, and the parent decides: in the worker it stays blocked from its birth on.
        # The first start of a process would start the resource tracker, which lets it through again.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        theirs.close()
        self.task: Task | None = None

    def give(self, task: Task) -> None:
        """Hand out a task; if the process has died meanwhile, the end of the pipe tells."""
        self.task = task
        with contextlib.suppress(OSError):
            self.pipe.send(task)


def on_processes(count: int) -> Backend:
    """Return a backend of up to `count` processes of this machine."""

    def outcomes(job: Job, tasks: Sequence[Task], progress: Callable[[str, float], None]) -> Iterator[Outcome]:
        return _outcomes(job, tasks, progress, count)

    return outcomes


def _outcomes(job: Job, tasks: Sequence[Task], progress: Callable[[str, float], None], count: int) -> Iterator[Outcome]:
    waiting = deque(tasks)
    attempts: Counter[str] = Counter()
    workers: list[_Worker] = []
    leaving: list[_Worker] = []
    begun = False

    def let_go(worker: _Worker) -> None:
        """Let a process end: it does when its pipe is closed."""
        worker.pipe.close()
        workers.remove(worker)
        leaving.append(worker)

    def supply(worker: _Worker) -> None:
        """Give the next task, or let the worker go."""
        if waiting:
            attempts[waiting[0].name] += 1
            worker.give(waiting.popleft())
        else:
            let_go(worker)

    try:
        while waiting or workers:
            while len(workers) < min(count, len(waiting) + sum(worker.task is not None for worker in workers)):
                workers.append(_Worker(job))
            # All start at once, but one begins: on a first start it compiles, and the others find what it has made.
            idle = [worker for worker in workers if worker.task is None]
            for worker in idle if begun else idle[: len(idle) - len(workers) + 1]:
                supply(worker)
            for worker in _with_news(workers):
                task = worker.task
                try:
                    message = worker.pipe.recv()
                except (EOFError, OSError):
                    let_go(worker)
                    worker.process.join()
                    if task is not None and attempts[task.name] < ATTEMPTS:
                        waiting.appendleft(task)
                    elif task is not None:
                        yield _lost(task, worker.process)
                    continue
                assert task is not None
                begun = True
                if isinstance(message, Outcome):
                    supply(worker)
                    yield replace(message, attempts=attempts[task.name])
                else:
                    progress(task.name, message)
    finally:
        _end(workers, leaving)


def _with_news(workers: Sequence[_Worker]) -> list[_Worker]:
    """Wait until at least one worker has sent something, or has died."""
    ready = wait([worker.pipe for worker in workers])
    return [worker for worker in workers if worker.pipe in ready]


def _lost(task: Task, process: SpawnProcess) -> Outcome:
    code = process.exitcode or 0
    cause = f"by signal {-code} ({signal.Signals(-code).name})" if code < 0 else f"with exit code {code}"
    hint = "; did memory run out?" if code == -signal.SIGKILL else ""
    error = f"the process that had it ended {cause}, {ATTEMPTS} times{hint}"
    return Outcome(task, "failed", error=error, attempts=ATTEMPTS, worker=f"process {process.pid}")


def _end(workers: Sequence[_Worker], leaving: Sequence[_Worker]) -> None:
    """Stop what still works, and wait for all; unfinished files are removed by the workers themselves."""
    for worker in workers:
        worker.process.terminate()
    deadline = time.monotonic() + PATIENCE
    for worker in (*workers, *leaving):
        worker.process.join(max(0.0, deadline - time.monotonic()))
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        worker.pipe.close()
