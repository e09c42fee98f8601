"""A table of numbers as CSV, `time` first or none at all: read with the place of every fault, written whole."""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TextIO

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, InputError
from cosim.base.units import alternatives, factor
from cosim.storage.files import atomic_write
from cosim.storage.yaml_file import did_you_mean

MOST_BYTES = 200_000_000  # bytes; read whole, so that every fault can be reported
MOST_FAULTS = 100_000  # after which nothing more is read
FAULTS_A_KIND = 5  # reported of the cells of a column, then their number
LONGEST_LINE = 2_000_000  # bytes; of the header some 100 000 columns
INDEX = re.compile(r"\S\[[\d,\s]+\]$")  # the end of a name such as p.e[1]; a unit stands after a blank, or is no number
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
SEPARATORS = {";": "semicolons", "\t": "tabs"}

# -- what is read -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Heading:
    """A cell of the header, `name [unit]`; line and cell count from 1, and `unit` is "" where none is written."""

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
        """Its place in a row, from 1."""
        return self.heading.cell

    @property
    def name(self) -> str:
        """What it is called."""
        return self.heading.name

    def converted(self, value: float) -> float:
        """Return a number of the column in the unit that is wanted; without an offset its zero keeps its sign."""
        scaled = value * self.factor
        return scaled + self.offset if self.offset else scaled

    @property
    def cure(self) -> str:
        """What to do about a cell that holds something else than a finite number."""
        return "write a number or leave the row out" if self.known else "leave the cell empty where there is no value"


