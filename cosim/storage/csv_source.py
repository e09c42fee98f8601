"""CSV files: read at once by numpy, or cell by cell if faulty, so that every fault has its place."""

from __future__ import annotations

import csv
import io
import math
import re
from array import array
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from cosim.base.arrays import Array
from cosim.base.messages import Message
from cosim.base.text import counted
from cosim.storage import messages
from cosim.storage.files import atomic_write, open_bytes
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
    split_heading,
)
from cosim.storage.table_source import Frame, Source, SourceColumn, fill

MOST_BYTES = 200_000_000  # size of a file [bytes]; files are read whole to report every fault
LONGEST_LINE = 2_000_000  # length of a line [bytes], enough for about 100 000 columns
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "vertical bars", " ": "blanks"}
EMPTY_CELL = re.compile(rb",(?=[,\r\n]|\Z)")


class Csv(Source):
    """Comma-separated values in UTF-8, with a header line."""

    name = "CSV"
    suffixes = (".csv",)
    writes = True

    def table(self, faults: Faults, request: TableRequest) -> Table:
        """Read the requested columns and note the faults of all cells."""
        try:
            if _is_small_enough(faults, request.shorter):
                with _open(faults.path) as stream:
                    return _read_table(_Cells(stream, faults), request)
        except OSError as error:
            faults.note(0, 0, f"cannot be read: {error.strerror}")
        return Table()

    def frame(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Frame:
        """Read all columns, non-numeric ones as text; raise InputError with all faults."""
        faults = Faults(path)
        frame = Frame()
        if _is_small_enough(faults, "leave out columns or rows"):
            with _open(path) as stream:
                cells = _Cells(stream, faults)
                if cells.header:
                    frame = _frame_of(cells, names, text)
                elif not faults.items:
                    faults.note(1, 1, "is empty; the first line names the columns: time, then signals")
        faults.raise_any()
        return frame

    def column_names(self, path: Path) -> list[str]:
        """Return the names in the header, none if unreadable."""
        try:
            with _open(path) as stream:
                return [split_heading(text)[0] for text in _Cells(stream, Faults(path)).header]
        except OSError:
            return []

    def write(self, path: Path, columns: Sequence[SourceColumn]) -> None:
        """Write columns with exactly reproducible numbers."""
        values = [c.values.tolist() if isinstance(c.values, np.ndarray) else c.values for c in columns]
        write_table(path, [c.name for c in columns], zip(*values, strict=True), cell_text)


CSV = Csv()


def read_heading(path: Path, names: Container[str] = ()) -> tuple[list[tuple[str, str]], int]:
    """Return names and units of the columns, and the number of lines down to the header.

    Raises:
        ValueError: The cells are not separated by commas, or there is no header.
    """
    with _open(path) as stream:
        cells = _Cells(stream, Faults(path))
    if not cells.header or not cells.plain:
        raise ValueError("the header is no CSV")
    return [split_heading(cell, names) for cell in cells.header], cells.line


def _is_small_enough(faults: Faults, cure: str) -> bool:
    size = faults.path.stat().st_size
    if size > MOST_BYTES:
        faults.note(0, 0, f"has {size / 1e6:.0f} MB, more than the {MOST_BYTES / 1e6:.0f} MB that are read; {cure}")
    return size <= MOST_BYTES


# -- text -----------------------------------------------------------------------------------------


class _BadLine(Exception):
    """A message on a line that cannot be read."""


def _open(path: Path) -> TextIO:
    """Open a CSV with a character per byte and any line end."""
    return io.TextIOWrapper(open_bytes(path), encoding="latin-1", newline="")


def _lines(stream: TextIO) -> Iterator[str]:
    """Yield the UTF-8 lines of a file from `_open`. A byte order mark is left out."""
    while line := stream.readline(LONGEST_LINE + 1):
        if len(line) > LONGEST_LINE:
            raise _BadLine(f"the line has more than {LONGEST_LINE / 1e6:g} MB; is this a CSV?")
        try:
            yield line.encode("latin-1").decode("utf-8-sig")
        except UnicodeDecodeError:
            raise _BadLine("is not UTF-8 text; save it as plain CSV, UTF-8") from None


def _has_text(row: Sequence[str]) -> bool:
    return any(cell.strip() for cell in row)


class _Cells:
    """Header and rows of a CSV as text; faults of the text are noted.

    Attributes:
        header: Cells of the first non-blank line; empty for an empty file or binary data.
        line: Line number of the header.
        plain: Whether commas separate cells.
        whole: Whether all rows were read.
    """

    def __init__(self, stream: TextIO, faults: Faults) -> None:
        self.faults = faults
        self.header: list[str] = []
        self.line, self.plain, self.whole = 1, True, False
        self._text = _lines(stream)
        self._rows, self._above = csv.reader(self._text), 0  # rows, and the number of lines read by an earlier reader
        with self._noting_faults():
            self._read_header()

    def _read_header(self) -> None:
        header = next(filter(_has_text, self._rows), [])
        self.line = max(1, self._rows.line_num)
        if any("\0" in text for text in header):
            self.faults.note(self.line, 1, "is a binary file, or text of another encoding; save it as plain CSV, UTF-8")
            return
        only = header[0] if len(header) == 1 else ""
        has_unit = "[" in only  # which a blank separates from its name
        if mark := next((m for m in SEPARATORS if m in only.strip() and not (m == " " and has_unit)), None):
            self.faults.note(
                self.line,
                1,
                f"cells are separated by {SEPARATORS[mark]}; separate them with commas, decimals with a point",
            )
            split = partial(csv.reader, delimiter=mark, skipinitialspace=True)
            header = next(split([only.strip()]))  # Reading continues, to report further faults.
            self._above, self._rows = self._rows.line_num, split(self._text)
            self.plain = False
        self.header = header

    def rows(self, keep: Callable[[int, list[str]], None]) -> None:
        """Pass each row of the right length with its line to `keep`. Other rows are noted as faults."""
        faults, width = self.faults, len(self.header)
        with self._noting_faults():
            for row in filter(_has_text, self._rows):
                if len(row) == width:
                    keep(self._line(), row)
                else:
                    is_cut = len(row) == 2 * width
                    template = messages.ROW_WITH_DECIMAL_COMMAS if is_cut else messages.ROW_OF_OTHER_LENGTH
                    message = template(cells=counted(len(row), "cell"), header=width)
                    faults.note_cell(self._line(), 1, "rows of another length", message)
                if faults.is_full:
                    faults.note(self._line(), 1, "too many faults to read on; correct those of the earlier lines first")
                    return
            self.whole = True

    @contextmanager
    def _noting_faults(self) -> Iterator[None]:
        """Note unreadable lines as faults, ending the `with` block."""
        try:
            yield
        except _BadLine as error:
            self.faults.note(self._line() + 1, 1, str(error))
        except csv.Error as error:
            self.faults.note(self._line(), 1, f"is not CSV: {error}")

    def _line(self) -> int:
        return self._above + self._rows.line_num


# -- all cells at once ----------------------------------------------------------------------------


def _plain_numbers(cells: _Cells) -> tuple[Array, Sequence[bytes]] | None:
    """Return cells as numbers, and the text of the first row; None if any cell is not plainly a number.

    Empty cells become NaN.
    """
    body, width = cells.faults.path.read_bytes(), len(cells.header)
    for _ in range(cells.line):
        body = body.partition(b"\n")[2]
    if not body.strip() or not body.isascii() or b'"' in body or body.count(b"\r") != body.count(b"\r\n"):
        return None
    if b",," in body or b",\n" in body or b",\r" in body or body.endswith(b","):
        body = EMPTY_CELL.sub(b",nan", body)
    rows = body.count(b"\n") + (not body.endswith(b"\n"))
    try:
        numbers: Array = np.loadtxt(io.BytesIO(body), np.float64, comments=None, delimiter=",", ndmin=2)
    except ValueError:  # a cell without a number, or a row of another length
        return None
    return (numbers, body.partition(b"\n")[0].split(b",")) if numbers.shape == (rows, width) else None


def _frame_of(cells: _Cells, names: Container[str], text: Collection[str]) -> Frame:
    """Return all columns below a header."""
    headings = [split_heading(cell, names) for cell in cells.header]
    plain = _plain_numbers(cells) if cells.plain and not text else None
    if plain is not None and not _may_be_whole(*plain):
        columns = [SourceColumn(*pair, values) for pair, values in zip(headings, plain[0].T, strict=True)]
        return Frame(columns, range(cells.line + 1, cells.line + 1 + len(plain[0])))
    lines, rows = array("q"), list[list[str]]()

    def keep(line: int, row: list[str]) -> None:
        lines.append(line)
        rows.append(row)

    cells.rows(keep)
    by_column = zip(*rows, strict=True) if rows else ((),) * len(headings)
    return Frame([_column(*pair, c, pair[0] in text) for pair, c in zip(headings, by_column, strict=True)], lines)


def _may_be_whole(numbers: Array, first: Sequence[bytes]) -> bool:
    """Return whether the text of some column may be integers. The numbers alone do not show this."""
    digits = [k for k, cell in enumerate(first) if cell.strip().removeprefix(b"-").isdigit()]
    with np.errstate(invalid="ignore"):
        return any(bool((numbers[:, k] == np.rint(numbers[:, k])).all()) for k in digits)


def _column(name: str, unit: str, cells: Sequence[str], is_text: bool) -> SourceColumn:
    if is_text:
        return SourceColumn(name, unit, list(cells))
    try:
        values = np.array([cell if cell and not cell.isspace() else "nan" for cell in cells], dtype=np.float64)
    except ValueError:
        return SourceColumn(name, unit, list(cells))
    # Integers are recognised by their text: floats always have a point or an exponent.
    if cells and all(cell.removeprefix("-").isdecimal() for cell in cells):
        integers = [*map(int, cells)]
        for kind in (np.int64, np.uint64):
            if np.iinfo(kind).min <= min(integers) and max(integers) <= np.iinfo(kind).max:
                return SourceColumn(name, unit, np.array(integers, dtype=kind))
    return SourceColumn(name, unit, values)


# -- cell by cell ---------------------------------------------------------------------------------


def _read_table(cells: _Cells, request: TableRequest) -> Table:
    """Return the requested columns of a table; each cell is checked if any has a fault."""
    faults, table = cells.faults, Table(header=cells.line)
    if not cells.header:
        if not faults.items:
            faults.note(1, 1, f"is empty; the first line names the columns: {request.description}")
        return table
    headings = [split_heading(text, request.names) for text in cells.header]
    choose_columns(table, [Heading(cells.line, k, *pair) for k, pair in enumerate(headings, 1)], faults, request)
    if request.timed and "time" not in table.columns:
        return table
    plain = _plain_numbers(cells) if cells.plain else None
    if plain is not None:
        numbers, _ = plain
        columns = [SourceColumn(*pair, values) for pair, values in zip(headings, numbers.T, strict=True)]
        trial, lines = Faults(faults.path), range(cells.line + 1, cells.line + 1 + len(numbers))
        candidate = Table(dict(table.columns), header=table.header, first=table.first)
        fill(candidate, columns, lines, trial, request)
        if not trial.counts:
            return candidate
    reader = _Reader(table, faults, request)
    cells.rows(reader.row)
    table.whole = cells.whole
    return table


class _Reader:
    """Reader of a table, cell by cell."""

    def __init__(self, table: Table, faults: Faults, request: TableRequest) -> None:
        self.table, self.faults, self.timed, self.jumps = table, faults, request.timed, request.jumps
        columns = [c for c in table.columns.values() if c.cell > 1 or not request.timed]
        self.signals = [(c, c.cell - 1, table.values[c.name]) for c in columns]  # all columns but time

    def row(self, line: int, row: list[str]) -> None:
        """Take the cells of a row."""
        if self.timed and not self._time(line, row[0]):
            return
        for column, place, values in self.signals:
            values.append(self._value(line, column, row[place]))
        self.table.lines.append(line)

    def _time(self, line: int, text: str) -> bool:
        """Take the time of a row; return False without a time."""
        time, before = self._value(line, self.table.columns["time"], text), self.table.values["time"]
        if self.table.columns["time"].spare:
            before.append(time)
            return True
        if math.isnan(time):
            return False
        if abs(time) > MOST_TIME:
            note_distant(self.faults, line, time)
            return False
        if before and (time < before[-1] if self.jumps else time <= before[-1]):
            note_backwards(self.faults, line, time, before[-1])
        before.append(time)
        return True

    def _value(self, line: int, column: Column, text: str) -> float:
        """Return a cell's converted number; NaN if empty or faulty."""
        try:
            value = _number(text) if text and not text.isspace() else math.nan
        except ValueError:
            value = math.nan
            if not column.spare:
                self.faults.note_cell(line, column.cell, *_no_number(text, column))
                return value
        if column.spare:
            if not math.isfinite(value):
                self.table.spoiled.add(column.name)
        elif math.isinf(value):
            note_infinite(self.faults, line, column, text.strip())
            return math.nan
        elif column.role and math.isnan(value):
            note_missing(self.faults, line, column)
        return float(column.convert(value))


def _number(text: str) -> float:
    """Return the number of a cell; raise ValueError without one, also for an underscore, which Python reads over."""
    if "_" in text:
        raise ValueError(text)
    return float(text)


def _no_number(text: str, column: Column) -> tuple[str, Message]:
    """Return a faulty cell's plural and message."""
    cell, name = text.strip()[:30], column.name
    if DECIMAL_COMMA.fullmatch(cell):
        return f"cells of {name} with a decimal comma", f'"{cell}" in column {name} has a decimal comma: write a point'
    return f"cells of {name} that are no number", f'"{cell}" in column {name} is no number; {column.cure}'


# -- writing --------------------------------------------------------------------------------------


def write_table(
    path: Path, header: Sequence[str], rows: Iterable[Iterable[Any]], number: Callable[[Any], str] = repr
) -> None:
    """Write a header and rows.

    Args:
        number: Formats a cell; by default the shortest text that reads back bit for bit.
    """
    with atomic_write(path) as stream:
        write_rows(stream, header, rows, number)


def write_rows(
    stream: TextIO, header: Sequence[str], rows: Iterable[Iterable[Any]], number: Callable[[Any], str] = repr
) -> None:
    """Write a header and rows to a stream, as `write_table`."""
    csv.writer(stream, lineterminator="\n").writerow(header)
    stream.writelines(",".join(map(number, row)) + "\n" for row in rows)


def table_bytes(columns: Mapping[str, Iterable[float]]) -> bytes:
    """Return a CSV file of columns with full precision and an empty cell for a missing number."""
    stream = io.StringIO()
    rows = zip(*columns.values(), strict=True)
    write_rows(stream, [*columns], rows, lambda value: repr(value) if math.isfinite(value) else "")
    return stream.getvalue().encode()


def cell_text(value: Any) -> str:
    """Return a value as a CSV cell. Binary data become hexadecimal digits; text is quoted if necessary."""
    if isinstance(value, bytes):
        return value.hex()
    if not isinstance(value, str):
        return repr(value)
    return '"' + value.replace('"', '""') + '"' if any(c in value for c in ',"\r\n') else value
