"""Results of a run: a row per communication point, a column per `component.variable`."""

from __future__ import annotations

import csv
import errno
import io
import re
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.drafts import draft_of, is_full
from cosim.storage.csv_source import cell_text, write_table
from cosim.storage.table import is_there
from cosim.storage.table_columns import MOST_TIME, Faults, is_time, note_distant, note_wrong_first, time_scale
from cosim.storage.table_source import Frame, SourceColumn, as_text, source_named, source_of, suffixes

CHUNK = 1000  # rows
EXACT = 2**53  # integers below this size are doubles
FEWER = 0.7  # share of the rows to try next on a full disk, for formats written as a whole


@dataclass(frozen=True)
class Results:
    """Recorded signals.

    Row k holds the measurements at `time[k]` and the command acting until `time[k + 1]`.

    Attributes:
        time: Communication points [s], shape (rows,).
        columns: Names `component.variable` of the columns of `values`.
        values: Shape (rows, columns).
        units: Name → unit, "" without unit.
        exact: Name → column of values beyond doubles: text, 64-bit integers, binary data.
        whole: Columns of integers, Booleans and enumerations.
        notes: Notes on the run.
        loop: Stepping loop: "C", or "Python: " with the reason; "" if unknown.
        events: Handled events and ticks of a run with event mode: time [s], component, cause; the first ones.
        event_counts: Their numbers, by component and cause.
        details: Entries of the manifest about the steps.
        words: Names in `exact` of text and binary data, which may look like integers; none if that is not known.
    """

    time: Array
    columns: tuple[str, ...]
    values: Array
    units: Mapping[str, str] = field(default_factory=dict)
    exact: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    whole: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()
    loop: str = ""
    events: tuple[tuple[float, str, str], ...] = ()
    event_counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    words: frozenset[str] = frozenset()

    def __getitem__(self, name: str) -> Array:
        return self.values[:, self._places[name]]

    def __contains__(self, name: str) -> bool:
        return name in self._places

    def with_integers(self) -> Results:
        """Return results whose columns of 64-bit integers beside the doubles are numbers too, rounded to doubles."""
        integers = ((name, whole_numbers_of(values)) for name, values in self.exact.items() if name not in self.words)
        found = {name: values for name, values in integers if values is not None}
        if not found:
            return self
        values = np.column_stack([self.values, *found.values()])
        return replace(self, columns=(*self.columns, *found), values=values, whole=self.whole | {*found})

    def texts(self) -> dict[str, list[str]]:
        """Return the columns beside the doubles as text."""
        return {name: [as_text(value) for value in values] for name, values in self.exact.items()}

    @cached_property
    def _places(self) -> Mapping[str, int]:
        return {name: k for k, name in enumerate(self.columns)}

    def write(self, path: Path, go_on: Callable[[int], bool] | None = None) -> None:
        """Write time and all columns in the format of the suffix.

        Args:
            go_on: Function that returns whether CSV goes on after so many rows.
        """
        if path.suffix == ".csv":
            self.write_csv(path, go_on)
        else:
            source_named(path.suffix).write(path, self._source_columns(len(self.time)))

    def _source_columns(self, rows: int) -> list[SourceColumn]:
        """Return the first rows as columns, with time first."""
        columns = [SourceColumn("time", "s", self.time[:rows])]
        for k, name in enumerate(self.columns):
            values = np.ascontiguousarray(self.values[:rows, k])
            unit = self.units.get(name, "")
            columns.append(SourceColumn(name, unit, values.astype(np.int64) if name in self.whole else values))
        return columns + [SourceColumn(n, self.units.get(n, ""), list(v[:rows])) for n, v in self.exact.items()]

    def write_csv(self, path: Path, go_on: Callable[[int], bool] | None = None) -> None:
        """Write CSV with exactly reproducible numbers, to the row after which `go_on` returns False."""
        header = ("time", *self.columns, *self.exact)
        if self.exact or self.whole:
            write_table(path, header, self._typed_rows(go_on), cell_text)
        else:
            write_table(path, header, self._rows(go_on))

    def write_what_fits(self, path: Path) -> int:
        """Write the rows that fit on the disk and return their number; raise OSError if none fits."""
        if path.suffix != ".csv":
            return self._write_whole_that_fits(path)
        with draft_of(path) as draft, draft.open("wb", buffering=0) as stream:
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerow(("time", *self.columns, *self.exact))
            header = text.getvalue().encode()
            if stream.write(header) < len(header):
                raise OSError(errno.ENOSPC, "no room for a header")
            for number, row in enumerate(self._typed_rows()):
                line, before = (",".join(map(cell_text, row)) + "\n").encode(), stream.tell()
                try:
                    whole = stream.write(line) == len(line)
                except OSError:
                    whole = False
                if not whole:
                    stream.truncate(before)
                    return number
        return len(self.time)

    def _write_whole_that_fits(self, path: Path) -> int:
        """Write a format without partial files with as many first rows as fit on the disk; return their number."""
        count = len(self.time)
        while True:
            try:
                source_named(path.suffix).write(path, self._source_columns(count))
                return count
            except OSError as error:
                if not (count and is_full(error)):
                    raise
                count = int(FEWER * count)

    def _rows(self, go_on: Callable[[int], bool] | None = None) -> Iterator[tuple[float, ...]]:
        for first in range(0, len(self.time), CHUNK):  # Python floats need four times the memory.
            if first and go_on is not None and not go_on(first):
                return
            part = slice(first, first + CHUNK)
            for t, row in zip(self.time[part].tolist(), self.values[part].tolist(), strict=True):
                yield t, *row

    def _typed_rows(self, go_on: Callable[[int], bool] | None = None) -> Iterator[tuple[Any, ...]]:
        whole = [k for k, name in enumerate(self.columns, 1) if name in self.whole]
        for number, row in enumerate(self._rows(go_on)):
            typed: list[Any] = list(row)
            for k in whole:
                typed[k] = int(row[k])
            yield *typed, *(column[number] for column in self.exact.values())


