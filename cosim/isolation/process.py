"""The caller's side of a worker process: start, jobs, supervision and cleanup."""

from __future__ import annotations

import contextvars
import itertools
import os
import pickle
import queue
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Self

import psutil

from cosim.blocks.shared_code import SharedCode, has_loaded_fmus
from cosim.core.errors import Crashed, SimulationError, Terminated
from cosim.core.scratch import ScratchFolder, scratch
from cosim.files.cache import cache_environment
from cosim.files.files import delay_stops
from cosim.isolation import worker
from cosim.isolation.rows import NO_CALL, OTHER, Progress, mapped_progress
from cosim.isolation.watch import READING_PAUSE, Clock, Watch, how_ended
from cosim.isolation.worker import (
    FOLDERS_TO_REMOVE,
    PROGRESS,
    STREAMS_LOST,
    BadStream,
    call_object,
    make_object,
    receive,
    send,
    transfer_fault,
)

WORKER_FOLDER_PREFIX = "cosim-work-"
POLL = 0.05  # interval between checks of a process [s]
ENDING_TIMEOUT_S = 5.0  # time [s] for a process to end by itself
NO_MESSAGE = b""  # in place of an answer: an FMU has written into the stream
MOST_OUTPUT = 64_000  # passed output of FMUs [bytes]
LAST_OUTPUT = 4_000  # last part kept to explain a crash [bytes]
MOST_WORDS = 200  # shown part in a message [characters]
TIMED_OUT = (subprocess.TimeoutExpired, psutil.TimeoutExpired)  # errors of waiting for a process
ROOT = Path(__file__).resolve().parent.parent.parent


