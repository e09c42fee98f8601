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
from dataclasses import dataclass, field, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import walk_packages
from types import ModuleType
from typing import Any, NoReturn

import controller
import cosim as cosim_package
import fmus
import plant
from cosim.core.registry import names
from cosim.files.archive import unpack
from cosim.fmi.native import compiler
from cosim.isolation import process

ROOT = Path(__file__).resolve().parent.parent
FOREIGN = (
    "control", "email.message", "filterpy.kalman", "fmpy.fmi2", "fmpy.logging", "fmpy.validation", "jinja2",
    "lxml.etree", "matplotlib.backends.backend_svg", "matplotlib.figure", "pandas",
    "pydantic.type_adapter", "pythonfmu.builder", "rich.progress", "rich.table", "scipy.integrate", "scipy.io",
    "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.sparse.csgraph", "scipy.special", "scipy.stats", "sympy",
    "sympy.printing.c", "sympy.printing.pycode",
)  # fmt: skip
IN_WORKERS = (
    "email.message", "filterpy.kalman", "fmpy.fmi1", "fmpy.fmi2", "fmpy.fmi3", "fmpy.logging", "fmpy.sundials",
    "fmpy.validation", "jinja2", "lxml.etree", "pydantic.type_adapter",
)  # fmt: skip
READ_AT_START = ("LD_", "PYTHON", "OMP_", "OPENBLAS_", "NUMBA_", "MALLOC_")  # variables that a fork comes too late for
SPAWN = process._spawn  # what it does elsewhere


