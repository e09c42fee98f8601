"""Excel workbooks with one table, read by openpyxl."""

from __future__ import annotations

from collections.abc import Collection, Container
from datetime import date, datetime
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

from cosim.core.errors import Fault, InputError
from cosim.core.extras import optional
from cosim.core.text import join_names
from cosim.files.csv_source import MOST_BYTES, cells_of
from cosim.files.table import Source, Table, split_heading


class Excel(Source):
    """Excel workbooks."""

    name = "Excel"
    suffixes = (".xlsx", ".xlsm")

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns of the table. For a formula, the value stored by Excel is read."""
        openpyxl = optional("openpyxl", lambda message: Fault(path, 0, 0, message))
        try:
            with ZipFile(path) as parts:
                size = sum(part.file_size for part in parts.infolist())
            if size > MOST_BYTES:
                message = f"unpacks to {size / 1e6:.0f} MB; the limit is {MOST_BYTES / 1e6:.0f} MB"
                raise InputError.at(path, f"{message}; write Parquet")
            book = openpyxl.load_workbook(path, read_only=True, data_only=True)
            sheets = {sheet.title: [*sheet.iter_rows(values_only=True)] for sheet in book.worksheets}
            book.close()
        except (
            OSError,
            ValueError,
            KeyError,
            EOFError,
            BadZipFile,
            openpyxl.utils.exceptions.InvalidFileException,
        ) as error:
            raise InputError.at(
                path, f"is an incomplete or invalid workbook: {str(error)[:200]}; save it again"
            ) from None
        filled = {name: rows for name, rows in sheets.items() if any(map(_is_filled, rows))}
        if len(filled) > 1:
            raise InputError.at(path, f"has tables in the sheets {join_names([*filled])}; keep one, or write CSV")
        if not filled:
            return Table()
        ((sheet, rows),) = filled.items()
        places = [k for k, row in enumerate(rows) if _is_filled(row)]
        first, last = places[0], places[-1]
        if blank := next((k for k in range(first, last) if k not in {*places}), None):
            message = f"sheet {sheet} has several tables, separated by the empty row {blank + 1}; keep one"
            raise InputError([Fault(path, blank + 1, 1, message)])
        width = max(k for k, cell in enumerate(rows[first]) if cell is not None) + 1
        headings = [split_heading(_text(cell), names) for cell in rows[first][:width]]
        below = rows[first + 1 : last + 1]
        cells = [[_text(cell) for cell in (*row, *[None] * width)[:width]] for row in below]
        columns = [
            cells_of(name, unit, [row[k] for row in cells], is_text=name in text)
            for k, (name, unit) in enumerate(headings)
        ]
        return Table(columns, range(first + 2, last + 2), first + 1)


EXCEL = Excel()


def _is_filled(row: tuple[Any, ...]) -> bool:
    return any(cell is not None for cell in row)


def _text(cell: Any) -> str:
    """Return a cell as in a CSV file; dates by ISO 8601."""
    if cell is None:
        return ""
    return cell.isoformat() if isinstance(cell, (date, datetime)) else str(cell)
