"""Temporary folders owned by a process. The next command removes the folders of killed processes.

The folder for temporary files is shared with other users of the machine, so a folder's name does not identify its
owner. Only folders of this user with a plain lock file of this user are locked or removed.
"""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOCK = "in-use"
SCRATCH_PREFIX = "cosim-"  # of each folder in the machine's temporary folder
RETRIES, RETRY_PAUSE_S = 10, 0.1  # [s]


class ScratchFolder:
    """A temporary folder, locked while this process runs, so that no other process removes it."""

    def __init__(self, path: Path) -> None:
        self.path, self._pid = path, os.getpid()
        # Lock before renaming to the final name: a sweep between creation and locking would remove the folder.
        fresh = path / (LOCK if os.name == "nt" else f"{LOCK}.new")
        self._lock = lock_file(fresh, create=True)
        if self._lock is not None and os.name != "nt":
            fresh.rename(path / LOCK)

    def remove(self) -> None:
        """Remove the folder, unless this process is a fork of the owner."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        if self._pid == os.getpid():
            remove(self.path)


def scratch(prefix: str, beside: Path | None = None) -> ScratchFolder:
    """Return a new locked folder in `beside`, by default in the system's temporary folder; remove abandoned ones."""
    sweep(beside or Path(tempfile.gettempdir()), prefix if beside else SCRATCH_PREFIX)
    return ScratchFolder(Path(tempfile.mkdtemp(prefix=prefix, dir=beside)))


_folders: dict[tuple[int, str], ScratchFolder] = {}


def process_folder() -> Path:
    """Return the temporary folder of this process. It is removed at exit; after a kill, the next command removes it."""
    key = os.getpid(), tempfile.gettempdir()
    if key not in _folders or not _folders[key].path.is_dir():
        _folders[key] = scratch(SCRATCH_PREFIX)
        atexit.register(_folders[key].remove)
    return _folders[key].path


@contextmanager
def temporary_folder(name: str) -> Iterator[Path]:
    """Yield a new folder, removed after the `with` block."""
    with tempfile.TemporaryDirectory(prefix=f"{name}-", dir=process_folder(), ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def sweep(folder: Path, prefix: str) -> None:
    """Remove folders of this user whose process was killed."""
    try:
        paths = [folder / name for name in os.listdir(folder) if name.startswith(prefix)]
    except OSError:  # The folder may be writable but not readable.
        return
    for path in paths:
        with suppress(OSError):  # removed meanwhile
            # A folder without a lock file is under construction.
            if _is_own(os.lstat(path), stat.S_ISDIR) and (lock := lock_file(path / LOCK)) is not None:
                os.close(lock)
                remove(path)


def remove(folder: Path) -> None:
    """Remove a folder; try again for a while, because a dying process may still write into the folder."""
    for _ in range(RETRIES):
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return
        time.sleep(RETRY_PAUSE_S)


def lock_file(path: Path, *, create: bool = False) -> int | None:
    """Lock a file until its descriptor is closed.

    Returns:
        The descriptor; None if another process has locked the file, or if the path is not a plain file of this user. A
        pipe does not block the call, and links are not followed.
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
            if sys.platform == "win32":
                import msvcrt

                msvcrt.locking(lock, msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return lock
    os.close(lock)
    return None


def _is_own(status: os.stat_result, of_kind: Callable[[int], bool]) -> bool:
    return of_kind(status.st_mode) and (not hasattr(os, "geteuid") or status.st_uid == os.geteuid())
