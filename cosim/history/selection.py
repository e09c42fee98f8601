"""Results named on a command line or in Python: by path, number, name or pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.base.errors import Fault, refuse
from cosim.base.suggestions import did_you_mean
from cosim.history.entries import Entry, entries, hides_results, match_entries
from cosim.history.numbers import unknown_number
from cosim.storage.folders import RESULTS

PATTERN = ("*", "?", "[")  # characters that make a text a pattern


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
        if self.entry is not None:
            return self.entry.short
        return self.path.resolve().name if self.path.is_dir() else self.path.stem

    @property
    def longer(self) -> str:
        """Return a name that says more: `run 3 (tank/0001)`, or the name of the path."""
        return self.short if self.entry is None else f"{self.short} ({self.entry.name})"


def select_results(texts: Sequence[str], results: Path | None = None) -> list[Selected]:
    """Return the results of paths, numbers, names and patterns such as `tank/*`, in this order.

    A path that exists is taken as a path, but for a folder without results that has the name of results. A pattern
    gives its matches by age, without results that are there already.

    Args:
        results: Folder of results, by default `results`.

    Raises:
        InputError: Every text that names no results.
    """
    return [selected for group in select_groups(texts, results) for selected in group]


def select_groups(texts: Sequence[str], results: Path | None = None) -> list[list[Selected]]:
    """Return the results of each text; see `select_results`."""
    root = RESULTS if results is None else results
    every = entries(root) if any(_may_be_entry(text, root) for text in texts) else []
    by_folder = {entry.folder.resolve(): entry for entry in every}
    faults: list[Fault] = []
    groups: list[list[Selected]] = []
    there: set[Path] = set()
    for text in texts:
        path = Path(text)
        matches = _matches(text, every, root)
        if path.exists() and not matches:
            group = [Selected(path, by_folder.get(path.resolve()))]
        else:
            if not matches:
                faults.append(Fault(path, 0, 0, _no_match(text, every, root)))
            several = len(matches) > 1
            new = [e for e in matches if not (several and e.folder.resolve() in there)]
            group = [Selected(entry.folder, entry, several) for entry in new]
        there |= {selected.path.resolve() for selected in group}
        groups.append(group)
    refuse(faults)
    return groups


def is_pattern(text: str) -> bool:
    """Return whether a text is a pattern."""
    return any(character in text for character in PATTERN)


def _may_be_entry(text: str, root: Path) -> bool:
    path = Path(text)
    return _may_be_name(path) or (root.is_dir() and root.resolve() in path.resolve().parents)


def _matches(text: str, every: Sequence[Entry], root: Path) -> list[Entry]:
    return match_entries(text, every, root) if _may_be_name(Path(text)) else []


def _may_be_name(path: Path) -> bool:
    return not path.exists() or hides_results(path)


def _no_match(text: str, every: Sequence[Entry], root: Path) -> str:
    """Return the message about a text that names no results."""
    if text.isdecimal() and every:
        return unknown_number(text, root)
    if is_pattern(text):
        return (
            "no results match; `cosim list` shows all"
            if every
            else "no results here; run a command without --out first, or name their folder as --results"
        )
    return (
        "no such folder or file; give the folder of a run, a table of its rows, or a number or name in `cosim "
        f"list`{did_you_mean(text, [entry.name for entry in every])}"
    )
