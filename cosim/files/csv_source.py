"""CSV files. pyarrow reads files of numbers; other files are read row by row, so that each fault has its place."""

from __future__ import annotations

import csv
import io
import re
from array import array
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic_core import to_json

from cosim.core.arrays import Array
from cosim.core.errors import Fault, InputError
from cosim.core.text import counted
from cosim.files.files import atomic_write, open_bytes
from cosim.files.table import DECIMAL_COMMA, Column, Source, Table, number_of, split_heading

MOST_BYTES = 200_000_000  # size of a file [bytes]; files are read whole
CHUNK = 1000  # rows written at a time
PLAIN = 1e-4, 1e16  # `repr` writes numbers from the first to below the second without an exponent
THOUSANDS = re.compile(r"(?<![\d.,])\d{1,3}(?:[.'’ ]\d{3})+,\d+|(?<![\d.,])\d{1,3}(?:,\d{3})+\.\d+")
NO_DECIMAL = re.compile(r"(?<!\d),|,(?!\d)")  # a comma that is no decimal comma
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "vertical bars", " ": "blanks"}


class Csv(Source):
    """Comma-separated values in UTF-8, with a header line."""

    name = "CSV"
    suffixes = (".csv",)
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns, non-numeric ones as text."""
        if (size := path.stat().st_size) > MOST_BYTES:
            sizes = f"{size / 1e6:.0f} MB; the limit is {MOST_BYTES / 1e6:.0f} MB"
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
        if mark:
            content, decimals = _with_commas(path, content, mark, line)
            assumed = (f"cells are separated by {SEPARATORS[mark]}{decimals}",)
        headings = [split_heading(cell, names) for cell in header]
        if header and not text and (columns := _numbers(content, line, headings)) is not None:
            return Table(columns, range(line + 1, line + 1 + len(columns[0].values)), line, assumed=assumed)
        faults, by_column, lines = _texts(path, content, len(header), line)
        columns = [cells_of(*pair, c, pair[0] in text) for pair, c in zip(headings, by_column, strict=True)]
        return Table(columns, lines, line, faults, assumed)

    def column_names(self, path: Path) -> list[str]:
        """Return the names in the header."""
        with open_bytes(path) as stream:
            return [split_heading(text)[0] for text in _header(stream)[0]]

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write columns with exactly reproducible numbers."""
        header, count = [column.name for column in columns], len(columns[0].values)
        numeric = all(isinstance(c.values, np.ndarray) and c.values.dtype.kind in "iuf" for c in columns)

        def parts() -> Iterator[list[Any]]:
            for first in range(0, count, CHUNK):  # Python floats need four times the memory.
                yield [column.values[first : first + CHUNK] for column in columns]

        def rows() -> Iterator[tuple[Any, ...]]:
            for part in parts():
                yield from zip(*(p.tolist() if isinstance(p, np.ndarray) else p for p in part), strict=True)

        if not numeric:
            write_table(path, header, rows(), cell_text)
            return
        with atomic_write(path) as stream:
            csv.writer(stream, lineterminator="\n").writerow(header)
            stream.writelines(map(lines_of_numbers, parts()))


CSV = Csv()


def read_heading(path: Path, names: Container[str] = ()) -> tuple[list[tuple[str, str]], int]:
    """Return names and units of the columns, and the number of lines down to the header.

    Raises:
        ValueError: The cells are not separated by commas, or there is no header.
    """
    with open_bytes(path) as stream:
        header, line, mark = _header(stream)
    if not header or mark:
        raise ValueError("the header is not CSV")
    return [split_heading(cell, names) for cell in header], line


def _header(stream: BinaryIO) -> tuple[list[str], int, str]:
    """Return the cells of the first line with text, its number, and the separator if it is no comma."""
    text = io.TextIOWrapper(stream, encoding="utf-8-sig", errors="replace", newline="")
    reader = csv.reader(text)
    try:
        header = next((row for row in reader if any(map(str.strip, row))), [])
    except csv.Error:
        return [], 1, ""
    finally:
        text.detach()  # otherwise the wrapper would close the file
    line = max(1, reader.line_num)
    only = header[0] if len(header) == 1 else ""
    for mark in SEPARATORS:
        if mark in only.strip() and not (mark == " " and "[" in only):  # A blank separates a unit from its name.
            return next(csv.reader([only.strip()], delimiter=mark, skipinitialspace=True)), line, mark
    return header, line, ""


