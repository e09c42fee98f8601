"""Text files that are written completely or not at all, stop signals, and checks of output folders."""

from __future__ import annotations

import _thread
import errno
import io
import json
import math
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError, Terminated, refuse
from cosim.core.scratch import ScratchFolder, scratch
from cosim.core.settings import FilePath as FilePath

NOT_BLANK = "give a name, or . for the current folder"
STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
MAX_SIZE_PER_STORED_BYTE = 1000  # above, a file is sparse
ALWAYS_READ_BYTES = 1 << 26
READ_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)  # pipes are not waited for


def open_regular(path: Path) -> int:
    """Open a regular file for reading, and return its descriptor.

    Raises:
        OSError: The file is unreadable, a pipe or device (which may block or never end), or a sparse file with almost
            no stored bytes.
    """
    descriptor = os.open(path, READ_FLAGS)
    status = os.fstat(descriptor)
    is_regular, stored = stat.S_ISREG(status.st_mode), 512 * getattr(status, "st_blocks", status.st_size)
    if is_regular and status.st_size <= MAX_SIZE_PER_STORED_BYTE * stored + ALWAYS_READ_BYTES:
        return descriptor
    os.close(descriptor)
    raise OSError(
        errno.EINVAL,
        "has almost no stored content (a sparse file)" if is_regular else "is not a regular file",
        str(path),
    )


def open_bytes(path: Path) -> io.BufferedReader:
    """Open a regular file for reading; raise OSError for others."""
    return os.fdopen(open_regular(path), "rb")


def parse_json(text: str | bytes) -> Any:
    """Return the content of JSON; raise ValueError for other text, and for numbers beyond the range of doubles."""

    def number(digits: str, kind: Callable[[str], float]) -> float:
        if math.isinf(float(digits)):
            raise ValueError(f"{digits[:20]} is beyond the range of doubles")
        return kind(digits)

    return json.loads(text, parse_int=partial(number, kind=int), parse_float=partial(number, kind=float))


@contextmanager
def atomic_write(path: Path) -> Iterator[TextIO]:
    r"""Open a text file that replaces `path` after success. Unpaired surrogates are written as \ud800, as in JSON."""
    with draft_of(path) as draft, draft.open("w", encoding="utf-8", errors="backslashreplace", newline="") as stream:
        yield stream


def write_text(path: Path, text: str) -> None:
    """Write a text completely or not at all."""
    with atomic_write(path) as stream:
        stream.write(text)


def write_json(path: Path, content: Any, *, indent: int = 2, allow_nan: bool = True) -> None:
    """Write JSON with a final line break, completely or not at all."""
    write_text(path, json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=allow_nan) + "\n")


@contextmanager
def delay_stops() -> Iterator[None]:
    """Delay stop signals (Ctrl-C, SIGTERM) until the end of the block."""
    if threading.current_thread() is not threading.main_thread():  # Only the main thread receives signals.
        yield
        return
    signals: list[int] = []
    handlers = {n: signal.signal(n, lambda number, _: signals.append(number)) for n in STOPPING}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if signals:
            signal.raise_signal(signals[0])


@dataclass
class _Stops:
    """Handler of stop signals during a verb: raises them at once, or delays them."""

    handlers: dict[int, Callable[[int, FrameType | None], Any]]
    is_holding: bool = False
    is_stopped: bool = False
    signals: list[int] = field(default_factory=list)
    lost: BaseException | None = None  # stop that Python ignored

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.is_holding:
            self.signals.append(number)
        else:
            self.is_holding = self.is_stopped = True
            lost, self.lost = self.lost, None
            if lost is not None:
                raise lost.with_traceback(None)
            self.handlers[number](number, frame)

    def repeat_lost(self, ignored: sys.UnraisableHookArgs) -> None:
        """Raise a stop again soon after Python ignored it, as it does in `__del__` and in callbacks of imports."""
        if isinstance(ignored.exc_value, (KeyboardInterrupt, Terminated)):
            self.lost, self.is_holding = ignored.exc_value, False
            number = next(iter(self.handlers))
            threading.Timer(0.01, _thread.interrupt_main, (number,)).start()
        else:
            sys.__unraisablehook__(ignored)

    def release(self) -> None:
        """Raise the first delayed signal, unless a signal has already stopped the verb."""
        signals, self.signals = self.signals, []
        if signals and not self.is_stopped:
            signal.raise_signal(signals[0])


