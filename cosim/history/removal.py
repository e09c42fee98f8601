"""Removal of earlier runs."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from cosim.base.errors import Fault
from cosim.history.entries import Entry
from cosim.storage.folder_lock import folder_locks, take_folder
from cosim.storage.folders import note_last_number

DAY = 86_400.0  # [s]


@dataclass(frozen=True)
class Removal:
    """Earlier runs to remove, or removed, and their size in bytes.

    Attributes:
        warnings: Warnings about runs that were gone already.
        faults: Reasons why runs cannot be removed.
    """

    entries: tuple[Entry, ...]
    size: int
    warnings: tuple[str, ...] = ()
    faults: tuple[Fault, ...] = ()


def plan_removal(
    entries: Sequence[Entry], *, keep: int = 0, older: float = 0.0, chosen: Iterable[Entry] | None = None
) -> Removal:
    """Return the earlier runs to remove; the newest results of a name stay.

    Args:
        entries: All results, the oldest first.
        keep: Number of earlier runs of each name that stay: the latest ones.
        older: Age [days] from which a run is removed.
        chosen: Entries that may be removed; by default all.
    """
    by_name: dict[str, list[Entry]] = {}
    for entry in entries:
        if not entry.is_newest:
            by_name.setdefault(entry.of, []).append(entry)
    limit = time.time() - DAY * older
    names = {entry.name for entry in (entries if chosen is None else chosen)}
    outdated = [e for runs in by_name.values() for e in runs[: max(0, len(runs) - keep)] if e.time <= limit]
    removed = tuple(entry for entry in outdated if entry.name in names)
    return Removal(removed, sum(_size(entry.folder) for entry in removed))


@folder_locks()
def remove(entries: Iterable[Entry]) -> Removal:
    """Remove earlier runs while no command writes to their results."""
    removed, size, warnings, faults = list[Entry](), 0, list[str](), list[Fault]()
    for entry in entries:
        if not entry.folder.is_dir():
            warnings.append(f"{entry.folder} is gone already")
            continue
        take_folder(entry.folder.parent.parent)
        try:
            taken = _size(entry.folder)
            note_last_number(entry.folder.parent)
            shutil.rmtree(entry.folder)
            removed.append(entry)
            size += taken
        except OSError as error:
            faults.append(Fault(entry.folder, 0, 0, f"cannot be removed: {error.strerror or error}"))
    return Removal(tuple(removed), size, tuple(warnings), tuple(faults))


def _size(folder: Path) -> int:
    total = 0
    for place, _, files in os.walk(folder):
        for name in files:
            with suppress(OSError):
                total += os.lstat(os.path.join(place, name)).st_size
    return total
