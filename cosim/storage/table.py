"""Reading of tables of numbers in any format, with or without time, with the place of every fault."""

from __future__ import annotations

import re
from collections.abc import Collection, Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.storage.csv_source import write_table
from cosim.storage.table_columns import Choose, Column, Faults, Heading, Table, TableRequest, time_scale
from cosim.storage.table_source import source_of

WHOLE = re.compile(r"[-+]?\d+")


def read_columns(path: Path, names: Collection[str] = (), text: Collection[str] = ()) -> Table:
    """Read time [s] and every fully numeric column. Equal times are a jump.

    Args:
        names: Required columns, whose brackets are not units. If given, other columns may hold non-numbers and are then
            ignored.
        text: Columns to leave out, because they hold text.

    Raises:
        InputError: The file has faults; it lists all of them.
    """
    faults = Faults(path)

    def choose(heading: Heading) -> Column | None:
        if heading.name == "time":
            return Column(heading, time_scale(faults, heading.line, heading.unit), "the time")
        if not heading.name:
            faults.note(heading.line, heading.cell, "the column has no name; name it in the header")
            return None
        if heading.name in text:
            return None
        spare = bool(names) and heading.name not in names
        return Column(heading, role="" if spare else "a column played back", spare=spare)

    table = read_table(faults, choose, "signals", "leave out columns or rows", names=names, jumps=True)
    if table.whole and not table.rows and not faults.counts:
        faults.note(table.header + 1, 1, "holds no row; at least one follows the header")
    faults.raise_any()
    for name in table.spoiled:
        del table.columns[name], table.values[name]
    return table


def read_exactly(path: Path, columns: Collection[str], names: Collection[str] = ()) -> dict[str, Sequence[Any]]:
    """Return columns of a sound table as text, or as integers if the format stores them as such.

    Args:
        columns: Names of the columns; the result has those that the file has.
        names: Known names, whose brackets are not units.
    """
    frame = source_of(path).frame(path, names, columns)
    return {
        column.name: column.values.tolist() if isinstance(column.values, np.ndarray) else column.values
        for column in frame.columns[1:]
        if column.name in columns and not column.fault
    }


def whole_numbers_in(values: Sequence[Any]) -> list[int] | None:
    """Return the exact whole numbers of cells, as text or numbers; None if a cell is none."""
    try:
        return [_whole_number(value) for value in values]
    except ValueError:
        return None


def _whole_number(value: Any) -> int:
    """Return an exact whole number; raise ValueError for anything else."""
    if isinstance(value, int) or (isinstance(value, str) and WHOLE.fullmatch(value.strip())):
        return int(value)
    if not (number := float(value)).is_integer():
        raise ValueError
    return int(number)


def read_table(
    faults: Faults,
    choose: Choose,
    holds: str,
    shorter: str,
    *,
    timed: bool = True,
    names: Container[str] = (),
    times: Collection[str] = (),
    jumps: bool = False,
) -> Table:
    """Read a file as far as possible and note its faults. Further arguments are those of `TableRequest`."""
    if not is_there(faults):
        return Table()
    try:
        source = source_of(faults.path)
    except InputError as error:
        faults.items += error.faults
        return Table()
    return source.table(faults, TableRequest(choose, holds, shorter, timed, names, times, jumps))


def is_there(faults: Faults) -> bool:
    """Return whether the file exists; note a missing one."""
    path = faults.path
    try:
        if path.is_file():
            return True
        faults.note(0, 0, "is no file" if path.exists() else "no such file")
    except OSError as error:
        faults.note(0, 0, f"cannot be read: {error.strerror}")
    except ValueError:  # an impossible file name
        faults.note(0, 0, "no such file")
    return False


def read_header(path: Path) -> list[str]:
    """Return a file's column names, none if unreadable."""
    faults = Faults(path)
    try:
        return source_of(path).column_names(path) if is_there(faults) else []
    except InputError:
        return []


def write_columns(path: Path, time: Array, columns: Mapping[str, Array], units: Mapping[str, str]) -> None:
    """Write time and columns `name [unit]` as CSV with nine digits."""
    header = ["time", *(f"{name} [{units[name]}]" for name in columns)]
    rows = zip(time.tolist(), *(c.tolist() for c in columns.values()), strict=True)
    write_table(path, header, rows, "{:.9g}".format)
