"""Table formats, their detection and common behaviour; installed packages can add formats.

A format is a subclass of `Source` with an object registered in the group `cosim.sources`; see docs/extending.md.
"""

from __future__ import annotations

import functools
from array import array
from collections.abc import Collection, Container, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.registry import SOURCES, load, names, resolve
from cosim.storage.files import open_bytes
from cosim.storage.table_columns import (
    MOST_TIME,
    Column,
    Faults,
    Heading,
    Table,
    TableRequest,
    choose_columns,
    note_backwards,
    note_distant,
    note_infinite,
    note_missing,
)

OWN = {
    "csv": "cosim.storage.csv_source:CSV",
    "parquet": "cosim.storage.parquet_source:PARQUET",
    "mat": "cosim.storage.mat_source:MAT",
    "hdf5": "cosim.storage.hdf5_source:HDF5",
}
HEAD = 64  # bytes examined to detect a format


@dataclass(frozen=True)
class SourceColumn:
    """A column as stored in a file.

    Attributes:
        unit: Unit, "" if absent.
        values: Numbers, NaN if missing, whole numbers as integers; or a list of other values.
        fault: Reason for missing numbers, e.g. "holds timestamps; write seconds", or "".
        is_text: Whether the file says that values are text or binary data, also if they look like numbers.
    """

    name: str
    unit: str
    values: Array | Sequence[Any] = ()
    fault: str = ""
    is_text: bool = False

    @property
    def numeric(self) -> bool:
        """Return whether the column holds numbers."""
        return isinstance(self.values, np.ndarray) and not self.fault


@dataclass(frozen=True)
class Frame:
    """All columns of a file; `lines` holds the line of each row, empty in formats without lines."""

    columns: Sequence[SourceColumn] = ()
    lines: Sequence[int] = ()

    @property
    def row_lines(self) -> Sequence[int]:
        """Return the line of each row, or its number."""
        return self.lines or range(1, len(self.columns[0].values) + 1 if self.columns else 1)


