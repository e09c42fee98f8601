"""Columns of a table: headings, conversions, values and faults, for any format."""

from __future__ import annotations

import math
import re
import shlex
import sys
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Container
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, refuse
from cosim.base.units import alternatives, factor
from cosim.storage.yaml_file import did_you_mean

MOST_FAULTS = 100_000  # limit at which reading stops
FAULTS_A_KIND = 5  # reported faults of a kind per column; the rest are counted
MOST_TIME = math.sqrt(sys.float_info.max)  # [s] largest time whose square a double holds
COARSE = 1e-6  # [s] spacing of doubles from which equal times are due to their size
INDEX = re.compile(r"\S\[[\d,\s]+\]$")  # end of a name like p.e[1]; a unit follows a blank or is not numeric


@dataclass(frozen=True)
class Heading:
    """Name, unit and place of a column.

    Attributes:
        line: Line in the file, from 1; 0 in formats without lines.
        cell: Number of the column, from 1.
        unit: Unit, "" if absent.
    """

    line: int
    cell: int
    name: str
    unit: str


@dataclass(frozen=True)
class Column:
    """Instructions for reading a column.

    Attributes:
        factor: Factor on the numbers of the column.
        role: Description, "the time" or "an input", of a column without gaps; "" allows empty cells as NaN.
        spare: Whether the column is optional; a cell without a finite number then removes the column.
        offset: Offset added after the factor.
    """

    heading: Heading
    factor: float = 1.0
    role: str = ""
    spare: bool = False
    offset: float = 0.0

    @property
    def cell(self) -> int:
        """Return the number of the column, from 1."""
        return self.heading.cell

    @property
    def name(self) -> str:
        """Return the name of the column."""
        return self.heading.name

    def convert(self, value: Any) -> Any:
        """Return a number or array in the wanted unit. Without offset, a negative zero keeps its sign."""
        scaled = value * self.factor
        return scaled + self.offset if self.offset else scaled

    @property
    def cure(self) -> str:
        """Return the remedy for a cell without finite number."""
        return "write a number or leave the row out" if self.role else "leave the cell empty where there is no value"


@dataclass
class Table:
    """A table, as far as it could be read.

    Attributes:
        columns: Name → reading instructions, in the order of the header.
        values: Name → numbers by row.
        lines: Line of each row in the file; the row number in formats without lines.
        header: Line of the header; 0 in formats without lines.
        first: Name of the first column.
        spoiled: Optional columns with a non-finite cell.
        whole: Whether the file was read to its end.
    """

    columns: dict[str, Column] = field(default_factory=dict)
    values: dict[str, array[float]] = field(default_factory=dict)
    lines: array[int] = field(default_factory=lambda: array("q"))
    header: int = 1
    first: str = ""
    spoiled: set[str] = field(default_factory=set)
    whole: bool = False

    @property
    def rows(self) -> int:
        """Return the number of rows."""
        return len(self.lines)

    def __getitem__(self, name: str) -> Array:
        return np.array(self.values[name], dtype=np.float64)


Choose = Callable[[Heading], Column | None]


@dataclass(frozen=True)
class TableRequest:
    """A caller's requirements for a table.

    Attributes:
        choose: Function from a heading to its column; None skips the column, perhaps with a fault.
        holds: Description of the columns after time, for messages on empty files.
        shorter: Remedy for a file that is too large.
        timed: Whether the first column is `time`, increasing.
        jumps: Whether equal times are allowed, which are a jump.
        names: Known names, whose brackets are not units.
        times: Alternative names of the first column.
    """

    choose: Choose
    holds: str
    shorter: str
    timed: bool = True
    names: Container[str] = ()
    times: Collection[str] = ()
    jumps: bool = False

    @property
    def description(self) -> str:
        """Return the description of all columns."""
        return f"time, then {self.holds}" if self.timed else self.holds


