"""Folders that go with the process that made them; where it was killed, the next one that looks takes them away."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import IO

LOCK = "in-use"
RETRIES, MOMENT = 10, 0.1  # [s]


class Held:
    """A folder that is locked while this process lives, so that no other takes it for a leftover."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # locked before it has the name that a sweep looks for: one that came in between would take the folder away
        fresh = path / (LOCK if os.name == "nt" else f"{LOCK}.new")
        self._stream = _locked(fresh)
        if self._stream is not None and os.name != "nt":
            fresh.rename(path / LOCK)

    def remove(self) -> None:
        """Take it away."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        remove(self.path)


def scratch(prefix: str, beside: Path | None = None) -> Held:
    """A folder within `beside`, a temporary one without; leftovers whose names begin as its name does go first."""
    sweep(beside or Path(tempfile.gettempdir()), prefix)
    return Held(Path(tempfile.mkdtemp(prefix=prefix, dir=beside)))


def sweep(folder: Path, prefix: str) -> None:
    """Take away folders that processes which were killed have left in a folder."""
    for path in folder.glob(f"{prefix}*"):
        if (path / LOCK).exists() and (stream := _locked(path / LOCK)) is not None:  # one without is being made
            stream.close()
            remove(path)


def remove(folder: Path) -> None:
    """Take away a folder, as far as that goes; a process that ends just now may still write there."""
    for _ in range(RETRIES):
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return
        time.sleep(MOMENT)


def _locked(path: Path) -> IO[bytes] | None:
    """The file, locked by us until it is closed; None where another process holds it or it cannot be had."""
    try:
        stream = path.open("ab")
    except OSError:
        return None
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
        else:
            import fcntl

            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        stream.close()
        return None
    return stream
