"""A worker process: `python -m cosim.isolation`, with requests on stdin and answers on stdout.

Output of FMUs goes to stderr. The process ends when its stdin closes, for whatever reason.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import pickle
import queue
import signal
import struct
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO
from zlib import crc32

from cosim.core.errors import CosimError, InputError
from cosim.core.program import collect_seldom
from cosim.core.scratch import remove
from cosim.isolation.rows import Progress, mapped_progress

MESSAGE_HEAD = struct.Struct("!4sIQ")  # mark, checksum and size of a message
MESSAGE_MARK = b"\x93csm"
STREAMS_LOST = 121  # exit code of a worker whose streams an FMU has closed, read or changed
PROGRESS, FOLDERS_TO_REMOVE = "progress", "along"


class BadStream(OSError):
    """Error: a stream contains something other than a message, or does not block while it is empty."""


progress: Progress  # in memory that the caller shares
abandoned = threading.Event()  # set when the caller has ended


_objects: dict[int, Any] = {}  # number → object of a `Remote`


def make_object(number: int, make: Callable[..., Any], arguments: Sequence[Any]) -> None:
    """Create an object in this process, under a number."""
    _objects[number] = make(*arguments)


def call_object(
    number: int, method: str, arguments: Sequence[Any], options: Mapping[str, Any], is_last: bool = False
) -> Any:
    """Call a method of an object of this process; `is_last` removes the object afterwards."""
    return getattr(_objects.pop(number) if is_last else _objects[number], method)(*arguments, **options)


def share_log(component: Any) -> None:
    """Keep the last message of a component in shared memory, so that the caller sees it even after a crash."""

    def share(text: str) -> None:
        progress.words = " ".join(text.split()).encode()[:511]

    log: Any = getattr(component, "log", None)
    if hasattr(log, "share"):
        log.share = share


def send(stream: Any, content: bytes) -> None:
    """Write a message."""
    stream.write(MESSAGE_HEAD.pack(MESSAGE_MARK, crc32(content), len(content)) + content)
    stream.flush()


def receive(stream: Any) -> bytes | None:
    """Read a message; return None at the end of the stream, and raise BadStream for what is no message."""
    head = stream.read(MESSAGE_HEAD.size)
    if head is None:  # an FMU has made the stream non-blocking
        raise BadStream
    if len(head) < MESSAGE_HEAD.size:
        return None
    mark, checksum, size = MESSAGE_HEAD.unpack(head)
    content = stream.read(size) if mark == MESSAGE_MARK else None
    if content is None or (len(content) == size and crc32(content) != checksum):
        raise BadStream
    return bytes(content) if len(content) == size else None


def main() -> None:
    """Import the modules that the caller names, then execute its jobs in sequence."""
    global progress
    collect_seldom()
    # The streams to the caller are hidden from FMUs, which get an empty stdin and print to stderr.
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    state = _state_of(requests, answers)
    if sys.platform.startswith("linux"):
        # When the caller ends, the kernel sends SIGUSR1, even if an FMU hangs. The handler is alarm(SIGUSR1) of the C
        # library, which ends the process after 10 s.
        libc = ctypes.CDLL(None)
        libc.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
        libc.signal(signal.SIGUSR1, ctypes.cast(libc.alarm, ctypes.c_void_p))
        libc.prctl(1, signal.SIGUSR1)  # PR_SET_PDEATHSIG
    scratch, sys.path[:], python_path, modules = pickle.loads(receive(requests) or sys.exit())
    os.environ.pop("PYTHONPATH", None)  # this one located cosim; that of the caller replaces it
    if python_path is not None:
        os.environ["PYTHONPATH"] = python_path
    tempfile.tempdir = os.environ["TMPDIR"] = os.environ["TEMP"] = os.environ["TMP"] = str(scratch)
    progress = mapped_progress(scratch / PROGRESS)
    jobs: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(requests, jobs, scratch), daemon=True).start()
    for name in modules:
        importlib.import_module(name)
    _name_calls()
    while content := jobs.get():
        answer = _answer(content)
        try:
            if _state_of(requests, answers) != state:
                raise OSError
            send(answers, answer)
        except OSError:
            os._exit(STREAMS_LOST)
    # End immediately, without unloading modules. The caller ends processes that FMUs have started.
    with suppress(OSError, ValueError):  # an FMU may have closed the streams
        sys.stdout.flush()
        sys.stderr.flush()
    if os.name == "posix":
        ctypes.CDLL(None).fflush(None)  # writes buffered output of FMUs
    os._exit(0)


def _state_of(*streams: BinaryIO) -> list[tuple[int, int, bool]]:
    """Return the identity of each stream and whether reading blocks; raise OSError for a closed stream."""
    about = []
    for number in (stream.fileno() for stream in streams):
        waits = sys.platform == "win32" or os.get_blocking(number)
        status = os.fstat(number)
        about.append((status.st_dev, status.st_ino, waits))
    return about


def hold_if_abandoned() -> None:
    """If the caller has ended, wait until this process is ended."""
    while abandoned.is_set():
        time.sleep(1.0)


def _read(requests: BinaryIO, jobs: queue.SimpleQueue[bytes], scratch: Path) -> None:
    """Read requests and queue them as jobs; an empty job ends the worker.

    If the caller has ended, remove its files and end the process group.
    """
    try:
        while (content := receive(requests)) is not None:
            jobs.put(content)
    except OSError:
        os._exit(STREAMS_LOST)
    abandoned.set()  # Removal takes a while, during which another command may use the same folders.
    # The caller lists its folders in a file, since a job that names them may not have begun.
    with suppress(OSError, ValueError):
        for line in filter(None, (scratch / FOLDERS_TO_REMOVE).read_text(encoding="utf-8").split("\0")):
            remove(Path(line))
    remove(scratch)
    if sys.platform != "win32" and os.getpgid(0) == os.getpid():
        os.killpg(0, signal.SIGKILL)  # including processes started by an FMU
    os._exit(1)


def _name_calls() -> None:
    """Make FMPy store the name of each FMI call in the shared progress."""
    try:
        from fmpy.fmi1 import _FMU
    except ImportError:
        return
    call, here, named = _FMU._call, progress, progress.named

    def announce_and_call(self: Any, name: str, *arguments: Any) -> Any:
        here.call, named[0] = name.encode()[:127], 1
        answer = call(self, name, *arguments)
        named[0] = 0
        return answer

    _FMU._call = announce_and_call


def _answer(content: bytes) -> bytes:
    """Execute a job; return the pickled (answer, None) or (None, error). Unexpected errors include a traceback."""
    try:
        function, arguments = pickle.loads(content)
    except Exception as error:  # the answer has a class that only the caller can import
        return pickle.dumps((None, transfer_fault(error)))
    try:
        return pickle.dumps((function(*arguments), None))
    except Exception as error:
        place = f"in a worker:\n{traceback.format_exc()}"
        if not isinstance(error, CosimError):
            error.add_note(place)
        try:
            content = pickle.dumps((None, error))
            pickle.loads(content)
        except Exception:  # some errors cannot be pickled, or cannot be unpickled
            plain = RuntimeError(f"{type(error).__name__}: {error}")
            plain.add_note(place)
            content = pickle.dumps((None, plain))
        return content


def transfer_fault(error: Exception) -> InputError:
    """Return the InputError for an argument that cannot be sent to a worker."""
    reason = " ".join(str(error).split())[:200]
    message = (
        f"cannot be passed to the worker process ({type(error).__name__}: {reason}); define it in a module that can be "
        "imported, or run in this process (in_process=True, --in-process)"
    )
    return InputError.at(Path("the worker process"), message)
