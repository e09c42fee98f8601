"""Runs shown in the signal browser: results by number, name or pattern, folders and tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.core.drafts import is_full
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.messages import Note
from cosim.core.text import counted
from cosim.files.artefact import LOG
from cosim.files.folders import manifest_in, replay_record, run_name, status_in, warnings_on
from cosim.files.kinds import check_given, refuse_folder
from cosim.files.results import rows_in
from cosim.files.run_entries import Entry, Selected, entries, select_groups
from cosim.pages.rows import TIME_COLUMN, Recording, open_rows
from cosim.simulation.run_signals import RUN_OR_TABLE
from cosim.sweeps.store import SWEEP_TABLE, read_runs

NO_ROWS = "has no rows to draw{status}; give folders of runs, or tables with time in the first column"
FILE_LOST = "{label} was removed or replaced; the rows that were read stay"
MAX_VIEWED = 20  # results listed by name in a message
FILE_CHECK_INTERVAL_S = 1.0  # [s] between checks of a file
REREAD_INTERVAL_RATIO = 5.0  # time between readings of a growing file, as a multiple of the reading time
NO_COLUMNS: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class RunPlace:
    """A table of rows that the page can show, with its names.

    Attributes:
        name: Name in layouts, the same for later runs of the same series.
        label: Unique name on the page.
        is_named: True if the user named this table, so that its faults are errors.
        columns: Column of the table → name of its signal, or `time`, of columns with another name.
        rows: Rows in memory, for a run of a sweep, because the table of a sweep has no column of time.
        display: Unit → name of its display unit, factor and offset to its values, of these rows.
    """

    name: str
    label: str
    file: Path
    is_named: bool = True
    columns: Mapping[str, str] = field(default_factory=dict)
    rows: Recording | None = None
    display: Mapping[str, Any] = field(default_factory=dict)


class ViewedRun:
    """A run on the page, whose file may grow.

    Args:
        rows: Rows that another object appends to; by default those of the file.

    Attributes:
        record: Manifest of the run, or the record of a replay, with the display units.
        notes: Warnings on its rows.
        lost: Reason why no more rows are read; "" otherwise.

    Raises:
        InputError: The table has faults, or no rows.
    """

    def __init__(self, place: RunPlace, rows: Recording | None = None) -> None:
        self.place, self.lost, self.notes, self.record = place, "", list[str](), dict[str, Any](display=place.display)
        self._due = 0.0  # [s] next time at which a growing file may be read again
        self._state, self._is_fed = file_state(place.file), rows is not None
        self.rows = self._open() if rows is None else rows

    def _open(self) -> Recording:
        file, folder, begin = self.place.file, self.place.file.parent, time.monotonic()
        manifest = manifest_in(folder)
        self.record = manifest or replay_record(folder)
        types = {"units": self.record.get("units") or {}, "names": self.place.columns}
        rows = open_rows(file, **types, text=manifest.get("beside", ()), words=manifest.get("texts", ()))
        self.notes = [*warnings_on(folder), *map(Note, rows.assumed)]
        self._due = time.monotonic() + max(FILE_CHECK_INTERVAL_S, REREAD_INTERVAL_RATIO * (time.monotonic() - begin))
        return rows

    @property
    def judged(self) -> list[tuple[str, str]]:
        """Return the signals of the criteria, each with its target signal, or "" for a numeric target."""
        criteria = self.record.get("criteria")
        entries = [c for c in criteria if isinstance(c, dict)] if isinstance(criteria, list) else []
        pairs = ((str(c.get("of")), c.get("to")) for c in entries)
        return [*dict.fromkeys((of, to if isinstance(to, str) else "") for of, to in pairs)]

    def follow(self) -> None:
        """Read a changed file again.

        A file that is gone, or has other signals or fewer rows, belongs to another run; `lost` then has the reason.
        """
        if self._is_fed or self.lost:
            return
        state, lost = file_state(self.place.file), FILE_LOST.format(label=self.place.label)
        if state == (0, 0):
            self.lost = lost
        if self.lost or state == self._state or time.monotonic() < self._due:
            return
        try:
            table = self._open()
        except (InputError, OSError):
            return  # it is being written
        if [*table.units] != [*self.rows.units] or table.rows < self.rows.rows:
            self.lost = lost
            return
        self._state, self.rows = state, table


def file_state(file: Path) -> tuple[int, int]:
    """Return size and modification time of a file; zeros if it is missing."""
    try:
        status = file.stat()
    except OSError:
        return 0, 0
    return status.st_size, status.st_mtime_ns


def find_runs(
    texts: Sequence[str], results: Path, columns: Mapping[str, str] = NO_COLUMNS
) -> tuple[list[RunPlace], list[str]]:
    """Return the tables that the texts select, by default those of the newest results, and notes.

    Args:
        columns: Column → name of its signal, or `time`, for columns of files to rename.

    Raises:
        InputError: A text matches no results, no results have rows, or columns are given without a file.
    """
    notes, faults = list[str](), list[Fault]()
    if columns and not any(Path(text).is_file() for text in texts):
        raise InputError.at(Path("--column"), "renames columns of a table, but no table is given; add its file")
    if not texts:
        found = [place for entry in entries(results) if (place := _of_entry(entry, is_named=False)) is not None]
        if not found:
            raise InputError.at(results, "has no results with rows; run a scenario first, or give folders and tables")
        if len(found) > MAX_VIEWED:
            notes.append(f"the newest {MAX_VIEWED} of {len(found)} results are shown; to see others, give their names")
        return _with_unique_names(found[-MAX_VIEWED:]), [*map(Note, notes)]
    found = []
    for text, group in zip(texts, select_groups(texts, results), strict=True):
        try:
            places = []
            for selected in group:
                places += _places(selected, columns, notes)
            if group and not places:  # a pattern leaves out results without rows
                raise InputError.at(Path(text), NO_ROWS.format(status=""))
            found += places
        except InputError as error:
            faults += error.faults
    refuse(faults)
    unique = {(place.file.resolve(), place.name if place.rows else ""): place for place in found}
    return _with_unique_names(list(unique.values())), [*map(Note, notes)]


def _places(selected: Selected, columns: Mapping[str, str], notes: list[str]) -> list[RunPlace]:
    """Return the tables of selected results, and add notes; none for a match of a pattern without rows.

    Raises:
        InputError: The user named results without rows.
    """
    path, entry = selected.path, selected.entry
    if not path.is_dir():
        check_given(path, LOG)
        return [RunPlace(path.stem, path.stem, path, columns=columns)]
    if entry is not None and (place := _of_entry(entry, is_named=not selected.by_pattern)) is not None:
        return [place]
    name = run_name(path)
    if entry is None and (rows := rows_in(path)) is not None:
        return [RunPlace(name, name, rows)]
    if selected.by_pattern:
        return []
    swept = read_runs(path)
    time, runs = swept.signals(MAX_VIEWED) if swept is not None else (np.zeros(0), {})
    if swept is None or not runs:
        refuse_folder(path, RUN_OR_TABLE)
        raise InputError.at(path, NO_ROWS.format(status=status_in(path)))
    units, display = swept.record["units"], swept.record.get("display") or {}
    notes.append(
        f"{name} is a sweep; {len(runs)} of its {counted(swept.record['runs'], 'run')} are shown, at the times that "
        "the sweep stored"
    )
    labels = {
        f"{name} run {number}": Recording({TIME_COLUMN: time, **signals}, units) for number, signals in runs.items()
    }
    return [RunPlace(n, n, path / SWEEP_TABLE, rows=rows, display=display) for n, rows in labels.items()]


def open_runs(
    places: Sequence[RunPlace], progress: Callable[[str, float], None] | None = None
) -> tuple[list[ViewedRun], list[str]]:
    """Open tables, and convert large ones; return the runs, and warnings about runs that are left out.

    Args:
        progress: Function of (name of the table being read, share of the tables already read).

    Raises:
        InputError: A named table has faults, or no table can be opened.
    """
    runs, notes, faults, named = list[ViewedRun](), list[str](), list[Fault](), list[Fault]()
    for k, place in enumerate(places):
        if progress is not None:
            progress(f"reading {place.label}", k / len(places))
        try:
            runs.append(ViewedRun(place, place.rows))
            notes += [note for note in runs[-1].notes if note not in notes]
        except (InputError, OSError) as error:
            if is_full(error):
                raise
            refused = error
            if not isinstance(refused, InputError):  # it was removed, for example
                refused = InputError.at(place.file, f"cannot be read: {refused.strerror}; repeat the command")
            (named if place.is_named else faults).extend(refused.faults)
            notes.append(f"{place.label} is left out: {str(refused).splitlines()[0]}")
    refuse(named or (faults if not runs else ()))
    return runs, notes


def _of_entry(entry: Entry, *, is_named: bool) -> RunPlace | None:
    rows = rows_in(entry.folder)
    name = entry.of if entry.is_newest else entry.name
    return None if rows is None else RunPlace(name, entry.label, rows, is_named)


def _with_unique_names(places: Sequence[RunPlace]) -> list[RunPlace]:
    """Return places with unique names and labels: duplicates get their path."""
    names, labels = [p.name for p in places], [p.label for p in places]
    return [
        replace(
            p,
            name=p.name if names.count(p.name) == 1 else f"{p.file} {p.name}",
            label=p.label if labels.count(p.label) == 1 else f"{p.label} ({p.file})",
        )
        for p in places
    ]