def _with_commas(path: Path, content: bytes, mark: str, header: int) -> tuple[bytes, str]:
    """Return a file with cells separated by commas and decimals by points, and a phrase on its decimals.

    Raises:
        InputError: A number has separators of thousands.
    """
    text = content.decode("utf-8-sig", errors="surrogateescape")
    head, body = "", text
    for _ in range(header):
        line, end, body = body.partition("\n")
        head += line + end
    if (found := THOUSANDS.search(body)) is not None:
        line_of = header + 1 + body[: found.start()].count("\n")
        message = f"{found[0].strip()} has a separator of thousands; write numbers without one"
        raise InputError([Fault(path, line_of, 1, message)])
    has_comma = any(DECIMAL_COMMA.fullmatch(cell.strip()) for cell in re.split(f"[\n{re.escape(mark)}]", body))
    if '"' not in body and not (has_comma and NO_DECIMAL.search(body)) and (has_comma or "," not in body):
        body = body.replace(",", ".").replace(mark, ",")
    else:
        rows, written = csv.reader(io.StringIO(body, newline=""), delimiter=mark), io.StringIO()
        cells = ([c.replace(",", ".") if DECIMAL_COMMA.fullmatch(c.strip()) else c for c in row] for row in rows)
        csv.writer(written, lineterminator="\n").writerows(cells)
        body = written.getvalue()
    return (head + body).encode(errors="surrogateescape"), ", decimals have a comma" if has_comma else ""


# -- all cells at once ----------------------------------------------------------------------------


def _numbers(content: bytes, header: int, headings: Sequence[tuple[str, str]]) -> list[Column] | None:
    """Return numeric columns below the header line; None if the file must be read row by row."""
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
                columns[k] = cells_of(*headings[k], column.to_pylist(), is_text=False)
    except ArrowInvalid:  # a cell without a number, or a row of another length
        return None
    return columns


def cells_of(name: str, unit: str, cells: Sequence[str], is_text: bool) -> Column:
    """Return a column of cells: integers, doubles, or texts if a cell is no number."""
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
    path: Path, content: bytes, width: int, header: int
) -> tuple[list[Fault], Sequence[Sequence[str]], Sequence[int]]:
    """Return the faults, the cells of each column, and the line of each row. A row of another length is a fault.

    Args:
        width: Number of cells in the header.
        header: Line of the header.
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
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        for row in reader:
            if reader.line_num <= header or not any(map(str.strip, row)):
                continue
            if len(row) == width:
                lines.append(reader.line_num)
                rows.append(row)
                continue
            misfits.append((reader.line_num, len(row)))
    except csv.Error as error:
        faults.append(Fault(path, reader.line_num, 1, f"is not CSV: {error}"))
    if misfits:
        line, count = misfits[0]
        cure = "delete the row, or leave cells empty where nothing was measured"
        if count == 2 * width:
            cure = "a decimal comma may split each number; use a decimal point"
        further = f" ({counted(len(misfits) - 1, 'further row')} likewise)" if len(misfits) > 1 else ""
        faults.append(Fault(path, line, 1, f"has {counted(count, 'cell')}, the header {width}; {cure}{further}"))
    if not width and not faults:
        faults.append(Fault(path, 1, 1, "is empty; the first line names the columns"))
    return faults, [*zip(*rows, strict=True)] if rows else [()] * width, lines


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


def lines_of_numbers(columns: Sequence[Array]) -> str:
    """Return lines of CSV with each number as `repr` writes it.

    pydantic writes JSON by the same shortest digits in a fifth of the time. It has other texts only for numbers with
    an exponent and for infinity and NaN, which `repr` therefore writes.
    """
    cells = [column.tolist() for column in columns]
    for column, texts in zip(columns, cells, strict=True):
        if column.dtype.kind == "f":
            size = np.abs(column)
            for k in np.flatnonzero(~(((size >= PLAIN[0]) & (size < PLAIN[1])) | (size == 0.0))).tolist():
                texts[k] = repr(texts[k])
    rows = [*zip(*cells, strict=True)]
    return to_json(rows)[2:-2].replace(b"],[", b"\n").replace(b'"', b"").decode() + "\n" if rows else ""


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
