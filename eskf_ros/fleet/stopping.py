"""Ctrl-C and `kill`, as commands take them."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(BaseException):
    """Ctrl-C or `kill`, with the number of the signal.

    It is not KeyboardInterrupt: one that passes through an import of a dataclass makes Python die of SIGINT although it
    is caught.
    """

    def __init__(self, number: int) -> None:
        self.number = number


def _stop(number: int, frame: object) -> NoReturn:
    raise Stopped(number)


@contextmanager
def stoppable() -> Iterator[None]:
    """While this lasts, Ctrl-C and `kill` raise `Stopped`; in the main thread only."""
    previous = [signal.signal(number, _stop) for number in _SIGNALS]
    try:
        yield
    finally:
        for number, handler in zip(_SIGNALS, previous, strict=True):
            signal.signal(number, handler)
