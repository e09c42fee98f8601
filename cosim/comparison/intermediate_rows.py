"""Rows of one run that lie between those of the other: a spike there is no less a difference.

Between two rows nothing is known of a signal but where it comes from and goes to, whether it is held or runs straight.
So a row between them, or one of several at one time, is asked to lie within what the rows around it span.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array, Rows


@dataclass(frozen=True)
class Between:
    """Rows of b that are no row of a by themselves, and of each the rows of a from `first` to `last` around it."""

    rows: Rows
    time: Array
    first: Rows
    last: Rows

    def outside(self, a: Array, b: Array) -> tuple[float, float]:
        """How far b lies outside at most, infinite where one alone has no number, and when [s]; 0 without such rows."""
        if not self.rows.size:
            return 0.0, 0.0
        ends = np.column_stack((self.first, self.last + 1)).ravel()
        known = np.append(a, np.nan)  # a span may end with the last row
        low, high = (f.reduceat(known, ends)[::2] for f in (np.fmin, np.fmax))
        gaps = np.add.reduceat(np.isnan(np.append(a, 0.0)), ends)[::2] > 0
        values = b[self.rows]
        with np.errstate(invalid="ignore"):
            out = np.fmax(np.fmax(low - values, values - high), 0.0)
        out = np.where((values == low) | (values == high), 0.0, out)  # infinite alike
        out = np.where(np.isnan(values), np.where(gaps, 0.0, np.inf), np.where(np.isnan(low), np.inf, out))
        row = int(np.argmax(out))
        return float(out[row]), float(self.time[row])

    def other_text(self, a: Sequence[str], b: Sequence[str]) -> float | None:
        """When b first says what none of the rows around it says; None where it never does."""
        for row, time, first, last in zip(self.rows, self.time, self.first, self.last, strict=True):
            if b[int(row)] not in a[int(first) : int(last) + 1]:
                return float(time)
        return None


def rows_between(a: Array, b: Array, near: float) -> Between:
    """Of the times of two runs, a's and b's, which are the same where they are as near."""
    after, upto = np.searchsorted(a, b - near, side="left"), np.searchsorted(a, b + near, side="right")
    alone = np.ones(b.size, dtype=bool)
    alone[1:] &= np.diff(b) > near
    alone[:-1] &= np.diff(b) > near
    matched = alone & (upto - after == 1)
    within = (b >= a[0] - near) & (b <= a[-1] + near)
    rows = np.flatnonzero(within & ~matched)
    return Between(rows, b[rows], np.maximum(after[rows] - 1, 0), np.minimum(upto[rows], a.size - 1))
