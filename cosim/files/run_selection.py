"""Results named on a command line or in Python by path, number, name or pattern, and the removal of earlier runs."""

from __future__ import annotations

import fnmatch
import os
import shutil
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from cosim.core.errors import Fault, InputError, refuse
from cosim.core.text import did_you_mean
from cosim.files.folders import INTERRUPTED, RESULTS, has_results, newest_run, run_name, state_of
from cosim.files.run_entries import Entry, entries, numbered_lines

PATTERN = ("*", "?", "[")  # characters that make a text a pattern
DAY = 86_400.0  # [s]


@dataclass(frozen=True)
class Selected:
    """Results that a text names.

    Attributes:
        path: Folder of a command, or a table of rows.
        entry: Entry of the folder of results; None for other paths.
        by_pattern: Whether a pattern matched, so that results without rows may be left out.
    """

    path: Path
    entry: Entry | None = None
    by_pattern: bool = False

    @property
    def short(self) -> str:
        """Return a short name: `run 3`, or the name of the path."""
        own = run_name(self.path) if self.path.is_dir() else self.path.stem
        return own if self.entry is None else self.entry.short

    @property
    def longer(self) -> str:
        """Return a name that says more: `run 3 (tank/0001)`, or the name of the path."""
        return self.short if self.entry is None else f"{self.short} ({self.entry.name})"


def select_results(texts: Sequence[str], results: Path | None = None) -> list[Selected]:
    """Return the results of paths, numbers, names and patterns such as `tank/*`, in this order.

    A path that exists is taken as a path, but for a folder without results that has the name of results. A folder of
    numbered runs, or its name, means the newest of them. A pattern gives its matches by age, without results that are
    there already.

    Args:
        results: Folder of results, by default `results`.

    Raises:
        InputError: Every text that names no results.
    """
    return [selected for group in select_groups(texts, results) for selected in group]


def select_groups(texts: Sequence[str], results: Path | None = None) -> list[list[Selected]]:
    """Return the results of each text; see `select_results`."""
    root = RESULTS if results is None else results
    inside = root.resolve() if root.is_dir() else None
    is_entry = (not Path(text).is_file() or inside in Path(text).resolve().parents for text in texts)
    every = entries(root) if any(is_entry) else []
    by_folder = {entry.folder.resolve(): entry for entry in every}
    faults: list[Fault] = []
    groups: list[list[Selected]] = []
    there: set[Path] = set()
    for text in texts:
        path = newest_run(Path(text))
        group: list[Selected] = []
        if path.exists() and (not path.is_dir() or has_results(path)):
            group = [Selected(path, by_folder.get(path.resolve()))]
        elif matches := match_entries(text, every, root):
            several = len(matches) > 1
            new = [e for e in matches if not (several and e.folder.resolve() in there)]
            group = [Selected(entry.folder, entry, several) for entry in new]
        elif path.exists():
            group = [Selected(path)]
        else:
            faults.append(Fault(path, 0, 0, _no_match(text, every, root)))
        there |= {selected.path.resolve() for selected in group}
        groups.append(group)
    refuse(faults)
    return groups


def find_entries(texts: Sequence[str] | None, results: Path) -> list[Entry]:
    """Return the entries of numbers, names and patterns, in this order, each once; without texts all of a folder.

    Raises:
        InputError: A text matches no entry, or the folder is not the default one and not there.
    """
    if results != RESULTS and not results.is_dir():
        raise InputError.at(results, "no such folder; give the folder that has the results as --results")
    every = entries(results)
    if not texts:
        return every
    found: dict[str, Entry] = {}
    for text in texts:
        matches = match_entries(text, every, results)
        if not matches:
            raise InputError.at(Path(text), _no_match(text, every, results))
        found |= {entry.name: entry for entry in matches}
    return [*found.values()]


def match_entries(text: str, every: Sequence[Entry], root: Path = RESULTS) -> list[Entry]:
    """Return the entries of a name, a number, a pattern or a folder within the folder of results.

    The name of several runs means the newest.
    """
    if text.isdecimal() and not any(e.name == text for e in every):
        return [e for e in every if str(e.number) == text.lstrip("0")]
    if "/" in text and (folder := Path(text)).is_dir():
        place = newest_run(folder).resolve()
        return [e for e in every if e.folder.resolve() == place]
    name = text.removeprefix(f"{root}/").rstrip("/")
    exact = [e for e in every if e.of == name and e.is_newest] or [e for e in every if e.name == name]
    return exact or [e for e in every if fnmatch.fnmatchcase(e.name, name)]


def _no_match(text: str, every: Sequence[Entry], root: Path) -> str:
    """Return the message about a text that names no results."""
    if text.isdecimal() and every:
        known = {number: name for name, number in numbered_lines(root).items()}
        if (name := known.get(int(text))) is not None:
            return f"the results with the number {text}, {name}, were removed; `cosim list` shows all"
        return f"no results with the number {text}; `cosim list` shows the numbers, up to {max(known, default=0)}"
    is_pattern = any(character in text for character in PATTERN)
    if not every and (is_pattern or text.isdecimal()):
        return "no results here; run a command without --out first, or name their folder as --results"
    if is_pattern:
        return "no results match; `cosim list` shows all"
    hint = did_you_mean(text, [name for entry in every for name in (entry.of, entry.name)])
    return (
        "no such folder or file; give the folder of a run, a table of its rows, or a number or name in "
        f"`cosim list`{hint}"
    )


# -- removal --------------------------------------------------------------------------------------


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
    """Return the earlier runs to remove; the newest results of a name stay, and runs that go on.

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
    around = {folder for entry in entries for folder in entry.folder.parents}  # of other results
    idle = [e for e in outdated if state_of(e.folder) in {"", INTERRUPTED} and e.folder not in around]
    removed = tuple(entry for entry in idle if entry.name in names)
    return Removal(removed, sum(_size(entry.folder) for entry in removed))


def remove(entries: Iterable[Entry]) -> Removal:
    """Remove earlier runs."""
    removed, size, warnings, faults = list[Entry](), 0, list[str](), list[Fault]()
    for entry in entries:
        if not entry.folder.is_dir():
            warnings.append(f"{entry.folder} is gone already")
            continue
        taken = _size(entry.folder)
        try:
            shutil.rmtree(entry.folder)
        except OSError as error:
            faults.append(Fault(entry.folder, 0, 0, f"cannot be removed: {error.strerror or error}"))
            continue
        removed.append(entry)
        size += taken
    return Removal(tuple(removed), size, tuple(warnings), tuple(faults))


def _size(folder: Path) -> int:
    total = 0
    for place, _, files in os.walk(folder):
        for name in files:
            with suppress(OSError):
                total += os.lstat(os.path.join(place, name)).st_size
    return total