@dataclass(frozen=True)
class Job:
    """A process to fork: a worker, or the command with the given words, whose workers are forked too."""

    environment: dict[str, str]
    folder: str
    words: tuple[str, ...] = ()
    forker: Path | None = None  # the folder of the processes that fork, for a command
    options: tuple[str, ...] = field(default_factory=lambda: compiler.OPTIONS)
    fmus: tuple[Path, ...] = ()  # in Python, to import before


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
    """The processes that fork, as one of their callers sees them: started by the first, ended with the last.

    One has what workers import; the other, larger one has what commands import. Their sockets are in a folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self._sockets: dict[str, socket.socket] = {}
        self._environment = dict(os.environ)
        self._fixed = _read_at_start(os.environ)
        self._fmus: list[Path] = []  # of which it has not been told yet

    def spawn(self) -> Any:
        """Return a forked worker as in `cosim.isolation.process`, or a fresh process if its environment was changed."""
        self._start("workers")
        if _read_at_start(os.environ) != self._fixed:
            return SPAWN()
        ours, theirs = zip(*(os.pipe()[::way] for way in (-1, 1, 1)), strict=True)
        worker = self._fork("workers", list(theirs), Job(dict(os.environ), os.getcwd()))
        for number in theirs:
            os.close(number)
        worker.stdin = os.fdopen(ours[0], "wb")
        worker.stdout, worker.stderr = (os.fdopen(number, "rb") for number in ours[1:])
        return worker

    def run(
        self, words: Sequence[str], folder: str, environment: Mapping[str, str], timeout: float
    ) -> subprocess.CompletedProcess[str] | None:
        """Run `cosim WORDS` in a folder to its end; return None if it needs another environment from its start."""
        for kind in ("workers", "commands"):
            self._start(kind)
        if _read_at_start(environment) != self._fixed:
            return None
        job = Job(dict(environment), folder, tuple(words), self._folder)
        with open(os.devnull) as nothing, tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
            streams = [nothing, out, err]
            command = self._fork("commands", [stream.fileno() for stream in streams], job)
            try:
                code = command.wait(timeout)
            finally:
                command.kill()
            for stream in streams:
                stream.seek(0)
            return subprocess.CompletedProcess(["cosim", *words], code, out.read(), err.read())

    def know(self, fmu: Path) -> None:
        """Let the modules of an FMU in Python be there in all workers that are forked from now on."""
        self._fmus.append(fmu)

    def _start(self, kind: str) -> None:
        """Connect to a process that forks; start it if no other caller has."""
        if kind in self._sockets:
            return
        import fcntl  # of POSIX, as all that forks

        folder = os.open(self._folder, os.O_RDONLY)
        address = f"/proc/self/fd/{folder}/{kind}"  # the path of a socket has a limit of 108 bytes
        asked = self._sockets[kind] = socket.socket(socket.AF_UNIX)
        with (self._folder / f"{kind}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # until it is closed
            try:
                asked.connect(address)
            except (FileNotFoundError, ConnectionRefusedError):
                (self._folder / kind).unlink(missing_ok=True)
                with socket.socket(socket.AF_UNIX) as listening:
                    listening.bind(address)
                    listening.listen(64)
                    command = [sys.executable, "-m", __name__, str(listening.fileno()), kind]
                    self._processes.append(
                        subprocess.Popen(
                            command, cwd=ROOT, env=self._environment, pass_fds=[listening.fileno()],
                            stdin=subprocess.DEVNULL, start_new_session=True,
                        )
                    )  # fmt: skip
                    asked.connect(address)
        os.close(folder)

    def _fork(self, kind: str, streams: list[int], job: Job) -> Forked:
        status, told = os.pipe()
        if kind == "workers":
            job = replace(job, fmus=tuple(self._fmus))
            self._fmus.clear()
        content = pickle.dumps(job)
        socket.send_fds(self._sockets[kind], [len(content).to_bytes(8, "big")], [told, *streams])
        self._sockets[kind].sendall(content)
        pid = int.from_bytes(self._sockets[kind].recv(8, socket.MSG_WAITALL), "big")
        os.close(told)
        return Forked(pid, status)

    def end(self) -> None:
        """End the processes that fork."""
        for socket_to_it in self._sockets.values():
            socket_to_it.close()
        for process_ in self._processes:
            process_.wait()


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


# -- the processes that fork ------------------------------------------------------------------------


def import_all(
    foreign: Sequence[str] = FOREIGN, packages: Sequence[ModuleType] = (cosim_package, controller, fmus, plant)
) -> None:
    """Import packages and what they import late, for processes that are forked from this one."""
    own = (module.name for p in packages for module in walk_packages(p.__path__, f"{p.__name__}."))
    for name in (*foreign, *own):
        if find_spec(name.partition(".")[0]) and not name.endswith("__main__"):
            import_module(name)


def import_modules_of(fmu: Path) -> None:
    """Import the package that an FMU in Python carries; its name has a hash of its content."""
    with tempfile.TemporaryDirectory() as folder:
        unpack(fmu, Path(folder))
        resources = Path(folder, "resources")
        sys.path.insert(0, str(resources))
        (package,) = (path.name.removesuffix("_slave.py") for path in resources.glob("*_slave.py"))
        for module in walk_packages([str(resources / package)], f"{package}."):
            import_module(module.name)
        sys.path.remove(str(resources))


def serve(listening: socket.socket) -> None:
    """Fork a process for each message, and tell how each has ended, until the last caller ends."""
    woken, wake = os.pipe()
    for number in (woken, wake):
        os.set_blocking(number, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    told: dict[int, int] = {}  # process → where its caller reads how it ended
    callers = [listening.accept()[0]]
    while callers:
        ready = select.select([listening, woken, *callers], [], [])[0]
        if woken in ready:
            with suppress(BlockingIOError):
                os.read(woken, 4096)
            _tell(told)
        for asked in (caller for caller in callers.copy() if caller in ready):
            try:
                lives = _answer(asked, told)
            except (ConnectionError, EOFError, pickle.UnpicklingError):  # killed while it asked
                lives = False
            if not lives:
                callers.remove(asked)
                asked.close()
        if listening in ready:
            callers.append(listening.accept()[0])


def _answer(asked: socket.socket, told: dict[int, int]) -> bool:
    """Fork what a caller asks for; return False if the caller has ended."""
    head, numbers, _, _ = socket.recv_fds(asked, 8, 5)
    if not head:
        return False
    job: Job = pickle.loads(asked.recv(int.from_bytes(head, "big"), socket.MSG_WAITALL))
    for fmu in job.fmus:
        import_modules_of(fmu)
    pid = os.fork()
    if pid == 0:
        _work(numbers[1:], job)
    for number in numbers[1:]:
        os.close(number)
    told[pid] = numbers[0]
    asked.sendall(pid.to_bytes(8, "big"))
    return True


def _tell(told: dict[int, int]) -> None:
    """Report the exit codes of ended workers to their callers."""
    with suppress(ChildProcessError):
        while told and (ended := os.waitpid(-1, os.WNOHANG))[0]:
            number = told.pop(ended[0])
            with suppress(BrokenPipeError):
                os.write(number, str(os.waitstatus_to_exitcode(ended[1])).encode())
            os.close(number)


def _work(numbers: list[int], job: Job) -> NoReturn:
    """Run as a worker, as a server of workers or as a command, as after a start by Python."""
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        for place, number in enumerate(numbers):
            os.dup2(number, place)
        os.closerange(len(numbers), 1024)
        os.environ.clear()
        os.environ.update(job.environment)
        os.chdir(job.folder)
        compiler.OPTIONS = job.options
        _main(job)()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        if job.words:
            atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _main(job: Job) -> Callable[[], object]:
    """Return what the process does."""
    if not job.words:
        from cosim.isolation.worker import main

        return main
    from cosim.__main__ import main as command

    assert job.forker is not None
    process._spawn = Forker(job.forker).spawn
    sys.argv = ["cosim", *job.words]
    return command


if __name__ == "__main__":
    sys.modules["tests.warm"] = sys.modules["__main__"]  # where the class of a job is looked for
    if sys.argv[2] == "workers":
        import_all(IN_WORKERS, (cosim_package,))
    else:
        import_all()
        names("cosim.verbs")  # reads what all packages register
    serve(socket.socket(fileno=int(sys.argv[1])))
    os._exit(0)  # nothing is left to tidy up but what was imported
