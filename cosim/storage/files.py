"""Text files written completely or not at all, stop signals, and checks of output folders."""

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
    """Open a text file that replaces `path` after success."""
    with draft_of(path) as draft, draft.open("w", encoding="utf-8", newline="") as stream:
        yield stream


def write_text(path: Path, text: str) -> None:
    """Write a text completely or not at all."""
    with atomic_write(path) as stream:
        stream.write(text)


def write_json(path: Path, content: Any, *, indent: int = 2, allow_nan: bool = True) -> None:
    """Write JSON with a final line break, completely or not at all."""
    write_text(path, json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=allow_nan) + "\n")


def check_text(names: Iterable[str]) -> None:
    """Raise InputError for names that are not valid text.

    A folder of a machine with another encoding may have such names.
    """
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
    """Delay stop signals to the end of the block."""
    if threading.current_thread() is not threading.main_thread():  # Only the main thread receives signals.
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
    """Handling of stop signals by a verb: raise or hold back."""

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


_stops: list[_Stops] = []  # of the running verbs, the innermost last


@contextmanager
def one_stop() -> Iterator[None]:
    """Let the first signal stop a verb, and hold back later ones.

    The verb can then write its results. Signals that are ignored or end the process by default are left alone.
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
    """Hold back the first signal too, because results must be written."""
    if _stops and threading.current_thread() is threading.main_thread():
        _stops[-1].holding = True


def release_stops() -> None:
    """Raise a held signal, and let later signals stop the verb."""
    if _stops and threading.current_thread() is threading.main_thread():
        _stops[-1].holding = False
        _raise_held(_stops[-1])


def _raise_held(stops: _Stops) -> None:
    """Raise the first held signal, unless the verb was already stopped."""
    came, stops.came = stops.came, []
    if came and not stops.stopped:
        signal.raise_signal(came[0])


@contextmanager
def scratch_folder(beside: Path, prefix: str) -> Iterator[Path]:
    """Yield a new folder in `beside`, removed at the end. After a kill the next command removes the folder."""
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
    """Return the path given as --out; raise InputError if blank, which would mean the current folder."""
    if not os.fspath(out).strip():
        raise InputError([Fault(Path("--out"), 0, 0, f"is blank; {NOT_BLANK}")])
    return Path(out)


def check_folder(folder: Path) -> None:
    """Raise InputError if a file or another command blocks a folder."""
    take_folder(folder)
    try:
        taken = next((p for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    except OSError:  # The maker of the folder reports a name that is too long.
        return
    if taken is not None:
        why = f"cannot be the folder for results: {taken} is a file; give a folder as --out"
        raise InputError([Fault(folder, 0, 0, why)])


def _is_kept_by_another(path: Path) -> bool:
    """Return whether only another owner may replace a file. Folders such as the temporary folder have this rule."""
    if not hasattr(os, "geteuid") or not os.path.lexists(path):
        return False
    owner, folder = path.lstat().st_uid, path.parent.stat()
    return bool(folder.st_mode & stat.S_ISVTX) and os.geteuid() not in (0, owner, folder.st_uid)


def check_writable(folder: Path, names: Sequence[str], read: Iterable[Path] = ()) -> None:
    """Prepare a folder for writing files, and lock it.

    Drafts of killed commands are removed.

    Args:
        read: Input files, which must not be overwritten.

    Raises:
        InputError: A file cannot be written.
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
