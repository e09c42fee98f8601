"""Process of a command: it ends with exit code 130 whenever it is stopped from the keyboard, even during imports."""

from __future__ import annotations

import atexit
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STOPPED, TERMINATED = 130, 4  # exit codes: stopped from the keyboard, ended by a signal


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let Ctrl-C end the process silently. Only for code without need of cleanup."""
    listens = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # A shell's background jobs ignore SIGINT.
    if listens:
        signal.signal(signal.SIGINT, _end)
    yield
    if listens:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def as_program(entry: Callable[[], None]) -> None:
    """Call the entry function with signal handlers set up."""
    for name in ("SIGTERM", "SIGHUP"):  # Handlers return to these afterwards, so that the exit code survives.
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _ignore)
            atexit.register(signal.signal, number, signal.SIG_IGN)
    # Runs after the command's own exit functions: the exit code is settled, and Python soon removes the handlers.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    keyboard = _Keyboard()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, keyboard)
    try:
        entry()
        keyboard.is_done = True
    except KeyboardInterrupt:  # during the report of the end
        keyboard.is_done = True
        sys.exit(STOPPED)
    except BaseException:
        keyboard.is_done = True
        raise


class _Keyboard:
    """Handler of SIGINT: interrupt a running command, end the process of a finished command.

    A finished command sets `is_done`. Exchanging the handler instead would leave a moment for a KeyboardInterrupt.
    """

    is_done = False

    def __call__(self, number: int, frame: object) -> None:
        if self.is_done:
            _end(number, frame)
        raise KeyboardInterrupt


@contextmanager
def ending_when_stuck(patience: float = 5.0) -> Iterator[None]:
    """End the process if the `with` block ignores a stop for `patience` [s].

    A stop is SIGINT, SIGTERM or SIGHUP. Python calls signal handlers between its own instructions, so a library call
    without return, as in LAPACK, blocks them for ever. Only for commands, because no cleanup follows; without effect
    outside the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    descriptor, ended = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False), threading.Event()
    ends = {int(getattr(signal, name)): TERMINATED for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)}
    ends[int(signal.SIGINT)] = STOPPED

    def watch() -> None:
        while numbers := reader.recv(1):
            code = ends.get(numbers[0])
            if code is not None and not ended.wait(patience):
                os._exit(code)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(descriptor)
        writer.close()
        watcher.join()
        reader.close()


def _ignore(number: int, frame: object) -> None:
    """Ignore a signal. Unlike after SIG_IGN, the running command may still install its own handler."""


def _end(number: int, frame: object) -> None:
    os._exit(STOPPED)
