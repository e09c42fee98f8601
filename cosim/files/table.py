"""Tables of signals with time and units in any format: reading, conversion, and faults with their places.

A format is a subclass of `Source` with an object registered in the group `cosim.sources`; see docs/extending.md.
"""

from __future__ import annotations

import functools
import math
import re
import sys
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.registry import SOURCES_GROUP, registered, resolve
from cosim.core.text import counted, did_you_mean
from cosim.core.units import alternatives, factor
from cosim.files.files import open_bytes

OWN_FORMATS = (
    "cosim.files.csv_source:CSV",
    "cosim.files.formats:PARQUET",
    "cosim.files.formats:MAT",
    "cosim.files.formats:HDF5",
    "cosim.files.formats:EXCEL",
    "cosim.files.formats:MDF",
)
FORMAT_HEAD_BYTES = 64  # bytes examined to detect a format
SHOWN_FAULTS = 20  # faults that are shown for a file; the rest are counted
MOST_TIME = math.sqrt(sys.float_info.max)  # [s] largest time whose square is a double
FLOAT_RESOLUTION_S = 1e-6  # spacing of doubles from which equal times are due to their size
TIME_NAMES = {  # other usual names of the time
    *("t", "timestamp", "time stamp", "time_stamp", "datetime", "date time", "date", "elapsed", "seconds"),
    *("zeit", "zeitstempel", "datum", "temps", "tiempo", "tempo", "tijd"),
}
NAMELESS = ("", "unnamed: 0")  # headings of an index column without a name, as pandas writes and reads it
DAY_FIRST = re.compile(r"\d\d\.\d\d\.\d{4}")  # 24.12.2026 18:00:00
INDEX = re.compile(r"\S\[[\d,\s]+\]$")  # index at the end of a name like p.e[1], not a unit
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")


@dataclass(frozen=True)
class Column:
    """A signal of a table.

    Attributes:
        unit: Unit, "" if absent.
        values: Array of doubles (NaN if missing) or of integers; or a list of other values.
        fault: Reason why the column has no numbers, e.g. "has time stamps; write seconds", or "".
        is_text: True if the file declares the values as text or binary data, even if they look like numbers.
        cell: Position of the column in the file, from 1; set by `read_source`.
    """

    name: str
    unit: str = ""
    values: Array | Sequence[Any] = ()
    fault: str = ""
    is_text: bool = False
    cell: int = 0

    @property
    def numeric(self) -> bool:
        """Return True if the values are an array of numbers."""
        return isinstance(self.values, np.ndarray) and not self.fault

    @property
    def holds_words(self) -> bool:
        """Return True if the column has text or values of another type, apart from numbers with decimal commas."""
        filled = [] if self.numeric or self.fault else [c for v in self.values if (c := str(v).strip())]
        is_word = (number_of(c) is None and not DECIMAL_COMMA.fullmatch(c) for c in filled)
        return bool(self.fault) or (bool(filled) and all(is_word))


@dataclass(frozen=True)
class Table:
    """Columns read from a file; the first one is usually the time.

    Attributes:
        lines: Line number of each row; empty in formats without lines.
        header: Line number of the header; 0 in formats without lines.
        faults: Faults of rows that could not be read.
        assumed: Sentences on assumptions made when the file was read.
        own_times: True if columns have values at different times; an input then keeps its value until its next one.
        spoiled: Names of columns left out because a cell is not a finite number; set by `read_table`.
    """

    columns: Sequence[Column] = ()
    lines: Sequence[int] = ()
    header: int = 0
    faults: Sequence[Fault] = ()
    assumed: tuple[str, ...] = ()
    own_times: bool = False
    spoiled: Sequence[str] = ()

    @property
    def rows(self) -> int:
        """Return the number of rows."""
        return len(self.lines) or max((len(column.values) for column in self.columns), default=0)

    @property
    def row_lines(self) -> Sequence[int]:
        """Return the line number of each row; in formats without lines, the number of each row."""
        return self.lines or range(1, self.rows + 1)

    @cached_property
    def by_name(self) -> Mapping[str, Column]:
        """Return name → column."""
        return {column.name: column for column in self.columns}

    def __contains__(self, name: str) -> bool:
        return name in self.by_name

    def __getitem__(self, name: str) -> Array:
        return np.asarray(self.by_name[name].values, dtype=np.float64)


