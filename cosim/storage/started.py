"""Record of a command that has begun, in its results folder until the command ends: a killed command leaves it.

The next command in the folder makes the record of a killed one the newest results, and keeps it among the earlier runs.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from cosim.base.scratch import LOCK, ScratchFolder, is_own, lock_descriptor, remove
from cosim.storage.files import delay_stops, write_json
from cosim.storage.folder_lock import before_release, is_pending, take_folder

STARTED = ".started"  # folder inside a results folder
START = "started.json"  # record of a command whose own record is written at its end only
RECORDS = ("manifest.json", "replay.json", START)
COMMAND, STATUS = "command", "status"  # keys of each record
KILLED = "killed before its end"  # the status, as soon as nobody holds the lock of the record


def write_start(folder: Path, record: str, content: Mapping[str, Any]) -> None:
    """Write the record of a command that begins.

    It is removed when the command ends, but not when it is killed. The command goes on without a record if the folder
    cannot be locked or written.

    Args:
        record: One of RECORDS.
    """
    place = folder / STARTED
    if not take_folder(folder) or is_pending(place):
        return
    with delay_stops(), suppress(OSError):
        place.mkdir()
        before_release(place, ScratchFolder(place).remove)
        write_json(place / record, content)


def is_killed(folder: Path) -> bool:
    """Return whether a locked folder has a killed command's record."""
    return not is_pending(folder / STARTED) and is_own(folder / STARTED, stat.S_ISDIR)


def bring_killed(folder: Path) -> None:
    """Move a killed command's record into its empty folder."""
    place = folder / STARTED
    for name in RECORDS:
        if is_own(place / name, stat.S_ISREG):
            (place / name).replace(folder / name)
    remove(place)


def is_running(place: Path) -> bool | None:
    """Return whether a command goes on; None if unknown."""
    try:
        lock = os.open(place / LOCK, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        return None
    try:
        lock_descriptor(lock)
    except OSError:
        return True
    finally:
        os.close(lock)
    return False
