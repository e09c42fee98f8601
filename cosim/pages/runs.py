"""Runs shown in the signal browser: results by number, name or pattern, folders and tables."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import mkdtemp
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.core.drafts import is_full
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.messages import Note
from cosim.core.scratch import process_folder
from cosim.core.text import counted
from cosim.files.artefact import LOG
from cosim.files.folders import manifest_in, replay_record, run_name, status_in, warnings_on
from cosim.files.kinds import check_given, refuse_folder
from cosim.files.results import rows_in
from cosim.files.run_entries import Entry, entries, select_groups
from cosim.isolation import rows as running
from cosim.isolation.rows import FOLLOWED
from cosim.master.checkpoint import ROWS
from cosim.pages.rows import TIME, Recording, Store
from cosim.pages.tables import ColumnTypes, Progress, open_rows
from cosim.sweeps.store import TABLE, read_runs

NO_ROWS = "has no rows to draw{status}; give folders of runs, or tables with time in the first column"
LOST = "{label} was removed or replaced; its drawn curves stay, but are not refined when zooming"
MAX_RUNS = 20  # results listed by name in a message
MAX_NAMES = 5  # signals in a note
LOOK = 1.0  # [s] between checks of a file
SHARE = 5.0  # time between readings of a growing file, as a multiple of the reading time
NO_COLUMNS: Mapping[str, str] = MappingProxyType({})
WANTED = "the folder of a run or a table of its rows"
Bar = Callable[[str], AbstractContextManager[Callable[[int, int], None] | None]]


@dataclass(frozen=True)
class RunPlace:
    """A table of rows and its names.

    Attributes:
        name: Name in layouts, the same for later runs of the same series.
        label: Unique name on the page.
        is_named: True if the user named this table, so that its faults are errors.
        entry: Results in a folder of results; None for other paths.
        columns: Column of the table → name of its signal, or `time`, of columns with another name.
        rows: Rows in memory, of a run of a sweep, whose table has no time.
        display: Unit → name of its display unit, factor and offset to its values, of these rows.
    """

    name: str
    label: str
    file: Path
    is_named: bool = True
    entry: Entry | None = None
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

    def __init__(self, place: RunPlace, progress: Progress = None, rows: Recording | None = None) -> None:
        self.place, self.lost, self.notes, self.record = place, "", list[str](), dict[str, Any](display=place.display)
        self._due = 0.0  # [s] next time at which a growing file may be read again
        self._state, self._is_fed = file_state(place.file), rows is not None
        self.rows = self._open(progress) if rows is None else rows

    def _open(self, progress: Progress) -> Recording:
        if self.place.file.name == FOLLOWED:
            about = self.record = json.loads(self.place.file.read_text(encoding="utf-8"))
            return self._with_new_rows(Store(Path(mkdtemp(dir=process_folder())), about["units"]))
        folder, begin = self.place.file.parent, time.monotonic()
        manifest = manifest_in(folder)
        self.record = manifest or replay_record(folder)
        columns = ColumnTypes(
            self.record.get("units") or {},
            self.place.columns,
            manifest.get("beside", ()),
            frozenset(manifest.get("texts", ())),
        )
        rows = open_rows(self.place.file, columns, progress)
        self.notes = [*warnings_on(folder), *map(Note, rows.assumed)]
        for names, text in (
            (rows.rounded, "drawn as the nearest double; the cursor shows all digits"),
            (rows.inexact, "read as the nearest double"),
        ):
            if names:
                some = ", ".join(names[:MAX_NAMES])
                self.notes.append(Note(f"{self.place.label}: integers of {some} above 2^53 are {text}"))
        self._due = time.monotonic() + max(LOOK, SHARE * (time.monotonic() - begin))
        return rows

    @property
    def judged(self) -> list[tuple[str, str]]:
        """Return the signals of the criteria, each with its target signal, or "" for a numeric target."""
        criteria = self.record.get("criteria")
        entries = [c for c in criteria if isinstance(c, dict)] if isinstance(criteria, list) else []
        pairs = ((str(c.get("of")), c.get("to")) for c in entries)
        return [*dict.fromkeys((of, to if isinstance(to, str) else "") for of, to in pairs)]

    def _with_new_rows(self, rows: Store) -> Store:
        """Add new rows of a running simulation; raise OSError if it has ended."""
        about = json.loads(self.place.file.read_text(encoding="utf-8"))
        made = int(running.Progress.from_buffer_copy(Path(about["progress"]).read_bytes()).made[0])
        if made > rows.rows:
            table = np.memmap(self.place.file.with_name(ROWS), np.float64, "r", shape=(made, len(about["units"])))
            time = about["start"] + about["step"] * np.arange(rows.rows, made)
            rows.append(np.vstack((time, table[rows.rows :].T)))
        return rows

    def check(self) -> bool:
        """Return True if the file still exists."""
        folder = self.place.file.parent.parent
        if self.place.file.name == FOLLOWED and not self.place.file.is_file() and folder.is_dir():
            rows = rows_in(folder)
            if rows is None:
                return True  # the run has ended, and its results are being written
            self.place = replace(self.place, file=rows, entry=None)
        if not self.lost and not self._is_fed and not self.place.file.is_file():
            self.lost = LOST.format(label=self.place.label)
        return not self.lost

    def follow(self) -> bool:
        """Read a changed file again; return True if its rows changed.

        A file with other signals or fewer rows belongs to another run; `lost` then has the reason.
        """
        if isinstance(self.rows, Store) and self.place.file.name == FOLLOWED:
            before = self.rows.rows
            with suppress(OSError, ValueError):
                self._with_new_rows(self.rows)
            return self.rows.rows > before
        state = file_state(self.place.file)
        if self._is_fed or self.lost or state in {self._state, (0, 0)} or time.monotonic() < self._due:
            return False
        try:
            rows = self._open(None)
        except (InputError, OSError):
            return False  # it is being written
        if [*rows.units] != [*self.rows.units] or rows.rows < self.rows.rows:
            self.lost = LOST.format(label=self.place.label)
            return False
        for name, unit in self.rows.added.items():
            rows.add(name, self.rows.read(name), unit)
        self._state, self.rows = state, rows
        return True


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
    """Return the tables of numbers, names, patterns, folders and files, by default of the newest results.

    Args:
        columns: Column → name of its signal, or `time`, for columns of files to rename.

    Raises:
        InputError: A text matches no results, no results have rows, or columns are given without a file.
    """
    notes: list[str] = []
    if columns and not any(Path(text).is_file() for text in texts):
        raise InputError.at(Path("--column"), "renames columns of a table, but no table is given; add its file")
    if not texts:
        found = [place for entry in entries(results) if (place := _of_entry(entry, is_named=False)) is not None]
        if not found:
            raise InputError.at(results, "has no results with rows; run a scenario first, or give folders and tables")
        if len(found) > MAX_RUNS:
            notes.append(
                Note(f"the newest {MAX_RUNS} of {len(found)} results are shown; to see others, give their names")
            )
        return _differing(found[-MAX_RUNS:]), notes
    found, faults = list[RunPlace](), list[Fault]()
    for text, group in zip(texts, select_groups(texts, results), strict=True):
        count = len(found)
        try:
            for selected in group:
                path, entry = selected.path, selected.entry
                if not path.is_dir():
                    check_given(path, LOG)
                    found.append(RunPlace(path.stem, path.stem, path, columns=columns))
                elif entry is not None and (place := _of_entry(entry, is_named=not selected.by_pattern)) is not None:
                    found.append(place)
                elif entry is None and (rows := _rows_of(path)) is not None:
                    name = run_name(path)
                    found.append(RunPlace(name, name, rows))
                elif not selected.by_pattern and (of_sweep := _of_sweep(path))[0]:
                    found += of_sweep[0]
                    notes.append(Note(of_sweep[1]))
                elif earlier := _earlier_of(text, entry, results):
                    found.append(earlier)
                    notes.append(
                        Note(f"{path} has no rows to draw; the newest run that has, {earlier.label}, is shown")
                    )
                elif not selected.by_pattern:
                    refuse_folder(path, WANTED)
                    raise InputError.at(path, NO_ROWS.format(status=status_in(path)))
            if group and len(found) == count:  # a pattern leaves out results without rows
                raise InputError.at(Path(text), NO_ROWS.format(status=""))
        except InputError as error:
            faults += error.faults
    refuse(faults)
    unique = {(place.file.resolve(), place.name if place.rows else ""): place for place in found}
    return _differing(list(unique.values())), notes


def open_runs(places: Iterable[RunPlace], bar: Bar) -> tuple[list[ViewedRun], list[str]]:
    """Open tables, and convert large ones; return the runs, and warnings about runs that are left out.

    Raises:
        InputError: A named table has faults, or no table can be opened.
    """
    runs, notes, faults, named = list[ViewedRun](), list[str](), list[Fault](), list[Fault]()
    for place in places:
        try:
            with bar(f"converting {place.label}") as progress:
                runs.append(ViewedRun(place, progress, place.rows))
            notes += [note for note in runs[-1].notes if note not in notes]
        except (InputError, OSError) as error:
            if is_full(error):
                raise
            if isinstance(error, InputError):
                refused = error
            elif isinstance(error, FileNotFoundError):
                gone = "was removed while it was read; repeat the command with the remaining results"
                refused = InputError.at(place.file, gone)
            else:
                refused = InputError.at(place.file, f"cannot be read: {error.strerror}")
            (named if place.is_named else faults).extend(refused.faults)
            notes.append(f"{place.label} is left out: {str(refused).splitlines()[0]}")
    refuse(named or (faults if not runs else ()))
    return runs, notes


def _rows_of(folder: Path) -> Path | None:
    """Return the file with a run's rows; for a running simulation, the file with the location of its rows."""
    if (rows := rows_in(folder)) is not None:
        return rows
    for followed in folder.glob(f"*/{FOLLOWED}"):
        with suppress(OSError, ValueError):  # the run ends meanwhile
            if Path(json.loads(followed.read_text(encoding="utf-8"))["progress"]).is_file():
                return followed
    return None


