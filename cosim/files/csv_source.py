"""CSV files. pyarrow reads purely numeric files; other files are read row by row, so that each fault has a line."""

from __future__ import annotations

import csv
import io
import re
from array import array
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic_core import to_json

from cosim.core.arrays import Array
from cosim.core.errors import Fault, InputError
from cosim.core.text import counted
from cosim.files.files import atomic_write, open_bytes
from cosim.files.table import DECIMAL_COMMA, Column, Source, Table, number_of, split_heading

MAX_TABLE_BYTES = 200_000_000  # size of a file [bytes]; files are read whole
ROWS_PER_WRITE = 1000  # rows written at a time
PLAIN_SIZES = 1e-4, 1e16  # `repr` writes numbers from the first to below the second without an exponent
THOUSANDS = re.compile(r"\s*-?\d{1,3}([.,'’ ])\d{3}(\1\d{3})*(?!\1)[.,]\d+\s*")  # 1.234,5 and 1,234.5
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "vertical bars", " ": "blanks"}


class Csv(Source):
    """Comma-separated values in UTF-8, with a header line."""

    name = "CSV"
    suffixes = (".csv",)
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns, non-numeric ones as text."""
        if (size := path.stat().st_size) > MAX_TABLE_BYTES:
            sizes = f"{size / 1e6:.0f} MB; the limit is {MAX_TABLE_BYTES / 1e6:.0f} MB"
            cure = "remove columns or rows, split the log into several logs of one study, or write Parquet"
            raise InputError.at(path, f"has {sizes}; {cure}")
        with open_bytes(path) as stream:
            content = stream.read()
        header, line, mark = _header(io.BytesIO(content))
        message = ""
        if any("\0" in cell for cell in header):
            message = "is a binary file, or text of another encoding; save it as plain CSV, UTF-8"
        elif mark == " ":
            message = "cells are separated by blanks; separate them with commas, semicolons or tabs"
        if message:
            raise InputError([Fault(path, line, 1, message)])
        assumed: tuple[str, ...] = ()
        decimal = "."
        if mark != ",":
            cells = re.split(f"[\n{re.escape(mark)}]", content.decode("utf-8-sig", errors="replace"))
            decimal = "," if any(DECIMAL_COMMA.fullmatch(cell.strip()) for cell in cells) else "."
            commas = ", decimals have a comma" if decimal == "," else ""
            assumed = (f"cells are separated by {SEPARATORS[mark]}{commas}",)
        headings = [split_heading(cell, names) for cell in header]
        if header and not text and (columns := _numbers(content, line, headings, mark, decimal)) is not None:
            return Table(columns, range(line + 1, line + 1 + len(columns[0].values)), line, assumed=assumed)
        faults, by_column, lines = _texts(path, content, len(header), line, mark)
        for place, ((name, _), column) in enumerate(zip(headings, by_column, strict=True), 1):
            found = next((k for k, cell in enumerate(column) if THOUSANDS.fullmatch(cell)), None)
            if found is not None and name not in text:
                message = f"{column[found].strip()} has a separator of thousands; write numbers without one"
                raise InputError([Fault(path, lines[found], place, message)])
        columns = [cells_of(*pair, c, pair[0] in text) for pair, c in zip(headings, by_column, strict=True)]
        return Table(columns, lines, line, faults, assumed)

    def column_names(self, path: Path) -> list[str]:
        """Return the column names in the header."""
        with open_bytes(path) as stream:
            return [split_heading(text)[0] for text in _header(stream)[0]]

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write columns; reading the file returns bitwise equal numbers."""
        is_numeric = all(isinstance(c.values, np.ndarray) and c.values.dtype.kind in "iuf" for c in columns)
        with atomic_write(path) as stream:
            csv.writer(stream, lineterminator="\n").writerow([column.name for column in columns])
            for first in range(0, len(columns[0].values), ROWS_PER_WRITE):  # Python floats need four times the memory.
                part: list[Any] = [column.values[first : first + ROWS_PER_WRITE] for column in columns]
                if is_numeric:
                    stream.write(lines_of_numbers(part))
                else:
                    cells = (p.tolist() if isinstance(p, np.ndarray) else p for p in part)
                    stream.writelines(",".join(map(cell_text, row)) + "\n" for row in zip(*cells, strict=True))


CSV = Csv()


def _header(stream: BinaryIO) -> tuple[list[str], int, str]:
    """Return the cells of the first line that is not empty, its number in the file, and the separator between cells."""
    text = io.TextIOWrapper(stream, encoding="utf-8-sig", errors="replace", newline="")
    reader = csv.reader(text)
    try:
        header = next((row for row in reader if any(map(str.strip, row))), [])
    except csv.Error:
        return [], 1, ","
    finally:
        text.detach()  # otherwise the wrapper would close the file
    line = max(1, reader.line_num)
    only = header[0] if len(header) == 1 else ""
    for mark in SEPARATORS:
        if mark in only.strip() and not (mark == " " and "[" in only):  # A blank separates a unit from its name.
            return next(csv.reader([only.strip()], delimiter=mark, skipinitialspace=True)), line, mark
    return header, line, ","


# -- all cells at once ----------------------------------------------------------------------------


