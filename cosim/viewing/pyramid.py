"""Rows of a run with the extremes of their blocks, and the points that a picture of a signal needs.

Level 0 holds the rows. A block of level k + 1 holds the least and the largest value of `FACTOR` blocks of level k. Time
is a column like the others: its extremes are the first and the last time of a block.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from types import MappingProxyType
from typing import Literal

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.storage.results import is_rounded

FACTOR = 16
TOP = 256  # most blocks of the highest level
BLOCKS = 4  # least number of blocks in a pixel column, so that an edge is wrong by a quarter of a column at most
MOST_ROWS = 2  # rows for each pixel column that are drawn as they are
TIME = "time"
Part = Literal["rows", "low", "high"]
Places = Rows | slice


def level_sizes(rows: int) -> list[int]:
    """Return the numbers of blocks of all levels, rows first."""
    sizes = [rows, -(-rows // FACTOR)]
    while sizes[-1] > TOP:
        sizes.append(-(-sizes[-1] // FACTOR))
    return sizes


def join_blocks(low: Array, high: Array) -> tuple[Array, Array]:
    """Return the extremes of each `FACTOR` blocks along the last axis; missing values do not count."""
    missing = -low.shape[-1] % FACTOR
    pad = [(0, 0)] * (low.ndim - 1) + [(0, missing)]
    blocks = (np.pad(side, pad, constant_values=np.nan) if missing else side for side in (low, high))
    shape = (*low.shape[:-1], -1, FACTOR)
    first, second = (side.reshape(shape) for side in blocks)
    return np.fmin.reduce(first, axis=-1), np.fmax.reduce(second, axis=-1)


def make_levels(low: Array, high: Array, sizes: Sequence[int]) -> list[tuple[Array, Array]]:
    """Return the levels above a level, whose size is the first of `sizes`."""
    levels = []
    for _ in sizes[1:]:
        low, high = join_blocks(low, high)
        levels.append((low, high))
    return levels


def finite(values: Array) -> Array:
    """Return values with NaN for infinite ones."""
    return np.where(np.isfinite(values), values, np.nan)


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
        if self.starts is None:
            values = finite(self.recording.take("rows", name, self.parts[0][1]))
            return values, values
        low, high = (
            np.concatenate([self.recording.blocks(part, name, *place) for place in self.parts])
            for part in ("low", "high")
        )
        if self.order is not None:
            low, high = low[self.order], high[self.order]
        if self.parts[0][0] == 0 or self.parts[-1][0] == 0:  # rows; blocks have no infinite extremes
            low, high = finite(low), finite(high)
        return np.fmin.reduceat(low, self.starts), np.fmax.reduceat(high, self.starts)


class Recording:
    """Time and signals of a run in memory. A subclass reads columns from files instead.

    Attributes:
        units: Name of a signal → unit, "" without unit, in the order of the file.
        rows: Number of rows.
        added: Units of signals that were computed here.
        texts: Signals that doubles do not hold, each with all its texts; those of integers are numbers too.
        rounded: Signals with integers that are drawn as doubles, and of which all digits are there as texts.
        inexact: Signals with integers that are read as doubles, without their last digits.
        needed: Signals that are read one after the other now, for a subclass that reads several at once.
    """

    def __init__(
        self,
        columns: Mapping[str, Array],
        units: Mapping[str, str],
        rows: int,
        texts: Mapping[str, Sequence[str]] = MappingProxyType({}),
    ) -> None:
        self.units, self.rows, self.added, self.texts = dict(units), rows, dict[str, str](), texts
        self.rounded = [name for name in texts if name in columns and is_rounded(columns[name])]
        self.inexact: list[str] = []
        self.needed: frozenset[str] = frozenset()
        self.sizes = level_sizes(rows)
        # Above the rows, all levels stand one behind the other in a column.
        self.begins = [0, 0, *accumulate(self.sizes[1:-1])]
        self._columns = dict(columns)
        self._extremes: dict[str, tuple[Array, Array]] = {}
        self._lock = threading.RLock()

    def add(self, name: str, values: Array, unit: str) -> None:
        """Add a computed signal."""
        with self._lock:
            self._columns[name], self.added[name] = values, unit
            self._extremes.pop(name, None)

    def remove(self, name: str) -> None:
        """Remove a computed signal."""
        with self._lock:
            del self._columns[name], self.added[name]
            self._extremes.pop(name, None)

    def take(self, part: Part, name: str, places: Places) -> Array:
        """Return values of a column at places, which are within it."""
        with self._lock:
            if part == "rows":
                return self._columns[name][places]
            if name not in self._extremes:
                values = finite(self._columns[name])
                levels = make_levels(values, values, self.sizes)
                low, high = (np.concatenate(sides) for sides in zip(*levels, strict=True))
                self._extremes[name] = low, high
            return self._extremes[name][part == "high"][places]

    def text(self, name: str, row: int) -> str:
        """Return a text of a row."""
        return self.texts[name][row]

    def exact(self, name: str, begin: int, end: int) -> Array | list[str]:
        """Return the rows of a column from `begin` up to `end`, as texts if doubles do not hold them."""
        if name not in self.texts:
            return self.read(name, begin, end)
        return [self.text(name, row) for row in range(begin, end)]

    # -- from here on the same for every kind of store -------------------------------------------------

    def read(self, name: str, begin: int = 0, end: int | None = None) -> Array:
        """Return the rows of a column from `begin` up to `end`."""
        return self.take("rows", name, slice(begin, self.rows if end is None else end))

    def blocks(self, part: Part, name: str, level: int, places: Places) -> Array:
        """Return extremes of blocks of a level; level 0 has rows."""
        begin = self.begins[level]
        if level == 0:
            return self.take("rows", name, places)
        moved = slice(places.start + begin, places.stop + begin) if isinstance(places, slice) else places + begin
        return self.take(part, name, moved)

    def span(self) -> tuple[float, float]:
        """Return the first and the last time [s], zeros without rows."""
        ends = self.take("rows", TIME, np.array([0, self.rows - 1])) if self.rows else np.zeros(2)
        return float(ends[0]), float(ends[1])

    def locate(self, time: float, side: Literal["left", "right"] = "left") -> int:
        """Return the number of rows before a time [s], or with `right` up to it."""
        begin, end = 0, self.sizes[-1]
        for level in range(len(self.sizes) - 1, -1, -1):
            firsts = self.blocks("low", TIME, level, slice(begin, min(end, self.sizes[level])))
            place = begin + int(np.searchsorted(firsts, time, side))
            if level == 0:
                return place
            block = max(begin, place - 1)  # the last block that begins before
            begin, end = block * FACTOR, (block + 1) * FACTOR
        return 0

    def picture(self, begin: float, end: float, width: int) -> Picture:
        """Return the choice of rows and blocks for a picture of a time range [s] with `width` pixel columns."""
        first, stop = max(0, self.locate(begin) - 1), min(self.rows, self.locate(end, "right") + 1)
        if stop - first <= MOST_ROWS * width:
            return Picture(self, [(0, slice(first, stop))], self.read(TIME, first, stop))
        pixel, level = (end - begin) / width, 0
        while level + 1 < len(self.sizes) and stop - first >= BLOCKS * width * FACTOR ** (level + 1):
            level += 1
        size = FACTOR**level
        found = self._divide(level, slice(first // size, -(-stop // size)), pixel)
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
        since, until = (self.blocks(part, TIME, level, places) for part in ("low", "high"))
        wide = until - since > pixel
        if level == 0 or not wide.any():
            return [(level, places, since, until)]
        numbers = np.arange(places.start, places.stop) if isinstance(places, slice) else places
        inner = (numbers[wide, None] * FACTOR + np.arange(FACTOR)).ravel()
        inner = inner[inner < self.sizes[level - 1]]
        parts = [(level, numbers[~wide], since[~wide], until[~wide])] if not wide.all() else []
        return [*parts, *self._divide(level - 1, inner, pixel)]

    def every(self, names: Sequence[str], begin: float, end: float, count: int) -> tuple[int, list[Array]]:
        """Return the distance of rows, and about `count` rows of columns between two times [s]."""
        first, stop = max(0, self.locate(begin) - 1), min(self.rows, self.locate(end, "right") + 1)
        step = max(1, -(-(stop - first) // count))
        places = np.arange(first, stop, step)
        return step, [self.take("rows", name, places) for name in names]
