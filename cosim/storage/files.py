"""Text files written whole or not at all, also where the work is stopped, and what keeps them from being written."""

from __future__ import annotations

import json
import os
import signal
import stat
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

from cosim.base.drafts import draft_of, remove_drafts
from cosim.base.errors import Fault, InputError, refuse
from cosim.base.scratch import Held, scratch
from cosim.storage.folder_lock import take_folder

FilePath = str | os.PathLike[str]
NOT_BLANK = "give a name, or . for the current folder"
STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextmanager
def atomic_write(path: Path) -> Iterator[TextIO]:
    """Open a text file that takes the place of `path` only when the block ends without an error."""
    with draft_of(path) as draft, draft.open("w", encoding="utf-8", newline="") as stream:
        yield stream


def write_text(path: Path, text: str) -> None:
    """Write a text, whole or not at all."""
    with atomic_write(path) as stream:
        stream.write(text)


def write_json(path: Path, content: Any, *, indent: int = 2, allow_nan: bool = True) -> None:
    """Write JSON that ends in a line break, whole or not at all."""
    write_text(path, json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=allow_nan) + "\n")


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
    refuse(faults)


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


@dataclass
class _Stops:
    """What a verb does with a signal that is to stop it: raise it, or hold it back."""

    before: dict[int, Callable[[int, FrameType | None], Any]]
    holding: bool = False
    stopped: bool = False
    came: list[int] = field(default_factory=list)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.holding:
            self.came.append(number)
        else:
            self.holding = self.stopped = True
            self.before[number](number, frame)


_stops: list[_Stops] = []  # of the verbs that run, the inner ones last


@contextmanager
def one_stop() -> Iterator[None]:
    """Let the first signal stop a verb, and hold back later ones while the verb writes what it has.

    Signals whose default is to ignore them, or to end the process, are left alone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in STOPPING}
    stops = _Stops({number: handler for number, handler in handlers.items() if callable(handler)})
    for number in stops.before:
        signal.signal(number, stops)
    _stops.append(stops)
    try:
        yield
    finally:
        _stops.remove(stops)
        for number, handler in stops.before.items():
            signal.signal(number, handler)
        _raise_held(stops)


def hold_stops() -> None:
    """From now on hold back the first signal, too: there are results to be written."""
    if _stops and threading.current_thread() is threading.main_thread():
        _stops[-1].holding = True


def release_stops() -> None:
    """The results are written: raise the signal that was held back, and from now on every one."""
    if _stops and threading.current_thread() is threading.main_thread():
        _stops[-1].holding = False
        _raise_held(_stops[-1])


def _raise_held(stops: _Stops) -> None:
    """Raise the first signal that was held back, unless an earlier one has stopped the verb."""
    came, stops.came = stops.came, []
    if came and not stops.stopped:
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


def named_path(out: FilePath) -> Path:
    """Return the path that is named as --out; raise InputError if it is blank, which would be the current folder."""
    if not os.fspath(out).strip():
        raise InputError([Fault(Path("--out"), 0, 0, f"is blank; {NOT_BLANK}")])
    return Path(out)


def check_folder(folder: Path) -> None:
    """InputError where a file stands where a folder is to be made, or another command writes into the folder."""
    take_folder(folder)
    try:
        taken = next((p for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    except OSError:  # a name too long, which who makes it is told
        return
    if taken is not None:
        why = f"cannot be the folder for results: {taken} is a file; give a folder as --out"
        raise InputError([Fault(folder, 0, 0, why)])


def _is_kept_by_another(path: Path) -> bool:
    """Whether a file is in a folder as that for temporary files, where only its owner may replace it, and not ours."""
    if not hasattr(os, "geteuid") or not os.path.lexists(path):
        return False
    owner, folder = path.lstat().st_uid, path.parent.stat()
    return bool(folder.st_mode & stat.S_ISVTX) and os.geteuid() not in (0, owner, folder.st_uid)


def check_writable(folder: Path, names: Sequence[str], read: Iterable[Path] = ()) -> None:
    """Make and lock the folder and see that files of these names can be written there; InputError before any work.

    Drafts of these files that a killed command did not remove are removed.

    read: files that the work reads, which must not be what it writes.
    """
    if take_folder(folder):
        remove_drafts(folder, names)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        check_folder(folder)
        raise InputError([Fault(folder, 0, 0, f"cannot be the folder for results: {error.strerror}")]) from None
    paths = [folder / name for name in names]
    faults = []
    for path in paths:
        if path.is_dir():
            faults.append(Fault(path, 0, 0, "is a folder; a file is to be written there"))
        if _is_kept_by_another(path):
            why = "belongs to another user, and only its owner may replace it; give another folder as --out"
            faults.append(Fault(path, 0, 0, why))
    for source in dict.fromkeys(read):
        if source.is_file() and any(path.is_file() and source.samefile(path) for path in paths):
            why = "is read, and results would be written over it; give another folder as --out"
            faults.append(Fault(source, 0, 0, why))
    if not os.access(folder, os.W_OK):
        faults.append(Fault(folder, 0, 0, "cannot be written"))
    refuse(faults)