@dataclass
class Table:
    """A CSV as far as it could be read.

    columns: name → how it was read, in the order of the header
    values:  name → its numbers, one a row
    lines:   of the file, one a row
    header:  line that names the columns
    first:   what the first column is called
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


# -- reading ------------------------------------------------------------------------------------


def read_columns(path: Path, names: Collection[str] = ()) -> Table:
    """Time, in seconds, and every column of a CSV that has a finite number in every cell; InputError with every fault.

    names: that are needed, so that brackets in them are no unit; where there are any, others may hold what is no number
           and are left out then
    """
    faults = Faults(path)

    def choose(heading: Heading) -> Column | None:
        if heading.name == "time":
            scale, wrong = seconds(heading.unit)
            if wrong:
                faults.note(heading.line, heading.cell, wrong)
            return Column(heading, scale, "the time")
        if not heading.name:
            faults.note(heading.line, heading.cell, "the column has no name")
            return None
        spare = bool(names) and heading.name not in names
        return Column(heading, known="" if spare else "a column played back", spare=spare)

    table = read_table(faults, choose, "signals", "leave out columns or rows", names=names)
    if table.whole and not table.rows and not faults.counts:
        faults.note(table.header + 1, 1, "holds no row; at least one follows the header")
    faults.raise_any()
    for name in table.spoiled:
        del table.columns[name], table.values[name]
    return table


def read_table(
    faults: Faults,
    choose: Choose,
    holds: str,
    shorter: str,
    *,
    timed: bool = True,
    names: Container[str] = (),
    times: Collection[str] = (),
) -> Table:
    """Read a CSV as far as it goes and note its faults; `timed`: its first column is `time`, which increases.

    choose:  how the column below a heading is read; None where it is not, a fault noted if that is one
    holds:   what its columns are beside the time, for a file that is empty
    shorter: what to do about one that is too large
    names:   that are known, so that brackets in them are no unit
    times:   what the first column may be called beside `time`
    """
    path, reader = faults.path, _Reader(faults, choose, timed, names, times)
    try:
        if not path.is_file():
            faults.note(0, 0, "is no file" if path.exists() else "no such file")
        elif (size := path.stat().st_size) > MOST_BYTES:
            most = f"more than the {MOST_BYTES / 1e6:.0f} MB that are read"
            faults.note(0, 0, f"has {size / 1e6:.0f} MB, {most}; {shorter}")
        else:
            with _opened(path) as stream:
                reader.read(stream, holds)
    except OSError as error:
        faults.note(0, 0, f"cannot be read: {error.strerror}")
    except ValueError:  # a name that no file may have
        faults.note(0, 0, "no such file")
    return reader.table


def read_header(path: Path) -> list[str]:
    """Return the names of the columns of a CSV; none if it cannot be read."""
    try:
        with _opened(path) as stream:
            header = next(filter(_filled, csv.reader(_lines(stream))), [])
    except (OSError, ValueError, csv.Error, _NotText, _TooLong):
        return []
    mark = next((m for m in SEPARATORS if len(header) == 1 and m in header[0]), None)
    cells = header if mark is None else next(csv.reader(header, delimiter=mark))
    return [parted(text)[0] for text in cells]


class _NotText(Exception):
    """A line that is not UTF-8."""


class _TooLong(Exception):
    """A line that no CSV has."""


def _opened(path: Path) -> TextIO:
    """Open a CSV so that a character is a byte, and a line ends with LF, CR LF or CR alone."""
    return path.open(encoding="latin-1", newline="")


def _lines(stream: TextIO) -> Iterator[str]:
    """Yield lines of UTF-8 text from a file that `_opened` has opened; the first may begin with a byte order mark."""
    while line := stream.readline(LONGEST_LINE + 1):
        if len(line) > LONGEST_LINE:
            raise _TooLong
        raw = line.encode("latin-1")
        try:
            yield raw.decode("utf-8-sig" if raw.startswith(b"\xef\xbb\xbf") else "utf-8")
        except UnicodeDecodeError:
            raise _NotText from None


class _Reader:
    """Fills a table while the header and then the cells are read."""

    def __init__(
        self, faults: Faults, choose: Choose, timed: bool, names: Container[str], times: Collection[str]
    ) -> None:
        self.faults, self.choose, self.timed, self.names, self.times = faults, choose, timed, names, times
        self.table = Table()
        self.width = 0  # of the header
        self.signals: list[tuple[Column, int, array[float]]] = []  # all but the time: column, place in a row, numbers

    def read(self, stream: TextIO, holds: str) -> None:
        """Read the header and, below a time, the rows."""
        lines = _lines(stream)
        rows = csv.reader(lines)
        above = 0  # lines that another reader has read
        try:
            header = next(filter(_filled, rows), None)
            if header is None:
                names = f"time, then {holds}" if self.timed else holds
                self.faults.note(1, 1, f"is empty; the first line names the columns: {names}")
                return
            self.table.header = rows.line_num
            only = header[0] if len(header) == 1 and "\0" not in header[0] else ""
            if mark := next((m for m in SEPARATORS if m in only), None):
                cure = "separate them with commas, decimals with a point"
                self.faults.note(self.table.header, 1, f"cells are separated by {SEPARATORS[mark]}; {cure}")
                header = next(csv.reader(header, delimiter=mark))  # what else is wrong is told too
                above, rows = rows.line_num, csv.reader(lines, delimiter=mark)
            self._header(header)
            if self.timed and "time" not in self.table.columns:
                return
            for row in rows:
                if _filled(row):
                    self._row(above + rows.line_num, row)
                if self.faults.many:
                    self.faults.note(above + rows.line_num, 1, "nothing is read from here on")
                    return
            self.table.whole = True
        except _NotText:
            self.faults.note(above + rows.line_num + 1, 1, "is not UTF-8 text; save it as plain CSV, UTF-8")
        except _TooLong:
            message = f"the line has more than {LONGEST_LINE / 1e6:g} MB; is this a CSV?"
            self.faults.note(above + rows.line_num + 1, 1, message)
        except csv.Error as error:
            self.faults.note(above + rows.line_num, 1, f"is not CSV: {error}")

    def _header(self, header: list[str]) -> None:
        self.width = len(header)
        if any("\0" in text for text in header):
            cure = "save it as plain CSV, UTF-8"
            self.faults.note(self.table.header, 1, f"is a binary file, or text of another encoding; {cure}")
            return
        self.table.first = parted(header[0], self.names)[0]
        for cell, text in enumerate(header, 1):
            heading = Heading(self.table.header, cell, *parted(text, self.names))
            if self.timed and cell == 1 and (is_time(heading.name) or heading.name in self.times):
                heading = replace(heading, name="time")
            self._heading(heading)
        columns, values = self.table.columns, self.table.values
        self.signals = [(c, c.cell - 1, values[c.name]) for c in columns.values() if c.cell > 1 or not self.timed]

    def _heading(self, heading: Heading) -> None:
        line, cell, name = heading.line, heading.cell, heading.name
        if self.timed and cell == 1 and name != "time":
            self.faults.note(line, 1, not_time(name))
            self.table.columns["time"] = Column(replace(heading, name="time"), spare=True)  # the rest is still read
            self.table.values["time"] = array("d")
        elif name in self.table.columns:
            first = self.table.columns[name].cell
            self.faults.note(line, cell, f'column "{name}" stands twice, first as column {first}; keep one')
        elif (column := self.choose(heading)) is None:
            pass
        elif column.name in self.table.columns:  # by another name
            first = self.table.columns[column.name].cell
            self.faults.note(line, cell, f'column "{name}" is {column.name}, as column {first} is; keep one')
        else:
            self.table.columns[column.name], self.table.values[column.name] = column, array("d")

    def _row(self, line: int, row: list[str]) -> None:
        if len(row) != self.width:
            self.faults.note_cell(line, 1, "rows of another length", _wrong_length(len(row), self.width))
            return
        if self.timed and not self._time(line, row[0]):
            return
        for column, place, values in self.signals:
            values.append(self._value(line, column, row[place]))
        self.table.lines.append(line)

    def _time(self, line: int, text: str) -> bool:
        """Take the time of a row; false where there is none."""
        time, before = self._value(line, self.table.columns["time"], text), self.table.values["time"]
        if self.table.columns["time"].spare:
            before.append(time)
            return True
        if math.isnan(time):
            return False
        if before and time <= before[-1]:
            message = f"time {time:g} s does not increase, {before[-1]:g} s stands before it; sort the rows"
            self.faults.note_cell(line, 1, "times that do not increase", f"{message}, keep one of each")
        before.append(time)
        return True

    def _spare(self, column: Column, text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.table.spoiled.add(column.name)
        return column.converted(value)

    def _value(self, line: int, column: Column, text: str) -> float:
        """A cell times the factor of its column, NaN where it is empty, `nan` or faulty."""
        if column.spare:
            return self._spare(column, text)
        try:
            value = float(text) if text and not text.isspace() else math.nan
        except ValueError:
            self.faults.note_cell(line, column.cell, *_no_number(text, column))
            return math.nan
        if math.isinf(value):
            message = f'"{text.strip()}" in column {column.name} is not finite; {column.cure}'
            self.faults.note_cell(line, column.cell, f"cells of {column.name} that are not finite", message)
            return math.nan
        if column.known and math.isnan(value):
            known = f"{column.known} is known at every row, so fill the cell or leave the row out"
            message = f"{column.name} has no value here; {known}"
            self.faults.note_cell(line, column.cell, f"cells of {column.name} without a value", message)
        return column.converted(value)


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


def _no_number(text: str, column: Column) -> tuple[str, str]:
    """What cells like this one are called where there are many, and what is said of it."""
    cell, name = text.strip()[:30], column.name
    if DECIMAL_COMMA.fullmatch(cell):
        return f"cells of {name} with a decimal comma", f'"{cell}" in column {name} has a decimal comma: write a point'
    return f"cells of {name} that are no number", f'"{cell}" in column {name} is no number; {column.cure}'


def _wrong_length(cells: int, header: int) -> str:
    """What is said of a row that has not as many cells as the header."""
    cure = "delete the row, or leave cells empty where nothing was measured"
    if cells == 2 * header:
        cure = "is each number cut in two by a decimal comma? Write a point"
    return f"has {cells} {'cell' if cells == 1 else 'cells'}, the header {header}; {cure}"


def _filled(row: Sequence[str]) -> bool:
    return any(cell.strip() for cell in row)


# -- writing ------------------------------------------------------------------------------------


def write_table(
    path: Path, header: Sequence[str], rows: Iterable[Iterable[float]], number: Callable[[float], str] = repr
) -> None:
    """Write a header and rows; `number` prints a cell, by itself as the shortest text that reads back bit for bit."""
    with atomic_write(path) as stream:
        csv.writer(stream, lineterminator="\n").writerow(header)
        stream.writelines(",".join(map(number, row)) + "\n" for row in rows)


def write_columns(path: Path, time: Array, columns: Mapping[str, Array], units: Mapping[str, str]) -> None:
    """Write `time` and columns as `name [unit]`, nine digits each."""
    header = ["time", *(f"{name} [{units[name]}]" for name in columns)]
    rows = zip(time.tolist(), *(c.tolist() for c in columns.values()), strict=True)
    write_table(path, header, rows, "{:.9g}".format)
