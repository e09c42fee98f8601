"""Results of a run: one row per communication point, one column per `component.variable`."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import did_you_mean
from cosim.files.table import (
    Column,
    Faults,
    Use,
    as_text,
    is_time,
    note_wrong_first,
    numbers_of,
    read_source,
    source_named,
    suffixes,
    time_first,
    time_scale,
)

EXACT_INTEGER_LIMIT = 2**53  # integers below this size are exact as doubles
INTEGER_TEXT = re.compile(r"0|-?[1-9]\d{0,19}")


@dataclass(frozen=True)
class Results:
    """Recorded signals.

    Row k contains the measurements at `time[k]` and the command acting until `time[k + 1]`.

    Attributes:
        time: Communication points [s], shape (rows,).
        columns: Names `component.variable` of the columns of `values`.
        values: Shape (rows, columns).
        units: Name → unit, "" without unit.
        exact: Name → column of values that doubles cannot store: text, 64-bit integers, binary data.
        whole: Names of the columns of integers, Booleans and enumerations.
        notes: Notes on the run.
        loop: Language of the stepping loop: "C", or "Python: " with the reason; "" if unknown.
        events: The first events and clock ticks of a run with event mode: time [s], component, cause.
        event_counts: Number of events by component and cause.
        details: Entries of the manifest about the communication steps.
        words: Names of the text and binary columns in `exact`; empty if unknown.
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
        """Return results whose `values` also have the 64-bit integers of `exact`, rounded to doubles."""
        found: dict[str, Array] = {}
        for name, values in self.exact.items():
            is_whole = (INTEGER_TEXT.fullmatch(v) if isinstance(v, str) else type(v) is int for v in values)
            if name not in self.words and len(values) and all(is_whole):
                found[name] = np.array([float(int(value)) for value in values])
        if not found:
            return self
        every = np.column_stack([self.values, *found.values()])
        return replace(self, columns=(*self.columns, *found), values=every, whole=self.whole | {*found})

    def texts(self) -> dict[str, list[str]]:
        """Return the columns of `exact` as text."""
        return {name: [as_text(value) for value in values] for name, values in self.exact.items()}

    @cached_property
    def _places(self) -> Mapping[str, int]:
        return {name: k for k, name in enumerate(self.columns)}

    def write(self, path: Path) -> None:
        """Write time and all columns in the format given by the suffix of the path."""
        columns = [Column("time", "s", self.time)]
        for name, values in zip(self.columns, self.values.T, strict=True):
            exact = values.astype(np.int64) if name in self.whole else values
            columns.append(Column(name, self.units.get(name, ""), exact))
        columns += [Column(name, self.units.get(name, ""), list(values)) for name, values in self.exact.items()]
        source_named(path.suffix).write(path, columns)


def is_rounded(values: Any) -> bool:
    """Return True if integers, perhaps stored as doubles, are too large for exact doubles."""
    return bool(values.size) and bool(values.max() >= EXACT_INTEGER_LIMIT or values.min() <= -EXACT_INTEGER_LIMIT)


# -- reading results ------------------------------------------------------------------------------------


def read_results(
    path: Path,
    units: Mapping[str, str] | None = None,
    text: Collection[str] = (),
    *,
    words: Collection[str] = (),
    names: Mapping[str, str] | None = None,
) -> Results:
    """Return the results in a file written by cosim, or any other table with a time.

    Times in other units, and dates, become seconds; `notes` list the assumptions.

    Args:
        units: Units of columns without unit in the header.
        text: Columns of text; other columns are classified by their cells.
        words: Columns of `text` that are not integers, even if their cells look like integers.
        names: Column → its name in the results, or `time`, for columns to rename.

    Raises:
        InputError: The file has faults, or lacks a column of `names`.
    """
    faults, units, names = Faults(path), units or {}, names or {}
    table = read_source(faults, units, text)
    here = [column.name for column in table.columns]
    for missing in (name for name in names if table.columns and name not in here):
        faults.note(table.header, 0, f'has no column "{missing}"{did_you_mean(missing, here)}')
    faults.raise_any()
    columns = [replace(column, name=names.get(column.name, column.name)) for column in table.columns]
    table = time_first(replace(table, columns=columns), faults, (), ())
    first = table.columns[0] if table.columns else Column("")
    if not is_time(first.name):
        note_wrong_first(faults, table)
        faults.raise_any()
    use = Use("time", time_scale(faults, table.header, first.unit), role="the time")
    time = numbers_of(replace(first, name="time"), use, table, faults, jumps=True)
    numbers, exact, whole = dict[str, Array](), dict[str, list[Any]](), set[str]()
    for column in table.columns[1:]:
        if column.fault:
            faults.note(0, column.cell, f"column {column.name} {column.fault}")
        elif not column.numeric:
            exact[column.name] = list(column.values)
        elif (values := np.asarray(column.values)).dtype.kind in "iu" and is_rounded(values):
            exact[column.name] = values.tolist()
        else:
            numbers[column.name] = values.astype(np.float64)
            whole |= {column.name} if values.dtype.kind == "i" else set()
    faults.raise_any()
    assert time is not None  # Set above, since the time column is not spare.
    every = np.column_stack(list(numbers.values())) if numbers else np.empty((time.size, 0))
    own_units = {c.name: c.unit for c in table.columns[1:] if c.unit}
    own_units |= {name: unit for name, unit in units.items() if name in numbers or name in exact}
    words = frozenset(exact) & {*words, *(c.name for c in table.columns[1:] if c.is_text)}
    notes = tuple(f"{path.name}: {text}" for text in table.assumed)
    return Results(time, tuple(numbers), every, own_units, exact, frozenset(whole), notes, words=words)


def rows_name(stem: str, format_: str) -> str:
    """Return the name `stem` with the suffix of a format; raise InputError if cosim cannot write the format."""
    source = source_named(format_)
    source.check_writable()
    return f"{stem}{source.suffixes[0]}"


def rows_in(folder: Path, stem: str = "results") -> Path | None:
    """Return the path of the file with the rows in a folder, in any format; None if there is no such file."""
    return next((path for suffix in suffixes() if (path := folder / f"{stem}{suffix}").is_file()), None)
