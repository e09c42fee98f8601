"""Locks on results folders: two commands never write into the same folder at the same time.

The lock is on a hidden file in the folder, removed at the end. A file of a killed process is taken over. Only users
with write access to the folder can open the file, so that mere readers cannot hold the lock. A disk without locks is
written unlocked.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from cosim.base.errors import InputError
from cosim.base.scratch import lock_descriptor

LOCK_FILE = ".cosim-lock"
BUSY = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)  # error numbers of a lock held by another process
NO_LINK = getattr(os, "O_NOFOLLOW", 0)


@dataclass
class _Locks:
    """Locks of the running verb: descriptors of locked folders, folders made for locking, and actions at the end."""

    descriptors: dict[Path, int] = field(default_factory=dict)
    new_folders: list[Path] = field(default_factory=list)
    ends: dict[Path, Callable[[], None]] = field(default_factory=dict)

    def release(self) -> None:
        """Do the final actions, tidy up and end the locks."""
        for action in self.ends.values():
            with suppress(OSError):
                action()
        for folder, lock in self.descriptors.items():
            with suppress(OSError):
                if os.name == "nt":  # Windows cannot remove an open file.
                    os.close(lock)
                (folder / LOCK_FILE).unlink(missing_ok=True)
        for folder in reversed(self.new_folders):
            with suppress(OSError):
                folder.rmdir()
        for lock in self.descriptors.values():
            with suppress(OSError):
                os.close(lock)


_locks: ContextVar[_Locks | None] = ContextVar("folder locks", default=None)


@contextmanager
def folder_locks() -> Iterator[None]:
    """Hold folder locks until the end of a verb.

    An inner verb shares the locks of the outer verb. A folder made for its lock is removed if empty.
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


def before_release(path: Path, action: Callable[[], None]) -> None:
    """Do an action before the verb's locks end."""
    if (locks := _locks.get()) is not None:
        locks.ends[path.resolve()] = action


def is_pending(path: Path) -> bool:
    """Return whether the verb has an action for a path."""
    locks = _locks.get()
    return locks is not None and path.resolve() in locks.ends


def release_early(path: Path) -> None:
    """Do the action on a path now, if any."""
    locks = _locks.get()
    if locks is not None and (action := locks.ends.pop(path.resolve(), None)) is not None:
        action()


def take_folder(folder: Path) -> bool:
    """Lock a folder for the running verb.

    Missing folders are made. The caller reports a folder that cannot be made.

    Returns:
        Whether the folder is locked.

    Raises:
        InputError: Another command is writing into the folder.
    """
    locks = _locks.get()
    if locks is None:
        return False
    try:
        path = folder.resolve()
        if path in locks.descriptors:
            return True
        lock: int | None = None
        while lock is None or not _is_of(lock, path):  # Another command may just have removed the folder.
            for missing in [p for p in (*reversed(path.parents), path) if not p.exists()]:
                missing.mkdir(exist_ok=True)
                locks.new_folders.append(missing)
            if (lock := _lock(path)) is None:
                return False
            locks.descriptors[path] = lock
    except BlockingIOError:
        raise InputError.at(
            folder, "another command writes into this folder now; wait for its end, or give another folder as --out"
        ) from None
    except (OSError, ValueError):
        return False
    return True


def _lock(folder: Path) -> int | None:
    """Lock a folder and return the descriptor of its lock file; None if no lock is possible.

    Raises:
        BlockingIOError: Another process holds the lock.
    """
    try:
        lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | NO_LINK, 0o600)
    except OSError:  # no write access to the folder, or a private file of another user
        return None
    try:
        if not _is_shared_with_writers(lock, folder):
            os.close(lock)
            return None
        lock_descriptor(lock)
    except OSError as error:
        os.close(lock)
        if error.errno in BUSY:
            raise BlockingIOError from None
        with suppress(OSError):
            (folder / LOCK_FILE).unlink()
        return None
    return lock


def _is_shared_with_writers(lock: int, folder: Path) -> bool:
    """Share an own lock file with the folder's writers.

    Returns:
        False for a lock file of an untrusted user.
    """
    own, place = os.fstat(lock), folder.stat()
    if not stat.S_ISREG(own.st_mode):
        return False
    if sys.platform == "win32":
        return True
    if own.st_uid == os.geteuid() and own.st_nlink == 1:  # never the mode of a file with another name
        with suppress(OSError):  # a disk without permissions
            os.fchown(lock, -1, place.st_gid)
        writers = place.st_mode & 0o222
        with suppress(OSError):
            os.fchmod(lock, writers | writers << 1)
    # In a sticky folder, e.g. the temporary one, anybody may leave a file.
    return own.st_uid in (os.geteuid(), place.st_uid, 0) or not place.st_mode & stat.S_ISVTX


def _is_of(lock: int, folder: Path) -> bool:
    """Return whether a lock is the folder's; else close it."""
    path = folder / LOCK_FILE
    if path.exists() and os.path.samestat(os.fstat(lock), path.stat()):
        return True
    os.close(lock)
    return False
