"""Comparison of rows with the surrounding rows of the other run.

Between two rows a signal is unknown except for its ends, whether it is held or interpolated. A row in between, or one
of several at the same time, which mean a jump, must therefore lie within the range spanned by the surrounding rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.core.arrays import Array, Rows


@dataclass(frozen=True)
class RowsBetween:
    """Rows of run b, and the rows of a from `first` to `last` whose range is allowed for each.

    Attributes:
        is_jump: Whether a or b has several rows at the time of a row.
    """

    rows: Rows
    time: Array
    first: Rows
    last: Rows
    is_jump: NDArray[np.bool_]

    def outside(self, a: Array, b: Array) -> tuple[float, float]:
        """Return the largest distance of b from the range spanned by the surrounding rows of a, and its time [s].

        The distance is infinite if a number is missing in a single run, and 0 if b has no rows between rows of a.
        """
        if not self.rows.size:
            return 0.0, 0.0
        low, high = self._range(a)
        ends = np.column_stack((self.first, self.last + 1)).ravel()
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
        ends = np.column_stack((self.first, self.last + 1)).ravel()
        return np.fmin.reduceat(padded, ends)[::2], np.fmax.reduceat(padded, ends)[::2]

    def only(self, *, jumps: bool = False) -> RowsBetween:
        """Return the rows between rows of a, or at a time at which a or b has several rows; or at such times only."""
        chosen = (self.first < self.last) & (self.is_jump | (not jumps))
        first, last = self.first[chosen], self.last[chosen]
        return RowsBetween(self.rows[chosen], self.time[chosen], first, last, self.is_jump[chosen])


def surroundings(a: Array, b: Array, tolerance: float) -> RowsBetween:
    """Return the rows of b in the time of a with the surrounding rows of a, which is one row if both have one then.

    Args:
        tolerance: Largest difference of equal times [s].
    """
    after, upto = np.searchsorted(a, b - tolerance, side="left"), np.searchsorted(a, b + tolerance, side="right")
    is_apart = np.diff(b) > tolerance
    alone = np.append(True, is_apart) & np.append(is_apart, True)
    matched = alone & (upto - after == 1)
    first, last = np.where(matched, after, after - 1), np.where(matched, after, upto)
    rows = np.flatnonzero((b >= a[0] - tolerance) & (b <= a[-1] + tolerance))
    is_jump = ((upto - after > 1) | ~alone)[rows]
    return RowsBetween(rows, b[rows], np.maximum(first[rows], 0), np.minimum(last[rows], a.size - 1), is_jump)
