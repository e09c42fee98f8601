"""The process that works for another: `python -m cosim.isolation`, requests on stdin, answers on stdout.

What FMUs print goes to stderr. It ends when its stdin does: whoever asked has ended, however that was.
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
import traceback
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from cosim.base.errors import CosimError, Fault, InputError
from cosim.base.garbage import collect_seldom
from cosim.base.scratch import remove
from cosim.isolation.rows import Progress, mapped_progress

HEAD = struct.Struct("!Q")
PROGRESS, ALONG = "progress", "along"


@dataclass(frozen=True)
class Begin:
    """What a worker must know before its first job.

    scratch:    folder for all that it unpacks
    path:       where the caller finds modules
    pythonpath: the caller's variable of the environment
    modules:    to be imported at once
    """

    scratch: Path
    path: list[str]
    pythonpath: str | None
    modules: tuple[str, ...]


progress: Progress  # how far this worker is, for the one that watches


class Said(deque[str]):
    """Messages of an FMU, the last of which the caller sees even where the worker crashes."""

    def append(self, text: str) -> None:
        """As of a deque."""
        progress.words = " ".join(text.split()).encode()[:511]
        super().append(text)


def overheard(component: Any) -> None:
    """Let the caller see what a component logs."""
    log = getattr(component, "log", None)
    if isinstance(log, deque):
        component.log = Said(log, log.maxlen)


def send(stream: Any, content: bytes) -> None:
    """Write one message."""
    stream.write(HEAD.pack(len(content)) + content)
    stream.flush()


def receive(stream: Any) -> bytes | None:
    """Read one message; None where the other side has ended."""
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    content = stream.read(HEAD.unpack(head)[0])
    return content if len(content) == HEAD.unpack(head)[0] else None


def main() -> None:
    """Import what is asked for, then do one job after the other."""
    global progress
    collect_seldom()
    asked, answers = _own_streams()
    _end_with_caller()
    begin: Begin = pickle.loads(receive(asked) or sys.exit())
    scratch, sys.path[:] = begin.scratch, begin.path
    _restore("PYTHONPATH", begin.pythonpath)
    tempfile.tempdir = os.environ["TMPDIR"] = os.environ["TEMP"] = os.environ["TMP"] = str(scratch)
    progress = mapped_progress(scratch / PROGRESS)
    jobs: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(asked, jobs, scratch), daemon=True).start()
    for name in begin.modules:
        importlib.import_module(name)
    _name_calls()
    while content := jobs.get():
        send(answers, _answer(content))
    _end()


def _end() -> None:
    """End at once, as to take all modules apart takes longer than to load them; the caller ends what FMUs started."""
    sys.stdout.flush()
    sys.stderr.flush()
    if os.name == "posix":
        ctypes.CDLL(None).fflush(None)  # files that FMUs have written to
    os._exit(0)


def _own_streams() -> tuple[BinaryIO, BinaryIO]:
    """The streams to the caller, out of the way of FMUs: these read nothing and print to stderr."""
    asked, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    return asked, answers


def _restore(name: str, before: str | None) -> None:
    """A variable of the environment as the caller has it; it was changed so that this module is found."""
    if before is None:
        os.environ.pop(name, None)
    else:
        os.environ[name] = before


def _read(asked: BinaryIO, jobs: queue.SimpleQueue[bytes], scratch: Path) -> None:
    """Hand on the jobs, an empty one to end; where the caller has ended, end with all that is left."""
    while (content := receive(asked)) is not None:
        jobs.put(content)
    for path in (*_along(scratch), scratch):
        remove(path)
    if os.name == "posix" and os.getpgid(0) == os.getpid():
        os.killpg(0, signal.SIGKILL)  # what an FMU has started too
    os._exit(1)


def _along(scratch: Path) -> list[Path]:
    """Folders to take away where the caller has ended: it says so itself, as a job may not have begun yet."""
    try:
        return [Path(line) for line in (scratch / ALONG).read_text(encoding="utf-8").split("\0") if line]
    except (OSError, ValueError):
        return []


def _end_with_caller() -> None:
    """Linux: an FMU that hangs and holds the interpreter keeps no thread of ours from ending the process."""
    if not sys.platform.startswith("linux"):
        return
    # when the caller ends: SIGUSR1, whose handler is alarm(SIGUSR1) of the C library, 10 s to the default end
    libc = ctypes.CDLL(None)
    libc.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
    libc.signal(signal.SIGUSR1, ctypes.cast(libc.alarm, ctypes.c_void_p))
    libc.prctl(1, signal.SIGUSR1)  # PR_SET_PDEATHSIG


def _name_calls() -> None:
    """Have FMPy say which FMI function it calls, before it does."""
    try:
        from fmpy.fmi1 import _FMU
    except ImportError:
        return
    call = getattr(_FMU, "_call", None)
    if call is None:
        return

    def named(self: Any, name: str, *arguments: Any) -> Any:
        progress.call, progress.named[0] = name.encode()[:127], 1
        answer = call(self, name, *arguments)
        progress.named[0] = 0
        return answer

    _FMU._call = named


def _answer(content: bytes) -> bytes:
    """Do a job: (answer, None), or (None, the error), which says where it came from where it is none of ours."""
    try:
        function, arguments = pickle.loads(content)
    except Exception as error:  # of a class that only the caller can import
        return pickle.dumps((None, not_sent(error)))
    try:
        return pickle.dumps((function(*arguments), None))
    except Exception as error:
        return _sent(error, traceback.format_exc())


def not_sent(error: Exception) -> InputError:
    """Return the answer to an argument that does not come through to a worker process."""
    cure = "define it in a module that can be imported, or run in this process (in_process=True, --in-process)"
    message = f"cannot take over an object ({type(error).__name__}: {' '.join(str(error).split())[:200]}); {cure}"
    return InputError([Fault(Path("the worker process"), 0, 0, message)])


def _sent(error: Exception, place: str) -> bytes:
    """An error as the caller gets it; one that cannot be sent as its words."""
    if not isinstance(error, CosimError):
        error.add_note(f"in a worker:\n{place}")
    try:
        told = pickle.dumps((None, error))
        pickle.loads(told)
    except Exception:  # of those of some libraries that is seen only where they are read
        plain = RuntimeError(f"{type(error).__name__}: {error}")
        plain.add_note(f"in a worker:\n{place}")
        told = pickle.dumps((None, plain))
    return told