def _of_entry(entry: Entry, *, is_named: bool) -> RunPlace | None:
    rows = _rows_of(entry.folder)
    name = entry.of if entry.is_newest else entry.name
    return None if rows is None else RunPlace(name, entry.label, rows, is_named, entry)


def _of_sweep(folder: Path) -> tuple[list[RunPlace], str]:
    """Return runs of a sweep with their sampled signals, and a note; none of other results and without signals."""
    swept = read_runs(folder)
    if swept is None:
        return [], ""
    name, record, places = run_name(folder), swept.record, list[RunPlace]()
    time, runs = swept.signals(MAX_RUNS)
    for number, signals in runs.items():
        label, rows = f"{name} run {number}", Recording({TIME: time, **signals}, record["units"], time.size)
        places.append(RunPlace(label, label, folder / TABLE, rows=rows, display=record.get("display") or {}))
    note = f"{name} is a sweep; {len(places)} of its {counted(record['runs'], 'run')} are shown, as sampled"
    return places, note


def _earlier_of(text: str, entry: Entry | None, results: Path) -> RunPlace | None:
    """Return the newest run with rows of a name of several runs."""
    if entry is None or entry.name == entry.of or not text.rstrip("/").endswith(entry.of):
        return None
    places = [_of_entry(e, is_named=True) for e in entries(results) if e.of == entry.of]
    return next((place for place in reversed(places) if place is not None), None)


def _differing(places: Sequence[RunPlace]) -> list[RunPlace]:
    """Return places with unique names and labels: duplicates get their path."""
    names, labels = [p.name for p in places], [p.label for p in places]
    return [
        replace(
            p,
            name=p.name if names.count(p.name) == 1 else str(p.file.parent / p.name),
            label=p.label if labels.count(p.label) == 1 else f"{p.label} ({p.file})",
        )
        for p in places
    ]
