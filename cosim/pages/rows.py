"""Rows of a run with a pyramid of block extremes, and the points needed to draw a signal.

Level 0 contains the rows. A block of level k + 1 contains the smallest and largest value of `FACTOR` blocks of level k.
Time is a column like the others: its extremes are the first and last time of a block.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.files.results import is_rounded

FACTOR, LEVELS = 16, 3
GROUP: int = FACTOR**LEVELS  # number of rows up to which a block of the highest level is made
BLOCKS = 4  # minimum number of blocks per pixel column, so that an edge is wrong by at most a quarter of a column
MAX_ROWS = 2  # rows per pixel column up to which rows are drawn unchanged
TIME = "time"
Extremes = list[tuple[Array, Array]]  # smallest and largest values of the blocks of each level above 0
Places = Rows | slice


def extremes_of(values: Array) -> Extremes:
    """Return smallest and largest values of the blocks of all levels above 0; missing values are ignored."""
    low = high = finite(values)
    levels: Extremes = []
    for _ in range(LEVELS):
        pad = np.full(-low.size % FACTOR, np.nan)
        low = np.fmin.reduce(np.append(low, pad).reshape(-1, FACTOR), axis=1)
        high = np.fmax.reduce(np.append(high, pad).reshape(-1, FACTOR), axis=1)
        levels.append((low, high))
    return levels


def finite(values: Array) -> Array:
    """Return values with NaN for infinite ones."""
    return np.where(np.isfinite(values), values, np.nan)


def _picked(values: Array, places: Places) -> Array:
    """Return values at indices; NaN beyond the last value, for signals computed before the last rows arrived."""
    if isinstance(places, slice):
        found, count = values[places], places.stop - places.start
        return found if found.size == count else np.append(found, np.full(count - found.size, np.nan))
    return np.where(places < values.size, values[np.minimum(places, values.size - 1)], np.nan)


@dataclass(frozen=True)
class Picture:
    """Rows or blocks of a time range, and their pixel columns.

    If there are few rows, all are used. Otherwise each pixel column has the extremes of all its rows, for any spacing
    of their times. One row beyond each end is included.

    Attributes:
        parts: Levels and indices of their blocks.
        time: Times of the points [s].
        order: Order of the blocks of all parts by time.
        starts: First block of each point; None if the points are rows.
    """

    recording: Recording
    parts: Sequence[tuple[int, Places]]
    time: Array
    order: Places
    starts: Rows | None = None

    def points(self, name: str) -> tuple[Array, Array]:
        """Return the smallest and largest value of each point of a signal; NaN without a finite value."""
        blocks = [self.recording.blocks(name, *part) for part in self.parts]
        low, high = (np.concatenate(side)[self.order] for side in zip(*blocks, strict=True))
        if self.starts is None:
            return low, high
        return np.fmin.reduceat(low, self.starts), np.fmax.reduceat(high, self.starts)


class Recording:
    """Time and signals of a run in memory; a subclass keeps its columns in a file.

    Attributes:
        units: Signal → unit, "" without unit, in the order of the file.
        rows: Number of rows.
        added: Units of computed signals.
        texts: Signals that doubles cannot represent, with all values as text; integers also have a numeric column.
        rounded: Signals with integers that are drawn as doubles and kept exactly as text.
        inexact: Signals with integers that are read as doubles and lose their last digits.
        assumed: Assumptions made when the table was read, as sentences.
    """

    def __init__(
        self,
        columns: Mapping[str, Array],
        units: Mapping[str, str],
        rows: int,
        texts: Mapping[str, Sequence[Any]] = MappingProxyType({}),
    ) -> None:
        self.units, self.rows, self.texts = dict(units), rows, texts
        self.added = dict[str, str]()
        self.rounded = [name for name in texts if name in columns and is_rounded(columns[name])]
        self.inexact: list[str] = []
        self.assumed: Sequence[str] = ()
        self._columns = dict(columns)
        self._levels: dict[str, tuple[int, Extremes]] = {}  # column → (number of covered rows, extremes)
        self._lock = threading.RLock()

    def unit(self, name: str) -> str:
        """Return the unit of a signal."""
        return {**self.units, **self.added}.get(name, "")

    def add(self, name: str, values: Array, unit: str) -> None:
        """Add a computed signal."""
        with self._lock:
            self._columns[name], self.added[name] = values, unit
            self._levels.pop(name, None)

    def remove(self, name: str) -> None:
        """Remove a computed signal."""
        with self._lock:
            del self._columns[name], self.added[name]
            self._levels.pop(name, None)

    def column(self, name: str) -> Array:
        """Return all rows of a column."""
        return self._columns[name]

    def take(self, name: str, places: Places) -> Array:
        """Return rows of a column."""
        with self._lock:
            return _picked(self.column(name), places)

    def read(self, name: str, begin: int = 0, end: int | None = None) -> Array:
        """Return the rows `begin` to `end` (exclusive) of a column."""
        return self.take(name, slice(begin, self.rows if end is None else end))

    def text(self, name: str, row: int) -> str:
        """Return a text of a row."""
        return str(self.texts[name][row])

    def exact(self, name: str, begin: int, end: int) -> Array | list[str]:
        """Return the rows `begin` to `end` (exclusive) of a column, as text if doubles cannot represent them."""
        if name not in self.texts:
            return self.read(name, begin, end)
        return [self.text(name, row) for row in range(begin, end)]

    def locate(self, time: float, side: Literal["left", "right"] = "left") -> int:
        """Return the number of rows before a time [s]; with `right`, rows at the time are included."""
        return int(np.searchsorted(self.column(TIME), time, side))

    def span(self) -> tuple[float, float]:
        """Return the first and the last time [s], zeros without rows."""
        time = self.column(TIME) if self.rows else np.zeros(1)
        return float(time[0]), float(time[-1])

    def blocks(self, name: str, level: int, places: Places) -> tuple[Array, Array]:
        """Return the smallest and largest values of blocks of a level (of rows at level 0).

        Infinite values are missing.
        """
        if not level:
            values = finite(self.take(name, places))
            return values, values
        with self._lock:
            values = self.column(name)
            covered, levels = self._levels.get(name, (0, [(np.empty(0), np.empty(0))] * LEVELS))
            if covered != values.size:  # the last block may be incomplete
                begin = covered // GROUP * GROUP
                more = zip(levels, extremes_of(values[begin:]), strict=True)
                levels = [
                    (np.append(low[: begin // FACTOR**k], new_low), np.append(high[: begin // FACTOR**k], new_high))
                    for k, ((low, high), (new_low, new_high)) in enumerate(more, 1)
                ]
                self._levels[name] = values.size, levels
            low, high = levels[level - 1]
            return _picked(low, places), _picked(high, places)

    def picture(self, begin: float, end: float, width: int) -> Picture:
        """Return the rows and blocks to draw for a time range [s] with `width` pixel columns."""
        first, stop = max(0, self.locate(begin) - 1), min(self.rows, self.locate(end, "right") + 1)
        if stop - first <= MAX_ROWS * width:
            return Picture(self, [(0, slice(first, stop))], self.read(TIME, first, stop), slice(None))
        pixel, level = (end - begin) / width, 0
        while level < LEVELS and stop - first >= BLOCKS * width * FACTOR ** (level + 1):
            level += 1
        size = FACTOR**level
        found = self._divide(level, slice(first // size, -(-stop // size)), pixel)
        since, until = (np.concatenate([part[k] for part in found]) for k in (2, 3))
        order = np.argsort(since, kind="stable") if len(found) > 1 else slice(None)
        since, until = since[order], until[order]
        column = np.clip(np.floor((since - begin) / pixel), -1, width)
        starts = np.flatnonzero(np.diff(column, prepend=-2.0))
        middle = (since[starts] + until[np.append(starts[1:], column.size) - 1]) / 2
        return Picture(self, [part[:2] for part in found], middle, order, starts)

    def _divide(self, level: int, places: Places, pixel: float) -> list[tuple[int, Places, Array, Array]]:
        """Return (level, indices, first time, last time) of blocks; blocks wider than a pixel are divided."""
        since, until = self.blocks(TIME, level, places)
        wide = until - since > pixel
        if level == 0 or not wide.any():
            return [(level, places, since, until)]
        numbers = np.arange(places.start, places.stop) if isinstance(places, slice) else places
        inner = (numbers[wide, None] * FACTOR + np.arange(FACTOR)).ravel()
        inner = inner[inner * FACTOR ** (level - 1) < self.rows]
        parts = [(level, numbers[~wide], since[~wide], until[~wide])] if not wide.all() else []
        return [*parts, *self._divide(level - 1, inner, pixel)]


class Store(Recording):
    """Rows in a file that may grow; safe for several threads.

    The file `rows` has the columns one after another, each with room for further rows.
    """

    def __init__(self, folder: Path, units: Mapping[str, str], rows: int = 0) -> None:
        super().__init__({}, units, rows)
        self._file = folder / "rows"
        self._places = {name: k for k, name in enumerate([TIME, *units])}
        self._map: Any = np.empty((len(self._places), 0))
        if rows:
            self._open()

    def _open(self) -> None:
        self._map = np.memmap(self._file, np.float64, "r").reshape(len(self._places), -1)

    def append(self, values: Array) -> None:
        """Add rows, shape (columns, rows), time first."""
        with self._lock:
            rows, room = self.rows + values.shape[1], self._map.shape[1]
            if rows > room:
                room, draft = max(rows, 2 * room, GROUP), self._file.with_suffix(".draft")
                with draft.open("wb") as stream:
                    for k in range(len(self._places)):
                        stream.seek(8 * room * k)
                        stream.write(self._map[k, : self.rows].tobytes())
                    stream.truncate(8 * room * len(self._places))
                self._map = None  # some systems cannot replace a mapped file
                draft.replace(self._file)
                self._open()
            with self._file.open("r+b") as stream:
                for k, part in enumerate(values):
                    stream.seek(8 * (room * k + self.rows))
                    stream.write(part.tobytes())
            self.rows = rows

    def column(self, name: str) -> Array:
        """Return all rows of a column."""
        if name in self.added:
            return super().column(name)
        with self._lock:
            column: Array = self._map[self._places[name], : self.rows]
            return column.view(np.ndarray)
