"""Locks on folders for results: two commands never write into one folder at the same time.

The lock is on a hidden file in the folder, which is removed at the end; one that a killed process left is taken over.
Only those who may write into the folder may open the file: who can merely read the folder cannot hold its lock. A disk
without any locks is written without one.
"""

from __future__ import annotations

import errno
import os
import stat
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
        """Remove the files of the locks and folders that were made and are empty, and end the locks, in this order."""
        for folder, lock in self.held.items():
            with suppress(OSError):
                if os.name == "nt":  # an open file cannot be removed there
                    os.close(lock)
                (folder / LOCK_FILE).unlink(missing_ok=True)
        for folder in reversed(self.made):
            with suppress(OSError):
                folder.rmdir()
        for lock in self.held.values():
            with suppress(OSError):
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
    """Return the descriptor that holds a folder, None if it cannot be locked; raise BlockingIOError if held."""
    try:
        lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | NO_LINK, 0o600)
    except OSError:  # a folder that may not be written, or a file of somebody who keeps it to himself
        return None
    try:
        if not _is_shared_with_writers(lock, folder):
            os.close(lock)
            return None
        lock_descriptor(lock)
    except OSError as error:
        os.close(lock)
        if error.errno in HELD:
            raise BlockingIOError from None
        with suppress(OSError):
            (folder / LOCK_FILE).unlink()
        return None
    return lock


def _is_shared_with_writers(lock: int, folder: Path) -> bool:
    """Give an own file the permissions of who may write into the folder; False if a stranger's is not to trust."""
    own, place = os.fstat(lock), folder.stat()
    if not stat.S_ISREG(own.st_mode):
        return False
    if not hasattr(os, "geteuid"):
        return True
    if own.st_uid == os.geteuid():
        with suppress(OSError):  # a disk without permissions
            os.fchown(lock, -1, place.st_gid)
        writers = place.st_mode & 0o222
        with suppress(OSError):
            os.fchmod(lock, writers | writers << 1)
    # in a folder as that for temporary files anybody may leave a file
    return own.st_uid in (os.geteuid(), place.st_uid, 0) or not place.st_mode & stat.S_ISVTX


def _is_of(lock: int, folder: Path) -> bool:
    """Whether a lock is still on the hidden file in the folder of this name; closed if not."""
    path = folder / LOCK_FILE
    if path.exists() and os.path.samestat(os.fstat(lock), path.stat()):
        return True
    os.close(lock)
    return False
