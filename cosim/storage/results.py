"""Results of a run: one row a communication point, one column a `component.variable`."""

from __future__ import annotations

import csv
import errno
import io
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.drafts import draft_of
from cosim.base.errors import Fault, InputError
from cosim.base.text import counted
from cosim.storage.table import MOST_BYTES, is_time, not_time, parted, seconds, write_table

CHUNK = 1000  # rows


@dataclass(frozen=True)
class Results:
    """Recorded signals.

    Row k holds, at `time[k]`, what is measured there and the command that acts until `time[k + 1]`.

    time:    communication points [s], shape (rows,)
    columns: names `component.variable`, one a column of `values`
    values:  shape (rows, columns)
    units:   name → unit, "" where the variable has none
    exact:   name → one a row of what no double holds exactly: text, 64-bit integers, binary data
    whole:   columns that hold whole numbers: integers, Booleans, enumerations
    notes:   what is to be known of the run
    loop:    which loop stepped it: "C", or "Python: " and why; "" where that is not known
    """

    time: Array
    columns: tuple[str, ...]
    values: Array
    units: Mapping[str, str] = field(default_factory=dict)
    exact: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    whole: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()
    loop: str = ""

    def __getitem__(self, name: str) -> Array:
        return self.values[:, self._places[name]]

    def __contains__(self, name: str) -> bool:
        return name in self._places

    @cached_property
    def _places(self) -> Mapping[str, int]:
        return {name: k for k, name in enumerate(self.columns)}

    def write_csv(self, path: Path) -> None:
        """Write `time` and every column; numbers as the shortest text that reads back bit for bit."""
        header = ("time", *self.columns, *self.exact)
        if self.exact or self.whole:
            write_table(path, header, self._typed_rows(), cell)
        else:
            write_table(path, header, self._rows())

    def write_what_fits(self, path: Path) -> int:
        """Write as many rows as the disk has room for; their number. OSError where that is none."""
        with draft_of(path) as draft, draft.open("wb", buffering=0) as stream:
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerow(("time", *self.columns, *self.exact))
            header = text.getvalue().encode()
            if stream.write(header) < len(header):
                raise OSError(errno.ENOSPC, "no room for a header")
            for number, row in enumerate(self._typed_rows()):
                line, before = (",".join(map(cell, row)) + "\n").encode(), stream.tell()
                try:
                    whole = stream.write(line) == len(line)
                except OSError:
                    whole = False
                if not whole:
                    stream.truncate(before)
                    return number
        return len(self.time)

    def _rows(self) -> Iterator[tuple[float, ...]]:
        for first in range(0, len(self.time), CHUNK):  # Python's floats take four times the room
            part = slice(first, first + CHUNK)
            for t, row in zip(self.time[part].tolist(), self.values[part].tolist(), strict=True):
                yield t, *row

    def _typed_rows(self) -> Iterator[tuple[Any, ...]]:
        whole = [k for k, name in enumerate(self.columns, 1) if name in self.whole]
        for number, row in enumerate(self._rows()):
            typed: list[Any] = list(row)
            for k in whole:
                typed[k] = int(row[k])
            yield *typed, *(column[number] for column in self.exact.values())


def cell(value: Any) -> str:
    """A value as a cell of CSV: binary data in hexadecimal digits, text in quotes where it needs them."""
    if isinstance(value, bytes):
        return value.hex()
    if not isinstance(value, str):
        return repr(value)
    return '"' + value.replace('"', '""') + '"' if any(c in value for c in ',"\r\n') else value


# -- read back ------------------------------------------------------------------------------------


def read_results(path: Path, units: Mapping[str, str] | None = None, text: Collection[str] = ()) -> Results:
    """Results that were written, or any CSV whose first column is `time`; InputError where it is none.

    A time in another unit is converted to seconds.
    units: of columns whose header says none
    text:  columns that are no numbers, whatever they look like; others are told by their cells
    """
    header, rows = _cells(path)
    named = [parted(text, units or {}) for text in header]
    if not is_time(named[0][0] if named else ""):
        raise InputError([Fault(path, 1, 1, not_time(named[0][0] if named else ""))])
    scale, unknown = seconds(named[0][1])
    if unknown:
        raise InputError([Fault(path, 1, 1, unknown)])
    named[0] = ("time", "s")
    wrong = next((k for k, row in enumerate(rows, 2) if len(row) != len(header)), None)
    if wrong is not None:
        count = len(rows[wrong - 2])
        raise InputError([Fault(path, wrong, 1, f"has {counted(count, 'cell')}, the header {len(header)}")])
    numbers: dict[str, Array] = {}
    exact: dict[str, list[str]] = {}
    whole: set[str] = set()
    for (name, _), cells in zip(named, zip(*rows, strict=True) if rows else ((),) * len(named), strict=True):
        if name in text:
            exact[name] = list(cells)
            continue
        try:
            numbers[name] = np.array([cell or "nan" for cell in cells], dtype=np.float64)
            if cells and all(cell.removeprefix("-").isdecimal() for cell in cells):
                whole.add(name)  # as they are written: every other number has a point or an exponent
        except ValueError:
            exact[name] = list(cells)
    if "time" not in numbers:
        raise InputError([Fault(path, 2, 1, "a time is no number")])
    time = numbers.pop("time") * scale
    _check_time(path, time)
    values = np.column_stack(list(numbers.values())) if numbers else np.empty((time.size, 0))
    found = {n: u for n, u in named[1:] if u} | {n: u for n, u in (units or {}).items() if n in numbers or n in exact}
    return Results(time, tuple(numbers), values, found, exact, frozenset(whole - {"time"}))


def _check_time(path: Path, time: Array) -> None:
    """Times are known and in order; at an event other tools write several rows of one."""
    unknown = np.flatnonzero(~np.isfinite(time))
    back = np.flatnonzero(np.diff(time) < 0.0) + 1
    if unknown.size:
        raise InputError(
            [Fault(path, int(unknown[0]) + 2, 1, "the row has no time; fill the cell or leave the row out")]
        )
    if back.size:
        row = int(back[0])
        why = f"time {time[row]:g} s comes after {time[row - 1]:g} s; sort the rows"
        raise InputError([Fault(path, row + 2, 1, why)])


def _cells(path: Path) -> tuple[list[str], list[list[str]]]:
    """The header and the rows of a CSV as text."""
    if not path.is_file():
        raise InputError([Fault(path, 0, 0, "is no file" if path.exists() else "no such file")])
    if path.stat().st_size > MOST_BYTES:
        raise InputError([Fault(path, 0, 0, f"has more than the {MOST_BYTES / 1e6:.0f} MB that are read")])
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = [row for row in csv.reader(stream) if row]
    except UnicodeDecodeError:
        raise InputError([Fault(path, 1, 1, "is not UTF-8 text; save it as plain CSV, UTF-8")]) from None
    except csv.Error as error:
        raise InputError([Fault(path, 1, 1, f"is not CSV: {error}")]) from None
    if not rows:
        raise InputError([Fault(path, 1, 1, "is empty; the first line names the columns: time, then signals")])
    return rows[0], rows[1:]