class Worker:
    """A process that calls functions for this process; a context manager.

    The process is started at the first call, and again after a crash.

    Args:
        modules: Modules imported before the first job.
    """

    def __init__(self, *modules: str) -> None:
        self._modules = modules
        self._process: subprocess.Popen[bytes] | _Forked | None = None
        self.spent = [0.0]  # total time [s] of jobs that the caller counts together
        self.starts = 0  # number of starts; a new process does not have the objects of the old one

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with delay_stops():
            self.end(kill=kind is not None)  # after an error, do not wait for imports of the worker

    progress: Progress  # also valid after the process has ended

    def start(self) -> None:
        """Start the process ahead of the first job."""
        if not self.running:
            start_together([self])

    def _launch(self, *, replaced: bool = False) -> None:
        """Start a process; unless it replaces another one, create a new folder and progress. `_attend` must follow."""
        if not replaced:
            self.end()
            self._scratch: ScratchFolder = scratch(WORKER_FOLDER_PREFIX)
        try:
            self.progress = mapped_progress(self._scratch.path / PROGRESS)
            # A fork has all imported modules, but a lock that another thread holds would never be released in it. For
            # the Linux kernel, the thread that starts a process is the parent, and the worker ends with this thread.
            is_alone = sys.platform.startswith("linux") and int(psutil.Process().num_threads()) == 1
            if is_alone and not has_loaded_fmus():
                self._process = _fork()
            elif threading.current_thread() is threading.main_thread():
                self._process = _spawn()
            else:
                with _starting:
                    starter = _starters.setdefault(os.getpid(), ThreadPoolExecutor(1, "start of workers"))
                self._process = starter.submit(_spawn).result()
        except BaseException:
            self._scratch.remove()
            raise
        self._jobs = 0
        self.starts += 1

    def _attend(self) -> None:
        """Start reading what the process sends, and send its settings."""
        assert self._process is not None
        self._answers: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._output = _Output(self._process.stderr)
        threading.Thread(target=self._listen, args=(self._process.stdout, self._answers), daemon=True).start()
        python_path = os.environ.get("PYTHONPATH")
        self._ask(pickle.dumps((self._scratch.path, list(sys.path), python_path, self._modules)))

    @property
    def folder(self) -> Path:
        """Return a folder that exists as long as the process."""
        return self._scratch.path

    def remove_if_killed(self, folder: Path) -> None:
        """Register a folder that the worker removes if this process is killed."""
        with suppress(OSError), (self._scratch.path / FOLDERS_TO_REMOVE).open("a", encoding="utf-8") as stream:
            stream.write(f"{folder}\0")  # if the disk is full, the next command removes the folder

    @property
    def running(self) -> bool:
        """Return True if the process runs."""
        return self._process is not None and self._process.poll() is None

    def call(
        self, function: Callable[..., Any], *arguments: Any, watch: Watch | None = None, doing: int = NO_CALL
    ) -> Any:
        """Call a function in the worker and return its result.

        If an FMU has different code under a name that the process has already loaded, a new process is used.

        Errors of cosim in the worker are raised here. After a crash or an exceeded limit, shared rows and counters keep
        their values, and the next call starts a new process.

        Args:
            doing: Number of the FMI call that messages name, for functions that do not report their calls.

        Raises:
            InputError: The arguments cannot be sent to the worker.
            Crashed: The process ended.
            TimedOut: A time limit is exceeded.
            SimulationError: The memory limit is exceeded.
        """
        self.start()
        self.progress.made[0], self.progress.doing[0], self.progress.named[0] = 0, doing, 0
        self.progress.asked[0] = self.progress.ending[0] = 0
        self.progress.words = b""
        clock = Clock(watch or Watch(), self.progress)
        try:
            content = pickle.dumps((function, arguments))
        except Exception as failure:  # pickle raises any error of the objects' methods
            raise transfer_fault(failure) from None
        self._ask(content)
        self._jobs += 1
        try:
            content = self._wait(clock)
        except BaseException as stop:
            with delay_stops():
                grace = clock.watch.grace if isinstance(stop, (KeyboardInterrupt, Terminated)) else 0.0
                if grace and self.running and self.progress.made[0]:  # gives time for a last checkpoint
                    self.progress.ending[0] = self.progress.asked[0] = 1
                    with suppress(queue.Empty):
                        self._answers.get(timeout=grace)
                self.end(kill=True)
            raise
        answer, error = pickle.loads(content)
        if isinstance(error, SharedCode) and self._jobs > 1:
            with delay_stops():
                self.end(replaced=True)
                self._launch(replaced=True)
                self._attend()
            return self.call(function, *arguments, watch=watch, doing=doing)
        if error is not None:
            raise error
        return answer

    def end(self, kill: bool = False, *, replaced: bool = False) -> None:
        """End the process and its children.

        Args:
            kill: Do not wait for the process to end by itself.
            replaced: Keep the files of the process, for the next process.
        """
        process: Any = self._process
        self._process = None
        if process is None:
            return
        if not kill:
            try:
                with suppress(OSError):
                    send(process.stdin, b"")
                process.wait(ENDING_TIMEOUT_S)
            except TIMED_OUT:
                kill = True
        _end_group(process, kill)
        self._output.join(1.0)  # children of the process may keep its streams open
        with suppress(OSError, ValueError):  # Unsent data have no reader.
            process.stdin.close()  # The readers of the other streams close them; closing here would wait for a read.
        if not replaced:
            self._scratch.remove()

    def _ask(self, content: bytes) -> None:
        if self._process is not None:
            with suppress(OSError):  # an ended process is detected while waiting for the answer
                send(self._process.stdin, content)

    @staticmethod
    def _listen(stream: BinaryIO, answers: queue.SimpleQueue[bytes | None]) -> None:
        content: bytes | None = b""
        with suppress(ValueError), stream:
            while content is not None:
                try:
                    content = receive(stream)
                except BadStream:
                    answers.put(NO_MESSAGE)
                    return
                except (OSError, ValueError):
                    content = None
                answers.put(content)

    def _wait(self, clock: Clock) -> bytes:
        times, next_look = clock.watch.times, 0.0
        while True:
            try:
                content = self._answers.get(timeout=POLL if times is None else random.uniform(*READING_PAUSE))
            except queue.Empty:
                assert self._process is not None
                if times is not None:
                    times.read(self.progress.made[0], self.progress.doing[0])
                    if time.monotonic() < next_look:
                        continue
                    next_look = time.monotonic() + POLL
                clock.look(self._process.pid)
                if self._process.poll() is None or not self._answers.empty():
                    continue
                content = None  # children of the process may keep its streams open
            if not content:
                raise self._crash(clock, patience=0.0 if content == NO_MESSAGE else ENDING_TIMEOUT_S)
            if clock.watch.width and self._process is not None:  # A short run ends between two checks.
                clock.check_memory(self._process.pid)
            return content

    def _crash(self, clock: Clock, patience: float) -> SimulationError:
        """Return the error for a crash, with its cause, the call and the last message.

        Args:
            patience: Time [s] for the process to end.
        """
        assert self._process is not None
        code: int | None = None
        with suppress(*TIMED_OUT):
            code = self._process.wait(patience)
        _end_group(self._process, kill=True)
        self._output.join(1.0)
        if code in (None, STREAMS_LOST):
            return Crashed(*clock.place_of_streams())
        texts = (bytes(text).decode("utf-8", "replace") for text in (self.progress.words, self._output.last))
        words = next((line.strip() for text in texts for line in reversed(text.splitlines()) if line.strip()), "")
        component, at, call = clock.place()
        last = f"; its last output: {words[:MOST_WORDS]}" if words else ""
        return Crashed(component, at, f"{call} {how_ended(code)}{last}")


def start_together(workers: Sequence[Worker]) -> None:
    """Start the processes of several workers. All can be forks, since threads are started only afterwards."""
    with delay_stops():
        for worker_ in workers:
            worker_._launch()
        for worker_ in workers:
            worker_._attend()