@dataclass(frozen=True)
class Use:
    """How the caller of `read_table` uses a column.

    Attributes:
        name: Name of the signal.
        factor: Factor by which the numbers of the column are multiplied before `offset` is added.
        role: Description of the signal in messages, such as "the time" or "an input", if cells must not be empty. "":
            an empty cell becomes NaN.
        spare: True for an optional column: a cell without a finite number is not a fault, but the column is left out.
    """

    name: str
    factor: float = 1.0
    offset: float = 0.0
    role: str = ""
    spare: bool = False


class Source:
    """A table format.

    Attributes:
        name: Name in messages.
        suffixes: Lower-case suffixes with the dot.
        magic: First bytes of every file, b"" if they differ.
        writes: True if results can be written in the format.
    """

    name = ""
    suffixes: tuple[str, ...] = ()
    magic = b""
    writes = False

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns.

        Args:
            names: Names of signals. Brackets in these names do not contain units.
            text: Names of columns to read as text, even if their cells are numbers.

        Raises:
            InputError: The file cannot be read.
        """
        raise NotImplementedError

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write columns, time first, completely or not at all."""
        raise NotImplementedError

    def check_writable(self) -> None:
        """Raise InputError if a library for writing is missing."""

    def column_names(self, path: Path) -> list[str]:
        """Return the column names; raise InputError or OSError if unreadable."""
        return [column.name for column in self.read(path).columns]


