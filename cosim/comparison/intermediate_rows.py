"""Comparison of rows that lie between two rows of the other run, so that a spike there counts as a difference.

Between two rows a signal is unknown except for its ends, whether it is held or interpolated. A row in between, or one
of several at the same time, must therefore lie within the range spanned by the surrounding rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array, Rows


@dataclass(frozen=True)
class RowsBetween:
    """Rows of run b at times missing in run a, and the surrounding rows of a from `first` to `last`."""

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
        ends = np.column_stack((self.first, self.last + 1)).ravel()
        padded = np.append(a, np.nan)  # A range may end with the last row.
        low, high = (f.reduceat(padded, ends)[::2] for f in (np.fmin, np.fmax))
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


def rows_between(a: Array, b: Array, tolerance: float) -> RowsBetween:
    """Return the rows of b between rows of a, without equal time in a.

    Args:
        tolerance: Largest difference of equal times [s].
    """
    after, upto = np.searchsorted(a, b - tolerance, side="left"), np.searchsorted(a, b + tolerance, side="right")
    is_apart = np.diff(b) > tolerance
    alone = np.append(True, is_apart) & np.append(is_apart, True)
    matched = alone & (upto - after == 1)
    within = (b >= a[0] - tolerance) & (b <= a[-1] + tolerance)
    rows = np.flatnonzero(within & ~matched)
    return RowsBetween(rows, b[rows], np.maximum(after[rows] - 1, 0), np.minimum(upto[rows], a.size - 1))