def _numbers(
    content: bytes, header: int, headings: Sequence[tuple[str, str]], mark: str, decimal: str
) -> list[Column] | None:
    """Return the numeric columns of a file without its header; None if the file must be read row by row."""
    body = b"".join(content.split(b"\n", header)[header:])
    if not body.strip() or b'"' in body or body.count(b"\r") != body.count(b"\r\n"):
        return None
    from pyarrow import ArrowInvalid, BufferReader
    from pyarrow.csv import ConvertOptions, ParseOptions, ReadOptions, read_csv

    reading = ReadOptions(use_threads=False, column_names=[str(k) for k in range(len(headings))])
    converting = ConvertOptions(null_values=[""], timestamp_parsers=[], decimal_point=decimal)
    try:
        table = read_csv(BufferReader(body), reading, ParseOptions(delimiter=mark), converting)
    except ArrowInvalid:  # a row of another length
        return None
    if table.num_rows != body.count(b"\n") + (not body.endswith(b"\n")):  # blank lines
        return None
    if not {str(kind) for kind in table.schema.types} <= {"int64", "double", "null"}:
        return None
    values = [(c if str(c.type) == "int64" else c.cast("double")).to_numpy() for c in table.columns]
    floats = [v for v in values if v.dtype.kind == "f"]
    if len(floats) == len(values) and np.isnan(floats).all(axis=0).any():  # rows of empty cells
        return None
    if any(((v >= 2.0**63) & (v <= 2.0**64)).any() for v in floats):  # perhaps integers without a sign
        return None
    if any((v == 0).any() for v in values if v.dtype.kind == "i") and re.search(rb"-0(?![.\d])", body):
        return None  # a negative zero is no integer
    return [Column(*pair, column) for pair, column in zip(headings, values, strict=True)]


def cells_of(name: str, unit: str, cells: Sequence[str], is_text: bool) -> Column:
    """Return a column from the texts of its cells: as integers, as doubles, or as text if a cell is not a number."""
    numbers = [] if is_text else [number_of(cell) for cell in cells]
    if is_text or None in numbers:
        return Column(name, unit, list(cells))
    # Integers are recognised by their text: floats always have a point or an exponent.
    if cells and all(cell.removeprefix("-").isdecimal() and cell != "-0" for cell in cells):
        integers = [*map(int, cells)]
        for kind in (np.int64, np.uint64):
            if np.iinfo(kind).min <= min(integers) and max(integers) <= np.iinfo(kind).max:
                return Column(name, unit, np.array(integers, dtype=kind))
    return Column(name, unit, np.array(numbers, dtype=np.float64))


# -- row by row -----------------------------------------------------------------------------------


def _texts(
    path: Path, content: bytes, width: int, header: int, mark: str
) -> tuple[list[Fault], Sequence[Sequence[str]], Sequence[int]]:
    """Return the faults, the cells of each column, and the line of each row; a row of another length is a fault.

    Args:
        width: Number of cells in the header.
        header: Line number of the header.
    """
    faults: list[Fault] = []
    misfits = list[tuple[int, int]]()  # lines and numbers of cells
    lines, rows = array("q"), list[list[str]]()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = content[: content.rfind(b"\n", 0, error.start) + 1]
        faults.append(Fault(path, before.count(b"\n") + 1, 1, "is not UTF-8 text; save it as plain CSV, UTF-8"))
        text = before.decode("utf-8-sig")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=mark)
    try:
        for row in reader:
            if reader.line_num <= header or not any(map(str.strip, row)):
                continue
            if len(row) == width:
                lines.append(reader.line_num)
                is_comma = mark != ","
                rows.append(
                    [c.replace(",", ".") if is_comma and DECIMAL_COMMA.fullmatch(c.strip()) else c for c in row]
                )
            else:
                misfits.append((reader.line_num, len(row)))
    except csv.Error as error:
        faults.append(Fault(path, reader.line_num, 1, f"is not CSV: {error}"))
    if misfits:
        line, count = misfits[0]
        cure = "delete the row, use decimal points, or leave cells empty where nothing was measured"
        further = f" ({counted(len(misfits) - 1, 'further row')} likewise)" if len(misfits) > 1 else ""
        faults.append(Fault(path, line, 1, f"has {counted(count, 'cell')}, the header {width}; {cure}{further}"))
    if not width and not faults:
        faults.append(Fault(path, 1, 1, "is empty; the first line names the columns"))
    return faults, [*zip(*rows, strict=True)] if rows else [()] * width, lines


# -- writing --------------------------------------------------------------------------------------


def write_table(
    path: Path, header: Sequence[str], rows: Iterable[Iterable[Any]], number: Callable[[Any], str] = repr
) -> None:
    """Write a header and rows as CSV.

    Args:
        number: Function that formats a cell. The default, `repr`, writes the shortest text from which the same double
            is read.
    """
    with atomic_write(path) as stream:
        csv.writer(stream, lineterminator="\n").writerow(header)
        stream.writelines(",".join(map(number, row)) + "\n" for row in rows)


def lines_of_numbers(columns: Sequence[Array]) -> str:
    """Return lines of CSV with each number formatted as by `repr`.

    pydantic formats numbers five times faster than `repr`. Its texts differ from those of `repr` only for numbers with
    an exponent, infinity and NaN; these numbers are formatted by `repr`.
    """
    cells = [column.tolist() for column in columns]
    for column, texts in zip(columns, cells, strict=True):
        if column.dtype.kind == "f":
            size = np.abs(column)
            for k in np.flatnonzero(~(((size >= PLAIN_SIZES[0]) & (size < PLAIN_SIZES[1])) | (size == 0.0))).tolist():
                texts[k] = repr(texts[k])
    rows = [*zip(*cells, strict=True)]
    return to_json(rows)[2:-2].replace(b"],[", b"\n").replace(b'"', b"").decode() + "\n" if rows else ""


def write_columns(path: Path, time: Array, columns: Mapping[str, Array], units: Mapping[str, str]) -> None:
    """Write time and signals as CSV with headings `name [unit]` and nine significant digits."""
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
