"""Results of a run: one row a communication point, one column a `component.variable`."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cosim.arrays import Array
from cosim.files import atomic_write

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
        with atomic_write(path) as stream:
            csv.writer(stream, lineterminator="\n").writerow(("time", *self.columns))
            for first in range(0, len(self.time), CHUNK):  # Python's floats take four times the room
                part = slice(first, first + CHUNK)
                for t, row in zip(self.time[part].tolist(), self.values[part].tolist(), strict=True):
                    stream.write(",".join(map(repr, (t, *row))) + "\n")


def read_csv(path: Path) -> Results:
    """Read a `results.csv` back."""
    with path.open(newline="") as stream:
        rows = csv.reader(stream)
        header = next(rows)
        table = np.array([[float(cell) for cell in row] for row in rows]).reshape(-1, len(header))
    return Results(table[:, 0], tuple(header[1:]), table[:, 1:])
