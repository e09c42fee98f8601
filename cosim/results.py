"""Results of a run: one row a communication point, one column a `component.variable`."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

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
    """

    time: Array
    columns: tuple[str, ...]
    values: Array
    units: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Array:
        return self.values[:, self.columns.index(name)]

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def write_csv(self, path: Path) -> None:
        """Write `time` and every column; numbers as the shortest text that reads back bit for bit."""
        write_table(path, ("time", *self.columns), self._rows())

    def write_what_fits(self, path: Path) -> int:
        """Write as many rows as the disk has room for; their number. OSError where that is none."""
        with draft_of(path) as draft, draft.open("wb", buffering=0) as stream:
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerow(("time", *self.columns))
            stream.write(text.getvalue().encode())
            for number, row in enumerate(self._rows()):
                line, before = (",".join(map(repr, row)) + "\n").encode(), stream.tell()
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
