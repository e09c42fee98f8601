"""A command as a process: stopped from the keyboard it ends with 130 from its first moment to its last."""

from __future__ import annotations

import atexit
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STOPPED, TERMINATED = 130, 4  # exit codes: stopped from the keyboard, asked to end by a signal


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
    for name in ("SIGTERM", "SIGHUP"):  # what the command sets goes back to this when it is over: its exit code stands
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _ignore)
            atexit.register(signal.signal, number, signal.SIG_IGN)
    # the last of all: Python takes handlers away before it ends, and what is done has its own exit code
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    keyboard = _Keyboard()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, keyboard)
    try:
        entry()
        keyboard.is_done = True
    except KeyboardInterrupt:  # while the end was told
        keyboard.is_done = True
        sys.exit(STOPPED)
    except BaseException:
        keyboard.is_done = True
        raise


class _Keyboard:
    """Handles SIGINT: the command is interrupted; once it is done, the process ends.

    Python handles signals after calls, so that none comes between a command's end and the assignment after it. To
    change the handler there would be a call, in which another signal can raise KeyboardInterrupt.
    """

    is_done = False

    def __call__(self, number: int, frame: object) -> None:
        if self.is_done:
            _end(number, frame)
        raise KeyboardInterrupt


@contextmanager
def ending_when_stuck(patience: float = 5.0) -> Iterator[None]:
    """End the process if this block is not left within `patience` seconds of SIGINT, SIGTERM or SIGHUP.

    Python calls a handler between two of its own instructions. A library that does not return, as LAPACK may not,
    keeps it waiting for ever. Only for commands, and only in the main thread: no cleaning up follows.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    before, left = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False), threading.Event()
    ends = {int(getattr(signal, name)): TERMINATED for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)}
    ends[int(signal.SIGINT)] = STOPPED

    def watch() -> None:
        while numbers := reader.recv(1):
            code = ends.get(numbers[0])
            if code is not None and not left.wait(patience):
                os._exit(code)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        left.set()
        signal.set_wakeup_fd(before)
        writer.close()
        watcher.join()
        reader.close()


def _ignore(number: int, frame: object) -> None:
    """Do nothing: unlike SIG_IGN, a command takes this for a signal that is to end it."""


def _end(number: int, frame: object) -> None:
    os._exit(STOPPED)