class Faults:
    """Faults of a file; of each kind per column only the first few and a count."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.items: list[Fault] = []
        self.counts: Counter[tuple[int, str]] = Counter()

    def note(self, line: int, cell: int, message: str) -> None:
        """Note a fault; line and cell count from 1, 0 means the file."""
        self.items.append(Fault(self.path, line, cell, message))

    def note_cell(self, line: int, cell: int, kind: str, message: str) -> None:
        """Note a frequent fault; `kind` is its plural."""
        self.counts[cell, kind] += 1
        if self.counts[cell, kind] <= FAULTS_A_KIND:
            self.note(line, cell, message)

    @property
    def is_full(self) -> bool:
        """Return whether so many faults are noted that reading can stop."""
        return any(count > MOST_FAULTS for count in self.counts.values())

    def raise_any(self) -> None:
        """Raise InputError if any fault was noted."""
        for (cell, kind), count in self.counts.items():
            if count > FAULTS_A_KIND:
                self.note(0, 0, f"{count} {kind} in all, column {cell}; the first {FAULTS_A_KIND} are shown")
        refuse(self.items)


def choose_columns(table: Table, headings: Collection[Heading], faults: Faults, request: TableRequest) -> None:
    """Add the requested columns to a table, still without values."""
    times = [heading.cell for heading in headings if is_time(heading.name)]
    for heading in headings:
        if heading.cell == 1:
            table.first = heading.name
            if request.timed and (is_time(heading.name) or heading.name in request.times):
                heading = replace(heading, name="time")
            elif request.timed:
                note_wrong_first(faults, heading.line, heading.name, next(iter(times), 0))
        elif request.timed and 1 not in times and heading.cell in times and table.first not in request.times:
            continue  # The first column, which is not the time, stands for it from here on.
        _choose_column(table, heading, faults, request)


def _choose_column(table: Table, heading: Heading, faults: Faults, request: TableRequest) -> None:
    line, cell, name = heading.line, heading.cell, heading.name
    column: Column | None
    if request.timed and cell == 1 and name != "time":
        column = Column(replace(heading, name="time"), spare=True)  # Reading continues with the remaining columns.
    elif name in table.columns:
        faults.note(line, cell, f'column "{name}" stands twice, first as column {table.columns[name].cell}; keep one')
        return
    elif (column := request.choose(heading)) is not None and column.name in table.columns:
        first = table.columns[column.name].cell
        faults.note(line, cell, f'column "{name}" is {column.name}, as column {first} is; keep one')
        return
    if column is not None:
        table.columns[column.name], table.values[column.name] = column, array("d")


# -- faults of cells ------------------------------------------------------------------------------


def note_infinite(faults: Faults, line: int, column: Column, text: str) -> None:
    """Note a non-finite cell."""
    message = f'"{text}" in column {column.name} is not finite; {column.cure}'
    faults.note_cell(line, column.cell, f"cells of {column.name} that are not finite", message)


def note_missing(faults: Faults, line: int, column: Column) -> None:
    """Note a missing value in a column without gaps."""
    message = (
        f"{column.name} has no value here; {column.role} is known at every row, so fill the cell or leave the row out"
    )
    faults.note_cell(line, column.cell, f"cells of {column.name} without a value", message)


def note_distant(faults: Faults, line: int, time: float) -> None:
    """Note a time [s] beyond `MOST_TIME`."""
    faults.note_cell(
        line,
        1,
        "times that are too large",
        f"time is {time:g} s, too large to count differences of times; write seconds, or leave the row out",
    )


def note_backwards(faults: Faults, line: int, time: float, before: float) -> None:
    """Note a time [s] that does not increase."""
    spacing = math.ulp(time)
    if time == before and spacing > COARSE:
        message = (
            f"time {time:g} s does not increase: numbers of this size are {spacing:.2g} s apart in double "
            "precision, so the times of rows cannot be told apart; subtract the first time from all times "
            "before they are written"
        )
    else:
        message = f"time {time:g} s does not increase, {before:g} s stands before it; sort the rows, keep one of each"
    faults.note_cell(line, 1, "times that do not increase", message)


def note_wrong_first(faults: Faults, line: int, name: str, time: int = 0) -> None:
    """Note a first column that is not time.

    Args:
        time: Number of the column of the time, 0 if there is none.
    """
    hint = f"; time is column {time}: move it to the front" if time else _hint_of_first(name)
    faults.note(line, 1, f'the first column is "{name}"; it must be "time" [s]{hint}')


def _hint_of_first(name: str) -> str:
    """Return the likely cause of a wrong first column."""
    try:
        float(name)
    except ValueError:
        rename = f"; rename it, or say it by --column {shlex.quote(f'{name}=time')} where a command has that option"
        return did_you_mean(name, ["time"]) or rename
    return "; the file has no header: write the names of the columns into the first line"


# -- names and units ------------------------------------------------------------------------------


def is_time(name: str) -> bool:
    """Return whether a name means time, in any case."""
    return name.casefold() == "time"


def time_scale(faults: Faults, line: int, unit: str) -> float:
    """Return the factor from the unit of time to seconds, and note an unknown unit."""
    scale = factor(unit, "s")
    if scale is None:
        faults.note(line, 1, f'"{unit}" is no unit of time; known here: {", ".join(alternatives("s"))}')
    return 1.0 if scale is None else scale


def split_heading(text: str, names: Container[str] = ()) -> tuple[str, str]:
    """Return name and unit of a header cell `name [unit]`.

    Brackets of a known name or an index belong to the name. The unit is "" if absent.
    """
    whole = text.strip()
    name, bracket, unit = whole.rpartition("[")
    name, unit = name.strip(), unit.removesuffix("]").strip()
    if not bracket or whole in names or "]" in unit:
        return whole, ""
    return (whole, "") if INDEX.search(whole) and name not in names else (name, unit)
