"""Worker processes for tests, forked from one that has imported what they need: 1 s of processor time less for each.

A worker does all it does elsewhere but start a Python and import; tests of that are marked `fresh`, and
`tests/test_verbs.py` runs every verb as it is shipped.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import traceback
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

from cosim.isolation import process

ROOT = Path(__file__).resolve().parent.parent
MODULES = ("cosim.master.remote", "cosim.residuals.remote_drive", "fmpy.fmi2", "fmpy.logging", "filterpy.kalman")
READ_AT_START = ("LD_", "PYTHON", "OMP_", "OPENBLAS_", "NUMBA_", "MALLOC_")  # variables that a fork comes too late for
SPAWN = process._spawn  # what it does elsewhere


class Forked:
    """A forked worker as its caller sees it: what `subprocess.Popen` offers of that."""

    def __init__(self, pid: int, streams: tuple[Any, Any, Any], status: int) -> None:
        self.pid, self._status = pid, status
        self.stdin, self.stdout, self.stderr = streams
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit code, None while running."""
        with suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end and return the exit code."""
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("worker", timeout or 0.0)
            with os.fdopen(self._status, "rb") as stream:
                self.returncode = int(stream.read() or b"-9")
        return self.returncode

    def kill(self) -> None:
        """Kill the process."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


class Forker:
    """The process that forks, as its caller sees it; started when it is needed, ended with its caller."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._fixed: dict[str, str] = {}

    def spawn(self) -> Any:
        """Return a forked worker as in `cosim.isolation.process`, or a fresh process if its environment was changed."""
        if self._process is None:
            self._fixed = _read_at_start()
            self._socket, other = socket.socketpair()
            command = [sys.executable, "-m", __name__, str(other.fileno())]
            self._process = subprocess.Popen(
                command, cwd=ROOT, pass_fds=[other.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
            )
            other.close()
        if _read_at_start() != self._fixed:
            return SPAWN()
        ours, theirs = zip(*(os.pipe()[::way] for way in (-1, 1, 1, 1)), strict=True)
        job = pickle.dumps((dict(os.environ), os.getcwd()))
        socket.send_fds(self._socket, [len(job).to_bytes(8, "big")], list(theirs))
        self._socket.sendall(job)
        pid = int.from_bytes(self._socket.recv(8, socket.MSG_WAITALL), "big")
        for number in theirs:
            os.close(number)
        streams = (os.fdopen(ours[0], "wb"), os.fdopen(ours[1], "rb"), os.fdopen(ours[2], "rb"))
        return Forked(pid, streams, ours[3])

    def end(self) -> None:
        """End the forker."""
        if self._process is not None:
            self._socket.close()
            self._process.wait()


def _read_at_start() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.startswith(READ_AT_START)}


# -- the process that forks -------------------------------------------------------------------------


def serve(asked: socket.socket) -> None:
    """Fork a worker for each message, and tell how each has ended, until the caller ends."""
    for name in MODULES:
        if find_spec(name.partition(".")[0]):
            import_module(name)
    woken, wake = os.pipe()
    for number in (woken, wake):
        os.set_blocking(number, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    told: dict[int, int] = {}  # process → where its caller reads how it ended
    while True:
        ready = select.select([asked, woken], [], [])[0]
        if woken in ready:
            with suppress(BlockingIOError):
                os.read(woken, 4096)
            _tell(told)
        if asked in ready:
            head, numbers, _, _ = socket.recv_fds(asked, 8, 4)
            if not head:
                return
            job = asked.recv(int.from_bytes(head, "big"), socket.MSG_WAITALL)
            pid = os.fork()
            if pid == 0:
                _work(numbers, *pickle.loads(job))
            for number in numbers[:3]:
                os.close(number)
            told[pid] = numbers[3]
            asked.sendall(pid.to_bytes(8, "big"))


def _tell(told: dict[int, int]) -> None:
    """Report the exit codes of ended workers to their callers."""
    with suppress(ChildProcessError):
        while told and (ended := os.waitpid(-1, os.WNOHANG))[0]:
            number = told.pop(ended[0])
            with suppress(BrokenPipeError):
                os.write(number, str(os.waitstatus_to_exitcode(ended[1])).encode())
            os.close(number)


def _work(numbers: list[int], environment: dict[str, str], folder: str) -> NoReturn:
    """Run as a worker, as after a start by Python."""
    from cosim.isolation.worker import main

    code = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        for place, number in enumerate(numbers[:3]):
            os.dup2(number, place)
        os.closerange(3, 1024)
        os.environ.clear()
        os.environ.update(environment)
        os.chdir(folder)
        main()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
