"""Start and end of the node's process: signals, the executor, and the loop that drives it.

rclpy is imported when it is needed, not above: signals must be caught before its slow import.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

LONGEST_WAIT = 0.1
"""s; the loop checks the stop flag at least this often."""


class Stopped(BaseException):
    """A signal came while the node was being made; no error, like KeyboardInterrupt, so that no handler catches it."""


class StartError(Exception):
    """The node cannot start with the given arguments; the text is one line for the user."""

    def __init__(self, error: Exception) -> None:
        # The place in the sources of rcl does not help the user.
        super().__init__(re.sub(r",? at /\S+:\d+", "", " ".join(str(error).split())))


class StopFlag:
    """Is set by SIGINT or SIGTERM, without any other effect: the loop ends where it is safe to end.

    Only while the node is being made, which may take a minute of compiling, `Stopped` is raised.

    The handlers of rclpy shut the context down under the running callback instead, which then fails with a traceback. A
    second signal (`ros2 launch` sends SIGINT to the group and to the process) changes nothing.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.set = False
        self.raises = False
        for number in self.SIGNALS:
            signal.signal(number, self._stop)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.set = True
        if self.raises:
            self.raises = False
            raise Stopped

    def ignore_from_now(self) -> None:
        """Ignore signals from now on: while the interpreter ends they would spoil the exit code."""
        for number in self.SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def make_executor(context: Any = None) -> Any:
    """Return the quickest single-threaded executor of this rclpy; drive it with `spin_once`.

    The events executor takes a third of the processor time of the other, but its own `spin` delivers nothing in the
    releases of 2025 and 2026. Older Jazzy installations do not have it.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def spin(node: Any, stop: StopFlag) -> None:
    """Serve the node until the flag is set or its context is shut down; exceptions of a callback are raised here."""
    executor = make_executor(node.context)
    executor.add_node(node)
    try:
        while not stop.set and node.context.ok():
            executor.spin_once(timeout_sec=LONGEST_WAIT)
    finally:
        executor.remove_node(node)
        executor.shutdown()


def run(create_node: Callable[[], Any], stop: StopFlag, arguments: Sequence[str] | None = None) -> None:
    """Run a process with one node: initialise rclpy, create the node, serve it, shut everything down.

    `arguments` as of `rclpy.init` (None: those of the process). At the end, and also after an error, the node's
    `close()` is called while its publishers still work, then its `destroy_node()`. Raises StartError for arguments that
    rcl cannot read.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    words = None if arguments is None else list(arguments)
    try:
        rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise StartError(error) from error
    try:
        try:
            stop.raises = not stop.set
            node = create_node()
        except Stopped:
            return
        finally:
            stop.raises = False
        try:
            spin(node, stop)
        finally:
            node.close()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
        stop.ignore_from_now()