INTEGER = re.compile(r"0|-?[1-9]\d{0,19}")


def whole_numbers_of(values: Sequence[Any]) -> Array | None:
    """Return integers, or texts that are integers of 64 bits, as doubles; None for other values."""
    numbers = array("d")
    for value in values:
        is_whole = INTEGER.fullmatch(value) if isinstance(value, str) else type(value) is int
        if not is_whole:
            return None
        numbers.append(float(int(value)))
    return np.array(numbers) if numbers else None


def is_rounded(values: Any) -> bool:
    """Return whether integers, perhaps already as doubles, are too large for doubles to hold each of them."""
    return bool(values.size) and bool(values.max() >= EXACT or values.min() <= -EXACT)


# -- reading results ------------------------------------------------------------------------------------


def read_results(
    path: Path,
    units: Mapping[str, str] | None = None,
    text: Collection[str] = (),
    *,
    words: Collection[str] = (),
) -> Results:
    """Return written results, or any table with time first.

    Times in other units become seconds.

    Args:
        units: Units of columns without unit in the header.
        text: Columns of text; other columns are classified by their cells.
        words: Columns of `text` that are no integers, also if they look like it.

    Raises:
        InputError: The file has faults; it lists all of them.
    """
    faults, units = Faults(path), units or {}
    frame = source_of(path).frame(path, units, text) if is_there(faults) else Frame()
    faults.raise_any()
    time = _time_of(frame, faults)
    numbers: dict[str, Array] = {}
    exact, whole = dict[str, list[Any]](), set[str]()
    for cell, column in enumerate(frame.columns[1:], 2):
        if column.fault:
            faults.note(0, cell, f"column {column.name} {column.fault}")
        elif not column.numeric:
            exact[column.name] = list(column.values)
        else:
            values = np.asarray(column.values)
            if values.dtype.kind in "iu" and is_rounded(values):
                exact[column.name] = values.tolist()
                continue
            numbers[column.name] = values.astype(np.float64)
            whole |= {column.name} if values.dtype.kind == "i" else set()
    faults.raise_any()
    values = np.column_stack(list(numbers.values())) if numbers else np.empty((time.size, 0))
    own_units = {c.name: c.unit for c in frame.columns[1:] if c.unit}
    own_units |= {name: unit for name, unit in units.items() if name in numbers or name in exact}
    words = frozenset(exact) & {*words, *_texts_in(frame)}
    return Results(time, tuple(numbers), values, own_units, exact, frozenset(whole), words=words)


def _texts_in(frame: Frame) -> set[str]:
    return {column.name for column in frame.columns[1:] if column.is_text}


def _time_of(frame: Frame, faults: Faults) -> Array:
    """Return the first column in seconds, checked for order.

    Equal times are allowed, because some tools write several rows per event.
    """
    first = frame.columns[0] if frame.columns else SourceColumn("", "")
    lines = frame.row_lines
    line = 1 if len(lines) and lines[0] > 1 else 0  # line of the header
    if not is_time(first.name):
        place = next((cell for cell, column in enumerate(frame.columns, 1) if is_time(column.name)), 0)
        note_wrong_first(faults, line, first.name, place)
        return np.empty(0)
    scale = time_scale(faults, line, first.unit)
    if not first.numeric:
        if len(lines):
            reason = f"column time {first.fault}"
            faults.note(lines[0], 1, reason if first.fault else "a time is no number; write seconds")
        return np.empty(0)
    time = np.asarray(first.values, dtype=np.float64) * scale
    for row in np.flatnonzero(~np.isfinite(time)).tolist():
        faults.note_cell(
            lines[row], 1, "rows without a time", "the row has no time; fill the cell or leave the row out"
        )
    for row in np.flatnonzero(np.abs(time) > MOST_TIME).tolist():
        note_distant(faults, lines[row], float(time[row]))
    time = np.clip(time, -MOST_TIME, MOST_TIME)
    for row in (np.flatnonzero(np.diff(time) < 0.0) + 1).tolist():
        message = f"time {time[row]:g} s comes after {time[row - 1]:g} s; sort the rows"
        faults.note_cell(lines[row], 1, "times that go back", message)
    return time


def rows_name(stem: str, format_: str) -> str:
    """Return the name of a rows file; raise InputError if the format cannot be written."""
    source = source_named(format_)
    source.check_writable()
    return f"{stem}{source.suffixes[0]}"


def rows_in(folder: Path, stem: str = "results") -> Path | None:
    """Return a folder's rows file, in any format."""
    return next((path for suffix in suffixes() if (path := folder / f"{stem}{suffix}").is_file()), None)


def remove_rows(folder: Path, stem: str, besides: str = "") -> None:
    """Remove the rows files of an earlier command, except one name."""
    for suffix in suffixes():
        if f"{stem}{suffix}" != besides:
            (folder / f"{stem}{suffix}").unlink(missing_ok=True)
