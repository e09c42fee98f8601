"""Comparison of rows with the surrounding rows of the other run.

Between two rows a signal is unknown except for its ends, whether it is held or interpolated. A row in between, or one
of several at the same time, which mean a jump, must therefore lie within the range spanned by the surrounding rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.base.arrays import Array, Rows


@dataclass(frozen=True)
class RowsBetween:
    """Rows of run b, and the rows of a from `first` to `last` whose range is allowed for each."""

    rows: Rows
    time: Array
    first: Rows
    last: Rows

    def outside(self, a: Array, b: Array) -> tuple[float, float]:
        """Return the largest distance of b from the range spanned by the surrounding rows of a, and its time [s].

        The distance is infinite if a number is missing in a single run, and 0 if b has no rows between rows of a.
        """
        if not self.rows.size:
            return 0.0, 0.0
        low, high = self._range(a)
        ends = self._ends()
        gaps = np.add.reduceat(np.isnan(np.append(a, 0.0)), ends)[::2] > 0
        values = b[self.rows]
        with np.errstate(invalid="ignore"):
            out = np.fmax(np.fmax(low - values, values - high), 0.0)
        out = np.where((values == low) | (values == high), 0.0, out)  # equal infinities
        out = np.where(np.isnan(values), np.where(gaps, 0.0, np.inf), np.where(np.isnan(low), np.inf, out))
        row = int(np.argmax(out))
        return float(out[row]), float(self.time[row])

    def other_text(self, a: Sequence[str], b: Sequence[str]) -> float | None:
        """Return the first time [s] at which the text of b differs from the surrounding texts of a; None if never."""
        for row, time, first, last in zip(self.rows, self.time, self.first, self.last, strict=True):
            if b[int(row)] not in a[int(first) : int(last) + 1]:
                return float(time)
        return None

    def nearest(self, a: Array, b: Array) -> Array:
        """Return b with the nearest value in the range of a in place of each of the rows."""
        values = b.copy()
        if self.rows.size:
            values[self.rows] = np.clip(b[self.rows], *self._range(a))
        return values

    def _range(self, a: Array) -> tuple[Array, Array]:
        """Return the least and the largest values of a around each row."""
        padded = np.append(a, np.nan)  # A range may end with the last row.
        low, high = (f.reduceat(padded, self._ends())[::2] for f in (np.fmin, np.fmax))
        return low, high

    def _ends(self) -> Rows:
        return np.column_stack((self.first, self.last + 1)).ravel()

    def only(self, chosen: NDArray[np.bool_]) -> RowsBetween:
        """Return some of the rows."""
        return RowsBetween(self.rows[chosen], self.time[chosen], self.first[chosen], self.last[chosen])


def surroundings(a: Array, b: Array, tolerance: float) -> RowsBetween:
    """Return the rows of b in the time of a with the surrounding rows of a, which is one row if both have one then.

    Args:
        tolerance: Largest difference of equal times [s].
    """
    after, upto = np.searchsorted(a, b - tolerance, side="left"), np.searchsorted(a, b + tolerance, side="right")
    matched = _alone(b, tolerance) & (upto - after == 1)
    first, last = np.where(matched, after, after - 1), np.where(matched, after, upto)
    rows = np.flatnonzero((b >= a[0] - tolerance) & (b <= a[-1] + tolerance))
    return RowsBetween(rows, b[rows], np.maximum(first[rows], 0), np.minimum(last[rows], a.size - 1))


def rows_between(a: Array, b: Array, tolerance: float) -> RowsBetween:
    """Return the rows of b between rows of a, or at a time at which a or b has several rows."""
    every = surroundings(a, b, tolerance)
    return every.only(every.first < every.last)


def rows_at_jumps(a: Array, b: Array, tolerance: float) -> RowsBetween:
    """Return the rows of b at a time at which a or b has several rows."""
    every = rows_between(a, b, tolerance)
    count = np.searchsorted(a, every.time + tolerance, side="right") - np.searchsorted(a, every.time - tolerance)
    return every.only((count > 1) | ~_alone(b, tolerance)[every.rows])


def _alone(times: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return whether each row is the only one at its time."""
    is_apart = np.diff(times) > tolerance
    alone: NDArray[np.bool_] = np.append(True, is_apart) & np.append(is_apart, True)
    return alone
