"""Least and largest values of blocks of rows: a run of any length in bounded memory, without losing a peak."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array

MEMORY = 1 << 26  # of all blocks of a run [bytes]
MIN_BLOCKS, MAX_BLOCKS = 1 << 11, 1 << 15


@dataclass(frozen=True)
class Extremes:
    """Least and largest values of equal groups of rows, shape (signals, groups).

    Attributes:
        first: Number of the first row.
        size: Rows of a group; the last group may be incomplete.
    """

    first: int
    size: int
    low: Array
    high: Array


class Envelope:
    """Blocks of rows, whose size doubles whenever their number would exceed a limit; for several threads.

    Attributes:
        rows: Number of rows so far.
    """

    def __init__(self, columns: int) -> None:
        limit = MEMORY // (16 * max(1, columns))
        self.limit = 1 << max(MIN_BLOCKS, min(MAX_BLOCKS, limit)).bit_length() - 1
        self.rows, self._size = 0, 1
        self._low, self._high = (np.empty((self.limit, columns)) for _ in range(2))
        self._last = np.zeros(columns)
        self._lock = threading.Lock()

    def add(self, values: Array) -> None:
        """Add rows, shape (rows, columns)."""
        if not len(values):
            return
        with self._lock:
            while self.rows + len(values) > self._size * self.limit:
                self._double()
            first, size = self.rows // self._size, self._size
            end = (self.rows + len(values) - 1) // size + 1
            starts = np.maximum(0, np.arange(first, end) * size - self.rows)
            if size == 1:
                low = high = values
            else:
                low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
            if self.rows % size:  # The first block holds rows already.
                self._low[first] = np.minimum(self._low[first], low[0])
                self._high[first] = np.maximum(self._high[first], high[0])
                first, low, high = first + 1, low[1:], high[1:]
            self._low[first:end], self._high[first:end] = low, high
            self.rows += len(values)
            self._last = values[-1].copy()

    def last(self) -> Array:
        """Return the last row."""
        return self._last

    def extremes(self, columns: Sequence[int], first: int, end: int, count: int) -> Extremes:
        """Return at most about `count` groups of the rows from `first` up to `end`."""
        with self._lock:
            size = self._size
            begin, stop = max(0, first) // size, -(-min(end, self.rows) // size)
            if begin >= stop:
                return Extremes(begin * size, size, np.empty((len(columns), 0)), np.empty((len(columns), 0)))
            joined = max(1, -(-(stop - begin) // max(1, count)))
            begin -= begin % joined  # Groups stay the same while a window moves.
            low, high = self._low[begin:stop, columns], self._high[begin:stop, columns]
        starts = np.arange(0, stop - begin, joined)
        least, most = np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)
        return Extremes(begin * size, size * joined, least.T, most.T)

    def _double(self) -> None:
        """Join each two blocks."""
        used = -(-self.rows // self._size)
        for blocks, join in ((self._low, np.minimum), (self._high, np.maximum)):
            pairs = used // 2
            blocks[:pairs] = join(blocks[: 2 * pairs : 2], blocks[1 : 2 * pairs : 2])
            if used % 2:
                blocks[pairs] = blocks[used - 1]
        self._size *= 2
