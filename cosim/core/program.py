"""Process of a command. Ctrl-C ends the process with exit code 130, even during imports; SIGTERM and SIGHUP with 4."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cosim.core.errors import Terminated

STOPPED = 130  # exit code: stopped from the keyboard


def collect_seldom() -> None:
    """Make garbage collection rare: nearly all objects read from large files stay in use."""
    gc.set_threshold(500_000, 20, 100)


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let Ctrl-C end the process at once without a traceback, in code that needs no cleanup."""
    listens = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # A shell's background jobs ignore SIGINT.
    if listens:
        signal.signal(signal.SIGINT, lambda *_: os._exit(STOPPED))
    yield
    if listens:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def as_program(entry: Callable[[], None]) -> None:
    """Call the main function of this process. Ctrl-C raises KeyboardInterrupt; SIGTERM and SIGHUP raise Terminated."""
    received: list[int] = []

    def terminate(number: int, frame: object) -> None:
        received.append(number)
        if len(received) == 1:  # later signals, and signals after the end, have no effect
            raise Terminated(signal.Signals(number).name)

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if number := getattr(signal, name, None):
            atexit.register(signal.signal, number, signal.SIG_IGN)  # otherwise a signal could kill Python while it ends
            if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores SIGHUP
                signal.signal(number, terminate)
    try:
        entry()
    except KeyboardInterrupt:  # Ctrl-C while the error was printed
        sys.exit(STOPPED)
    finally:
        gc.freeze()  # otherwise Python searches all objects twice when it ends
        received.append(0)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, lambda *_: os._exit(STOPPED))
