"""Temporary folders that belong to one process; the next command removes the folders of a process that was killed.

The folder for temporary files is shared with other users of the machine. Nothing in it is trusted by its name: only a
folder of this user, with a plain lock file of this user in it, is ever locked or removed.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCK = "in-use"
PREFIX = "cosim-"  # of every folder among the temporary files of the machine
RETRIES, PAUSE = 10, 0.1  # [s]


class Held:
    """A folder that is locked while this process lives, so that no other process removes it."""

    def __init__(self, path: Path) -> None:
        self.path, self._pid = path, os.getpid()
        # locked before it has the name that a sweep looks for: one that came in between would remove the folder
        fresh = path / (LOCK if os.name == "nt" else f"{LOCK}.new")
        self._lock = locked(fresh, create=True)
        if self._lock is not None and os.name != "nt":
            fresh.rename(path / LOCK)

    def remove(self) -> None:
        """Remove the folder, unless this process is a fork of its owner."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        if self._pid == os.getpid():
            remove(self.path)


def scratch(prefix: str, beside: Path | None = None) -> Held:
    """Make a locked folder in `beside`, by default among the temporary files, after a sweep of that place."""
    if beside is None:
        sweep(Path(tempfile.gettempdir()), PREFIX)
    else:
        sweep(beside, prefix)
    return Held(Path(tempfile.mkdtemp(prefix=prefix, dir=beside)))


_folders: dict[tuple[int, str], Held] = {}


def process_folder() -> Path:
    """Return the folder for all temporary files of this process; it is removed at exit, or swept after a kill."""
    key = os.getpid(), tempfile.gettempdir()
    if key not in _folders or not _folders[key].path.is_dir():
        _folders[key] = held = scratch(PREFIX)
        atexit.register(held.remove)
    return _folders[key].path


@contextmanager
def temporary_folder(name: str) -> Iterator[Path]:
    """Make a folder in the process folder that is removed at the end of the block."""
    with tempfile.TemporaryDirectory(prefix=f"{name}-", dir=process_folder(), ignore_cleanup_errors=True) as made:
        yield Path(made)


def sweep(folder: Path, prefix: str) -> None:
    """Remove the folders of this user that killed processes did not remove."""
    try:
        names = [name for name in os.listdir(folder) if name.startswith(prefix)]
    except OSError:  # the folder may be written but not listed
        return
    for path in (folder / name for name in names):
        if not is_own(path, stat.S_ISDIR):
            continue
        lock = locked(path / LOCK)  # a folder without one is being made
        if lock is not None:
            os.close(lock)
            remove(path)


def remove(folder: Path) -> None:
    """Remove a folder, as far as possible; a process that ends just now may still write there."""
    for _ in range(RETRIES):
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return
        time.sleep(PAUSE)


def is_own(path: Path, of_kind: Callable[[int], bool]) -> bool:
    """Whether a path itself, and not the target of a link, is of this kind and belongs to this user."""
    try:
        return _is_own(os.lstat(path), of_kind)
    except OSError:
        return False


def locked(path: Path, *, create: bool = False) -> int | None:
    """Open a lock file and lock it until the descriptor is closed; None if another process holds it.

    None, too, for anything but a plain file of this user: a pipe is not waited for, a link is not followed.
    """
    flags = os.O_RDWR | (os.O_CREAT if create else 0)
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"):
        flags |= getattr(os, name, 0)
    try:
        lock = os.open(path, flags, 0o600)
    except OSError:
        return None
    with suppress(OSError):
        if _is_own(os.fstat(lock), stat.S_ISREG):
            lock_descriptor(lock)
            return lock
    os.close(lock)
    return None


def lock_descriptor(descriptor: int) -> None:
    """Lock an open file for this process alone; raise OSError if another process holds it or it cannot be locked."""
    if os.name == "nt":
        import msvcrt

        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _is_own(status: os.stat_result, of_kind: Callable[[int], bool]) -> bool:
    return of_kind(status.st_mode) and (not hasattr(os, "geteuid") or status.st_uid == os.geteuid())
