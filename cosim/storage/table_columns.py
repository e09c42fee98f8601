"""Columns of a table of numbers, of any format: the headings, how a column is read, the values, and the faults."""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Container
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, InputError
from cosim.base.units import alternatives, factor
from cosim.storage.yaml_file import did_you_mean

MOST_FAULTS = 100_000  # after which nothing more is read
FAULTS_A_KIND = 5  # reported of the cells of a column, then their number
INDEX = re.compile(r"\S\[[\d,\s]+\]$")  # the end of a name such as p.e[1]; a unit stands after a blank, or is no number


@dataclass(frozen=True)
class Heading:
    """Name and unit of a column, and their place.

    line: of the file, from 1; 0 in a format without lines
    cell: number of the column, from 1
    unit: "" where the file states none
    """

    line: int
    cell: int
    name: str
    unit: str


@dataclass(frozen=True)
class Column:
    """How a column is read.

    factor: what its numbers are multiplied by
    offset: what is added then
    known:  what it is, "the time" or "an input", where it has a value at every row; else "", an empty cell is NaN
    spare:  nobody needs it: a cell without a finite number is no fault, the column is left out
    """

    heading: Heading
    factor: float = 1.0
    known: str = ""
    spare: bool = False
    offset: float = 0.0

    @property
    def cell(self) -> int:
        """Number of the column, from 1."""
        return self.heading.cell

    @property
    def name(self) -> str:
        """Name of the column."""
        return self.heading.name

    def converted(self, value: Any) -> Any:
        """Return a number, or an array of them, in the unit that is wanted; without an offset a zero keeps its sign."""
        scaled = value * self.factor
        return scaled + self.offset if self.offset else scaled

    @property
    def cure(self) -> str:
        """What to do about a cell that holds something else than a finite number."""
        return "write a number or leave the row out" if self.known else "leave the cell empty where there is no value"


@dataclass
class Table:
    """A table as far as it could be read.

    columns: name → how it was read, in the order of the header
    values:  name → its numbers, one a row
    lines:   of the file, one a row; the number of the row in a format without lines
    header:  line that names the columns; 0 in a format without lines
    first:   name of the first column
    spoiled: spare columns with a cell that is no finite number
    whole:   it was read to its end
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
        """Number of rows."""
        return len(self.lines)

    def __getitem__(self, name: str) -> Array:
        return np.array(self.values[name], dtype=np.float64)


Choose = Callable[[Heading], Column | None]


@dataclass(frozen=True)
class Wanted:
    """What a caller wants of a table.

    choose:  how the column below a heading is read; None where it is not, a fault noted if that is one
    holds:   what its columns are beside the time, for a file that is empty
    shorter: what to do about a file that is too large
    timed:   its first column is `time`, which increases
    names:   that are known, so that brackets in them are no unit
    times:   what the first column may be called beside `time`
    """

    choose: Choose
    holds: str
    shorter: str
    timed: bool = True
    names: Container[str] = ()
    times: Collection[str] = ()


class Faults:
    """What is wrong with one file: of a column's cells the first few of each kind, then their number."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.found: list[Fault] = []
        self.counts: Counter[tuple[int, str]] = Counter()

    def note(self, line: int, cell: int, message: str) -> None:
        """Note a fault; line and cell count from 1, 0 is the whole file."""
        self.found.append(Fault(self.path, line, cell, message))

    def note_cell(self, line: int, cell: int, kind: str, message: str) -> None:
        """Note a fault of which a column may have thousands; `kind` is what they are called in the plural."""
        self.counts[cell, kind] += 1
        if self.counts[cell, kind] <= FAULTS_A_KIND:
            self.note(line, cell, message)

    @property
    def many(self) -> bool:
        """So many that reading on tells nothing new."""
        return any(count > MOST_FAULTS for count in self.counts.values())

    def raise_any(self) -> None:
        """InputError where there is a fault."""
        for (cell, kind), count in self.counts.items():
            if count > FAULTS_A_KIND:
                self.note(0, 0, f"{count} {kind} in all, column {cell}; the first {FAULTS_A_KIND} are shown")
        if self.found:
            raise InputError(self.found)


def choose_columns(table: Table, headings: Collection[Heading], faults: Faults, wanted: Wanted) -> None:
    """Give a table the columns below its headings that the caller wants, without values yet."""
    for place, heading in enumerate(headings):
        if not place:
            table.first = heading.name
            if wanted.timed and (is_time(heading.name) or heading.name in wanted.times):
                heading = replace(heading, name="time")
        _choose_column(table, heading, faults, wanted)


def _choose_column(table: Table, heading: Heading, faults: Faults, wanted: Wanted) -> None:
    line, cell, name = heading.line, heading.cell, heading.name
    if wanted.timed and cell == 1 and name != "time":
        faults.note(line, 1, not_time(name))
        table.columns["time"] = Column(replace(heading, name="time"), spare=True)  # the rest is still read
        table.values["time"] = array("d")
    elif name in table.columns:
        first = table.columns[name].cell
        faults.note(line, cell, f'column "{name}" stands twice, first as column {first}; keep one')
    elif (column := wanted.choose(heading)) is None:
        pass
    elif column.name in table.columns:  # by another name
        first = table.columns[column.name].cell
        faults.note(line, cell, f'column "{name}" is {column.name}, as column {first} is; keep one')
    else:
        table.columns[column.name], table.values[column.name] = column, array("d")


# -- faults of cells ------------------------------------------------------------------------------


def note_infinite(faults: Faults, line: int, column: Column, text: str) -> None:
    """Note a cell that is not finite."""
    message = f'"{text}" in column {column.name} is not finite; {column.cure}'
    faults.note_cell(line, column.cell, f"cells of {column.name} that are not finite", message)


def note_missing(faults: Faults, line: int, column: Column) -> None:
    """Note a cell without a value in a column that has one at every row."""
    known = f"{column.known} is known at every row, so fill the cell or leave the row out"
    kind = f"cells of {column.name} without a value"
    faults.note_cell(line, column.cell, kind, f"{column.name} has no value here; {known}")


def note_backwards(faults: Faults, line: int, time: float, before: float) -> None:
    """Note a time that is not after the one of the row before [s]."""
    message = f"time {time:g} s does not increase, {before:g} s stands before it; sort the rows, keep one of each"
    faults.note_cell(line, 1, "times that do not increase", message)


# -- names and units ------------------------------------------------------------------------------


def is_time(name: str) -> bool:
    """The name of a first column that is the time, whatever its capitals."""
    return name.casefold() == "time"


def not_time(name: str) -> str:
    """What is wrong where the first column has another name."""
    return f'the first column is "{name}"; it must be "time" [s]{did_you_mean(name, ["time"])}'


def seconds(unit: str) -> tuple[float, str]:
    """What times in a unit are multiplied by to be in seconds, and what is wrong where they cannot be."""
    scale = factor(unit, "s")
    if scale is None:
        return 1.0, f'"{unit}" is no unit of time; known here: {", ".join(alternatives("s"))}'
    return scale, ""


def parted(text: str, names: Container[str] = ()) -> tuple[str, str]:
    """Name and unit of a header's cell, `name [unit]`; brackets of a known name, or of an index, are its own.

    The unit is "" where none is written.
    """
    whole = text.strip()
    name, bracket, unit = whole.rpartition("[")
    name, unit = name.strip(), unit.removesuffix("]").strip()
    if not bracket or whole in names or "]" in unit:
        return whole, ""
    return (whole, "") if INDEX.search(whole) and name not in names else (name, unit)