class Source:
    """A table format.

    Attributes:
        name: Name in messages.
        suffixes: Lower-case suffixes with the dot.
        magic: First bytes of every file, b"" if undefined.
        writes: Whether results can be written in the format.
    """

    name = ""
    suffixes: tuple[str, ...] = ()
    magic = b""
    writes = False

    def frame(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Frame:
        """Read all columns.

        Args:
            names: Known names, whose brackets are not units.
            text: Columns of text, even with numeric content.

        Raises:
            InputError: The file is incomplete.
        """
        raise NotImplementedError

    def write(self, path: Path, columns: Sequence[SourceColumn]) -> None:
        """Write columns, time first, completely or not at all."""
        raise NotImplementedError

    def check_writable(self) -> None:
        """Raise InputError if a library for writing is missing."""

    def column_names(self, path: Path) -> list[str]:
        """Return the column names, none if unreadable."""
        try:
            return [column.name for column in self.frame(path).columns]
        except InputError:
            return []

    def table(self, faults: Faults, request: TableRequest) -> Table:
        """Read the requested columns and note all their faults."""
        table = Table(header=0)
        try:
            frame = self.frame(faults.path, request.names)
        except InputError as error:
            faults.items += error.faults
            return table
        if not frame.columns:
            faults.note(0, 0, f"has no columns; they are {request.description}")
            return table
        headings = [Heading(0, cell, c.name, c.unit) for cell, c in enumerate(frame.columns, 1)]
        choose_columns(table, headings, faults, request)
        if not request.timed or "time" in table.columns:
            fill(table, frame.columns, frame.row_lines, faults, request)
        return table


def fill(
    table: Table, columns: Sequence[SourceColumn], lines: Sequence[int], faults: Faults, request: TableRequest
) -> None:
    """Fill a table's columns and note their faults."""
    for column in table.columns.values():
        source = columns[column.cell - 1]
        values = np.full(len(lines), np.nan)
        if source.numeric:
            values[:] = source.values
        if column.spare:
            if not (source.numeric and np.isfinite(values).all()):
                table.spoiled.add(column.name)
        elif source.numeric:
            _note_values(column, values, lines, faults)
        else:
            reason = source.fault or "holds text; write numbers"
            message = f"column {column.name} {reason}"
            faults.note_cell(1, column.cell, f"cells of {column.name} that are no number", message)
        numbers: Array = column.convert(values)
        if request.timed and column.name == "time" and not column.spare:
            for row in np.flatnonzero(np.abs(numbers) > MOST_TIME).tolist():
                note_distant(faults, lines[row], float(numbers[row]))
            numbers = np.clip(numbers, -MOST_TIME, MOST_TIME)
            steps = np.diff(numbers)
            for row in (np.flatnonzero(steps < 0.0 if request.jumps else steps <= 0.0) + 1).tolist():
                note_backwards(faults, lines[row], float(numbers[row]), float(numbers[row - 1]))
        table.values[column.name] = array("d", numbers.tobytes())
    table.lines = array("q", lines)
    table.whole = True


def _note_values(column: Column, values: Array, lines: Sequence[int], faults: Faults) -> None:
    for row in np.flatnonzero(np.isinf(values)).tolist():
        note_infinite(faults, lines[row], column, f"{values[row]:g}")
    if column.role:
        for row in np.flatnonzero(np.isnan(values)).tolist():
            note_missing(faults, lines[row], column)


def time_among(names: Iterable[str]) -> str | None:
    """Return the name of the time: `time` in any case, else `t`; `T` is rather a temperature."""
    given = [*names]
    return next((name for name in given if name.lower() == "time"), "t" if "t" in given else None)


def whole_numbers(values: Array) -> Array:
    """Return integers with a sign, or without one if one is beyond 63 bits."""
    is_beyond = values.dtype.kind == "u" and bool(np.any(values > np.iinfo(np.int64).max))
    return values.astype(np.uint64 if is_beyond else np.int64)


def as_text(value: Any) -> str:
    """Return a value that is no double as text, binary data as hexadecimal digits."""
    return value.hex() if isinstance(value, bytes) else str(value)


# -- detection ----------------------------------------------------------------------------------


@functools.cache
def sources() -> tuple[Source, ...]:
    """Return the formats, installed packages last."""
    own = [resolve(place) for place in OWN.values()]
    added = (load(SOURCES, name) for name in names(SOURCES))
    return (*own, *(source for source in added if isinstance(source, Source)))


def suffixes() -> tuple[str, ...]:
    """Return the suffixes of table files, `.csv` first."""
    return tuple(suffix for source in sources() for suffix in source.suffixes)


def source_of(path: Path) -> Source:
    """Return the format of a file by first bytes or suffix.

    Text with any other suffix is CSV.

    Raises:
        InputError: The format is unknown.
    """
    head = b""
    with suppress(OSError, ValueError), open_bytes(path) as stream:
        head = stream.read(HEAD)
    by_suffix = [s for s in sources() if path.suffix.lower() in s.suffixes][:1]
    if by_head := [s for s in (*by_suffix, *sources()) if s.magic and head.startswith(s.magic)]:
        return by_head[0]
    if not by_suffix and b"\0" in head:
        raise InputError.at(path, f"has none of the formats that are read: {_formats()}")
    return (by_suffix or sources())[0]


def source_named(name: str) -> Source:
    """Return the named format for results; raise InputError if unknown or read-only."""
    word = name.lower().removeprefix(".")
    for source in sources():
        if word == source.name.lower() or f".{word}" in source.suffixes:
            if source.writes:
                return source
            message = f"{source.name} is read, not written; written are {_formats(written=True)}"
            raise InputError.at(Path("--format"), message)
    raise InputError.at(Path("--format"), f'no format "{name}"; known here: {_formats(written=True)}')


def _formats(*, written: bool = False) -> str:
    formats = [source for source in sources() if source.writes or not written]
    return ", ".join(f"{source.name} ({', '.join(source.suffixes)})" for source in formats)