_stops: list[_Stops] = []  # handlers of the running verbs, the innermost last


@contextmanager
def one_stop() -> Iterator[None]:
    """Let the first stop signal end the verb's work, and delay later signals until the block ends.

    The verb can thus write its results. A signal that is ignored or has its default handler is not changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    stops = _Stops({number: handler for number in STOPPING if callable(handler := signal.getsignal(number))})
    for number in stops.handlers:
        signal.signal(number, stops)
    _stops.append(stops)
    hook, sys.unraisablehook = sys.unraisablehook, stops.repeat_lost
    try:
        yield
    finally:
        sys.unraisablehook = hook
        _stops.remove(stops)
        for number, handler in stops.handlers.items():
            signal.signal(number, handler)
        stops.release()


def hold_stops() -> None:
    """From now on delay also the first stop signal, while results are written."""
    if _stops and threading.current_thread() is threading.main_thread():
        _stops[-1].is_holding = True


def release_stops() -> None:
    """Raise a delayed signal, and let later signals stop the verb again."""
    if _stops and threading.current_thread() is threading.main_thread():
        _stops[-1].is_holding = False
        _stops[-1].release()


@contextmanager
def scratch_folder(beside: Path, prefix: str) -> Iterator[Path]:
    """Yield a new folder in `beside`, removed at the end. After a kill the next command removes the folder."""
    folder: ScratchFolder | None = None
    try:
        with delay_stops():
            folder = scratch(prefix, beside)
        yield folder.path
    finally:
        if folder is not None:
            with delay_stops():
                folder.remove()


def named_path(out: FilePath) -> Path:
    """Return the path of --out; raise InputError if it is blank, since a blank path would mean the current folder."""
    if not os.fspath(out).strip():
        raise InputError.at(Path("--out"), f"is blank; {NOT_BLANK}")
    return Path(out)


def path_from_here(path: FilePath) -> Path:
    """Return a path inside the current folder relative to it; return other paths unchanged."""
    path = Path(path)
    return path.relative_to(Path.cwd()) if path.is_absolute() and path.is_relative_to(Path.cwd()) else path


def check_folder(folder: Path) -> None:
    """Raise InputError if the path of an output folder is a file."""
    with suppress(OSError):  # A name that is too long is reported when the folder is made.
        if file := next((p for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None):
            raise InputError.at(folder, f"cannot be the folder for results: {file} is a file; give a folder as --out")


def check_writable(folder: Path, names: Sequence[str], read: Iterable[Path] = ()) -> None:
    """Create an output folder, and check that files can be written into it.

    Args:
        names: Files to write.
        read: Input files, which must not be overwritten.

    Raises:
        InputError: A file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        check_folder(folder)
        raise InputError.at(
            folder, f"cannot be the folder for results: {error.strerror}; give another folder as --out"
        ) from None
    paths, cure = [folder / name for name in names], "give another folder as --out"
    faults = [Fault(p, 0, 0, f"is a folder, but a file must be written there; {cure}") for p in paths if p.is_dir()]
    for source in dict.fromkeys(read):
        if source.is_file() and any(path.is_file() and source.samefile(path) for path in paths):
            faults.append(Fault(source, 0, 0, f"is an input and would be overwritten by results; {cure}"))
    if not os.access(folder, os.W_OK):
        faults.append(Fault(folder, 0, 0, f"cannot be written; {cure}"))
    refuse(faults)
