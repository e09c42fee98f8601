"""Locks on folders for results: two commands never write into one folder at the same time.

The lock is on the folder itself and ends with the process, however that ends: no file of it is left. Only where a
folder cannot be locked, as on Windows and some network disks, the lock is on a hidden file in it. A disk without any
locks is written without one.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from cosim.base.errors import Fault, InputError
from cosim.base.scratch import lock_descriptor

LOCK_FILE = ".cosim-lock"
HELD = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)  # by another process, as systems say it
NO_LINK = getattr(os, "O_NOFOLLOW", 0)


@dataclass
class _Locks:
    """What the verb that runs holds: a descriptor of each locked folder, and folders made for that."""

    held: dict[Path, int] = field(default_factory=dict)
    made: list[Path] = field(default_factory=list)

    def release(self) -> None:
        """Remove folders that were made and are empty, and end the locks, in this order."""
        for folder in reversed(self.made):
            with suppress(OSError):
                folder.rmdir()
        for lock in self.held.values():
            os.close(lock)


_locks: ContextVar[_Locks | None] = ContextVar("folder locks", default=None)


@contextmanager
def folder_locks() -> Iterator[None]:
    """Hold the folders that a verb takes until it ends; a verb that another one calls shares the locks of that one.

    A folder that was made for the lock, and is empty at the end, is removed.
    """
    if _locks.get() is not None:
        yield
        return
    locks = _Locks()
    outer = _locks.set(locks)
    try:
        yield
    finally:
        _locks.reset(outer)
        locks.release()


def take_folder(folder: Path) -> bool:
    """Lock a folder for the verb that runs, made if missing; True if it is locked.

    Raises InputError if another command writes there. A folder that cannot be made is no fault yet.
    """
    locks = _locks.get()
    if locks is None:
        return False
    try:
        path = folder.resolve()
        if path in locks.held:
            return True
        lock: int | None = None
        while lock is None or not _is_of(lock, path):  # another command may just have removed it
            for missing in [p for p in (*reversed(path.parents), path) if not p.exists()]:
                missing.mkdir(exist_ok=True)
                locks.made.append(missing)
            if (lock := _lock(path)) is None:
                return False
            locks.held[path] = lock
    except BlockingIOError:
        cure = "wait for its end, or give another folder as --out"
        raise InputError([Fault(folder, 0, 0, f"another command writes into this folder now; {cure}")]) from None
    except (OSError, ValueError):
        return False
    return True


def _lock(folder: Path) -> int | None:
    """Return the descriptor that holds a folder, None on a disk without locks; raise BlockingIOError if it is held."""
    for path, flags in ((folder, os.O_RDONLY), (folder / LOCK_FILE, os.O_RDWR | os.O_CREAT)):
        try:
            lock = os.open(path, flags | NO_LINK, 0o600)
        except OSError:  # a folder that may be written but not read, and Windows, which opens none
            continue
        try:
            lock_descriptor(lock)
            return lock
        except OSError as error:
            os.close(lock)
            if error.errno in HELD:
                raise BlockingIOError from None
    return None


def _is_of(lock: int, folder: Path) -> bool:
    """Whether a lock is still on the folder of this name, or on the hidden file in it."""
    own = os.fstat(lock)
    places = (folder, folder / LOCK_FILE)
    if any(place.exists() and os.path.samestat(own, place.stat()) for place in places):
        return True
    os.close(lock)
    return False
