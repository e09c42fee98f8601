"""Results of a run: one row a communication point, one column a `component.variable`."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from cosim.arrays import Array
from cosim.table import write_table
from fmus.files import draft_of

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
    """

    time: Array
    columns: tuple[str, ...]
    values: Array
    units: Mapping[str, str] = field(default_factory=dict)
    exact: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    whole: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()

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
            stream.write(text.getvalue().encode())
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
