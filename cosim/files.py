"""Text files written whole or not at all, also where the work is stopped, and what keeps them from being written."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from cosim.errors import Fault, InputError
from fmus.files import draft_of, is_full
from fmus.scratch import Held, scratch

__all__ = [
    "FilePath",
    "atomic_write",
    "check_folder",
    "check_text",
    "check_writable",
    "is_full",
    "scratch_folder",
    "uninterrupted",
]

FilePath = str | os.PathLike[str]
STOPPING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def atomic_write(path: Path) -> Iterator[TextIO]:
    """Open a text file that takes the place of `path` only when the block ends without an error."""
    with draft_of(path) as draft, draft.open("w", encoding="utf-8", newline="") as stream:
        yield stream


def check_text(names: Iterable[str]) -> None:
    """InputError where a name is no text, as of a folder from a machine of another encoding: no file can tell it."""
    faults = []
    for name in names:
        try:
            name.encode()
        except UnicodeEncodeError:
            try:
                os.fsencode(name).decode()
                cure = "cannot be read in the locale of this shell; set PYTHONUTF8=1, or LC_ALL=C.UTF-8"
            except UnicodeDecodeError:
                cure = "is not UTF-8 text; give the file or folder another name"
            faults.append(Fault(Path(name), 0, 0, cure))
    if faults:
        raise InputError(faults)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Nothing stops the block half-way: a signal that would waits for its end."""
    if threading.current_thread() is not threading.main_thread():  # which alone gets them
        yield
        return
    came: list[int] = []
    handlers = {number: signal.signal(number, lambda n, frame: came.append(n)) for number in STOPPING}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if came:
            signal.raise_signal(came[0])


@contextmanager
def scratch_folder(beside: Path, prefix: str) -> Iterator[Path]:
    """Make a folder within `beside` that is removed at the end, or by the next command after a kill."""
    made: Held | None = None
    try:
        with uninterrupted():
            made = scratch(prefix, beside)
        yield made.path
    finally:
        with uninterrupted():
            if made is not None:
                made.remove()


def check_folder(folder: Path) -> None:
    """InputError where a file stands where a folder is to be made; nothing is made."""
    try:
        taken = next((p for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    except OSError:  # a name too long, which who makes it is told
        return
    if taken is not None:
        why = f"cannot be the folder for results: {taken} is a file; give a folder as --out"
        raise InputError([Fault(folder, 0, 0, why)])


def check_writable(folder: Path, names: Sequence[str], read: Iterable[Path] = ()) -> None:
    """Make the folder and see that files of these names can be written there; InputError before any work is done.

    read: files that the work reads, which must not be what it writes.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        check_folder(folder)
        raise InputError([Fault(folder, 0, 0, f"cannot be the folder for results: {error.strerror}")]) from None
    faults = [
        Fault(folder / n, 0, 0, "is a folder; a file is to be written there") for n in names if (folder / n).is_dir()
    ]
    written = [path for n in names if (path := folder / n).is_file()]
    faults += [
        Fault(path, 0, 0, "is read, and results would be written over it; give another folder as --out")
        for path in dict.fromkeys(read)
        if path.is_file() and any(path.samefile(other) for other in written)
    ]
    if not os.access(folder, os.W_OK):
        faults.append(Fault(folder, 0, 0, "cannot be written"))
    if faults:
        raise InputError(faults)
