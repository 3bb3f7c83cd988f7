"""Workers of a Dask cluster that is there: its scheduler spreads the tasks, and repeats those of workers that die."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from eskf_ros.fleet.fingerprint import of_version
from eskf_ros.fleet.task import Backend, Job, Outcome, Task, attempt

PATIENCE = 10.0
"""Seconds in which the scheduler has to answer."""


class ClusterError(Exception):
    """The cluster cannot be used; the text is a sentence for the user."""


def _run(job: Job, task: Task) -> Outcome:
    from distributed import get_worker

    return attempt(job, task, lambda share: None, get_worker().address)


def on_dask(address: str) -> Backend:
    """Return a backend of the cluster at ``address``, as in tcp://host:8786; raises ClusterError.

    The workers need this version of the package, and the recordings at the same paths.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise ClusterError("--dask needs the package distributed: pip install 'eskf_ros[dask]'") from error

    try:
        client: Any = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterError(f"--dask {address}: no scheduler answers there ({error})") from error
    try:
        _require_same_version(client, address)
    except BaseException:
        client.close()
        raise

    def outcomes(job: Job, tasks: Sequence[Task], progress: Callable[[str, float], None]) -> Iterator[Outcome]:
        return _outcomes(client, job, tasks)

    return outcomes


def _require_same_version(client: Any, address: str) -> None:
    try:
        versions = client.run(of_version)
    except Exception as error:  # Whatever a worker without this package answers.
        raise ClusterError(f"--dask {address}: its workers cannot run this version of eskf_ros ({error})") from error
    if not versions:
        raise ClusterError(f"--dask {address}: the cluster has no workers")
    for worker, version in versions.items():
        if version != of_version():
            raise ClusterError(f"--dask {address}: {worker} has eskf_ros {version}, this command {of_version()}")


def _outcomes(client: Any, job: Job, tasks: Sequence[Task]) -> Iterator[Outcome]:
    from distributed import as_completed

    futures: dict[Any, Task] = {}
    try:
        for place, task in enumerate(tasks):
            futures[client.submit(_run, job, task, pure=False, priority=-place)] = task
        for future in as_completed(list(futures), loop=client.loop):
            task = futures.pop(future)
            try:
                yield future.result()
            except Exception as error:  # KilledWorker, a scheduler that has gone, what cannot be sent.
                yield Outcome(task, "failed", error=f"{type(error).__name__}: {error}")
            future.release()
    finally:
        client.cancel(list(futures), force=True)
        client.close()