class Faults:
    """Faults of a file. Equal faults in many cells of a column are reported once, at the first cell.

    Attributes:
        header: Line of the header.
        faulty: Positions of the columns with faulty cells.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.header = path, 0
        self.items: list[Fault] = []
        self.faulty: set[int] = set()

    def note(self, line: int, cell: int, message: str) -> None:
        """Record a fault; line and cell count from 1; 0 means the whole file."""
        self.items.append(Fault(self.path, line, cell, message))

    def note_cells(self, rows: Rows, lines: Sequence[int], cell: int, message: Callable[[int], str]) -> None:
        """Record faulty cells of a column as one fault.

        Args:
            message: Function from a row to its message.
        """
        if len(rows):
            self.faulty.add(cell)
            further = (
                f" (same fault in {counted(len(rows) - 1, 'further cell')} of this column)" if len(rows) > 1 else ""
            )
            self.note(lines[rows[0]], cell, f"{message(int(rows[0]))}{further}")

    def raise_any(self) -> None:
        """Raise InputError if any fault was recorded."""
        items = sorted(self.items, key=lambda fault: (fault.line, fault.column))
        if (more := len(items) - SHOWN_FAULTS) > 0:
            items = [*items[:SHOWN_FAULTS], Fault(self.path, 0, 0, f"{counted(more, 'further fault')} below")]
        refuse(items)


# -- reading --------------------------------------------------------------------------------------


def read_source(faults: Faults, names: Container[str] = (), text: Collection[str] = ()) -> Table:
    """Return all columns of a file, and record its faults; for an unreadable file, return an empty table."""
    path = faults.path
    try:
        if not path.is_file():
            faults.note(0, 0, "is not a file" if path.exists() else "no such file")
            return Table()
        table = source_of(path).read(path, names, text)
    except InputError as error:
        faults.items += error.faults
        return Table()
    except OSError as error:
        faults.note(0, 0, f"cannot be read: {error.strerror}")
        return Table()
    faults.header = table.header
    faults.items += table.faults
    return replace(table, columns=[replace(column, cell=k) for k, column in enumerate(table.columns, 1)])


def read_table(
    faults: Faults,
    choose: Callable[[Column], Use | None],
    description: str,
    *,
    names: Container[str] = (),
    times: Collection[str] | None = None,
    jumps: bool = False,
) -> Table | None:
    """Return the columns that a caller selects, as numbers in the requested units, and record all faults.

    Args:
        choose: Function from a column to its use; None skips the column, perhaps with a fault.
        description: Description of the columns after time, for messages on empty files.
        names: Names of signals. Brackets in these names do not contain units.
        times: Names that the user gave to the time column, which may then be any column. None: the first column must be
            `time`.
        jumps: Accept rows with equal times, which mark a jump of the values.

    Returns:
        The table; None if the header is unreadable. A missing time column is a fault; the other columns are then
        returned.
    """
    table = read_source(faults, names)
    if not table.columns:
        if not faults.items:
            faults.note(0, 0, f"has no columns; the first line of a CSV names them: time, then {description}")
        return None
    if times is not None:
        table = time_first(table, faults, times, names)
    has_time = is_time(table.columns[0].name)
    if not has_time:
        note_wrong_first(faults, table)
    uses: dict[str, tuple[Use, Column]] = {}
    for place, column in enumerate(table.columns):
        if not has_time and (not place or is_time(column.name)):
            continue
        column, cell = replace(column, name=column.name if place else "time"), column.cell
        if (use := choose(column)) is not None and use.name in uses:
            before = uses[use.name][1].cell
            faults.note(table.header, cell, f'columns {before} and "{column.name}" are both {use.name}; keep one')
        elif use is not None:
            uses[use.name] = use, column
    columns, spoiled = list[Column](), list[str]()
    for use, column in uses.values():
        values = numbers_of(column, use, table, faults, jumps=jumps)
        if values is None:
            spoiled.append(use.name)
        else:
            columns.append(replace(column, name=use.name, values=values))
    return replace(table, columns=columns, lines=table.row_lines, spoiled=spoiled)


def time_first(table: Table, faults: Faults, named: Collection[str], signals: Container[str]) -> Table:
    """Return a table with the time as first column; dates become seconds.

    The time is the column named by the user, otherwise `time`, otherwise a column with another usual name, otherwise
    the first column with increasing numbers. A column chosen in one of the last two ways must not be a signal of the
    model. A column of row numbers without a name is left out.
    """
    columns = [c for c in table.columns if not (c.name.casefold() in NAMELESS and _counts_rows(c))]
    assumed = list(table.assumed)
    exact = [c for c in columns if c.name in named] or [c for c in columns if is_time(c.name)]
    others = [c for c in columns if c.name not in signals]
    usual = [c for c in others if c.name.casefold() in TIME_NAMES]
    if named and not any(c.name in named for c in columns):
        (wanted, *_), known = named, [c.name for c in columns]
        message = f'has no column "{wanted}"{did_you_mean(wanted, known)} for the time'
        faults.note(table.header, 1, message)
    if not exact and len(usual) > 1:
        names = ", ".join(c.name for c in usual)
        message = f"each of {names} may be the time; choose one with --column {usual[0].name}=time"
        faults.note(table.header, usual[1].cell, message)
    increasing = (c for c in others if number_of(c.name) is None and _increases(c))
    time = next(chain(exact, usual, increasing), None)
    if time is None:
        return replace(table, columns=columns or table.columns)
    if time.name not in named and not (is_time(time.name) and time.cell == 1):
        assumed.append(f"time is read from column {time.cell}, {time.name}{f' [{time.unit}]' if time.unit else ''}")
    values = time.values
    if not time.numeric and not time.fault and (found := _seconds_of_dates(time, table, faults)) is not None:
        values, begin = found
        assumed.append(f"time 0 is {begin.isoformat(sep=' ')}")
    first = replace(time, name="time", values=values)
    return replace(table, columns=[first, *(c for c in columns if c is not time)], assumed=tuple(assumed))


def _counts_rows(column: Column) -> bool:
    """Return True if a column contains consecutive row numbers."""
    values = column.values
    return isinstance(values, np.ndarray) and values.dtype.kind in "iu" and bool(np.all(np.diff(values) == 1))


def _increases(column: Column) -> bool:
    """Return True if a column has increasing numbers or dates."""
    values = column.values
    if column.fault or len(values) < 2:
        return False
    if not isinstance(values, np.ndarray):
        return all(date_of(text) is not None for text in values[:2])
    return bool(np.all(np.diff(values.astype(np.float64)) > 0.0))


def date_of(text: Any) -> datetime | None:
    """Return the date of a spreadsheet cell, an ISO 8601 text, or day.month.year with a time of day.

    The result is None for other values.
    """
    if isinstance(text, datetime):
        return text
    cell = str(text).strip()
    if DAY_FIRST.match(cell):
        day, month, year = cell[:2], cell[3:5], cell[6:10]
        cell = f"{year}-{month}-{day}{cell[10:]}"
    with suppress(ValueError):
        return datetime.fromisoformat(cell) if len(cell) > len("2026-01-01") else None
    return None


def _seconds_of_dates(column: Column, table: Table, faults: Faults) -> tuple[Array, datetime] | None:
    """Return seconds since the first row, and the date of the first row; None if the first cell has no date.

    Any other cell without a date is a fault.
    """
    dates = [date_of(text) for text in column.values]
    begin = next(iter(dates), None)
    if begin is None:
        return None
    has_zone = begin.tzinfo is not None
    good = np.array([d is not None and (d.tzinfo is not None) == has_zone for d in dates])
    seconds = [(d - begin).total_seconds() if is_good and d else 0.0 for d, is_good in zip(dates, good, strict=True)]

    def message(row: int) -> str:
        return f'"{str(column.values[row]).strip()[:40]}" is not a time stamp like {str(column.values[0]).strip()[:40]}'

    faults.note_cells(np.flatnonzero(~good), table.row_lines, column.cell, message)
    return np.where(good, seconds, np.nan), begin


def numbers_of(column: Column, use: Use, table: Table, faults: Faults, *, jumps: bool = False) -> Array | None:
    """Return a column's numbers in the requested unit, and record its faulty cells.

    Times that are too large or decrease are faults too; equal times are faults unless `jumps`. The result is None for a
    column that is left out because its use is `spare` and a cell is faulty.
    """
    lines, cell = table.row_lines, column.cell
    wrong = np.zeros(len(lines), bool)
    values = np.full(len(lines), np.nan)
    if column.numeric:
        values[:] = column.values
    elif column.fault or not table.header:  # Cells that were not read as text have no line and column.
        if use.spare:
            return None
        faults.faulty.add(cell)
        faults.note(table.header, cell, f"column {use.name} {column.fault or 'has text; write numbers'}")
        return values
    else:
        for row, text in enumerate(column.values):
            number = number_of(text)
            wrong[row], values[row] = number is None, np.nan if number is None else number
    if table.own_times and use.role:
        last = np.maximum.accumulate(np.where(np.isnan(values), -1, np.arange(values.size)))
        values = np.where(last >= 0, values[last], np.nan)
    if use.spare:
        return use.factor * values if np.isfinite(values).all() else None
    cure = "write a number or delete the row" if use.role else "leave the cell empty if the value is missing"
    infinite, missing = np.isinf(values), np.isnan(values) & ~wrong & bool(use.role)

    def message(row: int) -> str:
        text = str(column.values[row]).strip()[:30]
        if missing[row]:
            known = f"{use.role} needs a value in every row: fill the cell or delete the row"
            return f"{use.name} has no value here; {known}"
        if DECIMAL_COMMA.fullmatch(text):
            return f'"{text}" in column {use.name} has a decimal comma; use a decimal point'
        return f'"{text}" in column {use.name} is {"not finite" if infinite[row] else "not a number"}; {cure}'

    for kind in (wrong, infinite, missing):
        faults.note_cells(np.flatnonzero(kind), lines, cell, message)
    values[infinite] = np.nan
    scaled: Array = values * use.factor
    if use.name == "time":
        _check_times(scaled, lines, cell, faults, jumps=jumps)
        return scaled
    return scaled + use.offset if use.offset else scaled  # Without offset, a negative zero keeps its sign.


def number_of(text: str) -> float | None:
    """Return the number in a cell's text; NaN for a blank cell, None for other text."""
    if not text or text.isspace():
        return math.nan
    try:
        return None if "_" in text else float(text)  # Python ignores underscores in numbers.
    except ValueError:
        return None


