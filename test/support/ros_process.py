"""For tests with the real node in its own process: an isolated DDS domain, an observer, and processes that always end.

Each test process takes a domain id that no other one on this machine has, so tests may run side by side. A test module
makes its own fixture of the observer, a new one for each test: it takes 10 ms, while an observer that saw a process end
may take three seconds to see the next one.

    pytestmark = needs_ros

    @pytest.fixture
    def ros() -> Iterator[Ros]:
        with Ros() as observer:
            yield observer
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

import eskf_ros

needs_ros = pytest.mark.skipif(
    importlib.util.find_spec("rclpy") is None, reason="needs rclpy: source a ROS 2 installation or install .[ros]"
)

# Read by the message classes when they are imported: without it they take values of any type and send garbage.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

_FIRST_PORT = 22119
_PACKAGE_PARENT = Path(eskf_ros.__file__).resolve().parent.parent


@functools.cache
def _reserved_domain() -> tuple[int, socket.socket]:
    for domain in range(1, 100):
        guard = socket.socket()
        try:
            guard.bind(("127.0.0.1", _FIRST_PORT + domain))
        except OSError:
            guard.close()
            continue
        return domain, guard
    raise RuntimeError("all ROS domains from 1 to 99 are in use by tests")


def free_domain() -> int:
    """A ROS domain id that is this process's own until it ends: a bound TCP port keeps others off it."""
    return _reserved_domain()[0]


class Process:
    """A child process whose output (both streams) goes to a file, so that it never waits for a reader."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self.is_closed = False
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        self.popen = subprocess.Popen(
            command,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    @property
    def output(self) -> str:
        """What the process wrote so far."""
        file = self._output.fileno()
        return os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace")

    @property
    def is_running(self) -> bool:
        return self.popen.poll() is None

    def send_signal(self, number: signal.Signals) -> None:
        self.popen.send_signal(number)

    def stop(self, number: signal.Signals = signal.SIGINT, timeout: float = 10.0) -> int:
        """Ask the process to end and return its exit code (negative: killed by that signal).

        After `timeout` (s) it is killed with everything it started, which shows as -9.
        """
        if self.is_running:
            self.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.popen.wait(timeout)
        self.close()
        return self.popen.returncode

    def close(self) -> None:
        """Kill whatever is left of the process and its children."""
        if not self.is_closed:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.popen.pid, signal.SIGKILL)
            self.popen.wait()
            self.is_closed = True


class Ros:
    """An observer: a node of this process in a context of its own, and the processes it started, on one domain.

    Attributes: `domain` (int), `context` (rclpy.Context), `node` (rclpy.node.Node).
    """

    def __init__(self, name: str = "observer") -> None:
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        self.domain = free_domain()
        self.context = Context()
        self.context.init(args=[], domain_id=self.domain)
        self.node: Any = Node(name, context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._processes: list[Process] = []
        self._logs = tempfile.TemporaryDirectory()

    def __enter__(self) -> Ros:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes:
            process.stop(timeout=5.0)
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
        self._logs.cleanup()

    def spin_once(self, timeout: float = 0.01) -> None:
        """Serve the observer's node for one event, or `timeout` seconds."""
        self._executor.spin_once(timeout_sec=timeout)

    def until(self, condition: Callable[[], object], timeout: float = 10.0, what: str = "") -> None:
        """Serve the observer's node until the condition holds.

        Fails the test after `timeout` (s), or when a process that was not stopped has died, saying `what` was waited
        for and what the processes wrote.
        """
        deadline = time.monotonic() + timeout
        while not condition():
            own = [process for process in self._processes if not process.is_closed]
            died = any(process.popen.poll() for process in own)
            if died or time.monotonic() > deadline:
                written = "\n".join(
                    f"--- {process.popen.args}: {process.popen.poll()}\n{process.output}" for process in own
                )
                why = "a process died" if died else f"{timeout:g} s passed"
                pytest.fail(f"{why} while waiting for {what or 'a condition'}\n{written}")
            self.spin_once()

    def spawn(self, command: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> Process:
        """Start a process on this domain; it is stopped (SIGINT, then SIGKILL) with the observer at the latest.

        A `command` that ends in .py runs with this interpreter.
        """
        words = [str(word) for word in command]
        if words[0].endswith(".py"):
            words.insert(0, sys.executable)
        settings = {
            "ROS_DOMAIN_ID": str(self.domain),
            "ROS_LOG_DIR": self._logs.name,
            "PYTHONUNBUFFERED": "1",
            # The package under test, installed or not, is the one this process has.
            "PYTHONPATH": os.pathsep.join([str(_PACKAGE_PARENT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        }
        process = Process(words, {**os.environ, **settings, **(environment or {})})
        self._processes.append(process)
        return process
