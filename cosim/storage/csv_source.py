"""CSV files: read by pyarrow if all cells are numbers, otherwise row by row, so that every fault has its place."""

from __future__ import annotations

import csv
import io
from array import array
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, InputError
from cosim.base.text import counted
from cosim.storage.files import atomic_write, open_bytes
from cosim.storage.table import SHOWN_FAULTS, Column, Source, Table, number_of, split_heading

MOST_BYTES = 200_000_000  # size of a file [bytes]; files are read whole
CHUNK = 1000  # rows written at a time
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "vertical bars", " ": "blanks"}


class Csv(Source):
    """Comma-separated values in UTF-8, with a header line."""

    name = "CSV"
    suffixes = (".csv",)
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns, non-numeric ones as text."""
        if (size := path.stat().st_size) > MOST_BYTES:
            sizes = f"{size / 1e6:.0f} MB, more than the {MOST_BYTES / 1e6:.0f} MB that are read"
            cure = "leave out columns or rows, cut a log into pieces of one study, or write Parquet"
            raise InputError.at(path, f"has {sizes}; {cure}")
        with open_bytes(path) as stream:
            content = stream.read()
        rows = _Rows(path, io.BytesIO(content))
        headings = [split_heading(cell, names) for cell in rows.header]
        columns = None
        if rows.is_plain and rows.header and not text:
            columns = _numbers(content, rows.line, headings)
        if columns is not None:
            lines: Sequence[int] = range(rows.line + 1, rows.line + 1 + len(columns[0].values))
        else:
            by_column, lines = rows.read()
            columns = [_column(*pair, c, pair[0] in text) for pair, c in zip(headings, by_column, strict=True)]
        if not rows.header and not rows.faults:
            rows.note(1, "is empty; the first line names the columns")
        return Table(columns, lines, rows.line, rows.faults)

    def column_names(self, path: Path) -> list[str]:
        """Return the names in the header, none if unreadable."""
        try:
            with open_bytes(path) as stream:
                rows = _Rows(path, stream)
        except OSError:
            return []
        return [split_heading(text)[0] for text in rows.header]

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write columns with exactly reproducible numbers."""
        is_plain = all(isinstance(column.values, np.ndarray) for column in columns)

        def rows() -> Iterator[tuple[Any, ...]]:
            for first in range(0, len(columns[0].values), CHUNK):  # Python floats need four times the memory.
                parts = (column.values[first : first + CHUNK] for column in columns)
                yield from zip(*(p.tolist() if isinstance(p, np.ndarray) else p for p in parts), strict=True)

        write_table(path, [column.name for column in columns], rows(), repr if is_plain else cell_text)


CSV = Csv()


def read_heading(path: Path, names: Container[str] = ()) -> tuple[list[tuple[str, str]], int]:
    """Return names and units of the columns, and the number of lines down to the header.

    Raises:
        ValueError: The cells are not separated by commas, or there is no header.
    """
    with open_bytes(path) as stream:
        rows = _Rows(path, stream)
    if not rows.header or not rows.is_plain:
        raise ValueError("the header is no CSV")
    return [split_heading(cell, names) for cell in rows.header], rows.line


# -- all cells at once ----------------------------------------------------------------------------


def _numbers(content: bytes, header: int, headings: Sequence[tuple[str, str]]) -> list[Column] | None:
    """Return columns of numbers below the header line; None if a line or a cell needs a closer look."""
    body = content
    for _ in range(header):
        body = body.partition(b"\n")[2]
    if not body.strip() or b'"' in body or body.count(b"\r") != body.count(b"\r\n"):
        return None
    from pyarrow import ArrowInvalid, BufferReader, float64, string
    from pyarrow.csv import ConvertOptions, ReadOptions, read_csv

    def read(places: Sequence[int], kind: Any) -> Any:
        names = [str(k) for k in places]
        options = ReadOptions(use_threads=False, column_names=[str(k) for k in range(len(headings))])
        types = ConvertOptions(column_types=dict.fromkeys(names, kind), include_columns=names, null_values=[""])
        return read_csv(BufferReader(body), options, convert_options=types)

    try:
        table = read(range(len(headings)), float64())
        values: list[Array] = [column.to_numpy() for column in table.columns]
        if table.num_rows != body.count(b"\n") + (not body.endswith(b"\n")) or np.isnan(values).all(axis=0).any():
            return None  # blank lines, or rows of empty cells
        first = body.partition(b"\n")[0].split(b",")
        digits = [k for k, cell in enumerate(first) if cell.strip().removeprefix(b"-").isdigit()]
        with np.errstate(invalid="ignore"):
            digits = [k for k in digits if (values[k] == np.rint(values[k])).all()]
        columns = [Column(*pair, column) for pair, column in zip(headings, values, strict=True)]
        if digits:  # Only their text shows whether they are integers.
            for k, column in zip(digits, read(digits, string()).columns, strict=True):
                columns[k] = _column(*headings[k], column.to_pylist(), is_text=False)
    except ArrowInvalid:  # a cell without a number, or a row of another length
        return None
    return columns