def _check_times(time: Array, lines: Sequence[int], cell: int, faults: Faults, *, jumps: bool) -> None:
    """Record times that are too large or do not increase."""
    cure = "too large; write seconds, or delete the row"
    large = np.abs(time) > MOST_TIME
    faults.note_cells(np.flatnonzero(large), lines, cell, lambda row: f"time is {time[row]:g} s, {cure}")
    rows = np.flatnonzero(np.isfinite(time) & ~large)
    steps = np.diff(time[rows])
    late = np.flatnonzero(steps < 0.0 if jumps else steps <= 0.0) + 1
    before = dict(zip(rows[late].tolist(), time[rows[late - 1]].tolist(), strict=True))

    def message(row: int) -> str:
        cure = "sort the rows, and keep one row per time"
        if time[row] == before[row] and math.ulp(time[row]) > FLOAT_RESOLUTION_S:
            cure = "doubles of this size are too coarse: subtract the first time from all times before writing"
        return f"time {time[row]:g} s does not increase, the row before has {before[row]:g} s; {cure}"

    faults.note_cells(rows[late], lines, cell, message)


def note_wrong_first(faults: Faults, table: Table) -> None:
    """Record as a fault that the first column is not the time."""
    first = table.columns[0].name if table.columns else ""
    place = next((cell for cell, column in enumerate(table.columns, 1) if is_time(column.name)), 0)
    hint = f"; time is column {place}: move it to the front" if place else did_you_mean(first, ["time"])
    if number_of(first) is not None and first:
        hint = "; the file has no header: add a first line with the column names"
    faults.note(table.header, 1, f'the first column is "{first}"; it must be "time" [s]{hint}')