class Remote:
    """An object in a worker. The first call creates the object; after a crash, it is created in a new process.

    Args:
        worker: Worker, which can contain several objects.
        make: Function that creates the object in the worker.
        arguments: Arguments of `make`.
    """

    _numbers = itertools.count()

    def __init__(self, worker: Worker, make: Callable[..., Any], *arguments: Any) -> None:
        self.worker, self._recipe = worker, (make, arguments)
        self._number, self._process = next(self._numbers), 0

    @property
    def is_made(self) -> bool:
        """Return True if the object exists in the current process of the worker."""
        return self._process == self.worker.starts and self.worker.running

    def make(self, watch: Watch | None = None) -> None:
        """Create the object unless it exists, supervised as in `Worker.call`."""
        if not self.is_made:
            self.worker.call(make_object, self._number, *self._recipe, watch=watch, doing=OTHER)
            self._process = self.worker.starts

    def call(self, method: str, *arguments: Any, watch: Watch | None = None, doing: int = OTHER, **options: Any) -> Any:
        """Call a method of the object and return its result; errors are those of `Worker.call`."""
        self.make(watch)
        call = self._number, method, arguments, options
        return self.worker.call(call_object, *call, watch=watch, doing=doing)

    def free(self, method: str, *arguments: Any, watch: Watch | None = None) -> None:
        """Call a last method of the object if it exists, then discard the object."""
        if self.is_made:
            self.worker.call(call_object, self._number, method, arguments, {}, True, watch=watch, doing=OTHER)
        self._process = 0


class _Output(threading.Thread):
    """Text that FMUs print in the worker: up to a limit, the text is passed on; its last part is kept for messages."""

    def __init__(self, stream: Any) -> None:
        super().__init__(daemon=True)
        self.last, self._stream = b"", stream
        self.start()

    def run(self) -> None:
        """Read to the end."""
        room = MOST_OUTPUT
        with suppress(OSError, ValueError), self._stream:
            while part := self._stream.read1(65536):
                self.last = (self.last + part)[-LAST_OUTPUT:]
                if room <= 0:
                    continue
                shown = part[:room].decode("utf-8", "replace")
                room -= len(part)
                with suppress(OSError, ValueError):  # stderr may be closed
                    sys.stderr.write(shown if room > 0 else f"{shown}\n(further output of the FMUs is left out)\n")
                    sys.stderr.flush()


_starting = threading.Lock()
_starters: dict[int, ThreadPoolExecutor] = {}  # process → threads; a fork does not have the threads of its parent


def _spawn() -> subprocess.Popen[bytes]:
    """Start Python in a process group of its own, so that Ctrl-C interrupts only the caller."""
    path = os.environ.get("PYTHONPATH")
    environment = {**os.environ, **cache_environment(), "PYTHONPATH": str(ROOT) + (os.pathsep + path if path else "")}
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "cosim.isolation"],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        start_new_session=os.name != "nt",
    )


class _Forked(psutil.Process):  # type: ignore[misc]  # psutil is untyped
    """A process that `_fork` has started, with the interface of `subprocess.Popen` as far as needed."""

    def __init__(self, pid: int, stdin: int, stdout: int, stderr: int) -> None:
        super().__init__(pid)
        self.stdin, self.stdout, self.stderr = os.fdopen(stdin, "wb"), os.fdopen(stdout, "rb"), os.fdopen(stderr, "rb")

    def poll(self) -> int | None:
        """Return the exit code, negative after a signal; None while the process runs."""
        with suppress(psutil.TimeoutExpired):
            return int(self.wait(0.0))
        return None


def _fork() -> _Forked:
    """Fork this process into a group of its own, with default signals and only the files of its streams."""
    for stream in (sys.stdout, sys.stderr):  # otherwise the fork would write buffered text again
        with suppress(OSError, ValueError):  # a stream may be closed
            stream.flush()
    (to_read, to_write), (out_read, out_write), (err_read, err_write) = os.pipe(), os.pipe(), os.pipe()
    if sys.platform == "win32":
        raise OSError("Windows has no fork")
    pid = os.fork()
    if pid:
        for end in (to_read, out_write, err_write):
            os.close(end)
        return _Forked(pid, to_write, out_read, err_read)
    try:
        os.setsid()
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            signal.signal(getattr(signal, name), signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, [])
        for number, end in enumerate((to_read, out_write, err_write)):
            os.dup2(end, number)
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))
        os.environ.update(cache_environment())
        contextvars.Context().run(worker.main)  # without context variables of the caller
    finally:
        os._exit(1)


def _end_group(process: subprocess.Popen[bytes] | _Forked, kill: bool) -> None:
    """End a process and its children."""
    if sys.platform == "win32":
        if kill and process.poll() is None:
            command = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
            subprocess.run(command, capture_output=True, check=False)
    else:
        with suppress(ProcessLookupError, PermissionError):  # All have ended.
            os.killpg(process.pid, signal.SIGKILL)
    if kill:
        with suppress(psutil.Error):
            process.kill()
    process.wait()
