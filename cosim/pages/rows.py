"""Rows of a run with the extremes of their blocks, and the points that a picture of a signal needs.

Level 0 holds the rows. A block of level k + 1 holds the least and the largest value of `FACTOR` blocks of level k. Time
is a column like the others: its extremes are the first and the last time of a block.
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
GROUP: int = FACTOR**LEVELS  # rows whose columns stand together in a file
SIZES = [GROUP // FACTOR**level for level in range(LEVELS + 1)]  # blocks of a group, by level
BLOCKS = 4  # least number of blocks in a pixel column, so that an edge is wrong by a quarter of a column at most
MAX_ROWS = 2  # rows for each pixel column that are drawn as they are
TIME = "time"
Side = Literal["low", "high"]
Places = Rows | slice


def extremes_of(values: Array) -> list[tuple[Array, Array]]:
    """Return least and largest values of the blocks of all levels along the last axis; missing values do not count."""
    levels = [(finite(values), finite(values))]
    for _ in range(LEVELS):
        low, high = levels[-1]
        missing = -low.shape[-1] % FACTOR
        pad = [(0, 0)] * (low.ndim - 1) + [(0, missing)]
        blocks = (np.pad(side, pad, constant_values=np.nan) if missing else side for side in (low, high))
        first, second = (side.reshape((*side.shape[:-1], -1, FACTOR)) for side in blocks)
        levels.append((np.fmin.reduce(first, axis=-1), np.fmax.reduce(second, axis=-1)))
    return levels


def finite(values: Array) -> Array:
    """Return values with NaN for infinite ones."""
    return np.where(np.isfinite(values), values, np.nan)


def _picked(values: Array, places: Places) -> Array:
    """Return values at places; NaN beyond the last one, as of a signal that was computed before the last rows."""
    if isinstance(places, slice):
        found, count = values[places], places.stop - places.start
        return found if found.size == count else np.append(found, np.full(count - found.size, np.nan))
    return np.where(places < values.size, values[np.minimum(places, values.size - 1)], np.nan)


@dataclass(frozen=True)
class Picture:
    """Rows or blocks of a time range, and their pixel columns.

    Few rows are taken as they are. Otherwise each pixel column has the extremes of all its rows, whatever the distances
    of their times. One row beyond each end is included.

    Attributes:
        time: Times of the points [s].
        order: Order of the blocks of all parts by time; None for the order of their parts.
        starts: First block of each point; None if the points are rows.
    """

    recording: Recording
    parts: Sequence[tuple[int, Places]]
    time: Array
    order: Rows | None = None
    starts: Rows | None = None

    def points(self, name: str) -> tuple[Array, Array]:
        """Return least and largest value of each point of a signal; NaN without a finite value."""
        sides: tuple[Side, Side] = ("low", "high")
        low, high = (
            np.concatenate([self.recording.blocks(side, name, *place) for place in self.parts]) for side in sides
        )
        if self.starts is None:
            return low, low
        if self.order is not None:
            low, high = low[self.order], high[self.order]
        return np.fmin.reduceat(low, self.starts), np.fmax.reduceat(high, self.starts)


class Recording:
    """Time and signals of a run in memory. A subclass reads its columns from a file instead.

    Attributes:
        units: Name of a signal → unit, "" without unit, in the order of the file.
        rows: Number of rows.
        full: Number of rows that blocks cover.
        added: Units of signals that were computed here.
        texts: Signals that doubles do not hold, each with all its texts; those of integers are numbers too.
        rounded: Signals with integers that are drawn as doubles, and of which all digits are there as texts.
        inexact: Signals with integers that are read as doubles, without their last digits.
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
        self._columns = dict(columns)
        self._levels: dict[str, list[tuple[Array, Array]]] = {}
        self._lock = threading.RLock()

    @property
    def full(self) -> int:
        """Return the number of rows that blocks cover."""
        return self.rows

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

    def take(self, name: str, places: Places) -> Array:
        """Return rows of a column."""
        with self._lock:
            return _picked(self._columns[name], places)

    def blocks(self, side: Side, name: str, level: int, places: Places) -> Array:
        """Return extremes of blocks of a level, at level 0 of rows; infinite values are missing."""
        if not level:
            return finite(self.take(name, places))
        with self._lock:
            if name not in self._levels:
                self._levels[name] = extremes_of(self._columns[name])
            return _picked(self._levels[name][level][side == "high"], places)

    def locate(self, time: float, side: Literal["left", "right"] = "left") -> int:
        """Return the number of rows before a time [s], or with `right` up to it."""
        return int(np.searchsorted(self.read(TIME), time, side))

    # -- from here on the same for every kind of store -------------------------------------------------

    def text(self, name: str, row: int) -> str:
        """Return a text of a row."""
        return str(self.texts[name][row])

    def exact(self, name: str, begin: int, end: int) -> Array | list[str]:
        """Return the rows of a column from `begin` up to `end`, as texts if doubles do not hold them."""
        if name not in self.texts:
            return self.read(name, begin, end)
        return [self.text(name, row) for row in range(begin, end)]

    def read(self, name: str, begin: int = 0, end: int | None = None) -> Array:
        """Return the rows of a column from `begin` up to `end`."""
        return self.take(name, slice(begin, self.rows if end is None else end))

    def span(self) -> tuple[float, float]:
        """Return the first and the last time [s], zeros without rows."""
        ends = self.take(TIME, np.array([0, self.rows - 1])) if self.rows else np.zeros(2)
        return float(ends[0]), float(ends[1])

    def picture(self, begin: float, end: float, width: int) -> Picture:
        """Return the choice of rows and blocks for a picture of a time range [s] with `width` pixel columns."""
        first, stop = max(0, self.locate(begin) - 1), min(self.rows, self.locate(end, "right") + 1)
        if stop - first <= MAX_ROWS * width:
            return Picture(self, [(0, slice(first, stop))], self.read(TIME, first, stop))
        pixel, level, full = (end - begin) / width, 0, min(stop, self.full)
        while level < LEVELS and stop - first >= BLOCKS * width * FACTOR ** (level + 1):
            level += 1
        size, found = FACTOR**level, list[tuple[int, Places, Array, Array]]()
        if first < full:
            found += self._divide(level, slice(first // size, -(-full // size)), pixel)
        if stop > max(first, full):
            found += self._divide(0, slice(max(first, full), stop), pixel)
        since, until = (np.concatenate([part[k] for part in found]) for k in (2, 3))
        order = np.argsort(since, kind="stable") if len(found) > 1 else None
        if order is not None:
            since, until = since[order], until[order]
        column = np.clip(np.floor((since - begin) / pixel), -1, width)
        starts = np.flatnonzero(np.diff(column, prepend=-2.0))
        middle = (since[starts] + until[np.append(starts[1:], column.size) - 1]) / 2
        return Picture(self, [part[:2] for part in found], middle, order, starts)

    def _divide(self, level: int, places: Places, pixel: float) -> list[tuple[int, Places, Array, Array]]:
        """Return level, places, first and last time of blocks; a block wider than a pixel is divided."""
        since, until = self.blocks("low", TIME, level, places), self.blocks("high", TIME, level, places)
        wide = until - since > pixel
        if level == 0 or not wide.any():
            return [(level, places, since, until)]
        numbers = np.arange(places.start, places.stop) if isinstance(places, slice) else places
        inner = (numbers[wide, None] * FACTOR + np.arange(FACTOR)).ravel()
        inner = inner[inner * FACTOR ** (level - 1) < self.full]
        parts = [(level, numbers[~wide], since[~wide], until[~wide])] if not wide.all() else []
        return [*parts, *self._divide(level - 1, inner, pixel)]


class Store(Recording):
    """Rows in two files, which may grow; for several threads.

    A file has groups of `GROUP` rows, in which a column stands together: `rows` the rows, `blocks` the extremes of all
    levels. The rows of the last group are in memory until there are enough.
    """

    def __init__(self, folder: Path, units: Mapping[str, str], rows: int = 0) -> None:
        super().__init__({}, units, rows)
        self.folder = folder
        self._places = {name: k for k, name in enumerate([TIME, *units])}
        self._groups = -(-rows // GROUP)
        self._rest = np.empty((len(self._places), GROUP))
        self._maps: tuple[int, Any, Any] = (-1, None, None)
        self._firsts = np.empty(0)  # first time of each group in the files

    @property
    def full(self) -> int:
        """Return the number of rows in the files."""
        return min(self.rows, self._groups * GROUP)

    def append(self, values: Array) -> None:
        """Add rows, shape (columns, rows), time first."""
        with self._lock:
            while values.shape[1]:
                begin = self.rows - self.full
                part = values[:, : GROUP - begin]
                self._rest[:, begin : begin + part.shape[1]] = part
                if begin + part.shape[1] == GROUP:
                    self._write()
                self.rows += part.shape[1]
                values = values[:, part.shape[1] :]

    def finish(self) -> None:
        """Write the rows of the last group."""
        with self._lock:
            if rest := self.rows - self.full:
                self._rest[:, rest:] = np.nan
                self._write()

    def _write(self) -> None:
        levels = extremes_of(self._rest)
        kept = [level[side] for side in range(2) for level in levels[1:]]
        for name, part in (("rows", self._rest), ("blocks", np.concatenate(kept, axis=1))):
            with (self.folder / name).open("ab") as stream:
                stream.write(part.tobytes())
        self._groups += 1

    def _mapped(self) -> tuple[Any, Any]:
        """Return the content of the files, shape (groups, columns, numbers)."""
        if self._maps[0] != self._groups:
            shape = self._groups, len(self._places)
            inner = 2 * sum(SIZES[1:])
            files = [
                np.memmap(self.folder / name, np.float64, "r", shape=(*shape, size))
                for name, size in (("rows", GROUP), ("blocks", inner))
            ]
            self._maps = self._groups, files[0], files[1]
            self._firsts = np.array(files[0][:, 0, 0])
        return self._maps[1], self._maps[2]

    def take(self, name: str, places: Places) -> Array:
        """Return rows of a column."""
        if name in self.added:
            return super().take(name, places)
        column = self._places[name]
        with self._lock:
            full = self.full
            rest = self._rest[column, : self.rows - full]
            if isinstance(places, slice):
                begin, stop = places.start, min(places.stop, self.rows)
                parts = [rest[max(0, begin - full) : max(0, stop - full)]]
                if begin < full:
                    first, last = begin // GROUP, -(-min(stop, full) // GROUP)
                    rows = self._mapped()[0][first:last, column].reshape(-1)
                    parts.insert(0, rows[begin - first * GROUP : min(stop, full) - first * GROUP])
                return np.concatenate(parts)
            values, stored = np.empty(places.size), places < full
            if stored.any():
                values[stored] = self._mapped()[0][places[stored] // GROUP, column, places[stored] % GROUP]
            values[~stored] = rest[places[~stored] - full]
            return values

    def blocks(self, side: Side, name: str, level: int, places: Places) -> Array:
        """Return extremes of blocks of a level, at level 0 of rows; infinite values are missing."""
        if not level or name in self.added:
            return super().blocks(side, name, level, places)
        size, column = SIZES[level], self._places[name]
        begin = sum(SIZES[1:level]) + (sum(SIZES[1:]) if side == "high" else 0)
        with self._lock:
            blocks = self._mapped()[1]
            if isinstance(places, slice):
                first, last = places.start // size, -(-places.stop // size)
                values = blocks[first:last, column, begin : begin + size].reshape(-1)
                return np.asarray(values[places.start - first * size : places.stop - first * size])
            return np.asarray(blocks[places // size, column, begin + places % size])

    def locate(self, time: float, side: Literal["left", "right"] = "left") -> int:
        """Return the number of rows before a time [s], or with `right` up to it."""
        with self._lock:
            full, begin = self.full, self.full
            if full:
                self._mapped()
                rest = self._rest[0, : self.rows - full]
                is_in_rest = rest.size and (rest[0] < time if side == "left" else rest[0] <= time)
                begin = full if is_in_rest else max(0, int(np.searchsorted(self._firsts, time, side)) - 1) * GROUP
            end = self.rows if begin == full else min(full, begin + GROUP)
            return begin + int(np.searchsorted(self.take(TIME, slice(begin, end)), time, side))