def read_columns(path: Path, names: Collection[str] = (), text: Collection[str] = ()) -> Table:
    """Read the time [s] and every column of numbers. Rows with equal times mark a jump of the values.

    Args:
        names: Required columns; brackets in these names do not contain units. If there are any, other columns without
            numbers are ignored.
        text: Text columns, which are not read.

    Raises:
        InputError: The file has faults.
    """
    faults = Faults(path)

    def choose(column: Column) -> Use | None:
        if column.name == "time":
            return Use("time", time_scale(faults, faults.header, column.unit), role="the time")
        if not column.name:
            faults.note(faults.header, column.cell, "the column has no name; name it in the header")
        if not column.name or column.name in text:
            return None
        spare = bool(names) and column.name not in names
        return Use(column.name, role="" if spare else "a column played back", spare=spare)

    table = read_table(faults, choose, "signals", names=names, times=(), jumps=True)
    if table is not None and not table.rows and not table.faults:
        faults.note(table.header + 1, 1, "has no rows; write at least one below the header")
    faults.raise_any()
    assert table is not None
    return table


def read_header(path: Path) -> list[str]:
    """Return a file's column names; an empty list if unreadable."""
    try:
        return source_of(path).column_names(path) if path.is_file() else []
    except (InputError, OSError, ValueError):
        return []


# -- names, units and values ----------------------------------------------------------------------


def is_time(name: str) -> bool:
    """Return True if a name is `time`, in upper or lower case."""
    return name.casefold() == "time"


