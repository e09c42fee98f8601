"""Workers and commands for tests, forked from a process that has imported what they need: each costs 1 s less.

They do all they do elsewhere but start a Python and import; tests of that are marked `fresh`, and
`tests/test_verbs.py` runs every verb as it is shipped.
"""

from __future__ import annotations

import atexit
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import walk_packages
from typing import Any, NoReturn

import cosim as cosim_package
from cosim.fmi.native import compiler
from cosim.isolation import process

ROOT = Path(__file__).resolve().parent.parent
FOREIGN = (
    "email.message", "filterpy.kalman", "fmpy.fmi2", "fmpy.logging", "fmpy.validation", "jinja2", "lxml.etree",
    "pydantic.type_adapter",
)  # fmt: skip
READ_AT_START = ("LD_", "PYTHON", "OMP_", "OPENBLAS_", "NUMBA_", "MALLOC_")  # variables that a fork comes too late for
SPAWN = process._spawn  # what it does elsewhere


@dataclass(frozen=True)
class Job:
    """A process to fork: a worker, or the command with the given words."""

    environment: dict[str, str]
    folder: str
    words: tuple[str, ...] | None = None
    options: tuple[str, ...] = field(default_factory=lambda: compiler.OPTIONS)


class Forked:
    """A forked worker or command as its caller sees it: what `subprocess.Popen` offers of that."""

    def __init__(self, pid: int, status: int) -> None:
        self.pid, self._status = pid, status
        self.stdin: Any = None
        self.stdout: Any = None
        self.stderr: Any = None
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

    def __init__(self, socket_to_it: socket.socket | None = None) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._socket, self._fixed = socket_to_it, _read_at_start(os.environ)

    def spawn(self) -> Any:
        """Return a forked worker as in `cosim.isolation.process`, or a fresh process if its environment was changed."""
        self._start()
        if _read_at_start(os.environ) != self._fixed:
            return SPAWN()
        ours, theirs = zip(*(os.pipe()[::way] for way in (-1, 1, 1)), strict=True)
        worker = self._fork(list(theirs), Job(dict(os.environ), os.getcwd()))
        for number in theirs:
            os.close(number)
        worker.stdin = os.fdopen(ours[0], "wb")
        worker.stdout, worker.stderr = (os.fdopen(number, "rb") for number in ours[1:])
        return worker

    def run(
        self, words: Sequence[str], folder: str, environment: Mapping[str, str], timeout: float
    ) -> subprocess.CompletedProcess[str] | None:
        """Run `cosim WORDS` in a folder to its end; return None if it needs another environment from its start."""
        self._start()
        if _read_at_start(environment) != self._fixed:
            return None
        with open(os.devnull) as nothing, tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            streams = [nothing, out, err]
            job = Job(dict(environment), folder, tuple(words))
            command = self._fork([stream.fileno() for stream in streams], job)
            try:
                code = command.wait(timeout)
            finally:
                command.kill()
            for stream in streams:
                stream.seek(0)
            return subprocess.CompletedProcess(["cosim", *words], code, out.read(), err.read())

    def _start(self) -> None:
        if self._socket is None:
            self._fixed = _read_at_start(os.environ)
            self._socket, other = socket.socketpair()
            command = [sys.executable, "-m", __name__, str(other.fileno())]
            self._process = subprocess.Popen(
                command, cwd=ROOT, pass_fds=[other.fileno()], stdin=subprocess.DEVNULL, start_new_session=True
            )
            other.close()

    def _fork(self, streams: list[int], job: Job) -> Forked:
        assert self._socket is not None
        status, told = os.pipe()
        content = pickle.dumps(job)
        socket.send_fds(self._socket, [len(content).to_bytes(8, "big")], [*streams, told])
        self._socket.sendall(content)
        pid = int.from_bytes(self._socket.recv(8, socket.MSG_WAITALL), "big")
        os.close(told)
        return Forked(pid, status)

    def end(self) -> None:
        """End the forker."""
        if self._socket is not None:
            self._socket.close()
        if self._process is not None:
            self._process.wait()


def cosim(
    *arguments: object, cwd: Path | None = None, env: Mapping[str, str] | None = None, timeout: float = 300.0
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end: forked, unless the test is marked `fresh` or the environment is another one."""
    words, environment = list(map(str, arguments)), dict(os.environ if env is None else env)
    forker = getattr(process._spawn, "__self__", None)
    if isinstance(forker, Forker) and (done := forker.run(words, str(cwd or Path.cwd()), environment, timeout)):
        return done
    command = [sys.executable, "-m", "cosim", *words]
    environment.setdefault("PYTHONPATH", str(ROOT))
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=False, timeout=timeout
    )


def _read_at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that Python reads at its start; the project itself is always on the path."""
    return {
        name: value
        for name, value in environment.items()
        if name.startswith(READ_AT_START) and (name, value) != ("PYTHONPATH", str(ROOT))
    }


# -- the process that forks -------------------------------------------------------------------------


def import_all() -> None:
    """Import the framework and what it imports late, for processes that are forked from this one."""
    own = (module.name for module in walk_packages(cosim_package.__path__, "cosim."))
    for name in (*FOREIGN, *own):
        if find_spec(name.partition(".")[0]) and not name.endswith("__main__"):
            import_module(name)


def serve(asked: socket.socket) -> None:
    """Fork a worker for each message, and tell how each has ended, until the caller ends."""
    import_all()
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
                _work(numbers, pickle.loads(job))
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


def _work(numbers: list[int], job: Job) -> NoReturn:
    """Run as a worker or as a command, as after a start by Python."""
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        for place, number in enumerate(numbers[:3]):
            os.dup2(number, place)
        os.closerange(3, 1024)
        os.environ.clear()
        os.environ.update(job.environment)
        os.chdir(job.folder)
        compiler.OPTIONS = job.options
        _main(job.words)()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        if job.words is not None:
            atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _main(words: tuple[str, ...] | None) -> Callable[[], object]:
    """Return what the process does: a worker's work, or that of a command, whose workers are forked too."""
    if words is None:
        from cosim.isolation.worker import main

        return main
    from cosim.__main__ import main as command

    ours, theirs = socket.socketpair()
    if os.fork() == 0:
        ours.close()
        with suppress(BaseException):
            serve(theirs)
        os._exit(0)
    theirs.close()
    process._spawn = Forker(ours).spawn
    sys.argv = ["cosim", *words]
    return command


if __name__ == "__main__":
    sys.modules["tests.warm"] = sys.modules["__main__"]  # where the class of a job is looked for
    serve(socket.socket(fileno=int(sys.argv[1])))