def _column(name: str, unit: str, cells: Sequence[str], is_text: bool) -> Column:
    """Return a column of cells: integers, doubles, or texts if a cell is no number."""
    if is_text:
        return Column(name, unit, list(cells))
    numbers = [number_of(cell) for cell in cells]
    if None in numbers:
        return Column(name, unit, list(cells))
    # Integers are recognised by their text: floats always have a point or an exponent.
    if cells and all(cell.removeprefix("-").isdecimal() and cell != "-0" for cell in cells):
        integers = [*map(int, cells)]
        for kind in (np.int64, np.uint64):
            if np.iinfo(kind).min <= min(integers) and max(integers) <= np.iinfo(kind).max:
                return Column(name, unit, np.array(integers, dtype=kind))
    return Column(name, unit, np.array(numbers, dtype=np.float64))


# -- row by row -----------------------------------------------------------------------------------


class _BadLine(Exception):
    """A message on a line that cannot be read."""


def _lines(stream: BinaryIO) -> Iterator[str]:
    """Yield the UTF-8 lines of a file with any line end. A byte order mark is left out."""
    for line in io.TextIOWrapper(stream, encoding="latin-1", newline=""):  # a character per byte
        try:
            yield line.encode("latin-1").decode("utf-8-sig")
        except UnicodeDecodeError:
            raise _BadLine("is not UTF-8 text; save it as plain CSV, UTF-8") from None


def _has_text(row: Sequence[str]) -> bool:
    return any(cell.strip() for cell in row)


class _Rows:
    """Header and rows of a CSV as text, and the faults of the text.

    Attributes:
        header: Cells of the first non-blank line; empty for an empty file or binary data.
        line: Line number of the header.
        is_plain: Whether commas separate cells.
    """

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.faults: list[Fault] = []
        self.header: list[str] = []
        self.line, self.is_plain = 1, True
        self._path, self._text = path, _lines(stream)
        self._reader, self._above = csv.reader(self._text), 0  # and the number of lines read by an earlier reader
        with self._noting_faults():
            self._read_header()

    def _read_header(self) -> None:
        header = next(filter(_has_text, self._reader), [])
        self.line = max(1, self._reader.line_num)
        if any("\0" in text for text in header):
            self.note(self.line, "is a binary file, or text of another encoding; save it as plain CSV, UTF-8")
            return
        only = header[0] if len(header) == 1 else ""
        has_unit = "[" in only  # which a blank separates from its name
        if mark := next((m for m in SEPARATORS if m in only.strip() and not (m == " " and has_unit)), None):
            separator = f"cells are separated by {SEPARATORS[mark]}"
            self.note(self.line, f"{separator}; separate them with commas, decimals with a point")
            header = next(csv.reader([only.strip()], delimiter=mark, skipinitialspace=True))
            self._above, self.is_plain = self._reader.line_num, False  # Reading continues, to report further faults.
            self._reader = csv.reader(self._text, delimiter=mark, skipinitialspace=True)
        self.header = header

    def read(self) -> tuple[Sequence[Sequence[str]], Sequence[int]]:
        """Return the cells of each column, and the line of each row; rows of another length are faults."""
        lines, rows, width = array("q"), list[list[str]](), len(self.header)
        with self._noting_faults():
            for row in filter(_has_text, self._reader) if width else ():
                if len(row) == width:
                    lines.append(self._line())
                    rows.append(row)
                    continue
                cure = "delete the row, or leave cells empty where nothing was measured"
                if len(row) == 2 * width:
                    cure = "is each number cut in two by a decimal comma? Write a point"
                self.note(self._line(), f"has {counted(len(row), 'cell')}, the header {width}; {cure}")
                if len(self.faults) >= SHOWN_FAULTS:
                    break
        return [*zip(*rows, strict=True)] if rows else [()] * width, lines

    def note(self, line: int, message: str) -> None:
        """Note a fault of a line."""
        self.faults.append(Fault(self._path, line, 1, message))

    @contextmanager
    def _noting_faults(self) -> Iterator[None]:
        """Note unreadable lines as faults, ending the `with` block."""
        try:
            yield
        except _BadLine as error:
            self.note(self._line() + 1, str(error))
        except csv.Error as error:
            self.note(self._line(), f"is not CSV: {error}")

    def _line(self) -> int:
        return self._above + self._reader.line_num


# -- writing --------------------------------------------------------------------------------------


def write_table(
    path: Path, header: Sequence[str], rows: Iterable[Iterable[Any]], number: Callable[[Any], str] = repr
) -> None:
    """Write a header and rows.

    Args:
        number: Formats a cell; by default the shortest text that reads back bit for bit.
    """
    with atomic_write(path) as stream:
        csv.writer(stream, lineterminator="\n").writerow(header)
        stream.writelines(",".join(map(number, row)) + "\n" for row in rows)


def write_columns(path: Path, time: Array, columns: Mapping[str, Array], units: Mapping[str, str]) -> None:
    """Write time and columns `name [unit]` as CSV with nine digits."""
    header = ["time", *(f"{name} [{units[name]}]" for name in columns)]
    rows = zip(time.tolist(), *(c.tolist() for c in columns.values()), strict=True)
    write_table(path, header, rows, "{:.9g}".format)


def cell_text(value: Any) -> str:
    """Return a value as a CSV cell. Binary data become hexadecimal digits; text is quoted if necessary."""
    if isinstance(value, bytes):
        return value.hex()
    if not isinstance(value, str):
        return repr(value)
    return '"' + value.replace('"', '""') + '"' if any(c in value for c in ',"\r\n') else value