def table_by_time(columns: Sequence[Column]) -> Table:
    """Return the columns of another tool's file as a table whose first column is the time; empty without a time.

    The time is the column `time` in upper or lower case, otherwise `t`, but not `T`, which usually is a temperature.
    Columns of another length are left out.
    """
    names = [column.name for column in columns]
    found = next((name for name in names if is_time(name)), "t" if "t" in names else None)
    if found is None:
        return Table()
    time = columns[names.index(found)]
    others = [column for column in columns if column is not time and len(column.values) == len(time.values)]
    return Table([replace(time, name="time", unit=time.unit or "s"), *others])


def time_scale(faults: Faults, line: int, unit: str) -> float:
    """Return the factor from a unit of time to seconds; record a fault for an unknown unit."""
    scale = factor(unit, "s")
    if scale is None:
        faults.note(line, 1, f'"{unit}" is not a unit of time; known units: {", ".join(alternatives("s"))}')
    return 1.0 if scale is None else scale


def split_heading(text: str, names: Container[str] = ()) -> tuple[str, str]:
    """Return name and unit of a header cell `name [unit]`.

    Brackets in one of `names`, or around an index, belong to the name. The unit is "" if absent.
    """
    whole = text.strip()
    name, bracket, unit = whole.rpartition("[")
    name, unit = name.strip(), unit.removesuffix("]").strip()
    if not bracket or whole in names or "]" in unit:
        return whole, ""
    return (whole, "") if INDEX.search(whole) and name not in names else (name, unit)


def plain_numbers(values: Array) -> Array:
    """Return an array of numbers as doubles or as 64-bit integers, unsigned if a value requires it."""
    if values.dtype.kind not in "biu":
        return values.astype(np.float64)
    is_beyond = values.dtype.kind == "u" and bool(np.any(values > np.iinfo(np.int64).max))
    return values.astype(np.uint64 if is_beyond else np.int64)


def as_text(value: Any) -> str:
    """Return a value other than a double as text; binary data as hexadecimal digits."""
    return value.hex() if isinstance(value, bytes) else str(value)


# -- formats --------------------------------------------------------------------------------------


@functools.cache
def sources() -> tuple[Source, ...]:
    """Return the formats, installed packages last."""
    own = [resolve(place) for place in OWN_FORMATS]
    return (*own, *(source for _, source in registered(SOURCES_GROUP, Source)))


def suffixes() -> tuple[str, ...]:
    """Return the suffixes of table files, `.csv` first."""
    return tuple(suffix for source in sources() for suffix in source.suffixes)


def source_of(path: Path) -> Source:
    """Return the table format of a file, from its first bytes or its suffix.

    Text with an unknown suffix is read as CSV.

    Raises:
        InputError: The format is unknown.
    """
    head = b""
    with suppress(OSError, ValueError), open_bytes(path) as stream:
        head = stream.read(FORMAT_HEAD_BYTES)
    by_suffix = [s for s in sources() if path.suffix.lower() in s.suffixes][:1]
    if by_head := [s for s in (*by_suffix, *sources()) if s.magic and head.startswith(s.magic)]:
        return by_head[0]
    if not by_suffix and b"\0" in head:
        formats = ", ".join(f"{source.name} ({', '.join(source.suffixes)})" for source in sources())
        raise InputError.at(path, f"has an unknown format; supported: {formats}")
    return (by_suffix or sources())[0]


def source_named(name: str) -> Source:
    """Return the table format with a name; raise InputError if it is unknown or cannot be written."""
    word = name.lower().removeprefix(".")
    written = [source for source in sources() if source.writes]
    found = [source for source in written if word == source.name.lower() or f".{word}" in source.suffixes]
    if not found:
        known = ", ".join(f"{source.name} ({', '.join(source.suffixes)})" for source in written)
        raise InputError.at(Path("--format"), f'no format "{name}"; known formats: {known}')
    return found[0]
