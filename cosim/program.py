"""A command as a process: stopped from the keyboard it ends with 130 from its first moment to its last."""

from __future__ import annotations

import atexit
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STOPPED = 130


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Ctrl-C ends the process without a word, as there is nothing to take away."""
    listens = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not in the background of a shell
    if listens:
        signal.signal(signal.SIGINT, _end)
    yield
    if listens:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def as_program(entry: Callable[[], None]) -> None:
    """Call it as all that this process is for."""
    # the last of all: Python takes handlers away before it ends, and what is done has its own exit code
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    try:
        entry()
    except KeyboardInterrupt:  # while the end was told
        sys.exit(STOPPED)
    finally:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _end)  # all is done that was to be


def _end(number: int, frame: object) -> None:
    os._exit(STOPPED)
